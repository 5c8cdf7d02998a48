//! Camera-space manipulation: one simple map from the arm's coordinates to each image, made right
//! where the target is (Skaar, Brockman and Hanson 1987), and its linear variant.

use crate::{
    Method, MethodError, Reference, Sample, Setup,
    hips::STRAIN_PX_M,
    linear::{least_squares, solve_scaled},
    setup::finite,
};
use nalgebra::{
    DMatrix, DVector, Matrix3, Matrix6, Quaternion, RowVector6, UnitQuaternion, Vector2, Vector3,
    Vector4, Vector6,
};
use rover_cameras::Camera;
use std::sync::Arc;

/// Prior of the four quaternion components, per degree of the error level.
const PRIOR_C: f64 = 0.5;
/// Prior of the two offsets, px per degree of the error level.
const PRIOR_PX: f64 = 25.0;
/// Gauss-Newton steps of one fit, each after moving the origin onto the target.
const STEPS: usize = 4;

/// A sighting: predicted fiducial, rover frame, m, and its pixels.
type Sighting = (Vector3<f64>, [Vector2<f64>; 2]);

/// The six view parameters of one camera: `(u, v) (1 + r3.x / Z0) = (r1.x + C5, r2.x + C6)`, x
/// from the target, pixels from the principal point with the believed distortion removed. The
/// factor flattens perspective; it stands in the residual and in its derivative.
#[derive(Clone, Copy, Debug)]
struct View {
    c: Vector6<f64>,
    start: Vector6<f64>,
    depth_m: f64,
}

/// Pixel relative to the principal point, distortion removed.
fn flat_pixel(camera: &Camera, pixel: &Vector2<f64>) -> Result<Vector2<f64>, MethodError> {
    let d = *camera.ray(pixel)?.direction;
    let [_, a, h, v] = camera.model.cahv();
    let range = d.dot(a);
    Ok(Vector2::new(
        d.dot(h) / range - a.dot(h),
        d.dot(v) / range - a.dot(v),
    ))
}

/// Rows r1, r2 and the not normalised r3 of the quaternion.
fn rows(c: &Vector6<f64>) -> [Vector3<f64>; 3] {
    let (a, b, d, e) = (c[0], c[1], c[2], c[3]);
    let two = |x: f64| 2.0 * x;
    [
        Vector3::new(
            a * a + b * b - d * d - e * e,
            two(b * d + a * e),
            two(b * e - a * d),
        ),
        Vector3::new(
            two(b * d - a * e),
            a * a - b * b + d * d - e * e,
            two(d * e + a * b),
        ),
        Vector3::new(
            two(b * e + a * d),
            two(d * e - a * b),
            a * a - b * b - d * d + e * e,
        ),
    ]
}

/// Derivatives of `row . x` by the four components, for each row.
fn row_derivatives(c: &Vector6<f64>, x: &Vector3<f64>) -> [Vector4<f64>; 3] {
    let (a, b, d, e) = (c[0], c[1], c[2], c[3]);
    let (x, y, z) = (x.x, x.y, x.z);
    [
        Vector4::new(
            a * x + e * y - d * z,
            b * x + d * y + e * z,
            -d * x + b * y - a * z,
            -e * x + a * y + b * z,
        ) * 2.0,
        Vector4::new(
            -e * x + a * y + b * z,
            d * x - b * y + a * z,
            b * x + d * y + e * z,
            -a * x - e * y + d * z,
        ) * 2.0,
        Vector4::new(
            d * x - b * y + a * z,
            e * x - a * y - b * z,
            a * x + e * y - d * z,
            b * x + d * y + e * z,
        ) * 2.0,
    ]
}

impl View {
    /// The believed camera as a view of `target`.
    fn believed(camera: &Camera, target: &Vector3<f64>) -> Result<Self, MethodError> {
        let [c, a, h, v] = camera.model.cahv();
        let (x, y) = (h - a * a.dot(h), v - a * a.dot(v));
        let focal_px = x.norm();
        let depth_m = (target - c).dot(a);
        // Rows of the view are those of the camera's rotation, so the quaternion is that of its
        // transpose.
        let axes = Matrix3::from_columns(&[x.normalize(), y.normalize(), *a]);
        let q: Quaternion<f64> = *UnitQuaternion::from_matrix(&axes);
        let scale = (focal_px / depth_m).sqrt();
        let pixel = flat_pixel(camera, &camera.project(target)?)?;
        let start = Vector6::new(
            scale * q.w,
            scale * q.i,
            scale * q.j,
            scale * q.k,
            pixel.x,
            pixel.y,
        );
        Ok(Self {
            c: start,
            start,
            depth_m,
        })
    }

