//! Trials of stereo matching, on textured planes.

use nalgebra::{Isometry3, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_cameras::{Camera, StereoPair};
use rover_vision::texture::texture;
use rover_vision::{
    DenseRules, Image8, MatchRules, PreparedImage, Rectifier, SurfaceRules, dense_disparity,
    match_point, measure_surface,
};

use super::super::bound::{Unknown, bound_px};
use super::super::patch::{self, FOCAL_PX, Light};
use super::{MAX_TILT_RAD, Outcome};

/// Baseline of the pairs, m.
const BASELINE_M: f64 = 0.08;

/// A textured plane in both images of a pair; the pair, both images, the left pixel and the range
/// along its ray.
struct PlanePair {
    pair: StereoPair,
    left: Image8,
    right: Image8,
    pixel: Vector2<f64>,
    pose: Isometry3<f64>,
    shift_px: f64,
    /// The left image without noise.
    clean: Image8,
}

fn plane_pair(rng: &mut ChaCha8Rng, noise_dn: f64, size: (u32, u32)) -> Option<PlanePair> {
    let pose = patch::pose(rng, MAX_TILT_RAD, 0.0);
    // both patches look at the plane's middle
    let shift_px = (BASELINE_M * FOCAL_PX / pose.translation.vector.z).round() - 24.0;
    let pair = StereoPair {
        left: patch::camera(size.0, size.1, Vector3::zeros(), 0.0),
        right: patch::camera(size.0, size.1, Vector3::new(BASELINE_M, 0.0, 0.0), shift_px),
    };
    let seed: u64 = rng.random::<u64>() >> 1;
    let shade = move |x: f64, y: f64| Some(texture(x, y, 0.064, 0.0015, 18.0, seed));
    let light = Light::random(rng);
    let draw = |camera: &Camera| patch::draw(camera, &pose, &shade, &|_, _| 110.0, patch::SMOOTH);
    let pictures = [draw(&pair.left), draw(&pair.right)];
    let clean = patch::expose(&pictures[0], size.0, &light, 0.0, &mut rng.clone())?;
    let left = patch::expose(&pictures[0], size.0, &light, noise_dn, rng)?;
    let right = patch::expose(&pictures[1], size.0, &light, noise_dn, rng)?;
    let pixel = patch::seen(&pair.left, &pose, 0.0, 0.0)?.map(f64::round);
    Some(PlanePair {
        pair,
        left,
        right,
        pixel,
        pose,
        shift_px,
        clean,
    })
}

impl PlanePair {
    /// Range of the plane along the ray of a left pixel, m.
    fn range_m(&self, pixel: &Vector2<f64>) -> Option<f64> {
        let ray = self.pair.left.ray(pixel).ok()?;
        let normal = self.pose * Vector3::z();
        let d = ray.direction.into_inner();
        Some(normal.dot(&(self.pose.translation.vector - ray.origin)) / normal.dot(&d))
    }

    fn prepared(&self) -> Option<(PreparedImage, PreparedImage)> {
        let left = PreparedImage::new(&self.left).ok()?;
        Some((left, PreparedImage::new(&self.right).ok()?))
    }

    /// The true right pixel of a left one.
    fn right_px(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let ray = self.pair.left.ray(pixel).ok()?;
        self.pair.right.project(&ray.at(self.range_m(pixel)?)).ok()
    }
}

const PAIR_PX: (u32, u32) = (160, 96);

fn match_rules() -> MatchRules {
    MatchRules {
        range_min_m: 0.4,
        range_max_m: 0.9,
        slant_normals: vec![[0.0, -0.7, -0.7], [0.5, -0.5, -0.7], [-0.5, -0.5, -0.7]],
        ..MatchRules::default()
    }
}

pub(super) fn stereo_match(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let Some(p) = plane_pair(rng, noise_dn, PAIR_PX) else {
        return Outcome::MISSED;
    };
    let rules = match_rules();
    let attempt = || {
        let (left, right) = p.prepared()?;
        let truth = p.right_px(&p.pixel)?;
        let found = match_point(&left, &right, &p.pair, &p.pixel, &rules).ok()?;
        Some(Outcome {
            error_px: Some([found.right_px.x - truth.x, 0.0]),
            sigma_px: found.sigma_px,
            bound_px: None,
        })
    };
    // both images are as noisy
    let noise = noise_dn * std::f64::consts::SQRT_2;
    let centre = [p.pixel.x as i64, p.pixel.y as i64];
    let half = i64::from(rules.half_window_px);
    let bound = bound_px(&p.clean, centre, half, noise, Unknown::Disparity);
    attempt_or_missed(attempt).bounded_by(bound)
}

pub(super) fn surface(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let attempt = || {
        let p = plane_pair(rng, noise_dn, PAIR_PX)?;
        let (left, right) = p.prepared()?;
        let truth = p.right_px(&p.pixel)?;
        let rules = SurfaceRules {
            matching: match_rules(),
            ..SurfaceRules::default()
        };
        let found = measure_surface(&left, &right, &p.pair, &p.pixel, &rules).ok()?;
        let at = p.pair.right.project(&found.position).ok()?;
        Some(Outcome {
            error_px: Some([at.x - truth.x, 0.0]),
            sigma_px: found.sigma_px,
            bound_px: None,
        })
    };
    attempt_or_missed(attempt)
}

/// The dense disparity at one random pixel of a patch, against the plane.
pub(super) fn dense(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let pick = Vector2::new(rng.random_range(80..140u32), rng.random_range(20..76u32));
    let attempt = || {
        let p = plane_pair(rng, noise_dn, PAIR_PX)?;
        let rectifier = Rectifier::new(&p.pair, p.shift_px).ok()?;
        let left = rectifier.apply(&p.left, rover_cameras::Side::Left).ok()?;
        let right = rectifier.apply(&p.right, rover_cameras::Side::Right).ok()?;
        let rules = DenseRules::default();
        let disparity = dense_disparity(&left, &right, &rules).ok()?;
        let found = disparity.at(pick.x, pick.y)?;
        let rectified = PlanePair {
            pair: rectifier.pair,
            ..p
        };
        let pixel = pick.map(f64::from);
        let truth = rectified.right_px(&pixel)?;
        Some(Outcome {
            error_px: Some([(pixel.x - truth.x) - found, 0.0]),
            sigma_px: f64::NAN,
            bound_px: None,
        })
    };
    attempt_or_missed(attempt)
}

fn attempt_or_missed(attempt: impl FnOnce() -> Option<Outcome>) -> Outcome {
    attempt().unwrap_or(Outcome::MISSED)
}
