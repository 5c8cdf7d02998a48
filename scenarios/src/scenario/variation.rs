//! What differs from run to run of a campaign: fields drawn from the seed.

use super::{Scenario, ScenarioError, overrides};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// How the runs of a campaign differ, besides the truth that every seed draws anew.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CampaignSettings {
    /// Fields that are drawn from the seed, each independently of the others.
    pub vary: Vec<Variation>,
}

/// One field and what it may become; exactly one of `uniform`, `integer`, `choice` and `cycle`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Variation {
    /// The field, as for `--set`.
    pub path: String,
    /// Drawn evenly between these bounds, in the field's unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uniform: Option<[f64; 2]>,
    /// A whole number drawn evenly between these, both included.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub integer: Option<[i64; 2]>,
    /// Drawn from these values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub choice: Option<Vec<toml::Value>>,
    /// These values in turn, by the seed: so each occurs equally often.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cycle: Option<Vec<toml::Value>>,
}

impl Variation {
    /// The value for a seed; depends on seed and path alone.
    ///
    /// # Errors
    /// What was found and what was expected.
    fn draw(&self, seed: u64) -> Result<toml::Value, String> {
        let one_of = |values: &[toml::Value], n: u64| {
            let count = values.len() as u64;
            let index = n.checked_rem(count).ok_or("no values, expected some")?;
            Ok(values[index as usize].clone())
        };
        match (&self.uniform, &self.integer, &self.choice, &self.cycle) {
            (Some([low, high]), None, None, None) => {
                if !(low < high && low.is_finite() && high.is_finite()) {
                    return Err(format!("uniform = [{low}, {high}], expected low < high"));
                }
                let x: f64 = self.stream(seed).random();
                Ok(toml::Value::Float(low + (high - low) * x))
            }
            (None, Some([low, high]), None, None) => {
                if low > high {
                    return Err(format!("integer = [{low}, {high}], expected low <= high"));
                }
                let n = self.stream(seed).random_range(*low..=*high);
                Ok(toml::Value::Integer(n))
            }
            (None, None, Some(values), None) => one_of(values, self.stream(seed).random()),
            (None, None, None, Some(values)) => one_of(values, seed),
            _ => Err("expected exactly one of uniform, integer, choice, cycle".into()),
        }
    }

    fn stream(&self, seed: u64) -> ChaCha8Rng {
        let mut hash = Sha256::new();
        hash.update(seed.to_le_bytes());
        hash.update(self.path.as_bytes());
        ChaCha8Rng::from_seed(hash.finalize().into())
    }
}

/// The scenario with its varied fields drawn for its seed.
///
/// # Errors
/// [`ScenarioError::Field`] for a variation that is none, [`ScenarioError::Override`] for a path
/// or value that does not fit.
pub(super) fn drawn(scenario: Scenario, origin: &str) -> Result<Scenario, ScenarioError> {
    let variations = scenario.campaign.vary.clone();
    let mut drawn = scenario;
    for (i, variation) in variations.iter().enumerate() {
        let value = variation
            .draw(drawn.seed)
            .map_err(|message| ScenarioError::Field {
                origin: origin.into(),
                field: format!("campaign.vary[{i}]"),
                message,
            })?;
        drawn = overrides::replace(&drawn, &variation.path, value)?;
    }
    Ok(drawn)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn variation(text: &str) -> Variation {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn draws_depend_on_seed_and_path_alone_and_fill_their_range() {
        let sun = variation("path = 'a'\nuniform = [10.0, 20.0]");
        let other = variation("path = 'b'\nuniform = [10.0, 20.0]");
        let values: Vec<f64> = (0..200)
            .map(|seed| sun.draw(seed).unwrap().as_float().unwrap())
            .collect();
        assert!(values.iter().all(|x| (10.0..20.0).contains(x)));
        assert!(values.iter().any(|&x| x < 11.0) && values.iter().any(|&x| x > 19.0));
        assert_eq!(sun.draw(5), sun.draw(5));
        assert_ne!(sun.draw(5), other.draw(5));
    }

    #[test]
    fn whole_numbers_stay_whole_and_reach_both_ends() {
        let seeds = variation("path = 'a'\ninteger = [3, 5]");
        let values: Vec<i64> = (0..200)
            .map(|seed| seeds.draw(seed).unwrap().as_integer().unwrap())
            .collect();
        for n in 3..=5 {
            assert!(values.contains(&n), "{n}");
        }
        assert!(values.iter().all(|n| (3..=5).contains(n)));
    }

    #[test]
    fn a_cycle_gives_each_value_its_turn_and_a_choice_each_its_chance() {
        let cycle = variation("path = 'a'\ncycle = ['x', 'y']");
        let of = |v: &Variation, n| v.draw(n).unwrap().as_str().unwrap().to_owned();
        assert_eq!(
            [of(&cycle, 0), of(&cycle, 1), of(&cycle, 2)],
            ["x", "y", "x"]
        );
        let choice = variation("path = 'a'\nchoice = ['x', 'y']");
        let xs = (0..100).filter(|&n| of(&choice, n) == "x").count();
        assert!((30..70).contains(&xs), "{xs}");
    }

    #[test]
    fn what_is_no_variation_is_refused() {
        for text in [
            "path = 'a'",
            "path = 'a'\nuniform = [2.0, 1.0]",
            "path = 'a'\nchoice = []",
            "path = 'a'\ninteger = [2, 1]",
            "path = 'a'\nuniform = [1.0, 2.0]\ncycle = [1]",
        ] {
            assert!(variation(text).draw(1).is_err(), "{text}");
        }
    }
}
