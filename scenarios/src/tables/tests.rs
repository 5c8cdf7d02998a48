//! What the tables promise.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use super::*;
use std::{io::Cursor, path::Path};

const XYZ: [&str; 3] = ["x_m", "y_m", "z_m"];

fn table(text: impl Into<Vec<u8>>) -> Result<Table, TableError> {
    Table::from_reader("p.csv", Box::new(Cursor::new(text.into())), &XYZ)
}

fn rows(text: impl Into<Vec<u8>>) -> Vec<[f64; 3]> {
    table(text)
        .unwrap()
        .map(|row| row.unwrap().array().unwrap())
        .collect()
}

fn refusal(text: impl Into<Vec<u8>>) -> String {
    match table(text) {
        Err(error) => error.to_string(),
        Ok(mut table) => table.find_map(Result::err).unwrap().to_string(),
    }
}

#[test]
fn numbers_come_in_the_order_of_the_rows() {
    let text = "x_m,y_m,z_m\n1,2,3\n-4.5e-3,+0.5, 6 \n";
    assert_eq!(rows(text), [[1.0, 2.0, 3.0], [-4.5e-3, 0.5, 6.0]]);
}

#[test]
fn marks_line_ends_quotes_and_blank_lines_of_other_tools_are_understood() {
    let text = "\u{feff}\"x_m\",\"y_m\",\"z_m\"\r\n\r\n\"1\",2,3\r\n4,5,6";
    assert_eq!(rows(text), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    let second = table(text).unwrap().next().unwrap().unwrap();
    assert_eq!(second.line(), 3);
}

#[test]
fn comments_are_passed_over_and_lines_are_those_of_the_file() {
    let text = "# of the rig, \"day 2\n\nx_m,y_m,z_m\n1,2,3\n  # far\n\n4,5,6\n7,8,x\n";
    let mut table = table(text).unwrap();
    let next = |table: &mut Table| table.next().unwrap();
    assert_eq!(next(&mut table).unwrap().line(), 4);
    assert_eq!(next(&mut table).unwrap().line(), 7);
    let error = next(&mut table).unwrap_err().to_string();
    assert!(error.starts_with("p.csv:8:3: `z_m` is `x`"), "{error}");
}

/// As `numpy.savetxt(..., delimiter=",", header="x_m,y_m,z_m")` writes it.
#[test]
fn a_comment_is_the_header_of_a_table_that_begins_with_numbers() {
    for text in [
        "# x_m,y_m,z_m\n1,2,3\n4,5,6\n",
        "\u{feff}#x_m, y_m, z_m\n# more\n1,2,3\n4,5,6\n",
        "# x_m,y_m,z_m\nx_m,y_m,z_m\n1,2,3\n4,5,6\n",
        "# x_m,y_m,z_m,status\n1,2,3,ok\n4,5,6,ok\n",
    ] {
        assert_eq!(rows(text), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], "{text}");
    }
    assert_eq!(rows("# x_m,y_m,z_m\n"), Vec::<[f64; 3]>::new());
    for other in ["# x_m,y_m\n1,2,3\n", "1,2,3\n# x_m,y_m,z_m\n"] {
        let message = refusal(other);
        assert!(message.contains("the first line has numbers"), "{message}");
    }
    let message = refusal("# x_m,y_m,z_m\n1,2\n");
    assert_eq!(message, "p.csv:2: 2 cells, 3 expected as in the header");
}

#[test]
fn a_wrong_header_is_refused_with_the_name_that_was_meant() {
    for (header, part) in [
        (
            "x_m,y_mm,z_m",
            "p.csv:1: column 2 is `y_mm`, which is unknown, `y_m` may be meant",
        ),
        ("x_m,y_m", "no column `z_m`"),
        ("x_m,y_m,z_m,w", "column 4 is `w`, which is unknown;"),
        ("x_m,y_m,z_m,z_m", "a column occurs twice"),
        (
            "z_m,y_m,x_m",
            "the columns are in another order: `z_m,y_m,x_m`",
        ),
        ("x_m;y_m;z_m", "columns are separated by commas"),
        ("1,2,3", "the first line has numbers"),
        ("", "the table is empty"),
        (
            "X_m,y_m,z_m",
            "column 1 is `X_m`, which is unknown, `x_m` may be meant",
        ),
    ] {
        let message = refusal(header);
        assert!(message.contains(part), "{header}: {message}");
        assert!(message.ends_with("the header must be `x_m,y_m,z_m`"));
    }
}

#[test]
fn a_wrong_cell_is_refused_with_its_line_and_column() {
    for cell in [
        "",
        "abc",
        "nan",
        "inf",
        "1e999",
        "0x10",
        "1;5",
        "1 000",
        "\u{1b}[2J",
    ] {
        let message = refusal(format!("x_m,y_m,z_m\n0,0,0\n1,{cell},3\n"));
        assert!(message.starts_with("p.csv:3:2: `y_m` is `"), "{message}");
        assert!(!message.contains('\u{1b}'));
    }
    let message = refusal("x_m,y_m,z_m\n1,2\n");
    assert_eq!(message, "p.csv:2: 2 cells, 3 expected as in the header");
    assert!(refusal("x_m,y_m,z_m\n1,2,3,\n").contains("4 cells, 3 expected"));
    assert!(refusal(b"x_m,y_m,z_m\n1,\xff\xfe,3\n".to_vec()).starts_with("p.csv:2:2:"));
}

