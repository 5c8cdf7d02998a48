//! Draws a testbed scene and writes it as PNG, with the time that drawing takes.
//!
//! ```text
//! cargo run --release -p rover-render --example preview -- OUT_DIR [REPEATS]
//! ```

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use rover_cameras::{Cahvor, Camera, CameraModel};
use rover_render::{
    DynamicPart, FrameState, Grey8, ImagingParameters, Mesh, Plate, Renderer, Scene, Sky,
    StaticMesh, Sun, Surface, shapes,
};
use std::{error::Error, path::Path, sync::Arc, time::Instant};

/// A camera at `eye` that looks at `target`, pixels 640x480, focal length in pixels.
fn camera(eye: Vector3<f64>, target: Vector3<f64>, focal_px: f64) -> Camera {
    let a = (target - eye).normalize();
    let right = a.cross(&Vector3::z()).normalize();
    let down = a.cross(&right);
    let h = right * focal_px + a * 319.5;
    let v = down * focal_px + a * 239.5;
    let r = Vector3::new(0.001, -0.06, 0.02);
    Camera {
        model: CameraModel::Cahvor(Cahvor {
            c: eye,
            a,
            h,
            v,
            o: a,
            r,
        }),
        width_px: 640,
        height_px: 480,
    }
}

fn ground_height(x: f64, y: f64) -> f64 {
    let p = Vector3::new(x, y, 0.0);
    0.035 * shapes::fractal_noise(&(p / 0.9), 11, 6, 0.42)
        + 0.004 * shapes::fractal_noise(&(p / 0.09), 12, 3, 0.5)
}

/// Grid lines: 1 cm apart within a metre of `centre`, growing outside.
fn lines(centre: f64, far: f64) -> Vec<f64> {
    let mut half = vec![0.0];
    let (mut x, mut step) = (0.0, 0.01);
    while x < far {
        if x > 0.55 {
            step *= 1.13;
        }
        x += step;
        half.push(x);
    }
    half.iter()
        .rev()
        .map(|x| centre - x)
        .chain(half[1..].iter().map(|x| centre + x))
        .collect()
}

fn terrain() -> Vec<StaticMesh> {
    let ground = shapes::heightfield_mesh(&lines(0.9, 14.0), &lines(0.0, 14.0), ground_height);
    let mut out = vec![StaticMesh {
        mesh: ground,
        surface: Surface::ground(1),
    }];
    let mut stone = |seed: u64, x: f64, y: f64, radius: f64, subdivisions: u32| {
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, seed as f64);
        let place = Translation3::new(x, y, ground_height(x, y) + 0.12 * radius);
        let mesh = shapes::rock(seed, radius, subdivisions, 0.32)
            .transformed(&Isometry3::from_parts(place, turn));
        out.push(StaticMesh {
            mesh,
            surface: Surface::rock(seed as u32),
        });
    };
    stone(5, 0.86, -0.06, 0.17, 5);
    stone(6, 0.62, 0.26, 0.06, 4);
    stone(7, 1.25, 0.30, 0.12, 4);
    let random = |k: u64, c: f64| 0.5 + 0.5 * shapes::noise(&Vector3::new(k as f64, c, 0.0), 77);
    for k in 0..90 {
        let (x, y) = (random(k, 0.0) * 7.0 + 0.2, (random(k, 1.0) - 0.5) * 8.0);
        let radius = 0.012 / (0.07 + random(k, 2.0).powi(2));
        if (x - 0.86).hypot(y + 0.06) > 0.3 + radius {
            stone(100 + k, x, y, radius, if radius > 0.09 { 3 } else { 2 });
        }
    }
    for k in 0..160 {
        let (x, y) = (random(k, 5.0) * 1.6 + 0.3, (random(k, 6.0) - 0.5) * 1.6);
        stone(1000 + k, x, y, 0.004 + 0.008 * random(k, 7.0), 1);
    }
    out
}

/// From `a` to `b` along z.
fn along(a: Vector3<f64>, b: Vector3<f64>) -> (Isometry3<f64>, f64) {
    let z = b - a;
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &z).unwrap_or_default();
    (Isometry3::from_parts(a.into(), turn), z.norm())
}

fn albedo(x: f64, y: f64) -> Option<f64> {
    let dark = 0.04;
    for (cx, cy) in [
        (-0.028, -0.028),
        (0.028, -0.028),
        (-0.028, 0.028),
        (0.028, 0.028),
    ] {
        if (x - cx).hypot(y - cy) < 0.0055 {
            return Some(dark);
        }
    }
    if x.abs() < 0.016 && y.abs() < 0.016 {
        return Some(if (x > 0.0) == (y > 0.0) { dark } else { 0.5 });
    }
    Some(0.5)
}