    /// Coefficients of x in `r1.x - u r3.x / Z0` and `r2.x - v r3.x / Z0`.
    fn equations(&self, pixel: &Vector2<f64>) -> [Vector3<f64>; 2] {
        let [r1, r2, r3] = rows(&self.c);
        let r3 = r3 / (self.c.fixed_rows::<4>(0).norm_squared() * self.depth_m);
        [r1 - r3 * pixel.x, r2 - r3 * pixel.y]
    }

    /// Residuals (u, then v) and their derivatives by the parameters, for `x` from the target.
    fn residuals(&self, x: &Vector3<f64>, pixel: &Vector2<f64>) -> [(f64, RowVector6<f64>); 2] {
        let [r1, r2, r3] = rows(&self.c);
        let [d1, d2, d3] = row_derivatives(&self.c, x);
        let c = self.c.fixed_rows::<4>(0).into_owned();
        let scale = c.norm_squared();
        let flatten = r3.dot(x) / (scale * self.depth_m);
        let d_flatten = (d3 - c * (2.0 * r3.dot(x) / scale)) / (scale * self.depth_m);
        let one = |observed: f64, row: Vector3<f64>, by_row: Vector4<f64>, offset: usize| {
            let residual = observed * (1.0 + flatten) - row.dot(x) - self.c[offset];
            // Derivative of what is subtracted from the observation.
            let by_c = by_row - d_flatten * observed;
            let mut derivative = RowVector6::zeros();
            derivative
                .fixed_columns_mut::<4>(0)
                .copy_from(&by_c.transpose());
            derivative[offset] = 1.0;
            (residual, derivative)
        };
        [one(pixel.x, r1, d1, 4), one(pixel.y, r2, d2, 5)]
    }
}

/// Standard deviations of the sightings for a target in the arm's coordinates.
fn sigmas(setup: &Setup, sightings: &[Sighting], target: &Vector3<f64>) -> Vec<f64> {
    let strain = STRAIN_PX_M * setup.level_deg();
    let sigma = |s: &Sighting| setup.sigma_px().hypot(strain * (s.0 - target).norm());
    sightings.iter().map(sigma).collect()
}

/// The six-parameter method.
#[derive(Clone, Debug)]
pub struct CameraSpace {
    setup: Arc<Setup>,
    target: Reference,
    sightings: Vec<Sighting>,
    /// Origin of the views.
    origin: Vector3<f64>,
    /// Where the target is in the arm's coordinates, the origin of the next fit.
    estimate: Vector3<f64>,
    views: Option<[View; 2]>,
}

impl CameraSpace {
    /// Before any image: the believed cameras.
    pub fn new(setup: Arc<Setup>, target: Reference) -> Self {
        Self {
            origin: target.tip_in_rover,
            estimate: target.tip_in_rover,
            setup,
            target,
            sightings: Vec::new(),
            views: None,
        }
    }

    fn cameras(&self) -> [&Camera; 2] {
        [&self.setup.cameras.left, &self.setup.cameras.right]
    }

    /// The point, from the origin, that the views show where the believed cameras show `at`.
    fn solve(&self, views: &[View; 2], at: &Vector3<f64>) -> Result<Vector3<f64>, MethodError> {
        let mut normal = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for (view, camera) in views.iter().zip(self.cameras()) {
            let pixel = flat_pixel(camera, &camera.project(at)?)?;
            let offsets = [pixel.x - view.c[4], pixel.y - view.c[5]];
            for (row, offset) in view.equations(&pixel).iter().zip(offsets) {
                normal += row * row.transpose();
                right += row * offset;
            }
        }
        solve_scaled(&normal, &right, "camera space")
    }
}

