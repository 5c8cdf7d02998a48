//! A disc standing alone: its ellipse, and with a camera and the disc's normal the image of its
//! true centre.

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use super::blobs::{Blob, BlobRules, blobs};
use super::disc_centre::{DiscTruth, true_centre};
use super::pixels::{PixelModel, fit_pixels, fit_rules, noise_dn};
use super::{Finding, NoFinding, distinct, positive};
use crate::fiducial::normal_at;
use crate::image::Image8;
use crate::ncc::Window;

/// Which discs are looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Polarity {
    /// Dark discs on light ground.
    Dark,
    /// Light discs on dark ground.
    Light,
    /// Both.
    Either,
}

/// Thresholds of the disc detector.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiscRules {
    /// Dark, light, or either.
    pub polarity: Polarity,
    /// Least semi-axis along the shortest direction, px. Below the default a pebble or a shadow,
    /// blurred by the lens, is too often an ellipse to within the noise.
    pub min_radius_px: f64,
    /// Largest semi-axis along the longest direction, px.
    pub max_radius_px: f64,
    /// Least ratio of the semi-axes.
    pub min_axis_ratio: f64,
    /// Largest difference of a region's area from that of an ellipse with the same moments, as a
    /// fraction; pixels of the outline are granted on top.
    pub max_fill_error: f64,
    /// Least difference between disc and ground, DN.
    pub min_contrast_dn: f64,
    /// Least correlation of model and image.
    pub min_score: f64,
    /// Largest rms difference between model and image beyond the image's own noise, as a fraction of
    /// the contrast.
    pub max_residual_fraction: f64,
    /// Largest deformation of the shape (bent edges, unequal blur or grey...), as a multiple of what
    /// noise and a small granted deformation explain. Drawn discs hardly ever reach 1.2; of the dark
    /// patches of thresholded texture that pass as small discs with 1.8, nine in ten exceed the
    /// default.
    pub max_deformation: f64,
    /// Largest grey noise of the image that the residual check puts up with, DN.
    pub noise_dn: f64,
    /// Largest blur of the edge, px.
    pub max_blur_px: f64,
    /// Ground that the fit takes in beyond the edge, px.
    pub margin_px: f64,
    /// Ground beyond the edge that must be of even grey (a plane of it), px. What the image cuts off
    /// is not asked for.
    pub quiet_zone_px: f64,
    /// Largest standard deviation of the result, px.
    pub max_sigma_px: f64,
    /// Largest fraction of clipped pixels.
    pub max_saturated_fraction: f64,
    /// Smallest standard deviation that is ever claimed, px.
    pub sigma_floor_px: f64,
}

impl Default for DiscRules {
    fn default() -> Self {
        Self {
            polarity: Polarity::Dark,
            min_radius_px: 4.25,
            max_radius_px: 80.0,
            min_axis_ratio: 0.3,
            max_fill_error: 0.06,
            min_contrast_dn: 30.0,
            min_score: 0.965,
            max_deformation: 1.3,
            max_residual_fraction: 0.02,
            noise_dn: 6.0,
            max_blur_px: 1.6,
            margin_px: 2.5,
            quiet_zone_px: 4.0,
            max_sigma_px: 0.2,
            max_saturated_fraction: 0.7,
            sigma_floor_px: 0.004,
        }
    }
}

impl DiscRules {
    fn validate(&self) -> Result<(), NoFinding> {
        for (name, x) in [
            ("min_radius_px", self.min_radius_px),
            (
                "max_radius_px less min_radius_px",
                self.max_radius_px - self.min_radius_px,
            ),
            ("min_axis_ratio", self.min_axis_ratio),
            ("max_fill_error", self.max_fill_error),
            ("min_contrast_dn", self.min_contrast_dn),
            ("min_score", self.min_score),
            ("max_residual_fraction", self.max_residual_fraction),
            ("max_deformation", self.max_deformation),
            ("noise_dn", self.noise_dn),
            ("max_blur_px", self.max_blur_px),
            ("margin_px", self.margin_px),
            ("quiet_zone_px", self.quiet_zone_px),
            ("max_sigma_px", self.max_sigma_px),
            ("max_saturated_fraction", self.max_saturated_fraction),
            ("sigma_floor_px", self.sigma_floor_px),
        ] {
            positive("disc rules", name, x)?;
        }
        Ok(())
    }
}

