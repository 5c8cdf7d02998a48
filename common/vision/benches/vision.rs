//! Speed of the image measurements, one thread, on rendered 640 x 480 images.
#![allow(clippy::unwrap_used, missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::{Isometry3, Vector2};
use rover_vision::find::{self, DiscRules, SaddleRules, TagRules, TemplateRules};
use rover_vision::harris::HarrisRules;
use rover_vision::ncc::{TemplatePyramid, Window, search};
use rover_vision::*;

#[allow(dead_code)]
#[path = "../src/synthetic.rs"]
mod synthetic;

fn plate_image(layout: &PlateLayout, pose: &Isometry3<f64>, side: usize) -> Image8 {
    let pair = synthetic::pair();
    let camera = [&pair.left, &pair.right][side];
    let rays = synthetic::Rays::new(camera);
    let mut picture: Vec<f64> = (0..640 * 480)
        .map(|i| synthetic::texture((i % 640) as f64, (i / 640) as f64, 64.0, 3.0, 18.0, 1))
        .collect();
    synthetic::draw(&mut picture, &rays, (0, 0, 640, 480), 4, &|o, d| {
        let p = synthetic::hit_plane(pose, o, d)?;
        layout.albedo(p.x, p.y).map(|a| a * 220.0)
    });
    let mut rng = synthetic::rng(1);
    let pixels = synthetic::expose(&picture, 640, (0, 0, 640, 480), 0.6, 1.5, &mut rng);
    Image8::from_raw(640, 480, pixels).unwrap()
}

fn rock_image(pose: &Isometry3<f64>, side: usize) -> Image8 {
    let pair = synthetic::pair();
    let camera = [&pair.left, &pair.right][side];
    let rays = synthetic::Rays::new(camera);
    let mut picture = vec![110.0; 640 * 480];
    synthetic::draw(&mut picture, &rays, (0, 0, 640, 480), 2, &|o, d| {
        let p = synthetic::hit_plane(pose, o, d)?;
        Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, 3))
    });
    let mut rng = synthetic::rng(2);
    let pixels = synthetic::expose(&picture, 640, (0, 0, 640, 480), 0.6, 1.5, &mut rng);
    Image8::from_raw(640, 480, pixels).unwrap()
}

fn fiducial(c: &mut Criterion) {
    let pair = synthetic::pair();
    let layout = PlateLayout::standard(0.08);
    let rules = DetectionRules::default();
    let pose = synthetic::facing_pose(&pair.left, Vector2::new(300.0, 230.0), 0.6, 0.5, 1.0, 0.2);
    let (left, right) = (
        plate_image(&layout, &pose, 0),
        plate_image(&layout, &pose, 1),
    );
    let off = Isometry3::translation(0.004, 0.003, 0.002);
    let looking = |camera, radius| PlateSearch {
        camera,
        layout: &layout,
        predicted_camera_frame_from_plate: off * pose,
        search_radius_px: radius,
        rules: &rules,
    };
    for radius in [10.0, 20.0, 60.0] {
        let search = looking(&pair.left, radius);
        c.bench_function(&format!("plate, search radius {radius} px"), |b| {
            b.iter(|| find_plate(&left, &search).unwrap());
        });
    }
    let search = looking(&pair.left, 16.0);
    c.bench_function("saddle alone, search radius 16 px", |b| {
        b.iter(|| find_saddle(&left, &search).unwrap());
    });
    c.bench_function("plate, whole image without a prediction", |b| {
        b.iter(|| find::plate(&left, &pair.left, &layout, None, &rules).unwrap());
    });
    let whole = Window::whole(&left);
    c.bench_function("discs, whole image", |b| {
        b.iter(|| find::disc(&left, whole, &DiscRules::default(), None).unwrap());
    });
    c.bench_function("saddles, whole image", |b| {
        b.iter(|| find::saddle(&left, whole, &SaddleRules::default()).unwrap());
    });
    c.bench_function("tags, whole image", |b| {
        b.iter(|| find::tags(&left, whole, "tag36h11", None, &TagRules::default()).is_err());
    });
    let seen = [
        find_plate(&left, &looking(&pair.left, 20.0)).unwrap(),
        find_plate(&right, &looking(&pair.right, 20.0)).unwrap(),
    ];
    c.bench_function("plate pose from two images", |b| {
        b.iter(|| estimate_plate_pose(&pair, &layout, &seen[0], &seen[1], &(off * pose)).unwrap());
    });
}

