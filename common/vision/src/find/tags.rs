//! AprilTag families, for people who print tags.
//!
//! The crate `kornia-apriltag` (Apache-2.0, a port of the AprilTag 3 library) finds and reads the
//! tags. It chooses fused arithmetic by the processor, so its corners may differ in their last bits
//! from one machine to the next; they are rounded to 1/16 px and then measured anew here, by
//! straight lines through the border's edges, which also gives them a standard deviation.

use kornia_apriltag::family::TagFamilyKind;
use kornia_apriltag::{AprilTagDecoder, DecodeTagsConfig};
use nalgebra::{Vector2, Vector3};
use rover_cameras::Camera;
use serde::{Deserialize, Serialize};

use super::homography::plane_pose;
use super::{Finding, FoundPose, NoFinding, positive};
use crate::fiducial::{Sighting, solve_pose};
use crate::image::{Image8, ImageF};
use crate::sample::SplineImage;

/// Names of the families that can be found.
pub const TAG_FAMILIES: [&str; 9] = [
    "tag36h11",
    "tagStandard41h12",
    "tag25h9",
    "tag16h5",
    "tag36h10",
    "tagCircle21h7",
    "tagCircle49h12",
    "tagCustom48h12",
    "tagStandard52h13",
];

fn family(name: &str) -> Result<TagFamilyKind, NoFinding> {
    Ok(match name {
        "tag36h11" => TagFamilyKind::Tag36H11,
        "tagStandard41h12" => TagFamilyKind::TagStandard41H12,
        "tag25h9" => TagFamilyKind::Tag25H9,
        "tag16h5" => TagFamilyKind::Tag16H5,
        "tag36h10" => TagFamilyKind::Tag36H10,
        "tagCircle21h7" => TagFamilyKind::TagCircle21H7,
        "tagCircle49h12" => TagFamilyKind::TagCircle49H12,
        "tagCustom48h12" => TagFamilyKind::TagCustom48H12,
        "tagStandard52h13" => TagFamilyKind::TagStandard52H13,
        _ => {
            return Err(NoFinding::BadInput(format!(
                "there is no tag family {name:?}, expected one of {}",
                TAG_FAMILIES.join(", ")
            )));
        }
    })
}

/// Thresholds of the tag search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TagRules {
    /// Bits that may be wrong.
    pub max_wrong_bits: u8,
    /// Least mean distance of the bits' grey values from the threshold, DN.
    pub min_margin_dn: f64,
    /// The image is reduced by this factor for finding the outlines.
    pub reduction: usize,
    /// Largest standard deviation of a corner, px.
    pub max_sigma_px: f64,
    /// Largest reprojection error of a tag's corners under its pose, rms per coordinate, px.
    pub max_rms_px: f64,
    /// Smallest standard deviation that is ever claimed, px.
    pub sigma_floor_px: f64,
}

impl Default for TagRules {
    fn default() -> Self {
        Self {
            max_wrong_bits: 1,
            min_margin_dn: 20.0,
            reduction: 1,
            max_sigma_px: 0.3,
            max_rms_px: 0.5,
            sigma_floor_px: 0.01,
        }
    }
}

/// All tags of a family in the image, by identity. With `size` (camera; side of the border's outer
/// square, m) each has a pose: origin in the middle, x right, y up, z out of the tag.
///
/// # Errors
/// [`NoFinding`]: what refused the first tag seen, `NothingThere` without one, `BadInput`.
pub fn tags(
    image: &Image8,
    family_name: &str,
    size: Option<(&Camera, f64)>,
    rules: &TagRules,
) -> Result<Vec<Finding>, NoFinding> {
    image.validate()?;
    for (name, x) in [
        ("min_margin_dn", rules.min_margin_dn),
        ("reduction", rules.reduction as f64),
        ("max_sigma_px", rules.max_sigma_px),
        ("max_rms_px", rules.max_rms_px),
        ("sigma_floor_px", rules.sigma_floor_px),
    ] {
        positive("tag rules", name, x)?;
    }
    if let Some((camera, side_m)) = size {
        positive("tag", "size in m", side_m)?;
        if (camera.width_px, camera.height_px) != (image.width_px, image.height_px) {
            return Err(NoFinding::BadInput(format!(
                "the image has {} x {} px, the camera model {} x {} px",
                image.width_px, image.height_px, camera.width_px, camera.height_px
            )));
        }
    }
    let kind = family(family_name)?;
    let bad = |e: &dyn std::fmt::Display| NoFinding::BadInput(format!("tags: {e}"));
    let mut config = DecodeTagsConfig::new(vec![kind]).map_err(|e| bad(&e))?;
    config.downscale_factor = rules.reduction;
    let extent = kornia_image::ImageSize {
        width: image.width_px as usize,
        height: image.height_px as usize,
    };
    let mut decoder = AprilTagDecoder::new(config, extent).map_err(|e| bad(&e))?;
    let picture =
        kornia_image::Image::new(extent, image.pixels.clone()).map_err(|e| bad(&e))?;
    let mut seen = decoder.decode(&picture).map_err(|e| bad(&e))?;
    seen.sort_by(|a, b| a.id.cmp(&b.id).then(a.center.y.total_cmp(&b.center.y)));
    let spline = SplineImage::new(&ImageF::from_image8(image)?);
    let mut found = Vec::new();
    let mut refusal = None;
    for tag in &seen {
        let corners = tag.quad.corners.map(|c| {
            // a sixteenth of a pixel swallows what the processor's arithmetic changes
            let round = |x: f32| (f64::from(x) * 16.0).round() / 16.0;
            Vector2::new(round(c.x), round(c.y))
        });
        let read = Read {
            id: u32::from(tag.id),
            wrong_bits: tag.hamming,
            margin_dn: f64::from(tag.decision_margin),
            light_border: tag.quad.reversed_border,
            corners,
        };
        match measure(&spline, &read, size, rules) {
            Ok(one) => found.push(one),
            Err(e) => {
                refusal.get_or_insert(e);
            }
        }
    }
    if found.is_empty() {
        return Err(refusal.unwrap_or_else(|| {
            NoFinding::NothingThere(format!("no tag of family {family_name}"))
        }));
    }
    Ok(found)
}

