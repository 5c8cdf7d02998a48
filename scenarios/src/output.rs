//! Output files: `-` is standard output, and what exists is overwritten only with `--force`.

use rover_files::FileError;
use std::{
    io::{self, Write},
    path::{Path, PathBuf},
};

/// Why an output cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// It is there already.
    #[error("{path} exists: give --force to overwrite it, or another name")]
    Exists {
        /// The file.
        path: String,
    },
    /// The system refused.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// What the system said.
        source: FileError,
    },
}

impl OutputError {
    /// Whether another name or path would do.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Exists { .. } => true,
            Self::File { source, .. } => source.is_wrong_path(),
        }
    }
}

/// Where a command writes its data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// Standard output.
    Stdout,
    /// A file.
    File(PathBuf),
}

impl Output {
    /// The output of that name, refused early if it must not be written.
    ///
    /// # Errors
    /// [`OutputError::Exists`].
    pub fn open(name: &Path, force: bool) -> Result<Self, OutputError> {
        if name == Path::new("-") {
            return Ok(Self::Stdout);
        }
        if !force && name.exists() {
            return Err(OutputError::Exists {
                path: name.display().to_string(),
            });
        }
        Ok(Self::File(name.into()))
    }

    /// Writes the whole output.
    ///
    /// # Errors
    /// [`OutputError::File`].
    pub fn write(&self, text: &str) -> Result<(), OutputError> {
        self.write_bytes(text.as_bytes())
    }

    /// Writes the whole output, which need not be text.
    ///
    /// # Errors
    /// [`OutputError::File`].
    pub fn write_bytes(&self, bytes: &[u8]) -> Result<(), OutputError> {
        match self {
            Self::Stdout => print_bytes(bytes),
            Self::File(path) => {
                let file = |source| OutputError::File {
                    path: path.display().to_string(),
                    source: FileError::writing(source),
                };
                if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
                    std::fs::create_dir_all(folder).map_err(file)?;
                }
                std::fs::write(path, bytes).map_err(file)
            }
        }
    }
}

/// Writes to standard output; that the reader has gone away (`| head`) is not an error.
///
/// # Errors
/// [`OutputError::File`].
pub fn print(text: &str) -> Result<(), OutputError> {
    print_bytes(text.as_bytes())
}

fn print_bytes(bytes: &[u8]) -> Result<(), OutputError> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        other => other.map_err(|source| OutputError::File {
            path: "standard output".into(),
            source: FileError::writing(source),
        }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn an_existing_file_is_kept_unless_forced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sub/report.json");
        Output::open(&path, false).unwrap().write("one").unwrap();
        assert!(matches!(
            Output::open(&path, false),
            Err(OutputError::Exists { .. })
        ));
        Output::open(&path, true).unwrap().write("two").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "two");
        assert_eq!(Output::open(Path::new("-"), false).unwrap(), Output::Stdout);
    }
}
