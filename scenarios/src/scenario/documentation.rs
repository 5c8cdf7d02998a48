//! What each field of a scenario means, for `rover run --print`.

/// Path of a field and one line about it.
const FIELDS: &[(&str, &str)] = &[
    ("name", "Name in reports."),
    ("description", "What the scenario shows."),
    ("robot", "The robot file, relative to this file."),
    (
        "seed",
        "Seed of everything that is drawn by chance: model errors, noise, terrain.",
    ),
    ("target", "What to place the instrument on."),
    ("target.pair", "Camera pair, as named in the robot file."),
    (
        "target.pixel_px",
        "Column and row in the left image, px; (0, 0) is the centre of the first pixel.",
    ),
    (
        "target.mast_deg",
        "Pan (to the left) and tilt (down) of the mast for that image, deg; for a pair on the mast.",
    ),
    (
        "target.pick",
        "Instead of a pixel: the place that the simulator picks in a person's stead.",
    ),
    ("target.pick.surface", "\"rock\" or \"ground\"."),
    (
        "target.pick.range_m",
        "Nearest and farthest distance from the rover along the ground, m.",
    ),
    ("target.pick.choice_n", "Which of many such places."),
    (
        "approach",
        "How the rover drives to a target seen from the mast; without it the target lies in the arm's workspace.",
    ),
    ("approach.max_distance_m", "Longest way of the wheels, m."),
    ("approach.max_stops_n", "Most stops."),
    (
        "approach.step_fraction",
        "Longest way between two stops, as a fraction of the range.",
    ),
    (
        "approach.max_slope_deg",
        "Steepest ground to drive on, deg.",
    ),
    (
        "approach.max_slip",
        "Largest slip, fraction of the wheels' way.",
    ),
    (
        "approach.max_sigma_mm",
        "Near the target: largest uncertainty of its position at which to go on, mm, one sigma.",
    ),
    (
        "approach.max_base_poses_n",
        "Base poses from which the placement is tried at most; without it 3.",
    ),
    (
        "approach.sun_deg",
        "Azimuth (from the rover's first heading to its left) and elevation of the sun, deg; without it those of the simulated sun.",
    ),
    (
        "approach.spot_radius_mm",
        "Another spot within this radius may be taken if the target itself cannot be reached, mm; 0 for the target alone.",
    ),
    ("servo", "How the instrument is brought to the standoff."),
    (
        "servo.method",
        "How the end-effector's error is estimated. \"kinematic\" (no image of the arm), \"epec\" (last error vector), \"epec_field\" (error field with kinematic prior), \"epec_field_free\" (the same from pixels of one point, not anchored), \"hips_limited\", \"hips_full\", \"hips_approach\" (hybrid image plane/stereo), \"camera_space\", \"camera_space_linear\", \"mount_kabsch\", \"mount_map\" (camera mount), \"kinematic_calibration\", \"position_based\", \"position_based_half\", \"image_based\", \"image_based_broyden\" (visual servoing). hips_limited, hips_full, camera_space_linear, mount_map and kinematic_calibration first look at 12 poses over the view. The predicted error of every method is the error field's: its distance from what the method applies, plus its own 95 % radius.",
    ),
    (
        "servo.observation",
        "\"position\" of one mark, or \"pose\" of the whole plate.",
    ),
    (
        "servo.stations_m",
        "Distances from the target along the normal at which to look, far to near, m; the last is the standoff.",
    ),
    (
        "servo.tolerance_mm",
        "At the standoff: correct until the next correction is below this, mm.",
    ),
    (
        "servo.max_corrections_n",
        "At the standoff: at most so many corrections.",
    ),
    (
        "servo.max_predicted_error_mm",
        "Refuse to go on when the predicted lateral error (95 % bound) exceeds this, mm; after an \
         approach, this and its forecast together.",
    ),
    ("contact", "How contact is made."),
    ("contact.speed_mm_s", "Speed along the normal, mm/s."),
    (
        "contact.max_overtravel_mm",
        "Travel beyond the target after which there is no surface, mm.",
    ),
    ("contact.max_force_n", "Largest axial force, N."),
    (
        "contact.retract",
        "Whether to go back to the standoff after contact.",
    ),
    ("arm", "Where the arm starts and ends."),
    (
        "arm.start_posture",
        "Posture of the robot file in which the arm starts.",
    ),
    (
        "arm.end_posture",
        "Posture to which the arm goes after a placement with retract; empty: it stays at the standoff.",
    ),
    (
        "limits",
        "Limits on wall-clock time: a run that exceeds one is ended as a fault.",
    ),
    ("limits.start_s", "For simulator and services to appear, s."),
    (
        "limits.question_s",
        "For one question (designation, survey, plan, score), s.",
    ),
    (
        "limits.action_s",
        "For one action (servo, contact, arm motion), s.",
    ),
    ("limits.stop_s", "For an orderly stop, s."),
    ("campaign", "What differs from run to run of a campaign."),
    (
        "campaign.vary",
        "Fields that are drawn from the seed: { path, uniform = [low, high] | integer = [low, high] | choice = [..] | cycle = [..] }.",
    ),
];

/// The text with a comment before each field that has one.
pub(super) fn annotate(text: &str) -> String {
    let mut section = String::new();
    let mut out = String::new();
    for line in text.lines() {
        let path = if let Some(header) = line.strip_prefix('[') {
            section = header.trim_matches(['[', ']']).into();
            Some(section.clone())
        } else {
            line.split_once(" = ").map(|(key, _)| {
                if section.is_empty() {
                    key.into()
                } else {
                    format!("{section}.{key}")
                }
            })
        };
        let comment = path.and_then(|path| FIELDS.iter().find(|(field, _)| *field == path));
        if let Some((_, comment)) = comment {
            out.push_str(&format!("# {comment}\n"));
        }
        out.push_str(line);
        out.push('\n');
    }
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{embedded, scenario::Scenario};
    use std::collections::BTreeSet;

    /// Paths of all fields of tables within tables, but for the simulation's.
    fn paths(table: &toml::Table, before: &str, found: &mut BTreeSet<String>) {
        for (key, value) in table {
            let path = format!("{before}{key}");
            if path == "simulation" {
                continue;
            }
            if let toml::Value::Table(fields) = value {
                paths(fields, &format!("{path}."), found);
            }
            found.insert(path);
        }
    }

    #[test]
    fn every_field_of_the_runner_is_explained_and_every_explanation_has_a_field() {
        let by_hand = "name = 'a'\nrobot = 'b'\n[target]\npair = 'mast'\npixel_px = [1.0, 2.0]\n\
                       mast_deg = [0.0, 10.0]\n[approach]\nsun_deg = [90.0, 45.0]";
        let mut found = BTreeSet::new();
        let shipped = embedded::SCENARIOS.iter().map(|(_, text)| *text);
        for text in shipped.chain([by_hand]) {
            let scenario = Scenario::parse(text, "a scenario").unwrap();
            paths(&toml::Table::try_from(scenario).unwrap(), "", &mut found);
        }
        for path in &found {
            assert!(
                FIELDS.iter().any(|(field, _)| field == path),
                "{path} is not explained"
            );
        }
        for (field, _) in FIELDS.iter().filter(|(f, _)| !f.starts_with("simulation")) {
            assert!(found.contains(*field), "{field} is explained but is none");
        }
    }
}
