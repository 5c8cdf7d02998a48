//! Distances between the shapes that robot and terrain are made of: segments (the core lines of
//! capsules) and columns (the cells of a height grid). Exact, in closed form.

use nalgebra::Vector3;

/// The straight line between two points, metres; both may coincide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// One end, m.
    pub from: Vector3<f64>,
    /// The other end, m.
    pub to: Vector3<f64>,
}

/// The solid below `top_m` and above a rectangle of the ground: unbounded downwards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Column {
    /// Smallest x and y, m.
    pub low_m: [f64; 2],
    /// Largest x and y, m.
    pub high_m: [f64; 2],
    /// Height, m.
    pub top_m: f64,
}

/// The two points of two shapes that are nearest to each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// Their distance, m.
    pub distance_m: f64,
    /// The point on the first shape, m.
    pub on_first: Vector3<f64>,
    /// The point on the second shape, m.
    pub on_second: Vector3<f64>,
}

impl Closest {
    fn between(on_first: Vector3<f64>, on_second: Vector3<f64>) -> Self {
        Self {
            distance_m: (on_first - on_second).norm(),
            on_first,
            on_second,
        }
    }
}

impl Segment {
    /// The point at the fraction `t` of the way.
    pub fn at(&self, t: f64) -> Vector3<f64> {
        self.from + (self.to - self.from) * t
    }

    /// Nearest points of two segments.
    ///
    /// The squared distance is a convex quadratic over the square of both fractions: its minimum
    /// is the unconstrained one if that lies inside, else on one of the four edges, each of which
    /// is a point against a segment.
    pub fn closest_to_segment(&self, other: &Self) -> Closest {
        let (d1, d2) = (self.to - self.from, other.to - other.from);
        let offset = self.from - other.from;
        let (a, b, e) = (d1.norm_squared(), d1.dot(&d2), d2.norm_squared());
        let (c, f) = (d1.dot(&offset), d2.dot(&offset));
        let determinant = a * e - b * b;
        if determinant > 1e-12 * a * e {
            let s = (b * f - c * e) / determinant;
            let t = (a * f - b * c) / determinant;
            if (0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t) {
                return Closest::between(self.at(s), other.at(t));
            }
        }
        let ends = [
            Closest::between(self.from, other.at(other.nearest_fraction(&self.from))),
            Closest::between(self.to, other.at(other.nearest_fraction(&self.to))),
            Closest::between(self.at(self.nearest_fraction(&other.from)), other.from),
            Closest::between(self.at(self.nearest_fraction(&other.to)), other.to),
        ];
        ends.into_iter().fold(ends[0], |best, c| {
            if c.distance_m < best.distance_m {
                c
            } else {
                best
            }
        })
    }

    /// Fraction of the way at which the segment is nearest to `point`.
    pub fn nearest_fraction(&self, point: &Vector3<f64>) -> f64 {
        let d = self.to - self.from;
        let length_squared = d.norm_squared();
        if length_squared == 0.0 {
            0.0
        } else {
            (d.dot(&(point - self.from)) / length_squared).clamp(0.0, 1.0)
        }
    }

    /// The parts of the segment outside a ball: none, one, or one on either side of it.
    pub fn outside_ball(&self, centre: &Vector3<f64>, radius_m: f64) -> [Option<Self>; 2] {
        let d = self.to - self.from;
        let offset = self.from - centre;
        let (a, b) = (d.norm_squared(), d.dot(&offset));
        let c = offset.norm_squared() - radius_m * radius_m;
        let discriminant = b * b - a * c;
        if a == 0.0 || discriminant <= 0.0 {
            return [(c > 0.0).then_some(*self), None];
        }
        let root = discriminant.sqrt();
        let (enters, leaves) = ((-b - root) / a, (-b + root) / a);
        let part = |from: f64, to: f64| {
            (from < to).then(|| Self {
                from: self.at(from),
                to: self.at(to),
            })
        };
        if enters >= 1.0 || leaves <= 0.0 {
            return [Some(*self), None];
        }
        [part(0.0, enters), part(leaves, 1.0)]
    }