/// What the reader says of a tag. Corners: right above, right below, left below, left above.
struct Read {
    id: u32,
    wrong_bits: u8,
    margin_dn: f64,
    light_border: bool,
    corners: [Vector2<f64>; 4],
}

fn measure(
    spline: &SplineImage,
    read: &Read,
    size: Option<(&Camera, f64)>,
    rules: &TagRules,
) -> Result<Finding, NoFinding> {
    if read.wrong_bits > rules.max_wrong_bits {
        return Err(NoFinding::Shape {
            what: "number of wrong bits",
            found: f64::from(read.wrong_bits),
            expected: format!("at most {}", rules.max_wrong_bits),
        });
    }
    if read.margin_dn < rules.min_margin_dn {
        return Err(NoFinding::LowContrast {
            found_dn: read.margin_dn,
            needed_dn: rules.min_margin_dn,
        });
    }
    let (corners, sigma_px) = refine(spline, read)?;
    let sigma_px = sigma_px.max(rules.sigma_floor_px);
    if sigma_px > rules.max_sigma_px {
        return Err(NoFinding::Uncertain {
            sigma_px,
            limit_px: rules.max_sigma_px,
        });
    }
    // the middle is where the diagonals cross, under any perspective
    let middle = crossing(
        (corners[0], corners[2] - corners[0]),
        (corners[1], corners[3] - corners[1]),
    )
    .ok_or(NoFinding::NothingThere("a degenerate outline".into()))?;
    let score = 1.0 / (1.0 + f64::from(read.wrong_bits));
    let mut finding = Finding::at(middle.x, middle.y, score, sigma_px);
    finding.id = Some(read.id);
    if let Some((camera, side_m)) = size {
        finding.pose = Some(pose(camera, side_m, &corners, sigma_px, rules)?);
    }
    Ok(finding)
}

/// Half length of the profiles across an edge, px.
const PROFILE_PX: f64 = 2.5;
const PROFILE_STEP_PX: f64 = 0.25;
/// Ends of an edge that are left out, as a fraction of it.
const END: f64 = 0.1;
/// Rounds of refinement: profiles are laid anew across the improved lines.
const ROUNDS: usize = 2;

/// Corners by lines through the border's edges, and their standard deviation.
fn refine(spline: &SplineImage, read: &Read) -> Result<([Vector2<f64>; 4], f64), NoFinding> {
    let mut corners = read.corners;
    let mut sigma = 0.0;
    for _ in 0..ROUNDS {
        let mut lines = [(Vector2::zeros(), Vector2::zeros()); 4];
        let mut variance = 0.0;
        let middle = (corners[0] + corners[1] + corners[2] + corners[3]) / 4.0;
        for (k, line) in lines.iter_mut().enumerate() {
            let (a, b) = (corners[k], corners[(k + 1) % 4]);
            let (at, direction, v) = edge_line(spline, a, b, middle, read.light_border)?;
            *line = (at, direction);
            variance += v / 4.0;
        }
        for k in 0..4 {
            let before = lines[(k + 3) % 4];
            let corner = crossing(before, lines[k])
                .ok_or(NoFinding::NothingThere("a degenerate outline".into()))?;
            let moved = (corner - read.corners[k]).norm();
            if !(moved <= PROFILE_PX) {
                return Err(NoFinding::Diverged {
                    moved_px: moved,
                    limit_px: PROFILE_PX,
                });
            }
            corners[k] = corner;
        }
        sigma = variance.sqrt();
    }
    Ok((corners, sigma))
}

