//! What is evaluated: for every detector and matcher a trial with known truth, and a patch without
//! the fiducial.

mod plate;
mod stereo;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_cameras::Camera;
use rover_vision::Image8;
use rover_vision::find::{
    self, Appearance, DiscRules, DiscTruth, Finding, NoFinding, SaddleRules, TagRules,
    TemplateRules,
};
use rover_vision::harris::HarrisRules;
use rover_vision::ncc::Window;
use rover_vision::texture::texture;

use super::bound::{Unknown, bound_px};
use super::patch::{self, EDGES, FOCAL_PX, Light};

/// How a trial ended. Without an error nothing was accepted.
pub struct Outcome {
    /// Found less true position, px.
    pub error_px: Option<[f64; 2]>,
    /// Standard deviation that the detector states, px.
    pub sigma_px: f64,
    /// What the noise allows in this patch, px, where it was worked out.
    pub bound_px: Option<f64>,
}

impl Outcome {
    const MISSED: Self = Self {
        error_px: None,
        sigma_px: 0.0,
        bound_px: None,
    };

    /// Length of the error, px; 0 without one.
    pub fn size(&self) -> f64 {
        self.error_px.map_or(0.0, |[u, v]| u.hypot(v))
    }

    fn of(found: &Finding, truth: &Vector2<f64>) -> Self {
        Self {
            error_px: Some([found.u_px - truth.x, found.v_px - truth.y]),
            sigma_px: found.sigma_px,
            bound_px: None,
        }
    }

    fn bounded_by(mut self, bound_px: Option<f64>) -> Self {
        self.bound_px = bound_px;
        self
    }
}

type Trial = fn(&mut ChaCha8Rng, f64) -> Outcome;
type Blank = fn(&mut ChaCha8Rng, f64) -> bool;

/// A detector or matcher.
pub struct Subject {
    /// Its name in the table.
    pub name: &'static str,
    pub(super) trial: Trial,
    /// Whether something is accepted in a patch without the fiducial.
    pub(super) blank: Option<Blank>,
    pub(super) target: &'static str,
    /// Coordinates that the error has: 2, or 1 along the epipolar line.
    pub(super) coordinates: u32,
}

const FIDUCIAL: &str = "sigma < 0.02 px at 1 DN, < 0.05 px at 5 DN, no false accept";
const MATCH: &str = "bias < 0.02 px, sigma < 0.04 px";

/// All that can be evaluated.
pub const SUBJECTS: [Subject; 11] = [
    Subject {
        name: "harris",
        trial: harris,
        blank: None,
        target: "none stated (repeatability of interest points)",
        coordinates: 2,
    },
    Subject {
        name: "template",
        trial: template,
        blank: Some(blank_template),
        target: "0.05 px class (paper: correlation)",
        coordinates: 2,
    },
    Subject {
        name: "warped template",
        trial: warped,
        blank: Some(blank_warped),
        target: "0.05 px class (paper: correlation)",
        coordinates: 2,
    },
    Subject {
        name: "disc",
        trial: disc,
        blank: Some(blank_disc),
        target: FIDUCIAL,
        coordinates: 2,
    },
    Subject {
        name: "saddle",
        trial: saddle,
        blank: Some(blank_saddle),
        target: FIDUCIAL,
        coordinates: 2,
    },
    Subject {
        name: "plate",
        trial: plate::plate,
        blank: Some(plate::blank_plate),
        target: FIDUCIAL,
        coordinates: 2,
    },
    Subject {
        name: "plate's saddle",
        trial: plate::plate_saddle,
        blank: Some(plate::blank_plate_saddle),
        target: FIDUCIAL,
        coordinates: 2,
    },
    Subject {
        name: "apriltag",
        trial: apriltag,
        blank: Some(blank_apriltag),
        target: "none stated",
        coordinates: 2,
    },
    Subject {
        name: "stereo match",
        trial: stereo::stereo_match,
        blank: None,
        target: MATCH,
        coordinates: 1,
    },
    Subject {
        name: "surface point",
        trial: stereo::surface,
        blank: None,
        target: MATCH,
        coordinates: 1,
    },
    Subject {
        name: "dense disparity",
        trial: stereo::dense,
        blank: None,
        target: "that of semi-global matching on planes",
        coordinates: 1,
    },
];

