//! A run as one self-contained page: numbers, pictures, plots, the effective scenario. The page
//! refers to nothing outside of itself.

mod approach;
mod bullseye;
mod picture;
mod timeline;

use crate::{
    evidence::Evidence,
    report::{Outcome, RunReport},
    scenario::LoadedScenario,
};
use picture::{Mark, Overlay, figure};
use rover_messages::{imaging::ImageData, placement::Look};
use rover_page::{
    BLUE, GREEN, ORANGE, PURPLE, YELLOW, document, escape,
    plot::{Marks, Plot, Series},
    section,
};
use std::fmt::Write;

/// Why a page could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A picture could not be encoded.
    #[error("picture for the report: {0}")]
    Picture(#[from] image::ImageError),
    /// The scenario cannot be written.
    #[error(transparent)]
    Scenario(#[from] crate::scenario::ScenarioError),
}

/// The page of one run.
///
/// # Errors
/// [`PageError`].
pub fn page(
    report: &RunReport,
    evidence: &Evidence,
    loaded: &LoadedScenario,
) -> Result<String, PageError> {
    let scenario = &loaded.scenario;
    let mut body = String::new();
    body += &header(report, &scenario.description);
    body += &cards(report);
    body += &views(evidence)?;
    body += &designation(evidence)?;
    body += &approach::approach(report, evidence)?;
    body += &where_the_servo_ended(evidence)?;
    body += &servo(report, evidence);
    let kinds = timeline::kinds(&report.wall_by_kind_s);
    body += &section("Timeline", &(timeline::timeline(&report.phases) + &kinds));
    body += &section("Measured against the truth", &truth(report, evidence));
    let toml = escape(&scenario.to_toml()?);
    body += &section(
        "Effective scenario",
        &format!(
            "<details><summary>TOML, every default filled in</summary><pre>{toml}</pre></details>"
        ),
    );
    let title = format!("{}: {}", scenario.name, outcome(report));
    let footer = format!(
        "rover {} · robot <b>{}</b> · seed <b>{}</b> · digest <code>{}</code>",
        env!("CARGO_PKG_VERSION"),
        escape(&report.robot),
        report.seed,
        report.digest,
    );
    Ok(document(&title, &body, &footer))
}

fn outcome(report: &RunReport) -> &'static str {
    match report.outcome {
        Outcome::Placed => "placed",
        Outcome::Aborted => "aborted",
    }
}

fn header(report: &RunReport, description: &str) -> String {
    let outcome = outcome(report);
    let reason = report.reason.as_ref().map_or(String::new(), |reason| {
        format!("<p class=\"reason\">{}</p>", escape(reason))
    });
    format!(
        "<header><h1>{}<span class=\"badge {outcome}\">{outcome}</span></h1>\
         <p class=\"lead\">{}</p>{reason}</header>\n",
        escape(&report.scenario),
        escape(description)
    )
}

fn card(name: &str, value: &str, unit: &str, note: &str) -> String {
    format!(
        "<div class=\"card\"><div class=\"name\">{name}</div><div class=\"value\">{value}\
         <span class=\"unit\">{unit}</span></div><div class=\"note\">{note}</div></div>"
    )
}

fn cards(report: &RunReport) -> String {
    let mut cards = String::new();
    let number =
        |v: Option<f64>, digits: usize| v.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
    let truth = report.truth.as_ref();
    cards += &card(
        "Lateral error",
        &number(truth.and_then(|t| t.lateral_error_mm), 2),
        "mm",
        "contact to designated point, true",
    );
    let predicted = report.servo.as_ref().map(|s| s.predicted_error_mm);
    cards += &card(
        "Predicted",
        &number(predicted, 2),
        "mm",
        "before contact, 95 % bound",
    );
    cards += &card(
        "Open loop",
        &number(truth.and_then(|t| t.open_loop_lateral_error_mm), 1),
        "mm",
        "kinematics alone, same truth",
    );
    let axis = truth.and_then(|t| t.axis_error_deg);
    cards += &card(
        "Axis error",
        &number(axis, 2),
        "deg",
        "instrument to surface normal, true",
    );
    let force = report.contact.as_ref().map(|c| c.peak_force_n);
    cards += &card("Peak force", &number(force, 1), "N", "axial, at contact");
    let (sim, wall) = report.times();
    cards += &card(
        "Time",
        &format!("{sim:.1}"),
        "s",
        &format!("simulated, in {wall:.1} s"),
    );
    format!("<div class=\"cards\">{cards}</div>\n")
}

