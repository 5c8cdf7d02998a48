//! Images against exact projections and casts.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;
use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::Camera;
use rover_render::{
    DynamicPart, FrameState, Grey8, ImagingParameters, Plate, RenderError, Renderer, Scene,
    SceneError, Sky, StaticMesh, Sun, Surface, Texture, shapes,
};
use std::sync::Arc;

const QUIET: ImagingParameters = ImagingParameters {
    psf_sigma_px: 0.6,
    gain_dn: 420.0,
    read_noise_dn: 0.0,
    electrons_per_dn: f64::INFINITY,
};

/// The area centroid of a disc of the plane `pose * (x, y, 0)` as the camera images it, by a polygon
/// of its outline.
fn disc_centroid(camera: &Camera, pose: &Isometry3<f64>, x: f64, y: f64, r: f64) -> Vector2<f64> {
    let outline: Vec<Vector2<f64>> = (0..720)
        .map(|k| {
            let a = f64::from(k) * std::f64::consts::TAU / 720.0;
            let p = nalgebra::Point3::new(x + r * a.cos(), y + r * a.sin(), 0.0);
            camera.project(&(pose * p).coords).unwrap()
        })
        .collect();
    let (mut area, mut sum) = (0.0, Vector2::zeros());
    for (a, b) in outline.iter().zip(outline.iter().cycle().skip(1)) {
        let w = a.perp(b);
        area += w;
        sum += (a + b) * w;
    }
    sum / (3.0 * area)
}

fn measured_centroid(
    image: &Grey8,
    near: Vector2<f64>,
    radius_px: f64,
    white: f64,
) -> Vector2<f64> {
    let (mut mass, mut sum) = (0.0, Vector2::zeros());
    for v in 0..image.height {
        for u in 0..image.width {
            let p = Vector2::new(u as f64, v as f64);
            if (p - near).norm() < radius_px {
                let w = white - f64::from(image.pixels[v * image.width + u]);
                mass += w;
                sum += p * w;
            }
        }
    }
    sum / mass
}

#[test]
fn discs_on_a_plate_appear_where_they_are() {
    let disc = |x: f64, y: f64| Some(if x.hypot(y) < 0.010 { 0.04 } else { 0.5 });
    let plate = Plate {
        part: 0,
        part_from_plate: Isometry3::identity(),
        half_width_m: 0.035,
        half_height_m: 0.035,
        albedo: Arc::new(disc),
        blank_albedo: 0.5,
        back_albedo: 0.2,
    };
    // a body that is out of sight
    let mesh = shapes::icosphere(0).transformed(&Translation3::new(0.0, 0.0, -50.0).into());
    let part = DynamicPart {
        mesh,
        surface: Surface::paint(0.5, 1),
    };
    let sun = Sun {
        direction_to_sun: Unit::new_normalize(Vector3::new(-0.8, 0.2, 0.5)),
        intensity: 0.8,
        ambient: 0.3,
    };
    let scene = Scene::new(vec![], vec![part], vec![plate], sun, Sky::default()).unwrap();
    let mut renderer = Renderer::new(scene);
    let camera = common::camera(Vector3::zeros(), Vector3::x(), [320, 240], 300.0);
    let id = renderer.add_camera(&camera, QUIET).unwrap();
    let mut squares = 0.0;
    let mut worst: f64 = 0.0;
    let count = 60;
    for k in 0..count {
        let f = |c: f64| shapes::noise(&Vector3::new(f64::from(k) * 1.37, c + 0.5, 0.5), 5);
        let distance = 0.45 + 0.1 * f(0.0);
        let place = Translation3::new(distance, 0.12 * f(1.0), 0.1 * f(2.0));
        // face towards -x, tilted by up to 40 deg
        let face = Rotation3::from_axis_angle(&Vector3::y_axis(), -std::f64::consts::FRAC_PI_2);
        let tilt = UnitQuaternion::from_euler_angles(1.2 * f(3.0), 0.7 * f(4.0), 0.7 * f(5.0));
        let pose = Isometry3::from_parts(place, tilt * UnitQuaternion::from(face));
        let state = FrameState {
            part_poses: vec![pose],
            pattern_visible: true,
        };
        let image = renderer.render(id, &state, 0).unwrap();
        let expected = disc_centroid(&camera, &pose, 0.0, 0.0, 0.010);
        let scale = 300.0 / distance;
        // the level of the white around the disc
        let rim = pose * nalgebra::Point3::new(0.0, 0.022, 0.0);
        let at = camera.project(&rim.coords).unwrap();
        let white =
            f64::from(image.pixels[at.y.round() as usize * image.width + at.x.round() as usize]);
        let found = measured_centroid(&image, expected, 0.0155 * scale, white);
        let error = (found - expected).norm();
        squares += error * error;
        worst = worst.max(error);
    }
    let rms = (squares / f64::from(count)).sqrt();
    println!("disc centroid: rms {rms:.4} px, worst {worst:.4} px");
    assert!(rms < 0.008 && worst < 0.02, "rms {rms}, worst {worst}");
}

