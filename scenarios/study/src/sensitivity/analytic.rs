//! The final error's mean square from Jacobians.
//!
//! With the error field `e(q) = J(q) phi` of a point of the last link, a vector seen at `q_l` of
//! the point `f` leaves at the target, to first order, `(J_tip(q_t) - J_f(q_l)) phi`. Where both
//! are the same that is nothing, and what remains is the change of J along the correction's own
//! motion, quadratic in phi: `phi' H phi` with the derivative of J along `-dq/dp J phi`. For normal
//! phi its mean square is `|sum H_ii|^2 + sum |H_ij|^2 + sum H_ij H_ji` in units of one sigma.
//! Camera errors act through the pixel: `S P kappa` with the triangulation's (or the plate pose's)
//! derivative S and the projection's P.

use super::{
    ANGLE_RAD, Bed, DETECTOR_PX, LENGTH_M, MATCH_PX, PER_CAMERA, Place, Seen, Source, TILT_RAD,
    WAYS, Way, failed, wrong_camera,
};
use crate::StudyError;
use nalgebra::{DMatrix, Matrix3x6, Matrix6, Matrix6xX, Point3, Vector2, Vector3};
use rover_compensation::Compensation;

/// Step of the central differences over camera numbers, in sigmas.
const STEP: f64 = 1e-3;

/// Mean squares, m^2: before, then for each way.
pub fn mean_squares(
    bed: &Bed,
    place: &Place,
    source: Source,
) -> Result<[f64; 1 + WAYS.len()], StudyError> {
    let at = At::new(bed, place)?;
    let before = square(&at.before(source)?);
    let mut out = [before; 1 + WAYS.len()];
    for (out, way) in out.iter_mut().skip(1).zip(WAYS) {
        *out = square(&at.after(source, way)?) + at.quadratic(source, way)?;
    }
    Ok(out)
}

/// Sum of the squares of the effects of independent standard normal numbers.
fn square(columns: &[Vector3<f64>]) -> f64 {
    columns.iter().map(Vector3::norm_squared).sum()
}

fn minus(a: Vec<Vector3<f64>>, b: Vec<Vector3<f64>>) -> Vec<Vector3<f64>> {
    a.into_iter().zip(b).map(|(a, b)| a - b).collect()
}

struct At<'a> {
    bed: &'a Bed,
    place: &'a Place,
    /// Derivative of the tip's pose by the 26 numbers, each in its sigma; zero for those that the
    /// robot's joints do not have.
    tip: Matrix6xX<f64>,
}

/// One number of arm or mount in its sigma.
fn sigma(index: usize, count: usize) -> f64 {
    let is_length = if index < count - 6 {
        matches!(index % 4, 1 | 2)
    } else {
        index >= count - 3
    };
    if is_length { LENGTH_M } else { ANGLE_RAD }
}

/// Whether a number of arm or mount belongs to a source.
fn belongs(source: Source, index: usize, count: usize) -> bool {
    source.has(if index >= count - 3 {
        Source::MountTranslation
    } else if index >= count - 6 {
        Source::MountRotation
    } else if matches!(index % 4, 1 | 2) {
        Source::ArmLengths
    } else {
        Source::ArmAngles
    })
}

/// Derivative of a point's pose by the 26 numbers in their sigmas.
fn scaled(bed: &Bed, q: &[f64], point: &Vector3<f64>) -> Result<Matrix6xX<f64>, StudyError> {
    let mut jacobian = bed.model.pose_jacobian(q, point)?;
    let n = jacobian.ncols();
    for (i, mut column) in jacobian.column_iter_mut().enumerate() {
        column *= sigma(i, n);
    }
    Ok(jacobian)
}

fn position(jacobian: &Matrix6xX<f64>, i: usize) -> Vector3<f64> {
    jacobian.fixed_view::<3, 1>(0, i).into_owned()
}

impl<'a> At<'a> {
    fn new(bed: &'a Bed, place: &'a Place) -> Result<Self, StudyError> {
        Ok(Self {
            tip: scaled(bed, &place.joints, &bed.model.tool.tip_in_link)?,
            bed,
            place,
        })
    }

    fn chosen(&self, source: Source, of: &Matrix6xX<f64>) -> Vec<Vector3<f64>> {
        let n = of.ncols();
        (0..n)
            .filter(|i| belongs(source, *i, n))
            .map(|i| position(of, i))
            .collect()
    }

    /// Effects without correction, one per number of the source.
    fn before(&self, source: Source) -> Result<Vec<Vector3<f64>>, StudyError> {
        let mut out = self.chosen(source, &self.tip);
        out.extend(self.by_cameras(source, &self.place.target)?);
        out.extend(self.target_only(source)?);
        if source.has(Source::Droop) {
            out.push(self.drooped(&self.place.joints, &self.bed.model.tool.tip_in_link)?);
        }
        Ok(out)
    }

