//! What every method knows beforehand and what it is told.

use nalgebra::{Matrix3, Point3, Unit, Vector2, Vector3};
use rover_cameras::{Camera, CameraError, StereoPair, TriangulationError};
use rover_compensation::ErrorModel;
use rover_kinematics::{ArmError, AxisGoal, IkError, closest_solution};

/// Why a method cannot take in a sighting or has no command.
#[derive(Debug, thiserror::Error)]
pub enum MethodError {
    /// A point does not project into a camera.
    #[error("projection: {0}")]
    Camera(#[from] CameraError),
    /// Two pixels do not make a point.
    #[error("triangulation: {0}")]
    Triangulation(#[from] TriangulationError),
    /// Joint angles do not fit the arm.
    #[error(transparent)]
    Arm(#[from] ArmError),
    /// A pose cannot be reached.
    #[error("command: {0}")]
    Unreachable(#[from] IkError),
    /// Too little was seen for the method.
    #[error("{found} sightings, the method needs at least {needed}")]
    TooFew {
        /// Sightings there are.
        found: usize,
        /// Sightings it takes.
        needed: usize,
    },
    /// A linear system of the method has no solution.
    #[error("{what}: the equations are degenerate")]
    Degenerate {
        /// Which.
        what: &'static str,
    },
    /// The command came out as no number.
    #[error("the command is not a finite point")]
    NotFinite,
}

/// The believed robot.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Believed arm, tool, and where they are.
    pub model: ErrorModel,
    /// Believed cameras, rover frame.
    pub cameras: StereoPair,
    /// The fiducial on the last link, m.
    pub fiducial_in_link: Vector3<f64>,
    /// Standard deviation of the model's angles, rad.
    pub angle_rad: f64,
    /// Standard deviation of the model's lengths, m.
    pub length_m: f64,
    /// Standard deviation of a detected pixel coordinate, px.
    pub pixel_sigma_px: f64,
}

/// Where the tip shall be seen, and where the tool shall point.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// Tip, as the believed cameras see it, rover frame, m.
    pub tip_in_rover: Vector3<f64>,
    /// Approach axis, rover frame.
    pub axis_in_rover: Unit<Vector3<f64>>,
}

/// One sighting of the fiducial.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// Joint angles at the exposure, rad.
    pub joints_rad: Vec<f64>,
    /// The fiducial in the left image, px.
    pub left_px: Vector2<f64>,
    /// The fiducial in the right image, px.
    pub right_px: Vector2<f64>,
    /// The reference that the tip was sent to; none for a pose taken before the approach.
    pub reference: Option<Reference>,
}

impl Setup {
    /// Least standard deviation of a pixel that weights assume, px: below it the models, not the
    /// detector, are what is wrong.
    pub const LEAST_SIGMA_PX: f64 = 0.05;

    /// Standard deviation of a pixel for weights, px.
    pub fn sigma_px(&self) -> f64 {
        self.pixel_sigma_px.max(Self::LEAST_SIGMA_PX)
    }

    /// The stated error level in degrees, by which priors and weights scale.
    pub fn level_deg(&self) -> f64 {
        self.angle_rad.to_degrees()
    }

    /// Predicted position of a point of the last link, rover frame, m.
    ///
    /// # Errors
    /// [`MethodError::Arm`].
    pub fn point(&self, q: &[f64], in_link: &Vector3<f64>) -> Result<Vector3<f64>, MethodError> {
        let pose = self.model.rover_from_link(q)?;
        Ok((pose * Point3::from(*in_link)).coords)
    }

    /// Predicted tip, rover frame, m.
    ///
    /// # Errors
    /// [`MethodError::Arm`].
    pub fn tip(&self, q: &[f64]) -> Result<Vector3<f64>, MethodError> {
        self.point(q, &self.model.tool.tip_in_link)
    }

    /// Predicted fiducial, rover frame, m.
    ///
    /// # Errors
    /// [`MethodError::Arm`].
    pub fn fiducial(&self, q: &[f64]) -> Result<Vector3<f64>, MethodError> {
        self.point(q, &self.fiducial_in_link)
    }

    /// The fiducial as the believed cameras see it, rover frame, m.
    ///
    /// # Errors
    /// [`MethodError::Triangulation`].
    pub fn seen(&self, sample: &Sample) -> Result<Vector3<f64>, MethodError> {
        Ok(self
            .cameras
            .triangulate(&sample.left_px, &sample.right_px)?
            .point)
    }

    /// Joint angles that put the believed tip on `tip`, near to `near`, rad.
    ///
    /// # Errors
    /// [`MethodError::Unreachable`].
    pub fn joints(
        &self,
        tip: &Vector3<f64>,
        axis: &Unit<Vector3<f64>>,
        near: &[f64],
    ) -> Result<Vec<f64>, MethodError> {
        let base_from_rover = self.model.rover_from_arm_base.inverse();
        let goal = AxisGoal {
            point: (base_from_rover * Point3::from(*tip)).coords,
            axis: base_from_rover.rotation * axis,
        };
        Ok(closest_solution(
            &self.model.arm,
            &self.model.tool,
            &goal,
            near,
        )?)
    }

    /// Sum over both cameras of `J^T J`, with J the pixel's derivative by the point, px^2/m^2.
    ///
    /// # Errors
    /// [`MethodError::Camera`].
    pub fn pixel_information(&self, point: &Vector3<f64>) -> Result<Matrix3<f64>, MethodError> {
        let of = |camera: &Camera| -> Result<Matrix3<f64>, MethodError> {
            let j = camera.project_with_jacobian(point)?.jacobian;
            Ok(j.transpose() * j)
        };
        Ok(of(&self.cameras.left)? + of(&self.cameras.right)?)
    }
}

/// Refuses what is not a number.
pub(crate) fn finite(p: Vector3<f64>) -> Result<Vector3<f64>, MethodError> {
    if p.iter().all(|x| x.is_finite()) {
        Ok(p)
    } else {
        Err(MethodError::NotFinite)
    }
}
