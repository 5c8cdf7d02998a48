//! Reading a table.

use super::{OK, STATUS, TableError, lines::Lines, names::nearest};
use csv::{ByteRecord, Reader, ReaderBuilder};
use rover_files::FileError;
use std::{
    fs::File,
    io::{self, Read},
    path::Path,
};

/// A table that is being read; an iterator over its rows.
pub struct Table {
    file: String,
    columns: Vec<String>,
    has_status: bool,
    rows: Reader<Lines>,
    record: ByteRecord,
    ended: bool,
}

impl Table {
    /// Opens a file, or standard input for `-`, and checks its header: the `columns` in their order,
    /// and perhaps a last column `status`.
    ///
    /// # Errors
    /// [`TableError::Open`], [`TableError::Read`], [`TableError::Header`].
    pub fn open(path: &Path, columns: &[impl AsRef<str>]) -> Result<Self, TableError> {
        if path == Path::new("-") {
            return Self::from_reader("standard input", Box::new(io::stdin()), columns);
        }
        let file = path.display().to_string();
        match File::open(path) {
            Ok(source) => Self::from_reader(&file, Box::new(source), columns),
            Err(source) => Err(TableError::Open {
                file,
                source: source.into(),
            }),
        }
    }

    /// The same for any source; `file` is its name in messages.
    ///
    /// # Errors
    /// As [`Table::open`].
    pub fn from_reader(
        file: &str,
        source: Box<dyn Read>,
        columns: &[impl AsRef<str>],
    ) -> Result<Self, TableError> {
        let columns: Vec<String> = columns.iter().map(|c| c.as_ref().to_owned()).collect();
        let mut table = Self {
            file: file.into(),
            columns: columns.clone(),
            has_status: false,
            rows: ReaderBuilder::new()
                .has_headers(false)
                .flexible(true)
                .from_reader(Lines::new(source, columns)),
            record: ByteRecord::new(),
            ended: false,
        };
        let Some(line) = table.advance()? else {
            return Err(table.header_error(1, "the table is empty".into()));
        };
        let mut found: Vec<String> = table
            .record
            .iter()
            .map(|cell| String::from_utf8_lossy(cell).trim().to_owned())
            .collect();
        if found.len() == table.columns.len() + 1 && found.last().is_some_and(|c| c == STATUS) {
            found.pop();
            table.has_status = true;
        }
        match check_header(&found, &table.columns) {
            None => Ok(table),
            Some(what) => Err(table.header_error(line, what)),
        }
    }

    fn header_error(&self, line: u64, what: String) -> TableError {
        TableError::Header {
            file: self.file.clone(),
            line,
            what,
            expected: self.columns.join(","),
        }
    }

    /// Reads the next record; its line, or nothing at the end of the file.
    fn advance(&mut self) -> Result<Option<u64>, TableError> {
        match self.rows.read_byte_record(&mut self.record) {
            Ok(false) => Ok(None),
            // Lines are handed on one at a time.
            Ok(true) => Ok(Some(self.rows.get_ref().line())),
            Err(error) => Err(TableError::Read {
                file: self.file.clone(),
                line: self.rows.get_ref().line(),
                what: match error.into_kind() {
                    csv::ErrorKind::Io(e) => FileError::from(e).to_string(),
                    other => format!("{other:?}"),
                },
            }),
        }
    }

    fn row(&self, line: u64) -> Result<Row, TableError> {
        let expected = self.columns.len() + usize::from(self.has_status);
        if self.record.len() != expected {
            return Err(TableError::Width {
                file: self.file.clone(),
                line,
                found: self.record.len(),
                expected,
            });
        }
        if self.has_status {
            let status = self.record.get(self.columns.len()).unwrap_or_default();
            let status = String::from_utf8_lossy(status);
            if status.trim() != OK {
                return Ok(Row {
                    line,
                    cells: Err(status.trim().to_owned()),
                });
            }
        }
        let cells: Result<Vec<f64>, TableError> = self
            .columns
            .iter()
            .zip(&self.record)
            .enumerate()
            .map(|(i, (name, cell))| {
                number(cell).ok_or_else(|| TableError::Cell {
                    file: self.file.clone(),
                    line,
                    column: i + 1,
                    name: name.clone(),
                    found: shortened(cell),
                })
            })
            .collect();
        Ok(Row {
            line,
            cells: Ok(cells?),
        })
    }
}

impl Iterator for Table {
    type Item = Result<Row, TableError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let row = match self.advance() {
            Ok(None) => {
                self.ended = true;
                return None;
            }
            Ok(Some(line)) => self.row(line),
            Err(error) => Err(error),
        };
        self.ended = row.is_err();
        Some(row)
    }
}

/// One row of a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    line: u64,
    cells: Result<Vec<f64>, String>,
}

impl Row {
    /// Its line in the file, from 1.
    pub fn line(&self) -> u64 {
        self.line
    }

    /// Its numbers in the order of the columns.
    ///
    /// # Errors
    /// The reason, when an earlier command already had no answer for this row.
    pub fn values(&self) -> Result<&[f64], String> {
        self.cells.as_deref().map_err(Clone::clone)
    }

    /// Its numbers as an array.
    ///
    /// # Errors
    /// As [`Row::values`]; or that the row has not `N` numbers.
    pub fn array<const N: usize>(&self) -> Result<[f64; N], String> {
        let values = self.values()?;
        values
            .try_into()
            .map_err(|_| format!("{} numbers, {N} expected", values.len()))
    }
}

/// What is wrong with a header, if anything is.
fn check_header(found: &[String], expected: &[String]) -> Option<String> {
    if found == expected {
        return None;
    }
    if found.len() == 1 && found[0].contains([';', '\t', ' ']) {
        return Some(format!(
            "`{}` is one column: columns are separated by commas",
            shortened(found[0].as_bytes())
        ));
    }
    if found.iter().all(|name| number(name.as_bytes()).is_some()) {
        return Some("the first line has numbers, it must name the columns".into());
    }
    if let Some((i, name)) = found
        .iter()
        .enumerate()
        .find(|(_, name)| !expected.contains(name))
    {
        let missing = expected.iter().filter(|e| !found.contains(e));
        let meant = nearest(name, missing.map(String::as_str))
            .map(|meant| format!(", `{meant}` may be meant"))
            .unwrap_or_default();
        return Some(format!(
            "column {} is `{}`, which is unknown{meant}",
            i + 1,
            shortened(name.as_bytes())
        ));
    }
    let missing: Vec<&str> = expected
        .iter()
        .filter(|e| !found.contains(e))
        .map(String::as_str)
        .collect();
    if !missing.is_empty() {
        return Some(format!("no column `{}`", missing.join("`, `")));
    }
    if found.len() > expected.len() {
        return Some("a column occurs twice".into());
    }
    Some(format!(
        "the columns are in another order: `{}`",
        found.join(",")
    ))
}

pub(super) fn number(cell: &[u8]) -> Option<f64> {
    let value: f64 = std::str::from_utf8(cell).ok()?.trim().parse().ok()?;
    value.is_finite().then_some(value)
}

fn shortened(cell: &[u8]) -> String {
    const LONGEST: usize = 40;
    let text = String::from_utf8_lossy(cell);
    let mut short: String = text.chars().take(LONGEST).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    short.escape_debug().to_string()
}