    /// What enters through the target alone: no vector corrects it.
    fn target_only(&self, source: Source) -> Result<Vec<Vector3<f64>>, StudyError> {
        let mut out = Vec::new();
        if source.has(Source::Match) {
            out.extend(self.by_pixels(&self.place.target)?.map(|c| c * MATCH_PX));
        }
        if source.has(Source::BodyTilt) {
            let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
            out.extend(axes.map(|a| a.cross(&self.place.target) * TILT_RAD));
        }
        Ok(out)
    }

    /// Effects that remain after a correction.
    fn after(&self, source: Source, way: Way) -> Result<Vec<Vector3<f64>>, StudyError> {
        let (bed, place) = (self.bed, self.place);
        let above = place.target + Vector3::z() * way.above_m;
        let q = bed.solve(&Compensation::none(), &above, &place.joints)?;
        let point = match way.seen {
            Seen::Mark => bed.mark_in_link,
            Seen::Plate => bed.model.tool.tip_in_link,
        };
        let seen = scaled(bed, &q, &point)?;
        let mut out = minus(self.chosen(source, &self.tip), self.chosen(source, &seen));
        let rover_from_link = bed.model.rover_from_link(&q)?;
        let of_target = self.by_cameras(source, &place.target)?;
        let at = |p: &Vector3<f64>| (rover_from_link * Point3::from(*p)).coords;
        match way.seen {
            Seen::Mark => {
                let mark = at(&bed.mark_in_link);
                out.extend(minus(of_target, self.by_cameras(source, &mark)?));
                if source.has(Source::Detector) {
                    out.extend(self.by_pixels(&mark)?.map(|c| c * DETECTOR_PX));
                }
            }
            Seen::Plate => {
                let marks: Vec<_> = bed.plate_in_link.iter().map(at).collect();
                let fit = self.plate_fit(&marks, &at(&point))?;
                let columns = self.pixel_columns(source, &marks)?;
                let seen: Vec<_> = columns.iter().map(|c| applied(&fit, c)).collect();
                out.extend(minus(of_target, seen));
                if source.has(Source::Detector) {
                    out.extend((0..fit.ncols()).map(|i| fit_column(&fit, i) * DETECTOR_PX));
                }
            }
        }
        out.extend(self.target_only(source)?);
        if source.has(Source::Droop) {
            let tip = self.drooped(&place.joints, &bed.model.tool.tip_in_link)?;
            out.push(tip - self.drooped(&q, &point)?);
        }
        Ok(out)
    }

    /// Mean square of the part that is quadratic in the numbers of arm and mount.
    fn quadratic(&self, source: Source, way: Way) -> Result<f64, StudyError> {
        let (bed, place) = (self.bed, self.place);
        let above = place.target + Vector3::z() * way.above_m;
        let q = bed.solve(&Compensation::none(), &above, &place.joints)?;
        let seen = match way.seen {
            Seen::Mark => scaled(bed, &q, &bed.mark_in_link)?,
            Seen::Plate => scaled(bed, &q, &bed.model.tool.tip_in_link)?,
        };
        let n = seen.ncols();
        let chosen: Vec<usize> = (0..n).filter(|i| belongs(source, *i, n)).collect();
        let mut h = vec![vec![Vector3::zeros(); chosen.len()]; chosen.len()];
        for (column, j) in chosen.iter().enumerate() {
            let moved = |sign: f64| {
                let mut compensation = Compensation::constant((position(&seen, *j) * sign).into());
                if way.seen == Seen::Plate {
                    let turn = seen.fixed_view::<3, 1>(3, *j).into_owned() * sign;
                    compensation.offset_rad = turn.into();
                }
                let q = bed.solve(&compensation, &place.target, &place.joints)?;
                scaled(bed, &q, &bed.model.tool.tip_in_link)
            };
            let change = (moved(1.0)? - moved(-1.0)?) * 0.5;
            for (row, i) in chosen.iter().enumerate() {
                h[row][column] = position(&change, *i);
            }
        }
        let mut trace = Vector3::zeros();
        let mut sum = 0.0;
        for i in 0..chosen.len() {
            trace += h[i][i];
            for j in 0..chosen.len() {
                sum += h[i][j].norm_squared() + h[i][j].dot(&h[j][i]);
            }
        }
        Ok(trace.norm_squared() + sum)
    }

    /// Change of a point by the droop at believed joint angles.
    fn drooped(&self, q: &[f64], point: &Vector3<f64>) -> Result<Vector3<f64>, StudyError> {
        let rest = self.bed.still.rest_rad(q)?;
        let jacobian = self.bed.model.pose_jacobian(q, point)?;
        let turns = rest.iter().zip(q).enumerate();
        Ok(turns
            .map(|(joint, (rest, q))| position(&jacobian, 4 * joint) * (rest - q))
            .sum())
    }

