//! XML elements with their place in the file.

use super::UrdfError;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use roxmltree::{Document, Node};

/// The deepest nesting of elements that is read: the parser works by recursion.
const DEEPEST: usize = 100;

/// The place, in bytes, at which elements are nested too deeply, if anywhere.
pub(super) fn too_deep(text: &str) -> Option<usize> {
    let bytes = text.as_bytes();
    let beyond = |from: usize, end: &str| -> usize {
        let rest = text.get(from..).unwrap_or_default();
        rest.find(end).map_or(bytes.len(), |i| from + i + end.len())
    };
    let (mut at, mut depth) = (0, 0_usize);
    while let Some(open) = text.get(at..)?.find('<').map(|i| at + i) {
        let rest = &text[open..];
        at = if rest.starts_with("<!--") {
            beyond(open + 4, "-->")
        } else if rest.starts_with("<![CDATA[") {
            beyond(open, "]]>")
        } else if rest.starts_with("<?") {
            beyond(open, "?>")
        } else if rest.starts_with("</") {
            depth = depth.saturating_sub(1);
            beyond(open, ">")
        } else {
            let mut quote = None;
            let end = bytes[open..].iter().position(|&b| {
                match (quote, b) {
                    (None, b'"' | b'\'') => quote = Some(b),
                    (Some(q), b) if q == b => quote = None,
                    _ => {}
                }
                quote.is_none() && b == b'>'
            });
            let end = open + end?;
            if bytes[end - 1] != b'/' {
                depth += 1;
                if depth > DEEPEST {
                    return Some(open);
                }
            }
            end + 1
        };
    }
    None
}

/// Reads elements and says where they are wrong.
pub(super) struct Reader<'a> {
    pub file: &'a str,
    pub document: &'a Document<'a>,
    /// Where lines begin, bytes.
    line_starts: Vec<usize>,
}

impl<'a> Reader<'a> {
    pub fn new(file: &'a str, document: &'a Document<'a>) -> Self {
        let text = document.input_text();
        let ends = text.bytes().enumerate().filter(|(_, b)| *b == b'\n');
        Self {
            file,
            document,
            line_starts: std::iter::once(0).chain(ends.map(|(i, _)| i + 1)).collect(),
        }
    }

    /// Line and column, from 1.
    fn place(&self, node: Node<'a, 'a>) -> (u32, u32) {
        let start = node.range().start;
        let line = self.line_starts.partition_point(|s| *s <= start);
        let column = start - self.line_starts[line - 1] + 1;
        let small = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        (small(line), small(column))
    }

    pub fn line(&self, node: Node<'a, 'a>) -> u32 {
        self.place(node).0
    }

    pub fn error(&self, node: Node<'a, 'a>, message: impl Into<String>) -> UrdfError {
        let (line, column) = self.place(node);
        UrdfError::Text {
            file: self.file.into(),
            line,
            column,
            message: message.into(),
        }
    }

    pub fn attribute(&self, node: Node<'a, 'a>, name: &str) -> Result<&'a str, UrdfError> {
        node.attribute(name).ok_or_else(|| {
            let element = node.tag_name().name();
            self.error(node, format!("<{element}> has no attribute `{name}`"))
        })
    }

    /// The only child of that name, if there is one.
    pub fn child(&self, node: Node<'a, 'a>, name: &str) -> Result<Option<Node<'a, 'a>>, UrdfError> {
        let mut found = node.children().filter(|c| c.has_tag_name(name));
        let first = found.next();
        match found.next() {
            None => Ok(first),
            Some(second) => Err(self.error(
                second,
                format!("a second <{name}> in <{}>", node.tag_name().name()),
            )),
        }
    }

    /// Finite numbers separated by blanks.
    pub fn numbers<const N: usize>(
        &self,
        node: Node<'a, 'a>,
        name: &str,
        text: &str,
    ) -> Result<[f64; N], UrdfError> {
        let wrong = || {
            let element = node.tag_name().name();
            let (found, more) = match text.char_indices().nth(60) {
                None => (text, ""),
                Some((end, _)) => (&text[..end], "..."),
            };
            let expected = if N == 1 {
                "a finite number".into()
            } else {
                format!("{N} finite numbers")
            };
            self.error(
                node,
                format!("<{element} {name}=\"{found}{more}\">: expected {expected}"),
            )
        };
        let mut values = [0.0; N];
        let mut words = text.split_whitespace();
        for value in &mut values {
            let word = words.next().ok_or_else(wrong)?;
            *value = word
                .parse()
                .ok()
                .filter(|v: &f64| v.is_finite())
                .ok_or_else(wrong)?;
        }
        match words.next() {
            None => Ok(values),
            Some(_) => Err(wrong()),
        }
    }

    /// A number that may be absent.
    pub fn number(&self, node: Node<'a, 'a>, name: &str) -> Result<Option<f64>, UrdfError> {
        let Some(text) = node.attribute(name) else {
            return Ok(None);
        };
        let [value] = self.numbers(node, name, text)?;
        Ok(Some(value))
    }

    /// The pose of an `<origin>` child: translation, and roll, pitch, yaw about fixed axes; the
    /// identity where the format lets it be absent.
    pub fn origin(&self, node: Node<'a, 'a>) -> Result<Isometry3<f64>, UrdfError> {
        let Some(origin) = self.child(node, "origin")? else {
            return Ok(Isometry3::identity());
        };
        let vector = |name| match origin.attribute(name) {
            Some(text) => self.numbers::<3>(origin, name, text),
            None => Ok([0.0; 3]),
        };
        let [roll, pitch, yaw] = vector("rpy")?;
        Ok(Isometry3::from_parts(
            Vector3::from(vector("xyz")?).into(),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        ))
    }
}
