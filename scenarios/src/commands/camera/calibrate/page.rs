//! The residuals as a page: every corner with its error as an arrow, and the errors as a cloud.

use super::{Pictures, SIDES};
use rover_cameras::calibration::{Calibration, QualityProblem};
use std::fmt::Write;

/// Width of a picture's drawing, in its own units.
const WIDTH: f64 = 560.0;
const CLOUD: f64 = 280.0;

/// The page, complete in itself.
pub(super) fn page(
    found: &Calibration,
    pictures: &Pictures,
    problems: &[QualityProblem],
) -> String {
    let mut out = String::from(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Calibration residuals</title>\
         <style>body{font:14px system-ui,sans-serif;margin:2em;max-width:70em}\
         svg{border:1px solid #bbb;background:#fff;margin:.5em}text{font-size:11px;fill:#444}\
         .bad{stroke:#c33}.good{stroke:#2563a8}table{border-collapse:collapse}\
         td{padding:.1em .8em;text-align:right}td:first-child{text-align:left}</style>\
         <h1>Calibration residuals</h1>\
         <p>A residual is the corner as it was found minus the corner as the model images it, in \
         pixels (u to the right, v down). <b style=\"color:#2563a8\">Blue</b>: corners that were \
         used. <b style=\"color:#c33\">Red</b>: corners that were rejected as outliers; they do not \
         count in any figure but their number. Arrows begin at the corner. Blue arrows that turn at \
         random are noise; arrows that swirl or grow together towards the border mean that the \
         model leaves distortion over.</p>",
    );
    for problem in problems {
        // Writing to a String cannot fail.
        let _ = write!(out, "<p><b>Not accepted</b>: {problem}.</p>");
    }
    // The arrows of a typical error are a thirtieth of the picture long.
    let typical_px = found.sigma_px.max(1e-9);
    for (camera, of) in found.cameras.iter().enumerate() {
        let size = [of.width_px, of.height_px];
        let scale = WIDTH / f64::from(size[0].max(1));
        let height = scale * f64::from(size[1]);
        let gain = WIDTH / 30.0 / typical_px;
        // Writing to a String cannot fail.
        let _ = write!(
            out,
            "<h2>{}: {:.3} px rms</h2><svg width=\"{WIDTH}\" height=\"{height:.0}\" role=\"img\">\
             <text x=\"6\" y=\"14\">errors {:.0} times as long as in the picture</text>",
            SIDES[camera],
            found.rms_px[camera],
            gain / scale
        );
        let own = || found.residuals.iter().filter(|r| r.camera == camera);
        for r in own() {
            let (x, y) = (scale * (r.pixel_px.x + 0.5), scale * (r.pixel_px.y + 0.5));
            let arrow = r.error_px * gain;
            // An outlier's arrow would leave the picture.
            let arrow = arrow * (WIDTH / 8.0 / arrow.norm().max(WIDTH / 8.0));
            let _ = write!(
                out,
                "<path d=\"M{x:.1} {y:.1}l{:.1} {:.1}\" class=\"{}\"/>",
                arrow.x,
                arrow.y,
                if r.used { "good" } else { "bad" }
            );
        }
        let reach = 5.0 * typical_px;
        let half = CLOUD / 2.0;
        let _ = write!(
            out,
            "</svg><svg width=\"{CLOUD}\" height=\"{CLOUD}\" role=\"img\">\
             <path d=\"M{half} 0V{CLOUD}M0 {half}H{CLOUD}\" stroke=\"#ddd\"/>\
             <text x=\"6\" y=\"14\">errors, border at {reach:.3} px</text>"
        );
        for r in own().filter(|r| r.error_px.amax() < reach) {
            let at = r.error_px * (half / reach);
            let _ = write!(
                out,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.5\" fill=\"{}\"/>",
                half + at.x,
                half + at.y,
                if r.used { "#2563a8" } else { "#c33" }
            );
        }
        out.push_str("</svg>");
    }
    out.push_str(&per_picture(found, pictures));
    out.push_str(PARAMETERS);
    for p in &found.parameters {
        let _ = write!(
            out,
            "<tr><td>{}<td>{:.6}<td>{:.2e}</tr>",
            p.name, p.value, p.sigma
        );
    }
    out.push_str("</table></html>\n");
    out
}

/// What the names stand for; the head of their table.
const PARAMETERS: &str = "<h2>Parameters</h2>\
    <p>In a camera's own axes (x right, y down, z forward along A, origin at C) the model is \
    C = (0, 0, 0), A = (0, 0, 1), H = (fx_px, 0, cx_px), V = (0, fy_px, cy_px), \
    O = (tilt_x, tilt_y, 1) scaled to length 1 (the tilt of the optical axis against A, as the \
    tangent of its angle), R = (0, r1, r2) and, for CAHVORE, E = (e0_m, e1_m, e2_m). \
    The left camera's axes are the frame of the results. A point X in them is \
    turn X + shift in the axes of the right camera, where turn is the rotation about the vector \
    (turn_x_rad, turn_y_rad, turn_z_rad) by its length and shift = (shift_x_m, shift_y_m, \
    shift_z_m), metres; so that the right camera's C is -turn<sup>-1</sup> shift, its A, H, V and O \
    are turned by turn<sup>-1</sup>, and the baseline is the length of the shift. \
    Sigma is one standard deviation, in the unit of the value: _px pixels, _m metres, _rad \
    radians; tilt, r1 and r2 have no unit.</p>\
    <table><tr><td>name<td>value<td>sigma</tr>";

/// A table of what became of every picture.
fn per_picture(found: &Calibration, pictures: &Pictures) -> String {
    let fits = found.pictures();
    let mut out = String::from(
        "<h2>Pictures</h2><p>Rms: of the corners used; median: of all corners, both px. A pair of \
         which one picture lost more than half of its corners was left out as a whole.</p>\
         <table><tr><td>picture<td>corners<td>rejected<td>rms<td>median<td></tr>",
    );
    for picture in &pictures.all {
        let name = escaped(&picture.path.display().to_string());
        let fit = fits
            .iter()
            .find(|f| Some(f.view) == picture.view && f.camera == picture.camera);
        // Writing to a String cannot fail.
        let _ = match fit {
            Some(fit) => write!(
                out,
                "<tr><td>{name}<td>{}<td>{}<td>{}<td>{:.3}<td>{}</tr>",
                fit.corners,
                fit.rejected,
                fit.rms_px.map_or("-".into(), |x| format!("{x:.3}")),
                fit.median_px,
                if fit.dropped { "left out" } else { "" }
            ),
            None => write!(
                out,
                "<tr><td>{name}<td>0<td><td><td><td>{}</tr>",
                match (&picture.refusal, picture.repeats) {
                    (Some(why), _) => escaped(why),
                    (None, Some(_)) => "shows a placement once more".into(),
                    (None, None) => String::new(),
                }
            ),
        };
    }
    out.push_str("</table>");
    out
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}