/// Side of a patch, px.
const SIDE_PX: u32 = 96;
/// Largest tilt, rad: 50 degrees.
const MAX_TILT_RAD: f64 = 0.873;
const WHITE_DN: f64 = 200.0;
const BLACK_DN: f64 = 20.0;

/// A ground of its own for every trial.
fn ground(rng: &mut ChaCha8Rng) -> impl Fn(f64, f64) -> f64 + use<> {
    let seed: u64 = rng.random::<u64>() >> 1;
    let contrast = rng.random_range(3.0..18.0);
    move |u, v| texture(u, v, 64.0, 3.0, contrast, seed)
}

/// A scene of one thing in the middle of a patch; also the pose and the true pixel of its origin.
fn scene(
    rng: &mut ChaCha8Rng,
    noise_dn: f64,
    side_px: u32,
    shade: &dyn Fn(f64, f64) -> Option<f64>,
    samples: patch::Samples,
) -> Option<(Camera, Image8, Isometry3<f64>, Vector2<f64>)> {
    let camera = patch::camera(side_px, side_px, Vector3::zeros(), 0.0);
    let pose = patch::pose(rng, MAX_TILT_RAD, std::f64::consts::PI);
    let light = Light::random(rng);
    let ground = ground(rng);
    let picture = patch::draw(&camera, &pose, shade, &ground, samples);
    let image = patch::expose(&picture, side_px, &light, noise_dn, rng)?;
    let truth = patch::seen(&camera, &pose, 0.0, 0.0)?;
    Some((camera, image, pose, truth))
}

/// The finding nearest to the truth.
fn nearest(found: Result<Vec<Finding>, NoFinding>, truth: &Vector2<f64>) -> Outcome {
    let off = |f: &Finding| (f.u_px - truth.x).hypot(f.v_px - truth.y);
    found
        .ok()
        .and_then(|all| all.into_iter().min_by(|a, b| off(a).total_cmp(&off(b))))
        .map_or(Outcome::MISSED, |f| Outcome::of(&f, truth))
}

/// The best finding, wherever it is.
fn first(found: Result<Finding, NoFinding>, truth: &Vector2<f64>) -> Outcome {
    found.map_or(Outcome::MISSED, |f| Outcome::of(&f, truth))
}

/// Repeatability: a corner of rock without noise, against the nearest one with noise.
fn harris(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let camera = patch::camera(SIDE_PX, SIDE_PX, Vector3::zeros(), 0.0);
    let pose = patch::pose(rng, MAX_TILT_RAD, std::f64::consts::PI);
    let light = Light::random(rng);
    let seed: u64 = rng.random::<u64>() >> 1;
    let shade = move |x: f64, y: f64| Some(texture(x, y, 0.03, 0.002, 25.0, seed));
    let picture = patch::draw(&camera, &pose, &shade, &|_, _| 110.0, patch::SMOOTH);
    let mut corners = |noise_dn: f64| {
        let image = patch::expose(&picture, SIDE_PX, &light, noise_dn, rng)?;
        find::harris(&image, Window::whole(&image), &HarrisRules::default()).ok()
    };
    let (Some(clean), Some(noisy)) = (corners(0.0), corners(noise_dn)) else {
        return Outcome::MISSED;
    };
    clean.first().map_or(Outcome::MISSED, |c| {
        nearest(Ok(noisy), &Vector2::new(c.u_px, c.v_px))
    })
}

/// Rim that is rendered around a picture and cut off, px.
const RIM_PX: u32 = 6;
/// Side of the picture that is cut out, px.
const CUT_PX: u32 = 31;

