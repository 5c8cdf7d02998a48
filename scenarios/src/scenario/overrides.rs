//! `--set PATH=VALUE`: one field of a scenario replaced by a TOML value.

use super::{Scenario, ScenarioError};
use crate::tables::distance;
use toml::{Table, Value};

/// The scenario with one field replaced. `PATH` is dotted, an index counts from 0
/// (`simulation.terrain.rocks.0.radius_m`); `VALUE` is a TOML value, and a bare word stands for
/// itself as text.
///
/// # Errors
/// [`ScenarioError::Override`] for a path that there is not, with the nearest ones that there
/// are, or for a value that does not fit.
pub(super) fn apply(scenario: &Scenario, set: &str) -> Result<Scenario, ScenarioError> {
    let error = |message: String| ScenarioError::Override {
        given: set.into(),
        message,
    };
    let (path, value) = set
        .split_once('=')
        .map(|(path, value)| (path.trim(), value.trim()))
        .filter(|(path, value)| !path.is_empty() && !value.is_empty())
        .ok_or_else(|| error("expected PATH=VALUE, e.g. servo.tolerance_mm=0.2".into()))?;
    let value = parse_value(value).map_err(error)?;
    let root = Table::try_from(scenario).map_err(|e| error(e.to_string()))?;
    let mut changed = Value::Table(root.clone());
    let kind = |message: String| ScenarioError::Override {
        given: set.into(),
        message: format!("{message}; {}", near(&root, path)),
    };
    *place(&mut changed, path).map_err(kind)? = value;
    changed.try_into().map_err(|e: toml::de::Error| {
        let message = e.message();
        if message.contains("unknown field") {
            kind(format!("no field `{path}`"))
        } else {
            error(format!("`{path}`: {message}"))
        }
    })
}

fn parse_value(text: &str) -> Result<Value, String> {
    let parsed = toml::from_str::<Table>(&format!("value = {text}"));
    if let Ok(mut table) = parsed
        && table.len() == 1
        && let Some(value) = table.remove("value")
    {
        return Ok(value);
    }
    let bare = |c: char| c.is_ascii_alphanumeric() || "_-./".contains(c);
    if text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '.' || c == '/')
        && text.chars().all(bare)
    {
        return Ok(Value::String(text.into()));
    }
    Err(format!(
        "`{text}` is not a TOML value: expected a number, true, false, \"text\" or [..]"
    ))
}

/// The place of a path; a field that is absent because it is optional is made.
fn place<'a>(root: &'a mut Value, path: &str) -> Result<&'a mut Value, String> {
    let mut at = root;
    let mut walked = String::new();
    for step in path.split('.') {
        at = match at {
            Value::Table(table) => table
                .entry(step)
                .or_insert_with(|| Value::Table(Table::new())),
            Value::Array(items) => {
                let n = items.len();
                step.parse::<usize>()
                    .ok()
                    .and_then(|i| items.get_mut(i))
                    .ok_or_else(|| {
                        format!("`{walked}` has {n} entries: no entry `{step}`, they count from 0")
                    })?
            }
            other => {
                return Err(format!(
                    "`{walked}` is a {}, it has no fields",
                    other.type_str()
                ));
            }
        };
        if !walked.is_empty() {
            walked.push('.');
        }
        walked.push_str(step);
    }
    Ok(at)
}

/// The known paths that are most like `path`, for a message.
fn near(root: &Table, path: &str) -> String {
    let mut known = Vec::new();
    collect(&Value::Table(root.clone()), "", &mut known);
    let last = path.rsplit('.').next().unwrap_or(path);
    let mut ranked: Vec<(usize, &String)> = known
        .iter()
        .map(|candidate| {
            let leaf = candidate.rsplit('.').next().unwrap_or(candidate);
            (
                distance(path, candidate).min(distance(last, leaf) + 1),
                candidate,
            )
        })
        .collect();
    ranked.sort();
    let names: Vec<_> = ranked
        .iter()
        .take(3)
        .map(|(_, name)| format!("`{name}`"))
        .collect();
    format!("nearest: {}", names.join(", "))
}

fn collect(value: &Value, path: &str, into: &mut Vec<String>) {
    let below = |step: &str| {
        if path.is_empty() {
            step.into()
        } else {
            format!("{path}.{step}")
        }
    };
    match value {
        Value::Table(table) => table.iter().for_each(|(k, v)| collect(v, &below(k), into)),
        Value::Array(items) if items.iter().any(Value::is_table) => {
            items
                .iter()
                .enumerate()
                .for_each(|(i, v)| collect(v, &below(&i.to_string()), into));
        }
        _ => into.push(path.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_toml_and_bare_words_are_text() {
        assert_eq!(parse_value("0.5"), Ok(Value::Float(0.5)));
        assert_eq!(parse_value("epec"), Ok(Value::String("epec".into())));
        assert_eq!(parse_value("\"a b\""), Ok(Value::String("a b".into())));
        assert_eq!(parse_value("true"), Ok(Value::Boolean(true)));
        assert!(matches!(parse_value("[1, 2]"), Ok(Value::Array(_))));
        assert!(parse_value("1 2").is_err());
        assert!(parse_value("1\nother = 2").is_err());
    }
}
