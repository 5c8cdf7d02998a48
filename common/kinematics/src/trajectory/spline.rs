//! A smooth path through joint-space points: natural cubic splines over the chord length.

/// A path of `n` joints, twice continuously differentiable in its parameter.
pub(crate) struct Path {
    /// Parameter at the way-points, from 0.
    knots: Vec<f64>,
    /// Way-points.
    points: Vec<Vec<f64>>,
    /// Second derivatives at the way-points.
    bends: Vec<Vec<f64>>,
}

/// Position and its first two derivatives with respect to the parameter, per joint.
pub(crate) struct Place {
    pub q: Vec<f64>,
    pub slope: Vec<f64>,
    pub bend: Vec<f64>,
}

/// Euclidean distance in joint space, radians.
pub(crate) fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b) * (a - b))
        .sum::<f64>()
        .sqrt()
}

impl Path {
    /// The path through at least two points, no two neighbours of which coincide.
    pub fn new(points: &[Vec<f64>]) -> Self {
        let mut knots = vec![0.0];
        let mut length = 0.0;
        for pair in points.windows(2) {
            length += distance(&pair[0], &pair[1]);
            knots.push(length);
        }
        let bends = natural_bends(&knots, points);
        Self {
            knots,
            points: points.to_vec(),
            bends,
        }
    }

    /// Largest parameter.
    pub fn length(&self) -> f64 {
        self.knots[self.knots.len() - 1]
    }

    /// Parameters of the way-points.
    pub fn knots(&self) -> &[f64] {
        &self.knots
    }

    /// The path at parameter `s`, clamped to its ends.
    pub fn at(&self, s: f64) -> Place {
        let last = self.knots.len() - 2;
        let segment = self
            .knots
            .partition_point(|k| *k <= s)
            .saturating_sub(1)
            .min(last);
        let h = self.knots[segment + 1] - self.knots[segment];
        let b = ((s - self.knots[segment]) / h).clamp(0.0, 1.0);
        let a = 1.0 - b;
        let n = self.points[0].len();
        let mut place = Place {
            q: vec![0.0; n],
            slope: vec![0.0; n],
            bend: vec![0.0; n],
        };
        for j in 0..n {
            let (p, q) = (self.points[segment][j], self.points[segment + 1][j]);
            let (m, k) = (self.bends[segment][j], self.bends[segment + 1][j]);
            place.q[j] =
                a * p + b * q + (a * (a * a - 1.0) * m + b * (b * b - 1.0) * k) * h * h / 6.0;
            place.slope[j] =
                (q - p) / h + ((3.0 * b * b - 1.0) * k - (3.0 * a * a - 1.0) * m) * h / 6.0;
            place.bend[j] = a * m + b * k;
        }
        place
    }

    /// Largest distance (radians) of segment `segment` from its chord, and how far any joint
    /// leaves `[lower, upper]` in it.
    pub fn excursion(&self, segment: usize, limits: impl Fn(usize) -> (f64, f64)) -> (f64, f64) {
        let (start, end) = (self.knots[segment], self.knots[segment + 1]);
        let (mut off, mut out): (f64, f64) = (0.0, 0.0);
        for i in 1..8 {
            let b = f64::from(i) / 8.0;
            let place = self.at(start + b * (end - start));
            let mut square = 0.0;
            for (j, q) in place.q.iter().enumerate() {
                let chord = (1.0 - b) * self.points[segment][j] + b * self.points[segment + 1][j];
                square += (q - chord) * (q - chord);
                let (lower, upper) = limits(j);
                out = out.max(lower - q).max(q - upper);
            }
            off = off.max(square.sqrt());
        }
        (off, out)
    }
}

/// Second derivatives of the natural spline: tridiagonal system, solved for all joints at once.
fn natural_bends(knots: &[f64], points: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let count = points.len();
    let n = points[0].len();
    let mut bends = vec![vec![0.0; n]; count];
    let mut factor = vec![0.0; count];
    for i in 1..count - 1 {
        let (before, after) = (knots[i] - knots[i - 1], knots[i + 1] - knots[i]);
        let pivot = 2.0 * (before + after) - before * factor[i - 1];
        factor[i] = after / pivot;
        for j in 0..n {
            let kink = (points[i + 1][j] - points[i][j]) / after
                - (points[i][j] - points[i - 1][j]) / before;
            bends[i][j] = (6.0 * kink - before * bends[i - 1][j]) / pivot;
        }
    }
    for i in (1..count - 1).rev() {
        let (head, tail) = bends.split_at_mut(i + 1);
        for (bend, next) in head[i].iter_mut().zip(&tail[0]) {
            *bend -= factor[i] * next;
        }
    }
    bends
}