impl Method for CameraSpace {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let [left, right] = self.cameras();
        let sighting = (
            self.setup.fiducial(&sample.joints_rad)?,
            [
                flat_pixel(left, &sample.left_px)?,
                flat_pixel(right, &sample.right_px)?,
            ],
        );
        let target = self.target.tip_in_rover;
        let mut views = match self.views {
            Some(views) => views,
            None => [
                View::believed(left, &target)?,
                View::believed(right, &target)?,
            ],
        };
        self.sightings.push(sighting);
        let level = self.setup.level_deg();
        let weights =
            Vector6::from_fn(|i, _| 1.0 / (if i < 4 { PRIOR_C } else { PRIOR_PX } * level).powi(2));
        let mut origin = self.estimate;
        let mut fitted_at = origin;
        for _ in 0..STEPS {
            let sigma = sigmas(&self.setup, &self.sightings, &origin);
            for (side, view) in views.iter_mut().enumerate() {
                let mut normal = Matrix6::from_diagonal(&weights);
                let mut gradient = weights.component_mul(&(view.start - view.c));
                for ((predicted, pixels), sigma) in self.sightings.iter().zip(&sigma) {
                    for (residual, by) in view.residuals(&(predicted - origin), &pixels[side]) {
                        let weighted = by.transpose() / (sigma * sigma);
                        normal += weighted * by;
                        gradient += weighted * residual;
                    }
                }
                view.c += solve_scaled(&normal, &gradient, "camera space")?;
            }
            fitted_at = origin;
            origin = finite(origin + self.solve(&views, &target)?)?;
        }
        (self.origin, self.estimate) = (fitted_at, origin);
        self.views = Some(views);
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        match &self.views {
            None => finite(reference.tip_in_rover),
            Some(views) => finite(self.origin + self.solve(views, &reference.tip_in_rover)?),
        }
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of_val(self.sightings.as_slice()) + size_of::<[View; 2]>() + 48
    }
}

/// Sightings below which eleven parameters are not determined.
const LEAST_SIGHTINGS: usize = 6;

/// The linear method: eleven parameters of a direct linear transform per camera.
#[derive(Clone, Debug)]
pub struct LinearCameraSpace {
    setup: Arc<Setup>,
    target: Reference,
    sightings: Vec<Sighting>,
    fitted: Option<Fitted>,
}

/// Parameters in normalised coordinates.
#[derive(Clone, Debug)]
struct Fitted {
    centre: Vector3<f64>,
    cameras: [(Vector2<f64>, DVector<f64>); 2],
}

/// Units of the normalised coordinates.
const UNIT_M: f64 = 0.1;
const UNIT_PX: f64 = 100.0;

impl Fitted {
    fn new(sightings: &[Sighting], sigma: &[f64]) -> Result<Self, MethodError> {
        let n = sightings.len();
        let centre = sightings.iter().map(|s| s.0).sum::<Vector3<f64>>() / n as f64;
        let fit = |side: usize| -> Result<(Vector2<f64>, DVector<f64>), MethodError> {
            let middle = sightings.iter().map(|s| s.1[side]).sum::<Vector2<f64>>() / n as f64;
            let mut a = DMatrix::zeros(2 * n, 11);
            let mut b = DVector::zeros(2 * n);
            for (k, ((p, pixels), sigma)) in sightings.iter().zip(sigma).enumerate() {
                let x = (p - centre) / UNIT_M;
                let u = (pixels[side] - middle) / UNIT_PX;
                let weight = 1.0 / sigma;
                for axis in 0..2 {
                    let row = 2 * k + axis;
                    let column = 4 * axis;
                    for i in 0..3 {
                        a[(row, column + i)] = x[i] * weight;
                        a[(row, 8 + i)] = -u[axis] * x[i] * weight;
                    }
                    a[(row, column + 3)] = weight;
                    b[row] = u[axis] * weight;
                }
            }
            Ok((middle, least_squares(a, &b, "direct linear transform")?))
        };
        Ok(Self {
            centre,
            cameras: [fit(0)?, fit(1)?],
        })
    }

    /// The point that both transforms show at these pixels.
    fn triangulate(&self, pixels: &[Vector2<f64>; 2]) -> Result<Vector3<f64>, MethodError> {
        let mut normal = Matrix3::zeros();
        let mut right = Vector3::zeros();
        for ((middle, a), pixel) in self.cameras.iter().zip(pixels) {
            let u = (pixel - middle) / UNIT_PX;
            for axis in 0..2 {
                let c = 4 * axis;
                let row = Vector3::from_fn(|i, _| a[c + i] - a[8 + i] * u[axis]);
                normal += row * row.transpose();
                right += row * (u[axis] - a[c + 3]);
            }
        }
        let x = solve_scaled(&normal, &right, "linear triangulation")?;
        finite(self.centre + x * UNIT_M)
    }
}

impl LinearCameraSpace {
    /// Before any image: kinematics alone.
    pub fn new(setup: Arc<Setup>, target: Reference) -> Self {
        Self {
            setup,
            target,
            sightings: Vec::new(),
            fitted: None,
        }
    }

