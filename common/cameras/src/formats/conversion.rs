//! From the CAHV family to pinhole cameras with a lens of OpenCV, and back.
//!
//! What both can express is carried over by formula: a lens whose only coefficients are k1 and k2
//! is CAHVOR with `O = A`, `R = (0, k1, k2)`; an equidistant one with only k1 and k2 is CAHVORE
//! with linearity 0, `E = 0` and the same R; and back with `f = (1 + r0) hs`, `k = r / (1 + r0)`.
//! Everything else is fitted by least squares over a grid of pixels, and the worst error over a
//! finer grid is reported. A moving pupil makes that error depend on range: it is fitted and
//! checked from the nearest range of the rules to a thousand times that.

use super::lens::{Lens, LensCamera};
use crate::least_squares::{Differenced, minimise};
use crate::{Cahv, Cahvor, Cahvore, Camera, CameraError, CameraModel, Ray};
use nalgebra::{DVector, Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use thiserror::Error;

/// What a conversion may do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConversionRules {
    /// Largest pixel error that is accepted, px.
    pub limit_px: f64,
    /// Nearest range at which the cameras shall agree, metres; matters only for a moving pupil.
    pub near_m: f64,
}

impl Default for ConversionRules {
    /// A tenth of a pixel, from half a metre.
    fn default() -> Self {
        Self {
            limit_px: 0.1,
            near_m: 0.5,
        }
    }
}

/// The lens models that other tools read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// k1, k2, p1, p2 (Kalibr `radtan`).
    RadialTangential,
    /// k1, k2, p1, p2, k3 (ROS `plumb_bob`).
    PlumbBob,
    /// k1, k2, p1, p2, k3, k4, k5, k6 (ROS `rational_polynomial`).
    Rational,
    /// k1, k2, k3, k4 of the angle (ROS `equidistant`, OpenCV fisheye, Kalibr `equidistant`).
    Equidistant,
}

/// A converted camera and how well it stands for the original.
#[derive(Clone, Debug, PartialEq)]
pub struct Conversion<T> {
    /// The camera.
    pub camera: T,
    /// Whether the two are the same function (to 1e-9 px).
    pub exact: bool,
    /// Largest distance between the two over the image, px.
    pub worst_px: f64,
    /// Share of the image in which the original has rays at all; only there were they compared.
    pub covered: f64,
}

/// Why a camera cannot be converted.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ConversionError {
    /// The best fit is not good enough.
    #[error(
        "the other model cannot express this camera: its best fit is {worst_px} px off at worst, \
         expected at most {limit_px} px"
    )]
    TooFar {
        /// Worst error of the best fit, px.
        worst_px: f64,
        /// The largest accepted, px.
        limit_px: f64,
    },
    /// No fit could be begun.
    #[error(
        "the other model cannot image all rays of this camera (up to {off_axis_deg} deg from its \
         axis)"
    )]
    OutOfReach {
        /// The widest angle from A of the camera's rays, degrees.
        off_axis_deg: f64,
    },
    /// The camera has rays only in a small part of its image.
    #[error("the model has rays in only {covered} of its image, expected at least {MIN_COVERED}")]
    NotCovered {
        /// Share of pixels with a ray.
        covered: f64,
    },
    /// The camera is not one, or became none.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

/// Errors below this count as the same function, px.
const EXACT_PX: f64 = 1e-9;
/// Least share of the image in which the original has rays.
const MIN_COVERED: f64 = 0.5;
const FIT_GRID: [u32; 2] = [25, 19];
const CHECK_GRID: [u32; 2] = [61, 47];
const ITERATIONS: u32 = 200;

/// Points on the original's rays and where it sees them.
struct Samples {
    seen: Vec<(Vector3<f64>, Vector2<f64>)>,
    covered: f64,
}