/// The line through an edge: a point, its direction, and the variance of a corner on it, px^2.
fn edge_line(
    spline: &SplineImage,
    a: Vector2<f64>,
    b: Vector2<f64>,
    middle: Vector2<f64>,
    light_border: bool,
) -> Result<(Vector2<f64>, Vector2<f64>, f64), NoFinding> {
    let length = (b - a).norm();
    let small = |found_px| NoFinding::TooSmall {
        found_px,
        needed_px: 8.0,
    };
    if !(length >= 8.0) {
        return Err(small(length));
    }
    let along = (b - a) / length;
    let mut outward = Vector2::new(along.y, -along.x);
    if outward.dot(&((a + b) * 0.5 - middle)) < 0.0 {
        outward = -outward;
    }
    let sign = if light_border { -1.0 } else { 1.0 };
    let count = (length * (1.0 - 2.0 * END)).floor() as usize + 1;
    let mut seen: Vec<(f64, f64)> = Vec::with_capacity(count);
    for k in 0..count {
        let s = length * END + k as f64;
        let base = a + along * s;
        let (mut weight, mut moment) = (0.0, 0.0);
        let steps = (PROFILE_PX / PROFILE_STEP_PX) as i32;
        for i in -steps..=steps {
            let t = f64::from(i) * PROFILE_STEP_PX;
            let p = base + outward * t;
            let Some(sample) = spline.sample(p.x, p.y) else {
                return Err(NoFinding::OutsideImage { u_px: p.x, v_px: p.y });
            };
            let rise = sign
                * (f64::from(sample.du) * outward.x + f64::from(sample.dv) * outward.y);
            if rise > 0.0 {
                let w = rise * rise;
                weight += w;
                moment += w * t;
            }
        }
        if weight > 0.0 {
            seen.push((s - 0.5 * length, moment / weight));
        }
    }
    // offset + slope s by least squares, the farthest tenth left out
    let mut line = (0.0, 0.0);
    let mut variance = 0.0;
    for round in 0..3 {
        if seen.len() < 6 {
            return Err(small(seen.len() as f64));
        }
        let n = seen.len() as f64;
        let ms = seen.iter().map(|p| p.0).sum::<f64>() / n;
        let mt = seen.iter().map(|p| p.1).sum::<f64>() / n;
        let ss: f64 = seen.iter().map(|p| (p.0 - ms) * (p.0 - ms)).sum();
        let st: f64 = seen.iter().map(|p| (p.0 - ms) * (p.1 - mt)).sum();
        let slope = st / ss.max(1e-9);
        line = (mt - slope * ms, slope);
        let off = |p: &(f64, f64)| (p.1 - line.0 - line.1 * p.0).abs();
        let square: f64 = seen.iter().map(|p| off(p) * off(p)).sum();
        let spread = square / (n - 2.0);
        // at the edge's end; neighbouring profiles share pixels
        variance = 2.0 * spread * (1.0 / n + 0.25 * length * length / ss.max(1e-9));
        if round < 2 {
            let limit = 2.5 * spread.sqrt() + 0.02;
            seen.retain(|p| off(p) <= limit);
        }
    }
    let at = (a + b) * 0.5 + outward * line.0;
    let direction = along + outward * line.1;
    Ok((at, direction / direction.norm(), variance))
}

/// Where two lines (point, direction) cross.
fn crossing(
    a: (Vector2<f64>, Vector2<f64>),
    b: (Vector2<f64>, Vector2<f64>),
) -> Option<Vector2<f64>> {
    let cross = a.1.x * b.1.y - a.1.y * b.1.x;
    let d = b.0 - a.0;
    let t = (d.x * b.1.y - d.y * b.1.x) / cross;
    t.is_finite().then(|| a.0 + a.1 * t)
}

fn pose(
    camera: &Camera,
    side_m: f64,
    corners: &[Vector2<f64>; 4],
    sigma_px: f64,
    rules: &TagRules,
) -> Result<FoundPose, NoFinding> {
    let h = 0.5 * side_m;
    let places = [(h, h), (h, -h), (-h, -h), (-h, h)].map(|(x, y)| Vector2::new(x, y));
    let points: Vec<(Vector2<f64>, Vector2<f64>)> =
        places.into_iter().zip(corners.iter().copied()).collect();
    let start = plane_pose(camera, &points)
        .ok_or_else(|| NoFinding::NothingThere("corners without a pose".into()))?;
    let seen: Vec<Sighting> = points
        .iter()
        .enumerate()
        .map(|(index, (p, q))| Sighting {
            camera: 0,
            index,
            point_in_plate: Vector3::new(p.x, p.y, 0.0),
            pixel_px: *q,
            sigma_px,
        })
        .collect();
    let solved = solve_pose(&[camera], &seen, &start)?;
    let rms_px = solved.rms_px();
    if !(rms_px <= rules.max_rms_px) {
        return Err(NoFinding::Shape {
            what: "reprojection error of the corners in px rms",
            found: rms_px,
            expected: format!("at most {}", rules.max_rms_px),
        });
    }
    let covariance = solved
        .information
        .cholesky()
        .ok_or_else(|| NoFinding::NothingThere("corners without a pose".into()))?
        .inverse();
    Ok(FoundPose {
        camera_frame_from_fiducial: solved.pose,
        covariance,
        rms_px,
    })
}