    fn pixels(&self, at: &Vector3<f64>) -> Result<[Vector2<f64>; 2], MethodError> {
        let cameras = &self.setup.cameras;
        Ok([cameras.left.project(at)?, cameras.right.project(at)?])
    }
}

impl Method for LinearCameraSpace {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        self.sightings.push((
            self.setup.fiducial(&sample.joints_rad)?,
            [sample.left_px, sample.right_px],
        ));
        if self.sightings.len() < LEAST_SIGHTINGS {
            return Ok(());
        }
        let pixels = self.pixels(&self.target.tip_in_rover)?;
        let mut target = self.target.tip_in_rover;
        for _ in 0..3 {
            let sigma = sigmas(&self.setup, &self.sightings, &target);
            let fitted = Fitted::new(&self.sightings, &sigma)?;
            target = fitted.triangulate(&pixels)?;
            self.fitted = Some(fitted);
        }
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        match &self.fitted {
            None => finite(reference.tip_in_rover),
            Some(fitted) => fitted.triangulate(&self.pixels(&reference.tip_in_rover)?),
        }
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of_val(self.sightings.as_slice()) + 8 * (3 + 2 * (2 + 11))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::tests::setup;

    /// The pixel that the six numbers show at `x` from the origin, by the definition of the view:
    /// `u (1 + r3.x / Z0) = r1.x + C5`, with the rows of the quaternion's rotation matrix.
    fn shown(c: &Vector6<f64>, depth_m: f64, x: &Vector3<f64>) -> Vector2<f64> {
        let q = Quaternion::new(c[0], -c[1], -c[2], -c[3]);
        let scale = q.norm_squared();
        let rotated = *UnitQuaternion::new_normalize(q)
            .to_rotation_matrix()
            .matrix()
            * x;
        let flatten = 1.0 + rotated.z / depth_m;
        Vector2::new(
            (scale * rotated.x + c[4]) / flatten,
            (scale * rotated.y + c[5]) / flatten,
        )
    }

    fn view() -> (View, Vector3<f64>) {
        let setup = setup(0.13);
        let target = Vector3::new(0.5, 0.05, 0.2);
        let mut view = View::believed(&setup.cameras.left, &target).unwrap();
        view.c += Vector6::new(0.4, -0.3, 0.5, 0.2, 3.0, -5.0);
        (view, Vector3::new(0.03, -0.05, -0.12))
    }

    #[test]
    fn a_pixel_that_the_view_itself_shows_leaves_no_residual() {
        let (view, x) = view();
        let pixel = shown(&view.c, view.depth_m, &x);
        let [(u, _), (v, _)] = view.residuals(&x, &pixel);
        assert!(u.abs() < 1e-9 && v.abs() < 1e-9, "{u} {v}");
    }

    #[test]
    fn the_believed_view_agrees_with_the_believed_camera() {
        let setup = setup(0.13);
        for camera in [&setup.cameras.left, &setup.cameras.right] {
            let target = Vector3::new(0.5, 0.05, 0.2);
            let view = View::believed(camera, &target).unwrap();
            for x in [Vector3::zeros(), Vector3::new(0.04, -0.06, -0.1)] {
                let expected = flat_pixel(camera, &camera.project(&(target + x)).unwrap()).unwrap();
                let apart = (shown(&view.c, view.depth_m, &x) - expected).norm();
                assert!(apart < 1e-6, "{apart} px at {x:?}");
            }
        }
    }

    #[test]
    fn the_residuals_derivative_is_that_of_finite_differences() {
        const STEP: f64 = 1e-6;
        let (view, x) = view();
        let pixel = Vector2::new(31.0, -17.0);
        let derivatives = view.residuals(&x, &pixel).map(|r| r.1);
        for k in 0..6 {
            let moved = |step: f64| {
                let mut c = view;
                c.c[k] += step;
                c.residuals(&x, &pixel).map(|r| r.0)
            };
            let (plus, minus) = (moved(STEP), moved(-STEP));
            for row in 0..2 {
                // What is differentiated is subtracted from the observation.
                let numeric = -(plus[row] - minus[row]) / (2.0 * STEP);
                let apart = (derivatives[row][k] - numeric).abs();
                assert!(
                    apart < 1e-5 * (1.0 + numeric.abs()),
                    "row {row}, number {k}: {apart}"
                );
            }
        }
    }
}
