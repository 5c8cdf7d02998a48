//! Boards rendered through a lens, with blur, tilt, uneven light and noise: found whole, in order,
//! and to a few hundredths of a pixel.

use super::*;
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_cameras::Camera;

const SQUARE_M: f64 = 0.02;

struct Scene {
    turn: [f64; 3],
    shift: [f64; 3],
    blur_px: f64,
    noise_dn: f64,
    /// Share of the light lost from the left to the right border.
    shade: f64,
    contrast: f64,
    /// Width of the white margin around the squares, squares.
    margin: f64,
}

const PLAIN: Scene = Scene {
    turn: [0.2, -0.3, 0.1],
    shift: [0.0, 0.0, 0.35],
    blur_px: 0.7,
    noise_dn: 1.0,
    shade: 0.0,
    contrast: 1.0,
    margin: 0.7,
};

fn camera() -> Camera {
    Camera::pinhole_distorted(
        &Isometry3::identity(),
        [602.0; 2],
        [319.5, 239.5],
        [640, 480],
        &Unit::new_normalize(Vector3::new(0.004, -0.003, 1.0)),
        [0.0, -0.12, 0.03],
    )
}

fn pose(scene: &Scene) -> Isometry3<f64> {
    Isometry3::new(scene.shift.into(), scene.turn.into())
}

/// The board's place of a corner, metres.
fn place(board: Chessboard, column: usize, row: usize) -> Point3<f64> {
    let middle = [board.columns as f64 - 1.0, board.rows as f64 - 1.0].map(|n| 0.5 * n);
    Point3::new(
        (column as f64 - middle[0]) * SQUARE_M,
        (row as f64 - middle[1]) * SQUARE_M,
        0.0,
    )
}

