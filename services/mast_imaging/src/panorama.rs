//! Where the mast looks for a panorama, and the mosaic of what it saw.
//!
//! The mosaic is one of azimuth and elevation about the middle of the cameras' places. The pictures
//! are taken from places some centimetres apart, so a mosaic needs a surface to lay them on: the
//! plane on which the rover stands, and what lies above its horizon far away. What stands out of
//! the plane shows that at the seams.

use crate::SERVICE;
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use rover_cameras::Camera;
use rover_messages::{
    Fault,
    imaging::ImageData,
    panorama::{MAX_MOSAIC_PX, PanoramaRequest},
};
use rover_robot::MastDescription;

/// Most pictures of a panorama.
const MAX_STOPS: u32 = 64;
/// What lies above the horizon is taken to be so far away, m.
const FAR_M: f64 = 1000.0;

/// Horizontal and vertical angle that a camera sees through its middle, rad.
fn field_of_view_rad(camera: &Camera) -> Result<[f64; 2], Fault> {
    let [last_u, last_v] = [camera.width_px, camera.height_px].map(|n| f64::from(n) - 1.0);
    let ray = |u: f64, v: f64| {
        camera
            .ray(&Vector2::new(u, v))
            .map(|ray| ray.direction.into_inner())
            .map_err(|e| Fault::new(SERVICE, "unusable_camera", e.to_string()))
    };
    let [mid_u, mid_v] = [last_u / 2.0, last_v / 2.0];
    Ok([
        ray(0.0, mid_v)?.angle(&ray(last_u, mid_v)?),
        ray(mid_u, 0.0)?.angle(&ray(mid_u, last_v)?),
    ])
}

/// Pan and tilt (rad) of each picture of a panorama: row by row, there and back, so that the mast
/// goes short ways. `camera` is one of the pair's.
///
/// # Errors
/// Fault `outside_mast_range` for angles that the mast cannot take, `panorama_too_large` for more
/// than 64 pictures, `unusable_camera` for one without a field of view.
pub fn stops(
    request: &PanoramaRequest,
    camera: &Camera,
    mast: &MastDescription,
) -> Result<Vec<[f64; 2]>, Fault> {
    let asked = [
        ("pan_rad", request.pan_rad, mast.pan_rad),
        ("tilt_rad", request.tilt_rad, mast.tilt_rad),
    ];
    for (name, [first, last], [lower, upper]) in asked {
        if first < lower || last > upper {
            let message = format!(
                "{name}: [{first}, {last}], expected within the mast's {lower} to {upper} rad"
            );
            return Err(Fault::new(SERVICE, "outside_mast_range", message));
        }
    }
    let fields = field_of_view_rad(camera)?;
    let spread = |[first, last]: [f64; 2], field: f64| -> Vec<f64> {
        let steps = ((last - first) / (field * (1.0 - request.overlap)) - 1e-9).ceil();
        let n = (steps.max(0.0) as u32).min(MAX_STOPS);
        let part = |k: u32| f64::from(k) / f64::from(n.max(1));
        (0..=n).map(|k| first + (last - first) * part(k)).collect()
    };
    let pans = spread(request.pan_rad, fields[0]);
    let tilts = spread(request.tilt_rad, fields[1]);
    let n = pans.len() * tilts.len();
    if n > MAX_STOPS as usize {
        let message = format!(
            "{} x {} pictures, expected at most {MAX_STOPS}: a smaller range or less overlap",
            pans.len(),
            tilts.len()
        );
        return Err(Fault::new(SERVICE, "panorama_too_large", message));
    }
    let mut all = Vec::with_capacity(n);
    for (row, tilt) in tilts.iter().enumerate() {
        let along = pans.iter().map(|pan| [*pan, *tilt]);
        if row % 2 == 0 {
            all.extend(along);
        } else {
            all.extend(along.rev());
        }
    }
    Ok(all)
}

/// A mosaic and the directions of its pixels; see [`rover_messages::panorama::Panorama`].
#[derive(Clone, Debug, PartialEq)]
pub struct Mosaic {
    /// Its pixels.
    pub image: ImageData,
    /// Azimuth of the first and last column, rad.
    pub azimuth_rad: [f64; 2],
    /// Elevation of the first and last row, rad.
    pub elevation_rad: [f64; 2],
    /// Angle of a pixel, rad.
    pub pixel_rad: f64,
    /// Where it is seen from, rover frame, m.
    pub eye_m: Vector3<f64>,
}

