//! Bounded reading of YAML, and numbers that every YAML reader takes for numbers.

use super::{FormatError, MAX_BYTES, brief, shown};
use serde::de::DeserializeOwned;

/// Deepest nesting that is read; the deepest of the formats has five levels.
const MAX_DEPTH: usize = 12;

/// Reads one YAML document; a mark that ends it (`---` as `ros2 topic echo` prints it, or `...`) may
/// follow, and comments behind it. A second document is refused, and so are aliases, which can make
/// a short text long.
pub(super) fn read<T: DeserializeOwned>(text: &str) -> Result<T, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooLong { found: text.len() });
    }
    let options = serde_saphyr::options! {
        budget: serde_saphyr::budget! {
            max_depth: MAX_DEPTH,
            flow_nesting_limit: MAX_DEPTH,
            max_aliases: 0,
            max_anchors: 0,
            max_merge_keys: 0,
            max_documents: 1,
        },
    };
    serde_saphyr::from_str_with_options(without_mark(text), options).map_err(|error| {
        let message = plain(&brief(&error.without_snippet().to_string()));
        let message = match line_of(&message).and_then(|n| text.lines().nth(n.checked_sub(1)?)) {
            Some(line) => format!("{message}: `{}`", shown(&brief(line))),
            None => message,
        };
        FormatError::Structure { message }
    })
}

/// The line that a message of the reader names, from 1.
fn line_of(message: &str) -> Option<usize> {
    let (_, rest) = message.rsplit_once("line ")?;
    let digits = rest.find(|c: char| !c.is_ascii_digit());
    rest[..digits.unwrap_or(rest.len())].parse().ok()
}

/// What the reader says in terms of its own options, in terms of the file.
fn plain(message: &str) -> String {
    if message.starts_with("budget breached: Documents")
        && let Some(line) = line_of(message)
    {
        return format!("a second document begins at line {line}, expected one");
    }
    message
        .replace(", set DuplicateKeyPolicy in Options if acceptable", "")
        .replace("simple key expected ':'", "expected `name: value`")
}

/// The text without a last mark that only ends the document, and what is blank or comment behind it.
fn without_mark(text: &str) -> &str {
    let mut end = text;
    loop {
        let start = end.trim_end().rfind('\n').map_or(0, |n| n + 1);
        match end[start..].trim() {
            "---" | "..." if start > 0 => return &end[..start],
            line if start > 0 && (line.is_empty() || line.starts_with('#')) => {
                end = &end[..start];
            }
            _ => return text,
        }
    }
}

/// A number as YAML 1.1 and 1.2 both read it: with a point, and a sign in the exponent.
pub(super) fn number(x: f64) -> String {
    let text = format!("{x:?}");
    let Some((mantissa, exponent)) = text.split_once('e') else {
        return text;
    };
    let point = if mantissa.contains('.') { "" } else { ".0" };
    let sign = if exponent.starts_with('-') { "" } else { "+" };
    format!("{mantissa}{point}e{sign}{exponent}")
}

/// Numbers as a YAML list.
pub(super) fn list(numbers: &[f64]) -> String {
    let words: Vec<String> = numbers.iter().map(|x| number(*x)).collect();
    format!("[{}]", words.join(", "))
}

/// Refuses a number that is not finite, naming its field.
pub(super) fn all_finite(field: &str, numbers: &[f64]) -> Result<(), FormatError> {
    match numbers.iter().find(|x| !x.is_finite()) {
        None => Ok(()),
        Some(x) => Err(wrong(field, x, "finite numbers")),
    }
}

/// Refuses the numbers of a matrix that are not finite, not as many as one of `expected` or not as
/// many as its rows and cols, if it has these, say.
pub(super) fn check_matrix(
    field: &str,
    shape: Option<(usize, usize)>,
    data: &[f64],
    expected: &[usize],
) -> Result<(), FormatError> {
    let n = data.len();
    if let Some((rows, cols)) = shape
        && rows.checked_mul(cols) != Some(n)
    {
        return Err(wrong(
            field,
            format_args!("{n} numbers of data"),
            format!("{rows} x {cols} as its rows and cols say"),
        ));
    }
    if !expected.contains(&n) {
        return Err(wrong(field, format_args!("{n} numbers"), counts(expected)));
    }
    all_finite(field, data)
}

/// A field with the wrong content.
pub(super) fn wrong(
    field: &str,
    found: impl std::fmt::Display,
    expected: impl Into<String>,
) -> FormatError {
    FormatError::Field {
        field: field.to_owned(),
        found: super::shown(&found.to_string()),
        expected: expected.into(),
    }
}

/// `4, 5 or 8 numbers`.
pub(super) fn counts(counts: &[usize]) -> String {
    let words: Vec<String> = counts.iter().map(ToString::to_string).collect();
    match words.split_last() {
        Some((last, [])) => format!("{last} numbers"),
        Some((last, rest)) => format!("{} or {last} numbers", rest.join(", ")),
        None => "no numbers".into(),
    }
}
