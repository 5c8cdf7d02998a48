//! The facets of a mesh by place, and normals averaged over the instrument's footprint.

use nalgebra::Vector3;
use rover_render::Mesh;

/// Most columns and rows of the index.
const MOST_CELLS: f64 = 512.0;

/// The facets of a mesh in the cells of a grid over x and y; a facet is in every cell that its
/// bounding box touches.
#[derive(Clone, Debug)]
pub(crate) struct Facets {
    low: [f64; 2],
    cell_m: [f64; 2],
    size: [usize; 2],
    /// Where each cell's facets begin in `facets`, row by row, and where the last one's end.
    starts: Vec<u32>,
    facets: Vec<u32>,
}

impl Facets {
    /// Sorts a mesh's facets; about one to a cell.
    pub fn of(mesh: &Mesh) -> Self {
        let first = mesh.positions.first().copied().unwrap_or_default();
        let (low, high) = mesh
            .positions
            .iter()
            .fold((first, first), |(l, h), p| (l.inf(p), h.sup(p)));
        let side = (mesh.triangles.len() as f64).sqrt().ceil();
        let cells = side.clamp(1.0, MOST_CELLS);
        let cell_m = [0, 1].map(|k| ((high[k] - low[k]) / cells).max(1e-9));
        let mut index = Self {
            low: [low.x, low.y],
            cell_m,
            size: [cells as usize; 2],
            starts: vec![0; cells as usize * cells as usize + 1],
            facets: Vec::new(),
        };
        let boxes: Vec<_> = mesh
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
                index.cells(&a.inf(&b).inf(&c), &a.sup(&b).sup(&c))
            })
            .collect();
        let columns = index.size[0];
        for cell in boxes.iter().flat_map(|b| numbers(b, columns)) {
            index.starts[cell + 1] += 1;
        }
        for cell in 1..index.starts.len() {
            index.starts[cell] += index.starts[cell - 1];
        }
        let mut next = index.starts.clone();
        index.facets = vec![0; index.starts[index.starts.len() - 1] as usize];
        for (facet, b) in boxes.iter().enumerate() {
            for cell in numbers(b, columns) {
                index.facets[next[cell] as usize] = facet as u32;
                next[cell] += 1;
            }
        }
        index
    }

    /// First and last column and row that a box touches.
    fn cells(&self, low: &Vector3<f64>, high: &Vector3<f64>) -> [[usize; 2]; 2] {
        [0, 1].map(|k| {
            let at = |x: f64| ((x - self.low[k]) / self.cell_m[k]).max(0.0) as usize;
            [low[k], high[k]].map(|x| at(x).min(self.size[k] - 1))
        })
    }

    /// The facets that may be within `radius_m` of a point, in ascending order.
    pub fn about(&self, centre: &Vector3<f64>, radius_m: f64) -> Vec<u32> {
        let reach = Vector3::repeat(radius_m);
        let cells = self.cells(&(centre - reach), &(centre + reach));
        let mut found: Vec<u32> = numbers(&cells, self.size[0])
            .flat_map(|cell| {
                let [start, end] = [cell, cell + 1].map(|c| self.starts[c] as usize);
                self.facets[start..end].iter().copied()
            })
            .collect();
        found.sort_unstable();
        found.dedup();
        found
    }

    /// Mean normal of the mesh within `radius_m` of a point, by area; not of unit length.
    pub fn mean_normal(&self, mesh: &Mesh, centre: &Vector3<f64>, radius_m: f64) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for facet in self.about(centre, radius_m) {
            let corners = mesh.triangles[facet as usize].map(|i| mesh.positions[i as usize]);
            sum += normal_within(&corners, centre, radius_m);
        }
        sum
    }
}

/// The numbers of the cells from a first to a last column and row.
fn numbers(cells: &[[usize; 2]; 2], columns: usize) -> impl Iterator<Item = usize> + use<> {
    let [[u0, u1], [v0, v1]] = *cells;
    (v0..=v1).flat_map(move |v| (u0..=u1).map(move |u| v * columns + u))
}

/// The normal of a facet times the part of it, in parts of equal size, that lies within `radius_m`
/// of a point.
fn normal_within(
    [a, b, c]: &[Vector3<f64>; 3],
    centre: &Vector3<f64>,
    radius_m: f64,
) -> Vector3<f64> {
    // The facet is divided into n^2 smaller ones; those inside count.
    const PARTS: u32 = 8;
    let mut sum = Vector3::zeros();
    let apart = |k: usize| {
        a[k].max(b[k]).max(c[k]) < centre[k] - radius_m
            || a[k].min(b[k]).min(c[k]) > centre[k] + radius_m
    };
    if (0..3).any(apart) {
        return sum;
    }
    let normal = (b - a).cross(&(c - a));
    let part = 1.0 / f64::from(PARTS);
    for i in 0..PARTS {
        for j in 0..(2 * (PARTS - i) - 1) {
            // Odd ones stand on their point.
            let third = if j % 2 == 0 { 1.0 / 3.0 } else { 2.0 / 3.0 };
            let u = (f64::from(i) + third) * part;
            let v = (f64::from(j / 2) + third) * part;
            let p = a + (b - a) * u + (c - a) * v;
            if (p - centre).norm() <= radius_m {
                sum += normal;
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use rover_render::shapes;

    #[test]
    fn the_index_misses_no_facet_about_a_point() {
        let waves = |x: f64, y: f64| 0.3 * (3.0 * x).sin() * (2.0 * y).cos();
        let lines = |n: i32| {
            (0..n)
                .map(|i| 0.07 * f64::from(i) - 1.0)
                .collect::<Vec<_>>()
        };
        for mesh in [
            shapes::heightfield_mesh(&lines(31), &lines(23), waves),
            shapes::rock(5, 0.2, 3, 0.2),
        ] {
            let index = Facets::of(&mesh);
            for (centre, radius_m) in [
                (Vector3::new(0.1, -0.2, 0.05), 0.05),
                (Vector3::new(-1.0, -1.0, 0.0), 0.2),
                (Vector3::new(5.0, 5.0, 0.0), 0.1),
                (Vector3::new(0.0, 0.0, 0.0), 10.0),
            ] {
                let near = |t: &[u32; 3]| {
                    let corners = t.map(|i| mesh.positions[i as usize]);
                    normal_within(&corners, &centre, radius_m).norm() > 0.0
                };
                let every = (0..).zip(&mesh.triangles);
                let needed: Vec<u32> = every.filter(|(_, t)| near(t)).map(|(i, _)| i).collect();
                let found = index.about(&centre, radius_m);
                assert!(
                    needed.iter().all(|i| found.contains(i)),
                    "{centre} {radius_m}"
                );
                assert!(found.is_sorted());
            }
        }
    }

    #[test]
    fn the_mean_normal_of_a_dome_is_the_normal_at_its_place() {
        let dome = |x: f64, y: f64| -(x * x + y * y);
        let lines: Vec<f64> = (0..=200).map(|i| 0.01 * f64::from(i) - 1.0).collect();
        let mesh = shapes::heightfield_mesh(&lines, &lines, dome);
        let index = Facets::of(&mesh);
        for (x, y) in [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.25)] {
            let place = Vector3::new(x, y, dome(x, y));
            let expected = Vector3::new(2.0 * x, 2.0 * y, 1.0);
            let normal = index.mean_normal(&mesh, &place, 0.05);
            let apart = normal.angle(&expected);
            assert!(apart < 0.01, "{x} {y}: {apart}");
        }
    }
}