fn samples(
    size_px: [u32; 2],
    grid: [u32; 2],
    ranges_m: &[f64],
    ray: impl Fn(&Vector2<f64>) -> Result<Ray, CameraError>,
) -> Samples {
    let mut seen = Vec::new();
    let mut covered = 0_u32;
    for j in 0..grid[1] {
        for i in 0..grid[0] {
            let at =
                |k: u32, n: u32, size: u32| f64::from(k) / f64::from(n - 1) * f64::from(size) - 0.5;
            let pixel = Vector2::new(at(i, grid[0], size_px[0]), at(j, grid[1], size_px[1]));
            if let Ok(ray) = ray(&pixel) {
                covered += 1;
                seen.extend(ranges_m.iter().map(|range_m| (ray.at(*range_m), pixel)));
            }
        }
    }
    Samples {
        seen,
        covered: f64::from(covered) / f64::from(grid[0] * grid[1]),
    }
}

/// Largest pixel error; `None` if a point has no image.
fn worst_px(
    samples: &Samples,
    project: impl Fn(&Vector3<f64>) -> Result<Vector2<f64>, CameraError>,
) -> Option<f64> {
    samples
        .seen
        .iter()
        .map(|(point, pixel)| Some((project(point).ok()? - pixel).norm()))
        .try_fold(0.0_f64, |worst, error| {
            error.filter(|e| e.is_finite()).map(|e| worst.max(e))
        })
}

/// Fits the parameters of `build` to the samples.
fn fit<C>(
    samples: &Samples,
    start: DVector<f64>,
    steps: DVector<f64>,
    build: &dyn Fn(&DVector<f64>) -> Option<C>,
    project: &dyn Fn(&C, &Vector3<f64>) -> Result<Vector2<f64>, CameraError>,
) -> Option<C> {
    let residuals = |x: &DVector<f64>| {
        let camera = build(x)?;
        let mut r = DVector::zeros(2 * samples.seen.len());
        for (i, (point, pixel)) in samples.seen.iter().enumerate() {
            let error = project(&camera, point).ok()? - pixel;
            r[2 * i] = error.x;
            r[2 * i + 1] = error.y;
        }
        Some(r)
    };
    let problem = Differenced { residuals, steps };
    build(&minimise(&problem, start, ITERATIONS)?.state)
}

/// A pose turned and moved by six small numbers: angles (radians), then metres.
fn nudged(pose: &Isometry3<f64>, by: &[f64]) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(by[0], by[1], by[2]));
    let shift = Vector3::new(by[3], by[4], by[5]);
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        pose.rotation * turn,
    )
}

impl LensCamera {
    /// The camera as one of the CAHV family: CAHV without distortion, CAHVOR for radial and
    /// tangential, CAHVORE for an equidistant lens or if CAHVOR is not good enough.
    ///
    /// # Errors
    /// [`ConversionError`].
    pub fn to_camera(
        &self,
        rules: &ConversionRules,
    ) -> Result<Conversion<Camera>, ConversionError> {
        self.validate()?;
        let take = |grid| samples(self.size_px, grid, &[1.0], |pixel| self.ray(pixel));
        let check = take(CHECK_GRID);
        if check.covered < MIN_COVERED {
            return Err(ConversionError::NotCovered {
                covered: check.covered,
            });
        }
        let starts = self.starts();
        let start = self.with_model(&starts[0]);
        let rate = |camera: &Camera| worst_px(&check, |p| camera.project(p));
        if let Some(worst_px) = rate(&start)
            && worst_px <= EXACT_PX
        {
            start.validate()?;
            return Ok(Conversion {
                camera: start,
                exact: true,
                worst_px,
                covered: check.covered,
            });
        }
        let train = take(FIT_GRID);
        let mut best: Option<(f64, Camera)> = None;
        for model in starts {
            let found = self.fit_cahv(&train, &model);
            if let Some(camera) = found
                && let Some(worst) = rate(&camera)
                && best.as_ref().is_none_or(|(least, _)| worst < *least)
            {
                best = Some((worst, camera));
            }
            if best.as_ref().is_some_and(|(w, _)| *w <= rules.limit_px) {
                break;
            }
        }
        let (worst_px, camera) = best.ok_or_else(|| self.out_of_reach(&check))?;
        accept(camera, worst_px, check.covered, rules)
    }

