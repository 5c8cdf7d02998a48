//! `rover vision`: fiducials and stereo on a person's own images.

mod disparity;
mod doubt;
mod evaluate;
mod find;
pub(super) mod input;
mod stereo;

use super::{CommandError, Exit};

/// Finds fiducials, matches pixels and measures surfaces in images of one's own
///
/// Images are PNG, PNM (PGM, PPM), JPEG or BMP, turned upright as their EXIF orientation says; colour
/// and 16 bits are converted to grey of 8. Pixel (0, 0) is the centre of the first pixel. Camera models are of any format that `rover camera` reads. Exit code 3: the images hold no
/// answer, and the output says why.
#[derive(Clone, Debug, clap::Args)]
pub struct VisionArgs {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum Verb {
    Find(Box<find::FindArgs>),
    Match(stereo::MatchArgs),
    Normal(stereo::NormalArgs),
    Disparity(disparity::DisparityArgs),
    Evaluate(evaluate::EvaluateArgs),
}

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: VisionArgs) -> Result<Exit, CommandError> {
    match args.verb {
        Verb::Find(args) => find::run(&args),
        Verb::Match(args) => stereo::run_match(&args),
        Verb::Normal(args) => stereo::run_normal(&args),
        Verb::Disparity(args) => disparity::run(&args),
        Verb::Evaluate(args) => evaluate::run(&args),
    }
}
