//! `rover camera info`: what a model says in pinhole terms, and how far its field reaches.

use super::files::{About, json, load};
use crate::{
    commands::CommandError,
    output::{Output, print},
};
use nalgebra::Vector2;
use rover_cameras::{Camera, formats::ConversionRules};
use serde_json::{Value, json};
use std::{fmt::Write, path::PathBuf};

/// Says what a camera model means: pose, focal lengths, boresight, distortion, field of view
#[derive(Clone, Debug, clap::Args)]
pub(super) struct InfoArgs {
    /// Camera model
    model: PathBuf,
    #[command(flatten)]
    about: About,
    /// Writes the same as JSON; `-` is standard output, without the text
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

/// Runs the verb.
pub(super) fn run(args: &InfoArgs) -> Result<(), CommandError> {
    let output = args
        .json
        .as_deref()
        .map(|path| Output::open(path, args.force))
        .transpose()?;
    let rules = args.about.rules(ConversionRules::default().near_m)?;
    let loaded = load(&args.model, &rules, &args.about)?;
    loaded.report_notes();
    let size = loaded.file.size_px;
    // Without a size the terms are the same; only the field of view is not known.
    let camera = Camera {
        model: loaded.file.model.clone(),
        width_px: size.map_or(1, |s| s[0]),
        height_px: size.map_or(1, |s| s[1]),
    };
    let terms = camera.intrinsics();
    let [c, a, h, v] = camera.model.cahv();
    let (roll, pitch, yaw) = terms.camera_from_model.inverse().euler_angles();
    let field = size.map(|_| field_deg(&camera));
    let lens = camera.model.lens();
    let pupil = match &camera.model {
        rover_cameras::CameraModel::Cahvore(m) => Some((m.e, m.linearity)),
        _ => None,
    };
    let list = |x: &nalgebra::Vector3<f64>| [x.x, x.y, x.z];
    let value = json!({
        "model": camera.model.name(),
        "frame": loaded.file.frame,
        "size_px": size,
        "position_m": list(&terms.position),
        "axis": list(a),
        "focal_px": [terms.hs, terms.vs],
        "boresight_px": [terms.hc, terms.vc],
        "skew_deg": terms.theta_rad.to_degrees() + 90.0,
        "distortion_centre_px": terms.distortion_centre_px.map(|p| [p.x, p.y]),
        "vectors": {
            "c": list(c), "a": list(a), "h": list(h), "v": list(v),
            "o": lens.map(|[o, _]| list(o)),
            "r": lens.map(|[_, r]| list(r)),
            "e": pupil.map(|(e, _)| list(&e)),
            "linearity": pupil.map(|(_, l)| l),
        },
        "field_deg": field,
        "converted": loaded.fidelity,
    });
    if let Some(output) = &output {
        output.write(&json(&value)?)?;
        if output == &Output::Stdout {
            return Ok(());
        }
    }
    let mut text = String::new();
    let mut line = |name: &str, found: String| {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{name:<20}{found}");
    };
    line("model", camera.model.name().into());
    line(
        "frame",
        loaded.file.frame.clone().unwrap_or("not named".into()),
    );
    line(
        "image",
        size.map_or("size not given".into(), |[w, h]| format!("{w} x {h} px")),
    );
    let p = terms.position;
    line("position", format!("{} {} {} m", p.x, p.y, p.z));
    line("axis A", format!("{} {} {}", a.x, a.y, a.z));
    line(
        "turn",
        format!(
            "roll {:.4} pitch {:.4} yaw {:.4} deg (camera axes x right, y down, z forward)",
            roll.to_degrees(),
            pitch.to_degrees(),
            yaw.to_degrees()
        ),
    );
    line(
        "focal length",
        format!("{:.4} {:.4} px", terms.hs, terms.vs),
    );
    line("boresight", format!("{:.4} {:.4} px", terms.hc, terms.vc));
    line(
        "skew",
        format!("{:.6} deg", terms.theta_rad.to_degrees() + 90.0),
    );
    if let (Some(centre), Some([_, r])) = (terms.distortion_centre_px, lens) {
        line(
            "optical axis at",
            format!("{:.4} {:.4} px", centre.x, centre.y),
        );
        line("distortion R", format!("{} {} {}", r.x, r.y, r.z));
    }
    if let Some((e, linearity)) = pupil {
        line("pupil E", format!("{} {} {} m", e.x, e.y, e.z));
        line("linearity", linearity.to_string());
    }
    if let Some(field) = &field {
        line("field of view", shown(field));
    }
    if let Some(fidelity) = loaded.fidelity {
        let how = if fidelity.exact {
            "exactly".to_owned()
        } else {
            format!("by a fit, {:.3e} px off at worst", fidelity.worst_px)
        };
        line("converted", how);
    }
    print(&text)?;
    Ok(())
}

/// Angles between the rays of the middles of opposite borders, and of opposite corners, degrees;
/// null where a pixel has no ray.
fn field_deg(camera: &Camera) -> Value {
    let (right, low) = (
        f64::from(camera.width_px) - 0.5,
        f64::from(camera.height_px) - 0.5,
    );
    let (u, v) = (0.5 * (right - 0.5), 0.5 * (low - 0.5));
    let angle = |from: [f64; 2], to: [f64; 2]| {
        let ray = |[u, v]: [f64; 2]| Some(camera.ray(&Vector2::new(u, v)).ok()?.direction);
        // Through the middle: an angle of two vectors ends at 180 degrees.
        let (a, middle, b) = (ray(from)?, ray([u, v])?, ray(to)?);
        Some((a.angle(&middle) + middle.angle(&b)).to_degrees())
    };
    json!({
        "horizontal": angle([-0.5, v], [right, v]),
        "vertical": angle([u, -0.5], [u, low]),
        "diagonal": angle([-0.5, -0.5], [right, low]),
    })
}

fn shown(field: &Value) -> String {
    ["horizontal", "vertical", "diagonal"]
        .map(|name| match field[name].as_f64() {
            Some(x) => format!("{name} {x:.2} deg"),
            None => format!("{name} beyond the model"),
        })
        .join(", ")
}
