//! The plate's points: every mark is fitted, then contrast and pose tell which belong together.

use nalgebra::{Isometry3, Vector2, Vector3};

use super::local_map::Candidate;
use super::local_map::LocalMap;
use super::mark::{Mark, MarkFit, PointFault, fit};
use super::pose::{Sighting, solve_pose};
use super::{DetectionRules, NotFound, PlateObservation, PlateSearch, PointKind, PointObservation};
use crate::image::Image8;

fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

type Fits = Vec<(usize, Result<MarkFit, PointFault>)>;

fn fit_all(
    image: &Image8,
    search: &PlateSearch,
    map_of: &dyn Fn(usize, &Vector2<f64>) -> Option<LocalMap>,
    blur_px: Option<f64>,
) -> Fits {
    let rules = search.rules;
    let mut all = Vec::new();
    for index in 0..search.layout.point_count() {
        let Some(mark) = Mark::new(search.layout, index) else {
            continue;
        };
        let Some(map) = map_of(index, &mark.at_m) else {
            continue;
        };
        let start = blur_px.unwrap_or(rules.blur_sigma_px);
        all.push((
            index,
            fit(
                image,
                &mark,
                &map,
                start,
                blur_px.is_none(),
                blur_px.is_none(),
                rules,
            ),
        ));
    }
    all
}

fn sightings(search: &PlateSearch, fits: &Fits) -> Vec<Sighting> {
    let good = fits
        .iter()
        .filter_map(|(index, fit)| fit.as_ref().ok().map(|fit| (*index, fit)));
    good.filter_map(|(index, fit)| {
        search.layout.point(index).map(|point_in_plate| Sighting {
            camera: 0,
            index,
            point_in_plate,
            pixel_px: fit.pixel_px,
            sigma_px: fit.sigma_px,
        })
    })
    .collect()
}

fn too_few(rules: &DetectionRules, fits: &Fits) -> NotFound {
    NotFound::TooFewPoints {
        found: fits.iter().filter(|(_, f)| f.is_ok()).count(),
        needed: rules.min_points,
        first_fault: fits
            .iter()
            .find_map(|(i, f)| f.as_ref().err().map(|e| (*i, *e))),
    }
}

/// Removes points whose contrast does not belong to the plate's. Compared with its white a mark's
/// contrast is the same in sun and shade, so that the arm's own shadow costs no more than the marks
/// on its edge.
fn check_contrast(fits: &mut Fits, rules: &DetectionRules) {
    let mut contrasts: Vec<f64> = fits
        .iter()
        .filter_map(|(_, f)| f.as_ref().ok().map(|f| f.contrast))
        .collect();
    let Some(plate) = median(&mut contrasts) else {
        return;
    };
    for (_, fit) in fits.iter_mut() {
        if let Ok(good) = fit
            && (good.contrast - plate).abs() > rules.max_contrast_change * plate
        {
            *fit = Err(PointFault::OtherContrast {
                found: good.contrast,
                plate,
            });
        }
    }
}

/// Fits the single-camera pose and removes points off it, the worst first.
fn check_pose(
    search: &PlateSearch,
    fits: &mut Fits,
    start: &Isometry3<f64>,
) -> Result<Isometry3<f64>, NotFound> {
    let rules = search.rules;
    loop {
        let seen = sightings(search, fits);
        if seen.len() < rules.min_points {
            return Err(too_few(rules, fits));
        }
        let solved = solve_pose(&[search.camera], &seen, start)?;
        let Some((worst, residual_px)) = solved.worst() else {
            return Ok(solved.pose);
        };
        if residual_px <= rules.max_reprojection_px {
            return Ok(solved.pose);
        }
        let fault = PointFault::OffPose {
            residual_px,
            limit_px: rules.max_reprojection_px,
        };
        let index = seen[worst].index;
        for (i, fit) in fits.iter_mut() {
            if *i == index {
                *fit = Err(fault);
            }
        }
    }
}

/// Measures all points of an aligned plate.
pub(super) fn measure(
    image: &Image8,
    search: &PlateSearch,
    candidate: &Candidate,
) -> Result<PlateObservation, NotFound> {
    let rules = search.rules;
    if !(candidate.score >= rules.min_score) {
        return Err(NotFound::LowScore {
            score: candidate.score,
            limit: rules.min_score,
        });
    }
    // first from the aligned map, blur unknown; then from the pose, blur known
    let mut first = fit_all(image, search, &|_, at| candidate.map.at(at), None);
    check_contrast(&mut first, rules);
    let pose = check_pose(
        search,
        &mut first,
        &search.predicted_camera_frame_from_plate,
    )?;
    let mut blurs: Vec<f64> = first
        .iter()
        .filter_map(|(_, f)| f.as_ref().ok().map(|f| f.blur_px))
        .collect();
    let blur_px = median(&mut blurs).unwrap_or(rules.blur_sigma_px);

    let from_pose = |_: usize, at: &Vector2<f64>| {
        LocalMap::new(search.camera, &pose, &Vector3::new(at.x, at.y, 0.0)).ok()
    };
    let mut second = fit_all(image, search, &from_pose, Some(blur_px));
    check_contrast(&mut second, rules);
    check_pose(search, &mut second, &pose)?;

    let mut points = Vec::new();
    let mut refused = Vec::new();
    for (index, fit) in &second {
        let point = search.layout.point(*index);
        match (fit, point) {
            (Ok(fit), Some(point_in_plate)) => points.push(PointObservation {
                index: *index,
                point_in_plate,
                pixel_px: fit.pixel_px,
                sigma_px: fit.sigma_px,
                kind: if *index < search.layout.discs.len() {
                    PointKind::Disc
                } else {
                    PointKind::Saddle
                },
            }),
            (Err(fault), _) => refused.push((*index, *fault)),
            (Ok(_), None) => {}
        }
    }
    Ok(PlateObservation {
        points,
        score: candidate.score,
        refused,
        blur_sigma_px: blur_px,
    })
}

/// Measures the saddle of an aligned central marker.
pub(super) fn measure_saddle(
    image: &Image8,
    search: &PlateSearch,
    candidate: &Candidate,
) -> Result<PointObservation, NotFound> {
    let rules = search.rules;
    if !(candidate.score >= rules.min_saddle_score) {
        return Err(NotFound::LowScore {
            score: candidate.score,
            limit: rules.min_saddle_score,
        });
    }
    let index = search.layout.discs.len();
    let mark = Mark::new(search.layout, index).ok_or(NotFound::NoSaddle)?;
    let refuse = |fault| NotFound::TooFewPoints {
        found: 0,
        needed: 1,
        first_fault: Some((index, fault)),
    };
    let found = fit(
        image,
        &mark,
        &candidate.map,
        rules.blur_sigma_px,
        true,
        false,
        rules,
    )
    .map_err(refuse)?;
    Ok(PointObservation {
        index,
        point_in_plate: Vector3::new(mark.at_m.x, mark.at_m.y, 0.0),
        pixel_px: found.pixel_px,
        sigma_px: found.sigma_px,
        kind: PointKind::Saddle,
    })
}
