//! `rover vision find`: one image, one kind of fiducial.

use std::path::PathBuf;

use nalgebra::{Isometry3, Matrix2, Vector2, Vector3};
use rover_vision::find::{self, Appearance, DiscTruth, Finding, FindingRecord, NoFinding};
use rover_vision::ncc::Window;
use rover_vision::{DetectionRules, Image8, PlateLayout};
use serde::Serialize;

use super::input;
use crate::commands::{CommandError, Exit};
use crate::output::Output;

/// Finds a fiducial in an image: position, score, standard deviation, and the pose if it has one
#[derive(Clone, Debug, clap::Args)]
pub struct FindArgs {
    /// Image; `-` is standard input
    pub image: PathBuf,
    /// What to look for
    #[arg(long, value_name = "KIND")]
    pub fiducial: Kind,
    /// Searches around this pixel, instead of the whole image (all but plate)
    #[arg(long, value_name = "U,V", value_parser = input::numbers::<2>, allow_hyphen_values = true)]
    pub near: Option<[f64; 2]>,
    /// How far from --near, or from a predicted pose, in u and in v [default: 20]
    #[arg(long, value_name = "PX")]
    pub radius: Option<f64>,
    /// Picture to look for (template)
    #[arg(long, value_name = "PNG")]
    pub template: Option<PathBuf>,
    /// How the picture appears: the 2 x 2 matrix of image offsets by picture offsets (template,
    /// with --near)
    #[arg(long, value_name = "A,B,C,D", value_parser = input::numbers::<4>, allow_hyphen_values = true)]
    pub warp: Option<[f64; 4]>,
    /// Camera model (plate; apriltag, disc and template if their pose or plane is to count)
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Predicted pose in the frame of the camera model: x,y,z in m and quaternion w,x,y,z (plate,
    /// template)
    #[arg(long, value_name = "X,Y,Z,W,I,J,K", value_parser = input::pose, allow_hyphen_values = true)]
    pub pose: Option<Isometry3<f64>>,
    /// Width of the picture, of the standard plate, or of a tag's border square
    #[arg(long, value_name = "M")]
    pub width_m: Option<f64>,
    /// Layout of the plate as TOML, instead of the standard one of --width-m (plate)
    #[arg(long, value_name = "FILE")]
    pub layout: Option<PathBuf>,
    /// Normal of the disc's plane in the frame of the camera model: the disc's true centre is given
    /// (disc, with --model)
    #[arg(long, value_name = "X,Y,Z", value_parser = input::vector, allow_hyphen_values = true)]
    pub normal: Option<Vector3<f64>>,
    /// Tag family (apriltag) [default: tag36h11]
    #[arg(long, value_name = "NAME")]
    pub family: Option<String>,
    /// Thresholds of the detector as TOML; what it leaves out keeps its default
    #[arg(long, value_name = "FILE")]
    pub rules: Option<PathBuf>,
    /// Where the JSON goes; `-` is standard output
    #[arg(long, value_name = "FILE", default_value = "-")]
    pub json: PathBuf,
    /// Overwrites an output that exists
    #[arg(long)]
    pub force: bool,
}

/// Kinds of fiducials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Kind {
    /// Harris corners
    Harris,
    /// A picture, given with --template
    Template,
    /// A dark disc (a light one with the rule polarity = "light")
    Disc,
    /// The crossing of two edges, as in a checker
    Saddle,
    /// The plate of discs and a saddle; gives its pose
    Plate,
    /// A tag of --family; gives its pose with --model and --width-m: origin in the middle, x right,
    /// y up, z out of the tag, as the family's own pictures stand
    Apriltag,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Harris => "harris",
            Self::Template => "template",
            Self::Disc => "disc",
            Self::Saddle => "saddle",
            Self::Plate => "plate",
            Self::Apriltag => "apriltag",
        }
    }
}

#[derive(Serialize)]
struct Report {
    fiducial: &'static str,
    status: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    refused_by: Option<&'static str>,
    #[serde(flatten)]
    best: Option<FindingRecord>,
    others: Vec<FindingRecord>,
}

