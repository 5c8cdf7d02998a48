//! What makes a type a message, and the two messages that every peer knows.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{collections::BTreeMap, fmt};

/// A type that travels between peers.
///
/// Binary encoding forbids serde's `tag`, `untagged`, `flatten` and `skip_serializing_if`
/// attributes: they encode but do not decode.
pub trait Wire: Serialize + DeserializeOwned + Send + Sync + 'static {
    /// Schema name and version, `name/version`; it travels with every binary payload.
    const SCHEMA: &'static str;

    /// Checks the meaning of a decoded message.
    ///
    /// # Errors
    /// One line that names the field, what was found and what was expected.
    fn validate(&self) -> Result<(), String> {
        Ok(())
    }
}

/// Implements [`Wire`] for types without a check of their own.
#[macro_export]
macro_rules! wire {
    ($($name:ty = $schema:literal),* $(,)?) => {$(
        impl $crate::Wire for $name { const SCHEMA: &'static str = $schema; }
    )*};
}

/// The empty question or answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Nothing {}

wire! { Nothing = "nothing/1", Fault = "fault/1" }

/// A refusal or failure, by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// Stable name in snake_case; programs decide by it.
    pub name: String,
    /// The service that raised it.
    pub service: String,
    /// For a person: what, where, what was expected.
    pub message: String,
    /// The numbers behind it; keys carry their unit.
    pub details: BTreeMap<String, f64>,
}

impl Fault {
    /// A fault without numbers.
    pub fn new(service: &str, name: &str, message: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            service: service.into(),
            message: message.into(),
            details: BTreeMap::new(),
        }
    }

    /// Adds one number; `key` carries the unit.
    #[must_use]
    pub fn with(mut self, key: &str, value: f64) -> Self {
        self.details.insert(key.into(), value);
        self
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}: {}", self.service, self.name, self.message)
    }
}

impl std::error::Error for Fault {}

/// Checks that every number is finite; `field` is named in the refusal.
///
/// # Errors
/// The field and the place of the first number that is not finite.
pub fn finite(field: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(i) => Err(format!(
            "{field}[{i}]: {} is not a finite number",
            values[i]
        )),
    }
}

/// Checks that a number lies in a range; the refusal names field, value and range.
///
/// # Errors
/// The field, what was found and what was expected.
pub fn in_range(field: &str, value: f64, low: f64, high: f64) -> Result<(), String> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(format!("{field}: {value}, expected {low} to {high}"))
    }
}
