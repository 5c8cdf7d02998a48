//! The two-stage correction with one draw of the errors: perturbed arm, cameras that are what the
//! believed models are not, drooped joints, real projections, triangulations and pose fits.

use super::{
    ANGLE_RAD, Bed, DETECTOR_PX, LENGTH_M, MATCH_PX, PER_CAMERA, Place, Seen, Source, TILT_RAD,
    WAYS, Way, failed, wrong_camera,
};
use crate::{StudyError, draws::Draws};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Camera, StereoPair};
use rover_compensation::Compensation;
use rover_sim::StillArm;
use rover_vision::{PlateObservation, PointKind, PointObservation, estimate_plate_pose};

/// One draw of the truth.
struct World<'a> {
    bed: &'a Bed,
    arm: StillArm,
    cameras: StereoPair,
    droops: bool,
    detector_px: f64,
    /// The rover frame at the placement from that at the designation.
    now_from_then: UnitQuaternion<f64>,
    match_px: [f64; 4],
}

/// Squares of the final error, m^2: before, then for each way.
pub fn squares(
    bed: &Bed,
    place: &Place,
    source: Source,
    seed: u64,
    keys: &[u64],
) -> Result<[f64; 1 + WAYS.len()], StudyError> {
    let mut draws = Draws::new(seed, keys);
    let world = World::draw(bed, source, &mut draws)?;
    let target = world.designated(place)?;
    let error = |q: &[f64]| -> Result<f64, StudyError> {
        let link = world.link(q)?;
        let tip = (link * Point3::from(bed.model.tool.tip_in_link)).coords;
        Ok((tip - place.target).norm_squared())
    };
    let open = bed.solve(&Compensation::none(), &target, &place.joints)?;
    let mut out = [error(&open)?; 1 + WAYS.len()];
    for (out, way) in out.iter_mut().skip(1).zip(WAYS) {
        let above = target + Vector3::z() * way.above_m;
        let q = bed.solve(&Compensation::none(), &above, &place.joints)?;
        let vector = world.vector(&q, way, &mut draws)?;
        *out = error(&bed.solve(&vector, &target, &place.joints)?)?;
    }
    Ok(out)
}

impl<'a> World<'a> {
    fn draw(bed: &'a Bed, source: Source, draws: &mut Draws) -> Result<Self, StudyError> {
        // Everything is drawn whether or not it is switched on, so that one source's draws do not
        // depend on the others.
        let on = |kind: Source| if source.has(kind) { 1.0 } else { 0.0 };
        let joints = bed.model.arm.joint_count();
        let mut errors = Vec::with_capacity(4 * joints);
        for i in 0..4 * joints {
            let (kind, sigma) = if matches!(i % 4, 1 | 2) {
                (Source::ArmLengths, LENGTH_M)
            } else {
                (Source::ArmAngles, ANGLE_RAD)
            };
            errors.push(on(kind) * sigma * draws.normal());
        }
        let rotation = draws.vector(ANGLE_RAD) * on(Source::MountRotation);
        let translation = draws.vector(LENGTH_M) * on(Source::MountTranslation);
        let centre = Translation3::from(bed.model.mount_centre_in_rover);
        let believed_from_true = Translation3::from(translation)
            * centre
            * UnitQuaternion::from_scaled_axis(rotation)
            * centre.inverse();
        let mut wrong = |camera: &Camera| {
            let e: [f64; PER_CAMERA] = std::array::from_fn(|k| {
                let kind = if k < 3 {
                    Source::Intrinsics
                } else {
                    Source::Distortion
                };
                on(kind) * draws.normal()
            });
            Ok::<_, StudyError>(
                wrong_camera(camera, &e)?.transformed(&believed_from_true.inverse()),
            )
        };
        let cameras = StereoPair {
            left: wrong(&bed.cameras.left)?,
            right: wrong(&bed.cameras.right)?,
        };
        let tilt = draws.vector(TILT_RAD) * on(Source::BodyTilt);
        let match_px = [(); 4].map(|()| on(Source::Match) * MATCH_PX * draws.normal());
        Ok(Self {
            arm: bed.still.with_arm(bed.model.arm.perturbed(&errors)?),
            bed,
            cameras,
            droops: source.has(Source::Droop),
            detector_px: on(Source::Detector) * DETECTOR_PX,
            now_from_then: UnitQuaternion::from_scaled_axis(tilt),
            match_px,
        })
    }