/// Parameters: centre u, v; change of B (11, 12, 22) in units of `scale`; blur. The disc's radius
/// coordinate of an offset d is r = |B d|, B symmetric.
struct Ellipse {
    b: [f64; 3],
    scale: f64,
    margin_px: f64,
    max_blur_px: f64,
}

const MIN_BLUR_PX: f64 = 0.3;

impl Ellipse {
    /// The ellipse of a region: B is the inverse square root of its shape.
    fn of(blob: &Blob, rules: &DiscRules) -> Option<Self> {
        let [a, b, c] = blob.shape();
        let det = a * c - b * b;
        if !(det > 0.0 && a > 0.0) {
            return None;
        }
        // square root of a symmetric 2 x 2, then its inverse
        let s = det.sqrt();
        let t = (a + c + 2.0 * s).sqrt();
        let root = [(a + s) / t, b / t, (c + s) / t];
        let root_det = root[0] * root[2] - root[1] * root[1];
        let inverse = [root[2] / root_det, -root[1] / root_det, root[0] / root_det];
        Some(Self {
            b: inverse,
            scale: 0.5 * (inverse[0] + inverse[2]),
            margin_px: rules.margin_px,
            max_blur_px: rules.max_blur_px + 0.5,
        })
    }

    fn matrix(&self, p: &[f64; 6]) -> [f64; 3] {
        [0, 1, 2].map(|i| self.b[i] + self.scale * p[2 + i])
    }

    /// Shortest and longest semi-axis, px.
    fn semi_axes(&self, p: &[f64; 6]) -> (f64, f64) {
        let [a, b, c] = self.matrix(p);
        let (mean, half) = (0.5 * (a + c), 0.5 * (a - c));
        let spread = (half * half + b * b).sqrt();
        (1.0 / (mean + spread), 1.0 / (mean - spread).max(1e-6))
    }
}

impl PixelModel<6> for Ellipse {
    /// The parameters and the matrix.
    type Shared = ([f64; 6], [f64; 3]);

    fn shared(&self, p: &[f64; 6]) -> Self::Shared {
        (*p, self.matrix(p))
    }

    #[inline(always)]
    fn at(&self, shared: &Self::Shared, u: f64, v: f64, slopes: &mut [f64; 6]) -> (f64, f64) {
        let (p, [a, b, c]) = shared;
        let (du, dv) = (u - p[0], v - p[1]);
        let (x, y) = (a * du + b * dv, b * du + c * dv);
        let radius = (x * x + y * y).sqrt();
        if radius < 1e-3 {
            return (1.0, 1.0);
        }
        let (nx, ny) = (x / radius, y / radius);
        let (gu, gv) = (a * nx + b * ny, b * nx + c * ny);
        let slope = (gu * gu + gv * gv).sqrt();
        let edge = (radius - 1.0) / slope;
        let weight = (self.margin_px + 0.5 - edge).clamp(0.0, 1.0);
        if weight <= 0.0 {
            return (0.0, 0.0);
        }
        let z = edge / p[5];
        let (inside, density) = normal_at(-z as f32);
        let rate = f64::from(density) / p[5];
        let by_b = -rate / slope * self.scale;
        *slopes = [
            rate * gu / slope,
            rate * gv / slope,
            by_b * nx * du,
            by_b * (nx * dv + ny * du),
            by_b * ny * dv,
            rate * z,
        ];
        (f64::from(inside), weight)
    }

    /// Outline moved outwards by cos k t and sin k t px for k = 3 to 6 (1 is the centre, 2 the
    /// ellipse), blur changed by cos k t and sin k t for k = 1 and 2.
    const DEFORMATIONS: usize = 12;
    const GRANTED_PX: f64 = 0.02;

    fn deform(&self, p: &[f64; 6], u: f64, v: f64, out: &mut [f64]) {
        let [a, b, c] = self.matrix(p);
        let (du, dv) = (u - p[0], v - p[1]);
        let (x, y) = (a * du + b * dv, b * du + c * dv);
        let radius = (x * x + y * y).sqrt();
        if radius < 1e-3 {
            return;
        }
        let (nx, ny) = (x / radius, y / radius);
        let (gu, gv) = (a * nx + b * ny, b * nx + c * ny);
        let z = (radius - 1.0) / (gu * gu + gv * gv).sqrt() / p[5];
        let rate = f64::from(normal_at(-z as f32).1) / p[5];
        let (mut cos, mut sin) = (1.0, 0.0);
        for k in 1..=6 {
            (cos, sin) = (cos * nx - sin * ny, sin * nx + cos * ny);
            let (at, factor) = if k < 3 {
                (6 + 2 * k, rate * z)
            } else {
                (2 * (k - 3), rate)
            };
            out[at] = factor * cos;
            out[at + 1] = factor * sin;
        }
    }