fn template(c: &mut Criterion) {
    let pair = synthetic::pair();
    let pose = synthetic::facing_pose(&pair.left, Vector2::new(320.0, 240.0), 0.6, 0.3, 1.0, 0.0);
    let image = rock_image(&pose, 0);
    let values: Vec<f32> = (0..31 * 31)
        .map(|i| f32::from(image.get(305 + i % 31, 225 + i / 31).unwrap()))
        .collect();
    let template = TemplatePyramid::new(31, 31, &values, None, 3).unwrap();
    c.bench_function("template 31 x 31, whole image", |b| {
        b.iter(|| search(&image, &template, Window::whole(&image)).unwrap());
    });
    c.bench_function("harris, whole image", |b| {
        let rules = HarrisRules::default();
        b.iter(|| find::harris(&image, Window::whole(&image), &rules).unwrap());
    });
    let picture: Vec<u8> = values.iter().map(|&x| x as u8).collect();
    let picture = Image8::from_raw(31, 31, picture).unwrap();
    c.bench_function(
        "template 31 x 31, whole image, with affine fit and all rules",
        |b| {
            let rules = TemplateRules::default();
            b.iter(|| find::template(&image, &picture, Window::whole(&image), &rules).unwrap());
        },
    );
    let window = Window {
        left: 290,
        top: 205,
        width: 64,
        height: 64,
    };
    c.bench_function("template 31 x 31, 64 x 64 window", |b| {
        b.iter(|| search(&image, &template, window).unwrap());
    });
}

fn stereo(c: &mut Criterion) {
    let pair = synthetic::pair();
    let pixel = Vector2::new(340.0, 240.0);
    let pose = synthetic::facing_pose(&pair.left, pixel, 0.6, 0.6, 0.3, 0.0);
    let images = [rock_image(&pose, 0), rock_image(&pose, 1)];
    c.bench_function("prepare one image", |b| {
        b.iter(|| PreparedImage::new(&images[0]).unwrap());
    });
    let rectifier = Rectifier::new(&pair, 40.0).unwrap();
    c.bench_function("rectify one image", |b| {
        b.iter(|| {
            rectifier
                .apply(&images[0], rover_cameras::Side::Left)
                .unwrap()
        });
    });
    let flat = [
        rectifier
            .apply(&images[0], rover_cameras::Side::Left)
            .unwrap(),
        rectifier
            .apply(&images[1], rover_cameras::Side::Right)
            .unwrap(),
    ];
    c.bench_function("dense disparity 640 x 480, 64 disparities", |b| {
        b.iter(|| dense_disparity(&flat[0], &flat[1], &DenseRules::default()).unwrap());
    });
    let [left, right] = images.map(|i| PreparedImage::new(&i).unwrap());
    let rules = MatchRules {
        range_min_m: 0.45,
        range_max_m: 0.9,
        ..MatchRules::default()
    };
    c.bench_function("match of one point over 54 px", |b| {
        b.iter(|| match_point(&left, &right, &pair, &pixel, &rules).unwrap());
    });
    let surface = SurfaceRules {
        matching: rules.clone(),
        ..SurfaceRules::default()
    };
    c.bench_function("surface under one pixel", |b| {
        b.iter(|| measure_surface(&left, &right, &pair, &pixel, &surface).unwrap());
    });
    let mut slow = c.benchmark_group("whole image");
    slow.sample_size(10);
    slow.bench_function("sparse points, every 8 px", |b| {
        b.iter(|| sparse_points(&left, &right, &pair, 8, &rules).unwrap());
    });
}

/// The image library of the field in Rust, on the same image: normalised cross-correlation at every
/// whole pixel, and its interest points (FAST has no subpixel place).
fn peer(c: &mut Criterion) {
    use imageproc::image::GrayImage;
    use imageproc::template_matching::{MatchTemplateMethod, find_extremes, match_template};
    let pair = synthetic::pair();
    let pose = synthetic::facing_pose(&pair.left, Vector2::new(320.0, 240.0), 0.6, 0.3, 1.0, 0.0);
    let rock = rock_image(&pose, 0);
    let image = GrayImage::from_raw(640, 480, rock.pixels.clone()).unwrap();
    let cut = |left: u32, top: u32, side: u32| {
        GrayImage::from_fn(side, side, |u, v| *image.get_pixel(left + u, top + v))
    };
    let (picture, window) = (cut(305, 225, 31), cut(290, 205, 64));
    let method = MatchTemplateMethod::CrossCorrelationNormalized;
    c.bench_function(
        "imageproc: template 31 x 31, 64 x 64 window, whole px",
        |b| {
            b.iter(|| find_extremes(&match_template(&window, &picture, method)));
        },
    );
    c.bench_function("imageproc: FAST-9 corners, whole image", |b| {
        b.iter(|| imageproc::corners::corners_fast9(&image, 20));
    });
    let mut slow = c.benchmark_group("imageproc");
    slow.sample_size(10);
    slow.bench_function("template 31 x 31, whole image, whole px", |b| {
        b.iter(|| find_extremes(&match_template(&image, &picture, method)));
    });
}

criterion_group!(benches, fiducial, template, stereo, peer);
criterion_main!(benches);
