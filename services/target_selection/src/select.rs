//! The surface under a pixel, and whether the arm can touch it.

use crate::SERVICE;
use nalgebra::Vector2;
use rover_geometry::{Direction, Point, Rover};
use rover_kinematics::{AxisGoal, IkError, closest_solution, solve_axis};
use rover_messages::{
    Fault,
    imaging::StereoFrame,
    target::{SelectRequest, Target},
};
use rover_robot::{CameraMount, CameraPairDescription, Robot};
use rover_service::{frames::prepared, reach_refusal};
use rover_vision::{
    MatchRules, PlaneRules, Surface, SurfaceFailure, SurfaceRules, measure_distant_surface,
    measure_surface,
};

/// Distance from the surface along its normal from which the arm must be able to approach, m.
pub const STANDOFF_M: f64 = 0.05;
/// Travel beyond the believed surface that the arm must be capable of, m.
pub const TRAVEL_BEYOND_M: f64 = 0.01;

fn fault(name: &str, message: impl Into<String>) -> Fault {
    Fault::new(SERVICE, name, message)
}

/// Whether the pixel lies in the left image of `pair`.
///
/// # Errors
/// Fault `pixel_outside_image`.
pub fn check_pixel(pixel_px: [f64; 2], pair: &CameraPairDescription) -> Result<(), Fault> {
    let camera = &pair.cameras.left;
    if camera.contains(&Vector2::from(pixel_px), 0.0) {
        return Ok(());
    }
    let (width, height) = (camera.width_px, camera.height_px);
    Err(fault(
        "pixel_outside_image",
        format!(
            "the pixel ({}, {}) is outside the left image of the pair `{}`, expected -0.5 to {} \
             and -0.5 to {} px",
            pixel_px[0],
            pixel_px[1],
            pair.name,
            f64::from(width) - 0.5,
            f64::from(height) - 0.5
        ),
    )
    .with("u_px", pixel_px[0])
    .with("v_px", pixel_px[1])
    .with("width_px", width.into())
    .with("height_px", height.into()))
}

/// Whether the pair looks at what the rover still has to drive to: it is on the mast. Whether such
/// a surface suits the instrument, and whether the arm reaches it, shows only from near.
#[must_use]
pub fn is_distant(pair: &CameraPairDescription) -> bool {
    pair.mount == CameraMount::Mast
}

/// The target at the request's pixel of `frame`, rover frame.
///
/// # Errors
/// A fault that says why nothing can be placed there: `pixel_outside_image`, `no_texture`,
/// `not_unique`, `occluded`, `no_surface_in_range`, `too_close_to_border`, `too_few_points`,
/// `too_rough`, `normal_uncertain`, `normal_facing_away`, `bad_frame`.
pub fn target_at(
    request: &SelectRequest,
    frame: &StereoFrame,
    pair: &CameraPairDescription,
) -> Result<Target, Fault> {
    check_pixel(request.pixel_px, pair)?;
    let (left, right) = prepared(SERVICE, frame)?;
    let pixel = Vector2::from(request.pixel_px);
    let surface = if is_distant(pair) {
        let range_m = [pair.range_min_m, pair.range_max_m];
        let images = (&left, &right);
        let rules = PlaneRules::default();
        measure_distant_surface(images, &frame.cameras, &pixel, range_m, &rules)
    } else {
        let rules = SurfaceRules {
            matching: MatchRules {
                range_min_m: pair.range_min_m,
                range_max_m: pair.range_max_m,
                ..Default::default()
            },
            ..Default::default()
        };
        measure_surface(&left, &right, &frame.cameras, &pixel, &rules)
    }
    .map_err(|failure| refused(&failure, request))?;
    target(request, frame, &surface)
}

fn target(
    request: &SelectRequest,
    frame: &StereoFrame,
    surface: &Surface,
) -> Result<Target, Fault> {
    let right = frame
        .cameras
        .right
        .project(&surface.position)
        .map_err(|e| fault("bad_frame", format!("the target has no right pixel: {e}")))?;
    let c = surface.covariance;
    Ok(Target {
        pair: request.pair.clone(),
        pixel_px: request.pixel_px,
        right_pixel_px: [right.x, right.y],
        position_m: surface.position.into(),
        normal: surface.normal.into(),
        covariance_m2: [0, 1, 2].map(|i| [0, 1, 2].map(|j| c[(i, j)])),
        plane_rms_mm: surface.plane_rms_m * 1e3,
        roughness_mm: surface.roughness_m * 1e3,
        points_n: surface.points_used as u32,
        sim_time_s: frame.images.sim_time_s,
    })
}