    /// Nearest points of the segment and a column; distance 0 if they meet.
    ///
    /// Along the segment the squared distance to the column is convex and piecewise quadratic;
    /// the pieces meet where the segment crosses one of the column's five planes. Its slope is
    /// piecewise linear and never falls, so the minimum is where the slope passes zero.
    pub fn closest_to_column(&self, column: &Column) -> Closest {
        let d = self.to - self.from;
        let mut breaks = [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        let mut count = 1;
        let mut add = |at: f64| {
            if at > 0.0 && at < 1.0 {
                breaks[count] = at;
                count += 1;
            }
        };
        for axis in 0..2 {
            if d[axis] != 0.0 {
                add((column.low_m[axis] - self.from[axis]) / d[axis]);
                add((column.high_m[axis] - self.from[axis]) / d[axis]);
            }
        }
        if d.z != 0.0 {
            add((column.top_m - self.from.z) / d.z);
        }
        breaks[1..count].sort_by(f64::total_cmp);
        let slope = |t: f64| column.excess(&self.at(t)).dot(&d);
        let (mut t0, mut slope0) = (0.0, slope(0.0));
        let mut nearest = if slope0 >= 0.0 { Some(0.0) } else { None };
        for &t1 in &breaks[1..=count] {
            if nearest.is_some() {
                break;
            }
            let slope1 = slope(t1);
            if slope1 >= 0.0 {
                nearest = Some(t0 + (t1 - t0) * (-slope0 / (slope1 - slope0)));
            }
            (t0, slope0) = (t1, slope1);
        }
        let on_first = self.at(nearest.unwrap_or(1.0));
        Closest::between(on_first, on_first - column.excess(&on_first))
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.from.inf(&self.to), self.from.sup(&self.to))
    }
}

impl Column {
    /// The vector from the column's nearest point to `point`, m: zero inside.
    pub fn excess(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let outside = |x: f64, low: f64, high: f64| x - x.clamp(low, high);
        Vector3::new(
            outside(point.x, self.low_m[0], self.high_m[0]),
            outside(point.y, self.low_m[1], self.high_m[1]),
            (point.z - self.top_m).max(0.0),
        )
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use proptest::prelude::*;

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-1.0..1.0f64).prop_map(Vector3::from)
    }
    fn segment() -> impl Strategy<Value = Segment> {
        (point(), point(), 0..4u8).prop_map(|(from, to, kind)| match kind {
            0 => Segment { from, to: from },
            1 => Segment {
                from,
                to: Vector3::new(to.x, from.y, from.z),
            },
            _ => Segment { from, to },
        })
    }

    /// The best of a fine grid of fractions: never below the true minimum, and above it by at
    /// most the distance between neighbours on the grid.
    const GRID: usize = 60;
    fn fractions() -> impl Iterator<Item = f64> {
        (0..=GRID).map(|i| i as f64 / GRID as f64)
    }
    fn spacing(s: &Segment) -> f64 {
        (s.to - s.from).norm() / GRID as f64
    }

    proptest! {
        #[test]
        fn segment_distance_agrees_with_brute_force(a in segment(), b in segment()) {
            let closest = a.closest_to_segment(&b);
            let brute = fractions()
                .flat_map(|s| fractions().map(move |t| (s, t)))
                .map(|(s, t)| (a.at(s) - b.at(t)).norm())
                .fold(f64::INFINITY, f64::min);
            prop_assert!(closest.distance_m <= brute + 1e-12);
            prop_assert!(closest.distance_m >= brute - spacing(&a) - spacing(&b));
            let swapped = b.closest_to_segment(&a);
            prop_assert!((closest.distance_m - swapped.distance_m).abs() < 1e-9);
        }

        #[test]
        fn parallel_segments_have_the_distance_of_their_lines(
            from in point(), d in point(), shift in point(), overlap in 0.0..1.0f64,
        ) {
            let across = shift.cross(&d);
            prop_assume!(d.norm() > 0.05 && across.norm() > 1e-3);
            let a = Segment { from, to: from + d };
            let b = Segment { from: from + d * overlap + across, to: from + d * 3.0 + across };
            prop_assert!((a.closest_to_segment(&b).distance_m - across.norm()).abs() < 1e-9);
        }

        #[test]
        fn column_distance_agrees_with_brute_force(
            s in segment(), corner in point(), size in prop::array::uniform2(0.01..0.8f64),
        ) {
            let column = Column {
                low_m: [corner.x, corner.y],
                high_m: [corner.x + size[0], corner.y + size[1]],
                top_m: corner.z,
            };
            let closest = s.closest_to_column(&column);
            let brute = fractions()
                .map(|t| column.excess(&s.at(t)).norm())
                .fold(f64::INFINITY, f64::min);
            prop_assert!(closest.distance_m <= brute + 1e-12);
            prop_assert!(closest.distance_m >= brute - spacing(&s));
            prop_assert!(column.excess(&closest.on_second).norm() < 1e-12);
        }
    }

    #[test]
    fn a_segment_through_a_column_touches_it() {
        let column = Column {
            low_m: [0.0, 0.0],
            high_m: [1.0, 1.0],
            top_m: 0.0,
        };
        let through = Segment {
            from: Vector3::new(-1.0, 0.5, -0.2),
            to: Vector3::new(2.0, 0.5, -0.1),
        };
        assert_eq!(through.closest_to_column(&column).distance_m, 0.0);
        let above = Segment {
            from: Vector3::new(0.5, 0.5, 0.3),
            to: Vector3::new(0.5, 0.5, 0.1),
        };
        let closest = above.closest_to_column(&column);
        assert!((closest.distance_m - 0.1).abs() < 1e-15);
        assert!((closest.on_second - Vector3::new(0.5, 0.5, 0.0)).norm() < 1e-15);
    }
}
