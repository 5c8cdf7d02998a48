//! `rover vision match` and `rover vision normal`: a stereo pair and its camera models.

use std::path::PathBuf;

use nalgebra::Vector2;
use rover_cameras::{MissLimit, StereoPair};
use rover_vision::{
    Image8, MatchRules, PreparedImage, SurfaceFailure, SurfaceRules, match_point, measure_surface,
};
use serde::Serialize;

use super::doubt::Matches;
use super::input;
use crate::commands::{CommandError, Exit};
use crate::output::Output;
use crate::tables::{Table, TableWriter};

/// The images and models of a pair.
#[derive(Clone, Debug, clap::Args)]
pub struct PairArgs {
    /// Left image
    pub left: PathBuf,
    /// Right image
    pub right: PathBuf,
    /// Camera model of the left image
    #[arg(long, value_name = "FILE")]
    pub left_model: PathBuf,
    /// Camera model of the right image
    #[arg(long, value_name = "FILE")]
    pub right_model: PathBuf,
    /// Nearest surface searched; without it the rules decide (match, normal: 0.35 m)
    #[arg(long, value_name = "M")]
    pub range_min_m: Option<f64>,
    /// Farthest surface searched; without it the rules decide (match, normal: 1.5 m)
    #[arg(long, value_name = "M")]
    pub range_max_m: Option<f64>,
    /// Thresholds as TOML; what it leaves out keeps its default
    #[arg(long, value_name = "FILE")]
    pub rules: Option<PathBuf>,
}

struct Loaded {
    pair: StereoPair,
    left: PreparedImage,
    right: PreparedImage,
}

impl PairArgs {
    /// The cameras, the left and the right image.
    pub fn images(&self) -> Result<(StereoPair, Image8, Image8), CommandError> {
        let (left, right) = (input::image(&self.left)?, input::image(&self.right)?);
        let pair = input::pair((&self.left_model, &self.right_model), (&left, &right))?;
        Ok((pair, left, right))
    }

    fn load(&self) -> Result<Loaded, CommandError> {
        let (pair, left, right) = self.images()?;
        let prepare = |image: &Image8| {
            PreparedImage::new(image).map_err(|e| CommandError::BadInput(e.to_string()))
        };
        Ok(Loaded {
            pair,
            left: prepare(&left)?,
            right: prepare(&right)?,
        })
    }

    fn limit(&self, rules: &mut MatchRules) {
        rules.range_min_m = self.range_min_m.unwrap_or(rules.range_min_m);
        rules.range_max_m = self.range_max_m.unwrap_or(rules.range_max_m);
    }
}

/// Matches pixels of the left image in the right one, and triangulates them
///
/// Columns u_px,v_px in; ur_px,vr_px,x_m,y_m,z_m,score,status out, in the frame of the camera
/// models. Nothing is rectified: the true epipolar curve is searched, and a local plane fitted.
/// Pictures that seem exchanged or unrelated are told.
#[derive(Clone, Debug, clap::Args)]
pub struct MatchArgs {
    #[command(flatten)]
    pair: PairArgs,
    /// Table of left pixels, u_px,v_px; `-` is standard input
    #[arg(long, value_name = "CSV")]
    pixels: PathBuf,
    /// Where the table of matches goes; `-` is standard output
    #[arg(long, value_name = "CSV", default_value = "-")]
    out: PathBuf,
    /// Writes how many pixels have a match, and warnings, as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct MatchReport {
    pixels: u64,
    matched: u64,
    /// What speaks against the pictures: exchanged, or of two scenes.
    warnings: Vec<String>,
}

const MATCH_COLUMNS: [&str; 6] = ["ur_px", "vr_px", "x_m", "y_m", "z_m", "score"];

/// Runs `rover vision match`.
pub fn run_match(args: &MatchArgs) -> Result<Exit, CommandError> {
    let json = args
        .json
        .as_deref()
        .map(|path| Output::open(path, args.force))
        .transpose()?;
    if json == Some(Output::Stdout) && args.out.as_os_str() == "-" {
        return Err(CommandError::BadInput(
            "--out and --json are both standard output, expected a file for one of them".into(),
        ));
    }
    let mut rules: MatchRules = input::rules(args.pair.rules.as_deref())?;
    args.pair.limit(&mut rules);
    rules.validate().map_err(CommandError::BadInput)?;
    let table = Table::open(&args.pixels, &["u_px", "v_px"])?;
    let loaded = args.pair.load()?;
    let mut out = TableWriter::create(&args.out, args.force, &MATCH_COLUMNS)?;
    let mut matches = Matches::default();
    for row in table {
        let answer = row?.array::<2>().and_then(|[u, v]| {
            let pixel = Vector2::new(u, v);
            matched(&loaded, pixel, &rules, &mut matches)
        });
        out.answer(answer)?;
        if out.is_closed() {
            break;
        }
    }
    let (matched, refused) = out.counts();
    out.finish()?;
    let Loaded { pair, left, right } = &loaded;
    let warning = matches.doubt(pair, (left, right), &rules);
    if let Some(warning) = &warning {
        eprintln!("rover: warning: {warning}");
    }
    if let Some(json) = json {
        let report = MatchReport {
            pixels: matched + refused,
            matched,
            warnings: warning.into_iter().collect(),
        };
        input::write_json(&json, &report)?;
    }
    Ok(Exit::Done)
}

