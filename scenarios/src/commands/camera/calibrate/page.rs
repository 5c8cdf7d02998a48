//! The residuals as a page: every corner with its error as an arrow, and the errors as a cloud.

use rover_cameras::calibration::Calibration;
use std::fmt::Write;

/// Width of a picture's drawing, in its own units.
const WIDTH: f64 = 560.0;
const CLOUD: f64 = 280.0;

/// The page, complete in itself.
pub(super) fn page(found: &Calibration, sizes_px: &[[u32; 2]]) -> String {
    let mut out = String::from(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Calibration residuals</title>\
         <style>body{font:14px system-ui,sans-serif;margin:2em;max-width:70em}\
         svg{border:1px solid #bbb;background:#fff;margin:.5em}text{font-size:11px;fill:#444}\
         .bad{stroke:#c33}.good{stroke:#2563a8}table{border-collapse:collapse}\
         td{padding:.1em .8em;text-align:right}td:first-child{text-align:left}</style>\
         <h1>Calibration residuals</h1>",
    );
    // The arrows of a typical error are a thirtieth of the picture long.
    let typical_px = found.sigma_px.max(1e-9);
    for (camera, size) in sizes_px.iter().enumerate() {
        let scale = WIDTH / f64::from(size[0].max(1));
        let height = scale * f64::from(size[1]);
        let gain = WIDTH / 30.0 / typical_px;
        // Writing to a String cannot fail.
        let _ = write!(
            out,
            "<h2>{}: {:.3} px rms</h2><svg width=\"{WIDTH}\" height=\"{height:.0}\" role=\"img\">\
             <text x=\"6\" y=\"14\">errors {:.0} times as long as in the picture</text>",
            ["left", "right"][camera.min(1)],
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
    out.push_str("<h2>Parameters</h2><table><tr><td>name<td>value<td>sigma</tr>");
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
