//! Fitting one camera model to another: samples of the one's rays, least squares, and then the
//! fit whose worst pixel is as good as it can be.
//!
//! The minimax fit is reached by least powers: the sum of the p-th powers of the pixel errors is
//! minimised for p = 4, 8, ... 128, each from the last (G. Polya's algorithm; M. R. Osborne,
//! "Finite Algorithms in Optimization and Data Analysis", 1985, chapter 4), with Newton steps that
//! have the exact curvature of the power and the Gauss-Newton one of the model.

use crate::least_squares::{Differenced, Normal, Problem, minimise};
use crate::{CameraError, Ray};
use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix2, Translation3, UnitQuaternion, Vector2, Vector3,
};

const ITERATIONS: u32 = 200;
/// Iterations at each power.
const POWER_ITERATIONS: u32 = 25;
/// With 475 samples the worst error of the last power is at most 475^(1/128), 5 %, from the least.
const POWERS: [i32; 6] = [4, 8, 16, 32, 64, 128];

/// Points on the original's rays and where it sees them.
pub(super) struct Samples {
    pub(super) seen: Vec<(Vector3<f64>, Vector2<f64>)>,
    /// Share of the pixels that have a ray.
    pub(super) covered: f64,
}

/// Samples over a grid that reaches the borders of the image.
pub(super) fn samples(
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
pub(super) fn worst_px(
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

/// Largest pixel error the other way: rays of the result (`ray`), imaged by the original
/// (`project`). A ray that is beyond what the original images has no error there; its pixel was
/// compared the first way.
pub(super) fn back_px(
    samples: &Samples,
    ranges_m: &[f64],
    ray: impl Fn(&Vector2<f64>) -> Result<Ray, CameraError>,
    project: impl Fn(&Vector3<f64>) -> Result<Vector2<f64>, CameraError>,
) -> f64 {
    let mut worst = 0.0_f64;
    for of_pixel in samples.seen.chunk_by(|a, b| a.1 == b.1) {
        let Some((_, pixel)) = of_pixel.first() else {
            continue;
        };
        let Ok(ray) = ray(pixel) else {
            continue;
        };
        for range_m in ranges_m {
            if let Ok(image) = project(&ray.at(*range_m)) {
                worst = worst.max((image - pixel).norm());
            }
        }
    }
    worst
}

/// A pose turned and moved by six small numbers: angles (radians), then metres.
pub(super) fn nudged(pose: &Isometry3<f64>, by: &[f64]) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(by[0], by[1], by[2]));
    let shift = Vector3::new(by[3], by[4], by[5]);
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        pose.rotation * turn,
    )
}

/// A camera with parameters to be fitted.
pub(super) struct Fitting<'a, C> {
    /// Steps of the central differences.
    pub(super) steps: DVector<f64>,
    /// The camera of the parameters, if they make one.
    pub(super) build: Box<dyn Fn(&DVector<f64>) -> Option<C> + 'a>,
    pub(super) project: fn(&C, &Vector3<f64>) -> Result<Vector2<f64>, CameraError>,
}

impl<C> Fitting<'_, C> {
    /// Pixel errors of all samples, u and v in turn.
    fn errors(&self, samples: &Samples, x: &DVector<f64>) -> Option<DVector<f64>> {
        let camera = (self.build)(x)?;
        let mut r = DVector::zeros(2 * samples.seen.len());
        for (i, (point, pixel)) in samples.seen.iter().enumerate() {
            let error = (self.project)(&camera, point).ok()? - pixel;
            r[2 * i] = error.x;
            r[2 * i + 1] = error.y;
        }
        Some(r)
    }

    /// The parameters of least squared pixel error; `None` if `start` does not image all samples.
    pub(super) fn least_squares(
        &self,
        samples: &Samples,
        start: DVector<f64>,
    ) -> Option<DVector<f64>> {
        let problem = Differenced {
            residuals: |x: &DVector<f64>| self.errors(samples, x),
            steps: self.steps.clone(),
        };
        Some(minimise(&problem, start, ITERATIONS)?.state)
    }

    /// The parameters of least worst pixel error, near `start`.
    pub(super) fn even(&self, samples: &Samples, start: DVector<f64>) -> DVector<f64> {
        let worst_of = |x: &DVector<f64>| {
            let errors = self.errors(samples, x)?;
            Some((0..samples.seen.len()).fold(0.0_f64, |w, i| w.max(at(&errors, i).norm())))
        };
        let Some(mut worst) = worst_of(&start) else {
            return start;
        };
        let mut best = start;
        let mut x = best.clone();
        for power in POWERS {
            let problem = Powers {
                fitting: self,
                samples,
                power,
                scale: worst,
            };
            let Some(minimum) = minimise(&problem, x.clone(), POWER_ITERATIONS) else {
                break;
            };
            x = minimum.state;
            if let Some(found) = worst_of(&x)
                && found < worst
            {
                worst = found;
                best.clone_from(&x);
            }
        }
        best
    }
}

fn at(errors: &DVector<f64>, i: usize) -> Vector2<f64> {
    Vector2::new(errors[2 * i], errors[2 * i + 1])
}

/// The sum of the powers of the errors over `scale`, which is near their largest.
struct Powers<'a, 'b, C> {
    fitting: &'a Fitting<'b, C>,
    samples: &'a Samples,
    power: i32,
    scale: f64,
}

impl<C> Problem for Powers<'_, '_, C> {
    type State = DVector<f64>;

    fn cost(&self, x: &DVector<f64>) -> Option<f64> {
        let errors = self.fitting.errors(self.samples, x)?;
        let sum: f64 = (0..self.samples.seen.len())
            .map(|i| (at(&errors, i).norm() / self.scale).powi(self.power))
            .sum();
        Some(sum / f64::from(self.power))
    }

    fn normal(&self, x: &DVector<f64>) -> Option<Normal> {
        let n = x.len();
        let errors = self.fitting.errors(self.samples, x)?;
        let mut columns = Vec::with_capacity(n);
        for i in 0..n {
            let side = |sign: f64| {
                let mut moved = x.clone();
                moved[i] += sign * self.fitting.steps[i];
                self.fitting.errors(self.samples, &moved)
            };
            columns.push((side(1.0)? - side(-1.0)?) / (2.0 * self.fitting.steps[i] * self.scale));
        }
        let mut hessian = DMatrix::zeros(n, n);
        let mut gradient = DVector::zeros(n);
        let mut cost = 0.0;
        for i in 0..self.samples.seen.len() {
            let error = at(&errors, i) / self.scale;
            let length = error.norm();
            cost += length.powi(self.power) / f64::from(self.power);
            let weight = length.powi(self.power - 2);
            if !(weight > 1e-12) {
                continue;
            }
            let along = error / length;
            let bend = f64::from(self.power - 2);
            let curvature = (Matrix2::identity() + along * along.transpose() * bend) * weight;
            let slope = error * weight;
            for (a, column) in columns.iter().enumerate() {
                let own = at(column, i);
                gradient[a] += own.dot(&slope);
                let bent = curvature * own;
                for (b, other) in columns.iter().enumerate().take(a + 1) {
                    let value = bent.dot(&at(other, i));
                    hessian[(a, b)] += value;
                }
            }
        }
        hessian.fill_upper_triangle_with_lower_triangle();
        Some(Normal {
            hessian,
            gradient,
            cost,
        })
    }

    fn moved(&self, x: &DVector<f64>, step: &DVector<f64>) -> DVector<f64> {
        x + step
    }
}
