//! The crossing of two edges: a checker's corner, standing alone.
//!
//! Candidates are the maxima of -det(Hessian) of the smoothed image, where the image is a saddle
//! surface; each is then fitted by the blurred crossing of two edges, for edges at right angles
//! value = E(n1.d / s) E(n2.d / s), E(x) = 2 Phi(x) - 1, with both edge directions, the blur s and
//! the centre free. The model is even under d -> -d, so that unequal light over the window moves the
//! centre only in second order.

use serde::{Deserialize, Serialize};

use super::pixels::{FitRules, PixelModel, fit_pixels, fit_rules, noise_dn};
use super::{Finding, NoFinding, cut, positive};
use crate::fiducial::normal_at;
use crate::image::{Image8, ImageF};
use crate::ncc::Window;

/// Thresholds of the saddle detector.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SaddleRules {
    /// Radius of the fitted window, px.
    pub window_px: f64,
    /// Smoothing of the candidate search, px.
    pub smoothing_px: f64,
    /// Least difference between light and dark quadrants, DN.
    pub min_contrast_dn: f64,
    /// Least such difference in units of the image's grey noise: below it noise hides what tells a
    /// crossing from chance.
    pub min_contrast_to_noise: f64,
    /// Least correlation of model and image.
    pub min_score: f64,
    /// Largest rms difference between model and image beyond the image's own noise, as a fraction of
    /// the contrast.
    pub max_residual_fraction: f64,
    /// Largest deformation of the shape (bent edges, unequal blur or grey...), as a multiple of what
    /// noise and a small granted deformation explain. Of drawn crossings one in a hundred exceeds the
    /// default; of the places where two dark patches of thresholded texture meet corner to corner
    /// and which pass with 2.5, all but one in fifty. Photographs need more where light saturates,
    /// a tone curve widens bright squares or compression rings.
    pub max_deformation: f64,
    /// Largest grey noise of the image that the residual check puts up with, DN.
    pub noise_dn: f64,
    /// Least sine of the angle between the edges.
    pub min_sine: f64,
    /// Largest blur, px.
    pub max_blur_px: f64,
    /// Largest standard deviation of the result, px.
    pub max_sigma_px: f64,
    /// Largest fraction of clipped pixels.
    pub max_saturated_fraction: f64,
    /// Candidates that are fitted, the strongest first.
    pub max_candidates: usize,
    /// Smallest standard deviation that is ever claimed, px.
    pub sigma_floor_px: f64,
}

impl Default for SaddleRules {
    fn default() -> Self {
        Self {
            window_px: 8.0,
            smoothing_px: 1.5,
            min_contrast_dn: 20.0,
            min_contrast_to_noise: 17.0,
            min_score: 0.93,
            max_deformation: 1.15,
            max_residual_fraction: 0.025,
            noise_dn: 6.0,
            min_sine: 0.35,
            max_blur_px: 1.6,
            max_sigma_px: 0.2,
            max_saturated_fraction: 0.6,
            max_candidates: 64,
            sigma_floor_px: 0.004,
        }
    }
}

impl SaddleRules {
    fn validate(&self) -> Result<(), NoFinding> {
        for (name, x) in [
            ("window_px", self.window_px - 3.0),
            ("smoothing_px", self.smoothing_px),
            ("min_contrast_dn", self.min_contrast_dn),
            ("min_contrast_to_noise", self.min_contrast_to_noise),
            ("min_score", self.min_score),
            ("max_residual_fraction", self.max_residual_fraction),
            ("max_deformation", self.max_deformation),
            ("noise_dn", self.noise_dn),
            ("min_sine", self.min_sine),
            ("max_blur_px", self.max_blur_px),
            ("max_sigma_px", self.max_sigma_px),
            ("max_saturated_fraction", self.max_saturated_fraction),
            ("max_candidates", self.max_candidates as f64),
            ("sigma_floor_px", self.sigma_floor_px),
        ] {
            positive("saddle rules (window_px less 3)", name, x)?;
        }
        Ok(())
    }
}

/// Parameters: centre u, v; turn of the first and of the second edge normal; blur.
struct Crossing {
    normals: [[f64; 2]; 2],
    window_px: f64,
    max_blur_px: f64,
}

const MIN_BLUR_PX: f64 = 0.3;

/// One blurred edge at a pixel: 2 Phi(z) - 1, z being the distance in blurs, with phi(z) and the
/// distance along the edge in blurs.
struct Edge {
    z: f64,
    value: f64,
    density: f64,
    along: f64,
}

/// One of the edges, for all pixels.
struct Line {
    n: [f64; 2],
    /// 1 / (1 + t^2): change of the direction with the tangent t of its turn.
    by_tangent: f64,
}

