//! `rover camera calibrate`: cameras from pictures of a chessboard whose poses nobody measured.

mod page;
mod report;

use super::files::json;
use crate::{
    commands::{CommandError, vision::input::image},
    output::Output,
};
use anyhow::anyhow;
use nalgebra::Vector2;
use rover_cameras::{
    calibration::{
        BoardPoint, BoardView, CalibrationError, CalibrationRules, ModelKind, QualityLimits,
        calibrate, repeats,
    },
    formats::write_text,
};
use rover_vision::board::{Chessboard, find_chessboard};
use std::path::{Path, PathBuf};

/// Calibrates a stereo pair, or one camera, from pictures of a printed chessboard
///
/// Pictures are paired in the order given. Writes left.cahvor and right.cahvor (or .cahv,
/// .cahvore), report.json and residuals.html into the folder DIR. The models are in the axes of the
/// left camera (x right, y down, z forward); the scale is that of the squares. A pair of which one
/// picture loses more than half of its corners is left out and named. No models are written, and the
/// command ends with 2, if more than a third of the pairs or a tenth of the corners of the others do
/// not fit, if a camera errs by more than --max-rms-px, or if the baseline is below 10 sigma.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct CalibrateArgs {
    /// The board: chessboard:COLSxROWS:SQUARE_M, counting inner corners, e.g. chessboard:9x6:0.025
    #[arg(long, value_name = "BOARD", value_parser = board)]
    board: BoardArg,
    /// Pictures of the left camera
    #[arg(long, required = true, num_args = 1.., value_name = "IMAGE")]
    left: Vec<PathBuf>,
    /// Pictures of the right camera, as many; without them one camera is calibrated
    #[arg(long, num_args = 1.., value_name = "IMAGE")]
    right: Vec<PathBuf>,
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Camera model
    #[arg(long, value_name = "MODEL", default_value = "cahvor")]
    model: Model,
    /// Linearity of a CAHVORE model: 1 perspective, 0 fisheye (the default), or between
    #[arg(long, value_name = "L")]
    linearity: Option<f64>,
    /// Largest root mean square error of a camera that is accepted
    #[arg(long, value_name = "PX", default_value_t = 1.0)]
    max_rms_px: f64,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Model {
    Cahv,
    Cahvor,
    Cahvore,
}

impl Model {
    fn extension(self) -> &'static str {
        match self {
            Self::Cahv => "cahv",
            Self::Cahvor => "cahvor",
            Self::Cahvore => "cahvore",
        }
    }
}

/// A chessboard with the side of its squares.
#[derive(Clone, Copy, Debug)]
struct BoardArg {
    board: Chessboard,
    square_m: f64,
}

fn board(text: &str) -> Result<BoardArg, String> {
    let parse = || {
        let (sides, square) = text.strip_prefix("chessboard:")?.split_once(':')?;
        let (columns, rows) = sides.split_once('x')?;
        let square_m: f64 = square.parse().ok()?;
        let board = Chessboard {
            columns: columns.parse().ok()?,
            rows: rows.parse().ok()?,
        };
        (square_m > 0.0 && square_m.is_finite()).then_some(BoardArg { board, square_m })
    };
    parse()
        .ok_or_else(|| "expected chessboard:COLSxROWS:SQUARE_M, e.g. chessboard:9x6:0.025".into())
}

const SIDES: [&str; 2] = ["left", "right"];
/// The frame of the results.
const FRAME: &str = "left_camera";

