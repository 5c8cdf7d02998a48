//! What the system says about a file, in the words that every command uses.
//!
//! ```
//! use rover_files::FileError;
//! let error: FileError = std::fs::read("no/such/file").unwrap_err().into();
//! assert_eq!(error.to_string(), "there is no such file");
//! ```

use std::io::{self, ErrorKind};

/// Why a file cannot be read or written. Its text follows the file's name and a colon; it says what
/// is there and what was expected, never a number of the operating system.
#[derive(Debug, thiserror::Error)]
#[error("{}", words(source, *writes))]
pub struct FileError {
    /// What the system said.
    pub source: io::Error,
    writes: bool,
}

impl FileError {
    /// The failure of writing a file or of making its folder.
    #[must_use]
    pub fn writing(source: io::Error) -> Self {
        Self {
            source,
            writes: true,
        }
    }

    /// Whether there is no such file.
    #[must_use]
    pub fn is_missing(&self) -> bool {
        self.source.kind() == ErrorKind::NotFound
    }

    /// Whether another path would do: nothing is there, or something else, or no permission is
    /// given; not that the machine has failed.
    #[must_use]
    pub fn is_wrong_path(&self) -> bool {
        matches!(
            self.source.kind(),
            ErrorKind::NotFound
                | ErrorKind::IsADirectory
                | ErrorKind::NotADirectory
                | ErrorKind::AlreadyExists
                | ErrorKind::PermissionDenied
                | ErrorKind::ReadOnlyFilesystem
                | ErrorKind::InvalidFilename
        )
    }
}

/// The failure of reading a file.
impl From<io::Error> for FileError {
    fn from(source: io::Error) -> Self {
        Self {
            source,
            writes: false,
        }
    }
}

fn words(error: &io::Error, writes: bool) -> String {
    let fixed = match (error.kind(), writes) {
        (ErrorKind::NotFound, false) => "there is no such file",
        (ErrorKind::NotFound, true) => "its folder is not there and cannot be made",
        (ErrorKind::IsADirectory, _) => "is a folder, a file is expected",
        (ErrorKind::NotADirectory, _) => "a part of the path is a file, a folder is expected there",
        // Of a folder that is to be made.
        (ErrorKind::AlreadyExists, true) => "there is a file, a folder is expected",
        (ErrorKind::PermissionDenied, false) => "no permission to read it",
        (ErrorKind::PermissionDenied, true) => "no permission to write it",
        (ErrorKind::ReadOnlyFilesystem, _) => "its file system can only be read",
        (ErrorKind::StorageFull, _) => "no space is left on its file system",
        (ErrorKind::InvalidFilename, _) => "no name that a file can have",
        // What `read_to_string` says.
        (ErrorKind::InvalidData, false) if error.raw_os_error().is_none() => {
            return format!("not a text in UTF-8 ({error})");
        }
        _ => {
            let said = error.to_string();
            return match said.rsplit_once(" (os error ") {
                Some((said, _)) => said.to_owned(),
                None => said,
            };
        }
    };
    fixed.to_owned()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::fs;

    #[test]
    fn what_is_there_is_told_in_place_of_the_systems_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, [0xff]).unwrap();
        let reading = |error: io::Error| FileError::from(error).to_string();
        let writing = |error: io::Error| FileError::writing(error).to_string();
        let below = file.join("below");
        for (found, expected) in [
            (
                reading(fs::read(folder.path().join("x")).unwrap_err()),
                "there is no such file",
            ),
            (
                reading(fs::read(folder.path()).unwrap_err()),
                "is a folder, a file is expected",
            ),
            (
                reading(fs::read(&below).unwrap_err()),
                "a part of the path is a file, a folder is expected there",
            ),
            (
                writing(fs::create_dir_all(&file).unwrap_err()),
                "there is a file, a folder is expected",
            ),
            (
                writing(fs::write(folder.path().join("x/y"), "").unwrap_err()),
                "its folder is not there and cannot be made",
            ),
        ] {
            assert_eq!(found, expected);
        }
        let wrong = FileError::writing(fs::create_dir_all(&file).unwrap_err());
        let full = FileError::writing(ErrorKind::StorageFull.into());
        assert!(wrong.is_wrong_path() && !full.is_wrong_path());
        let text = reading(fs::read_to_string(&file).unwrap_err());
        assert!(text.starts_with("not a text in UTF-8"), "{text}");
        // EMFILE, for which there are no words of our own.
        let other = reading(io::Error::from_raw_os_error(24));
        assert!(!other.contains("os error") && !other.is_empty(), "{other}");
    }
}
