//! `rover camera convert`: between the formats of model files.

use super::files::{self, About, Format, express, load};
use crate::{commands::CommandError, output::Output};
use serde_json::json;
use std::path::PathBuf;

/// Converts a camera model; what is not exact is fitted and its worst pixel error is printed
///
/// The fit makes the worst pixel as good as it can be; the error printed is the largest of rays of
/// the input imaged by the output and of rays of the output imaged by the input.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ConvertArgs {
    /// Model to read; `-` is standard input
    input: PathBuf,
    /// File to write; `-` is standard output
    output: PathBuf,
    /// Format to write (default: by the extension .cahv, .cahvor, .cahvore, .txt or .toml; needed
    /// for YAML)
    #[arg(long, value_name = "FORMAT")]
    to: Option<Format>,
    /// Nearest range at which the two shall agree; matters for a lens with a moving pupil
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    near_m: f64,
    #[command(flatten)]
    about: About,
    /// Names the frame of the vectors (cahv, toml; the camera in ros)
    #[arg(long, value_name = "NAME")]
    frame: Option<String>,
    /// Cuts out a part of the image: column, row, width, height
    #[arg(long, value_name = "U,V,W,H", value_parser = four)]
    subframe: Option<[u32; 4]>,
    /// Then joins N x N pixels to one
    #[arg(long, value_name = "N")]
    downsample: Option<u32>,
    /// Writes how good the conversion is as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

fn four(text: &str) -> Result<[u32; 4], String> {
    let all: Option<Vec<u32>> = text.split(',').map(|x| x.trim().parse().ok()).collect();
    all.and_then(|all| all.try_into().ok())
        .ok_or_else(|| "expected U,V,W,H in whole pixels".into())
}

/// Runs the verb.
pub(super) fn run(args: &ConvertArgs) -> Result<(), CommandError> {
    let rules = args.about.rules(args.near_m)?;
    let format = args
        .to
        .or_else(|| files::by_extension(&args.output))
        .ok_or_else(|| {
            CommandError::BadInput(format!(
                "{}: its name does not say the format, give --to cahv, toml, ros, opencv or kalibr",
                args.output.display()
            ))
        })?;
    if args.frame.is_some() && matches!(format, Format::Opencv | Format::Kalibr) {
        return Err(CommandError::BadInput(
            "--frame has no effect on opencv and kalibr files: they name no frame".into(),
        ));
    }
    let output = Output::open(&args.output, args.force)?;
    let report = args
        .json
        .as_deref()
        .map(|path| Output::open(path, args.force))
        .transpose()?;
    let mut loaded = load(&args.input, &rules, &args.about)?;
    loaded.report_notes();
    if args.subframe.is_some() || args.downsample.is_some() {
        let mut camera = loaded.camera()?;
        let wrong = |e: rover_cameras::CameraError| CommandError::BadInput(e.to_string());
        if let Some([u, v, w, h]) = args.subframe {
            camera = camera.subframe([u, v], [w, h]).map_err(wrong)?;
        }
        if let Some(n) = args.downsample {
            camera = camera.downsampled(n).map_err(wrong)?;
        }
        loaded.file.size_px = Some([camera.width_px, camera.height_px]);
        loaded.file.model = camera.model;
    }
    if args.frame.is_some() {
        loaded.file.frame.clone_from(&args.frame);
    }
    let (text, written) = express(&loaded, format, &rules)?;
    output.write(&text)?;
    // Errors of reading and of writing add up.
    let steps: Vec<_> = [loaded.fidelity, written].into_iter().flatten().collect();
    let exact = steps.iter().all(|f| f.exact);
    let worst_px: f64 = steps.iter().map(|f| f.worst_px).sum();
    let covered = steps.iter().map(|f| f.covered).fold(1.0, f64::min);
    if exact {
        eprintln!("exact");
    } else {
        eprintln!("fitted: {worst_px:.3e} px off at worst");
    }
    if covered < 1.0 {
        eprintln!(
            "{:.1} % of the image has no ray in the original and was not compared",
            100.0 * (1.0 - covered)
        );
    }
    let [c, a, ..] = loaded.model().cahv();
    let posed = matches!(format, Format::Ros | Format::Opencv | Format::Kalibr);
    if posed {
        eprintln!(
            "the pose is not in the file: camera at {} {} {} m, looking along {} {} {}",
            c.x, c.y, c.z, a.x, a.y, a.z
        );
    }
    if let Some(report) = report {
        let value = json!({
            "exact": exact,
            "worst_px": if exact { 0.0 } else { worst_px },
            "covered": covered,
            "pose_dropped": posed,
            "from": format!("{:?}", loaded.format).to_lowercase(),
            "to": format!("{format:?}").to_lowercase(),
        });
        report.write(&files::json(&value)?)?;
    }
    Ok(())
}