/// The parts of an arm with a plate on its last link, and their poses for a given bend.
fn arm() -> (Vec<DynamicPart>, Vec<Plate>) {
    let paint = |mesh: Mesh| DynamicPart {
        mesh,
        surface: Surface::paint(0.42, 3),
    };
    let metal = |mesh: Mesh| DynamicPart {
        mesh,
        surface: Surface::metal(4),
    };
    let joint = |radius: f64, width: f64| {
        let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
        let lay = Isometry3::from_parts(Translation3::new(0.0, width / 2.0, 0.0), turn.into());
        shapes::cylinder(radius, width, 48).transformed(&lay)
    };
    let mut upper = shapes::cylinder(0.022, 0.36, 48);
    upper.append(&joint(0.038, 0.085));
    let mut fore = shapes::cylinder(0.019, 0.34, 48);
    fore.append(&joint(0.034, 0.075));
    let mut wrist = joint(0.026, 0.06);
    wrist.append(&shapes::cylinder(0.024, 0.06, 48));
    let mut tool = shapes::lathe(
        &[
            [0.0, 0.0],
            [0.030, 0.0],
            [0.032, 0.002],
            [0.032, 0.03],
            [0.026, 0.036],
            [0.026, 0.055],
            [0.014, 0.06],
            [0.012, 0.085],
            [0.006, 0.088],
            [0.004, 0.12],
            [0.0, 0.121],
        ],
        64,
    );
    let bracket = shapes::cuboid(&Vector3::new(0.04, 0.003, 0.04))
        .transformed(&Translation3::new(0.0, -0.0355, 0.03).into());
    tool.append(&bracket);
    let parts = vec![paint(upper), paint(fore), paint(wrist), metal(tool)];
    let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    let plate = Plate {
        part: 3,
        part_from_plate: Isometry3::from_parts(Translation3::new(0.0, -0.0393, 0.03), turn.into()),
        half_width_m: 0.04,
        half_height_m: 0.04,
        albedo: Arc::new(albedo),
        blank_albedo: 0.5,
        back_albedo: 0.25,
    };
    (parts, vec![plate])
}

fn pose(step: f64) -> FrameState {
    let base = Vector3::new(0.20, -0.34, 0.42);
    let elbow = Vector3::new(0.44, -0.24 + 0.01 * step, 0.66);
    let wrist = Vector3::new(0.72, -0.05, 0.42 - 0.004 * step);
    let upper = along(base, elbow).0;
    let fore = along(elbow, wrist).0;
    let tool = |z: f64| {
        let down = Vector3::new(0.12, 0.0, -1.0).normalize();
        let face = Vector3::new(0.8, -0.25, -0.3);
        let y = (face - down * face.dot(&down)).normalize();
        let turn =
            Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[y.cross(&down), y, down]));
        Isometry3::from_parts((wrist + down * z).into(), turn.into())
    };
    FrameState {
        part_poses: vec![upper, fore, tool(0.0), tool(0.06)],
        pattern_visible: true,
    }
}

fn save(dir: &Path, name: &str, image: Grey8) -> Result<(), Box<dyn Error>> {
    let (w, h) = (image.width as u32, image.height as u32);
    let picture = image::GrayImage::from_raw(w, h, image.pixels).ok_or("wrong size")?;
    picture.save(dir.join(name))?;
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let dir = arguments.next().ok_or("usage: preview OUT_DIR [REPEATS]")?;
    let repeats: usize = arguments.next().map_or(Ok(0), |n| n.parse())?;
    let dir = Path::new(&dir);
    let statics = terrain();
    let (parts, plates) = arm();
    let count = |m: &Mesh| m.triangles.len();
    println!(
        "triangles: {} static, {} moving",
        statics.iter().map(|s| count(&s.mesh)).sum::<usize>(),
        parts.iter().map(|p| count(&p.mesh)).sum::<usize>()
    );
    let sun = Sun {
        direction_to_sun: Unit::new_normalize(Vector3::new(-0.35, 0.85, 0.72)),
        intensity: 1.0,
        ambient: 0.16,
    };
    let started = Instant::now();
    let scene = Scene::new(statics, parts, plates, sun, Sky::default())?;
    let mut renderer = Renderer::new(scene);
    println!("scene prepared in {:?}", started.elapsed());
    let started = Instant::now();
    let imaging = ImagingParameters::default();
    let pair = [0.04, -0.04].map(|y| {
        let eye = Vector3::new(0.05, y, 0.95);
        camera(eye, eye + Vector3::new(0.74, 0.0, -0.74), 602.0)
    });
    let left = renderer.add_camera(&pair[0], imaging)?;
    let right = renderer.add_camera(&pair[1], imaging)?;
    let eye = Vector3::new(-0.6, 0.0, 1.15);
    let mast = renderer.add_camera(&camera(eye, Vector3::new(1.4, 0.0, 0.15), 520.0), imaging)?;
    println!("three cameras added in {:?}", started.elapsed());
    let (l, r) = renderer.render_pair(left, right, &pose(0.0), 1)?;
    save(dir, "left.png", l)?;
    save(dir, "right.png", r)?;
    save(dir, "mast.png", renderer.render(mast, &pose(0.0), 2)?)?;
    let mut full = Vec::new();
    let mut kept = Vec::new();
    for k in 0..repeats {
        if std::env::var("FULL").is_ok() { renderer.clear_cache(left)?; renderer.clear_cache(right)?; }
        for times in [&mut full, &mut kept] {
            let (wall, busy) = (Instant::now(), processor_ms());
            renderer.render_pair(left, right, &pose(k as f64 * 0.1), k as u64)?;
            times.push((wall.elapsed().as_secs_f64() * 1e3, processor_ms() - busy));
        }
    }
    for (name, times) in [("in full", full), ("static kept", kept)] {
        let mut wall: Vec<f64> = times.iter().map(|t| t.0).collect();
        let mut busy: Vec<f64> = times.iter().map(|t| t.1).collect();
        wall.sort_by(f64::total_cmp);
        busy.sort_by(f64::total_cmp);
        if let (Some(w), Some(b)) = (wall.get(wall.len() / 2), busy.get(busy.len() / 2)) {
            println!(
                "pair {name}: {w:.1} ms (least {:.1}), processor {b:.1} ms (least {:.1})",
                wall[0], busy[0]
            );
        }
    }
    Ok(())
}

/// Time that all threads of this process have run, ms (Linux; elsewhere 0).
fn processor_ms() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else {
        return 0.0;
    };
    tasks
        .flatten()
        .filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok())
        .filter_map(|s| s.split(' ').next()?.parse::<f64>().ok())
        .sum::<f64>()
        * 1e-6
}