fn views(evidence: &Evidence) -> Result<String, PageError> {
    let mut figures = String::new();
    for (view, caption) in [
        (
            &evidence.contact_view,
            "The instrument at the end of the approach",
        ),
        (&evidence.scene_view, "The arm after the contact motion"),
    ] {
        if let Some(image) = view {
            figures += &figure(image, &Overlay::default(), caption)?;
        }
    }
    if figures.is_empty() {
        return Ok(String::new());
    }
    Ok(section(
        "From outside",
        &format!("<div class=\"pair\">{figures}</div>"),
    ))
}

fn cross_at(pixel: [f64; 2]) -> Mark {
    Mark::cross(pixel, ORANGE, "target")
}

/// Two pictures side by side under a heading.
fn pictures(title: &str, pair: [(&ImageData, Overlay, String); 2]) -> Result<String, PageError> {
    let mut figures = String::new();
    for (image, overlay, caption) in pair {
        figures += &figure(image, &overlay, &caption)?;
    }
    Ok(section(
        title,
        &format!("<div class=\"pair\">{figures}</div>"),
    ))
}

fn designation(evidence: &Evidence) -> Result<String, PageError> {
    let Some(frame) = &evidence.designation else {
        return Ok(String::new());
    };
    let target = evidence.target.as_ref();
    let side = |name: &str, how: &str, pixel: Option<[f64; 2]>| {
        let overlay = Overlay {
            marks: pixel.into_iter().map(cross_at).collect(),
            path: vec![],
        };
        let caption = match pixel {
            Some([u, v]) => format!("{name}, {how} at {u:.2}, {v:.2} px"),
            None => name.to_owned(),
        };
        (overlay, caption)
    };
    let (left, named) = side("Left", "designated", target.map(|t| t.pixel_px));
    let (right, matched) = side("Right", "matched", target.map(|t| t.right_pixel_px));
    let images = &frame.images;
    let pair = [(&images.left, left, named), (&images.right, right, matched)];
    pictures("Designation", pair)
}

fn where_the_servo_ended(evidence: &Evidence) -> Result<String, PageError> {
    let Some(frame) = &evidence.standoff else {
        return Ok(String::new());
    };
    let target = evidence.handed_over.as_ref().or(evidence.target.as_ref());
    let looks = &evidence.looks;
    let side = |name: &str, pixel: Option<[f64; 2]>, of: fn(&Look) -> Option<[f64; 2]>| {
        let path: Vec<_> = looks.iter().filter_map(of).collect();
        let mut marks: Vec<_> = pixel.into_iter().map(cross_at).collect();
        marks.extend(path.last().map(|p| Mark::ring(*p, YELLOW, "fiducial")));
        let (seen, all) = (path.len(), looks.len());
        let caption = format!("{name}, fiducial seen in {seen} of {all} looks");
        (Overlay { marks, path }, caption)
    };
    let (left, on_left) = side("Left", target.map(|t| t.pixel_px), |l| l.left_px);
    let (right, on_right) = side("Right", target.map(|t| t.right_pixel_px), |l| l.right_px);
    let images = &frame.images;
    let pair = [
        (&images.left, left, on_left),
        (&images.right, right, on_right),
    ];
    pictures("Where the servo ended", pair)
}