#[test]
fn nothing_is_read_after_the_first_error() {
    let mut table = table("x_m,y_m,z_m\n1,2,x\n1,2,3\n").unwrap();
    assert!(table.next().unwrap().is_err());
    assert!(table.next().is_none());
}

/// A line without end and a quote without end would otherwise be gathered whole.
#[test]
fn endless_lines_and_quotes_are_refused_early() {
    struct Endless(&'static [u8], usize);
    impl std::io::Read for Endless {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            for byte in buffer.iter_mut() {
                *byte = self.0[self.1 % self.0.len()];
                self.1 += 1;
            }
            assert!(self.1 < 1_000_000, "a megabyte was read of one line");
            Ok(buffer.len())
        }
    }
    for (endless, part) in [
        (&b"1,"[..], ":1: the line is longer than 65536 bytes"),
        (&b"\"1\n"[..], ":1: a quoted cell does not end on its line"),
    ] {
        let error = Table::from_reader("p.csv", Box::new(Endless(endless, 0)), &XYZ)
            .err()
            .unwrap();
        assert!(error.to_string().contains(part), "{error}");
    }
}

#[test]
fn a_missing_file_is_bad_input() {
    let error = Table::open(Path::new("/nowhere/p.csv"), &XYZ)
        .err()
        .unwrap();
    assert!(error.is_bad_input());
    assert!(error.to_string().starts_with("/nowhere/p.csv: "));
}

fn written(work: impl FnOnce(&mut TableWriter)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sub/out.csv");
    let mut writer = TableWriter::create(&path, false, &["u_px", "v_px"]).unwrap();
    work(&mut writer);
    writer.finish().unwrap();
    let names: Vec<_> = std::fs::read_dir(path.parent().unwrap()).unwrap().collect();
    assert_eq!(names.len(), 1);
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn a_row_without_answer_has_empty_cells_and_the_reason() {
    let text = written(|out| {
        out.answer::<_, String>(Ok([1.5, -2.0])).unwrap();
        out.answer::<[f64; 2], _>(Err("behind the camera, by\n0.2 m"))
            .unwrap();
        out.answer::<_, String>(Ok([f64::NAN, 1.0])).unwrap();
        out.answer::<[f64; 2], _>(Err("ok")).unwrap();
        assert_eq!(out.counts(), (1, 3));
        assert!(matches!(
            out.answer::<_, String>(Ok([1.0])),
            Err(TableError::Answer { .. })
        ));
    });
    assert_eq!(
        text,
        "u_px,v_px,status\n1.5,-2,ok\n,,\"behind the camera, by 0.2 m\"\n,,the answer is not finite\n,,no answer\n"
    );
}

#[test]
fn every_double_reads_back_as_itself() {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut values = vec![
        0.0,
        -0.0,
        1.0,
        0.1 + 0.2,
        1e-5,
        1e16,
        f64::MIN_POSITIVE,
        f64::MAX,
        5e-324,
    ];
    while values.len() < 20_000 {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let value = f64::from_bits(state);
        if value.is_finite() {
            values.push(value);
        }
    }
    let text = written(|out| {
        for &v in &values {
            out.answer::<_, String>(Ok([v, -v])).unwrap();
        }
    });
    let back = Table::from_reader("t", Box::new(Cursor::new(text)), &["u_px", "v_px"]).unwrap();
    let mut count = 0;
    for (row, value) in back.zip(&values) {
        let [v, w]: [f64; 2] = row.unwrap().array().unwrap();
        assert_eq!(v.to_bits(), value.to_bits());
        assert_eq!(w.to_bits(), (-value).to_bits());
        count += 1;
    }
    assert_eq!(count, values.len());
}

#[test]
fn the_reasons_of_an_earlier_command_are_handed_on() {
    let text = "x_m,y_m,z_m,status\n1,2,3,ok\n,,,\"out of reach, by 0.1 m\"\n";
    let rows: Vec<_> = table(text).unwrap().map(Result::unwrap).collect();
    assert_eq!(rows[0].array(), Ok([1.0, 2.0, 3.0]));
    assert_eq!(rows[1].array::<3>(), Err("out of reach, by 0.1 m".into()));
}

#[test]
fn a_table_can_be_replaced_by_one_made_from_it_and_survives_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.csv");
    std::fs::write(&path, "x_m\n1\n2\n").unwrap();
    assert!(TableWriter::create(&path, false, &["x_m"]).is_err());
    let double = |give_up: bool| {
        let mut out = TableWriter::create(&path, true, &["x_m"]).unwrap();
        for row in Table::open(&path, &["x_m"]).unwrap() {
            out.answer(row.unwrap().array().map(|[x]| [2.0 * x]))
                .unwrap();
            if give_up {
                return;
            }
        }
        out.finish().unwrap();
    };
    double(true);
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "x_m\n1\n2\n");
    double(false);
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(text, "x_m,status\n2,ok\n4,ok\n");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
