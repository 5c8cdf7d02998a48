//! The studies as JSON, as lines for a terminal, and as one self-contained page. One file per
//! study says how that study looks; this one puts them together.

mod compare;
mod cost;
mod distance;
mod experiment;
mod locality;
mod paper;
mod sensitivity;
mod table;
mod table1;

use super::{
    compare::Comparison, cost::Cost, experiment::Experiment, locality::Locality,
    sensitivity::Sensitivity, table1::Table1,
};
use rover_page::{document, escape};
use serde::Serialize;
use std::fmt::Write;

/// How one study is shown.
trait Shown {
    /// Its name on the command line, and its anchor on the page.
    const NAME: &'static str;
    /// Its heading.
    const TITLE: &'static str;
    /// A paragraph computed from its numbers.
    fn verdict(&self) -> String;
    /// Lines for a terminal, without heading and verdict.
    fn lines(&self) -> String;
    /// Its part of the page, without heading and verdict.
    fn section(&self) -> String;
}

/// The studies that were run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct StudyReport {
    #[serde(skip)]
    together: bool,
    /// Seed of all draws.
    pub seed: u64,
    /// The paper's table 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table1: Option<Table1>,
    /// The paper's figure 6.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub locality: Option<Locality>,
    /// The paper's figure 7.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub experiment: Option<Experiment>,
    /// Error sources.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensitivity: Option<Sensitivity>,
    /// The methods against each other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compare: Option<Comparison>,
    /// What a cycle costs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cost: Option<Cost>,
}

impl StudyReport {
    /// An empty report; `together` keeps each study under its name in the JSON even if there is
    /// only one.
    pub fn new(seed: u64, together: bool) -> Self {
        Self {
            seed,
            together,
            ..Self::default()
        }
    }

    /// The JSON: a single study's own fields, or all studies by name.
    ///
    /// # Errors
    /// [`serde_json::Error`] never, for finite numbers.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        let mut value = serde_json::to_value(self)?;
        if !self.together
            && let Some(fields) = value.as_object_mut()
        {
            fields.remove("seed");
            if let Some(only) = fields.iter_mut().next() {
                value = only.1.take();
            }
        }
        serde_json::to_string_pretty(&value).map(|t| t + "\n")
    }

    /// A few lines for a terminal.
    pub fn summary(&self) -> String {
        let mut out = format!("seed {}\n", self.seed);
        lines(&mut out, self.table1.as_ref());
        lines(&mut out, self.locality.as_ref());
        lines(&mut out, self.experiment.as_ref());
        lines(&mut out, self.sensitivity.as_ref());
        lines(&mut out, self.compare.as_ref());
        lines(&mut out, self.cost.as_ref());
        out
    }

    /// The page.
    pub fn page(&self) -> String {
        let mut page = Page::default();
        page.add(self.table1.as_ref());
        page.add(self.locality.as_ref());
        page.add(self.experiment.as_ref());
        page.add(self.sensitivity.as_ref());
        page.add(self.compare.as_ref());
        page.add(self.cost.as_ref());
        if self.together {
            page.put(
                "numbers",
                "The paper\u{2019}s other numbers",
                &paper::numbers(self),
            );
        }
        page.put("unknown", "What a re-run cannot know", paper::UNKNOWN);
        let title = "The paper's analysis, carried out again";
        let body = format!(
            "<header><h1>{title}</h1><p class=\"lead\">Vision-based end-effector position error \
             compensation: sections 5 and 6 of the paper, every number beside ours.</p></header>\n\
             <section><h2>Contents</h2><ul>{}</ul></section>\n{}",
            page.contents, page.sections
        );
        let footer = format!(
            "rover {} · seed <b>{}</b>",
            env!("CARGO_PKG_VERSION"),
            self.seed
        );
        document(title, &body, &footer)
    }
}

fn lines<S: Shown>(out: &mut String, study: Option<&S>) {
    if let Some(study) = study {
        let _ = writeln!(out, "{}\n{}  {}", S::NAME, study.lines(), study.verdict());
    }
}

#[derive(Default)]
struct Page {
    contents: String,
    sections: String,
}

impl Page {
    fn add<S: Shown>(&mut self, study: Option<&S>) {
        if let Some(study) = study {
            let verdict = escape(&study.verdict());
            let content = format!("<p><b>Verdict.</b> {verdict}</p>{}", study.section());
            self.put(S::NAME, S::TITLE, &content);
        }
    }

    fn put(&mut self, id: &str, title: &str, content: &str) {
        let _ = write!(self.contents, "<li><a href=\"#{id}\">{title}</a></li>");
        let _ = write!(
            self.sections,
            "<section id=\"{id}\"><h2>{title}</h2>\n{content}\n</section>\n"
        );
    }
}

/// A number of millimetres, or that too many trials failed.
fn mm(x: Option<f64>) -> String {
    x.map_or("–".to_owned(), |x| format!("{x:.2}"))
}
