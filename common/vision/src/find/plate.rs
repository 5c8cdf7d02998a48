//! The pose fiducial, near a prediction or anywhere in the image.
//!
//! Without a prediction the dark regions of the image that are elliptic are taken for discs. The
//! shape of one and the direction to a neighbour of the same shape fix an affine map for every
//! matching pair of the layout; the map that explains most regions, refined to a homography, gives
//! the pose from which the plate is then measured as usual.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use nalgebra::{Isometry3, Matrix2, SMatrix, SVector, Vector2, Vector3};
use rover_cameras::Camera;

use super::blobs::{Blob, BlobRules, blobs};
use super::homography::plane_pose;
use super::{Finding, FoundPose, NoFinding};
use crate::fiducial::{
    DetectionRules, NotFound, PlateSearch, Sighting, estimate_plate_pose_single, find_plate,
    solve_pose,
};
use crate::image::Image8;
use crate::ncc::Window;
use crate::plate::PlateLayout;

/// Finds the plate and its pose. `prediction` is the expected pose (camera model's frame from
/// plate) and how far its centre may be from there, px; without it the whole image is searched.
///
/// `u_px`, `v_px` is the image of the plate's origin.
///
/// # Errors
/// [`NoFinding`], most often [`NoFinding::Plate`] with the search's own reason.
pub fn plate(
    image: &Image8,
    camera: &Camera,
    layout: &PlateLayout,
    prediction: Option<(&Isometry3<f64>, f64)>,
    rules: &DetectionRules,
) -> Result<Finding, NoFinding> {
    if let Some((pose, radius_px)) = prediction {
        return measure(image, camera, layout, pose, radius_px, rules);
    }
    image.validate()?;
    layout
        .validate()
        .map_err(|e| NoFinding::BadInput(e.to_string()))?;
    rules.validate().map_err(NoFinding::BadInput)?;
    if layout.discs.len() < MIN_MATCHES {
        return Err(NoFinding::BadInput(format!(
            "the layout has {} discs; a search without a predicted pose needs {MIN_MATCHES}",
            layout.discs.len()
        )));
    }
    let discs = elliptic_regions(image, rules);
    let mut refusal = None;
    for pose in hypotheses(&discs, camera, layout) {
        match measure(image, camera, layout, &pose, FOUND_RADIUS_PX, rules) {
            Ok(found) => return Ok(found),
            Err(e) => {
                refusal.get_or_insert(e);
            }
        }
    }
    Err(refusal.unwrap_or_else(|| {
        NoFinding::NothingThere(format!(
            "{} elliptic dark regions, no {MIN_MATCHES} of them lie as on the plate",
            discs.len()
        ))
    }))
}

/// How far a plate found by its discs may be from there, px.
const FOUND_RADIUS_PX: f64 = 4.0;
/// Discs that have to be where a hypothesis puts them.
const MIN_MATCHES: usize = 7;
/// Regions that are considered, the most elliptic first.
const MAX_REGIONS: usize = 160;
/// Neighbours of a region, and of a layout disc, that are tried.
const NEIGHBOURS: usize = 5;
/// Hypotheses that are measured.
const MAX_MEASURED: usize = 3;
/// Hypotheses whose pose is worked out, those with the most matches.
const SETTLED: usize = 4 * MAX_MEASURED;