#[test]
fn the_shadow_of_an_edge_falls_where_it_should() {
    let flat = shapes::heightfield_mesh(
        &(0..=40)
            .map(|i| f64::from(i) * 0.1 - 2.0)
            .collect::<Vec<_>>(),
        &(0..=40)
            .map(|i| f64::from(i) * 0.1 - 2.0)
            .collect::<Vec<_>>(),
        |_, _| 0.0,
    );
    let even = |mesh| StaticMesh {
        mesh,
        surface: Surface::Paint {
            albedo: 0.4,
            texture: Texture::PLAIN,
        },
    };
    let slab = shapes::cuboid(&Vector3::new(0.3, 0.2, 0.005))
        .transformed(&Translation3::new(0.6, 0.35, 0.3).into());
    let to_sun = Vector3::new(0.0, 0.6, 0.8);
    let sun = Sun {
        direction_to_sun: Unit::new_normalize(to_sun),
        intensity: 1.0,
        ambient: 0.1,
    };
    let scene = Scene::new(
        vec![even(flat), even(slab)],
        vec![],
        vec![],
        sun,
        Sky::default(),
    )
    .unwrap();
    let mut renderer = Renderer::new(scene);
    let camera = common::camera(
        Vector3::new(0.0, -0.5, 0.9),
        Vector3::new(0.6, -0.1, 0.0),
        [320, 240],
        300.0,
    );
    let id = renderer.add_camera(&camera, QUIET).unwrap();
    let state = FrameState {
        part_poses: vec![],
        pattern_visible: false,
    };
    let image = renderer.render(id, &state, 0).unwrap();
    let level = |p: Vector2<f64>| {
        let (u, v) = (p.x.floor(), p.y.floor());
        let (fu, fv) = (p.x - u, p.y - v);
        let at = |i: usize, j: usize| {
            f64::from(image.pixels[(v as usize + j) * image.width + u as usize + i])
        };
        (at(0, 0) * (1.0 - fu) + at(1, 0) * fu) * (1.0 - fv)
            + (at(0, 1) * (1.0 - fu) + at(1, 1) * fu) * fv
    };
    // the upper edge of the slab's near side casts the border of the shadow: y - z * 0.6 / 0.8,
    // at the lower end of its bevel of 0.25 mm
    let border = 0.15 - 0.30475 * 0.75;
    let on_ground = |x: f64, y: f64| camera.project(&Vector3::new(x, y, 0.0)).unwrap();
    let lit = level(on_ground(0.6, border - 0.05));
    let dark = level(on_ground(0.6, border + 0.05));
    assert!(dark < 0.25 * lit, "{lit} lit, {dark} dark");
    for i in 0..20 {
        let x = 0.45 + 0.015 * f64::from(i);
        // the half-way level along the line across the border
        let half = 0.5 * (lit + dark);
        let (mut low, mut high) = (border - 0.02, border + 0.02);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if level(on_ground(x, middle)) > half {
                low = middle
            } else {
                high = middle
            }
        }
        let error = (on_ground(x, low) - on_ground(x, border)).norm();
        assert!(error < 0.15, "{error} px at x = {x}");
    }
}

#[test]
fn casts_find_surfaces_normals_and_bodies() {
    let (renderer, _, _) = common::renderer();
    let down = -Vector3::z();
    let hit = renderer
        .cast(&Vector3::new(-0.503, 0.512, 1.0), &down, None)
        .unwrap();
    assert_eq!(hit.mesh_index, 0);
    assert!((hit.point.z - common::height(-0.503, 0.512)).abs() < 1e-3);
    assert!(hit.normal.z > 0.8 && hit.smooth_normal.dot(&hit.normal) > 0.95);
    assert!((hit.distance_m - (1.0 - hit.point.z)).abs() < 1e-12);
    let below = renderer
        .cast(&Vector3::new(-0.503, 0.512, -1.0), &-down, None)
        .unwrap();
    assert!((below.point - hit.point).norm() < 1e-12 && below.normal.z < -0.8);
    // the plate's face, seen only with a state
    let state = common::state(0.0);
    let (parts, plates) = common::arm();
    let world_from_plate = state.part_poses[1] * plates[0].part_from_plate;
    let n = world_from_plate.rotation * Vector3::z();
    let from = world_from_plate.translation.vector + n * 0.02;
    let hit = renderer.cast(&from, &-n, Some(&state)).unwrap();
    let plate = common::statics().len() + parts.len();
    assert_eq!(hit.mesh_index, plate);
    assert!((hit.distance_m - 0.02).abs() < 1e-12 && (hit.normal - n).norm() < 1e-12);
    assert!(
        renderer
            .cast(&from, &-n, None)
            .is_none_or(|h| h.mesh_index < plate)
    );
    assert!(renderer.cast(&from, &Vector3::zeros(), None).is_none());
}