/// Lays pictures with their camera models (rover frame) together. A pixel is taken from the picture
/// that shows it nearest to its axis.
///
/// # Errors
/// Fault `panorama_too_large` for a mosaic of more than [`MAX_MOSAIC_PX`], `unusable_camera` as
/// [`stops`], `no_pictures` for none.
pub fn mosaic(views: &[(Camera, ImageData)], pixel_rad: Option<f64>) -> Result<Mosaic, Fault> {
    let Some((first, _)) = views.first() else {
        return Err(Fault::new(
            SERVICE,
            "no_pictures",
            "a mosaic of no pictures",
        ));
    };
    let pixel_rad = pixel_rad.unwrap_or_else(|| 1.0 / first.model.cahv()[2].norm());
    let half = field_of_view_rad(first)?.map(|field| field / 2.0);
    let centres = views.iter().map(|(camera, _)| camera.model.cahv()[0]);
    let eye_m = centres.sum::<Vector3<f64>>() / views.len() as f64;
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for (camera, _) in views {
        let axis = camera.model.cahv()[1];
        let looks = [axis.y.atan2(axis.x), axis.z.atan2(axis.x.hypot(axis.y))];
        for k in 0..2 {
            low[k] = low[k].min(looks[k] - half[k]);
            high[k] = high[k].max(looks[k] + half[k]);
        }
    }
    let size = [0, 1].map(|k| ((high[k] - low[k]) / pixel_rad).ceil() as u64 + 1);
    if size[0].saturating_mul(size[1]) > MAX_MOSAIC_PX {
        let message = format!(
            "{} x {} px, expected at most {MAX_MOSAIC_PX} px: a larger pixel_rad or a smaller range",
            size[0], size[1]
        );
        return Err(Fault::new(SERVICE, "panorama_too_large", message));
    }
    let [columns, rows] = size;
    let pixels = (0..rows)
        .into_par_iter()
        .flat_map_iter(|v| {
            let elevation = high[1] - v as f64 * pixel_rad;
            (0..columns).map(move |u| {
                let azimuth = high[0] - u as f64 * pixel_rad;
                shown(views, &place(&eye_m, azimuth, elevation))
            })
        })
        .collect();
    let end = |k: usize| high[k] - (size[k] - 1) as f64 * pixel_rad;
    Ok(Mosaic {
        image: ImageData {
            width_px: columns as u32,
            height_px: rows as u32,
            pixels,
        },
        azimuth_rad: [high[0], end(0)],
        elevation_rad: [high[1], end(1)],
        pixel_rad,
        eye_m,
    })
}

/// The place that a direction shows: on the plane z = 0, or far away.
fn place(eye_m: &Vector3<f64>, azimuth: f64, elevation: f64) -> Vector3<f64> {
    let level = elevation.cos();
    let along = Vector3::new(
        level * azimuth.cos(),
        level * azimuth.sin(),
        elevation.sin(),
    );
    let range = if along.z < 0.0 {
        (eye_m.z.max(0.0) / -along.z).min(FAR_M)
    } else {
        FAR_M
    };
    eye_m + along * range
}

/// Grey value of a place in the picture that shows it nearest to its axis; 0 if none does.
fn shown(views: &[(Camera, ImageData)], place: &Vector3<f64>) -> u8 {
    let mut best: Option<(f64, f64)> = None;
    for (camera, image) in views {
        let [centre, axis, ..] = camera.model.cahv();
        let nearness = (place - centre).normalize().dot(axis);
        if nearness <= best.map_or(0.0, |(most, _)| most) {
            continue;
        }
        let Ok(pixel) = camera.project(place) else {
            continue;
        };
        if camera.contains(&pixel, 0.0)
            && let Some(grey) = grey(image, &pixel)
        {
            best = Some((nearness, grey));
        }
    }
    best.map_or(0, |(_, grey)| grey.round().clamp(0.0, 255.0) as u8)
}

