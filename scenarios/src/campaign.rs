//! Campaigns: many runs of one scenario with truth, and whatever else the scenario varies, drawn
//! anew from each seed. Every run leaves one record, so that a campaign that was killed goes on
//! where it ended, and any run can be repeated from its seed alone.
//!
//! | module | question it answers |
//! |---|---|
//! | [`folder`] | which runs are done, and what came of them |
//! | [`summary`] | how often, how well, how fast, and what went wrong |
//! | [`page`] | how does a person see it |

pub mod folder;
pub mod page;
pub mod summary;

pub use folder::{CampaignError, Folder, Manifest, Record};
pub use summary::Summary;

/// One of several machines' part of a campaign: part `index` (from 1) of `count`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Which part, from 1.
    pub index: u64,
    /// Of how many.
    pub count: u64,
}

impl Shard {
    /// Everything.
    pub const WHOLE: Self = Self { index: 1, count: 1 };

    /// Whether the run with this index (from 0) belongs to this part.
    pub fn has(self, run: u64) -> bool {
        run % self.count == self.index - 1
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.split_once('/')
            .and_then(|(index, count)| {
                let (index, count) = (index.parse().ok()?, count.parse().ok()?);
                (1..=count)
                    .contains(&index)
                    .then_some(Self { index, count })
            })
            .ok_or_else(|| format!("`{text}`, expected I/N with 1 <= I <= N, e.g. 2/8"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn shards_share_out_every_run_once() {
        let shards: Vec<Shard> = (1..=3).map(|i| format!("{i}/3").parse().unwrap()).collect();
        for run in 0..20 {
            assert_eq!(shards.iter().filter(|s| s.has(run)).count(), 1);
        }
        for bad in ["0/3", "4/3", "1", "1/0", "a/b", "-1/2"] {
            assert!(bad.parse::<Shard>().is_err(), "{bad}");
        }
    }
}