/// The square at the origin's outer side is dark.
fn render(scene: &Scene, board: Chessboard, seed: u64) -> Image8 {
    const SIDE: usize = 3;
    let camera = camera();
    let camera_from_board = pose(scene);
    let (rotation, shift) = (
        camera_from_board.rotation,
        camera_from_board.translation.vector,
    );
    let normal = rotation * Vector3::z();
    let mut values = Vec::with_capacity(640 * 480);
    for v in 0..480 {
        for u in 0..640 {
            let mut sum = 0.0;
            for k in 0..SIDE * SIDE {
                let sub = |i: usize| (i as f64 + 0.5) / SIDE as f64 - 0.5;
                let pixel =
                    Vector2::new(f64::from(u) + sub(k % SIDE), f64::from(v) + sub(k / SIDE));
                let ray = camera.ray(&pixel).unwrap();
                let range = normal.dot(&shift) / normal.dot(ray.direction.as_ref());
                let at = rotation.inverse() * (ray.at(range) - shift) / SQUARE_M;
                let (x, y) = (
                    at.x + 0.5 * (board.columns as f64 + 1.0),
                    at.y + 0.5 * (board.rows as f64 + 1.0),
                );
                let (i, j) = (x.floor(), y.floor());
                let on = (0.0..=board.columns as f64).contains(&i)
                    && (0.0..=board.rows as f64).contains(&j);
                let dark = on && (i + j) as i64 % 2 == 0;
                let sheet = (-scene.margin..board.columns as f64 + 1.0 + scene.margin).contains(&x)
                    && (-scene.margin..board.rows as f64 + 1.0 + scene.margin).contains(&y);
                let grey = match (dark, sheet) {
                    (true, _) => 0.15,
                    (false, true) => 0.15 + 0.65 * scene.contrast,
                    (false, false) => 0.35 + 0.1 * (0.11 * pixel.x).sin() * (0.07 * pixel.y).cos(),
                };
                sum += grey * (1.0 - scene.shade * pixel.x / 640.0);
            }
            values.push((255.0 * sum / (SIDE * SIDE) as f64) as f32);
        }
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut blurred = ImageF::from_raw(640, 480, values)
        .unwrap()
        .blurred(scene.blur_px);
    let noisy = blurred
        .values()
        .iter()
        .map(|x| {
            let sum: f64 = (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
            x + (scene.noise_dn * sum) as f32
        })
        .collect();
    blurred = ImageF::from_raw(640, 480, noisy).unwrap();
    blurred.to_image8()
}

/// Root mean square and worst distance from the truth, px; panics unless all corners are in order.
fn errors(scene: &Scene, board: Chessboard, seed: u64) -> (f64, f64) {
    let corners = find_chessboard(&render(scene, board, seed), board).unwrap();
    assert_eq!(corners.len(), board.columns * board.rows);
    let camera_from_board = pose(scene);
    let (mut sum, mut worst) = (0.0, 0.0_f64);
    for (n, corner) in corners.iter().enumerate() {
        assert_eq!(
            (corner.column, corner.row),
            (n % board.columns, n / board.columns)
        );
        let point = camera_from_board * place(board, corner.column, corner.row);
        let truth = camera().project(&point.coords).unwrap();
        let error = (corner.pixel_px - truth).norm();
        sum += error * error;
        worst = worst.max(error);
    }
    ((sum / corners.len() as f64).sqrt(), worst)
}

const BOARD: Chessboard = Chessboard {
    columns: 9,
    rows: 6,
};

#[test]
fn boards_are_found_under_blur_tilt_shade_and_noise() {
    let scenes = [
        ("plain", PLAIN, 0.06),
        (
            "blurred",
            Scene {
                blur_px: 2.0,
                ..PLAIN
            },
            0.06,
        ),
        (
            "noisy",
            Scene {
                noise_dn: 6.0,
                ..PLAIN
            },
            0.12,
        ),
        (
            "shaded",
            Scene {
                shade: 0.75,
                ..PLAIN
            },
            0.06,
        ),
        (
            "faint",
            Scene {
                contrast: 0.3,
                ..PLAIN
            },
            0.08,
        ),
        (
            "tilted",
            Scene {
                turn: [0.1, 0.9, 0.2],
                ..PLAIN
            },
            0.06,
        ),
        (
            "upside down",
            Scene {
                turn: [0.0, 0.0, 3.0],
                ..PLAIN
            },
            0.07,
        ),
        (
            "on its side",
            Scene {
                turn: [0.3, 0.0, 1.5],
                shift: [0.0, 0.0, 0.4],
                ..PLAIN
            },
            0.07,
        ),
        // Beyond a narrow margin the backing closes in on the outer squares: almost crossings.
        (
            "on a backing board",
            Scene {
                margin: 0.2,
                ..PLAIN
            },
            0.06,
        ),
        (
            "far",
            Scene {
                shift: [0.1, 0.05, 0.8],
                ..PLAIN
            },
            0.08,
        ),
    ];
    let mut wrong = Vec::new();
    for (n, (name, scene, limit_px)) in scenes.into_iter().enumerate() {
        let (rms, worst) = errors(&scene, BOARD, n as u64);
        println!("{name}: {rms:.4} px rms, {worst:.4} px worst");
        if rms >= limit_px {
            wrong.push(format!("{name}: {rms} px"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:?}");
}

/// Both numbers odd: the board looks the same upside down, and the upper left end is the origin.
#[test]
fn a_board_with_two_like_ends_starts_at_the_upper_left() {
    let board = Chessboard {
        columns: 7,
        rows: 5,
    };
    for turn in [0.1, 3.1] {
        let scene = Scene {
            turn: [0.2, 0.1, turn],
            ..PLAIN
        };
        let corners = find_chessboard(&render(&scene, board, 5), board).unwrap();
        let (first, last) = (corners[0].pixel_px, corners[34].pixel_px);
        assert!(first.x + first.y < last.x + last.y, "{turn}");
    }
}

#[test]
fn what_is_not_the_board_is_not_taken_for_it() {
    let image = render(&PLAIN, BOARD, 1);
    for board in [
        Chessboard {
            columns: 8,
            rows: 6,
        },
        Chessboard {
            columns: 10,
            rows: 6,
        },
    ] {
        let refused = find_chessboard(&image, board);
        assert!(
            matches!(refused, Err(BoardError::Incomplete { .. })),
            "{refused:?}"
        );
    }
    let cut = Scene {
        shift: [0.15, 0.0, 0.35],
        ..PLAIN
    };
    assert!(find_chessboard(&render(&cut, BOARD, 1), BOARD).is_err());
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let noise = (0..640 * 480).map(|_| random.random::<u8>()).collect();
    let noise = Image8::from_raw(640, 480, noise).unwrap();
    assert!(find_chessboard(&noise, BOARD).is_err());
    let flat = Image8::from_raw(640, 480, vec![90; 640 * 480]).unwrap();
    assert!(find_chessboard(&flat, BOARD).is_err());
    let tiny = Image8::from_raw(3, 3, vec![90; 9]).unwrap();
    assert!(find_chessboard(&tiny, BOARD).is_err());
    let size = find_chessboard(
        &image,
        Chessboard {
            columns: 2,
            rows: 6,
        },
    );
    assert!(matches!(size, Err(BoardError::Size { .. })), "{size:?}");
}
