//! Bias, sigma, detection and false-accept rates of every detector and of the matcher, over patches
//! with known truth.

mod bound;
mod patch;
mod trials;

use rayon::prelude::*;
use serde::Serialize;
use trials::Outcome;
pub use trials::{SUBJECTS, Subject};

/// One row of the table.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// What was evaluated.
    pub name: &'static str,
    /// Grey noise, standard deviation, DN.
    pub noise_dn: f64,
    /// Patches that show the fiducial.
    pub patches: u32,
    /// Of these it was found in so many.
    pub detected_percent: f64,
    /// Mean error in u and v, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bias_px: Option<[f64; 2]>,
    /// Standard deviation per coordinate, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_px: Option<f64>,
    /// The error's length that 95 % stay below, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p95_px: Option<f64>,
    /// What the noise allows in the window that is matched (Cramer-Rao), root mean square over the
    /// patches, px; for subjects that may come up against it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound_px: Option<f64>,
    /// Errors per stated standard deviation, rms (1 is honest).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stated: Option<f64>,
    /// Accepted fiducials more than `gross_px` off.
    pub gross: u32,
    /// See `gross`.
    pub gross_px: f64,
    /// Patches without the fiducial, and those in which one was seen.
    pub blanks: u32,
    /// See `blanks`.
    pub false_accepts: u32,
    /// What the table is judged by.
    pub target: &'static str,
}

/// Grey noise that is evaluated unless another is asked for, DN of 255.
pub const NOISES_DN: [f64; 2] = [1.0, 5.0];
/// Accepted results farther off are counted by themselves and not in bias and sigma, px.
const GROSS_PX: f64 = 1.0;

/// `share` trials of one subject at one noise.
pub fn evaluate(subject: &Subject, noise_dn: f64, share: u32, stream: u64) -> Row {
    let outcomes: Vec<Outcome> = (0..share)
        .into_par_iter()
        .map(|i| (subject.trial)(&mut patch::rng(stream, u64::from(i)), noise_dn))
        .collect();
    let blanks = if subject.blank.is_some() { share } else { 0 };
    let false_accepts = subject.blank.map_or(0, |blank| {
        (0..share)
            .into_par_iter()
            .filter(|&i| blank(&mut patch::rng(stream, (1 << 32) + u64::from(i)), noise_dn))
            .count() as u32
    });
    let found: Vec<&Outcome> = outcomes.iter().filter(|o| o.error_px.is_some()).collect();
    let gross = found.iter().filter(|o| o.size() > GROSS_PX).count();
    let good: Vec<(f64, f64, f64)> = found
        .iter()
        .filter(|o| o.size() <= GROSS_PX)
        .filter_map(|o| o.error_px.map(|[u, v]| (u, v, o.sigma_px)))
        .collect();
    let n = good.len() as f64;
    let bounds: Vec<f64> = outcomes.iter().filter_map(|o| o.bound_px).collect();
    let bound_square = bounds.iter().map(|b| b * b).sum::<f64>() / bounds.len() as f64;
    let mut row = Row {
        name: subject.name,
        noise_dn,
        patches: share,
        detected_percent: 100.0 * found.len() as f64 / f64::from(share.max(1)),
        bias_px: None,
        sigma_px: None,
        p95_px: None,
        bound_px: bound_square.is_finite().then(|| bound_square.sqrt()),
        stated: None,
        gross: gross as u32,
        gross_px: GROSS_PX,
        blanks,
        false_accepts,
        target: subject.target,
    };
    if good.len() < 2 {
        return row;
    }
    let mean = |f: &dyn Fn(&(f64, f64, f64)) -> f64| good.iter().map(f).sum::<f64>() / n;
    let bias = [mean(&|e| e.0), mean(&|e| e.1)];
    let coordinates = f64::from(subject.coordinates);
    let square = mean(&|e| (e.0 - bias[0]).powi(2) + (e.1 - bias[1]).powi(2));
    let mut sizes: Vec<f64> = good.iter().map(|e| e.0.hypot(e.1)).collect();
    sizes.sort_by(f64::total_cmp);
    row.bias_px = Some(bias);
    row.sigma_px = Some((square / coordinates).sqrt());
    row.p95_px = sizes.get((0.95 * n) as usize).copied();
    let stated = mean(&|e| (e.0 * e.0 + e.1 * e.1) / (coordinates * e.2 * e.2));
    row.stated = stated.is_finite().then(|| stated.sqrt());
    row
}
