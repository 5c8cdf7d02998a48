//! The pose fiducial as data: a flat plate with dark discs on white and a checker saddle.
//!
//! Plate frame: x to the right and y up as seen from the front, z the outward normal, origin at the
//! plate's centre.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// A dark disc.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Disc {
    /// Centre, plate x, m.
    pub x_m: f64,
    /// Centre, plate y, m.
    pub y_m: f64,
    /// Radius, m.
    pub radius_m: f64,
}

/// A 2 x 2 checker: the quadrants with x y > 0 (about its centre) are black, the others white.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Saddle {
    /// Centre, plate x, m.
    pub x_m: f64,
    /// Centre, plate y, m.
    pub y_m: f64,
    /// Half the side of the checker's square, m.
    pub half_size_m: f64,
}

/// What is painted on the plate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlateLayout {
    /// Half the plate's width (along x), m.
    pub half_width_m: f64,
    /// Half the plate's height (along y), m.
    pub half_height_m: f64,
    /// Albedo of the white ground, 0 to 1.
    pub white: f64,
    /// Albedo of discs and black quadrants, 0 to 1.
    pub black: f64,
    /// The discs; their order gives the point indices.
    pub discs: Vec<Disc>,
    /// The central checker, if there is one; its point index is `discs.len()`.
    pub saddle: Option<Saddle>,
}

/// What is wrong with a layout.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LayoutError {
    /// A number is not usable.
    #[error("plate layout: {what} is {found}, expected {expected}")]
    BadValue {
        /// The field.
        what: String,
        /// Its value.
        found: f64,
        /// What it should be.
        expected: String,
    },
    /// Two marks touch, or a mark reaches over the plate's edge.
    #[error("plate layout: {first} and {second} are {gap_m} m apart, expected a gap above 0")]
    Overlap {
        /// One mark.
        first: String,
        /// The other mark, or the edge.
        second: String,
        /// Distance between their outlines (negative: they overlap), m.
        gap_m: f64,
    },
    /// There is nothing to see.
    #[error("plate layout: there is neither a disc nor a saddle")]
    Empty,
    /// Turned by the stated angle the layout matches itself, so its pose would be ambiguous.
    #[error("plate layout: turned by {angle_deg} degrees it looks the same")]
    Symmetric {
        /// Angle of the rotation, degrees.
        angle_deg: f64,
    },
}

/// Marks closer than this fraction of a disc radius count as the same place in the symmetry check.
const SAME_PLACE: f64 = 0.5;

/// Length of a vector on the plate, m.
fn length(x_m: f64, y_m: f64) -> f64 {
    (x_m * x_m + y_m * y_m).sqrt()
}

impl PlateLayout {
    /// A square plate of the given width: 11 discs on a ring along the border (4 per side; one of
    /// the 12 places is empty, so that no rotation maps the layout onto itself) and a checker in
    /// the middle.
    ///
    /// Proportions for 80 mm: disc radius 5.2 mm (minor radius 2.5 px at 1.33 mm per px seen 50
    /// degrees obliquely), 3.8 mm of white beyond the discs, 10.3 mm between them.
    #[must_use]
    pub fn standard(width_m: f64) -> Self {
        let half = width_m / 2.0;
        let reach = 0.3875 * width_m; // 31 mm of 80
        let radius_m = 0.065 * width_m; // 5.2 mm of 80
        let third = reach / 3.0;
        let ring = [
            (-reach, -reach),
            (-third, -reach),
            (third, -reach),
            (reach, -reach),
            (reach, -third),
            (reach, third),
            (reach, reach),
            (third, reach),
            // (-third, reach) stays empty
            (-reach, reach),
            (-reach, third),
            (-reach, -third),
        ];
        Self {
            half_width_m: half,
            half_height_m: half,
            white: 0.85,
            black: 0.06,
            discs: ring
                .iter()
                .map(|&(x_m, y_m)| Disc { x_m, y_m, radius_m })
                .collect(),
            saddle: Some(Saddle {
                x_m: 0.0,
                y_m: 0.0,
                half_size_m: 0.2 * width_m,
            }),
        }
    }