/// Runs the verb.
pub(super) fn run(args: &CalibrateArgs) -> Result<(), CommandError> {
    let cameras: Vec<&[PathBuf]> = if args.right.is_empty() {
        vec![&args.left]
    } else {
        vec![&args.left, &args.right]
    };
    if cameras.iter().any(|images| images.len() != args.left.len()) {
        return Err(CommandError::BadInput(format!(
            "{} left and {} right pictures: expected pairs",
            args.left.len(),
            args.right.len()
        )));
    }
    let rules = CalibrationRules {
        model: kind(args)?,
        ..CalibrationRules::default()
    };
    if args.max_rms_px.is_nan() || args.max_rms_px <= 0.0 {
        return Err(CommandError::BadInput(format!(
            "--max-rms-px {}: expected a number above 0",
            args.max_rms_px
        )));
    }
    let names: Vec<String> = (0..cameras.len())
        .map(|n| format!("{}.{}", SIDES[n], args.model.extension()))
        .collect();
    let open = |name: &str| Output::open(&args.out.join(name), args.force);
    let models: Vec<Output> = names.iter().map(|n| open(n)).collect::<Result<_, _>>()?;
    let (report, page) = (open("report.json")?, open("residuals.html")?);

    let (sizes_px, views, pictures) = find(&cameras, args.board)?;
    let found = calibrate(&sizes_px, &views, &rules)
        .map_err(|e| failed(&e, &sizes_px, &views, &pictures, &rules))?;
    let problems = found.problems(&QualityLimits {
        max_rms_px: args.max_rms_px,
        ..QualityLimits::default()
    });
    let left_out = report::left_out(&found, &pictures);
    report.write(&json(&report::account(&found, &pictures, &problems))?)?;
    page.write(&page::page(&found, &pictures, &problems))?;
    eprintln!("{}", report::summary(&found));
    for pair in &left_out {
        eprintln!("left out: {pair}");
    }
    let more = match args.model {
        Model::Cahv => "--model cahvor describes it",
        Model::Cahvor => "--model cahvore may describe it",
        Model::Cahvore => "another --linearity may describe it",
    };
    for camera in 0..found.cameras.len() {
        if let Some(word) = report::pattern(&found, camera, more) {
            eprintln!("{word}");
        }
    }
    if !problems.is_empty() {
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        return Err(CommandError::BadInput(format!(
            "no models written: {}{}; see report.json and residuals.html in {}",
            problems.join("; "),
            alone(&sizes_px, &views, &rules),
            args.out.display()
        )));
    }
    for (output, camera) in models.iter().zip(&found.cameras) {
        let text = write_text(camera, Some(FRAME)).map_err(|e| anyhow!("result: {e}"))?;
        output.write(&text)?;
    }
    eprintln!("results in {}", args.out.display());
    Ok(())
}

fn kind(args: &CalibrateArgs) -> Result<ModelKind, CommandError> {
    let bad = |what: String| Err(CommandError::BadInput(what));
    Ok(match (args.model, args.linearity) {
        (Model::Cahv, None) => ModelKind::Cahv,
        (Model::Cahvor, None) => ModelKind::Cahvor,
        (Model::Cahvore, l) => {
            let linearity = l.unwrap_or(0.0);
            if !(-1.0..=1.0).contains(&linearity) {
                return bad(format!("--linearity {linearity}: expected -1 to 1"));
            }
            ModelKind::Cahvore { linearity }
        }
        (_, Some(l)) => {
            return bad(format!(
                "--linearity {l}: only --model cahvore has a linearity"
            ));
        }
    })
}

/// A calibration that failed, with the names of the pictures it is about.
fn failed(
    error: &CalibrationError,
    sizes_px: &[[u32; 2]],
    views: &[BoardView],
    pictures: &Pictures,
    rules: &CalibrationRules,
) -> CommandError {
    let about: Vec<String> = error.views().iter().map(|v| pictures.of_view(*v)).collect();
    let about = if about.is_empty() {
        String::new()
    } else {
        format!(" ({})", about.join(", "))
    };
    let inner = matches!(
        error,
        CalibrationError::Inconsistent { .. } | CalibrationError::NotSettled { .. }
    );
    let alone = if inner {
        alone(sizes_px, views, rules)
    } else {
        String::new()
    };
    CommandError::BadInput(format!("no models written: {error}{about}{alone}"))
}

/// How well each camera of a pair calibrates without the other: good pictures in wrong pairs do.
fn alone(sizes_px: &[[u32; 2]], views: &[BoardView], rules: &CalibrationRules) -> String {
    if sizes_px.len() < 2 {
        return String::new();
    }
    let limits = QualityLimits::default();
    let rms_px: Vec<Option<f64>> = (0..2)
        .map(|camera| {
            let own: Vec<BoardView> = views
                .iter()
                .filter(|view| !view[camera].is_empty())
                .map(|view| vec![view[camera].clone()])
                .collect();
            let found = calibrate(&sizes_px[camera..=camera], &own, rules).ok()?;
            found.problems(&limits).is_empty().then(|| found.rms_px[0])
        })
        .collect();
    match rms_px.as_slice() {
        [Some(left), Some(right)] => format!(
            "; each camera alone fits its pictures (left {left:.3} px rms, right {right:.3} px rms): were \
             the pictures of a pair taken at the same time, and is their order the same?"
        ),
        _ => String::new(),
    }
}