fn measure(
    image: &Image8,
    camera: &Camera,
    layout: &PlateLayout,
    pose: &Isometry3<f64>,
    radius_px: f64,
    rules: &DetectionRules,
) -> Result<Finding, NoFinding> {
    let search = PlateSearch {
        camera,
        layout,
        predicted_camera_frame_from_plate: *pose,
        search_radius_px: radius_px,
        rules,
    };
    let seen = find_plate(image, &search)?;
    let found = estimate_plate_pose_single(camera, layout, &seen, pose)?;
    let pose = found.rover_from_plate;
    let at = camera
        .project_with_jacobian(&pose.translation.vector)
        .map_err(|e| NoFinding::Plate(NotFound::NotVisible(e.to_string())))?;
    let place = found.covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let spread = at.jacobian * place * at.jacobian.transpose();
    Ok(Finding {
        u_px: at.pixel_px.x,
        v_px: at.pixel_px.y,
        score: seen.score,
        sigma_px: (0.5 * spread.trace()).max(0.0).sqrt(),
        id: None,
        pose: Some(FoundPose {
            camera_frame_from_fiducial: pose,
            covariance: found.covariance,
            rms_px: found.rms_px,
        }),
    })
}

/// A region that may be a disc: S^(1/2) takes the unit circle to its outline.
struct Region {
    centre: Vector2<f64>,
    root: Matrix2<f64>,
    inverse: Matrix2<f64>,
    short_px: f64,
    area: f64,
}

fn elliptic_regions(image: &Image8, rules: &DetectionRules) -> Vec<Region> {
    let least = std::f64::consts::PI * rules.min_mark_radius_px * rules.min_mark_radius_px;
    let regions = BlobRules {
        dark: true,
        min_contrast_dn: rules.min_contrast_dn.clamp(1.0, 255.0) as u8,
        area: (0.6 * least, 0.02 * image.pixels.len() as f64),
    };
    let mut all: Vec<(f64, Blob, f64)> = blobs(image, Window::whole(image), &regions)
        .into_iter()
        .filter_map(|blob| {
            let (short, long) = blob.semi_axes()?;
            let error = (blob.fill() - 1.0).abs() - 0.35 / short.max(0.1);
            let fits = short >= 0.8 * rules.min_mark_radius_px && short >= 0.15 * long;
            (fits && error <= 0.06).then_some((error, blob, short))
        })
        .collect();
    all.sort_by(|a, b| {
        a.0.total_cmp(&b.0)
            .then(a.1.centre[1].total_cmp(&b.1.centre[1]))
            .then(a.1.centre[0].total_cmp(&b.1.centre[0]))
    });
    all.truncate(MAX_REGIONS);
    all.into_iter()
        .filter_map(|(_, blob, short_px)| {
            let [a, b, c] = blob.shape();
            let s = (a * c - b * b).max(0.0).sqrt();
            let t = (a + c + 2.0 * s).sqrt();
            let root = Matrix2::new(a + s, b, b, c + s) / t;
            Some(Region {
                centre: Vector2::new(blob.centre[0], blob.centre[1]),
                root,
                inverse: root.try_inverse()?,
                short_px,
                area: blob.area,
            })
        })
        .collect()
}

/// Regions by cells of the image, for looking up what lies at a place: a cell lists the regions
/// that reach into it.
struct Cells<'a> {
    regions: &'a [Region],
    columns: usize,
    rows: usize,
    /// Where the list of each cell begins in `listed`, and where the last one ends.
    starts: Vec<usize>,
    listed: Vec<usize>,
}

const CELL_PX: f64 = 16.0;
/// Farthest that a region is looked up from its centre, in its own short radii.
const REACH: f64 = 1.2;

impl<'a> Cells<'a> {
    fn new(regions: &'a [Region]) -> Self {
        let extent = regions.iter().fold(Vector2::zeros(), |e: Vector2<f64>, r| {
            e.sup(&(r.centre + Vector2::repeat(REACH * r.short_px)))
        });
        let count = |x: f64| (x / CELL_PX).floor() as usize + 1;
        let (columns, rows) = (count(extent.x), count(extent.y));
        let mut lists = vec![Vec::new(); columns * rows];
        for (k, r) in regions.iter().enumerate() {
            let range = |x: f64| {
                let cell = |x: f64| (x / CELL_PX).floor().max(0.0) as usize;
                cell(x - REACH * r.short_px)..=cell(x + REACH * r.short_px)
            };
            for j in range(r.centre.y) {
                for i in range(r.centre.x) {
                    lists[j * columns + i].push(k);
                }
            }
        }
        let mut starts = Vec::with_capacity(lists.len() + 1);
        let mut listed = Vec::new();
        for list in lists {
            starts.push(listed.len());
            listed.extend(list);
        }
        starts.push(listed.len());
        Self {
            regions,
            columns,
            rows,
            starts,
            listed,
        }
    }

