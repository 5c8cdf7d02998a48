//! From a stereo frame to what was seen of the end-effector (paper, section 3 *Fiducial Detection*
//! and *Stereo Triangulation*): local search where kinematics and camera model predict the plate,
//! a wider one when that fails.

use crate::estimator::Seen;
use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix6, Vector2, Vector3};
use rover_cameras::{Camera, StereoPair};
use rover_messages::{imaging::ImageData, imaging::StereoFrame, placement::Observation};
use rover_robot::Robot;
use rover_vision::{
    DetectionRules, Image8, PlateObservation, PlateSearch, PointObservation, estimate_plate_pose,
    find_plate,
};

/// How far from the prediction to search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SearchWindow {
    /// One sigma of the plate's predicted position, m.
    pub sigma_m: f64,
}

impl SearchWindow {
    /// Sigmas that the first window spans.
    const SIGMAS: f64 = 3.5;
    /// Growth of the second window, tried when the first holds no fiducial.
    const WIDER: f64 = 2.5;
    /// Smallest window, px: detection needs some room in any case.
    const MIN_PX: f64 = 10.0;
    /// Largest window, px.
    const MAX_PX: f64 = 240.0;

    /// The radii to try in order, px, for a camera with focal length `focal_px` at `range_m`.
    pub fn radii_px(&self, focal_px: f64, range_m: f64) -> [f64; 2] {
        let first = Self::SIGMAS * self.sigma_m * focal_px / range_m + Self::MIN_PX;
        [first, first * Self::WIDER].map(|r| r.clamp(Self::MIN_PX, Self::MAX_PX))
    }
}

/// What one frame showed.
#[derive(Clone, Debug, PartialEq)]
pub struct Sighting {
    /// The measurement for the estimator.
    pub seen: Seen,
    /// The plate's central mark in the left image, px.
    pub left_px: Vector2<f64>,
    /// The same in the right image, px.
    pub right_px: Vector2<f64>,
    /// Reprojection residual, px, if the pose was observed.
    pub rms_px: Option<f64>,
}

/// Looks for the plate in both images of `frame`.
///
/// `predicted_rover_from_link` is the last link's pose as kinematics and everything seen so far
/// predict it; `kinematic_rover_from_link` is the pose that kinematics alone predict, to which the
/// measured orientation error refers.
///
/// # Errors
/// One line that says which image failed and why, with numbers.
pub fn look(
    robot: &Robot,
    frame: &StereoFrame,
    observation: Observation,
    predicted_rover_from_link: &Isometry3<f64>,
    kinematic_rover_from_link: &Isometry3<f64>,
    window: SearchWindow,
) -> Result<Sighting, String> {
    let layout = &robot.description().fiducial.layout;
    let predicted = predicted_rover_from_link * robot.link_from_plate;
    let find = |side: &str, camera: &Camera, data: &ImageData| {
        let image = image(data).map_err(|e| format!("{side} image: {e}"))?;
        find_in(camera, &image, robot, &predicted, window).map_err(|e| format!("{side} image: {e}"))
    };
    let left = find("left", &frame.cameras.left, &frame.images.left)?;
    let right = find("right", &frame.cameras.right, &frame.images.right)?;
    let mark = layout.discs.len();
    let pixel = |observation: &PlateObservation, camera: &Camera| {
        let seen = observation
            .points
            .iter()
            .find(|p| p.index == mark)
            .map(|p| p.pixel_px);
        // A plate without a usable central mark is shown where its centre is predicted.
        seen.or_else(|| camera.project(&predicted.translation.vector).ok())
            .ok_or_else(|| "the plate's centre does not project into the image".to_owned())
    };
    let left_px = pixel(&left, &frame.cameras.left)?;
    let right_px = pixel(&right, &frame.cameras.right)?;
    let (seen, rms_px) = match observation {
        Observation::Pose => {
            let pose = estimate_plate_pose(&frame.cameras, layout, &left, &right, &predicted)
                .map_err(|e| format!("pose: {e}"))?;
            let seen = seen_pose(
                robot,
                kinematic_rover_from_link,
                &pose.rover_from_plate,
                &pose.covariance,
            );
            (seen, Some(pose.rms_px))
        }
        Observation::Position => {
            let of_mark = |observation: &PlateObservation, side: &str| {
                observation
                    .points
                    .iter()
                    .find(|p| p.index == mark)
                    .copied()
                    .ok_or_else(|| format!("{side} image: the central mark was not measured"))
            };
            (
                seen_position(
                    robot,
                    &frame.cameras,
                    &of_mark(&left, "left")?,
                    &of_mark(&right, "right")?,
                )?,
                None,
            )
        }
    };
    Ok(Sighting {
        seen,
        left_px,
        right_px,
        rms_px,
    })
}