    /// Albedo at a place on the plate, with hard edges; `None` outside the plate.
    #[inline]
    #[must_use]
    pub fn albedo(&self, x_m: f64, y_m: f64) -> Option<f64> {
        if !(x_m.abs() <= self.half_width_m && y_m.abs() <= self.half_height_m) {
            return None;
        }
        if let Some(s) = &self.saddle {
            let (dx, dy) = (x_m - s.x_m, y_m - s.y_m);
            if dx.abs() <= s.half_size_m && dy.abs() <= s.half_size_m {
                return Some(if dx * dy > 0.0 {
                    self.black
                } else {
                    self.white
                });
            }
        }
        for d in &self.discs {
            let (dx, dy) = (x_m - d.x_m, y_m - d.y_m);
            if dx * dx + dy * dy <= d.radius_m * d.radius_m {
                return Some(self.black);
            }
        }
        Some(self.white)
    }

    /// Number of points: the discs, then the saddle.
    #[must_use]
    pub fn point_count(&self) -> usize {
        self.discs.len() + usize::from(self.saddle.is_some())
    }

    /// The point with an index in plate coordinates, m; `None` if there is no such point.
    #[must_use]
    pub fn point(&self, index: usize) -> Option<Vector3<f64>> {
        match self.discs.get(index) {
            Some(d) => Some(Vector3::new(d.x_m, d.y_m, 0.0)),
            None if index == self.discs.len() => self
                .saddle
                .as_ref()
                .map(|s| Vector3::new(s.x_m, s.y_m, 0.0)),
            None => None,
        }
    }

    /// Checks sizes, albedos, gaps between the marks, and that no rotation by 90, 180 or 270
    /// degrees maps the marks onto themselves (with three or more discs).
    ///
    /// # Errors
    /// The first [`LayoutError`] found.
    pub fn validate(&self) -> Result<(), LayoutError> {
        let bad = |what: String, found: f64, expected: &str| {
            Err(LayoutError::BadValue {
                what,
                found,
                expected: expected.into(),
            })
        };
        for (what, size) in [
            ("half_width_m", self.half_width_m),
            ("half_height_m", self.half_height_m),
        ] {
            if !(size.is_finite() && size > 0.0) {
                return bad(what.into(), size, "a positive length");
            }
        }
        for (what, albedo) in [("white", self.white), ("black", self.black)] {
            if !(0.0..=1.0).contains(&albedo) {
                return bad(what.into(), albedo, "0 to 1");
            }
        }
        if self.white <= self.black {
            return bad("white".into(), self.white, "more than black");
        }
        if self.discs.is_empty() && self.saddle.is_none() {
            return Err(LayoutError::Empty);
        }
        for (i, d) in self.discs.iter().enumerate() {
            for (what, x) in [("x_m", d.x_m), ("y_m", d.y_m)] {
                if !x.is_finite() {
                    return bad(format!("discs[{i}].{what}"), x, "a finite length");
                }
            }
            if !(d.radius_m.is_finite() && d.radius_m > 0.0) {
                return bad(
                    format!("discs[{i}].radius_m"),
                    d.radius_m,
                    "a positive length",
                );
            }
        }
        if let Some(s) = &self.saddle {
            for (what, x) in [("x_m", s.x_m), ("y_m", s.y_m)] {
                if !x.is_finite() {
                    return bad(format!("saddle.{what}"), x, "a finite length");
                }
            }
            if !(s.half_size_m.is_finite() && s.half_size_m > 0.0) {
                return bad(
                    "saddle.half_size_m".into(),
                    s.half_size_m,
                    "a positive length",
                );
            }
        }
        self.check_gaps()?;
        self.check_symmetry()
    }

    fn check_gaps(&self) -> Result<(), LayoutError> {
        let name = |i: usize| {
            if i < self.discs.len() {
                format!("discs[{i}]")
            } else {
                "the saddle".into()
            }
        };
        let apart = |i: usize, other: Option<usize>, gap_m: f64| {
            if gap_m > 0.0 {
                return Ok(());
            }
            let second = other.map_or_else(|| "the edge".into(), name);
            Err(LayoutError::Overlap {
                first: name(i),
                second,
                gap_m,
            })
        };
        let to_edge = |x: f64, y: f64, reach: f64| {
            (self.half_width_m - x.abs()).min(self.half_height_m - y.abs()) - reach
        };
        let last = self.discs.len();
        for (i, d) in self.discs.iter().enumerate() {
            apart(i, None, to_edge(d.x_m, d.y_m, d.radius_m))?;
            for (j, other) in self.discs.iter().enumerate().skip(i + 1) {
                let distance = length(d.x_m - other.x_m, d.y_m - other.y_m);
                apart(i, Some(j), distance - d.radius_m - other.radius_m)?;
            }
            if let Some(s) = &self.saddle {
                let dx = ((d.x_m - s.x_m).abs() - s.half_size_m).max(0.0);
                let dy = ((d.y_m - s.y_m).abs() - s.half_size_m).max(0.0);
                apart(i, Some(last), length(dx, dy) - d.radius_m)?;
            }
        }
        if let Some(s) = &self.saddle {
            apart(last, None, to_edge(s.x_m, s.y_m, s.half_size_m))?;
        }
        Ok(())
    }

