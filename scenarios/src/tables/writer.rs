//! Writing a table.

use super::{OK, STATUS, TableError};
use crate::output::{Output, OutputError};
use rover_files::FileError;
use std::{
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

/// A table that is being written, row by row.
///
/// A file appears under its name only with [`finish`](Self::finish): rows go to `NAME.partial` beside
/// it, which is removed when the work ends early. So a failed command leaves no half table, and a table
/// can be replaced by one that is made from it.
pub struct TableWriter {
    file: String,
    columns: usize,
    sink: Option<csv::Writer<Box<dyn Write>>>,
    partial: Option<(PathBuf, PathBuf)>,
    answered: u64,
    refused: u64,
}

impl TableWriter {
    /// Starts the table `path`, or standard output for `-`, with these columns and `status`.
    ///
    /// # Errors
    /// [`OutputError`]: the file exists and `force` is not given, or it cannot be written.
    pub fn create(
        path: &Path,
        force: bool,
        columns: &[impl AsRef<str>],
    ) -> Result<Self, TableError> {
        let output = Output::open(path, force)?;
        let (file, sink, partial): (_, Box<dyn Write>, _) = match &output {
            Output::Stdout => (
                "standard output".to_owned(),
                Box::new(BufWriter::new(io::stdout())),
                None,
            ),
            Output::File(path) => {
                let name = path.display().to_string();
                let failed = |source| OutputError::File {
                    path: name.clone(),
                    source: FileError::writing(source),
                };
                if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
                    fs::create_dir_all(folder).map_err(failed)?;
                }
                // A pipe or a device is written to, not replaced.
                let special = fs::metadata(path).is_ok_and(|m| !m.is_file());
                let partial = (!special).then(|| (partial_name(path), path.clone()));
                let written = partial.as_ref().map_or(path, |(partial, _)| partial);
                let sink = File::create(written).map_err(failed)?;
                (name, Box::new(BufWriter::new(sink)), partial)
            }
        };
        let mut writer = Self {
            file,
            columns: columns.len(),
            sink: Some(csv::Writer::from_writer(sink)),
            partial,
            answered: 0,
            refused: 0,
        };
        writer.record(columns.iter().map(AsRef::as_ref).chain([STATUS]))?;
        Ok(writer)
    }

    /// Writes a row: the numbers, or the reason why there are none. Numbers that are not finite are
    /// never written; the row then says so.
    ///
    /// # Errors
    /// [`TableError::Output`]; [`TableError::Answer`] when there are not as many numbers as columns.
    pub fn answer<T: AsRef<[f64]>, E: ToString>(
        &mut self,
        answer: Result<T, E>,
    ) -> Result<(), TableError> {
        let numbers = match &answer {
            Ok(numbers) => numbers.as_ref(),
            Err(reason) => return self.refuse_after(&[], &reason.to_string()),
        };
        if numbers.len() != self.columns {
            return Err(TableError::Answer {
                file: self.file.clone(),
                found: numbers.len(),
                expected: self.columns,
            });
        }
        if numbers.iter().any(|n| !n.is_finite()) {
            return self.refuse_after(&[], "the answer is not finite");
        }
        let cells: Vec<String> = numbers.iter().map(|&n| shortest(n)).collect();
        self.answered += 1;
        self.record(cells.iter().map(String::as_str).chain([OK]))
    }

    /// Writes a row without an answer, whose first cells are known all the same: the number of the
    /// row that was asked about, say.
    ///
    /// # Errors
    /// As [`answer`](Self::answer).
    pub fn refuse_after(&mut self, known: &[f64], reason: &str) -> Result<(), TableError> {
        if known.len() > self.columns {
            return Err(TableError::Answer {
                file: self.file.clone(),
                found: known.len(),
                expected: self.columns,
            });
        }
        // One row, one line; and a refusal never reads as an answer.
        let reason = reason.split_whitespace().collect::<Vec<_>>().join(" ");
        let reason = if reason.is_empty() || reason == OK {
            "no answer"
        } else {
            &reason
        };
        self.refused += 1;
        let known: Vec<String> = known.iter().map(|&n| shortest(n)).collect();
        let empty = std::iter::repeat_n("", self.columns - known.len());
        self.record(
            known
                .iter()
                .map(String::as_str)
                .chain(empty)
                .chain([reason]),
        )
    }

    fn record<'a>(&mut self, cells: impl Iterator<Item = &'a str>) -> Result<(), TableError> {
        let Some(sink) = &mut self.sink else {
            return Ok(());
        };
        match sink.write_record(cells) {
            Ok(()) => Ok(()),
            Err(error) => {
                let error = match error.into_kind() {
                    csv::ErrorKind::Io(e) => e,
                    other => io::Error::other(format!("{other:?}")),
                };
                self.failed(error)
            }
        }
    }

    /// That the reader has gone away (`| head`) ends the writing and is not an error.
    fn failed(&mut self, source: io::Error) -> Result<(), TableError> {
        if self.partial.is_none() && source.kind() == io::ErrorKind::BrokenPipe {
            self.sink = None;
            return Ok(());
        }
        Err(TableError::Output(OutputError::File {
            path: self.file.clone(),
            source: FileError::writing(source),
        }))
    }

    /// Whether the reader of the output has gone away: nobody waits for more rows.
    pub fn is_closed(&self) -> bool {
        self.sink.is_none()
    }

    /// Rows with an answer, rows without.
    pub fn counts(&self) -> (u64, u64) {
        (self.answered, self.refused)
    }

    /// Writes what is left and gives the file its name.
    ///
    /// # Errors
    /// [`TableError::Output`].
    pub fn finish(mut self) -> Result<(), TableError> {
        if let Some(mut sink) = self.sink.take()
            && let Err(error) = sink.flush()
        {
            return self.failed(error);
        }
        if let Some((partial, path)) = self.partial.take()
            && let Err(error) = fs::rename(&partial, &path)
        {
            self.partial = Some((partial, path));
            return self.failed(error);
        }
        Ok(())
    }
}

impl Drop for TableWriter {
    fn drop(&mut self) {
        if let Some((partial, _)) = &self.partial {
            // Nothing can be done about a file that cannot be removed.
            let _ = fs::remove_file(partial);
        }
    }
}

fn partial_name(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

/// The fewest digits that read back as the same double; an exponent where zeros would fill the cell.
fn shortest(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 || (1e-5..1e16).contains(&size) {
        format!("{value}")
    } else {
        format!("{value:e}")
    }
}
