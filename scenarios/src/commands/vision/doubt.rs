//! Whether two pictures are what their camera models say: told only where the evidence is clear.
//!
//! Pictures of one scene with their own models answer for a third of the pixels and more where there
//! is texture; exchanged or unrelated ones for a few per cent, by chance. Few answers have innocent
//! reasons too (no texture, a scene beyond the ranges searched), so exchanged pictures are told by
//! their answering well when they are exchanged back.

use nalgebra::Vector2;
use rover_cameras::StereoPair;
use rover_vision::match_point;
use rover_vision::{DenseRules, Image8, MatchFailure, MatchRules, PreparedImage, Rectifier};

/// Largest share of pixels with a disparity that raises a doubt.
const FEW_DISPARITIES: f64 = 0.08;
/// What the exchanged pair must answer: a share, and as many times more.
const GOOD_DISPARITIES: f64 = 0.15;
/// Share of pixels that must be textured for the lack of answers to say something, and what counts:
/// a grey difference, DN, to the fourth pixel beside.
const TEXTURED: f64 = 0.4;
const TEXTURE_DN: u8 = 8;

/// Largest share of the given pixels that have a match and raise a doubt, and the fewest pixels.
const FEW_MATCHES: f64 = 0.2;
const FEWEST_PIXELS: usize = 10;
/// What the exchanged pair must answer, as a share; and what share of the pixels must have failed on
/// what the other picture shows, if the exchanged one does no better.
const GOOD_MATCHES: f64 = 0.25;
const UNLIKE: f64 = 0.6;
/// How many times more the exchanged pair must answer.
const TIMES: f64 = 4.0;
/// Pixels that are looked at again, at most.
const MOST_PIXELS: usize = 400;

const SAME: &str = "the left and the right picture are the same: expected one of each camera";
const EXCHANGED: &str = "the pictures, or their models, seem exchanged";

fn exchanged(pair: &StereoPair) -> StereoPair {
    StereoPair {
        left: pair.right.clone(),
        right: pair.left.clone(),
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// What speaks against a pair of which the share `found` of the pixels has a disparity; `pair` as
/// its models are, `shift_px` as for [`Rectifier::new`].
pub fn of_disparities(
    pair: &StereoPair,
    (left, right): (&Image8, &Image8),
    (shift_px, rules): (f64, &DenseRules),
    found: f64,
) -> Option<String> {
    if left == right {
        return Some(SAME.into());
    }
    if found > FEW_DISPARITIES {
        return None;
    }
    // A pair that cannot be searched the other way says nothing.
    let other = Rectifier::new(&exchanged(pair), shift_px)
        .ok()?
        .disparity(left, right, rules)
        .ok()?;
    let pixels = (0..other.height_px).flat_map(|v| (0..other.width_px).map(move |u| (u, v)));
    // counted as `found` is: what lies before infinity
    let answers = |&(u, v): &(u32, u32)| other.at(u, v).is_some_and(|d| d + shift_px > 0.0);
    let answered = pixels.filter(answers).count();
    let back = answered as f64 / (f64::from(other.width_px) * f64::from(other.height_px));
    if back >= GOOD_DISPARITIES.max(TIMES * found) {
        return Some(format!(
            "{EXCHANGED}: {} of the pixels have a disparity, the other way round {}",
            percent(found),
            percent(back)
        ));
    }
    let textured = [left, right].map(textured).into_iter().fold(1.0, f64::min);
    (textured >= TEXTURED).then(|| {
        format!(
            "only {} of the pixels have a disparity, although {} are textured: expected two pictures \
             of one scene at one moment, their own models, and a scene within the depths searched",
            percent(found),
            percent(textured)
        )
    })
}

/// The share of pixels that differ from the fourth beside them.
fn textured(image: &Image8) -> f64 {
    let rows = image.pixels.chunks_exact(image.width_px as usize);
    let differ = |row: &[u8]| {
        let pairs = row.iter().zip(row.iter().skip(4));
        pairs.filter(|(a, b)| a.abs_diff(**b) >= TEXTURE_DN).count()
    };
    rows.map(differ).sum::<usize>() as f64 / image.pixels.len() as f64
}

/// Gathers what became of the pixels of a table, the first [`MOST_PIXELS`] of them.
#[derive(Default)]
pub struct Matches {
    pixels: Vec<Vector2<f64>>,
    found: usize,
    unlike: usize,
}

impl Matches {
    /// Takes a pixel and what the search said.
    pub fn add(&mut self, pixel: Vector2<f64>, failure: Option<&MatchFailure>) {
        if self.pixels.len() == MOST_PIXELS {
            return;
        }
        self.pixels.push(pixel);
        match failure {
            None => self.found += 1,
            Some(
                MatchFailure::LowScore { .. }
                | MatchFailure::NotUnique { .. }
                | MatchFailure::NotMutual { .. }
                | MatchFailure::Diverged { .. }
                | MatchFailure::TooSteep { .. }
                | MatchFailure::OffEpipolar { .. },
            ) => self.unlike += 1,
            // Not what the other picture shows, but where and how it was looked for.
            Some(_) => {}
        }
    }

    /// What speaks against the pair.
    pub fn doubt(
        &self,
        pair: &StereoPair,
        (left, right): (&PreparedImage, &PreparedImage),
        rules: &MatchRules,
    ) -> Option<String> {
        let all = self.pixels.len();
        let share = |n: usize| n as f64 / all as f64;
        if all < FEWEST_PIXELS || share(self.found) > FEW_MATCHES {
            return None;
        }
        let other = exchanged(pair);
        let back = self
            .pixels
            .iter()
            .filter(|pixel| match_point(left, right, &other, pixel, rules).is_ok())
            .count();
        if share(back) >= GOOD_MATCHES.max(TIMES * share(self.found)) {
            return Some(format!(
                "{EXCHANGED}: {} of {all} pixels have a match, the other way round {back}",
                self.found
            ));
        }
        (share(self.unlike) >= UNLIKE).then(|| {
            format!(
                "only {} of {all} pixels have a match, {} show nothing alike where their epipolar \
                 curves lead: expected two pictures of one scene at one moment, their own models, and \
                 a scene at ranges of {} to {} m",
                self.found, self.unlike, rules.range_min_m, rules.range_max_m
            )
        })
    }
}
