//! What can be wrong with a scene, a camera or a request.

use thiserror::Error;

/// A scene that cannot be drawn.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SceneError {
    /// A triangle refers to a vertex that does not exist.
    #[error("{body}: triangle {triangle} refers to vertex {index}, but there are {vertices}")]
    Index {
        /// Which mesh.
        body: String,
        /// Which triangle.
        triangle: usize,
        /// The index it has.
        index: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// Not one normal per vertex.
    #[error("{body}: {normals} normals for {vertices} vertices, expected one for each")]
    NormalCount {
        /// Which mesh.
        body: String,
        /// Normals given.
        normals: usize,
        /// Vertices given.
        vertices: usize,
    },
    /// A vertex that is not finite or absurdly far away.
    #[error("{body}: vertex {vertex} is not a finite position within 1e6 m")]
    Position {
        /// Which mesh.
        body: String,
        /// Which vertex.
        vertex: usize,
    },
    /// A normal that is not of unit length.
    #[error("{body}: the normal of vertex {vertex} has length {norm}, expected 1")]
    Normal {
        /// Which mesh.
        body: String,
        /// Which vertex.
        vertex: usize,
        /// Its length.
        norm: f64,
    },
    /// A number outside its range.
    #[error("{body}: {what} is {value}, expected {low} to {high}")]
    OutOfRange {
        /// Which body.
        body: String,
        /// Which number.
        what: &'static str,
        /// The number.
        value: f64,
        /// Smallest allowed.
        low: f64,
        /// Largest allowed.
        high: f64,
    },
    /// A plate on a part that does not exist.
    #[error("{body}: sits on part {part}, but there are {parts} parts")]
    NoSuchPart {
        /// Which plate.
        body: String,
        /// The part it names.
        part: usize,
        /// How many there are.
        parts: usize,
    },
    /// More bodies than can be told apart.
    #[error("{count} bodies, at most {most} can be drawn")]
    TooMany {
        /// How many were given.
        count: usize,
        /// The limit.
        most: usize,
    },
}

/// A camera or a request that cannot be served.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum RenderError {
    /// An image that is too small or too large.
    #[error("image of {width}x{height} pixels, expected 2x2 to 8192x8192")]
    ImageSize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// The camera model has no ray for a pixel of its own image.
    #[error("no ray for pixel ({u_px}, {v_px}): {reason}")]
    NoRay {
        /// Column.
        u_px: f64,
        /// Row.
        v_px: f64,
        /// The model's words.
        reason: String,
    },
    /// The model's rays do not meet in one point (an entrance pupil that moves, as in CAHVORE).
    #[error(
        "the rays of pixel ({u_px}, {v_px}) and of the image centre start {distance_m} m apart; \
         only cameras with one centre of projection can be drawn"
    )]
    MovingPupil {
        /// Column.
        u_px: f64,
        /// Row.
        v_px: f64,
        /// How far the starts of the rays are apart, metres.
        distance_m: f64,
    },
    /// A field of view of a half space or more.
    #[error("the ray of pixel ({u_px}, {v_px}) is {angle_deg} deg off the axis, at most 80")]
    TooWide {
        /// Column.
        u_px: f64,
        /// Row.
        v_px: f64,
        /// Angle to the central ray, degrees.
        angle_deg: f64,
    },
    /// An imaging parameter outside its range.
    #[error("{what} is {value}, expected {low} to {high}")]
    Imaging {
        /// Which parameter.
        what: &'static str,
        /// Its value.
        value: f64,
        /// Smallest allowed.
        low: f64,
        /// Largest allowed.
        high: f64,
    },
    /// No such camera.
    #[error("camera {index} does not exist, there are {cameras}")]
    NoSuchCamera {
        /// The index asked for.
        index: usize,
        /// How many there are.
        cameras: usize,
    },
    /// A pair of one and the same camera.
    #[error("a pair needs two cameras, both are camera {index}")]
    SameCamera {
        /// The index given twice.
        index: usize,
    },
    /// The wrong number of poses.
    #[error("{given} part poses, the scene has {expected} parts")]
    PoseCount {
        /// Poses given.
        given: usize,
        /// Parts in the scene.
        expected: usize,
    },
    /// A pose that is not finite or not a rotation.
    #[error("the pose of {body} is not a finite rigid motion")]
    Pose {
        /// Of what.
        body: String,
    },
    /// No such static mesh, or it has been removed before.
    #[error("static mesh {index} does not exist (any more), there were {statics}")]
    NoSuchStatic {
        /// The index asked for.
        index: usize,
        /// How many there were at first.
        statics: usize,
    },
}