    fn out_of_reach(&self, check: &Samples) -> ConversionError {
        let widest = check
            .seen
            .iter()
            .map(|(point, _)| {
                self.frame_from_camera
                    .inverse_transform_point(&(*point).into())
                    .coords
            })
            .map(|d| d.xy().norm().atan2(d.z))
            .fold(0.0, f64::max);
        ConversionError::OutOfReach {
            off_axis_deg: widest.to_degrees(),
        }
    }

    /// The distortion terms of the CAHV family that come nearest, and others to try.
    fn starts(&self) -> Vec<Terms> {
        match self.lens {
            Lens::Polynomial { k, p } => {
                let r = [0.0, k[0] - k[3], k[1] - k[4]];
                let plain = self.lens == Lens::NONE;
                // To first order a tilt of O by -p / k1 makes the tangential terms.
                let tilt = |p: f64| {
                    let tilt = -p / r[1];
                    if tilt.is_finite() {
                        tilt.clamp(-0.05, 0.05)
                    } else {
                        0.0
                    }
                };
                vec![
                    Terms {
                        axis: [0.0; 2],
                        r,
                        linearity: None,
                        distorted: !plain,
                    },
                    Terms {
                        axis: [tilt(p[1]), tilt(p[0])],
                        r,
                        linearity: None,
                        distorted: true,
                    },
                    Terms {
                        axis: [0.0; 2],
                        r,
                        linearity: Some(0.9),
                        distorted: true,
                    },
                ]
            }
            Lens::Equidistant { k } => {
                let r = [0.0, k[0], k[1]];
                let terms = |linearity| Terms {
                    axis: [0.0; 2],
                    r,
                    linearity: Some(linearity),
                    distorted: true,
                };
                vec![terms(0.0), terms(0.3)]
            }
        }
    }

    fn with_model(&self, terms: &Terms) -> Camera {
        terms.camera(
            &self.frame_from_camera,
            self.focal_px,
            self.centre_px,
            self.size_px,
        )
    }

    /// Parameters: turn (3), fx, fy, cx, cy, O (2), r1, r2, and the linearity if it is free.
    fn fit_cahv(&self, train: &Samples, terms: &Terms) -> Option<Camera> {
        let free = terms.linearity.filter(|l| *l != 0.0);
        let mut start = vec![0.0; 3];
        start.extend(self.focal_px);
        start.extend(self.centre_px);
        start.extend(terms.axis);
        start.extend(&terms.r[1..]);
        start.extend(free.map(f64::atanh));
        let mut steps = vec![1e-6; start.len()];
        steps[3..7].fill(1e-3);
        let build = |x: &DVector<f64>| {
            let x = x.as_slice();
            let pose = nudged(&self.frame_from_camera, &[x[0], x[1], x[2], 0.0, 0.0, 0.0]);
            let moved = Terms {
                axis: [x[7], x[8]],
                r: [0.0, x[9], x[10]],
                linearity: terms.linearity.map(|l| x.get(11).map_or(l, |w| w.tanh())),
                distorted: terms.distorted,
            };
            let camera = moved.camera(&pose, [x[3], x[4]], [x[5], x[6]], self.size_px);
            camera.validate().is_ok().then_some(camera)
        };
        fit(
            train,
            DVector::from_vec(start),
            DVector::from_vec(steps),
            &build,
            &|camera, p| camera.project(p),
        )
    }