    /// The true last link when the encoders read `q`.
    fn link(&self, q: &[f64]) -> Result<Isometry3<f64>, StudyError> {
        if self.droops {
            return Ok(self.arm.world_from_link(q)?);
        }
        Ok(self.bed.model.rover_from_arm_base * self.arm.kinematics().forward(q)?)
    }

    /// Where the believed cameras put the target when it is designated.
    fn designated(&self, place: &Place) -> Result<Vector3<f64>, StudyError> {
        let then = self.now_from_then.inverse() * place.target;
        let [a, b, c, d] = self.match_px;
        let left = self.cameras.left.project(&then).map_err(failed)? + Vector2::new(a, b);
        let right = self.cameras.right.project(&then).map_err(failed)? + Vector2::new(c, d);
        let found = self.bed.cameras.triangulate(&left, &right);
        Ok(found.map_err(failed)?.point)
    }

    fn pixel(
        &self,
        camera: &Camera,
        p: &Vector3<f64>,
        draws: &mut Draws,
    ) -> Result<Vector2<f64>, StudyError> {
        let noise = Vector2::new(draws.normal(), draws.normal()) * self.detector_px;
        Ok(camera.project(p).map_err(failed)? + noise)
    }

    /// The error vector that is seen at `q`.
    fn vector(&self, q: &[f64], way: Way, draws: &mut Draws) -> Result<Compensation, StudyError> {
        let bed = self.bed;
        let (truth, believed) = (self.link(q)?, bed.model.rover_from_link(q)?);
        match way.seen {
            Seen::Mark => {
                let mark = (truth * Point3::from(bed.mark_in_link)).coords;
                let left = self.pixel(&self.cameras.left, &mark, draws)?;
                let right = self.pixel(&self.cameras.right, &mark, draws)?;
                let seen = bed.cameras.triangulate(&left, &right).map_err(failed)?;
                let predicted = (believed * Point3::from(bed.mark_in_link)).coords;
                Ok(Compensation::constant((seen.point - predicted).into()))
            }
            Seen::Plate => {
                let layout = &bed.robot.description().fiducial.layout;
                let mut observe = |camera: &Camera| {
                    let mut points = Vec::with_capacity(bed.plate_in_link.len());
                    for (index, in_link) in bed.plate_in_link.iter().enumerate() {
                        let p = (truth * Point3::from(*in_link)).coords;
                        points.push(PointObservation {
                            index,
                            point_in_plate: layout
                                .point(index)
                                .ok_or_else(|| failed("the plate has no such mark"))?,
                            pixel_px: self.pixel(camera, &p, draws)?,
                            sigma_px: DETECTOR_PX,
                            kind: if index < layout.discs.len() {
                                PointKind::Disc
                            } else {
                                PointKind::Saddle
                            },
                        });
                    }
                    Ok::<_, StudyError>(PlateObservation {
                        points,
                        score: 1.0,
                        refused: Vec::new(),
                        blur_sigma_px: 0.0,
                    })
                };
                let left = observe(&self.cameras.left)?;
                let right = observe(&self.cameras.right)?;
                let start = believed * bed.robot.link_from_plate;
                let pose = estimate_plate_pose(&bed.cameras, layout, &left, &right, &start)
                    .map_err(failed)?;
                let seen = pose.rover_from_plate * bed.robot.link_from_plate.inverse();
                let tip = Point3::from(bed.model.tool.tip_in_link);
                let mut vector = Compensation::constant((seen * tip - believed * tip).into());
                let turn = (seen.rotation * believed.rotation.inverse()).scaled_axis();
                vector.offset_rad = turn.into();
                Ok(vector)
            }
        }
    }
}
