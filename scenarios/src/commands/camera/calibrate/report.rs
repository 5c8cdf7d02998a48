//! What a calibration was: its figures as JSON, and the same in a few lines.

use super::{FRAME, Pictures, SIDES};
use rover_cameras::calibration::{CELLS, Calibration, Parameter, QualityProblem};
use serde_json::{Value, json};

/// Mean error and its RMS over the cells of a camera's image; null where no corner was.
fn map(found: &Calibration, camera: usize) -> Value {
    let cells: Vec<Value> = found
        .cells(camera)
        .iter()
        .map(|(mean, rms_px, n)| match n {
            0 => Value::Null,
            n => json!({ "mean_px": [mean.x, mean.y], "rms_px": rms_px, "n": n }),
        })
        .collect();
    cells.chunks(CELLS[0]).map(|row| json!(row)).collect()
}

/// The whole account.
pub(super) fn account(
    found: &Calibration,
    pictures: &Pictures,
    problems: &[QualityProblem],
) -> Value {
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
    let fits = found.pictures();
    json!({
        "frame": FRAME,
        "accepted": problems.is_empty(),
        "problems": problems.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "rms_px": by_side(&|n| json!(found.rms_px[n])),
        "sigma_px": found.sigma_px,
        "corners": found.residuals.len(),
        "rejected": found.rejected,
        "views_left_out": found.dropped,
        "left_over_px": by_side(&|n| json!(found.left_over_px(n))),
        "structured_share": by_side(&|n| json!(found.structured_share(n))),
        "baseline_m": found.baseline_m().map(|b| json!({ "value": b.value, "sigma": b.sigma })),
        "parameters": found.parameters.iter().map(|p| json!({
            "name": p.name, "value": p.value, "sigma": p.sigma,
        })).collect::<Vec<_>>(),
        "covariance": covariance,
        "residual_map": by_side(&|n| map(found, n)),
        "board_poses": found.camera_from_board.iter().map(|pose| {
            let (t, q) = (pose.translation.vector, pose.rotation);
            json!({ "position_m": [t.x, t.y, t.z], "quaternion_wxyz": [q.w, q.i, q.j, q.k] })
        }).collect::<Vec<_>>(),
        "pictures": pictures.all.iter().map(|p| {
            let fit = fits.iter().find(|f| Some(f.view) == p.view && f.camera == p.camera);
            json!({
                "file": p.path.display().to_string(),
                "camera": SIDES[p.camera],
                "view": p.view,
                "refused": p.refusal,
                "repeats_view": p.repeats,
                "corners": fit.map_or(0, |f| f.corners),
                "rejected": fit.map(|f| f.rejected),
                "rms_px": fit.and_then(|f| f.rms_px),
                "median_px": fit.map(|f| f.median_px),
                "left_out": fit.is_some_and(|f| f.dropped),
            })
        }).collect::<Vec<_>>(),
    })
}

/// The views left out, each with its pictures and how far off they are.
pub(super) fn left_out(found: &Calibration, pictures: &Pictures) -> Vec<String> {
    let fits = found.pictures();
    found
        .dropped
        .iter()
        .map(|view| {
            let off: Vec<String> = fits
                .iter()
                .filter(|f| f.view == *view)
                .map(|f| format!("{:.1} px", f.median_px))
                .collect();
            format!(
                "{} (corners off by {} in the median)",
                pictures.of_view(*view),
                off.join(" and ")
            )
        })
        .collect()
}

/// What is printed of a calibration.
pub(super) fn summary(found: &Calibration) -> String {
    let fits = found.pictures();
    let parameter = |name: &str| found.parameters.iter().find(|p| p.name == name);
    let mut lines: Vec<String> = SIDES
        .iter()
        .zip(&found.rms_px)
        .enumerate()
        .map(|(camera, (side, rms_px))| {
            let own = || fits.iter().filter(|f| f.camera == camera);
            let fx = parameter(&format!("{side}.fx_px"))
                .map(|p| format!(", fx {:.2} +- {:.2} px", p.value, p.sigma));
            format!(
                "{side}: {rms_px:.3} px rms{}, {} corners in {} pictures, {} rejected",
                fx.unwrap_or_default(),
                own().map(|f| f.corners).sum::<usize>(),
                own().count(),
                own().map(|f| f.rejected).sum::<usize>(),
            )
        })
        .collect();
    if let Some(Parameter { value, sigma, .. }) = found.baseline_m() {
        lines.push(format!(
            "baseline: {:.3} +- {:.3} mm",
            1e3 * value,
            1e3 * sigma
        ));
    }
    lines.push(format!(
        "{} corners, {} rejected, sigma {:.3} px",
        found.residuals.len(),
        found.rejected,
        found.sigma_px
    ));
    lines.join("\n")
}

/// A word on errors that have a pattern.
pub(super) fn pattern(found: &Calibration, camera: usize, more: &str) -> Option<String> {
    found.left_over_px(camera).map(|px| {
        format!(
            "{}: {px:.2} px rms of the error is common to neighbouring corners: distortion is left over \
             (or the board is not flat); {more}",
            SIDES[camera]
        )
    })
}