/// The crossing, for all pixels.
struct Lines {
    centre: [f64; 2],
    over_blur: f64,
    lines: [Line; 2],
    /// c = n1.n2, c^2 / 2 and c^3 / 6.
    cosine: [f64; 3],
    sine: f64,
}

/// What a blurred crossing has beside the product of its blurred edges unless they are at right
/// angles: the expectation of sign(x) sign(y) over the bivariate normal distribution with the
/// edges' distances as means and c = n1.n2 as correlation is the product plus
/// 4 phi(z1) phi(z2) (c + c^2/2 z1 z2 + c^3/6 (z1^2 - 1)(z2^2 - 1) + ...) (Mehler's series).
struct Skew {
    value: f64,
    /// Derivatives by z1, z2 and c.
    by_a: f64,
    by_b: f64,
    by_cosine: f64,
}

impl Skew {
    #[inline(always)]
    fn of(a: &Edge, b: &Edge, [c, c2, c3]: [f64; 3]) -> Self {
        let density = 4.0 * a.density * b.density;
        let (x, y) = (a.z, b.z);
        let (xx, yy) = (x * x - 1.0, y * y - 1.0);
        let sum = c + c2 * x * y + c3 * xx * yy;
        Self {
            value: density * sum,
            by_a: density * (c2 * y + c3 * 2.0 * x * yy - x * sum),
            by_b: density * (c2 * x + c3 * 2.0 * y * xx - y * sum),
            by_cosine: density * (1.0 + c * x * y + c2 * xx * yy),
        }
    }
}

impl Crossing {
    /// The normal turned by a tangent t: (n + t n') / |...|.
    fn turned(&self, which: usize, t: f64) -> [f64; 2] {
        let [x, y] = self.normals[which];
        let (a, b) = (x - t * y, y + t * x);
        let length = (a * a + b * b).sqrt();
        [a / length, b / length]
    }
}

impl PixelModel<5> for Crossing {
    type Shared = Lines;

    fn shared(&self, p: &[f64; 5]) -> Lines {
        let lines = [0, 1].map(|k| Line {
            n: self.turned(k, p[2 + k]),
            by_tangent: 1.0 / (1.0 + p[2 + k] * p[2 + k]),
        });
        let (a, b) = (lines[0].n, lines[1].n);
        let c = a[0] * b[0] + a[1] * b[1];
        Lines {
            centre: [p[0], p[1]],
            over_blur: 1.0 / p[4],
            lines,
            cosine: [c, 0.5 * c * c, c * c * c / 6.0],
            sine: a[0] * b[1] - a[1] * b[0],
        }
    }

    #[inline(always)]
    fn at(&self, shared: &Lines, u: f64, v: f64, slopes: &mut [f64; 5]) -> (f64, f64) {
        let (du, dv) = (u - shared.centre[0], v - shared.centre[1]);
        let square = du * du + dv * dv;
        let reach = self.window_px + 0.5;
        if square >= reach * reach {
            return (0.0, 0.0);
        }
        let weight = (reach - square.sqrt()).clamp(0.0, 1.0);
        let over = shared.over_blur;
        let edge = |n: [f64; 2]| {
            let z = (n[0] * du + n[1] * dv) * over;
            let (below, density) = normal_at(z as f32);
            Edge {
                z,
                value: 2.0 * f64::from(below) - 1.0,
                density: f64::from(density),
                along: (-n[1] * du + n[0] * dv) * over,
            }
        };
        let [first, second] = &shared.lines;
        let (a, b) = (edge(first.n), edge(second.n));
        let skew = Skew::of(&a, &b, shared.cosine);
        let (by_a, by_b) = (
            2.0 * a.density * b.value + skew.by_a,
            2.0 * b.density * a.value + skew.by_b,
        );
        // turning a normal changes the cosine of both by the sine between them
        let by_turn = skew.by_cosine * shared.sine;
        *slopes = [
            -(by_a * first.n[0] + by_b * second.n[0]) * over,
            -(by_a * first.n[1] + by_b * second.n[1]) * over,
            (by_a * a.along + by_turn) * first.by_tangent,
            (by_b * b.along - by_turn) * second.by_tangent,
            -(by_a * a.z + by_b * b.z) * over,
        ];
        (a.value * b.value + skew.value, weight)
    }

    /// Each edge bent (t^2), kinked (|t|) and bent to an S (t^3), its blur different from the other's
    /// and changing along it, t from -1 to 1 over the window; both more blurred away from the
    /// crossing than at it; quadrants of unequal grey (in units of the contrast); a gap or a neck at
    /// the crossing.
    const DEFORMATIONS: usize = 13;
    const GRANTED_PX: f64 = 0.07;