    /// The region closest to a place, within its own short radius times `reach`, which is at most
    /// [`REACH`].
    fn at(&self, p: &Vector2<f64>, reach: f64) -> Option<usize> {
        let (x, y) = (p.x / CELL_PX, p.y / CELL_PX);
        if !(x >= 0.0 && y >= 0.0 && x < self.columns as f64 && y < self.rows as f64) {
            return None;
        }
        let cell = y as usize * self.columns + x as usize;
        let mut best: Option<(f64, usize)> = None;
        for &k in &self.listed[self.starts[cell]..self.starts[cell + 1]] {
            let r = &self.regions[k];
            let distance = (r.centre - p).norm() / r.short_px;
            if distance <= reach && best.is_none_or(|(d, _)| distance < d) {
                best = Some((distance, k));
            }
        }
        best.map(|(_, k)| k)
    }
}

/// The `count` places nearest to each place, nearest first.
fn nearest(places: &[Vector2<f64>], count: usize) -> Vec<Vec<usize>> {
    let mut all = Vec::with_capacity(places.len());
    let mut near: Vec<(f64, usize)> = Vec::with_capacity(count + 1);
    for (i, p) in places.iter().enumerate() {
        near.clear();
        for (j, q) in places.iter().enumerate().filter(|(j, _)| *j != i) {
            let distance = (q - p).norm_squared();
            if near.len() == count && near.last().is_some_and(|last| last.0 <= distance) {
                continue;
            }
            near.insert(near.partition_point(|n| n.0 <= distance), (distance, j));
            near.truncate(count);
        }
        all.push(near.iter().map(|n| n.1).collect());
    }
    all
}

type Matches = Vec<(usize, usize)>;

/// Poses that explain at least [`MIN_MATCHES`] regions, the best first.
fn hypotheses(regions: &[Region], camera: &Camera, layout: &PlateLayout) -> Vec<Isometry3<f64>> {
    let discs: Vec<Vector2<f64>> = layout
        .discs
        .iter()
        .map(|d| Vector2::new(d.x_m, d.y_m))
        .collect();
    let centres: Vec<Vector2<f64>> = regions.iter().map(|r| r.centre).collect();
    let (in_layout, in_image) = (nearest(&discs, NEIGHBOURS), nearest(&centres, NEIGHBOURS));
    let cells = Cells::new(regions);
    // the most matches first
    let mut found: BTreeSet<(Reverse<usize>, Matches)> = BTreeSet::new();
    for (a, region) in regions.iter().enumerate() {
        for &b in &in_image[a] {
            let other = &regions[b];
            let ratio = other.area / region.area;
            if !(0.5..=2.0).contains(&ratio) {
                continue;
            }
            let seen = region.inverse * (other.centre - region.centre);
            let seen_length = seen.norm();
            for (i, disc) in discs.iter().enumerate() {
                let radius = layout.discs[i].radius_m;
                for &j in &in_layout[i] {
                    let edge = discs[j] - disc;
                    let length = edge.norm();
                    if !(0.75..=1.33).contains(&(seen_length * radius / length)) {
                        continue;
                    }
                    // a front view turns the plate's y upside down
                    let (p, q) = (edge / length, seen / seen_length);
                    let (c, s) = (p.x * q.x - p.y * q.y, p.y * q.x + p.x * q.y);
                    let mut map = region.root * Matrix2::new(c, s, s, -c) / radius;
                    // the neighbour's true place is better known than the region's size
                    map *= radius * seen_length / length;
                    let place = |d: &Vector2<f64>| region.centre + map * (d - disc);
                    // three neighbours first: most hypotheses end here
                    let (mut met, mut missed) = (0, 0);
                    for &k in &in_layout[i] {
                        match cells.at(&place(&discs[k]), 1.0) {
                            Some(_) => met += 1,
                            None => missed += 1,
                        }
                        if met >= 3 || missed + 3 > in_layout[i].len() {
                            break;
                        }
                    }
                    if met < 3 {
                        continue;
                    }
                    let matches = matching(&cells, &discs, &place, REACH);
                    if matches.len() >= MIN_MATCHES - 2 {
                        found.insert((Reverse(matches.len()), matches));
                        if found.len() > SETTLED {
                            found.pop_last();
                        }
                    }
                }
            }
        }
    }
    let mut poses: Vec<(usize, f64, Isometry3<f64>)> = Vec::new();
    for (_, matches) in found {
        if let Some(one) = settle(&cells, &discs, camera, matches) {
            poses.push(one);
        }
    }
    poses.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.total_cmp(&b.1)));
    poses
        .into_iter()
        .take(MAX_MEASURED)
        .map(|(_, _, pose)| pose)
        .collect()
}