    fn reach(&self, p: &[f64; 6]) -> f64 {
        self.semi_axes(p).1 + self.margin_px + 0.5
    }

    fn advance(&self, p: &mut [f64; 6], step: &[f64; 6]) {
        for i in 0..2 {
            p[i] += step[i].clamp(-1.0, 1.0);
        }
        for i in 2..5 {
            // B stays within a third of its start
            p[i] = (p[i] + step[i].clamp(-0.1, 0.1)).clamp(-0.3, 0.3);
        }
        p[5] = (p[5] + step[5].clamp(-0.3, 0.3)).clamp(MIN_BLUR_PX, self.max_blur_px);
    }
}

/// Shape checks on a region, before it is fitted.
fn plausible(blob: &Blob, rules: &DiscRules) -> Result<(), NoFinding> {
    let shape = |what, found, expected: String| {
        Err(NoFinding::Shape {
            what,
            found,
            expected,
        })
    };
    let Some((short, long)) = blob.semi_axes() else {
        return shape(
            "semi-axis in px",
            0.0,
            format!("at least {}", rules.min_radius_px),
        );
    };
    if short < rules.min_radius_px * 0.85 {
        return Err(NoFinding::TooSmall {
            found_px: short,
            needed_px: rules.min_radius_px,
        });
    }
    if long > rules.max_radius_px * 1.1 {
        return shape(
            "semi-axis in px",
            long,
            format!("at most {}", rules.max_radius_px),
        );
    }
    if short / long < rules.min_axis_ratio {
        return shape(
            "ratio of the semi-axes",
            short / long,
            format!("at least {}", rules.min_axis_ratio),
        );
    }
    let error = (blob.fill() - 1.0).abs();
    let limit = rules.max_fill_error + 0.35 / short;
    if error > limit {
        return shape(
            "area beside an ellipse's, as a fraction,",
            error,
            format!("at most {limit:.3}"),
        );
    }
    Ok(())
}

fn fit(
    image: &Image8,
    blob: &Blob,
    dark: bool,
    noise_dn: f64,
    rules: &DiscRules,
    truth: Option<&DiscTruth>,
) -> Result<Finding, NoFinding> {
    plausible(blob, rules)?;
    let model = Ellipse::of(blob, rules).ok_or_else(|| {
        NoFinding::NothingThere("a region without extent in two directions".into())
    })?;
    let start = [blob.centre[0], blob.centre[1], 0.0, 0.0, 0.0, 0.8];
    let found = fit_pixels(image, &model, start, 2.0)?;
    let p = &found.parameters;
    let contrast_dn = if dark { -found.gain_dn } else { found.gain_dn };
    let (short, long) = model.semi_axes(p);
    if short < rules.min_radius_px {
        return Err(NoFinding::TooSmall {
            found_px: short,
            needed_px: rules.min_radius_px,
        });
    }
    if short / long < rules.min_axis_ratio {
        return Err(NoFinding::Shape {
            what: "ratio of the semi-axes",
            found: short / long,
            expected: format!("at least {}", rules.min_axis_ratio),
        });
    }
    let limits = fit_rules!(rules, rules.max_blur_px.min(0.5 * short));
    let sigma_px = found.check(image, &model, contrast_dn, noise_dn, &limits)?;
    if let Some((rms_dn, freedom)) = unevenness(image, &model, p, rules.quiet_zone_px) {
        let limit_dn = limits.residual_limit_dn(noise_dn, contrast_dn, freedom);
        if !(rms_dn <= limit_dn) {
            return Err(NoFinding::Shape {
                what: "unevenness of the ground around the disc in DN",
                found: rms_dn,
                expected: format!("at most {limit_dn:.1}"),
            });
        }
    }
    let mut centre = [p[0], p[1]];
    if let Some(truth) = truth {
        let at = true_centre(centre, model.matrix(p), truth)?;
        centre = [at.x, at.y];
    }
    Ok(Finding::at(centre[0], centre[1], found.score, sigma_px))
}

