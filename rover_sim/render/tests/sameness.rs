//! An image depends on scene, camera, state and seed, and on nothing else.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;
use common::{renderer, state};
use nalgebra::{Isometry3, Vector3};
use rover_render::{Grey8, Renderer};

fn in_threads<T: Send>(threads: usize, f: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap()
        .install(f)
}

fn mean(image: &Grey8) -> f64 {
    image.pixels.iter().map(|&g| f64::from(g)).sum::<f64>() / image.pixels.len() as f64
}

#[test]
fn kept_tiles_give_the_same_image_as_drawing_in_full() {
    let (mut kept, left, right) = renderer();
    for step in [0.0, 0.3, 2.0, -3.0, -3.0, 30.0, 0.0] {
        let a = kept.render_pair(left, right, &state(step), 7).unwrap();
        let (mut fresh, l, r) = renderer();
        let b = fresh.render_pair(l, r, &state(step), 7).unwrap();
        assert!(a == b, "at step {step}");
    }
}

#[test]
fn hiding_the_pattern_is_undone_without_a_trace() {
    let (mut renderer, left, _) = renderer();
    let shown = renderer.render(left, &state(0.0), 1).unwrap();
    let mut blank = state(0.0);
    blank.pattern_visible = false;
    assert!(renderer.render(left, &blank, 1).unwrap() != shown);
    assert!(renderer.render(left, &state(0.0), 1).unwrap() == shown);
}

#[test]
fn one_thread_and_several_give_the_same_image() {
    let draw = |threads| {
        in_threads(threads, || {
            let (mut r, left, right) = renderer();
            let a = r.render_pair(left, right, &state(0.0), 3).unwrap();
            (a, r.render_pair(left, right, &state(1.0), 4).unwrap())
        })
    };
    let one = draw(1);
    assert!(one == draw(2) && one == draw(5));
}

#[test]
fn portable_kernels_give_the_same_image() {
    let (mut fast, left, right) = renderer();
    let (mut portable, _, _) = renderer();
    portable.use_portable_kernels();
    for step in [0.0, 1.0] {
        let a = fast.render_pair(left, right, &state(step), 3).unwrap();
        let b = portable.render_pair(left, right, &state(step), 3).unwrap();
        assert!(a == b);
    }
}

#[test]
fn the_seed_changes_the_noise_and_nothing_else() {
    let (mut renderer, left, _) = renderer();
    let a = renderer.render(left, &state(0.0), 1).unwrap();
    let b = renderer.render(left, &state(0.0), 2).unwrap();
    assert!(a == renderer.render(left, &state(0.0), 1).unwrap());
    let differing = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .filter(|(x, y)| x != y)
        .count();
    let most = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .map(|(x, y)| x.abs_diff(*y))
        .max()
        .unwrap();
    assert!(
        differing > a.pixels.len() / 3 && most <= 15,
        "{differing} {most}"
    );
}

/// The two sides of a pair are noisy independently.
#[test]
fn a_pair_has_two_noises() {
    let (parts, plates) = common::arm();
    let scene = rover_render::Scene::new(
        common::statics(),
        parts,
        plates,
        common::sun(),
        rover_render::Sky::default(),
    )
    .unwrap();
    let mut renderer = Renderer::new(scene);
    let camera = &common::pair()[0];
    let one = renderer.add_camera(camera, Default::default()).unwrap();
    let two = renderer.add_camera(camera, Default::default()).unwrap();
    let (a, b) = renderer.render_pair(one, two, &state(0.0), 9).unwrap();
    let product: f64 = a
        .pixels
        .windows(2)
        .zip(b.pixels.windows(2))
        .map(|(x, y)| f64::from(x[0]) - f64::from(y[0]))
        .map(f64::abs)
        .sum();
    assert!(product > 0.2 * a.pixels.len() as f64);
}

#[test]
fn a_camera_moved_to_a_place_sees_what_a_camera_made_there_sees() {
    let (mut renderer, left, _) = renderer();
    let move_by = Isometry3::new(
        Vector3::new(0.07, -0.05, 0.1),
        Vector3::new(0.05, -0.1, 0.2),
    );
    let made = common::pair()[0].transformed(&move_by);
    let made = renderer.add_camera(&made, Default::default()).unwrap();
    let before = renderer.render(left, &state(0.0), 1).unwrap();
    renderer.set_camera_pose(left, &move_by).unwrap();
    let moved = renderer.render(left, &state(0.0), 1).unwrap();
    let reference = renderer.render(made, &state(0.0), 1).unwrap();
    let off = moved
        .pixels
        .iter()
        .zip(&reference.pixels)
        .filter(|(a, b)| a.abs_diff(**b) > 2);
    // rounding may tip a sample at an edge of a shadow
    assert!(off.count() < moved.pixels.len() / 2000);
    renderer
        .set_camera_pose(left, &Isometry3::identity())
        .unwrap();
    assert!(renderer.render(left, &state(0.0), 1).unwrap() == before);
}

#[test]
fn a_removed_stone_leaves_no_trace() {
    let (mut renderer, left, _) = renderer();
    let with = renderer.render(left, &state(0.0), 1).unwrap();
    renderer.remove_static(1).unwrap();
    assert!(renderer.remove_static(1).is_err() && renderer.remove_static(99).is_err());
    let without = renderer.render(left, &state(0.0), 1).unwrap();
    assert!(with != without);
    let (parts, plates) = common::arm();
    let mut statics = common::statics();
    statics.remove(1);
    let sky = rover_render::Sky::default();
    let scene = rover_render::Scene::new(statics, parts, plates, common::sun(), sky).unwrap();
    let mut never = Renderer::new(scene);
    let id = never
        .add_camera(&common::pair()[0], Default::default())
        .unwrap();
    assert!(never.render(id, &state(0.0), 1).unwrap() == without);
    let down = (Vector3::new(0.8, -0.1, 2.0), Vector3::new(0.0, 0.0, -1.0));
    assert_eq!(renderer.cast(&down.0, &down.1, None).unwrap().mesh_index, 0);
}

#[test]
fn exposure_is_as_documented() {
    let (mut renderer, left, _) = renderer();
    let image = renderer.render(left, &state(0.0), 1).unwrap();
    let level = mean(&image);
    assert!((70.0..125.0).contains(&level), "mean level {level}");
    assert!(image.pixels.iter().filter(|&&g| g > 250).count() < 200);
}
