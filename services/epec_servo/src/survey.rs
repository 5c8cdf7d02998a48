//! Poses over the view at which some methods look at the fiducial before the approach.

use nalgebra::{Isometry3, Point3, Unit, Vector3};
use rover_cameras::{Camera, StereoPair};
use rover_compensation::ErrorModel;
use rover_geometry::{Direction, Rover, tangent_basis};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_messages::{planning::ToolPose, target::Target};
use rover_robot::Robot;

/// Candidates after which no more are sought.
const MOST_CANDIDATES: u32 = 96;
/// Sightings without which no camera model can be fitted.
pub const LEAST_FOUND: usize = 6;
/// Half the extent of the poses beside the target, and their heights above it, m. The spread in
/// height is what a linear camera model needs.
const BESIDE_M: f64 = 0.12;
const ABOVE_M: [f64; 2] = [0.10, 0.26];
/// Largest tilt of the tool from the normal, per axis, rad.
const TILT: f64 = 0.25;
/// Room between the plate's corners and the image's border, px: the plate is not where it is
/// predicted.
const MARGIN_PX: f64 = 30.0;

/// How far the survey has come.
#[derive(Clone, Debug)]
pub struct Survey {
    wanted: usize,
    found: usize,
    tried: u32,
}

impl Survey {
    /// A survey that ends after `wanted` sightings.
    pub fn new(wanted: usize) -> Self {
        Self {
            wanted,
            found: 0,
            tried: 0,
        }
    }

    /// Sightings so far.
    pub fn found(&self) -> usize {
        self.found
    }

    /// Whether enough was seen to go on.
    pub fn is_enough(&self) -> bool {
        self.wanted == 0 || self.found >= self.wanted.min(LEAST_FOUND)
    }

    /// Counts a sighting.
    pub fn count(&mut self) {
        self.found += 1;
    }

    /// The next pose that believed kinematics reach from near `q` and at which both cameras see
    /// the whole plate; none when all was seen or no candidate is left.
    pub fn next(
        &mut self,
        robot: &Robot,
        model: &ErrorModel,
        cameras: &StereoPair,
        target: &Target,
        q: &[f64],
    ) -> Option<ToolPose> {
        while self.found < self.wanted && self.tried < MOST_CANDIDATES {
            self.tried += 1;
            let pose = candidate(target, self.tried);
            if is_visible(robot, model, cameras, &pose, q) {
                return Some(pose);
            }
        }
        None
    }
}

/// The n-th pose of a low-discrepancy sequence over the target.
fn candidate(target: &Target, n: u32) -> ToolPose {
    // The R5 sequence (Roberts): three of place, two of direction.
    const STEP: [f64; 5] = [
        0.856_674_883_854_502_8,
        0.733_891_856_627_126_7,
        0.628_706_721_040_686,
        0.538_597_257_223_611_8,
        0.461_402_742_776_388_2,
    ];
    let t = STEP.map(|s| (0.5 + s * f64::from(n)).fract());
    let centred = |t: f64, half: f64| half * (2.0 * t - 1.0);
    let normal = target.normal.unit;
    let (a, b) = tangent_basis(&normal);
    let height = ABOVE_M[0] + (ABOVE_M[1] - ABOVE_M[0]) * t[2];
    let tip = target.position_m.coords
        + a * centred(t[0], BESIDE_M)
        + b * centred(t[1], BESIDE_M)
        + normal.into_inner() * height;
    let axis = -normal.into_inner() + a * centred(t[3], TILT) + b * centred(t[4], TILT);
    ToolPose {
        tip_m: tip.into(),
        axis: Direction::<Rover>::from(Unit::new_normalize(axis)),
    }
}

/// Whether believed kinematics reach a pose from near `q` with the whole plate in both images.
pub fn is_visible(
    robot: &Robot,
    model: &ErrorModel,
    cameras: &StereoPair,
    pose: &ToolPose,
    q: &[f64],
) -> bool {
    let base_from_rover = model.rover_from_arm_base.inverse();
    let goal = AxisGoal {
        point: (base_from_rover * Point3::from(pose.tip_m.coords)).coords,
        axis: base_from_rover.rotation * pose.axis.unit,
    };
    let Ok(joints) = closest_solution(&model.arm, &model.tool, &goal, q) else {
        return false;
    };
    let Ok(rover_from_link) = model.rover_from_link(&joints) else {
        return false;
    };
    let rover_from_plate = rover_from_link * robot.link_from_plate;
    let layout = &robot.description().fiducial.layout;
    let (w, h) = (layout.half_width_m, layout.half_height_m);
    let corners = [[-w, -h], [w, -h], [-w, h], [w, h]];
    [&cameras.left, &cameras.right].iter().all(|camera| {
        faces(camera, &rover_from_plate)
            && corners.iter().all(|[x, y]| {
                let corner = rover_from_plate * Point3::new(*x, *y, 0.0);
                camera.project_into_image(&corner.coords, MARGIN_PX).is_ok()
            })
    })
}

/// Whether the plate's front is turned to the camera.
fn faces(camera: &Camera, rover_from_plate: &Isometry3<f64>) -> bool {
    let to_camera = camera.model.cahv()[0] - rover_from_plate.translation.vector;
    let front = rover_from_plate.rotation * Vector3::z();
    front.dot(&to_camera) > 0.5 * to_camera.norm()
}
