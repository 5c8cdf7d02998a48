//! The robot and the workspace of the numeric studies.
//!
//! The paper publishes neither arm, camera position nor targets. The arm is the flight arm of the
//! Mars Exploration Rover with its microscopic imager, which has the same joints; camera position
//! and targets are ours and stated here. Everything is in the arm base frame: x away from the
//! rover, y right, z down, metres.

use nalgebra::{Unit, Vector3};
use rover_kinematics::{Arm, ArmError, AxisGoal, DhRow, JointLimits, Tool, solve_axis};
use rover_kinematics::{Elbow, Shoulder, Wrist};
use std::f64::consts::{FRAC_PI_2, PI};

/// Targets of the paper's table 1.
pub const TARGETS: usize = 196;
/// Joints of the arm.
pub const JOINTS: usize = 5;
/// Model errors: four for each joint, six for the camera mount.
pub const ERRORS: usize = 4 * JOINTS + 6;
/// Length of the tool along the last link's z, m (microscopic imager).
pub const TOOL_M: f64 = 0.1306;
/// Centre of the cameras, about which the mount turns: above the arm's base.
pub const CAMERA_CENTRE_M: [f64; 3] = [0.0, 0.0, -0.3];

/// `[a_m, d_m, alpha_rad]` of the rows (flight calibration of Opportunity's arm).
pub const ROWS: [[f64; 3]; JOINTS] = [
    [0.062443, 0.048494, FRAC_PI_2],
    [0.353552, 0.0, 0.0],
    [0.330349, 0.0, 0.0],
    [0.0, -0.098924, -FRAC_PI_2],
    [0.0, -0.077131, FRAC_PI_2],
];

/// The levels of the paper's table: angle and length standard deviation, and the paper's mean
/// error before and after one correction.
pub const LEVELS: [Level; 3] = [
    Level::new(0.5, 1.0, 12.2, 0.3),
    Level::new(1.0, 1.0, 23.0, 0.9),
    Level::new(1.0, 2.5, 25.7, 1.2),
];

/// One row of the paper's table 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Standard deviation of the angular errors, deg.
    pub angle_deg: f64,
    /// Standard deviation of the length errors, mm.
    pub length_mm: f64,
    /// The paper's mean error before, mm.
    pub paper_before_mm: f64,
    /// The paper's mean error after, mm.
    pub paper_after_mm: f64,
}

impl Level {
    const fn new(angle_deg: f64, length_mm: f64, before: f64, after: f64) -> Self {
        Self {
            angle_deg,
            length_mm,
            paper_before_mm: before,
            paper_after_mm: after,
        }
    }

    /// Angular standard deviation, rad.
    pub fn angle_rad(&self) -> f64 {
        self.angle_deg.to_radians()
    }

    /// Length standard deviation, m.
    pub fn length_m(&self) -> f64 {
        self.length_mm * 1e-3
    }
}

/// The believed arm; joints turn freely, because the paper's analysis knows no limits.
///
/// # Errors
/// [`ArmError`] never, for these rows.
pub fn arm() -> Result<Arm, ArmError> {
    let rows = ROWS.map(|[a_m, d_m, alpha_rad]| DhRow {
        a_m,
        alpha_rad,
        d_m,
        theta_offset_rad: 0.0,
    });
    let free = JointLimits {
        lower_rad: -2.0 * PI,
        upper_rad: 2.0 * PI,
        max_rate_rad_s: 1.0,
        max_acceleration_rad_s2: 1.0,
    };
    Arm::new(rows.to_vec(), vec![free; JOINTS])
}

/// The tool: its tip lies along the last link's z.
pub fn tool() -> Tool {
    Tool::on_turret(TOOL_M, 0.0)
}

/// The 196 targets, the same for every seed: a lattice that fills the part of x 0.35 to 0.66,
/// y -0.34 to 0.34, z -0.33 to 0.57 m which the arm reaches, the tool pointing within `cone_rad`
/// of straight down.
pub fn targets(arm: &Arm, cone_rad: f64) -> Vec<AxisGoal> {
    // The R3 low-discrepancy sequence (Roberts) in five dimensions: three of place, two of
    // direction.
    const STEP: [f64; 5] = [
        0.856_674_883_854_502_8,
        0.733_891_856_627_126_7,
        0.628_706_721_040_686,
        0.538_597_257_223_611_8,
        0.461_402_742_776_388_2,
    ];
    let along = |low: f64, high: f64, t: f64| low + (high - low) * t;
    let mut found = Vec::with_capacity(TARGETS);
    let mut i = 0.0;
    while found.len() < TARGETS && i < 1e5 {
        i += 1.0;
        let t = STEP.map(|s| (0.5 + s * i).fract());
        let point = Vector3::new(
            along(0.35, 0.66, t[0]),
            along(-0.34, 0.34, t[1]),
            along(-0.33, 0.57, t[2]),
        );
        // Uniform over the cap.
        let cosine = along(1.0, cone_rad.cos(), t[3]);
        let sine = (1.0 - cosine * cosine).sqrt();
        let turn = std::f64::consts::TAU * t[4];
        let axis = Unit::new_normalize(Vector3::new(sine * turn.cos(), sine * turn.sin(), cosine));
        let goal = AxisGoal { point, axis };
        if reachable_with_room(arm, &goal) {
            found.push(goal);
        }
    }
    found
}

/// Whether the arm reaches the goal, and everything within 12 cm of it, in its usual posture.
fn reachable_with_room(arm: &Arm, goal: &AxisGoal) -> bool {
    const ROOM_M: f64 = 0.06;
    let steps = [-ROOM_M, 0.0, ROOM_M];
    steps.iter().all(|dx| {
        steps.iter().all(|dz| {
            let near = AxisGoal {
                point: goal.point + Vector3::new(*dx, 0.0, *dz),
                axis: goal.axis,
            };
            usual_posture(arm, &near).is_some()
        })
    })
}

/// Joint angles of the goal with the arm's front towards it, elbow up and the wrist unflipped,
/// which is how the instrument arm is deployed; none if that does not reach.
pub fn usual_posture(arm: &Arm, goal: &AxisGoal) -> Option<Vec<f64>> {
    let found = solve_axis(arm, &tool(), goal).ok()?;
    found
        .into_iter()
        .find(|s| {
            s.branch.shoulder == Shoulder::Front
                && s.branch.elbow == Elbow::Positive
                && s.branch.wrist == Wrist::Positive
                && !s.singular
        })
        .map(|s| s.joints_rad)
}
