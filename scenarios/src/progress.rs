//! A run as a person at a terminal sees it: phase, distance, last error vector. Without a terminal
//! only the end of each phase is told.

use crate::{placement::Observer, report::Phase};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rover_messages::{
    approach::DriveToFeedback,
    placement::{ContactFeedback, PlaceFeedback},
    target::Target,
};
use std::{
    io::{IsTerminal, stderr},
    time::Duration,
};

/// Shows a run on standard error.
pub struct TerminalProgress {
    bar: ProgressBar,
    phase: String,
    error_mm: Option<[f64; 3]>,
    forecast_told: bool,
}

impl Default for TerminalProgress {
    fn default() -> Self {
        let bar = if stderr().is_terminal() {
            ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr())
        } else {
            ProgressBar::hidden()
        };
        if let Ok(style) = ProgressStyle::with_template("{spinner} {prefix:<10} {wide_msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(100));
        Self {
            bar,
            phase: String::new(),
            error_mm: None,
            forecast_told: false,
        }
    }
}

impl TerminalProgress {
    /// Shows what is going on outside of any phase.
    pub fn say(&mut self, what: &str) {
        self.bar.set_prefix("");
        self.bar.set_message(what.to_owned());
    }

    /// Takes the display away.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }

    fn line(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }
}

impl Observer for TerminalProgress {
    fn phase(&mut self, name: &str) {
        self.phase = name.into();
        self.bar.set_prefix(name.to_owned());
        self.bar.set_message("");
    }

    fn target(&mut self, target: &Target) {
        let range_m = target.position_m.coords.xy().norm();
        let [x, y, z] = target.sigma_mm();
        self.line(&format!(
            "target     {range_m:.2} m away, known to {x:.0} {y:.0} {z:.0} mm (one sigma)"
        ));
    }

    fn approach(&mut self, feedback: &DriveToFeedback) {
        let worst_mm = feedback.sigma_mm.iter().fold(0.0_f64, |a, b| a.max(*b));
        let text = format!(
            "{:<10} stop {:2}, {:5.2} m to target, known to {worst_mm:.1} mm",
            format!("{:?}", feedback.activity).to_lowercase(),
            feedback.stop_n,
            feedback.range_m,
        );
        if let Some(forecast_mm) = feedback.forecast_mm.filter(|_| !self.forecast_told) {
            self.forecast_told = true;
            self.line(&format!(
                "forecast   placements on targets seen like this end within {forecast_mm:.0} mm (95 %)"
            ));
        }
        match feedback.score {
            Some(score) => self.line(&format!("{text}, correlation {score:.2}")),
            None => self.bar.set_message(text),
        }
    }

    fn servo(&mut self, feedback: &PlaceFeedback) {
        let look = feedback.look.as_ref();
        if let Some(error_m) = look.and_then(|look| look.error_vector_m) {
            self.error_mm = Some(error_m.map(|x| x * 1e3));
        }
        let mut text = format!(
            "{:<8} {:6.1} mm to target",
            feedback.activity,
            feedback.distance_m * 1e3
        );
        if let Some([x, y, z]) = self.error_mm {
            text += &format!(", error vector {x:+.2} {y:+.2} {z:+.2} mm");
        }
        match look {
            Some(look) if !look.found => text += ", fiducial hidden",
            Some(look) => text += &format!(", predicted {:.2} mm", look.predicted_error_m * 1e3),
            None => {}
        }
        self.bar.set_message(text);
    }

    fn contact(&mut self, feedback: &ContactFeedback) {
        self.bar.set_message(format!(
            "{:<12} {:6.1} mm to target, force {:.1} N",
            feedback.activity,
            feedback.distance_m * 1e3,
            feedback.tip_force_n
        ));
    }

    fn ended(&mut self, phase: &Phase) {
        self.line(&format!(
            "{:<10} {:<10} {:7.2} s simulated, {:6.2} s wall",
            phase.name, phase.outcome, phase.sim_s, phase.wall_s
        ));
    }
}
