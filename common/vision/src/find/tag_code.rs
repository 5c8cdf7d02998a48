//! The AprilTag families: where the bits of a tag lie, and which words are tags.
//!
//! Layouts and code words are those of the AprilTag 3 library (J. Wang and E. Olson, "AprilTag 2:
//! Efficient and robust fiducial detection", 2016; M. Krogius, A. Haggenmiller and E. Olson,
//! "Flexible layouts for fiducial tags", 2019; BSD 2-clause).

use std::sync::OnceLock;

/// A family of tags.
#[derive(Debug)]
pub(super) struct Family {
    name: &'static str,
    /// Cells along the square whose outline is found.
    pub cells: usize,
    /// Whether that square is light on dark.
    pub light: bool,
    /// Cell (column, row) of every bit, the most significant first, from the square's first cell.
    pub bits: Vec<(i8, i8)>,
    /// Code words, by identity.
    pub codes: Vec<u64>,
}

/// Names of the families that can be found.
pub const TAG_FAMILIES: [&str; 4] = ["tag36h11", "tagStandard41h12", "tag25h9", "tag16h5"];

struct Source {
    name: &'static str,
    cells: usize,
    light: bool,
    columns: &'static [i8],
    rows: &'static [i8],
    codes: &'static str,
}

const SOURCES: [Source; 4] = [
    Source {
        name: "tag36h11",
        cells: 8,
        light: false,
        columns: &[
            1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5, 4, 3, 2, 5, 4, 3, 4, 1, 1,
            1, 1, 1, 2, 2, 2, 3,
        ],
        rows: &[
            1, 1, 1, 1, 1, 2, 2, 2, 3, 1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5,
            4, 3, 2, 5, 4, 3, 4,
        ],
        codes: include_str!("tag_codes/tag36h11.txt"),
    },
    Source {
        name: "tagStandard41h12",
        cells: 5,
        light: true,
        columns: &[
            -2, -1, 0, 1, 2, 3, 4, 5, 1, 2, 6, 6, 6, 6, 6, 6, 6, 6, 3, 3, 6, 5, 4, 3, 2, 1, 0, -1,
            3, 2, -2, -2, -2, -2, -2, -2, -2, -2, 1, 1, 2,
        ],
        rows: &[
            -2, -2, -2, -2, -2, -2, -2, -2, 1, 1, -2, -1, 0, 1, 2, 3, 4, 5, 1, 2, 6, 6, 6, 6, 6, 6,
            6, 6, 3, 3, 6, 5, 4, 3, 2, 1, 0, -1, 3, 2, 2,
        ],
        codes: include_str!("tag_codes/tagStandard41h12.txt"),
    },
    Source {
        name: "tag25h9",
        cells: 7,
        light: false,
        columns: &[
            1, 2, 3, 4, 2, 3, 5, 5, 5, 5, 4, 4, 5, 4, 3, 2, 4, 3, 1, 1, 1, 1, 2, 2, 3,
        ],
        rows: &[
            1, 1, 1, 1, 2, 2, 1, 2, 3, 4, 2, 3, 5, 5, 5, 5, 4, 4, 5, 4, 3, 2, 4, 3, 3,
        ],
        codes: include_str!("tag_codes/tag25h9.txt"),
    },
    Source {
        name: "tag16h5",
        cells: 6,
        light: false,
        columns: &[1, 2, 3, 2, 4, 4, 4, 3, 4, 3, 2, 3, 1, 1, 1, 2],
        rows: &[1, 1, 1, 2, 1, 2, 3, 2, 4, 4, 4, 3, 4, 3, 2, 3],
        codes: include_str!("tag_codes/tag16h5.txt"),
    },
];

/// The family of that name.
pub(super) fn family(name: &str) -> Option<&'static Family> {
    static ALL: OnceLock<Vec<Family>> = OnceLock::new();
    let all = ALL.get_or_init(|| {
        SOURCES
            .iter()
            .map(|s| Family {
                name: s.name,
                cells: s.cells,
                light: s.light,
                bits: s
                    .columns
                    .iter()
                    .copied()
                    .zip(s.rows.iter().copied())
                    .collect(),
                codes: s
                    .codes
                    .split_whitespace()
                    .filter_map(|word| u64::from_str_radix(word, 16).ok())
                    .collect(),
            })
            .collect()
    });
    all.iter().find(|f| f.name == name)
}

impl Family {
    /// The identity whose word differs from `word` in the fewest bits, and in how many; the first
    /// of equals.
    pub fn nearest(&self, word: u64) -> Option<(u32, u32)> {
        let apart = self.codes.iter().map(|code| (code ^ word).count_ones());
        apart.zip(0..).min().map(|(wrong, id)| (id, wrong))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    /// A word as it reads after a quarter turn: bit lists run through the four quadrants in turn.
    fn turned(word: u64, bits: usize) -> u64 {
        let (quarter, odd) = (bits / 4, bits % 4);
        let low = word & ((1 << odd) - 1);
        let high = word >> odd;
        let size = 4 * quarter;
        let high = ((high << quarter) | (high >> (size - quarter))) & ((1 << size) - 1);
        (high << odd) | low
    }

    #[test]
    fn every_family_has_its_number_of_words_and_keeps_its_distance_under_all_turns() {
        for (name, count, distance) in [
            ("tag36h11", 587, 11),
            ("tagStandard41h12", 2115, 12),
            ("tag25h9", 35, 9),
            ("tag16h5", 30, 5),
        ] {
            let family = family(name).unwrap();
            assert_eq!(family.codes.len(), count, "{name}");
            let bits = family.bits.len();
            let mut least = u32::MAX;
            for (i, &a) in family.codes.iter().enumerate() {
                assert!(a < 1 << bits, "{name} {i}");
                let mut b = a;
                for quarter in 0..4 {
                    for (j, &c) in family.codes.iter().enumerate().skip(i) {
                        if j != i || quarter != 0 {
                            least = least.min((b ^ c).count_ones());
                        }
                    }
                    b = turned(b, bits);
                }
            }
            assert!(least >= distance, "{name}: {least}");
            assert_eq!(family.nearest(family.codes[7] ^ 1), Some((7, 1)));
        }
        assert!(super::family("tag99").is_none());
    }
}