/// Bilinear grey value.
fn grey(image: &ImageData, pixel: &Vector2<f64>) -> Option<f64> {
    let [u0, v0] = [pixel.x.floor().max(0.0), pixel.y.floor().max(0.0)];
    let at = |u: u64, v: u64| {
        let u = u.min(u64::from(image.width_px).saturating_sub(1));
        let v = v.min(u64::from(image.height_px).saturating_sub(1));
        let index = v * u64::from(image.width_px) + u;
        image.pixels.get(index as usize).map(|g| f64::from(*g))
    };
    let (fu, fv) = (
        (pixel.x - u0).clamp(0.0, 1.0),
        (pixel.y - v0).clamp(0.0, 1.0),
    );
    let (u, v) = (u0 as u64, v0 as u64);
    let top = at(u, v)? * (1.0 - fu) + at(u + 1, v)? * fu;
    let bottom = at(u, v + 1)? * (1.0 - fu) + at(u + 1, v + 1)? * fu;
    Some(top * (1.0 - fv) + bottom * fv)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use rover_robot::{CameraPairDescription, Robot};

    const ROCKY: &str = include_str!("../../../scenarios/robots/rocky8.toml");

    fn with_mast() -> (Robot, CameraPairDescription) {
        let robot = Robot::parse(ROCKY, "rocky8").unwrap();
        let pair = robot.pair("mast").unwrap().clone();
        (robot, pair)
    }

    /// The ground as it really is: rings about the rover and spokes.
    fn ground(x: f64, y: f64) -> f64 {
        120.0 + 60.0 * (6.0 * x.hypot(y)).sin() + 40.0 * (9.0 * y.atan2(x)).cos()
    }

    fn picture(camera: &Camera) -> ImageData {
        let pixels = (0..camera.height_px)
            .flat_map(|v| (0..camera.width_px).map(move |u| (u, v)))
            .map(|(u, v)| {
                let ray = camera
                    .ray(&Vector2::new(f64::from(u), f64::from(v)))
                    .unwrap();
                if ray.direction.z > -0.02 {
                    return 30;
                }
                let p = ray.at(-ray.origin.z / ray.direction.z);
                ground(p.x, p.y).round() as u8
            })
            .collect();
        ImageData {
            width_px: camera.width_px,
            height_px: camera.height_px,
            pixels,
        }
    }

    #[test]
    fn neighbours_overlap_and_the_whole_range_is_looked_at() {
        let (robot, pair) = with_mast();
        let request = PanoramaRequest::default();
        let all = stops(&request, &pair.cameras.left, robot.mast().unwrap()).unwrap();
        let field = field_of_view_rad(&pair.cameras.left).unwrap();
        let mut pans: Vec<f64> = all.iter().map(|s| s[0]).collect();
        pans.sort_by(f64::total_cmp);
        pans.dedup();
        assert_eq!((pans[0], pans[pans.len() - 1]), (-1.2, 1.2));
        assert!(
            pans.windows(2)
                .all(|w| w[1] - w[0] <= field[0] * 0.8 + 1e-9)
        );
        // there and back: no long way between two pictures
        assert!(all.windows(2).all(|w| (w[1][0] - w[0][0]).abs() < field[0]));
        let one = PanoramaRequest {
            pan_rad: [0.3, 0.3],
            tilt_rad: [0.2, 0.2],
            ..request
        };
        let one = stops(&one, &pair.cameras.left, robot.mast().unwrap()).unwrap();
        assert_eq!(one, [[0.3, 0.2]]);
    }

    #[test]
    fn a_range_that_the_mast_has_not_is_refused() {
        let (robot, pair) = with_mast();
        let mast = robot.mast().unwrap();
        let request = PanoramaRequest {
            pan_rad: [-20.0, 0.0],
            ..PanoramaRequest::default()
        };
        let refused = stops(&request, &pair.cameras.left, mast).unwrap_err();
        assert_eq!(refused.name, "outside_mast_range");
        let request = PanoramaRequest {
            pan_rad: mast.pan_rad,
            tilt_rad: mast.tilt_rad,
            overlap: 0.8,
            pixel_rad: None,
        };
        let refused = stops(&request, &pair.cameras.left, mast).unwrap_err();
        assert_eq!(refused.name, "panorama_too_large");
        assert_eq!(mosaic(&[], None).unwrap_err().name, "no_pictures");
    }

    #[test]
    fn every_pixel_of_the_mosaic_shows_what_lies_in_its_direction() {
        let (robot, pair) = with_mast();
        let request = PanoramaRequest {
            pan_rad: [-0.5, 0.5],
            tilt_rad: [0.3, 0.5],
            ..PanoramaRequest::default()
        };
        let all = stops(&request, &pair.cameras.left, robot.mast().unwrap()).unwrap();
        let views: Vec<(Camera, ImageData)> = all
            .iter()
            .map(|angles| robot.cameras_at(&pair, Some(*angles)).unwrap().left)
            .map(|camera| (camera.clone(), picture(&camera)))
            .collect();
        let seen = mosaic(&views, Some(0.004)).unwrap();
        let columns = seen.image.width_px as usize;
        let (mut compared, mut worst, mut dark) = (0, 0.0_f64, 0);
        for (i, grey) in seen.image.pixels.iter().enumerate() {
            let azimuth = seen.azimuth_rad[0] - (i % columns) as f64 * seen.pixel_rad;
            let elevation = seen.elevation_rad[0] - (i / columns) as f64 * seen.pixel_rad;
            if elevation > -0.1 {
                continue;
            }
            let p = place(&seen.eye_m, azimuth, elevation);
            if *grey == 0 {
                dark += 1;
                continue;
            }
            compared += 1;
            worst = worst.max((f64::from(*grey) - ground(p.x, p.y)).abs());
        }
        assert!(
            compared > 10_000 && dark < compared / 10,
            "{compared} {dark}"
        );
        assert!(worst < 12.0, "{worst} DN");
    }
}
