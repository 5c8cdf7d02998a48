//! `rover vision disparity`: the disparity of every pixel of a pair.

use std::fmt::Write;
use std::path::PathBuf;

use nalgebra::Vector2;
use rover_cameras::{Camera, StereoPair};
use rover_vision::{DenseRules, Disparity, PairDisparityError, Rectifier};
use serde::Serialize;

use super::stereo::PairArgs;
use super::{doubt, input};
use crate::commands::{CommandError, Exit};
use crate::output::Output;

/// Gives the disparity of every pixel, for the operator's view and for finding obstacles
///
/// Both images are rectified first; columns and rows are those of the rectified left image, whose
/// camera the JSON summary names. A PNG has 16 bits: value / 64 is the disparity in px, 0 marks a
/// pixel without an answer. A CSV has a row for every pixel, u_px,v_px,disparity_px,x_m,y_m,z_m,
/// status, in the frame of the camera models. Pictures that seem exchanged, unrelated or the same are
/// told. Ranges here are depths along the rectified cameras' axis;
/// without --range-max-m the search begins at infinity, without --range-min-m it ends after as many
/// disparities as the rules say. Exit code 3: no pixel has an answer.
#[derive(Clone, Debug, clap::Args)]
pub struct DisparityArgs {
    #[command(flatten)]
    pair: PairArgs,
    /// Where the disparities go: FILE.png, FILE.csv, or `-` for CSV on standard output
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Writes a summary as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

/// Disparity that a point at infinity is given at least, px: noise must not push it out.
const ROOM_PX: f64 = 2.0;
/// Most disparities that can be searched.
const MOST: u32 = 256;

/// A camera of the rectified pair as vectors of a CAHV model.
#[derive(Serialize)]
struct Rectified {
    c: [f64; 3],
    a: [f64; 3],
    h: [f64; 3],
    v: [f64; 3],
}

#[derive(Serialize)]
struct Summary {
    width_px: u32,
    height_px: u32,
    /// Pixels with a disparity.
    found: usize,
    found_percent: f64,
    /// Disparities searched, px: from, up to.
    searched_px: [f64; 2],
    /// Depths searched, m: nearest, farthest; no farthest if up to infinity.
    searched_depth_m: [Option<f64>; 2],
    /// Least, median and largest disparity found, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    disparity_px: Option<[f64; 3]>,
    /// Depths of these, m: nearest, median, farthest.
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_m: Option<[f64; 3]>,
    /// Disparity times depth, px m.
    disparity_depth_px_m: f64,
    /// What a PNG's value is divided by, and the value of a pixel without an answer.
    png_steps_per_px: u32,
    png_no_answer: u16,
    rectified_left: Rectified,
    rectified_right: Rectified,
    /// What speaks against the pictures: exchanged, of two scenes, or twice the same.
    warnings: Vec<String>,
}

enum Form {
    Png,
    Csv,
}

fn form(args: &DisparityArgs) -> Result<Form, CommandError> {
    let name = args.out.display();
    let end = args
        .out
        .extension()
        .map(|e| e.to_string_lossy().to_lowercase());
    match end.as_deref() {
        _ if args.out.as_os_str() == "-" => Ok(Form::Csv),
        Some("png") => Ok(Form::Png),
        Some("csv") => Ok(Form::Csv),
        _ => Err(CommandError::BadInput(format!(
            "--out {name}: expected a name that ends in .png or .csv, or -"
        ))),
    }
}

/// The search: shift of the rectification, px, and number of disparities.
fn search(
    args: &PairArgs,
    disparity_depth_px_m: f64,
    rules: &DenseRules,
) -> Result<(i32, u32), CommandError> {
    for (name, x) in [
        ("--range-min-m", args.range_min_m),
        ("--range-max-m", args.range_max_m),
    ] {
        if let Some(x) = x
            && !(x.is_finite() && x > 0.0)
        {
            return Err(CommandError::BadInput(format!(
                "{name} is {x}, expected a positive length"
            )));
        }
    }
    let far_px = args
        .range_max_m
        .map_or(0.0, |far| disparity_depth_px_m / far);
    let shift = far_px.floor() - ROOM_PX;
    let Some(near) = args.range_min_m else {
        return Ok((shift as i32, rules.disparities));
    };
    if let Some(far) = args.range_max_m
        && far <= near
    {
        return Err(CommandError::BadInput(format!(
            "--range-max-m is {far}, expected more than --range-min-m, which is {near}"
        )));
    }
    let count = (disparity_depth_px_m / near).ceil() - shift + ROOM_PX;
    if count > f64::from(MOST) {
        return Err(CommandError::BadInput(format!(
            "the ranges span {count} disparities, at most {MOST} are searched: expected a larger \
             --range-min-m or a smaller --range-max-m"
        )));
    }
    Ok((shift as i32, (count as u32).max(16)))
}

/// Runs `rover vision disparity`.
pub fn run(args: &DisparityArgs) -> Result<Exit, CommandError> {
    let form = form(args)?;
    let out = Output::open(&args.out, args.force)?;
    let json = match &args.json {
        Some(path) => Some(Output::open(path, args.force)?),
        None => None,
    };
    if out == Output::Stdout && json == Some(Output::Stdout) {
        return Err(CommandError::BadInput(
            "--out and --json are both standard output, expected a file for one of them".into(),
        ));
    }
    let mut rules: DenseRules = input::rules(args.pair.rules.as_deref())?;
    let (pair, left, right) = args.pair.images()?;
    let bad = |e: &dyn std::fmt::Display| CommandError::BadInput(e.to_string());
    let depth = Rectifier::disparity_depth_px_m(&pair).map_err(|e| bad(&e))?;
    let (shift, disparities) = search(&args.pair, depth, &rules)?;
    rules.disparities = disparities;
    let rectifier = Rectifier::new(&pair, f64::from(shift)).map_err(|e| bad(&e))?;
    let found = rectifier
        .disparity(&left, &right, &rules)
        .map_err(|e: PairDisparityError| bad(&e))?;
    let field = Field {
        pair: &rectifier.pair,
        found: &found,
        shift_px: shift,
        depth_px_m: depth,
    };
    match form {
        Form::Png => out.write_bytes(&found.encode_png(shift).map_err(|e| bad(&e))?)?,
        Form::Csv => out.write(&field.table())?,
    }
    let mut summary = field.summary(&rules);
    let share = 0.01 * summary.found_percent;
    let search = (f64::from(shift), &rules);
    summary
        .warnings
        .extend(doubt::of_disparities(&pair, (&left, &right), search, share));
    let depth = |d: Option<f64>| d.map_or("infinity".into(), |d| format!("{d:.3} m"));
    let [near, far] = summary.searched_depth_m.map(depth);
    eprintln!(
        "rover: {} of {} pixels have a disparity; depths of {near} to {far} were searched",
        summary.found,
        found.width_px * found.height_px
    );
    if args.pair.range_min_m.is_none() {
        eprintln!(
            "rover: what is nearer than {near} cannot be matched, and may be matched wrongly: \
             --range-min-m extends the search"
        );
    }
    for warning in &summary.warnings {
        eprintln!("rover: warning: {warning}");
    }
    if let Some(json) = json {
        input::write_json(&json, &summary)?;
    }
    Ok(if summary.found > 0 {
        Exit::Done
    } else {
        Exit::Aborted
    })
}

/// What was found, and how it was rectified.
struct Field<'a> {
    pair: &'a StereoPair,
    found: &'a Disparity,
    shift_px: i32,
    depth_px_m: f64,
}