    fn deform(&self, p: &[f64; 5], u: f64, v: f64, out: &mut [f64]) {
        let (du, dv) = (u - p[0], v - p[1]);
        let edge = |which: usize| {
            let n = self.turned(which, p[2 + which]);
            let z = (n[0] * du + n[1] * dv) / p[4];
            let (below, density) = normal_at(z as f32);
            let rate = 2.0 * f64::from(density) / p[4];
            let along = (-n[1] * du + n[0] * dv) / self.window_px;
            (2.0 * f64::from(below) - 1.0, rate, rate * z, along)
        };
        let (a, rate_a, blur_a, s) = edge(0);
        let (b, rate_b, blur_b, t) = edge(1);
        out.copy_from_slice(&[
            rate_a * b * s * s,
            rate_a * b * s.abs(),
            rate_a * b * s * s * s,
            rate_b * a * t * t,
            rate_b * a * t.abs(),
            rate_b * a * t * t * t,
            blur_a * b - blur_b * a,
            blur_a * b * s,
            blur_b * a * t,
            blur_a * b * s.abs() + blur_b * a * t.abs(),
            a,
            b,
            rate_a * rate_b * p[4],
        ]);
    }

    fn reach(&self, _: &[f64; 5]) -> f64 {
        self.window_px + 0.5
    }

    fn advance(&self, p: &mut [f64; 5], step: &[f64; 5]) {
        for i in 0..2 {
            p[i] += step[i].clamp(-1.0, 1.0);
        }
        for i in 2..4 {
            p[i] = (p[i] + step[i].clamp(-0.2, 0.2)).clamp(-1.0, 1.0);
        }
        p[4] = (p[4] + step[4].clamp(-0.3, 0.3)).clamp(MIN_BLUR_PX, self.max_blur_px);
    }
}

/// A place where the smoothed image is a saddle, with its second derivatives.
struct Candidate {
    u: f64,
    v: f64,
    strength: f32,
    hessian: [f64; 3],
}

fn candidates(
    image: &Image8,
    window: Window,
    rules: &SaddleRules,
) -> Result<Vec<Candidate>, NoFinding> {
    let margin = (4.0 * rules.smoothing_px).ceil() as u32 + 2;
    let wide = Window {
        left: window.left.saturating_sub(margin),
        top: window.top.saturating_sub(margin),
        width: window.width.saturating_add(2 * margin),
        height: window.height.saturating_add(2 * margin),
    }
    .clipped(image);
    let smooth = ImageF::from_image8(&cut(image, wide)?)?.blurred(rules.smoothing_px);
    let (w, h) = (smooth.width(), smooth.height());
    if w < 5 || h < 5 {
        return Ok(Vec::new());
    }
    let mut response = vec![0.0f32; w * h];
    for v in 1..h - 1 {
        let (a, b, c) = (smooth.row(v - 1), smooth.row(v), smooth.row(v + 1));
        let out = &mut response[v * w..(v + 1) * w];
        for u in 1..w - 1 {
            let uu = b[u - 1] - 2.0 * b[u] + b[u + 1];
            let vv = a[u] - 2.0 * b[u] + c[u];
            let uv = 0.25 * (a[u - 1] - a[u + 1] - c[u - 1] + c[u + 1]);
            out[u] = uv * uv - uu * vv;
        }
    }
    // twist of a crossing of this contrast under smoothing and a blur of 1.5 px, halved twice
    let blur = rules.smoothing_px * rules.smoothing_px + 1.5 * 1.5;
    let twist = 0.5 * rules.min_contrast_dn * std::f64::consts::FRAC_2_PI / blur;
    let limit = (0.25 * twist * twist * rules.min_sine * rules.min_sine) as f32;
    let mut found = Vec::new();
    for v in 2..h - 2 {
        for u in 2..w - 2 {
            let r = response[v * w + u];
            if r < limit {
                continue;
            }
            let inside = |x: usize, offset: u32, first: u32, length: u32| {
                let x = x as u32 + offset;
                x >= first && x < first.saturating_add(length)
            };
            if !(inside(u, wide.left, window.left, window.width)
                && inside(v, wide.top, window.top, window.height))
            {
                continue;
            }
            let beaten = (0..25).filter(|k| *k != 12).any(|k| {
                let at = (v + k / 5 - 2) * w + u + k % 5 - 2;
                response[at] > r || (response[at] == r && k < 12)
            });
            if beaten {
                continue;
            }
            let (a, b, c) = (smooth.row(v - 1), smooth.row(v), smooth.row(v + 1));
            let uu = f64::from(b[u - 1] - 2.0 * b[u] + b[u + 1]);
            let vv = f64::from(a[u] - 2.0 * b[u] + c[u]);
            let uv = f64::from(0.25 * (a[u - 1] - a[u + 1] - c[u - 1] + c[u + 1]));
            found.push(Candidate {
                u: u as f64 + f64::from(wide.left),
                v: v as f64 + f64::from(wide.top),
                strength: r,
                hessian: [uu, uv, vv],
            });
        }
    }
    found.sort_by(|a, b| {
        b.strength
            .total_cmp(&a.strength)
            .then(a.v.total_cmp(&b.v))
            .then(a.u.total_cmp(&b.u))
    });
    found.truncate(rules.max_candidates);
    Ok(found)
}

