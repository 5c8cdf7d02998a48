//! From the CAHV family to pinhole cameras with a lens of OpenCV, and back.
//!
//! What both can express is carried over by formula: a lens whose only coefficients are k1 and k2
//! is CAHVOR with `O = A`, `R = (0, k1, k2)`; an equidistant one with only k1 and k2 is CAHVORE
//! with linearity 0, `E = 0` and the same R; and back with `f = (1 + r0) hs`, `k = r / (1 + r0)`.
//! Everything else is fitted over a grid of pixels, first by least squares, then so that the worst
//! pixel is as good as it can be ([`super::fit`]), and the worst error over a finer grid is
//! reported: of the original's rays imaged by the result, and of the result's rays imaged by the
//! original. A moving pupil makes that error depend on range: it is fitted and checked from the
//! nearest range of the rules to a thousand times that.

use super::fit::{Fitting, Samples, back_px, nudged, samples, worst_px};
use super::lens::{Lens, LensCamera};
use super::lens_fit::{Family, lens_fitting, lens_start, start_of};
use crate::error::Short;
use crate::radial::Radial;
use crate::{Cahv, Cahvor, Cahvore, Camera, CameraError, CameraModel};
use nalgebra::{DVector, Isometry3, Matrix3, Vector3};
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

/// A converted camera and how well it stands for the original.
#[derive(Clone, Debug, PartialEq)]
pub struct Conversion<T> {
    /// The camera.
    pub camera: T,
    /// Whether the two are the same function (to 1e-9 px).
    pub exact: bool,
    /// Largest distance between the two over the image, px: of a ray of the original imaged by the
    /// result from its pixel, and of a ray of the result imaged by the original.
    pub worst_px: f64,
    /// Share of the image in which the original has rays at all; only there were they compared.
    pub covered: f64,
}

