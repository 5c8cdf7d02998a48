//! Pictures that contradict each other: pairs that are none, pictures given twice, models that
//! leave distortion over.

use crate::calibration::{SIZE_PX, pair_with, paper_pair, rules, views};
use nalgebra::Vector3;
use rover_cameras::calibration::{
    BoardView, CalibrationError, ModelKind, QualityLimits, QualityProblem, STRUCTURED_SHARE,
    calibrate, repeats,
};

fn whole(views: Vec<BoardView>, n: usize) -> Vec<BoardView> {
    let all = |v: &BoardView| v.iter().all(|points| !points.is_empty());
    views.into_iter().filter(all).take(n).collect()
}

#[test]
fn a_pair_that_is_none_is_left_out_and_the_others_calibrate() {
    let pair = paper_pair();
    for spoilt in [0, 4] {
        let mut views = whole(views(&pair, 30, 0.1, 11, 0.6), 10);
        let stranger = views.pop().unwrap();
        views[spoilt][1].clone_from(&stranger[1]);
        let found = calibrate(&[SIZE_PX; 2], &views, &rules(pair.kind)).unwrap();
        assert_eq!(found.dropped, [spoilt]);
        assert_eq!(found.problems(&QualityLimits::default()), []);
        for (parameter, value) in found.parameters.iter().zip(&pair.values) {
            let pull = (parameter.value - value) / parameter.sigma;
            assert!(pull.abs() < 4.0, "{parameter:?}, truth {value}");
        }
        for picture in found.pictures() {
            let lost = picture.view == spoilt;
            assert_eq!(picture.dropped, lost);
            assert_eq!(picture.rms_px.is_none(), lost, "{picture:?}");
            assert_eq!(picture.median_px > 3.0, lost, "{picture:?}");
            assert!(lost || picture.rejected <= 2, "{picture:?}");
        }
        let corners: usize = found.pictures().iter().map(|p| p.corners).sum();
        assert_eq!(corners, found.residuals.len());
    }
}

#[test]
fn pairs_shifted_by_one_are_no_calibration() {
    let pair = paper_pair();
    let mut views = whole(views(&pair, 30, 0.1, 12, 0.6), 9);
    for n in 0..views.len() - 1 {
        let next = views[n + 1][1].clone();
        views[n][1] = next;
    }
    views.pop();
    match calibrate(&[SIZE_PX; 2], &views, &rules(pair.kind)) {
        Err(CalibrationError::Inconsistent { dropped, .. }) => assert!(dropped.len() > 5),
        Err(CalibrationError::NotSettled { sigma_px, .. }) => assert!(sigma_px > 1.0),
        Err(other) => panic!("{other}"),
        Ok(found) => assert_ne!(found.problems(&QualityLimits::default()), []),
    }
}

#[test]
fn one_placement_given_often_counts_once() {
    let pair = paper_pair();
    let views = whole(views(&pair, 30, 0.1, 13, 0.6), 4);
    let often = vec![views[0].clone(); 4];
    assert_eq!(repeats(&often), [None, Some(0), Some(0), Some(0)]);
    assert_eq!(repeats(&views), [None; 4]);
    let refused = calibrate(&[SIZE_PX; 2], &often, &rules(pair.kind)).unwrap_err();
    assert!(
        matches!(refused, CalibrationError::TooFewViews { found: 1, .. }),
        "{refused}"
    );
}

#[test]
fn a_board_moved_slowly_shows_several_placements() {
    let pair = paper_pair();
    let first = whole(views(&pair, 30, 0.1, 13, 0.6), 1).remove(0);
    let moved = |px: f64| -> BoardView {
        let mut view = first.clone();
        view.iter_mut()
            .flatten()
            .for_each(|corner| corner.pixel_px.x += px);
        view
    };
    let slow = [moved(0.0), moved(0.4), moved(0.8), moved(1.2)];
    assert_eq!(repeats(&slow), [None, Some(0), None, Some(2)]);
}

#[test]
fn pictures_that_cannot_both_be_true_are_named() {
    let pair = paper_pair();
    let views = whole(views(&pair, 40, 0.1, 14, 0.6), 8);
    let mut same = views.clone();
    same[2][1] = same[2][0].clone();
    let refused = calibrate(&[SIZE_PX; 2], &same, &rules(pair.kind)).unwrap_err();
    assert_eq!(refused, CalibrationError::SamePicture { view: 2 });
    let mut moved = views;
    // The pictures of views 1 and 6 with all corners.
    let full = |v: &BoardView| v.iter().all(|points| points.len() == 54);
    let at: Vec<usize> = (0..moved.len()).filter(|n| full(&moved[*n])).collect();
    let (first, second) = (at[0], at[1]);
    moved[second][0] = moved[first][0].clone();
    let refused = calibrate(&[SIZE_PX; 2], &moved, &rules(pair.kind)).unwrap_err();
    assert_eq!(
        refused,
        CalibrationError::Mispaired {
            camera: 0,
            views: [first, second]
        }
    );
    assert_eq!(refused.views(), [first, second]);
}

#[test]
fn distortion_that_a_model_leaves_over_shows() {
    let pair = paper_pair();
    let views = views(&pair, 18, 0.1, 15, 0.6);
    let right = calibrate(&[SIZE_PX; 2], &views, &rules(pair.kind)).unwrap();
    let poor = calibrate(&[SIZE_PX; 2], &views, &rules(ModelKind::Cahv)).unwrap();
    for camera in 0..2 {
        let (good, bad) = (
            right.structured_share(camera),
            poor.structured_share(camera),
        );
        println!("{good} {bad} of {} px", poor.rms_px[camera]);
        assert!(good < 0.1, "{good}");
        assert!(bad > STRUCTURED_SHARE, "{bad}");
        assert_eq!(right.left_over_px(camera), None);
        assert!(poor.left_over_px(camera).is_some());
    }
}

#[test]
fn the_baseline_and_its_sigma_cover_the_truth() {
    let pair = paper_pair();
    let truth: f64 = Vector3::new(-0.08, 0.001, 0.002).norm();
    let found = calibrate(
        &[SIZE_PX; 2],
        &views(&pair, 18, 0.1, 16, 0.6),
        &rules(pair.kind),
    )
    .unwrap();
    let baseline = found.baseline_m().unwrap();
    assert!((baseline.value - truth).abs() < 4.0 * baseline.sigma);
    assert!((1e-6..1e-3).contains(&baseline.sigma), "{baseline:?}");
}

#[test]
fn cameras_in_one_place_are_no_pair() {
    let pair = pair_with(Vector3::new(1e-5, 0.0, 0.0));
    let views = views(&pair, 18, 0.1, 17, 0.6);
    let found = calibrate(&[SIZE_PX; 2], &views, &rules(pair.kind)).unwrap();
    let problems = found.problems(&QualityLimits::default());
    assert!(
        matches!(problems.as_slice(), [QualityProblem::Baseline { .. }]),
        "{problems:?}"
    );
}