/// The fault for a surface that cannot be placed on.
fn refused(failure: &SurfaceFailure, request: &SelectRequest) -> Fault {
    use SurfaceFailure as F;
    let [u, v] = request.pixel_px;
    let named = |name| {
        fault(
            name,
            format!("pixel ({u}, {v}) of the pair `{}`: {failure}", request.pair),
        )
        .with("u_px", u)
        .with("v_px", v)
    };
    match failure {
        F::NoTexture {
            found_dn,
            needed_dn,
        } => named("no_texture")
            .with("found_dn", *found_dn)
            .with("needed_dn", *needed_dn),
        F::NotUnique { best, second } => named("not_unique")
            .with("best_score", *best)
            .with("second_score", *second),
        F::Occluded(_) => named("occluded"),
        F::NothingInRange { min_m, max_m, .. } => named("no_surface_in_range")
            .with("range_min_m", *min_m)
            .with("range_max_m", *max_m),
        F::OutsideImage(_) => named("too_close_to_border"),
        F::TooFewPoints { found, needed } => named("too_few_points")
            .with("found_n", *found as f64)
            .with("needed_n", *needed as f64),
        F::TooRough {
            rms_mm,
            rms_limit_mm,
            roughness_mm,
            roughness_limit_mm,
        } => named("too_rough")
            .with("plane_rms_mm", *rms_mm)
            .with("plane_rms_limit_mm", *rms_limit_mm)
            .with("roughness_mm", *roughness_mm)
            .with("roughness_limit_mm", *roughness_limit_mm),
        F::NormalUncertain {
            sigma_deg,
            limit_deg,
        } => named("normal_uncertain")
            .with("sigma_deg", *sigma_deg)
            .with("limit_deg", *limit_deg),
        F::NormalFacingAway { cosine, limit } => named("normal_facing_away")
            .with("cosine", *cosine)
            .with("limit", *limit),
        F::BadInput(_) => named("bad_frame"),
    }
}

/// Whether the arm reaches the target along its normal: from the standoff to a little beyond the
/// surface, within its joint limits.
///
/// # Errors
/// Fault `out_of_reach` that says at which distance which constraint is broken, and by how much.
pub fn check_reach(robot: &Robot, target: &Target) -> Result<(), Fault> {
    for distance_m in [STANDOFF_M, 0.0, -TRAVEL_BEYOND_M] {
        let what = match distance_m {
            d if d > 0.0 => format!("the standoff {:.0} mm before the target", d * 1e3),
            d if d < 0.0 => format!("{:.0} mm beyond the target", -d * 1e3),
            _ => "the target".into(),
        };
        let tip = target.position_m.offset(&target.normal, distance_m);
        reached(robot, tip, -target.normal).map_err(|error| {
            let [x, y, z] = target.position_m.coords.into();
            let mut fault = reach_refusal(robot, SERVICE, &what, &error)
                .with("distance_m", distance_m)
                .with("target_x_m", x)
                .with("target_y_m", y)
                .with("target_z_m", z);
            fault.name = "out_of_reach".into();
            fault
        })?;
    }
    Ok(())
}

fn reached(robot: &Robot, tip: Point<Rover>, axis: Direction<Rover>) -> Result<(), IkError> {
    let base_from_rover = robot.rover_from_arm_base.inverse();
    let goal = AxisGoal {
        point: (base_from_rover * tip).coords,
        axis: (base_from_rover * axis).unit,
    };
    match solve_axis(&robot.arm, &robot.tool, &goal) {
        Ok(solutions) if solutions.iter().any(|s| s.within_limits) => return Ok(()),
        // Reached by no branch within its limits: the solver names the least violation.
        Ok(_) | Err(IkError::NotThisFamily(_)) => {}
        Err(error) => return Err(error),
    }
    let middle: Vec<f64> = robot
        .arm
        .limits()
        .iter()
        .map(|l| 0.5 * (l.lower_rad + l.upper_rad))
        .collect();
    closest_solution(&robot.arm, &robot.tool, &goal, &middle).map(|_| ())
}