/// A picture of rock, 31 px wide, seen straight on at another subpixel place, light and noise.
fn template(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let seed: u64 = rng.random::<u64>() >> 1;
    let at = |u: f64, v: f64| texture(u, v, 32.0, 4.0, 25.0, seed);
    // what lies beyond the picture blurs into it as well
    let mut take = |corner: Vector2<f64>, side: u32| {
        let wide = side + 2 * RIM_PX;
        let corner = corner - Vector2::repeat(f64::from(RIM_PX));
        let picture: Vec<f64> = (0..wide * wide)
            .map(|i| {
                at(
                    corner.x + f64::from(i % wide),
                    corner.y + f64::from(i / wide),
                )
            })
            .collect();
        let light = Light::random(rng);
        let clean = patch::expose(&picture, wide, &light, 0.0, &mut rng.clone())?;
        let seen = patch::expose(&picture, wide, &light, noise_dn, rng)?;
        let inner = (0..side * side).map(|i| seen.get(RIM_PX + i % side, RIM_PX + i / side));
        let image = Image8::from_raw(side, side, inner.collect::<Option<Vec<u8>>>()?).ok()?;
        Some((image, clean, light.gain()))
    };
    let whole = take(Vector2::zeros(), SIDE_PX);
    let truth =
        Vector2::new(47.3, 46.8) + Vector2::new((seed % 97) as f64, (seed % 89) as f64) * 0.1;
    let picture = take(truth - Vector2::repeat(15.0), CUT_PX);
    let (Some((image, _, gain)), Some((picture, clean, picture_gain))) = (whole, picture) else {
        return Outcome::MISSED;
    };
    // both are noisy; the image's noise in grey values of the picture
    let noise = noise_dn * (picture_gain / gain).hypot(1.0);
    let middle = i64::from(RIM_PX + CUT_PX / 2);
    // the outermost pixels have no slopes
    let half = i64::from(CUT_PX / 2) - 1;
    let rules = TemplateRules::default();
    first(
        find::template(&image, &picture, Window::whole(&image), &rules),
        &truth,
    )
    .bounded_by(bound_px(&clean, [middle; 2], half, noise, Unknown::Affine))
}

/// The picture that is looked for in patches without it.
fn other_picture(rng: &mut ChaCha8Rng, side: u32) -> Option<Image8> {
    let seed: u64 = rng.random::<u64>() >> 1;
    let pixels = (0..side * side)
        .map(|i| {
            let (u, v) = (f64::from(i % side), f64::from(i / side));
            texture(u, v, 32.0, 4.0, 25.0, seed).clamp(0.0, 255.0) as u8
        })
        .collect();
    Image8::from_raw(side, side, pixels).ok()
}

fn blank_template(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    let (picture, image) = (
        other_picture(rng, 31),
        patch::blank(SIDE_PX, SIDE_PX, noise_dn, rng),
    );
    picture.zip(image).is_some_and(|(picture, image)| {
        let rules = TemplateRules::default();
        find::template(&image, &picture, Window::whole(&image), &rules).is_ok()
    })
}

/// A prediction that is off by some pixels, degrees and per cent.
fn spoiled(pose: &Isometry3<f64>, rng: &mut ChaCha8Rng) -> Isometry3<f64> {
    let mut off = |size: f64| rng.random_range(-size..size);
    let range = pose.translation.vector.z;
    let shift = Vector3::new(off(6.0), off(6.0), 0.0) * (range / FOCAL_PX);
    let turn = Vector3::new(off(0.05), off(0.05), off(0.05));
    let scale = 1.0 + off(0.03);
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector * scale + shift),
        UnitQuaternion::from_scaled_axis(turn) * pose.rotation,
    )
}

/// Width of the flat picture, m, and its pixels.
const PICTURE_M: f64 = 0.04;
const PICTURE_PX: u32 = 100;

fn warped(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let seed: u64 = rng.random::<u64>() >> 1;
    let per_m = f64::from(PICTURE_PX) / PICTURE_M;
    let half = 0.5 * PICTURE_M;
    let at = |i: f64, j: f64| texture(i, j, 50.0, 6.0, 25.0, seed);
    let shade = |x: f64, y: f64| {
        (x.abs().max(y.abs()) < half)
            .then(|| at((x + half) * per_m - 0.5, (half - y) * per_m - 0.5))
    };
    let made = scene(rng, noise_dn, SIDE_PX, &shade, patch::SMOOTH);
    let pixels = (0..PICTURE_PX * PICTURE_PX)
        .map(|i| {
            let x = at(f64::from(i % PICTURE_PX), f64::from(i / PICTURE_PX));
            x.round().clamp(0.0, 255.0) as u8
        })
        .collect();
    let picture = Image8::from_raw(PICTURE_PX, PICTURE_PX, pixels).ok();
    let (Some((camera, image, pose, truth)), Some(picture)) = (made, picture) else {
        return Outcome::MISSED;
    };
    let appearance = Appearance::Pose {
        camera: &camera,
        camera_frame_from_picture: spoiled(&pose, rng),
        width_m: PICTURE_M,
    };
    let rules = TemplateRules::default();
    first(
        find::warped_template(&image, &picture, &appearance, 12.0, &rules),
        &truth,
    )
}