/// How far the ground within `zone_px` of the edge, clear of its blur, is from a plane of grey
/// values: rms, DN, and the pixels less the plane's parameters. `None` if too little of it is in the
/// image.
fn unevenness(image: &Image8, model: &Ellipse, p: &[f64; 6], zone_px: f64) -> Option<(f64, f64)> {
    let [a, b, c] = model.matrix(p);
    let extent = model.semi_axes(p).1 + zone_px;
    let range = |x: f64, size: u32| {
        let clamp = |x: f64| x.clamp(0.0, f64::from(size) - 1.0) as usize;
        clamp((x - extent).ceil())..=clamp((x + extent).floor())
    };
    let clear_px = EDGE_BLURS * p[5] + 1.0;
    let mut sums = SMatrix::<f64, 4, 4>::zeros();
    for v in range(p[1], image.height_px) {
        let row = &image.pixels[v * image.width_px as usize..][..image.width_px as usize];
        for u in range(p[0], image.width_px) {
            let (du, dv) = (u as f64 - p[0], v as f64 - p[1]);
            let (x, y) = (a * du + b * dv, b * du + c * dv);
            let radius = (x * x + y * y).sqrt();
            if radius <= 1.0 {
                continue;
            }
            let (gu, gv) = ((a * x + b * y) / radius, (b * x + c * y) / radius);
            let edge_px = (radius - 1.0) / (gu * gu + gv * gv).sqrt();
            if !(clear_px..=zone_px).contains(&edge_px) {
                continue;
            }
            let column = SVector::<f64, 4>::new(1.0, du / extent, dv / extent, f64::from(row[u]));
            sums.ger(1.0, &column, &column, 1.0);
        }
    }
    let freedom = sums[(0, 0)] - 3.0;
    if freedom < MIN_GROUND_PX {
        return None;
    }
    let right = sums.fixed_view::<3, 1>(0, 3).into_owned();
    let plane = sums.fixed_view::<3, 3>(0, 0).into_owned().cholesky()?;
    let residual = sums[(3, 3)] - plane.solve(&right).dot(&right);
    Some(((residual.max(0.0) / freedom).sqrt(), freedom))
}

/// The ground is clear of the edge from so many blurs and a pixel on.
const EDGE_BLURS: f64 = 2.0;
/// Least ground whose evenness tells anything, px.
const MIN_GROUND_PX: f64 = 6.0;

/// Discs closer than this are one, px.
const SAME_PLACE_PX: f64 = 2.0;

/// All discs in a window, the best first (by score). With `truth` the positions are the images of
/// the discs' true centres, otherwise the middles of their ellipses.
///
/// # Errors
/// [`NoFinding`]: what refused the largest region, or `NothingThere` without one.
pub fn disc(
    image: &Image8,
    window: Window,
    rules: &DiscRules,
    truth: Option<&DiscTruth>,
) -> Result<Vec<Finding>, NoFinding> {
    image.validate()?;
    rules.validate()?;
    let area = std::f64::consts::PI * rules.min_radius_px * rules.min_radius_px;
    let largest = std::f64::consts::PI * rules.max_radius_px * rules.max_radius_px;
    let kinds: &[bool] = match rules.polarity {
        Polarity::Dark => &[true],
        Polarity::Light => &[false],
        Polarity::Either => &[true, false],
    };
    let noise = noise_dn(image, window);
    let mut found: Vec<Finding> = Vec::new();
    let mut refusal: Option<(f64, NoFinding)> = None;
    for &dark in kinds {
        let regions = BlobRules {
            dark,
            min_contrast_dn: rules.min_contrast_dn.min(255.0) as u8,
            area: (0.6 * area, 1.3 * largest),
        };
        for blob in blobs(image, window, &regions) {
            if blob.at_border {
                continue;
            }
            match fit(image, &blob, dark, noise, rules, truth) {
                Ok(one) => found.push(one),
                Err(e) => {
                    if refusal.as_ref().is_none_or(|(area, _)| blob.area > *area) {
                        refusal = Some((blob.area, e));
                    }
                }
            }
        }
    }
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    let found = distinct(found, SAME_PLACE_PX);
    if found.is_empty() {
        return Err(refusal.map_or_else(
            || NoFinding::NothingThere("no region of the size and contrast".into()),
            |(_, e)| e,
        ));
    }
    Ok(found)
}
