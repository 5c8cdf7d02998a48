//! What the camera models cost: projection, ray and triangulation, without and with derivatives.
//!
//! Each measurement runs over the same scattered pixels of the paper's stereo pair, so that branch
//! prediction and the Newton iterations see what an image offers; the time is per 1024 calls.

// criterion_group! makes a public function without documentation.
#![allow(missing_docs)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use nalgebra::{Isometry3, Matrix2, Translation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Cahv, Cahvore, Camera, CameraModel, StereoPair};
use std::hint::black_box;

const CALLS: usize = 1024;

/// The paper's camera at `y_m`, 45 degrees down, with or without the lens of a low-cost camera.
fn camera(y_m: f64, lens: bool) -> Camera {
    let look = UnitQuaternion::face_towards(
        &Vector3::new(1.0, 0.0, -1.0),
        &Vector3::new(-1.0, 0.0, -1.0),
    );
    let pose = Isometry3::from_parts(Translation3::new(0.2, y_m, 0.6), look);
    let (focal_px, centre_px, size_px) = ([602.15; 2], [319.5, 239.5], [640, 480]);
    if lens {
        let axis = Unit::new_normalize(Vector3::new(0.004, -0.003, 1.0));
        let r = [0.0, -0.12, 0.03];
        Camera::pinhole_distorted(&pose, focal_px, centre_px, size_px, &axis, r)
    } else {
        Camera::pinhole(&pose, focal_px, centre_px, size_px)
    }
}

/// Pixels spread evenly over the image (the additive recurrence of the plastic number).
fn pixels() -> Vec<Vector2<f64>> {
    (0..CALLS)
        .map(|i| {
            let x = (0.754_877_666_246_693 * i as f64).fract();
            let y = (0.569_840_290_998_053 * i as f64).fract();
            Vector2::new(60.0 + 560.0 * x, 20.0 + 440.0 * y)
        })
        .collect()
}

/// The points that the pixels see at 0.4 to 0.8 m.
fn points(camera: &Camera) -> Vec<Vector3<f64>> {
    pixels()
        .iter()
        .enumerate()
        .filter_map(|(i, pixel)| {
            camera
                .ray(pixel)
                .ok()
                .map(|ray| ray.at(0.4 + 0.4 * i as f64 / CALLS as f64))
        })
        .collect()
}

/// The same camera with the lens and the moving pupil of the Mars Exploration Rover's hazard camera.
fn wide() -> Camera {
    let mut camera = camera(0.04, false);
    if let CameraModel::Cahv(Cahv { c, a, h, v }) = camera.model {
        camera.model = CameraModel::Cahvore(Cahvore {
            c,
            a,
            h,
            v,
            o: a,
            r: Vector3::new(3e-6, -0.012015, -0.007525),
            e: Vector3::new(0.001442, 0.001522, 0.000483),
            linearity: 0.37,
        });
    }
    camera
}

fn single(c: &mut Criterion) {
    for (name, camera) in [
        ("cahv", camera(0.04, false)),
        ("cahvor", camera(0.04, true)),
        ("cahvore", wide()),
    ] {
        let (pixels, points) = (pixels(), points(&camera));
        let mut group = c.benchmark_group(name);
        group.throughput(Throughput::Elements(CALLS as u64));
        group.bench_function("project", |b| {
            b.iter(|| {
                points
                    .iter()
                    .for_each(|p| drop(black_box(camera.project(black_box(p)))))
            });
        });
        group.bench_function("project_with_jacobian", |b| {
            b.iter(|| {
                for point in &points {
                    let _ = black_box(camera.project_with_jacobian(black_box(point)));
                }
            });
        });
        group.bench_function("ray", |b| {
            b.iter(|| {
                pixels
                    .iter()
                    .for_each(|p| drop(black_box(camera.ray(black_box(p)))))
            });
        });
        group.bench_function("ray_with_jacobian", |b| {
            b.iter(|| {
                for pixel in &pixels {
                    let _ = black_box(camera.ray_with_jacobian(black_box(pixel)));
                }
            });
        });
        group.finish();
    }
}

fn stereo(c: &mut Criterion) {
    for (name, lens) in [("stereo_cahv", false), ("stereo_cahvor", true)] {
        let pair = StereoPair {
            left: camera(0.04, lens),
            right: camera(-0.04, lens),
        };
        let matches: Vec<_> = points(&pair.left)
            .iter()
            .filter_map(|p| Some((pair.left.project(p).ok()?, pair.right.project(p).ok()?)))
            .collect();
        let cov = Matrix2::identity() * 0.01;
        let mut group = c.benchmark_group(name);
        group.throughput(Throughput::Elements(matches.len() as u64));
        group.bench_function("triangulate", |b| {
            b.iter(|| {
                for (left, right) in &matches {
                    let _ = black_box(pair.triangulate(black_box(left), black_box(right)));
                }
            });
        });
        group.bench_function("triangulate_with_covariance", |b| {
            b.iter(|| {
                for (left, right) in &matches {
                    let found = pair.triangulate_with_covariance(
                        black_box(left),
                        black_box(right),
                        &cov,
                        &cov,
                    );
                    let _ = black_box(found);
                }
            });
        });
        group.bench_function("epipolar_point", |b| {
            b.iter(|| {
                for (left, _) in &matches {
                    let _ = black_box(pair.epipolar_point(black_box(left), black_box(0.6)));
                }
            });
        });
        group.finish();
    }
}

criterion_group!(benches, single, stereo);
criterion_main!(benches);