/// A picture and what became of it.
struct Picture {
    /// The placement of the board; `None` without a board in the pair.
    view: Option<usize>,
    camera: usize,
    path: PathBuf,
    refusal: Option<String>,
    /// The view that this picture's pair shows once more.
    repeats: Option<usize>,
}

/// All pictures, pair by pair.
struct Pictures {
    all: Vec<Picture>,
}

impl Pictures {
    /// The names of a view's pictures.
    fn of_view(&self, view: usize) -> String {
        let names: Vec<String> = self
            .all
            .iter()
            .filter(|p| p.view == Some(view))
            .map(|p| p.path.display().to_string())
            .collect();
        names.join(" + ")
    }
}

/// Finds the board in all pictures; a placement that no camera could use is left out.
fn find(
    cameras: &[&[PathBuf]],
    BoardArg { board, square_m }: BoardArg,
) -> Result<(Vec<[u32; 2]>, Vec<BoardView>, Pictures), CommandError> {
    let mut sizes_px: Vec<Option<[u32; 2]>> = vec![None; cameras.len()];
    let (mut views, mut pictures) = (Vec::new(), Vec::new());
    for n in 0..cameras[0].len() {
        let mut view: BoardView = Vec::new();
        let mut shown = Vec::new();
        for (camera, images) in cameras.iter().enumerate() {
            let path: &Path = &images[n];
            let bad = |what: String| CommandError::BadInput(format!("{}: {what}", path.display()));
            let image = image(path)?;
            let size = [image.width_px, image.height_px];
            let expected = *sizes_px[camera].get_or_insert(size);
            if size != expected {
                return Err(bad(format!(
                    "{} x {} px, the others of this camera have {} x {}",
                    size[0], size[1], expected[0], expected[1]
                )));
            }
            let found = find_chessboard(&image, board);
            if let Err(reason @ rover_vision::board::BoardError::Size { .. }) = found {
                return Err(CommandError::BadInput(format!("--board: {reason}")));
            }
            let refusal = found.as_ref().err().map(ToString::to_string);
            if let Some(why) = &refusal {
                eprintln!("{}: no board: {why}", path.display());
            }
            view.push(
                found
                    .unwrap_or_default()
                    .iter()
                    .map(|corner| BoardPoint {
                        board_m: Vector2::new(corner.column as f64, corner.row as f64) * square_m,
                        pixel_px: corner.pixel_px,
                    })
                    .collect(),
            );
            shown.push(Picture {
                view: None,
                camera,
                path: path.into(),
                refusal,
                repeats: None,
            });
        }
        if view.iter().any(|points| !points.is_empty()) {
            for picture in &mut shown {
                picture.view = Some(views.len());
            }
            views.push(view);
        }
        pictures.extend(shown);
    }
    let sizes_px = sizes_px.into_iter().flatten().collect();
    let mut pictures = Pictures { all: pictures };
    let views = once(views, &mut pictures);
    Ok((sizes_px, views, pictures))
}

/// The views without those that show a placement of the board once more, which are named.
fn once(views: Vec<BoardView>, pictures: &mut Pictures) -> Vec<BoardView> {
    let repeats = repeats(&views);
    for (view, first) in repeats.iter().enumerate() {
        if let Some(first) = first {
            eprintln!(
                "{} shows the board as {} does: counted once",
                pictures.of_view(view),
                pictures.of_view(*first)
            );
        }
    }
    let kept: Vec<usize> = (0..views.len()).filter(|n| repeats[*n].is_none()).collect();
    let now = |view: usize| kept.iter().position(|k| *k == view);
    for picture in &mut pictures.all {
        let Some(view) = picture.view else {
            continue;
        };
        picture.repeats = repeats[view].and_then(now);
        picture.view = now(view);
    }
    let is_kept = |(n, view): (usize, BoardView)| repeats[n].is_none().then_some(view);
    views.into_iter().enumerate().filter_map(is_kept).collect()
}