    /// A camera of the CAHV family as a pinhole camera with the best of the lens models in
    /// `families`; the first that is exact, otherwise the one with the least worst error.
    ///
    /// # Errors
    /// [`ConversionError`].
    pub fn from_camera(
        camera: &Camera,
        families: &[Family],
        rules: &ConversionRules,
    ) -> Result<Conversion<LensCamera>, ConversionError> {
        camera.validate()?;
        let camera = camera.with_unit_axes()?;
        let size_px = [camera.width_px, camera.height_px];
        let moving = matches!(&camera.model, CameraModel::Cahvore(m) if m.e != Vector3::zeros());
        let ranges_m: Vec<f64> = if moving {
            [1.0, 2.0, 10.0, 1000.0].map(|n| n * rules.near_m).into()
        } else {
            vec![1.0]
        };
        let take = |grid| samples(size_px, grid, &ranges_m, |pixel| camera.ray(pixel));
        let (check, train) = (take(CHECK_GRID), take(FIT_GRID));
        if check.covered < MIN_COVERED {
            return Err(ConversionError::NotCovered {
                covered: check.covered,
            });
        }
        let mut best: Option<(f64, LensCamera)> = None;
        for family in families {
            let start = start_of(&camera, *family);
            let rate = |lens: &LensCamera| worst_px(&check, |p| lens.project(p));
            let fitted = match rate(&start) {
                Some(worst) if worst <= EXACT_PX => Some(start.clone()),
                _ => fit_lens(&train, &start, *family, moving),
            };
            if let Some(lens) = fitted
                && let Some(worst) = rate(&lens)
                && best.as_ref().is_none_or(|(least, _)| worst < *least)
            {
                best = Some((worst, lens));
            }
            if best.as_ref().is_some_and(|(worst, _)| *worst <= EXACT_PX) {
                break;
            }
        }
        let (worst_px, lens) = best.ok_or_else(|| {
            let [c, a, ..] = camera.model.cahv();
            let widest = check.seen.iter().map(|(p, _)| (p - c).angle(a));
            ConversionError::OutOfReach {
                off_axis_deg: widest.fold(0.0, f64::max).to_degrees(),
            }
        })?;
        accept(lens, worst_px, check.covered, rules)
    }
}

fn accept<T>(
    camera: T,
    worst_px: f64,
    covered: f64,
    rules: &ConversionRules,
) -> Result<Conversion<T>, ConversionError> {
    if worst_px <= rules.limit_px {
        Ok(Conversion {
            camera,
            exact: worst_px <= EXACT_PX,
            worst_px,
            covered,
        })
    } else {
        Err(ConversionError::TooFar {
            worst_px,
            limit_px: rules.limit_px,
        })
    }
}

/// The distortion terms of a camera of the CAHV family.
struct Terms {
    /// x and y of O in the camera's axes, per unit along z.
    axis: [f64; 2],
    r: [f64; 3],
    linearity: Option<f64>,
    distorted: bool,
}

impl Terms {
    fn camera(
        &self,
        pose: &Isometry3<f64>,
        focal_px: [f64; 2],
        centre_px: [f64; 2],
        size_px: [u32; 2],
    ) -> Camera {
        let plain = Camera::pinhole(pose, focal_px, centre_px, size_px);
        let CameraModel::Cahv(Cahv { c, a, h, v }) = plain.model else {
            return plain;
        };
        if !self.distorted {
            return plain;
        }
        let axis = Vector3::new(self.axis[0], self.axis[1], 1.0).normalize();
        let (o, r) = (pose.rotation * axis, self.r.into());
        let model = match self.linearity {
            None => CameraModel::Cahvor(Cahvor { c, a, h, v, o, r }),
            Some(linearity) => CameraModel::Cahvore(Cahvore {
                c,
                a,
                h,
                v,
                o,
                r,
                e: Vector3::zeros(),
                linearity,
            }),
        };
        Camera { model, ..plain }
    }
}

