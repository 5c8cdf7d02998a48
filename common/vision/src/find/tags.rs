//! AprilTag families, for people who print tags.
//!
//! A tag's border is a dark square on light ground (or light on dark): a connected region whose hull
//! is a quadrilateral. Straight lines through the four edges give corners with a standard deviation;
//! the bits are read through the corners' homography against planes of dark and light fitted to both
//! sides of the border, and the word is looked up in the family.

use nalgebra::{Matrix3, Vector2, Vector3};
use rover_cameras::Camera;
use serde::{Deserialize, Serialize};

use super::blobs::{BlobRules, outlines};
use super::edges::{crossing, degenerate, refine};
use super::homography::{plane_pose, square_homography};
use super::tag_code::{Family, TAG_FAMILIES, family};
use super::{Finding, FoundPose, NoFinding, distinct, positive};
use crate::fiducial::{Sighting, solve_pose};
use crate::image::{Image8, ImageF};
use crate::ncc::Window;
use crate::sample::SplineImage;

/// Thresholds of the tag search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TagRules {
    /// Bits that may be wrong.
    pub max_wrong_bits: u32,
    /// Least difference between dark and light of the border, DN.
    pub min_contrast_dn: f64,
    /// Least mean distance of the light bits, and of the dark bits, from the threshold, as a
    /// fraction of the contrast (0.5 for a perfect tag).
    pub min_margin: f64,
    /// Shortest side of a tag's border, px.
    pub min_side_px: f64,
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
            min_contrast_dn: 30.0,
            min_margin: 0.2,
            min_side_px: 16.0,
            max_sigma_px: 0.3,
            max_rms_px: 0.5,
            sigma_floor_px: 0.01,
        }
    }
}

