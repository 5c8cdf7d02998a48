//! The straight motion along the normal as plain values (paper, section 3 *Instrument Contact*):
//! from the standoff through the target to the largest overtravel, every pose corrected with the
//! servo's last knowledge of the error.

use nalgebra::Vector3;
use rover_compensation::{CompensationError, ErrorModel};
use rover_geometry::Direction;
use rover_messages::{
    Fault,
    arm::{ExecuteResult, StopReason},
    keys::service::CONTACT_APPROACH,
    placement::ContactGoal,
    planning::{PlanGoal, PlanRequest, ToolPose},
};
use rover_robot::Robot;

/// Distance between corrected poses along the normal, m: the error changes by less than 0.2 mm in
/// between.
const POSE_SPACING_M: f64 = 0.005;
/// Fraction of the arm's limits for the way back.
const RETRACT_SPEED_FRACTION: f64 = 0.5;
/// Tip speed of the way back, m/s.
const RETRACT_TIP_SPEED_M_S: f64 = 0.02;

/// A contact motion.
#[derive(Clone, Debug)]
pub struct GuardedMove {
    model: ErrorModel,
    goal: ContactGoal,
}

/// How a contact motion ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The switch closed.
    Contact,
    /// There was none; the arm should go back.
    NoContact(Fault),
}

fn fault(name: &str, message: impl Into<String>) -> Fault {
    Fault::new(CONTACT_APPROACH, name, message)
}

fn compensation_fault(error: &CompensationError) -> Fault {
    match error {
        CompensationError::Unreachable(e) => {
            fault("normal_out_of_reach", format!("along the normal: {e}"))
        }
        other => fault("bad_compensation", other.to_string()),
    }
}

impl GuardedMove {
    /// A motion for the believed robot.
    pub fn new(robot: &Robot, goal: ContactGoal) -> Self {
        let model = ErrorModel {
            arm: robot.arm.clone(),
            tool: robot.tool.clone(),
            rover_from_arm_base: robot.rover_from_arm_base.isometry,
            mount_centre_in_rover: robot.mount_centre(),
        };
        Self { model, goal }
    }

    /// Signed distance of the tip from the target along the normal with the arm at `q`, as the
    /// cameras would see it, m; negative beyond the target.
    ///
    /// # Errors
    /// `bad_compensation` for joint angles or parameters that do not fit the arm.
    pub fn distance_m(&self, q: &[f64]) -> Result<f64, Fault> {
        let (error, _) = self
            .model
            .error_at(&self.goal.compensation, q)
            .map_err(|e| compensation_fault(&e))?;
        let link = self
            .model
            .rover_from_link(q)
            .map_err(|e| compensation_fault(&e.into()))?;
        let tip = link
            .transform_point(&self.model.tool.tip_in_link.into())
            .coords
            + error;
        let target = &self.goal.target;
        Ok(target.normal.unit.dot(&(tip - target.position_m.coords)))
    }

    /// The motion into the surface, from the arm at `q`.
    ///
    /// # Errors
    /// `not_at_standoff` when the tip is not where the goal says; `normal_out_of_reach` with the
    /// constraint that fails.
    pub fn approach(&self, q: &[f64]) -> Result<PlanRequest, Fault> {
        let start = self.distance_m(q)?;
        let expected = self.goal.standoff_m;
        if (start - expected).abs() > 0.5 * expected + 0.01 {
            return Err(fault(
                "not_at_standoff",
                format!(
                    "the tip is {:.1} mm from the target along the normal, expected the standoff of \
                     {:.1} mm",
                    start * 1e3,
                    expected * 1e3
                ),
            ));
        }
        let poses = self.poses(start, -self.goal.max_overtravel_m, q)?;
        Ok(PlanRequest {
            start_rad: None,
            goal: PlanGoal::Straight(poses),
            speed_fraction: RETRACT_SPEED_FRACTION,
            max_tip_speed_m_s: Some(self.goal.speed_m_s),
            contact_radius_m: start + self.goal.max_overtravel_m,
        })
    }

    /// The way back to the standoff, from the arm at `q`.
    ///
    /// # Errors
    /// As [`GuardedMove::approach`].
    pub fn retract(&self, q: &[f64]) -> Result<PlanRequest, Fault> {
        let start = self.distance_m(q)?;
        let poses = self.poses(start, self.goal.standoff_m.max(start + 0.005), q)?;
        Ok(PlanRequest {
            start_rad: None,
            goal: PlanGoal::Straight(poses),
            speed_fraction: RETRACT_SPEED_FRACTION,
            max_tip_speed_m_s: Some(RETRACT_TIP_SPEED_M_S),
            contact_radius_m: 2.0 * self.goal.standoff_m + self.goal.max_overtravel_m,
        })
    }

    /// What the driver's result means.
    pub fn outcome(&self, result: &ExecuteResult) -> Outcome {
        if result.joints_at_contact_rad.is_some() {
            return Outcome::Contact;
        }
        Outcome::NoContact(match &result.state.stop_reason {
            Some(StopReason::Force { found_n, limit_n }) => fault(
                "force_limit",
                format!("{found_n:.1} N without the switch closing, expected at most {limit_n} N"),
            )
            .with("force_n", *found_n),
            Some(other) => fault("motion_stopped", format!("the driver stopped: {other}")),
            None => fault(
                "no_contact",
                format!(
                    "no surface within {:.0} mm beyond the target, where one was expected; the \
                     target may be gone or its range wrong",
                    self.goal.max_overtravel_m * 1e3
                ),
            )
            .with("overtravel_mm", self.goal.max_overtravel_m * 1e3),
        })
    }

    fn poses(&self, from_m: f64, to_m: f64, q: &[f64]) -> Result<Vec<ToolPose>, Fault> {
        let normal = self.goal.target.normal.unit;
        let count = ((from_m - to_m).abs() / POSE_SPACING_M).ceil().max(1.0) as usize;
        let mut near = q.to_vec();
        let mut poses = Vec::with_capacity(count);
        for i in 1..=count {
            let distance = from_m + (to_m - from_m) * i as f64 / count as f64;
            let tip: Vector3<f64> =
                self.goal.target.position_m.coords + normal.into_inner() * distance;
            let solved = self
                .model
                .solve(&self.goal.compensation, &tip, &-normal, &near)
                .map_err(|e| compensation_fault(&e))?;
            near = solved.joints_rad;
            poses.push(ToolPose {
                tip_m: solved.tip_in_rover.into(),
                axis: Direction::from(solved.axis_in_rover),
            });
        }
        Ok(poses)
    }
}