fn image(data: &ImageData) -> Result<Image8, String> {
    Image8::from_raw(data.width_px, data.height_px, data.pixels.clone()).map_err(|e| e.to_string())
}

fn find_in(
    camera: &Camera,
    image: &Image8,
    robot: &Robot,
    predicted_rover_from_plate: &Isometry3<f64>,
    window: SearchWindow,
) -> Result<PlateObservation, String> {
    let centre = predicted_rover_from_plate.translation.vector;
    let projection = camera
        .project_with_jacobian(&centre)
        .map_err(|e| e.to_string())?;
    let focal_px = projection.jacobian.norm() / std::f64::consts::SQRT_2 * projection.range_m;
    let rules = DetectionRules::default();
    let mut why = String::new();
    for radius in window.radii_px(focal_px, projection.range_m) {
        let search = PlateSearch {
            camera,
            layout: &robot.description().fiducial.layout,
            predicted_camera_frame_from_plate: *predicted_rover_from_plate,
            search_radius_px: radius,
            rules: &rules,
        };
        match find_plate(image, &search) {
            Ok(found) => return Ok(found),
            Err(reason) => {
                why = format!("{reason} (searched {radius:.0} px around the prediction)")
            }
        }
    }
    Err(why)
}

/// The tip's position and the link's orientation error from the plate's seen pose, with the
/// plate's covariance (translation, rotation) carried over the lever to the tip.
fn seen_pose(
    robot: &Robot,
    kinematic_rover_from_link: &Isometry3<f64>,
    rover_from_plate: &Isometry3<f64>,
    plate_covariance: &Matrix6<f64>,
) -> Seen {
    let rover_from_link = rover_from_plate * robot.link_from_plate.inverse();
    let tip = rover_from_link
        .transform_point(&robot.tool.tip_in_link.into())
        .coords;
    let lever = tip - rover_from_plate.translation.vector;
    let mut to_tip = Matrix6::identity();
    to_tip
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-lever.cross_matrix());
    Seen::Pose {
        tip_in_rover: tip,
        rotation_error: (rover_from_link.rotation * kinematic_rover_from_link.rotation.inverse())
            .scaled_axis(),
        covariance: to_tip * plate_covariance * to_tip.transpose(),
    }
}

fn seen_position(
    robot: &Robot,
    cameras: &StereoPair,
    left: &PointObservation,
    right: &PointObservation,
) -> Result<Seen, String> {
    let of = |p: &PointObservation| Matrix2::identity() * p.sigma_px.powi(2);
    let (triangulation, covariance): (_, Matrix3<f64>) = cameras
        .triangulate_with_covariance(&left.pixel_px, &right.pixel_px, &of(left), &of(right))
        .map_err(|e| format!("triangulation: {e}"))?;
    let point_in_plate: Vector3<f64> = left.point_in_plate;
    Ok(Seen::Position {
        point_in_link: robot
            .link_from_plate
            .transform_point(&point_in_plate.into())
            .coords,
        seen_in_rover: triangulation.point,
        covariance,
    })
}