/// All tags of a family in a window, by identity. With `size` (camera; side of the border's outer
/// square, m) each has a pose: origin in the middle, x right, y up, z out of the tag as the family's
/// own pictures stand; its place is then the image of that origin, else where the diagonals cross.
///
/// # Errors
/// [`NoFinding`]: what refused the largest square seen, `NothingThere` without one, `BadInput`.
pub fn tags(
    image: &Image8,
    window: Window,
    family_name: &str,
    size: Option<(&Camera, f64)>,
    rules: &TagRules,
) -> Result<Vec<Finding>, NoFinding> {
    image.validate()?;
    for (name, x) in [
        ("min_contrast_dn", rules.min_contrast_dn),
        ("min_margin", rules.min_margin),
        ("min_side_px", rules.min_side_px),
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
    let family = family(family_name).ok_or_else(|| {
        NoFinding::BadInput(format!(
            "there is no tag family {family_name:?}, expected one of {}",
            TAG_FAMILIES.join(", ")
        ))
    })?;
    let regions = BlobRules {
        dark: !family.light,
        min_contrast_dn: rules.min_contrast_dn.clamp(1.0, 255.0) as u8,
        // the border ring of the smallest tag, and more
        area: (rules.min_side_px * 4.0, f64::INFINITY),
    };
    let spline = SplineImage::new(&ImageF::from_image8(image)?);
    let mut found = Vec::new();
    let mut refusal: Option<(f64, NoFinding)> = None;
    for outline in outlines(image, window, &regions) {
        let Some(corners) = quadrilateral(&outline, rules.min_side_px) else {
            continue;
        };
        match measure(&spline, corners, family, size, rules) {
            Ok(one) => found.push(one),
            Err(e) => {
                let side = (corners[2] - corners[0]).norm();
                if refusal.as_ref().is_none_or(|(largest, _)| side > *largest) {
                    refusal = Some((side, e));
                }
            }
        }
    }
    found.sort_by(|a, b| a.id.cmp(&b.id).then(b.score.total_cmp(&a.score)));
    let found = distinct(found, 0.25 * rules.min_side_px);
    if found.is_empty() {
        return Err(refusal.map_or_else(
            || NoFinding::NothingThere("no square outline".into()),
            |(_, e)| e,
        ));
    }
    Ok(found)
}

/// Largest difference between a hull's area and its quadrilateral's, as a fraction; a strip of 0.7 px
/// along the outline is granted on top.
const MAX_HULL_ERROR: f64 = 0.06;
/// Least ratio of the shortest to the longest side.
const MIN_SIDE_RATIO: f64 = 0.25;

/// Twice the signed area of a triangle, positive for clockwise in the image (v down).
fn turn(a: &Vector2<f64>, b: &Vector2<f64>, c: &Vector2<f64>) -> f64 {
    (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
}

/// Convex hull, clockwise in the image, of points sorted by v and then u.
fn hull(points: &[Vector2<f64>]) -> Vec<Vector2<f64>> {
    let mut chain: Vec<Vector2<f64>> = Vec::new();
    let mut side = |points: &mut dyn Iterator<Item = &Vector2<f64>>| {
        let start = chain.len();
        for p in points {
            while chain.len() >= start + 2
                && turn(&chain[chain.len() - 2], &chain[chain.len() - 1], p) <= 0.0
            {
                chain.pop();
            }
            chain.push(*p);
        }
        chain.pop();
    };
    side(&mut points.iter());
    side(&mut points.iter().rev());
    chain
}

/// The largest quadrilateral with corners of the hull, if the hull is one; clockwise in the image.
fn quadrilateral(outline: &[Vector2<f64>], min_side_px: f64) -> Option<[Vector2<f64>; 4]> {
    let hull = hull(outline);
    let n = hull.len();
    if n < 4 {
        return None;
    }
    let far = |from: &Vector2<f64>| {
        let apart = |i: &usize| (hull[*i] - from).norm_squared();
        (0..n).max_by(|a, b| apart(a).total_cmp(&apart(b)))
    };
    let middle = hull.iter().sum::<Vector2<f64>>() / n as f64;
    let first = far(&middle)?;
    let third = far(&hull[first])?;
    let beside = |sign: f64| {
        let off = |i: &usize| sign * turn(&hull[first], &hull[third], &hull[*i]);
        (0..n).max_by(|a, b| off(a).total_cmp(&off(b)))
    };
    let mut chosen = [first, beside(-1.0)?, third, beside(1.0)?];
    // let every corner move to where the area is largest
    for _ in 0..4 {
        for k in 0..4 {
            let (before, after) = (hull[chosen[(k + 3) % 4]], hull[chosen[(k + 1) % 4]]);
            let area = |i: &usize| turn(&before, &hull[*i], &after);
            chosen[k] = (0..n).max_by(|a, b| area(a).total_cmp(&area(b)))?;
        }
    }
    let corners = chosen.map(|i| hull[i]);
    let area_of = |p: &[Vector2<f64>]| -> f64 {
        (1..p.len() - 1)
            .map(|i| 0.5 * turn(&p[0], &p[i], &p[i + 1]))
            .sum()
    };
    let (area, whole) = (area_of(&corners), area_of(&hull));
    let sides = [0, 1, 2, 3].map(|k| (corners[(k + 1) % 4] - corners[k]).norm());
    let shortest = sides.iter().copied().fold(f64::INFINITY, f64::min);
    let longest = sides.iter().copied().fold(0.0, f64::max);
    let around: f64 = sides.iter().sum();
    let fits = shortest >= min_side_px - 2.0
        && shortest >= MIN_SIDE_RATIO * longest
        && whole - area <= MAX_HULL_ERROR * area + 0.7 * around;
    fits.then_some(corners)
}

fn measure(
    spline: &SplineImage,
    start: [Vector2<f64>; 4],
    family: &Family,
    size: Option<(&Camera, f64)>,
    rules: &TagRules,
) -> Result<Finding, NoFinding> {
    let (corners, sigma_px) = refine(spline, &start, family.light)?;
    let sigma_px = sigma_px.max(rules.sigma_floor_px);
    if sigma_px > rules.max_sigma_px {
        return Err(NoFinding::Uncertain {
            sigma_px,
            limit_px: rules.max_sigma_px,
        });
    }
    let read = read(spline, &corners, family, rules)?;
    if read.wrong_bits > rules.max_wrong_bits {
        return Err(NoFinding::Shape {
            what: "number of wrong bits",
            found: f64::from(read.wrong_bits),
            expected: format!("at most {}", rules.max_wrong_bits),
        });
    }
    let corners = [0, 1, 2, 3].map(|k| corners[(k + read.first) % 4]);
    // the middle is where the diagonals cross, under any perspective
    let middle = crossing(
        (corners[0], corners[2] - corners[0]),
        (corners[1], corners[3] - corners[1]),
    )
    .ok_or_else(degenerate)?;
    let score = 1.0 - f64::from(read.wrong_bits) / family.bits.len() as f64;
    // four corners share the noise of the middle
    let mut finding = Finding::at(middle.x, middle.y, score, 0.5 * sigma_px);
    finding.id = Some(read.id);
    if let Some((camera, side_m)) = size {
        let pose = pose(camera, side_m, &corners, sigma_px, rules)?;
        // straight diagonals are not straight through a lens: the middle's own image is
        let origin = pose.camera_frame_from_fiducial.translation.vector;
        let middle = camera.project(&origin).map_err(|_| degenerate())?;
        (finding.u_px, finding.v_px) = (middle.x, middle.y);
        finding.pose = Some(pose);
    }
    Ok(finding)
}

/// What the bits say. `first` is the corner that the word begins at (left above).
struct Read {
    id: u32,
    wrong_bits: u32,
    first: usize,
}

/// A plane a + b x + c y through grey values.
struct Shade(Vector3<f64>);

impl Shade {
    fn fit(samples: &[(f64, f64, f64)]) -> Option<Self> {
        let mut normal = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for &(x, y, grey) in samples {
            let row = Vector3::new(1.0, x, y);
            normal += row * row.transpose();
            right += row * grey;
        }
        Some(Self(normal.cholesky()?.solve(&right)))
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        self.0.x + self.0.y * x + self.0.z * y
    }
}

fn read(
    spline: &SplineImage,
    corners: &[Vector2<f64>; 4],
    family: &Family,
    rules: &TagRules,
) -> Result<Read, NoFinding> {
    // from the square 0..cells in x and y (down) to the image
    let map = square_homography(corners, family.cells as f64).ok_or_else(degenerate)?;
    let grey = |x: f64, y: f64| {
        let p = map * Vector3::new(x, y, 1.0);
        let (u, v) = (p.x / p.z, p.y / p.z);
        spline
            .sample(u, v)
            .map(|s| f64::from(s.value))
            .ok_or(NoFinding::OutsideImage { u_px: u, v_px: v })
    };
    let (mut outer, mut inner) = (Vec::new(), Vec::new());
    let n = family.cells as f64;
    for k in 0..family.cells {
        let s = k as f64 + 0.5;
        for (side, list) in [(-0.5, &mut outer), (0.5, &mut inner)] {
            for (x, y) in [(s, side), (s, n - side), (side, s), (n - side, s)] {
                list.push((x, y, grey(x, y)?));
            }
        }
    }
    let outer = Shade::fit(&outer).ok_or_else(degenerate)?;
    let inner = Shade::fit(&inner).ok_or_else(degenerate)?;
    let (dark, light) = if family.light {
        (&outer, &inner)
    } else {
        (&inner, &outer)
    };
    let contrast_dn = light.at(0.5 * n, 0.5 * n) - dark.at(0.5 * n, 0.5 * n);
    if !(contrast_dn >= rules.min_contrast_dn) {
        return Err(NoFinding::LowContrast {
            found_dn: contrast_dn,
            needed_dn: rules.min_contrast_dn,
        });
    }
    let mut best: Option<Read> = None;
    for first in 0..4 {
        let mut word = 0u64;
        let mut sums = [(0.0, 0.0); 2];
        for &(column, row) in &family.bits {
            let (x, y) = (f64::from(column) + 0.5, f64::from(row) + 0.5);
            // the square turned so that corner `first` is left above
            let (x, y) = match first {
                0 => (x, y),
                1 => (n - y, x),
                2 => (n - x, n - y),
                _ => (y, n - x),
            };
            let (low, high) = (dark.at(x, y), light.at(x, y));
            let beyond = (grey(x, y)? - 0.5 * (low + high)) / (high - low).max(1.0);
            let bit = usize::from(beyond > 0.0);
            word = word << 1 | bit as u64;
            sums[bit].0 += beyond.abs();
            sums[bit].1 += 1.0;
        }
        if first == 0 {
            let margin =
                sums.map(|(sum, count): (f64, f64)| if count > 0.0 { sum / count } else { 0.5 });
            let margin = margin[0].min(margin[1]);
            if margin < rules.min_margin {
                return Err(NoFinding::Shape {
                    what: "margin of the bits",
                    found: margin,
                    expected: format!("at least {}", rules.min_margin),
                });
            }
        }
        if let Some((id, wrong_bits)) = family.nearest(word)
            && best.as_ref().is_none_or(|b| wrong_bits < b.wrong_bits)
        {
            best = Some(Read {
                id,
                wrong_bits,
                first,
            });
        }
    }
    best.ok_or_else(degenerate)
}

fn pose(
    camera: &Camera,
    side_m: f64,
    corners: &[Vector2<f64>; 4],
    sigma_px: f64,
    rules: &TagRules,
) -> Result<FoundPose, NoFinding> {
    let h = 0.5 * side_m;
    let places = [(-h, h), (h, h), (h, -h), (-h, -h)].map(|(x, y)| Vector2::new(x, y));
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