    /// Change of a triangulated point by each of its four pixel coordinates, m/px.
    fn by_pixels(&self, p: &Vector3<f64>) -> Result<[Vector3<f64>; 4], StudyError> {
        let cameras = &self.bed.cameras;
        let left = cameras.left.project(p).map_err(failed)?;
        let right = cameras.right.project(p).map_err(failed)?;
        let (_, [l, r]) = cameras
            .triangulate_with_jacobian(&left, &right)
            .map_err(failed)?;
        let column = |m: &nalgebra::Matrix3x2<f64>, i| m.column(i).into_owned();
        Ok([column(&l, 0), column(&l, 1), column(&r, 0), column(&r, 1)])
    }

    /// Changes of pixels of points by each camera number of the source: points after one another,
    /// left u, v, right u, v each; one vector per number.
    fn pixel_columns(
        &self,
        source: Source,
        points: &[Vector3<f64>],
    ) -> Result<Vec<Vec<f64>>, StudyError> {
        let cameras = [&self.bed.cameras.left, &self.bed.cameras.right];
        let mut out = Vec::new();
        for (side, camera) in cameras.into_iter().enumerate() {
            for k in 0..PER_CAMERA {
                let kind = if k < 3 {
                    Source::Intrinsics
                } else {
                    Source::Distortion
                };
                if !source.has(kind) {
                    continue;
                }
                let moved = |step: f64| {
                    let mut e = [0.0; PER_CAMERA];
                    e[k] = step;
                    wrong_camera(camera, &e)
                };
                let (plus, minus) = (moved(STEP)?, moved(-STEP)?);
                let mut column = vec![0.0; 4 * points.len()];
                for (i, p) in points.iter().enumerate() {
                    let change: Vector2<f64> = (plus.project(p).map_err(failed)?
                        - minus.project(p).map_err(failed)?)
                        / (2.0 * STEP);
                    column[4 * i + 2 * side] = change.x;
                    column[4 * i + 2 * side + 1] = change.y;
                }
                out.push(column);
            }
        }
        Ok(out)
    }

    /// Change of where a point is seen by each camera number of the source.
    fn by_cameras(
        &self,
        source: Source,
        p: &Vector3<f64>,
    ) -> Result<Vec<Vector3<f64>>, StudyError> {
        let by_pixels = self.by_pixels(p)?;
        let columns = self.pixel_columns(source, std::slice::from_ref(p))?;
        let seen = |column: &Vec<f64>| {
            let parts = by_pixels.iter().zip(column);
            parts.map(|(by, px)| by * *px).sum()
        };
        Ok(columns.iter().map(seen).collect())
    }

    /// Change of the seen tip by each pixel coordinate of the plate's marks: the least-squares fit
    /// of the plate's pose, carried to the tip.
    fn plate_fit(
        &self,
        marks: &[Vector3<f64>],
        tip: &Vector3<f64>,
    ) -> Result<DMatrix<f64>, StudyError> {
        let cameras = [&self.bed.cameras.left, &self.bed.cameras.right];
        let mut rows = DMatrix::zeros(4 * marks.len(), 6);
        for (i, mark) in marks.iter().enumerate() {
            // A small motion of the plate: translation of the tip, rotation about it.
            let mut motion = Matrix3x6::zeros();
            motion.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            motion
                .fixed_view_mut::<3, 3>(0, 3)
                .copy_from(&-(mark - tip).cross_matrix());
            for (side, camera) in cameras.into_iter().enumerate() {
                let projection = camera.project_with_jacobian(mark).map_err(failed)?;
                let block = projection.jacobian * motion;
                rows.fixed_view_mut::<2, 6>(4 * i + 2 * side, 0)
                    .copy_from(&block);
            }
        }
        let normal = rows.transpose() * &rows;
        let normal = Matrix6::from_column_slice(normal.as_slice());
        let inverse = normal
            .try_inverse()
            .ok_or_else(|| failed("the plate's pose is not determined"))?;
        let inverse = DMatrix::from_column_slice(6, 6, inverse.as_slice());
        Ok((inverse * rows.transpose()).rows(0, 3).into_owned())
    }
}

fn fit_column(fit: &DMatrix<f64>, i: usize) -> Vector3<f64> {
    fit.fixed_view::<3, 1>(0, i).into_owned()
}

fn applied(fit: &DMatrix<f64>, pixels: &[f64]) -> Vector3<f64> {
    pixels
        .iter()
        .enumerate()
        .map(|(i, px)| fit_column(fit, i) * *px)
        .sum()
}