/// Runs the command.
pub fn run(args: &FindArgs) -> Result<Exit, CommandError> {
    check(args)?;
    let out = Output::open(&args.json, args.force)?;
    let image = input::image(&args.image)?;
    let fiducial = args.fiducial.name();
    let (report, exit) = match detect(args, &image)? {
        Ok(found) => {
            let mut records = found.iter().map(FindingRecord::from);
            let best = records.next();
            let report = Report {
                fiducial,
                status: "ok".into(),
                refused_by: None,
                best,
                others: records.collect(),
            };
            (report, Exit::Done)
        }
        Err(e) if e.is_bad_input() => return Err(CommandError::BadInput(e.to_string())),
        Err(e) => {
            eprintln!("rover: no {fiducial} found: {e}");
            let report = Report {
                fiducial,
                status: e.to_string(),
                refused_by: Some(e.rule()),
                best: None,
                others: Vec::new(),
            };
            (report, Exit::Aborted)
        }
    };
    input::write_json(&out, &report)?;
    Ok(exit)
}

/// Refuses an option that the kind of fiducial, or the other options, leave without effect.
fn check(args: &FindArgs) -> Result<(), CommandError> {
    use Kind::{Apriltag, Disc, Harris, Plate, Saddle, Template};
    let refused = |what: String| Err(CommandError::BadInput(what));
    let kind = args.fiducial;
    if kind == Plate && args.near.is_some() {
        return refused(
            "--near has no meaning for a plate: predict its pose with --pose, or search the whole \
             image"
                .into(),
        );
    }
    let options: [(&str, bool, &[Kind]); 9] = [
        (
            "--near",
            args.near.is_some(),
            &[Harris, Template, Disc, Saddle, Apriltag],
        ),
        ("--template", args.template.is_some(), &[Template]),
        ("--warp", args.warp.is_some(), &[Template]),
        (
            "--model",
            args.model.is_some(),
            &[Template, Disc, Plate, Apriltag],
        ),
        ("--pose", args.pose.is_some(), &[Template, Plate]),
        (
            "--width-m",
            args.width_m.is_some(),
            &[Template, Plate, Apriltag],
        ),
        ("--layout", args.layout.is_some(), &[Plate]),
        ("--normal", args.normal.is_some(), &[Disc]),
        ("--family", args.family.is_some(), &[Apriltag]),
    ];
    for (name, _, kinds) in options.iter().filter(|(_, is_given, _)| *is_given) {
        if !kinds.contains(&kind) {
            let kinds: Vec<&str> = kinds.iter().map(|k| k.name()).collect();
            return refused(format!(
                "{name} has no meaning for --fiducial {}: it is for {}",
                kind.name(),
                kinds.join(", ")
            ));
        }
    }
    let posed = args.pose.is_some();
    let idle = [
        (
            args.radius.is_some() && args.near.is_none() && !posed,
            if kind == Plate {
                "--radius has no effect without --pose"
            } else {
                "--radius has no effect without --near"
            },
        ),
        (
            kind == Disc && args.model.is_some() && args.normal.is_none(),
            "--model has no effect on a disc without --normal",
        ),
        (
            kind == Template && args.model.is_some() && !posed,
            "--model has no effect on a template without --pose",
        ),
        (
            kind == Template && args.width_m.is_some() && !posed,
            "--width-m has no effect on a template without --pose",
        ),
        (
            posed && args.warp.is_some(),
            "--warp has no effect beside --pose: expected one of them",
        ),
        (
            posed && args.near.is_some(),
            "--near has no effect beside --pose: expected one of them",
        ),
        (
            args.layout.is_some() && args.width_m.is_some(),
            "--width-m has no effect beside --layout: expected one of them",
        ),
    ];
    match idle.iter().find(|(is_idle, _)| *is_idle) {
        Some((_, what)) => refused((*what).into()),
        None => Ok(()),
    }
}

impl FindArgs {
    fn radius_px(&self) -> f64 {
        self.radius.unwrap_or(20.0)
    }
}

type Found = Result<Vec<Finding>, NoFinding>;