fn servo(report: &RunReport, evidence: &Evidence) -> String {
    let looks = &evidence.looks;
    if looks.is_empty() {
        return String::new();
    }
    let number = |i: usize| (i + 1) as f64;
    let component = |axis: usize| {
        let points = looks.iter().enumerate();
        points
            .filter_map(|(i, l)| Some((number(i), l.error_vector_m?[axis] * 1e3)))
            .collect()
    };
    let mut charts = Plot {
        title: "Error vector, seen minus predicted tip, rover frame",
        x_label: "look",
        y_label: "mm",
        whole_x: true,
        from_zero: false,
        series: vec![
            Series {
                name: "x",
                colour: BLUE,
                points: component(0),
                marks: Marks::Joined,
            },
            Series {
                name: "y",
                colour: ORANGE,
                points: component(1),
                marks: Marks::Joined,
            },
            Series {
                name: "z",
                colour: GREEN,
                points: component(2),
                marks: Marks::Joined,
            },
        ],
    }
    .svg();
    let over_looks = |f: &dyn Fn(&Look) -> f64| {
        looks
            .iter()
            .enumerate()
            .map(|(i, l)| (number(i), f(l)))
            .collect::<Vec<_>>()
    };
    charts += &Plot {
        title: "Predicted lateral error at the target, 95 % bound",
        x_label: "look",
        y_label: "mm",
        whole_x: true,
        from_zero: true,
        series: vec![Series {
            name: "predicted",
            colour: PURPLE,
            points: over_looks(&|l| l.predicted_error_m * 1e3),
            marks: Marks::Joined,
        }],
    }
    .svg();
    let mut rows = String::new();
    for (i, l) in looks.iter().enumerate() {
        let vector = l.error_vector_m.map_or("–".to_owned(), |e| {
            e.map(|x| format!("{:+.2}", x * 1e3)).join("&ensp;")
        });
        let rotation = l.rotation_error_rad.map_or("–".to_owned(), |r| {
            let angle = r.iter().map(|x| x * x).sum::<f64>().sqrt().to_degrees();
            format!("{angle:.2}")
        });
        let rms = l.rms_px.map_or("–".to_owned(), |r| format!("{r:.3}"));
        let found = match (&l.reason, l.found) {
            (_, true) => "found".to_owned(),
            (Some(reason), false) => escape(reason),
            (None, false) => "not looked for".to_owned(),
        };
        let _ = write!(
            rows,
            "<tr><td>{}</td><td>{:.2}</td><td>{:.1}</td><td class=\"text\">{found}</td>\
             <td>{vector}</td><td>{rotation}</td><td>{rms}</td><td>{:.2}</td></tr>",
            i + 1,
            l.sim_time_s,
            l.station_m * 1e3,
            l.predicted_error_m * 1e3,
        );
    }
    let head = "<tr><th>look</th><th>time, s</th><th>station, mm</th><th class=\"text\">fiducial</th>\
                <th>error vector x y z, mm</th><th>rotation, deg</th><th>residual, px</th>\
                <th>predicted, mm</th></tr>";
    let method = report.servo.as_ref().map_or(String::new(), |s| {
        let end = if s.converged {
            "converged"
        } else {
            "not converged"
        };
        format!(
            "<p>Method <b>{}</b>, {} looks, {end}.</p>",
            s.method, s.iterations
        )
    });
    section(
        "Error compensation",
        &format!(
            "{method}<div class=\"charts\">{charts}</div>\
             <div class=\"scroll\"><table>{head}{rows}</table></div>"
        ),
    )
}

fn truth(report: &RunReport, evidence: &Evidence) -> String {
    let Some(t) = &report.truth else {
        return "<p>There was nothing to measure: no target was selected.</p>".into();
    };
    let mut rows = String::new();
    let mut row = |what: &str, value: Option<f64>, unit: &str, note: &str| {
        let value = value.map_or("–".to_owned(), |v| format!("{v:.3} {unit}"));
        let _ = write!(
            rows,
            "<tr><td class=\"text\">{what}</td><td>{value}</td><td class=\"text note\">{note}</td></tr>"
        );
    };
    row(
        "Lateral error",
        t.lateral_error_mm,
        "mm",
        "contact point to the point seen at the designated pixel, in the plane of the true normal",
    );
    row(
        "Range error",
        t.range_error_mm,
        "mm",
        "the same along the true normal",
    );
    row(
        "Axis error",
        t.axis_error_deg,
        "deg",
        "instrument's axis to the inward normal",
    );
    row(
        "Open-loop lateral error",
        t.open_loop_lateral_error_mm,
        "mm",
        "a purely kinematic placement under the same truth",
    );
    row(
        "Arm model error",
        Some(t.arm_model_error_mm),
        "mm",
        "believed to true tip",
    );
    let target_error = evidence.score.as_ref().map(|s| s.target_error_mm);
    row(
        "Target error",
        target_error,
        "mm",
        "believed to true target, camera mount error removed",
    );
    if let Some(target) = &report.target {
        row(
            "Target plane rms",
            Some(target.plane_rms_mm),
            "mm",
            "of the surface points",
        );
        let sigma = target.sigma_mm.iter().map(|s| s * s).sum::<f64>().sqrt();
        row(
            "Target sigma",
            Some(sigma),
            "mm",
            "believed, all axes together",
        );
    }
    if let Some(contact) = &report.contact {
        row(
            "Approach",
            Some(contact.approach_m * 1e3),
            "mm",
            "driven along the normal until contact",
        );
        row(
            "Switch travel",
            Some(contact.switch_travel_mm),
            "mm",
            "at rest in contact",
        );
        row("Peak force", Some(contact.peak_force_n), "N", "axial");
    }
    let predicted_mm = report.servo.as_ref().map(|s| s.predicted_error_mm);
    let drawn = evidence
        .score
        .as_ref()
        .and_then(|score| bullseye::bullseye(score, predicted_mm));
    let drawn = drawn.map_or(String::new(), |svg| {
        format!(
            "<figure>{svg}<figcaption>Contact (blue) and the true point at the designated pixel \
             (cross), seen along the true normal; dashed: predicted to hold it in 95 % of \
             cases.</figcaption></figure>"
        )
    });
    format!("<div class=\"truth\"><table>{rows}</table>{drawn}</div>")
}