impl Field<'_> {
    /// The disparity of a pixel, px, if it is that of a point before infinity.
    fn at(&self, u: u32, v: u32) -> Result<f64, &'static str> {
        let found = self
            .found
            .at(u, v)
            .ok_or("no match that is textured, unique, mutual and part of a surface")?;
        let disparity = found + f64::from(self.shift_px);
        if disparity > 0.0 {
            Ok(disparity)
        } else {
            Err("the match lies beyond infinity")
        }
    }

    fn pixels(&self) -> impl Iterator<Item = (u32, u32)> + use<> {
        let (w, h) = (self.found.width_px, self.found.height_px);
        (0..h).flat_map(move |v| (0..w).map(move |u| (u, v)))
    }

    fn table(&self) -> String {
        let mut text = String::from("u_px,v_px,disparity_px,x_m,y_m,z_m,status\n");
        for (u, v) in self.pixels() {
            let line = self.at(u, v).map_err(str::to_owned).and_then(|disparity| {
                let pixel = Vector2::new(f64::from(u), f64::from(v));
                let ray = self.pair.left.ray(&pixel).map_err(|e| e.to_string())?;
                let along = ray.direction.dot(self.pair.left.model.cahv()[1]);
                let p = ray.at(self.depth_px_m / disparity / along);
                Ok(format!("{disparity},{},{},{},ok", p.x, p.y, p.z))
            });
            let line = line.unwrap_or_else(|why| format!(",,,,{why}"));
            let _ = writeln!(text, "{u},{v},{line}");
        }
        text
    }

    fn summary(&self, rules: &DenseRules) -> Summary {
        let mut all: Vec<f64> = self
            .pixels()
            .filter_map(|(u, v)| self.at(u, v).ok())
            .collect();
        all.sort_by(f64::total_cmp);
        let few = || Some([*all.first()?, *all.get(all.len() / 2)?, *all.last()?]);
        let from = f64::from(self.shift_px).max(0.0);
        let to = f64::from(self.shift_px) + f64::from(rules.disparities) - 1.0;
        let pixels = f64::from(self.found.width_px) * f64::from(self.found.height_px);
        Summary {
            width_px: self.found.width_px,
            height_px: self.found.height_px,
            found: all.len(),
            found_percent: 100.0 * all.len() as f64 / pixels,
            searched_px: [from, to],
            searched_depth_m: [to, from].map(|d| (d > 0.0).then(|| self.depth_px_m / d)),
            disparity_px: few(),
            depth_m: few()
                .map(|[least, middle, most]| [most, middle, least].map(|d| self.depth_px_m / d)),
            disparity_depth_px_m: self.depth_px_m,
            png_steps_per_px: Disparity::STEPS_PER_PX,
            png_no_answer: 0,
            rectified_left: vectors(&self.pair.left, 0),
            rectified_right: vectors(&self.pair.right, self.shift_px),
            warnings: Vec::new(),
        }
    }
}

/// The rectified camera, its image moved back by the shift of the search.
fn vectors(camera: &Camera, shift_px: i32) -> Rectified {
    let [c, a, h, v] = camera.model.cahv();
    let h = h - a * f64::from(shift_px);
    let [c, a, h, v] = [c, a, &h, v].map(|x| [x.x, x.y, x.z]);
    Rectified { c, a, h, v }
}
