//! Means, quantiles and straight lines.

/// Arithmetic mean; NaN for nothing.
pub fn mean(x: &[f64]) -> f64 {
    x.iter().sum::<f64>() / x.len() as f64
}

/// The value that a share `p` of `x` does not exceed (nearest rank); orders `x`. Values that are
/// not numbers count as larger than any; NaN for nothing.
pub fn quantile(x: &mut [f64], p: f64) -> f64 {
    if x.is_empty() {
        return f64::NAN;
    }
    let rank = (p * x.len() as f64).ceil() as usize;
    let at = rank.clamp(1, x.len()) - 1;
    // In the total order this NaN, which is positive, comes last.
    for value in x.iter_mut().filter(|v| v.is_nan()) {
        *value = f64::NAN;
    }
    let (_, value, _) = x.select_nth_unstable_by(at, f64::total_cmp);
    *value
}

/// The straight line of least squares through points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Rise per unit of x.
    pub slope: f64,
    /// Value at x = 0.
    pub intercept: f64,
    /// Share of the variance of y that the line explains.
    pub r2: f64,
}

impl Line {
    /// The line through at least three points of differing x, else none.
    pub fn fit(points: &[(f64, f64)]) -> Option<Self> {
        let n = points.len() as f64;
        let (mx, my) = (
            points.iter().map(|p| p.0).sum::<f64>() / n,
            points.iter().map(|p| p.1).sum::<f64>() / n,
        );
        let sum =
            |f: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| f(p.0 - mx, p.1 - my)).sum::<f64>();
        let (xx, xy, yy) = (sum(&|x, _| x * x), sum(&|x, y| x * y), sum(&|_, y| y * y));
        if points.len() < 3 || xx.is_nan() || xx <= 0.0 {
            return None;
        }
        let slope = xy / xx;
        let r2 = if yy > 0.0 { slope * xy / yy } else { 1.0 };
        Some(Self {
            slope,
            intercept: my - slope * mx,
            r2,
        })
    }

    /// The line's value.
    pub fn at(&self, x: f64) -> f64 {
        self.intercept + self.slope * x
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn quantiles_take_the_nearest_rank_and_count_failures_as_largest() {
        let mut x = [3.0, f64::NAN, 1.0, 2.0];
        assert_eq!(quantile(&mut x, 0.5), 2.0);
        assert_eq!(quantile(&mut x, 0.25), 1.0);
        assert!(quantile(&mut x, 0.95).is_nan());
        assert!(quantile(&mut [], 0.5).is_nan());
    }

    #[test]
    fn a_line_is_found_again() {
        let points: Vec<_> = (0..9)
            .map(|i| (f64::from(i), 2.0 + 0.5 * f64::from(i)))
            .collect();
        let line = Line::fit(&points).unwrap();
        assert!((line.slope - 0.5).abs() < 1e-12 && (line.intercept - 2.0).abs() < 1e-12);
        assert!((line.r2 - 1.0).abs() < 1e-12 && (line.at(4.0) - 4.0).abs() < 1e-12);
        assert!(Line::fit(&[(1.0, 1.0), (1.0, 2.0), (1.0, 3.0)]).is_none());
    }
}