/// Which disc meets which region.
fn matching(
    cells: &Cells,
    discs: &[Vector2<f64>],
    place: &dyn Fn(&Vector2<f64>) -> Vector2<f64>,
    reach: f64,
) -> Matches {
    let mut matches: Matches = Vec::with_capacity(discs.len());
    for (k, disc) in discs.iter().enumerate() {
        if let Some(r) = cells.at(&place(disc), reach)
            && matches.iter().all(|(_, taken)| *taken != r)
        {
            matches.push((k, r));
        }
    }
    matches
}

/// Affine fit, homography and pose from matches; also how many discs fit and how well.
fn settle(
    cells: &Cells,
    discs: &[Vector2<f64>],
    camera: &Camera,
    mut matches: Matches,
) -> Option<(usize, f64, Isometry3<f64>)> {
    // least-squares affine map, to pull in what the first map missed
    let mut normal = SMatrix::<f64, 3, 3>::zeros();
    let mut right = SMatrix::<f64, 3, 2>::zeros();
    for &(k, r) in &matches {
        let row = SVector::<f64, 3>::new(discs[k].x, discs[k].y, 1e-2);
        normal += row * row.transpose();
        right += row * cells.regions[r].centre.transpose();
    }
    let map = normal.cholesky()?.solve(&right);
    let by_affine = |d: &Vector2<f64>| map.transpose() * Vector3::new(d.x, d.y, 1e-2);
    let wider = matching(cells, discs, &by_affine, REACH);
    if wider.len() > matches.len() {
        matches = wider;
    }
    let mut best = None;
    for reach in [0.8, 0.5] {
        let points: Vec<(Vector2<f64>, Vector2<f64>)> = matches
            .iter()
            .map(|&(k, r)| (discs[k], cells.regions[r].centre))
            .collect();
        let start = plane_pose(camera, &points)?;
        let seen: Vec<Sighting> = points
            .iter()
            .map(|(p, q)| Sighting {
                camera: 0,
                index: 0,
                point_in_plate: Vector3::new(p.x, p.y, 0.0),
                pixel_px: *q,
                sigma_px: 0.3,
            })
            .collect();
        let solved = solve_pose(&[camera], &seen, &start).ok()?;
        let pose = solved.pose;
        let nowhere = Vector2::repeat(-1e6);
        let place = |d: &Vector2<f64>| {
            let p = pose * nalgebra::Point3::new(d.x, d.y, 0.0);
            camera.project(&p.coords).unwrap_or(nowhere)
        };
        matches = matching(cells, discs, &place, reach);
        if matches.len() < MIN_MATCHES {
            return best;
        }
        best = Some((matches.len(), solved.rms_px(), pose));
    }
    best
}
