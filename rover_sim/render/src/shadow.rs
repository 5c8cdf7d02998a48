//! Who stands in the sun: the scene in the *sun frame* (z towards the sun), where a shadow ray is
//! a point and a box a rectangle.

use crate::geometry::Geometry;
use crate::simd::{Lanes, Simd};
use nalgebra::Isometry3;

/// A triangle that faces the sun, with the barycentric weights of its second and third corner as
/// linear functions of the position relative to the first.
#[derive(Clone, Copy)]
struct Blocker {
    corner: [f32; 3],
    second: [f32; 2],
    third: [f32; 2],
    /// Rise from the first corner to the second and to the third.
    rise: [f32; 2],
    low: [f32; 2],
    high: [f32; 2],
    top: f32,
}

/// A node of the tree: its rectangle and highest point; children `first` and `first + 1`, or
/// `count` blockers from `first`.
#[derive(Clone, Copy)]
struct Node {
    low: [f32; 2],
    high: [f32; 2],
    top: f32,
    first: u32,
    count: u32,
}

/// A box in the sun frame, open at the top.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SunBox {
    pub low: [f32; 2],
    pub high: [f32; 2],
    pub bottom: f32,
}

impl Default for SunBox {
    fn default() -> Self {
        Self::EMPTY
    }
}

impl SunBox {
    pub(crate) const EMPTY: Self = Self {
        low: [f32::MAX; 2],
        high: [f32::MIN; 2],
        bottom: f32::MAX,
    };

    /// Grows to hold the box of half size `margin` around `p`.
    #[inline]
    pub(crate) fn add(&mut self, p: [f32; 3], margin: f32) {
        for k in 0..2 {
            self.low[k] = self.low[k].min(p[k] - margin);
            self.high[k] = self.high[k].max(p[k] + margin);
        }
        self.bottom = self.bottom.min(p[2] - margin);
    }
}

/// A tree over all triangles of some bodies that face the sun.
#[derive(Default)]
pub(crate) struct SunTree {
    nodes: Vec<Node>,
    blockers: Vec<Blocker>,
}

/// A blocker counts if it is at least this far above a point, metres.
const CLEARANCE_M: f32 = 1.5e-4;
/// Blockers overlap by this fraction of their size against light through the seams.
const SEAM: f32 = 1e-4;
const LEAF: usize = 4;
/// Most nodes at which a search begins.
const ENTRIES: usize = 16;
/// Room for a search: its beginning, and at most 32 levels, as the median split halves the count.
const DEPTH: usize = ENTRIES + 34;

impl SunTree {
    /// `sun_from_body(b)` is `None` for a body that is not there.
    pub(crate) fn new(
        geometry: &Geometry,
        sun_from_body: impl Fn(usize) -> Option<Isometry3<f64>>,
    ) -> Self {
        let mut blockers = Vec::new();
        let mut vertices = vec![[0.0_f32; 3]; geometry.positions.len()];
        for (index, body) in geometry.bodies.iter().enumerate() {
            let Some(pose) = sun_from_body(index) else {
                continue;
            };
            let (rotation, shift) = (
                *pose.rotation.to_rotation_matrix().matrix(),
                pose.translation.vector,
            );
            for v in body.vertices.clone() {
                let p = rotation * geometry.positions[v] + shift;
                vertices[v] = [p.x as f32, p.y as f32, p.z as f32];
            }
            for t in body.triangles.clone() {
                let [a, b, c] = geometry.triangles[t].map(|i| vertices[i as usize]);
                blockers.extend(blocker(a, b, c, body.two_sided));
            }
        }
        let mut tree = Self {
            nodes: Vec::new(),
            blockers,
        };
        if !tree.blockers.is_empty() {
            tree.nodes.reserve(tree.blockers.len());
            tree.nodes.push(Node {
                low: [0.0; 2],
                high: [0.0; 2],
                top: 0.0,
                first: 0,
                count: 0,
            });
            tree.split(0, 0, tree.blockers.len());
        }
        tree
    }

    /// Fills `node` with the blockers `first..last`, halving them along the longer side.
    fn split(&mut self, node: usize, first: usize, last: usize) {
        let mut low = [f32::MAX; 2];
        let mut high = [f32::MIN; 2];
        let mut top = f32::MIN;
        for b in &self.blockers[first..last] {
            for k in 0..2 {
                low[k] = low[k].min(b.low[k]);
                high[k] = high[k].max(b.high[k]);
            }
            top = top.max(b.top);
        }
        let mut this = Node {
            low,
            high,
            top,
            first: first as u32,
            count: (last - first) as u32,
        };
        if last - first > LEAF {
            let axis = usize::from(high[1] - low[1] > high[0] - low[0]);
            let middle = (last - first) / 2;
            self.blockers[first..last].select_nth_unstable_by(middle, |a, b| {
                (a.low[axis] + a.high[axis]).total_cmp(&(b.low[axis] + b.high[axis]))
            });
            let children = self.nodes.len();
            self.nodes.extend([this, this]);
            self.split(children, first, first + middle);
            self.split(children + 1, first + middle, last);
            this.first = children as u32;
            this.count = 0;
        }
        self.nodes[node] = this;
    }