fn blank_warped(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    let picture = other_picture(rng, PICTURE_PX);
    let camera = patch::camera(SIDE_PX, SIDE_PX, Vector3::zeros(), 0.0);
    let pose = patch::pose(rng, MAX_TILT_RAD, std::f64::consts::PI);
    let image = patch::blank(SIDE_PX, SIDE_PX, noise_dn, rng);
    picture.zip(image).is_some_and(|(picture, image)| {
        let appearance = Appearance::Pose {
            camera: &camera,
            camera_frame_from_picture: pose,
            width_m: PICTURE_M,
        };
        let rules = TemplateRules::default();
        find::warped_template(&image, &picture, &appearance, 12.0, &rules).is_ok()
    })
}

fn disc(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let radius = rng.random_range(0.006..0.018);
    let shade = move |x: f64, y: f64| {
        (x.abs().max(y.abs()) < 2.4 * radius).then(|| {
            if x.hypot(y) < radius {
                BLACK_DN
            } else {
                WHITE_DN
            }
        })
    };
    let Some((camera, image, pose, truth)) = scene(rng, noise_dn, SIDE_PX, &shade, EDGES) else {
        return Outcome::MISSED;
    };
    let known = DiscTruth {
        camera: &camera,
        normal: pose * Vector3::z(),
    };
    let rules = DiscRules::default();
    nearest(
        find::disc(&image, Window::whole(&image), &rules, Some(&known)),
        &truth,
    )
}

fn blank_disc(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    patch::blank(SIDE_PX, SIDE_PX, noise_dn, rng).is_some_and(|image| {
        find::disc(&image, Window::whole(&image), &DiscRules::default(), None).is_ok()
    })
}

fn saddle(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let shade = |x: f64, y: f64| {
        (x.abs().max(y.abs()) < 0.02).then_some(if x * y > 0.0 { BLACK_DN } else { WHITE_DN })
    };
    let Some((_, image, _, truth)) = scene(rng, noise_dn, SIDE_PX, &shade, EDGES) else {
        return Outcome::MISSED;
    };
    nearest(
        find::saddle(&image, Window::whole(&image), &SaddleRules::default()),
        &truth,
    )
}

fn blank_saddle(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    patch::blank(SIDE_PX, SIDE_PX, noise_dn, rng).is_some_and(|image| {
        find::saddle(&image, Window::whole(&image), &SaddleRules::default()).is_ok()
    })
}

/// Cells of the tag with identity 0 of family tag36h11, from its white rim on; 1 is white.
const TAG: [&str; 10] = [
    "1111111111",
    "1000000001",
    "1011010101",
    "1001110101",
    "1001100001",
    "1010100001",
    "1001011001",
    "1000010001",
    "1000000001",
    "1111111111",
];

fn apriltag(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let cell = rng.random_range(0.004..0.007);
    let shade = move |x: f64, y: f64| {
        let (i, j) = ((x / cell + 5.0).floor(), (5.0 - y / cell).floor());
        let inside = (0.0..10.0).contains(&i) && (0.0..10.0).contains(&j);
        let row = TAG.get(if inside { j as usize } else { usize::MAX })?;
        let light = row.as_bytes().get(i as usize) == Some(&b'1');
        Some(if light { WHITE_DN } else { BLACK_DN })
    };
    let Some((_, image, _, truth)) = scene(rng, noise_dn, SIDE_PX, &shade, EDGES) else {
        return Outcome::MISSED;
    };
    let whole = Window::whole(&image);
    nearest(
        find::tags(&image, whole, "tag36h11", None, &TagRules::default()),
        &truth,
    )
}

fn blank_apriltag(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    patch::blank(SIDE_PX, SIDE_PX, noise_dn, rng).is_some_and(|image| {
        let whole = Window::whole(&image);
        find::tags(&image, whole, "tag36h11", None, &TagRules::default()).is_ok()
    })
}