/// Unit normals of the two edges: perpendicular to the directions in which the second derivative
/// vanishes.
fn edge_normals([uu, uv, vv]: [f64; 3]) -> Option<[[f64; 2]; 2]> {
    let (mean, half) = (0.5 * (uu + vv), 0.5 * (uu - vv));
    let spread = (half * half + uv * uv).sqrt();
    let (high, low) = (mean + spread, mean - spread);
    if !(high > 0.0 && low < 0.0) {
        return None;
    }
    // eigenvector of the larger eigenvalue, by the better conditioned of two formulas
    let (x, y) = if half >= 0.0 {
        (half + spread, uv)
    } else {
        (uv, spread - half)
    };
    let length = (x * x + y * y).sqrt();
    let (x, y) = (x / length, y / length);
    let (a, b) = ((-low).sqrt(), high.sqrt());
    let normal = |sign: f64| {
        // direction a e1 + sign b e2 with e2 = (-y, x), turned by 90 degrees
        let (dx, dy) = (a * x - sign * b * y, a * y + sign * b * x);
        let length = (dx * dx + dy * dy).sqrt();
        [-dy / length, dx / length]
    };
    Some([normal(1.0), normal(-1.0)])
}

fn fit(
    image: &Image8,
    candidate: &Candidate,
    noise_dn: f64,
    rules: &SaddleRules,
) -> Result<Finding, NoFinding> {
    let skew = |found| NoFinding::Shape {
        what: "sine of the angle between the edges",
        found,
        expected: format!("at least {}", rules.min_sine),
    };
    let normals = edge_normals(candidate.hessian).ok_or_else(|| skew(0.0))?;
    let model = Crossing {
        normals,
        window_px: rules.window_px,
        max_blur_px: rules.max_blur_px + 0.5,
    };
    let start = [candidate.u, candidate.v, 0.0, 0.0, 0.8];
    let found = fit_pixels(image, &model, start, 0.5 * rules.window_px)?;
    let p = &found.parameters;
    let (a, b) = (model.turned(0, p[2]), model.turned(1, p[3]));
    let sine = (a[0] * b[1] - a[1] * b[0]).abs();
    let contrast_dn = 2.0 * found.gain_dn.abs();
    if sine < rules.min_sine {
        return Err(skew(sine));
    }
    let limits = fit_rules!(rules, rules.max_blur_px);
    let over_noise_dn = rules.min_contrast_to_noise * noise_dn.min(rules.noise_dn);
    let limits = FitRules {
        min_contrast_dn: rules.min_contrast_dn.max(over_noise_dn),
        ..limits
    };
    let sigma_px = found.check(image, &model, contrast_dn, noise_dn, &limits)?;
    Ok(Finding::at(p[0], p[1], found.score, sigma_px))
}

/// Places closer than this are one crossing, px.
const SAME_PLACE_PX: f64 = 2.0;

/// All crossings in a window, the best first (by score).
///
/// # Errors
/// [`NoFinding`]: what refused the strongest candidate, or `NothingThere` without a candidate.
pub fn saddle(
    image: &Image8,
    window: Window,
    rules: &SaddleRules,
) -> Result<Vec<Finding>, NoFinding> {
    image.validate()?;
    rules.validate()?;
    let mut found: Vec<Finding> = Vec::new();
    let mut refusal = None;
    let noise = noise_dn(image, window);
    for candidate in candidates(image, window, rules)? {
        match fit(image, &candidate, noise, rules) {
            Ok(one) => found.push(one),
            Err(e) => {
                refusal.get_or_insert(e);
            }
        }
    }
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    let distinct = super::distinct(found, SAME_PLACE_PX);
    if distinct.is_empty() {
        return Err(refusal.unwrap_or_else(|| NoFinding::NothingThere("no saddle surface".into())));
    }
    Ok(distinct)
}

#[cfg(test)]
#[path = "saddle_tests.rs"]
mod tests;