fn matched(
    loaded: &Loaded,
    pixel: Vector2<f64>,
    rules: &MatchRules,
    matches: &mut Matches,
) -> Result<[f64; 6], String> {
    let Loaded { pair, left, right } = loaded;
    let found = match_point(left, right, pair, &pixel, rules);
    matches.add(pixel, found.as_ref().err());
    let found = found.map_err(|e| e.to_string())?;
    let seen = pair
        .triangulate(&pixel, &found.right_px)
        .map_err(|e| e.to_string())?;
    seen.check_miss(&MissLimit::default())
        .map_err(|e| e.to_string())?;
    let p = seen.point;
    Ok([
        found.right_px.x,
        found.right_px.y,
        p.x,
        p.y,
        p.z,
        found.score,
    ])
}

/// Measures the surface under a left pixel: position, normal, plane rms, points used, roughness
#[derive(Clone, Debug, clap::Args)]
pub struct NormalArgs {
    #[command(flatten)]
    pair: PairArgs,
    /// Pixel in the left image
    #[arg(long, value_name = "U,V", value_parser = input::numbers::<2>, allow_hyphen_values = true)]
    pixel: [f64; 2],
    /// Where the JSON goes; `-` is standard output
    #[arg(long, value_name = "FILE", default_value = "-")]
    json: PathBuf,
    /// Overwrites an output that exists
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct SurfaceReport {
    position_m: [f64; 3],
    normal: [f64; 3],
    /// In the direction in which the normal is known least.
    normal_sigma_deg: Option<f64>,
    plane_rms_mm: f64,
    points_used: usize,
    roughness_mm: f64,
    range_m: f64,
    /// Standard deviations of the position along the frame's axes.
    sigma_mm: [f64; 3],
    match_sigma_px: f64,
    score: f64,
    epipolar_px: f64,
}

#[derive(Serialize)]
struct NormalReport {
    pixel_px: [f64; 2],
    status: String,
    #[serde(flatten)]
    surface: Option<SurfaceReport>,
}

/// Runs `rover vision normal`.
pub fn run_normal(args: &NormalArgs) -> Result<Exit, CommandError> {
    let out = Output::open(&args.json, args.force)?;
    let mut rules: SurfaceRules = input::rules(args.pair.rules.as_deref())?;
    args.pair.limit(&mut rules.matching);
    rules.validate().map_err(CommandError::BadInput)?;
    let Loaded { pair, left, right } = args.pair.load()?;
    let pixel = Vector2::from(args.pixel);
    let (status, surface, exit) = match measure_surface(&left, &right, &pair, &pixel, &rules) {
        Ok(s) => {
            let (p, n) = (s.position, s.normal);
            let report = SurfaceReport {
                position_m: [p.x, p.y, p.z],
                normal: [n.x, n.y, n.z],
                normal_sigma_deg: s.normal_sigma_rad.map(f64::to_degrees),
                plane_rms_mm: s.plane_rms_m * 1e3,
                points_used: s.points_used,
                roughness_mm: s.roughness_m * 1e3,
                range_m: s.range_m,
                sigma_mm: [0, 1, 2].map(|i| s.covariance[(i, i)].max(0.0).sqrt() * 1e3),
                match_sigma_px: s.sigma_px,
                score: s.score,
                epipolar_px: s.epipolar_px,
            };
            ("ok".to_owned(), Some(report), Exit::Done)
        }
        Err(SurfaceFailure::BadInput(what)) => return Err(CommandError::BadInput(what)),
        Err(e) => {
            eprintln!("rover: no surface at {}, {}: {e}", pixel.x, pixel.y);
            (e.to_string(), None, Exit::Aborted)
        }
    };
    input::write_json(
        &out,
        &NormalReport {
            pixel_px: args.pixel,
            status,
            surface,
        },
    )?;
    Ok(exit)
}