/// Why a camera cannot be converted.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ConversionError {
    /// The best fit is not good enough.
    #[error(
        "{target} cannot express this camera: the best fit is {} px off at worst, expected at most \
         {} px",
        Short(*worst_px), Short(*limit_px)
    )]
    TooFar {
        /// The models that were fitted.
        target: String,
        /// Worst error of the best fit, px.
        worst_px: f64,
        /// The largest accepted, px.
        limit_px: f64,
    },
    /// No fit could be begun.
    #[error(
        "{target} cannot image all rays of this camera (up to {} deg from its axis)",
        Short(*off_axis_deg)
    )]
    OutOfReach {
        /// The models that were tried.
        target: String,
        /// The widest angle from A of the camera's rays, degrees.
        off_axis_deg: f64,
    },
    /// The camera has rays only in a small part of its image.
    #[error(
        "the model has rays in only {:.1} % of its image, expected at least {:.0} %",
        100.0 * covered, 100.0 * MIN_COVERED
    )]
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
        let start = self.with_model(&self.formula());
        let forth = |camera: &Camera| worst_px(&check, |p| camera.project(p));
        if let Some(worst_px) = forth(&start)
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
        let rate = |camera: &Camera| {
            let back = back_px(&check, &[1.0], |p| camera.ray(p), |p| self.project(p));
            Some(forth(camera)?.max(back))
        };
        let train = take(FIT_GRID);
        let mut best: Option<(f64, Camera)> = None;
        for family in self.starts(&check) {
            // The best of several starts by least squares, then its worst pixel.
            let found = family
                .iter()
                .filter_map(|terms| self.fit_cahv(&train, terms))
                .filter_map(|(fitting, x)| {
                    let camera = (fitting.build)(&x)?;
                    let off = worst_px(&train, |p| camera.project(p))?;
                    Some((off, fitting, x))
                })
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, fitting, x)) = found else {
                continue;
            };
            let evened = fitting.even(&train, x.clone());
            for camera in [x, evened].iter().filter_map(|x| (fitting.build)(x)) {
                if let Some(worst) = rate(&camera)
                    && best.as_ref().is_none_or(|(least, _)| worst < *least)
                {
                    best = Some((worst, camera));
                }
            }
            if best.as_ref().is_some_and(|(w, _)| *w <= rules.limit_px) {
                break;
            }
        }
        let target = match self.lens {
            Lens::Polynomial { .. } => "CAHVOR or CAHVORE",
            Lens::Equidistant { .. } => "CAHVORE",
        };
        let (worst_px, camera) = best.ok_or_else(|| self.out_of_reach(target, &check))?;
        accept(target, camera, worst_px, check.covered, rules)
    }

    fn out_of_reach(&self, target: &str, check: &Samples) -> ConversionError {
        ConversionError::OutOfReach {
            target: target.to_owned(),
            off_axis_deg: self
                .tangents(check)
                .map(f64::atan)
                .fold(0.0, f64::max)
                .to_degrees(),
        }
    }

    /// Tangents of the angles from the axis of all samples; infinite from 90 degrees on.
    fn tangents<'a>(&'a self, check: &'a Samples) -> impl Iterator<Item = f64> + 'a {
        check.seen.iter().map(|(point, _)| {
            let d = self
                .frame_from_camera
                .inverse_transform_point(&(*point).into())
                .coords;
            if d.z > 0.0 {
                d.xy().norm() / d.z
            } else {
                f64::INFINITY
            }
        })
    }

    /// What the formulas give: exact for a lens whose only coefficients are k1 and k2.
    fn formula(&self) -> Terms {
        let (r, linearity) = match &self.lens {
            Lens::Polynomial { k, .. } => ([0.0, k[0] - k[3], k[1] - k[4]], None),
            Lens::Equidistant { k } => ([0.0, k[0], k[1]], Some(0.0)),
        };
        Terms {
            stretch: 1.0,
            axis: [0.0; 2],
            r,
            linearity,
            distorted: self.lens != Lens::NONE,
        }
    }

    /// Distortion terms to begin with: CAHVOR, then CAHVORE.
    fn starts(&self, check: &Samples) -> Vec<Vec<Terms>> {
        let widest = self.tangents(check).fold(0.0, f64::max);
        let terms = |stretch, axis, r, linearity| Terms {
            stretch,
            axis,
            r,
            linearity,
            distorted: true,
        };
        match self.lens {
            Lens::Polynomial { k, p } => {
                let profile = |linearity: Option<f64>, n| {
                    let angle = |t: f64| linearity.map_or(t, |l| (l * t.atan()).tan() / l);
                    self.profile(widest, n, &angle).map(|(stretch, r)| {
                        // To first order a tilt of O by -p / k1 makes the tangential terms.
                        let r1 = k[0] - k[3];
                        let tilt = |p: f64| {
                            let tilt = -p / r1;
                            tilt.is_finite().then(|| tilt.clamp(-0.05, 0.05))
                        };
                        let tilted = tilt(p[1]).zip(tilt(p[0])).map(|(x, y)| [x, y]);
                        [Some([0.0; 2]), tilted]
                            .into_iter()
                            .flatten()
                            .map(|axis| terms(stretch, axis, r, linearity))
                            .collect::<Vec<_>>()
                    })
                };
                let of = |linearity| {
                    let mut all: Vec<Terms> = [2, 1]
                        .into_iter()
                        .filter_map(|n| profile(linearity, n))
                        .flatten()
                        .collect();
                    all.push(terms(1.0, [0.0; 2], [0.0; 3], linearity));
                    all
                };
                vec![of(None), of(Some(0.9))]
            }
            Lens::Equidistant { k } => {
                let r = [0.0, k[0], k[1]];
                [0.0, 0.3]
                    .map(|linearity| {
                        [r, [0.0; 3]]
                            .map(|r| terms(1.0, [0.0; 2], r, Some(linearity)))
                            .into()
                    })
                    .into()
            }
        }
    }

    /// The stretch of the focal length and R with `n` coefficients (r1, r2) that come nearest to
    /// the radial part of the lens up to the tangent `widest`, over the tangent that `angle` makes
    /// of it: linear least squares. `None` if they do not rise all the way.
    fn profile(
        &self,
        widest: f64,
        n: usize,
        angle: &dyn Fn(f64) -> f64,
    ) -> Option<(f64, [f64; 3])> {
        const STEPS: u32 = 64;
        if !widest.is_finite() {
            return None;
        }
        let (mut gram, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for step in 1..=STEPS {
            let t = widest * f64::from(step) / f64::from(STEPS);
            let x = angle(t);
            let image = self.lens.radial(t);
            let powers = [x, x.powi(3), x.powi(5)];
            let row = Vector3::from_fn(|i, _| if i <= n { powers[i] } else { 0.0 });
            gram += row * row.transpose();
            right += row * image;
        }
        for i in n + 1..3 {
            gram[(i, i)] = 1.0;
        }
        let [s, a, b]: [f64; 3] = gram.cholesky()?.solve(&right).into();
        let r = Vector3::new(0.0, a / s, b / s);
        let far = angle(widest);
        let rises = s > 0.0 && Radial(&r).is_one_to_one(far * far);
        rises.then(|| (s, r.into()))
    }

    fn with_model(&self, terms: &Terms) -> Camera {
        terms.camera(
            &self.frame_from_camera,
            self.focal_px.map(|f| f * terms.stretch),
            self.centre_px,
            self.size_px,
        )
    }

    /// Parameters: turn (3), fx, fy, cx, cy, O (2), r1, r2, and the linearity if it is free.
    fn fit_cahv<'a>(
        &'a self,
        train: &Samples,
        terms: &'a Terms,
    ) -> Option<(Fitting<'a, Camera>, DVector<f64>)> {
        let free = terms.linearity.filter(|l| *l != 0.0);
        let mut start = vec![0.0; 3];
        start.extend(self.focal_px.map(|f| f * terms.stretch));
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
                ..*terms
            };
            let camera = moved.camera(&pose, [x[3], x[4]], [x[5], x[6]], self.size_px);
            camera.validate().is_ok().then_some(camera)
        };
        let fitting = Fitting {
            steps: DVector::from_vec(steps),
            build: Box::new(build),
            project: Camera::project,
        };
        let x = fitting.least_squares(train, DVector::from_vec(start))?;
        Some((fitting, x))
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
        let target = Family::names(families);
        let mut best: Option<(f64, LensCamera)> = None;
        for family in families {
            let start = start_of(&camera, *family);
            let forth = |lens: &LensCamera| worst_px(&check, |p| lens.project(p));
            if let Some(worst_px) = forth(&start)
                && worst_px <= EXACT_PX
            {
                best = Some((worst_px, start));
                break;
            }
            let rate = |lens: &LensCamera| {
                let back = back_px(&check, &ranges_m, |p| lens.ray(p), |p| camera.project(p));
                Some(forth(lens)?.max(back))
            };
            let fitting = lens_fitting(&start, *family, moving);
            let Some(x) = fitting.least_squares(&train, lens_start(&start, *family, moving)) else {
                continue;
            };
            let evened = fitting.even(&train, x.clone());
            for lens in [x, evened].iter().filter_map(|x| (fitting.build)(x)) {
                if let Some(worst) = rate(&lens)
                    && best.as_ref().is_none_or(|(least, _)| worst < *least)
                {
                    best = Some((worst, lens));
                }
            }
        }
        let (worst_px, lens) = best.ok_or_else(|| {
            let [c, a, ..] = camera.model.cahv();
            let widest = check.seen.iter().map(|(p, _)| (p - c).angle(a));
            ConversionError::OutOfReach {
                target: target.clone(),
                off_axis_deg: widest.fold(0.0, f64::max).to_degrees(),
            }
        })?;
        accept(&target, lens, worst_px, check.covered, rules)
    }
}

fn accept<T>(
    target: &str,
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
            target: target.to_owned(),
            worst_px,
            limit_px: rules.limit_px,
        })
    }
}

/// The distortion terms of a camera of the CAHV family.
#[derive(Clone, Copy)]
struct Terms {
    /// Factor of the focal lengths.
    stretch: f64,
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
