//! A table that is written once and shown on page and terminal.

use rover_page::escape;
use std::fmt::Write;

/// Rows of something and what of them the columns show; the first column is text, the others are
/// numbers.
pub(super) struct Table<'a, T> {
    rows: &'a [T],
    columns: Vec<(&'a str, Vec<String>)>,
}

impl<'a, T> Table<'a, T> {
    /// A table of these rows, still without columns.
    pub(super) fn of(rows: &'a [T]) -> Self {
        Self {
            rows,
            columns: Vec::new(),
        }
    }

    /// Adds a column.
    pub(super) fn column(mut self, head: &'a str, cell: impl Fn(&T) -> String) -> Self {
        self.columns
            .push((head, self.rows.iter().map(cell).collect()));
        self
    }

    /// For the page.
    pub(super) fn html(&self) -> String {
        let class = |column: usize| if column == 0 { " class=\"text\"" } else { "" };
        let mut out = String::from("<div class=\"scroll\"><table><tr>");
        for (i, (head, _)) in self.columns.iter().enumerate() {
            let _ = write!(
                out,
                "<th{} style=\"white-space:normal\">{}</th>",
                class(i),
                escape(head)
            );
        }
        out += "</tr>";
        for row in 0..self.rows.len() {
            out += "<tr>";
            for (i, (_, cells)) in self.columns.iter().enumerate() {
                let _ = write!(
                    out,
                    "<td{} style=\"white-space:nowrap\">{}</td>",
                    class(i),
                    escape(&cells[row])
                );
            }
            out += "</tr>";
        }
        out + "</table></div>"
    }

    /// For a terminal: columns as wide as their numbers, headings broken at words.
    pub(super) fn text(&self) -> String {
        let wide = |s: &str| s.chars().count();
        let columns: Vec<(usize, Vec<String>)> = self
            .columns
            .iter()
            .map(|(head, cells)| {
                let words = head.split(' ').map(wide);
                let width = cells.iter().map(|c| wide(c)).chain(words).max();
                let width = width.unwrap_or(0);
                (width, wrapped(head, width))
            })
            .collect();
        let height = columns
            .iter()
            .map(|(_, head)| head.len())
            .max()
            .unwrap_or(0);
        let mut out = String::new();
        let mut line = |of: &dyn Fn(usize) -> String| {
            let mut line = String::new();
            for (i, (width, _)) in columns.iter().enumerate() {
                let cell = of(i);
                let _ = if i == 0 {
                    write!(line, "  {cell:<width$}")
                } else {
                    write!(line, "  {cell:>width$}")
                };
            }
            let _ = writeln!(out, "{}", line.trim_end());
        };
        for i in 0..height {
            // Headings stand on the rows.
            line(&|column| {
                let head = &columns[column].1;
                let above = height - head.len();
                i.checked_sub(above)
                    .map_or(String::new(), |k| head[k].clone())
            });
        }
        for row in 0..self.rows.len() {
            line(&|column| self.columns[column].1[row].clone());
        }
        out
    }
}

/// Breaks a text at spaces into lines of at most `width` characters, longer words aside.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(last) if last.chars().count() + 1 + word.chars().count() <= width => {
                *last += " ";
                *last += word;
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings_are_broken_and_columns_aligned() {
        let table = Table::of(&[1.0, 20.0])
            .column("what it is", |x| format!("row {x}"))
            .column("value, mm", |x| format!("{x:.1}"));
        assert_eq!(
            table.text(),
            "  what    value,\n  it is       mm\n  row 1      1.0\n  row 20    20.0\n"
        );
        let html = table.html();
        assert!(html.contains(">row 20</td>") && html.contains(">20.0</td>"));
    }
}
