//! `rover camera`: camera models on a person's own files.

mod calibrate;
mod convert;
pub(super) mod files;
mod info;
mod points;

use super::{CommandError, Exit};
use clap::Subcommand;

/// Camera models: what they say, projection, rays, triangulation, conversion, calibration
///
/// A model file is CAHV text, TOML, ROS CameraInfo YAML, OpenCV YAML or a Kalibr chain; `-` is standard
/// input. Of a file with several cameras FILE#N is the one that the file numbers N: cam1 of a Kalibr
/// chain, M2 of an OpenCV stereo file. Both models of a pair must be given in one frame.
#[derive(Clone, Debug, clap::Args)]
pub struct CameraArgs {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Clone, Debug, Subcommand)]
enum Verb {
    Info(info::InfoArgs),
    Project(points::ProjectArgs),
    Ray(points::RayArgs),
    Triangulate(points::TriangulateArgs),
    Convert(convert::ConvertArgs),
    Calibrate(calibrate::CalibrateArgs),
}

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub fn run(args: CameraArgs) -> Result<Exit, CommandError> {
    match args.verb {
        Verb::Info(args) => info::run(&args),
        Verb::Project(args) => points::project(&args),
        Verb::Ray(args) => points::ray(&args),
        Verb::Triangulate(args) => points::triangulate(&args),
        Verb::Convert(args) => convert::run(&args),
        Verb::Calibrate(args) => calibrate::run(&args),
    }?;
    Ok(Exit::Done)
}
