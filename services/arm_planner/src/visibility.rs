//! Whether a camera pair sees the fiducial plate in a configuration of the arm.

use crate::collision::{CollisionModel, Placed};
use crate::segment::Segment;
use crate::terrain_map::TerrainMap;
use nalgebra::{Point3, Vector3};
use rover_cameras::Camera;
use rover_robot::CameraPairDescription;

/// Largest angle between the plate's normal and the direction to a camera, deg: beyond it the
/// marks are too foreshortened to be measured.
pub const MAX_FACING_DEG: f64 = 65.0;
/// Distance of the plate's corners from the border of the image, px.
pub const BORDER_PX: f64 = 8.0;
/// Distance of the arm's links from the lines of sight, m.
pub const SIGHT_MARGIN_M: f64 = 0.01;

/// Terrain blocks a line of sight only where it reaches it, m: the instrument works close to it.
const TOUCH_M: f64 = 1e-6;

/// How well the plate is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Larger of the angles between the plate's normal and the directions to the two cameras, rad.
    pub facing_rad: f64,
}

/// Why the plate is not seen.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Hidden {
    /// It is turned away.
    #[error(
        "the plate's normal is {:.1} deg from the direction to the {camera} camera, expected at \
         most {MAX_FACING_DEG} deg", .found_rad.to_degrees()
    )]
    TurnedAway {
        /// `left` or `right`.
        camera: &'static str,
        /// The angle, rad.
        found_rad: f64,
    },
    /// A part of it has no pixel, or one outside the image.
    #[error(
        "{part} of the plate is at {found} in the {camera} image of {width_px} x {height_px} px"
    )]
    OutsideImage {
        /// `left` or `right`.
        camera: &'static str,
        /// The centre or a corner.
        part: &'static str,
        /// The pixel, or why there is none.
        found: String,
        /// Image width, px.
        width_px: u32,
        /// Image height, px.
        height_px: u32,
    },
    /// Something is in the way.
    #[error(
        "{obstacle} is {:.1} mm from the line of sight between the {camera} camera and {part} of \
         the plate, expected at least {:.1} mm", distance_m * 1e3, SIGHT_MARGIN_M * 1e3
    )]
    Blocked {
        /// `left` or `right`.
        camera: &'static str,
        /// The centre or a corner.
        part: &'static str,
        /// What is in the way.
        obstacle: String,
        /// Its distance from the line, m, negative inside.
        distance_m: f64,
    },
}

/// How `pair` sees the plate of the arm as `placed`.
pub(crate) fn view(
    model: &CollisionModel,
    placed: &Placed,
    terrain: Option<&TerrainMap>,
    pair: &CameraPairDescription,
) -> Result<View, Hidden> {
    let robot = model.robot();
    let rover_from_link = placed.rover_from_links[placed.rover_from_links.len() - 1];
    let rover_from_plate = rover_from_link * robot.link_from_plate;
    let normal = rover_from_plate.rotation * Vector3::z();
    let layout = &robot.description().fiducial.layout;
    let (w, h) = (layout.half_width_m, layout.half_height_m);
    let parts = [
        ("the centre", 0.0, 0.0),
        ("the upper left corner", -w, h),
        ("the upper right corner", w, h),
        ("the lower left corner", -w, -h),
        ("the lower right corner", w, -h),
    ]
    .map(|(part, x, y)| (part, (rover_from_plate * Point3::new(x, y, 0.0)).coords));
    let cameras: [(&'static str, &Camera); 2] =
        [("left", &pair.cameras.left), ("right", &pair.cameras.right)];
    let mut facing_rad: f64 = 0.0;
    for (camera, model) in cameras {
        let found_rad = normal.angle(&(centre(model) - parts[0].1));
        if found_rad > MAX_FACING_DEG.to_radians() {
            return Err(Hidden::TurnedAway { camera, found_rad });
        }
        facing_rad = facing_rad.max(found_rad);
    }
    for (name, camera) in cameras {
        for (part, point) in &parts {
            let found = match camera.project(point) {
                Ok(pixel) if camera.contains(&pixel, BORDER_PX) => continue,
                Ok(pixel) => format!("({:.1}, {:.1}) px", pixel.x, pixel.y),
                Err(error) => error.to_string(),
            };
            let (width_px, height_px) = (camera.width_px, camera.height_px);
            return Err(Hidden::OutsideImage {
                camera: name,
                part,
                found,
                width_px,
                height_px,
            });
        }
    }
    for (name, camera) in cameras {
        for (part, point) in &parts {
            let sight = Segment {
                from: centre(camera),
                to: *point,
            };
            let blocked = |obstacle: &str, distance_m| Hidden::Blocked {
                camera: name,
                part,
                obstacle: obstacle.into(),
                distance_m,
            };
            if let Some((link, distance_m)) = model.obstruction(placed, &sight, SIGHT_MARGIN_M) {
                return Err(blocked(link, distance_m));
            }
            if let Some(closest) = terrain.and_then(|map| map.closest(&sight, TOUCH_M)) {
                return Err(blocked("the terrain", closest.distance_m));
            }
        }
    }
    Ok(View { facing_rad })
}

fn centre(camera: &Camera) -> Vector3<f64> {
    *camera.model.cahv()[0]
}
