//! The lines of a table, one at a time.

use super::{STATUS, reader::number};
use std::io::{self, BufRead, BufReader, Read};

/// The longest line that is read, bytes.
const LONGEST_LINE: usize = 64 * 1024;

/// Hands on one line with each read, so that [`line`](Self::line) is that of the record at hand, with
/// a plain end. Comments, which begin with `#`, become empty lines; but if a table begins with
/// numbers and a comment before them names the columns (as `numpy.savetxt` writes it), that one is
/// its header. What would make the reader gather without bound is refused: a line longer than
/// [`LONGEST_LINE`], and a quoted cell that does not end on its line.
pub(super) struct Lines {
    inner: BufReader<Box<dyn Read>>,
    columns: Vec<String>,
    /// Lines read, and lines not handed on yet.
    read: u64,
    held: Vec<(u64, Vec<u8>)>,
    /// The number of the line handed on last, what is left of it.
    line: u64,
    left: Vec<u8>,
    at: usize,
    /// A comment that names the columns, while no line with content has come.
    header: Option<(u64, Vec<u8>)>,
    has_begun: bool,
}

impl Lines {
    pub(super) fn new(source: Box<dyn Read>, columns: Vec<String>) -> Self {
        Self {
            inner: BufReader::new(source),
            columns,
            read: 0,
            held: Vec::new(),
            line: 1,
            left: Vec::new(),
            at: 0,
            header: None,
            has_begun: false,
        }
    }

    /// The number of the line that was handed on last, from 1.
    pub(super) fn line(&self) -> u64 {
        self.line
    }

    /// The next line with content, without its end; nothing at the end of the file.
    fn content(&mut self) -> io::Result<Option<Vec<u8>>> {
        loop {
            let mut line = Vec::new();
            let most = LONGEST_LINE as u64 + 2;
            let length = (&mut self.inner).take(most).read_until(b'\n', &mut line)?;
            if length == 0 {
                return Ok(None);
            }
            self.read += 1;
            self.line = self.read;
            let refused = |what: String| Err(io::Error::other(what));
            line.retain(|byte| !matches!(byte, b'\r' | b'\n'));
            if self.read == 1 && line.starts_with("\u{feff}".as_bytes()) {
                line.drain(..3);
            }
            if line.len() > LONGEST_LINE {
                return refused(format!("the line is longer than {LONGEST_LINE} bytes"));
            }
            match line.trim_ascii_start() {
                [] => continue,
                [b'#', comment @ ..] => {
                    if !self.has_begun && self.names_columns(comment) {
                        self.header = Some((self.read, comment.trim_ascii().to_vec()));
                    }
                    continue;
                }
                _ => {}
            }
            if line.iter().filter(|byte| **byte == b'"').count() % 2 == 1 {
                return refused("a quoted cell does not end on its line".into());
            }
            return Ok(Some(line));
        }
    }

    fn names_columns(&self, comment: &[u8]) -> bool {
        let comment = String::from_utf8_lossy(comment);
        let mut names: Vec<&str> = comment.split(',').map(str::trim).collect();
        if names.len() == self.columns.len() + 1 && names.last() == Some(&STATUS) {
            names.pop();
        }
        names == self.columns
    }

    /// The next line to hand on, with its number.
    fn advance(&mut self) -> io::Result<Option<(u64, Vec<u8>)>> {
        if let Some(held) = self.held.pop() {
            return Ok(Some(held));
        }
        let Some(line) = self.content()? else {
            // A header without rows.
            let header = self.header.take().filter(|_| !self.has_begun);
            self.has_begun = true;
            return Ok(header);
        };
        let row = (self.read, line);
        if !std::mem::replace(&mut self.has_begun, true)
            && let Some(header) = self.header.take()
            && row
                .1
                .split(|byte| *byte == b',')
                .any(|cell| number(cell).is_some())
        {
            self.held.push(row);
            return Ok(Some(header));
        }
        Ok(Some(row))
    }
}

impl Read for Lines {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if buffer.is_empty() {
            return Ok(0);
        }
        if self.at == self.left.len() {
            let Some((line, mut text)) = self.advance()? else {
                return Ok(0);
            };
            text.push(b'\n');
            (self.line, self.left, self.at) = (line, text, 0);
        }
        let count = buffer.len().min(self.left.len() - self.at);
        buffer[..count].copy_from_slice(&self.left[self.at..self.at + count]);
        self.at += count;
        Ok(count)
    }
}
