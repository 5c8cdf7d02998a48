//! The quickest speed along a path that its joints can follow, made smooth in time.
//!
//! With `q(s)` the path and `b = (ds/dt)^2`, rate and acceleration limits of joint `j` read
//! `q'_j^2 b <= v_j^2` and `|q'_j u + q''_j b| <= a_j` with `u = d2s/dt2`, and `b` changes by
//! `2 u ds`. Going backwards over a grid of `s`, each point gets the largest `b` from which the
//! next one's can still be reached; going forwards, `b` is made as large as that allows
//! (reachability analysis, Pham and Pham, "A New Approach to Time-Optimal Path Parameterization
//! Based on Reachability Analysis", 2018). The result changes its acceleration in steps; a moving
//! average over time turns the steps into ramps.

use super::spline::Path;

/// Limits of one joint.
#[derive(Clone, Copy)]
pub(crate) struct Bounds {
    pub rate: f64,
    pub acceleration: f64,
}

/// How the parameter of a path runs in time: pieces of constant acceleration, averaged over
/// `window` seconds.
pub(crate) struct Profile {
    times: Vec<f64>,
    places: Vec<f64>,
    speeds: Vec<f64>,
    /// Integral of the place over time, at `times`.
    areas: Vec<f64>,
    window: f64,
}

struct Node {
    slope: Vec<f64>,
    bend: Vec<f64>,
    /// Largest squared speed by the rates.
    ceiling: f64,
}

/// The interval of accelerations `u` that all joints allow at squared speed `b`.
fn accelerations(node: &Node, bounds: &[Bounds], b: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    for ((slope, bend), limit) in node.slope.iter().zip(&node.bend).zip(bounds) {
        let centre = -bend * b;
        if slope.abs() < 1e-12 {
            if centre.abs() > limit.acceleration {
                return (1.0, -1.0);
            }
            continue;
        }
        let (middle, half) = (centre / slope, limit.acceleration / slope.abs());
        low = low.max(middle - half);
        high = high.min(middle + half);
    }
    (low, high)
}

/// The largest squared speed at `node` from which `next` (or less) is reached after `ds`.
fn controllable(node: &Node, bounds: &[Bounds], next: f64, ds: f64) -> f64 {
    let is_possible = |b: f64| {
        let (low, high) = accelerations(node, bounds, b);
        let (low, high) = (low.max(-b / (2.0 * ds)), high.min((next - b) / (2.0 * ds)));
        low <= high
    };
    if is_possible(node.ceiling) {
        return node.ceiling;
    }
    // The set of possible b is convex and holds 0.
    let (mut inside, mut outside) = (0.0, node.ceiling);
    for _ in 0..60 {
        let middle = 0.5 * (inside + outside);
        if is_possible(middle) {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    inside
}

impl Profile {
    /// From rest to rest along `path` under `bounds` (one per joint), with `ds/dt` at most
    /// `ceiling(s)`, on a grid of at least `nodes` points, averaged over `window` seconds.
    pub fn new(
        path: &Path,
        bounds: &[Bounds],
        ceiling: impl Fn(f64) -> f64,
        nodes: usize,
        window: f64,
    ) -> Self {
        let grid = grid(path, nodes);
        let points: Vec<Node> = grid
            .iter()
            .map(|&s| {
                let place = path.at(s);
                let mut largest = ceiling(s);
                for (slope, limit) in place.slope.iter().zip(bounds) {
                    largest = largest.min(limit.rate / slope.abs());
                }
                Node {
                    slope: place.slope,
                    bend: place.bend,
                    ceiling: largest * largest,
                }
            })
            .collect();
        let count = grid.len();
        let mut square = vec![0.0; count];
        for i in (1..count - 1).rev() {
            let ds = grid[i + 1] - grid[i];
            square[i] = controllable(&points[i], bounds, square[i + 1], ds);
        }
        for i in 0..count - 1 {
            let ds = grid[i + 1] - grid[i];
            let (_, high) = accelerations(&points[i], bounds, square[i]);
            square[i + 1] = (square[i] + 2.0 * ds * high).clamp(0.0, square[i + 1]);
        }
        Self::timed(grid, &square, window)
    }

    fn timed(grid: Vec<f64>, square: &[f64], window: f64) -> Self {
        let speeds: Vec<f64> = square.iter().map(|b| b.sqrt()).collect();
        let (mut times, mut areas) = (vec![0.0], vec![0.0]);
        let (mut time, mut area) = (0.0, 0.0);
        for i in 0..grid.len() - 1 {
            let ds = grid[i + 1] - grid[i];
            let dt = 2.0 * ds / (speeds[i] + speeds[i + 1]);
            let acceleration = (speeds[i + 1] - speeds[i]) / dt;
            area += dt * (grid[i] + dt * (0.5 * speeds[i] + dt * acceleration / 6.0));
            time += dt;
            times.push(time);
            areas.push(area);
        }
        Self {
            times,
            places: grid,
            speeds,
            areas,
            window,
        }
    }

    /// Seconds from rest to rest.
    pub fn duration(&self) -> f64 {
        self.times[self.times.len() - 1] + self.window
    }

    /// Parameter and its integral over time, before averaging.
    fn raw(&self, t: f64) -> (f64, f64) {
        let last = self.times.len() - 1;
        if t <= 0.0 {
            return (self.places[0], self.places[0] * t);
        }
        if t >= self.times[last] {
            let rest = self.places[last];
            return (rest, self.areas[last] + rest * (t - self.times[last]));
        }
        let i = self.times.partition_point(|x| *x <= t) - 1;
        let dt = self.times[i + 1] - self.times[i];
        let acceleration = (self.speeds[i + 1] - self.speeds[i]) / dt;
        let x = t - self.times[i];
        let place = self.places[i] + x * (self.speeds[i] + 0.5 * x * acceleration);
        let area = self.areas[i]
            + x * (self.places[i] + x * (0.5 * self.speeds[i] + x * acceleration / 6.0));
        (place, area)
    }

    /// Parameter and speed `ds/dt` at `t` seconds.
    pub fn at(&self, t: f64) -> (f64, f64) {
        let (now, area_now) = self.raw(t);
        let (then, area_then) = self.raw(t - self.window);
        (
            (area_now - area_then) / self.window,
            (now - then) / self.window,
        )
    }
}

/// The way-points' parameters and evenly spaced ones between them; `nodes` or more in all.
fn grid(path: &Path, nodes: usize) -> Vec<f64> {
    let knots = path.knots();
    let step = path.length() / nodes as f64;
    let mut grid = vec![knots[0]];
    for pair in knots.windows(2) {
        let width = pair[1] - pair[0];
        let parts = (width / step).ceil().max(2.0);
        for k in 1..parts as usize {
            grid.push(pair[0] + width * k as f64 / parts);
        }
        grid.push(pair[1]);
    }
    grid
}
