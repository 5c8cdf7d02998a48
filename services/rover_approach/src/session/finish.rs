//! The end of the approach: first ray, hand-over, and the target as the body pair sees it.

use super::{Session, standpoint};
use crate::base_pose::{BaseRules, Serving, TargetSpot};
use crate::first_ray::{FirstRayRules, first_ray};
use crate::handover::{HandoverRules, hand_over};
use crate::hardware::fault;
use crate::service::unfit;
use nalgebra::Vector2;
use rover_geometry::tangent_basis;
use rover_messages::{
    Fault,
    approach::{ApproachActivity, BasePose, DriveToResult},
    status::work,
    target::Target,
};
use std::sync::Arc;

/// Base poses that may be chosen anew after a look of the body cameras.
const SECOND_CHOICES_N: u32 = 4;

/// What came of a hand-over.
pub(super) enum Finish {
    Reached(Box<DriveToResult>),
    /// The target must be served from elsewhere.
    Otherwise,
}

impl Session<'_> {
    /// First ray, hand-over, and the target as the body pair sees it.
    pub(super) async fn finish(&mut self, serving: Serving) -> Result<Finish, Fault> {
        self.tell(ApproachActivity::HandingOver);
        let view = Arc::clone(&self.now.view);
        if self.spot_offset_m.is_none()
            && let Ok(met) = first_ray(&self.tracker, &view, &FirstRayRules::default())
            && met.sigma_m < self.budget.tracking_m()
            && self.tracker.move_to(&view, met.pixel_px).is_ok()
        {
            self.budget.met(&met);
        }
        let body = self.hardware.capture("body", 0).await?;
        let (pixel, surface) = self.tracker.target();
        let tracked_px: [f64; 2] = (*pixel).into();
        let focal_px = body.view.cameras.left.model.cahv()[2].norm();
        let mount_rad = self
            .robot
            .description()
            .model_quality
            .angle_deg
            .to_radians();
        let rules = HandoverRules::for_mounts(mount_rad, focal_px);
        let found = self.hardware.shell.timed(work::VISION, || {
            hand_over(&view, pixel, surface, &body.view, &rules)
        });
        let found = match found {
            Ok(found) => found,
            Err(e) => return self.elsewhere(fault("handover_failed", e.to_string())),
        };
        self.budget.handed(&found, &standpoint(&body, &self.wheels));
        let mut target = match self.acceptable(&found.pixel_px, &found.surface).await {
            Ok(target) => target,
            Err(refusal) => return self.elsewhere(refusal),
        };
        let spot = TargetSpot {
            position_m: target.position_m.coords,
            normal: target.normal.unit.into_inner(),
            around_m: self.surface_about(&target.position_m.coords),
        };
        if let Err(reason) = self.served_from_here(&spot, &BaseRules::at_the_limit())? {
            return self.otherwise(&target, &reason);
        }
        let to_site = self.wheels.pose.site_from_rover().isometry.rotation;
        let normal = to_site * target.normal.unit.into_inner();
        let to_site = to_site.to_rotation_matrix();
        let spread = to_site.transpose() * self.budget.along(&normal) * to_site;
        for (i, row) in target.covariance_m2.iter_mut().enumerate() {
            for (j, value) in row.iter_mut().enumerate() {
                *value += spread[(i, j)];
            }
        }
        let quality = [
            ("manipulability", serving.manipulability),
            ("joint_limit_margin_rad", serving.limit_rad),
            ("fiducial_facing_rad", serving.facing_rad),
            (
                "tilt_rad",
                self.wheels.pose.roll_rad.hypot(self.wheels.pose.pitch_rad),
            ),
        ];
        Ok(Finish::Reached(Box::new(DriveToResult {
            target,
            spot_offset_m: self.spot_offset_m.map(Into::into),
            budget: self.budget.shares(),
            lost_m2: self.budget.lost_m2(),
            forecast_mm: self.forecast_mm,
            tracked_px,
            tracked_in: self.now.reference.clone(),
            handover_px: (found.pixel_px - found.geometric_px).norm(),
            base: BasePose {
                pose: self.wheels.pose,
                quality: quality.map(|(name, x)| (name.to_string(), x)).into(),
                candidates_n: self.candidates.0,
                refused: self.candidates.1.clone(),
            },
            stops: self.stops.clone(),
            driven_m: self.driven_m,
        })))
    }

    /// The body cameras do not see the target well enough from here: another base pose is chosen.
    fn elsewhere(&mut self, refusal: Fault) -> Result<Finish, Fault> {
        if self.second_choices_n >= SECOND_CHOICES_N {
            return Err(refusal);
        }
        self.second_choices_n += 1;
        self.spent.push(self.standing());
        self.aim = None;
        Ok(Finish::Otherwise)
    }

    /// From near the surface turned out to face another way than from afar, so that the arm cannot
    /// serve it from here: the base pose is chosen once more.
    fn otherwise(&mut self, target: &Target, reason: &str) -> Result<Finish, Fault> {
        if self.second_choices_n >= SECOND_CHOICES_N {
            let message = format!("as the body cameras see the target, it is not served: {reason}");
            return Err(fault("no_base_pose", message));
        }
        self.second_choices_n += 1;
        let site_from_rover = self.wheels.pose.site_from_rover().isometry;
        self.normal_in_site = Some(site_from_rover.rotation * target.normal.unit.into_inner());
        self.aim = None;
        Ok(Finish::Otherwise)
    }

    /// The target at the handed-over pixel; if the surface there is refused, a spot near it that is
    /// not, within the goal's radius.
    async fn acceptable(
        &mut self,
        pixel_px: &Vector2<f64>,
        surface: &crate::surface::StereoPlane,
    ) -> Result<Target, Fault> {
        let refusal = match self.hardware.select("body", (*pixel_px).into()).await {
            Ok(target) => return Ok(target),
            Err(refusal) => refusal,
        };
        let radius_m = self.goal.spot_radius_m;
        let Some(unit) = nalgebra::Unit::try_new(surface.plane.normal, 1e-9) else {
            return Err(refusal);
        };
        if radius_m <= 0.0 {
            return Err(refusal);
        }
        let (a, b) = tangent_basis(&unit);
        let pair = self.robot.pair("body").map_err(|e| unfit(&e))?;
        for part in [0.5, 1.0] {
            for k in 0..8 {
                let angle = f64::from(k) * std::f64::consts::FRAC_PI_4;
                let offset = (a * angle.cos() + b * angle.sin()) * (part * radius_m);
                let Ok(pixel) = pair.cameras.left.project(&(surface.plane.point + offset)) else {
                    continue;
                };
                if let Ok(target) = self.hardware.select("body", pixel.into()).await {
                    let moved = target.position_m.coords - surface.plane.point;
                    self.spot_offset_m = Some(self.spot_offset_m.unwrap_or_default() + moved);
                    return Ok(target);
                }
            }
        }
        Err(refusal)
    }
}
