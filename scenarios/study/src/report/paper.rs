//! What the paper says beside its tables and figures, and what it does not say.

use super::{StudyReport, table::Table};
use rover_page::escape;

/// The paper's cameras: focal length 2.8 mm over 4.65 um, px; baseline, m.
const FOCAL_PX: f64 = 2.8 / 4.65e-3;
const BASELINE_M: f64 = 0.08;
/// A usual working distance of its arm, m.
const WORKING_M: f64 = 0.5;
/// The paper's error of a match, px.
const MATCH_PX: f64 = 0.3;

/// What cannot be known, as HTML.
pub(super) const UNKNOWN: &str = "<p>The paper published none of the following, so its numbers can \
    be consistent with these, not equal:</p><ul>\
    <li>The arm\u{2019}s Denavit-Hartenberg table. Here: the flight arm of the Mars Exploration \
    Rover with its 0.1306 m tool, which has the same five joints; for studies with images the \
    Bluestreak model that comes with this program.</li>\
    <li>Where the cameras are. Here: 0.3 m above the arm\u{2019}s base. Of all unknowns this moves \
    the errors before the correction most: in another re-run, with other draws, from 21.7 mm with \
    the cameras beside the base to 27.4 mm with the cameras 0.6 m above it (1 deg, 2.5 mm; the \
    paper: 25.7). The slope of locality did not depend on it.</li>\
    <li>The workspace and its 196 targets. Here: x 0.35 to 0.66, y \u{b1}0.34, z -0.33 to 0.57 m of \
    the arm\u{2019}s base (z down), the tool within 45 deg of straight down.</li>\
    <li>How the mount\u{2019}s rotation is written. Here: a rotation vector about the \
    cameras\u{2019} centre.</li>\
    <li>The data of figures 6 and 7, of which it gives words, not numbers.</li></ul>";

/// A statement of the paper and what it comes to here.
struct Statement {
    what: &'static str,
    paper: &'static str,
    here: String,
}

/// The statements that no table or figure holds, as HTML.
pub(super) fn numbers(report: &StudyReport) -> String {
    let lateral_mm = WORKING_M / FOCAL_PX * 1e3;
    let range_mm = |at_m: f64| at_m * at_m * MATCH_PX / (FOCAL_PX * BASELINE_M) * 1e3;
    // Where a match that wrong is 1 cm of range, and where a pixel is 1 mm across.
    let centimetre_m = (0.01 * FOCAL_PX * BASELINE_M / MATCH_PX).sqrt();
    let millimetre_m = 1e-3 * FOCAL_PX;
    let mut rows = vec![
        Statement {
            what: "one pixel across (section 4)",
            paper: "?? mm",
            here: format!("{lateral_mm:.2} mm at {WORKING_M} m"),
        },
        Statement {
            what: "0.3 px of disparity in range (section 4)",
            paper: "?? mm",
            here: format!("{:.2} mm at {WORKING_M} m", range_mm(WORKING_M)),
        },
        Statement {
            what: "range error of the target\u{2019}s selection (section 3)",
            paper: "< 10 mm",
            here: format!("with 0.3 px up to {centimetre_m:.2} m"),
        },
        Statement {
            what: "lateral error of the target\u{2019}s selection (section 3)",
            paper: "< 1 mm",
            here: format!("with a whole pixel up to {millimetre_m:.2} m"),
        },
    ];
    if let Some(table1) = &report.table1 {
        let before: Vec<String> = table1
            .rows
            .iter()
            .map(|r| format!("{:.1}", r.before_mm))
            .collect();
        rows.push(Statement {
            what: "placement by kinematics alone, Mars Exploration Rovers (section 2)",
            paper: "about 10 mm",
            here: format!("{} mm at the levels of table 1", before.join(", ")),
        });
    }
    if let Some(experiment) = &report.experiment {
        let points = || experiment.references.iter().flat_map(|r| &r.points);
        let far = || points().filter(|p| p.distance_m >= 0.2);
        let better = far().filter(|p| p.error_mm < p.open_loop_mm).count();
        rows.push(Statement {
            what: "a vector from as far as 20 cm reduces the error significantly (section 5)",
            paper: "all trials",
            here: format!("{better} of {} targets at 20 cm and more", far().count()),
        });
    }
    let table = Table::of(&rows)
        .column("what", |s| s.what.to_owned())
        .column("paper", |s| s.paper.to_owned())
        .column("here", |s| s.here.clone());
    format!(
        "<p>Geometry of the paper\u{2019}s cameras ({}), and two results.</p>{}",
        escape("2.8 mm lenses, 4.65 um pixels, 8 cm apart"),
        table.html()
    )
}