    fn check_symmetry(&self) -> Result<(), LayoutError> {
        if self.discs.len() < 3 {
            return Ok(()); // a marker without pose
        }
        for quarter_turns in 1..4 {
            let turned = |x: f64, y: f64| match quarter_turns {
                1 => (-y, x),
                2 => (-x, -y),
                _ => (y, -x),
            };
            let same = self.discs.iter().all(|d| {
                let (x, y) = turned(d.x_m, d.y_m);
                self.discs
                    .iter()
                    .any(|e| length(x - e.x_m, y - e.y_m) < SAME_PLACE * e.radius_m)
            });
            if same {
                return Err(LayoutError::Symmetric {
                    angle_deg: 90.0 * f64::from(quarter_turns),
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn the_standard_plate_is_valid_and_has_the_stated_sizes() {
        let plate = PlateLayout::standard(0.08);
        plate.validate().unwrap();
        assert_eq!(plate.point_count(), 12);
        assert_eq!(plate.point(11).unwrap(), Vector3::zeros());
        assert!(plate.point(12).is_none());
        for d in &plate.discs {
            assert!((d.radius_m - 0.0052).abs() < 1e-12);
            assert!(d.x_m.abs().max(d.y_m.abs()) + d.radius_m < 0.04 - 0.0037);
        }
    }

    #[test]
    fn albedo_has_hard_edges_at_the_marks() {
        let plate = PlateLayout::standard(0.08);
        let d = plate.discs[4];
        assert_eq!(
            plate.albedo(d.x_m + d.radius_m - 1e-9, d.y_m),
            Some(plate.black)
        );
        assert_eq!(
            plate.albedo(d.x_m + d.radius_m + 1e-9, d.y_m),
            Some(plate.white)
        );
        assert_eq!(plate.albedo(0.001, 0.001), Some(plate.black));
        assert_eq!(plate.albedo(-0.001, -0.001), Some(plate.black));
        assert_eq!(plate.albedo(-0.001, 0.001), Some(plate.white));
        assert_eq!(plate.albedo(0.0401, 0.0), None);
        assert_eq!(plate.albedo(f64::NAN, 0.0), None);
    }

    #[test]
    fn faulty_layouts_are_refused_by_name() {
        let good = PlateLayout::standard(0.08);
        let refused = |change: &dyn Fn(&mut PlateLayout)| {
            let mut plate = good.clone();
            change(&mut plate);
            plate.validate().unwrap_err()
        };
        let full_ring = refused(&|p| {
            let d = p.discs[0];
            p.discs.push(Disc {
                x_m: -0.031 / 3.0,
                y_m: 0.031,
                ..d
            });
        });
        assert_eq!(full_ring, LayoutError::Symmetric { angle_deg: 90.0 });
        assert!(
            refused(&|p| p.discs[2].radius_m = -1.0)
                .to_string()
                .contains("discs[2].radius_m")
        );
        assert!(matches!(
            refused(&|p| p.discs[2].x_m = 0.037),
            LayoutError::Overlap { .. }
        ));
        assert!(
            refused(&|p| p.white = f64::NAN)
                .to_string()
                .contains("white")
        );
        let empty = refused(&|p| {
            p.discs.clear();
            p.saddle = None;
        });
        assert_eq!(empty, LayoutError::Empty);
    }

    #[test]
    fn a_layout_survives_json_and_unknown_fields_are_refused() {
        let plate = PlateLayout::standard(0.08);
        let text = serde_json::to_string(&plate).unwrap();
        assert_eq!(serde_json::from_str::<PlateLayout>(&text).unwrap(), plate);
        let text = text.replace("\"white\"", "\"colour\":1,\"white\"");
        assert!(serde_json::from_str::<PlateLayout>(&text).is_err());
    }
}
