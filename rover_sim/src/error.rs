//! Why a world cannot be built or asked.

use rover_kinematics::ArmError;

/// Why a world cannot be built or asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// A field of the description has a value that cannot be.
    #[error("simulation.{field}: {found}, expected {expected}")]
    Field {
        /// The field's path.
        field: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The robot lacks what a simulator needs.
    #[error("robot {robot}: {field}: {message}")]
    Robot {
        /// Name of the robot.
        robot: String,
        /// The field's path in the robot file.
        field: String,
        /// What is missing or wrong.
        message: String,
    },
    /// The arm's kinematics refused a row or a list of angles.
    #[error("true arm: {0}")]
    Arm(#[from] ArmError),
    /// The true camera is not a camera.
    #[error("true camera {pair}.{side}: {message}")]
    Camera {
        /// Camera pair.
        pair: String,
        /// `left` or `right`.
        side: &'static str,
        /// What is wrong.
        message: String,
    },
    /// A collider cannot be made of a mesh.
    #[error("collider of {body}: {message}")]
    Collider {
        /// Which body.
        body: String,
        /// What is wrong.
        message: String,
    },
    /// The scene cannot be drawn.
    #[error("scene: {0}")]
    Scene(#[from] rover_render::SceneError),
    /// A camera cannot draw.
    #[error("renderer: {0}")]
    Render(#[from] rover_render::RenderError),
    /// A picture cannot be taken.
    #[error("picture: {0}")]
    Picture(String),
    /// A designated pixel shows nothing solid.
    #[error("pixel [{u_px}, {v_px}] of {pair}.left shows no surface")]
    NoSurface {
        /// Camera pair.
        pair: String,
        /// Column, px.
        u_px: f64,
        /// Row, px.
        v_px: f64,
    },
}

impl SimulationError {
    pub(crate) fn field(
        field: impl Into<String>,
        found: impl std::fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Self::Field {
            field: field.into(),
            found: found.to_string(),
            expected: expected.into(),
        }
    }
}