/// Stereo correlation lives on this: contrast within a window about as wide as it uses.
#[test]
fn ground_has_contrast_in_small_windows_at_working_distance() {
    let scene = Scene::new(
        common::statics(),
        vec![],
        vec![],
        common::sun(),
        Sky::default(),
    );
    let mut renderer = Renderer::new(scene.unwrap());
    let state = FrameState {
        part_poses: vec![],
        pattern_visible: false,
    };
    for eye_height in [0.4, 0.7, 1.0] {
        let eye = Vector3::new(-1.0, -0.8, eye_height);
        let target = Vector3::new(-0.3, -0.8, 0.0);
        let camera = common::camera(eye, target, [640, 480], 602.0);
        let id = renderer.add_camera(&camera, Default::default()).unwrap();
        let image = renderer.render(id, &state, 1).unwrap();
        let (mut deviation, mut level, mut windows) = (0.0, 0.0, 0.0);
        for v in (100..360).step_by(15) {
            for u in (100..540).step_by(15) {
                let values: Vec<f64> = (0..225)
                    .map(|i| f64::from(image.pixels[(v + i / 15) * image.width + u + i % 15]))
                    .collect();
                let mean = values.iter().sum::<f64>() / 225.0;
                let var = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 225.0;
                deviation += var.sqrt();
                level += mean;
                windows += 1.0;
            }
        }
        let (deviation, level) = (deviation / windows, level / windows);
        println!("height {eye_height}: level {level:.1}, deviation in 15x15 {deviation:.1}");
        assert!((90.0..130.0).contains(&level), "level {level}");
        assert!((16.0..34.0).contains(&deviation), "deviation {deviation}");
    }
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let ball = || shapes::icosphere(1);
    let part = || DynamicPart {
        mesh: ball(),
        surface: Surface::metal(1),
    };
    let scene = |statics: Vec<StaticMesh>, parts| {
        Scene::new(statics, parts, vec![], common::sun(), Sky::default())
    };
    let mut mesh = ball();
    mesh.triangles[3][1] = 1000;
    let broken = scene(
        vec![StaticMesh {
            mesh,
            surface: Surface::rock(1),
        }],
        vec![],
    );
    assert!(matches!(
        broken,
        Err(SceneError::Index {
            triangle: 3,
            index: 1000,
            ..
        })
    ));
    let mut mesh = ball();
    mesh.positions[2].y = f64::NAN;
    let broken = scene(
        vec![StaticMesh {
            mesh,
            surface: Surface::rock(1),
        }],
        vec![],
    );
    assert!(matches!(
        broken,
        Err(SceneError::Position { vertex: 2, .. })
    ));
    let mut renderer = Renderer::new(scene(vec![], vec![part()]).unwrap());
    let mut camera = common::pair()[0].clone();
    let id = renderer.add_camera(&camera, Default::default()).unwrap();
    let none = FrameState {
        part_poses: vec![],
        pattern_visible: true,
    };
    let refused = renderer.render(id, &none, 0);
    assert_eq!(
        refused.unwrap_err(),
        RenderError::PoseCount {
            given: 0,
            expected: 1
        }
    );
    let mut lost = common::state(0.0);
    lost.part_poses.truncate(1);
    lost.part_poses[0].translation.x = f64::NAN;
    assert!(matches!(
        renderer.render(id, &lost, 0),
        Err(RenderError::Pose { .. })
    ));
    lost.part_poses[0].translation.x = 0.0;
    let same = renderer.render_pair(id, id, &lost, 0);
    assert_eq!(same.unwrap_err(), RenderError::SameCamera { index: 0 });
    camera.width_px = 1;
    let small = renderer.add_camera(&camera, Default::default());
    assert!(matches!(
        small,
        Err(RenderError::ImageSize { width: 1, .. })
    ));
    let loud = ImagingParameters {
        read_noise_dn: -1.0,
        ..Default::default()
    };
    let refused = renderer.add_camera(&common::pair()[0], loud);
    assert!(matches!(
        refused,
        Err(RenderError::Imaging {
            what: "read_noise_dn",
            ..
        })
    ));
}
