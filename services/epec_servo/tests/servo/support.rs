//! Perturbed robots and what is seen of them.

use nalgebra::{Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3};
use rand::{SeedableRng, rngs::StdRng};
use rand_distr::{Distribution, StandardNormal};
use rover_epec_servo::estimator::Seen;
use rover_kinematics::{Arm, AxisGoal, closest_solution};
use rover_robot::Robot;

pub const ANGLE_RAD: f64 = 1.0 / 57.295_779_513_082_32;
pub const LENGTH_M: f64 = 2.5e-3;

pub fn bluestreak() -> Robot {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scenarios/robots/bluestreak.toml"
    );
    Robot::read(path.as_ref()).unwrap()
}

pub struct Truth {
    pub arm: Arm,
    mount: Isometry3<f64>,
    rng: StdRng,
}

impl Truth {
    pub fn new(robot: &Robot, seed: u64) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut normal =
            |sigma: f64| sigma * Distribution::<f64>::sample(&StandardNormal, &mut rng);
        let errors: Vec<f64> = (0..robot.arm.joint_count())
            .flat_map(|_| [ANGLE_RAD, LENGTH_M, LENGTH_M, ANGLE_RAD])
            .map(&mut normal)
            .collect();
        let mut vector = |sigma| Vector3::from_fn(|_, _| normal(sigma));
        let (w, t) = (vector(ANGLE_RAD), vector(LENGTH_M));
        let c0 = robot.mount_centre();
        let rotation = UnitQuaternion::from_scaled_axis(w);
        let mount = Isometry3::from_parts((c0 + t - rotation * c0).into(), rotation);
        Self {
            arm: robot.arm.perturbed(&errors).unwrap(),
            mount,
            rng,
        }
    }

    /// Pose of the last link as the cameras believe to see it.
    pub fn seen_link(&self, robot: &Robot, q: &[f64]) -> Isometry3<f64> {
        self.mount * robot.rover_from_arm_base.isometry * self.arm.forward(q).unwrap()
    }

    pub fn noise(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| sigma * Distribution::<f64>::sample(&StandardNormal, &mut self.rng))
    }

    pub fn tip(&self, robot: &Robot, q: &[f64]) -> Vector3<f64> {
        self.seen_link(robot, q)
            .transform_point(&robot.tool.tip_in_link.into())
            .coords
    }

    pub fn pose(&mut self, robot: &Robot, q: &[f64], sigma_m: f64, sigma_rad: f64) -> Seen {
        let seen = self.seen_link(robot, q);
        let predicted = robot.rover_from_link(q).unwrap().isometry;
        let tip = self.tip(robot, q) + self.noise(sigma_m);
        let rotation = (seen.rotation * predicted.rotation.inverse()).scaled_axis();
        let mut covariance = Matrix6::identity() * sigma_m.powi(2);
        covariance
            .fixed_view_mut::<3, 3>(3, 3)
            .copy_from(&(Matrix3::identity() * sigma_rad.powi(2)));
        Seen::Pose {
            tip_in_rover: tip,
            rotation_error: rotation + self.noise(sigma_rad),
            covariance,
        }
    }
}

/// Joint angles on the way down to a point, at a height above it.
pub fn station(robot: &Robot, height_m: f64) -> Vec<f64> {
    let rover = Vector3::new(0.54, 0.0, 0.40 + height_m);
    let base = robot.rover_from_arm_base.isometry.inverse();
    let goal = AxisGoal {
        point: (base * nalgebra::Point3::from(rover)).coords,
        axis: base.rotation * -Vector3::z_axis(),
    };
    closest_solution(
        &robot.arm,
        &robot.tool,
        &goal,
        robot.posture("ready").unwrap(),
    )
    .unwrap()
}

pub fn quantile(values: &mut [f64], q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * q).round() as usize]
}
