//! `rover camera calibrate`: cameras from pictures of a chessboard whose poses nobody measured.

mod page;

use super::files::json;
use crate::{commands::CommandError, output::Output};
use anyhow::anyhow;
use nalgebra::Vector2;
use rover_cameras::{
    calibration::{BoardPoint, BoardView, Calibration, CalibrationRules, ModelKind, calibrate},
    formats::write_text,
};
use rover_vision::board::{Chessboard, find_chessboard};
use rover_vision::image::Image8;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Calibrates a stereo pair, or one camera, from pictures of a printed chessboard
///
/// Pictures are paired in the order given. Writes left.cahvor and right.cahvor (or .cahv,
/// .cahvore), report.json and residuals.html into the folder DIR. The models are in the axes of the
/// left camera (x right, y down, z forward); the scale is that of the squares.
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
    /// Linearity of a CAHVORE model: 1 perspective, 0 fisheye, or between
    #[arg(long, value_name = "L", default_value_t = 0.0)]
    linearity: f64,
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
    if !(-1.0..=1.0).contains(&args.linearity) {
        return Err(CommandError::BadInput(format!(
            "--linearity {}: expected -1 to 1",
            args.linearity
        )));
    }
    let names: Vec<String> = (0..cameras.len())
        .map(|n| format!("{}.{}", SIDES[n], args.model.extension()))
        .collect();
    let open = |name: &str| Output::open(&args.out.join(name), args.force);
    let models: Vec<Output> = names.iter().map(|n| open(n)).collect::<Result<_, _>>()?;
    let (report, page) = (open("report.json")?, open("residuals.html")?);

    let (sizes_px, views, pictures) = find(&cameras, args.board)?;
    let rules = CalibrationRules {
        model: match args.model {
            Model::Cahv => ModelKind::Cahv,
            Model::Cahvor => ModelKind::Cahvor,
            Model::Cahvore => ModelKind::Cahvore {
                linearity: args.linearity,
            },
        },
        ..CalibrationRules::default()
    };
    let found =
        calibrate(&sizes_px, &views, &rules).map_err(|e| CommandError::BadInput(e.to_string()))?;
    for (output, camera) in models.iter().zip(&found.cameras) {
        let text = write_text(camera, Some(FRAME)).map_err(|e| anyhow!("result: {e}"))?;
        output.write(&text)?;
    }
    report.write(&json(&account(&found, &sizes_px, &pictures))?)?;
    page.write(&page::page(&found, &sizes_px))?;
    for (side, rms_px) in SIDES.iter().zip(&found.rms_px) {
        eprintln!("{side}: {rms_px:.3} px rms");
    }
    eprintln!(
        "{} corners, {} rejected, sigma {:.3} px; results in {}",
        found.residuals.len(),
        found.rejected,
        found.sigma_px,
        args.out.display()
    );
    Ok(())
}

/// A picture and what became of it.
struct Picture {
    view: Option<usize>,
    camera: usize,
    path: PathBuf,
    refusal: Option<String>,
}

/// Finds the board in all pictures; a placement that no camera could use is left out.
fn find(
    cameras: &[&[PathBuf]],
    BoardArg { board, square_m }: BoardArg,
) -> Result<(Vec<[u32; 2]>, Vec<BoardView>, Vec<Picture>), CommandError> {
    let mut sizes_px: Vec<Option<[u32; 2]>> = vec![None; cameras.len()];
    let (mut views, mut pictures) = (Vec::new(), Vec::new());
    for n in 0..cameras[0].len() {
        let mut view: BoardView = Vec::new();
        let mut shown = Vec::new();
        for (camera, images) in cameras.iter().enumerate() {
            let path: &Path = &images[n];
            let bad = |what: String| CommandError::BadInput(format!("{}: {what}", path.display()));
            let image = Image8::read(path).map_err(|e| CommandError::BadInput(e.to_string()))?;
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
    Ok((sizes_px, views, pictures))
}

/// Cells of the residual map across the image.
const MAP: [usize; 2] = [8, 6];

/// Mean error and its RMS over the cells of a camera's image; null where no corner was.
fn map(found: &Calibration, camera: usize, size: [u32; 2]) -> Value {
    let mut cells = vec![(Vector2::zeros(), 0.0, 0_u32); MAP[0] * MAP[1]];
    for r in found
        .residuals
        .iter()
        .filter(|r| r.camera == camera && r.used)
    {
        let cell = [0, 1].map(|axis| {
            let share = (r.pixel_px[axis] + 0.5) / f64::from(size[axis]);
            ((share * MAP[axis] as f64).max(0.0) as usize).min(MAP[axis] - 1)
        });
        let cell = &mut cells[cell[1] * MAP[0] + cell[0]];
        cell.0 += r.error_px;
        cell.1 += r.error_px.norm_squared();
        cell.2 += 1;
    }
    let value = |(sum, squares, n): &(Vector2<f64>, f64, u32)| match n {
        0 => Value::Null,
        n => {
            let n = f64::from(*n);
            json!({ "mean_px": [sum.x / n, sum.y / n], "rms_px": (squares / n).sqrt(), "n": n })
        }
    };
    let rows: Vec<Vec<Value>> = cells
        .chunks(MAP[0])
        .map(|row| row.iter().map(value).collect())
        .collect();
    json!(rows)
}

fn account(found: &Calibration, sizes_px: &[[u32; 2]], pictures: &[Picture]) -> Value {
    let sides = &SIDES[..found.cameras.len()];
    let by_side = |of: &dyn Fn(usize) -> Value| -> Value {
        sides
            .iter()
            .enumerate()
            .map(|(n, side)| ((*side).to_owned(), of(n)))
            .collect()
    };
    let covariance: Vec<Vec<f64>> = found
        .covariance
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect();
    json!({
        "frame": FRAME,
        "rms_px": by_side(&|n| json!(found.rms_px[n])),
        "sigma_px": found.sigma_px,
        "corners": found.residuals.len(),
        "rejected": found.rejected,
        "parameters": found.parameters.iter().map(|p| json!({
            "name": p.name, "value": p.value, "sigma": p.sigma,
        })).collect::<Vec<_>>(),
        "covariance": covariance,
        "residual_map": by_side(&|n| map(found, n, sizes_px[n])),
        "board_poses": found.camera_from_board.iter().map(|pose| {
            let (t, q) = (pose.translation.vector, pose.rotation);
            json!({ "position_m": [t.x, t.y, t.z], "quaternion_wxyz": [q.w, q.i, q.j, q.k] })
        }).collect::<Vec<_>>(),
        "pictures": pictures.iter().map(|p| json!({
            "file": p.path.display().to_string(),
            "camera": SIDES[p.camera],
            "view": p.view,
            "refused": p.refusal,
        })).collect::<Vec<_>>(),
    })
}