fn detect(args: &FindArgs, image: &Image8) -> Result<Found, CommandError> {
    let window = match args.near {
        Some(place) => find::near(image, place, args.radius_px())
            .map_err(|e| CommandError::BadInput(format!("--near: {e}")))?,
        None => Window::whole(image),
    };
    let rules = args.rules.as_deref();
    let camera = |why: &str| -> Result<_, CommandError> {
        let path = need(args.model.as_deref(), "--model", why)?;
        input::camera(path, image)
    };
    Ok(match args.fiducial {
        Kind::Harris => find::harris(image, window, &input::rules(rules)?),
        Kind::Saddle => find::saddle(image, window, &input::rules(rules)?),
        Kind::Disc => match args.normal {
            None => find::disc(image, window, &input::rules(rules)?, None),
            Some(normal) => {
                let camera = camera("--normal")?;
                let truth = DiscTruth {
                    camera: &camera,
                    normal,
                };
                find::disc(image, window, &input::rules(rules)?, Some(&truth))
            }
        },
        Kind::Template => return template(args, image, window),
        Kind::Plate => {
            let camera = camera("the plate's pose")?;
            let layout = match &args.layout {
                Some(path) => input::toml_file(path)?,
                None => PlateLayout::standard(*need(
                    args.width_m.as_ref(),
                    "--width-m or --layout",
                    "the plate's size",
                )?),
            };
            let rules: DetectionRules = input::rules(rules)?;
            let prediction = args.pose.as_ref().map(|pose| (pose, args.radius_px()));
            find::plate(image, &camera, &layout, prediction, &rules).map(|one| vec![one])
        }
        Kind::Apriltag => {
            let rules = input::rules(rules)?;
            let family = args.family.as_deref().unwrap_or("tag36h11");
            if args.width_m.is_none() && args.model.is_none() {
                return Ok(find::tags(image, window, family, None, &rules));
            }
            let width_m = *need(args.width_m.as_ref(), "--width-m", "the tag's pose")?;
            let camera = camera("the tag's pose")?;
            find::tags(image, window, family, Some((&camera, width_m)), &rules)
        }
    })
}

fn template(args: &FindArgs, image: &Image8, window: Window) -> Result<Found, CommandError> {
    let path = need(
        args.template.as_deref(),
        "--template",
        "the picture to look for",
    )?;
    let picture = input::image(path)?;
    let rules = input::rules(args.rules.as_deref())?;
    if let Some(pose) = args.pose {
        let model = need(args.model.as_deref(), "--model", "--pose")?;
        let camera = input::camera(model, image)?;
        let appearance = Appearance::Pose {
            camera: &camera,
            camera_frame_from_picture: pose,
            width_m: *need(args.width_m.as_ref(), "--width-m", "--pose")?,
        };
        let found = find::warped_template(image, &picture, &appearance, args.radius_px(), &rules);
        return Ok(found.map(|one| vec![one]));
    }
    if let Some([a, b, c, d]) = args.warp {
        let near = need(args.near.as_ref(), "--near", "--warp")?;
        let appearance = Appearance::Affine {
            place_px: Vector2::from(*near),
            image_from_picture: Matrix2::new(a, b, c, d),
        };
        let found = find::warped_template(image, &picture, &appearance, args.radius_px(), &rules);
        return Ok(found.map(|one| vec![one]));
    }
    let window = match args.near {
        None => window,
        // the middle stays within the radius, the picture reaches beyond
        Some([u, v]) => {
            let (w, h) = (f64::from(picture.width_px), f64::from(picture.height_px));
            let across = find::near(image, [u, v], args.radius_px() + 0.5 * w);
            let down = find::near(image, [u, v], args.radius_px() + 0.5 * h);
            let bad = |e: NoFinding| CommandError::BadInput(format!("--near: {e}"));
            let (across, down) = (across.map_err(bad)?, down.map_err(bad)?);
            Window {
                left: across.left,
                width: across.width,
                ..down
            }
        }
    };
    Ok(find::template(image, &picture, window, &rules).map(|one| vec![one]))
}

/// An argument that another one calls for.
fn need<'a, T: ?Sized>(found: Option<&'a T>, name: &str, why: &str) -> Result<&'a T, CommandError> {
    found
        .ok_or_else(|| CommandError::BadInput(format!("{name} is missing, it is needed for {why}")))
}
