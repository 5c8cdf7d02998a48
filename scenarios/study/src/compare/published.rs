//! Medians that an independent program found beforehand.

use super::Case;
use rover_methods::Kind;

/// Medians of an independent program in the plain case, blind for 0, 10 and 20 cm, and in the
/// case with the fiducial behind; 200 trials each.
pub fn independent(kind: Kind, case: Case, occlusion_cm: u32) -> Option<f64> {
    const NONE: f64 = f64::NAN;
    let (plain, behind, lens): ([f64; 3], [f64; 3], [f64; 2]) = match kind {
        Kind::EpecField => ([0.67, 0.79, 1.6], [2.6, 2.7, 3.2], [0.68, 2.6]),
        Kind::EpecFieldFree => ([0.55, 0.71, 1.6], [2.5, 2.7, 3.3], [1.3, 2.7]),
        Kind::HipsApproach => ([0.66, 1.4, 4.6], [3.7, 4.0, 6.6], [0.68, 3.8]),
        Kind::HipsFull => ([0.68, 2.5, 3.5], [NONE; 3], [NONE; 2]),
        Kind::CameraSpace => ([0.65, 1.5, 5.3], [3.9, 4.5, 8.0], [0.70, 4.1]),
        Kind::CameraSpaceLinear => ([0.68, 2.35, 3.9], [NONE; 3], [NONE, 2.56]),
        Kind::MountKabsch => ([NONE, 2.2, 4.0], [NONE; 3], [NONE; 2]),
        Kind::KinematicCalibration => ([NONE, 0.48, 0.52], [NONE; 3], [3.3, NONE]),
        Kind::Epec | Kind::PositionBased => ([0.70, 3.6, 6.9], [4.1, 6.2, 9.2], [0.71, 4.4]),
        Kind::ImageBased => ([0.68, 3.6, 6.9], [4.1, 6.2, 9.2], [0.72, 4.4]),
        Kind::HipsLimited => ([3.6, 3.6, 3.6], [5.2, 5.2, 5.2], [8.0, 8.0]),
        Kind::Kinematic => ([21.8, 21.8, 21.8], [21.8, 21.8, 21.8], [21.9, 21.9]),
        _ => return None,
    };
    let column = [0, 10, 20].iter().position(|g| *g == occlusion_cm)?;
    let median = match case {
        Case::Plain => Some(plain[column]),
        Case::Behind => Some(behind[column]),
        Case::UnknownLens => lens.get(column).copied(),
        _ => None,
    };
    median.filter(|m| m.is_finite())
}