/// The pinhole camera that the formulas give for a model with unit axes.
fn start_of(camera: &Camera, family: Family) -> LensCamera {
    let terms = camera.intrinsics();
    let rotation = UnitQuaternion::from_rotation_matrix(&terms.camera_from_model.inverse());
    let r = camera.model.lens().map_or(Vector3::zeros(), |[_, r]| *r);
    let stretch = 1.0 + r.x;
    let (r1, r2) = (r.y / stretch, r.z / stretch);
    // tan(L t) / L = t (1 + L^2 t^2 / 3 + 2 L^4 t^4 / 15 + ...), sin(L t) / L = t (1 - ...).
    let l = match &camera.model {
        CameraModel::Cahvore(m) => m.linearity,
        _ => 1.0,
    };
    let l2 = l * l;
    let lens = if family == Family::Equidistant {
        let k = if l == 0.0 {
            [r1, r2, 0.0, 0.0]
        } else if l > 0.0 {
            [l2 / 3.0 + r1, 2.0 * l2 * l2 / 15.0 + r1 + r2, 0.0, 0.0]
        } else {
            [-l2 / 6.0 + r1, r2, 0.0, 0.0]
        };
        Lens::Equidistant { k }
    } else if matches!(camera.model, CameraModel::Cahvore(_)) && l < 1.0 {
        // An angle narrower than its tangent, by (1 + t^2 / 3)^-1 and its like.
        let bend = (1.0 - l2) / 3.0;
        let k = if family == Family::Rational {
            [0.0, 0.0, 0.0, bend, 0.0, 0.0]
        } else {
            [0.0; 6]
        };
        Lens::Polynomial { k, p: [0.0; 2] }
    } else {
        Lens::Polynomial {
            k: [r1, r2, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        }
    };
    LensCamera {
        frame_from_camera: Isometry3::from_parts(Translation3::from(terms.position), rotation),
        focal_px: [terms.hs * stretch, terms.vs * stretch],
        centre_px: [terms.hc, terms.vc],
        size_px: [camera.width_px, camera.height_px],
        lens,
    }
}

/// Parameters: turn and shift (6; a shift only for a moving pupil), fx, fy, cx, cy, coefficients.
fn fit_lens(
    train: &Samples,
    start: &LensCamera,
    family: Family,
    moving: bool,
) -> Option<LensCamera> {
    let mut x0 = vec![0.0; if moving { 6 } else { 3 }];
    let pose_n = x0.len();
    x0.extend(start.focal_px);
    x0.extend(start.centre_px);
    match (&start.lens, family) {
        (Lens::Equidistant { k }, _) => x0.extend(k),
        (Lens::Polynomial { k, .. }, Family::Rational) => {
            x0.extend([k[0], k[1], 0.0, 0.0]);
            x0.extend(&k[2..]);
        }
        (Lens::Polynomial { k, .. }, Family::PlumbBob) => {
            x0.extend([k[0], k[1], 0.0, 0.0, 0.0]);
        }
        (Lens::Polynomial { k, .. }, _) => x0.extend([k[0], k[1], 0.0, 0.0]),
    }
    let mut steps = vec![1e-6; x0.len()];
    steps[pose_n..pose_n + 4].fill(1e-3);
    let build = |x: &DVector<f64>| {
        let (pose, rest) = x.as_slice().split_at(pose_n);
        let mut by = [0.0; 6];
        by[..pose_n].copy_from_slice(pose);
        let c = &rest[4..];
        let at = |i: usize| c.get(i).copied().unwrap_or(0.0);
        let lens = match start.lens {
            Lens::Equidistant { .. } => Lens::Equidistant {
                k: [at(0), at(1), at(2), at(3)],
            },
            Lens::Polynomial { .. } => Lens::Polynomial {
                k: [at(0), at(1), at(4), at(5), at(6), at(7)],
                p: [at(2), at(3)],
            },
        };
        let camera = LensCamera {
            frame_from_camera: nudged(&start.frame_from_camera, &by),
            focal_px: [rest[0], rest[1]],
            centre_px: [rest[2], rest[3]],
            size_px: start.size_px,
            lens,
        };
        camera.validate().is_ok().then_some(camera)
    };
    fit(
        train,
        DVector::from_vec(x0),
        DVector::from_vec(steps),
        &build,
        &|camera, p| camera.project(p),
    )
}