    /// The nodes at which to begin for points within a box: all that may shade it, as deep in the
    /// tree as a short list allows. Empty if nothing can shade the box.
    pub(crate) fn entries(&self, target: &SunBox, out: &mut Vec<u32>) {
        out.clear();
        let meets = |index: u32| {
            let n = &self.nodes[index as usize];
            n.top > target.bottom
                && (0..2).all(|k| n.high[k] >= target.low[k] && n.low[k] <= target.high[k])
        };
        if !self.nodes.is_empty() && meets(0) {
            out.push(0);
        }
        // each round replaces the inner nodes by those of their children that meet the box
        let mut expanded = true;
        while expanded && out.len() <= ENTRIES / 2 {
            expanded = false;
            for i in (0..out.len()).rev() {
                let n = &self.nodes[out[i] as usize];
                if n.count == 0 {
                    expanded = true;
                    out.swap_remove(i);
                    out.extend([n.first, n.first + 1].into_iter().filter(|&c| meets(c)));
                }
            }
        }
    }

    /// Whether anything may cast its shadow into a box.
    pub(crate) fn may_shade(&self, target: &SunBox) -> bool {
        let mut stack = Vec::new();
        self.entries(target, &mut stack);
        while let Some(index) = stack.pop() {
            let n = &self.nodes[index as usize];
            let apart = n.top <= target.bottom
                || (0..2).any(|k| n.high[k] < target.low[k] || n.low[k] > target.high[k]);
            if apart {
                continue;
            }
            if n.count == 0 {
                stack.extend([n.first, n.first + 1]);
                continue;
            }
            let leaf = &self.blockers[n.first as usize..(n.first + n.count) as usize];
            if leaf.iter().any(|b| {
                b.top > target.bottom
                    && (0..2).all(|k| b.high[k] >= target.low[k] && b.low[k] <= target.high[k])
            }) {
                return true;
            }
        }
        false
    }

    /// Which of the `active` ones of eight points (sun frame) lie in shadow, one bit each. The
    /// points lie in the box for which `entries` were found.
    #[inline(always)]
    pub(crate) fn shaded<S: Simd>(&self, p: &[Lanes; 3], active: u32, entries: &[u32]) -> u32 {
        let mut hits = 0;
        if entries.is_empty() || active == 0 {
            return 0;
        }
        let (x, y) = (S::load(&p[0]), S::load(&p[1]));
        let z = S::load(&p[2]) + S::splat(CLEARANCE_M);
        let mut stack = [0_u32; DEPTH];
        let mut depth = entries.len();
        stack[..depth].copy_from_slice(entries);
        while depth > 0 {
            depth -= 1;
            let n = &self.nodes[stack[depth] as usize];
            let within = S::and(
                S::and(S::ge(x, S::splat(n.low[0])), S::ge(S::splat(n.high[0]), x)),
                S::and(S::ge(y, S::splat(n.low[1])), S::ge(S::splat(n.high[1]), y)),
            );
            if S::bits(S::and(within, S::gt(S::splat(n.top), z))) & active & !hits == 0 {
                continue;
            }
            if n.count == 0 {
                stack[depth] = n.first;
                stack[depth + 1] = n.first + 1;
                depth += 2;
                continue;
            }
            for b in &self.blockers[n.first as usize..(n.first + n.count) as usize] {
                let (dx, dy) = (x - S::splat(b.corner[0]), y - S::splat(b.corner[1]));
                let u = S::splat(b.second[0]) * dx + S::splat(b.second[1]) * dy;
                let v = S::splat(b.third[0]) * dx + S::splat(b.third[1]) * dy;
                let above =
                    S::splat(b.corner[2]) + u * S::splat(b.rise[0]) + v * S::splat(b.rise[1]);
                let edge = S::splat(-SEAM);
                let inside = S::and(
                    S::and(S::ge(u, edge), S::ge(v, edge)),
                    S::ge(S::splat(1.0 + SEAM), u + v),
                );
                hits |= S::bits(S::and(inside, S::gt(above, z)));
            }
            if hits & active == active {
                break;
            }
        }
        hits & active
    }
}

/// `None` if the triangle does not face the sun.
fn blocker(a: [f32; 3], b: [f32; 3], c: [f32; 3], two_sided: bool) -> Option<Blocker> {
    let (ab, ac) = ([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
    let area = ab[0] * ac[1] - ab[1] * ac[0];
    if !(area > 1e-13 || (two_sided && area < -1e-13)) {
        return None;
    }
    let mut low = [0.0; 2];
    let mut high = [0.0; 2];
    for k in 0..2 {
        let seam = SEAM * (ab[k].abs() + ac[k].abs());
        low[k] = a[k].min(b[k]).min(c[k]) - seam;
        high[k] = a[k].max(b[k]).max(c[k]) + seam;
    }
    let rise = [b[2] - a[2], c[2] - a[2]];
    Some(Blocker {
        corner: a,
        second: [ac[1] / area, -ac[0] / area],
        third: [-ab[1] / area, ab[0] / area],
        rise,
        low,
        high,
        top: a[2].max(b[2]).max(c[2]) + SEAM * (rise[0].abs() + rise[1].abs()),
    })
}
