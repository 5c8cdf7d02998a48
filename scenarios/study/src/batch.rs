//! The paper's two-stage simulation for many error draws at once.
//!
//! No angle is ever needed: the inverse kinematics of this arm give sines and cosines of the joint
//! angles with square roots and divisions alone, and a model error is small, so its sine and
//! cosine are short series and the addition theorems do the rest. The loops run over the draws of
//! one target, have no branch and no call, and the compiler turns them into vector code; where the
//! processor has AVX2 a second copy of the same source, compiled for it, is taken. Both copies do
//! the same IEEE operations and so give the same bits.
//!
//! Inverse and forward kinematics are loops of their own: each is a chain of operations that wait
//! for one another, and in a short loop the processor works at several draws at once.

use super::draws::fill_normals;
use super::workspace::{CAMERA_CENTRE_M, ERRORS, JOINTS, ROWS, TOOL_M};
use nalgebra::{Unit, Vector3};
use rover_kinematics::AxisGoal;

/// Draws that are computed together; small enough for the first-level cache.
const BLOCK: usize = 56;
/// Errors that are reported for each draw: before, and after one, two and three corrections.
pub const STAGES: usize = 4;

/// One target as the kernel needs it.
#[derive(Clone, Debug)]
pub struct BatchTarget {
    point: [f64; 3],
    axis: [f64; 3],
    /// Sign of sin(theta_3) and of sin(theta_5) in the posture taken.
    elbow: f64,
    wrist: f64,
}

impl BatchTarget {
    /// A goal with the joint angles that reach it, whose posture is kept for the corrected goals.
    pub fn new(goal: &AxisGoal, joints_rad: &[f64]) -> Self {
        let sign = |joint: usize| joints_rad.get(joint).map_or(1.0, |q| q.sin().signum());
        let vector = |v: &Vector3<f64>| [v.x, v.y, v.z];
        Self {
            point: vector(&goal.point),
            axis: vector(&Unit::into_inner(goal.axis)),
            elbow: sign(2),
            wrist: sign(4),
        }
    }
}

/// Errors of one target, m: `errors[stage][draw]`.
#[derive(Clone, Debug, Default)]
pub struct BatchErrors {
    /// For each stage one number per draw.
    pub errors_m: [Vec<f32>; STAGES],
}

/// Sine and cosine of the five joint angles.
type Turns = ([f64; JOINTS], [f64; JOINTS]);

/// Joint angles that put the believed tip on `p`.
#[inline(always)]
fn inverse(p: [f64; 3], n: &[f64; 3], elbow: f64, wrist: f64) -> Turns {
    let [[a1, d1, _], [a2, ..], [a3, ..], [_, d4, _], [_, d5, _]] = ROWS;
    let w = [
        p[0] - TOOL_M * n[0],
        p[1] - TOOL_M * n[1],
        p[2] - TOOL_M * n[2],
    ];
    let rho2 = w[0] * w[0] + w[1] * w[1];
    let h = (rho2 - d4 * d4).sqrt();
    let inv = 1.0 / rho2;
    let c1 = (w[0] * h - w[1] * d4) * inv;
    let s1 = (w[1] * h + w[0] * d4) * inv;
    let c5 = n[0] * s1 - n[1] * c1;
    let radial = n[0] * c1 + n[1] * s1;
    let s5 = wrist * (radial * radial + n[2] * n[2]).sqrt();
    let inv = 1.0 / s5;
    let (c234, s234) = (radial * inv, n[2] * inv);
    let r = h - a1 + d5 * s234;
    let z = w[2] - d1 - d5 * c234;
    let reach2 = r * r + z * z;
    let c3 = (reach2 - (a2 * a2 + a3 * a3)) * (1.0 / (2.0 * a2 * a3));
    let s3 = elbow * (1.0 - c3 * c3).sqrt();
    let (k1, k2) = (a2 + a3 * c3, a3 * s3);
    let inv = 1.0 / reach2;
    let c2 = (k1 * r + k2 * z) * inv;
    let s2 = (k1 * z - k2 * r) * inv;
    let (c23, s23) = (c2 * c3 - s2 * s3, s2 * c3 + c2 * s3);
    let c4 = c234 * c23 + s234 * s23;
    let s4 = s234 * c23 - c234 * s23;
    ([s1, s2, s3, s4, s5], [c1, c2, c3, c4, c5])
}

/// Sine and cosine of an error of at most a few degrees, to 1e-16 below 0.12 rad.
#[inline(always)]
fn small(e: f64) -> (f64, f64) {
    let z = e * e;
    let sine = e * (1.0 + z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0))));
    let cosine = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0))));
    (sine, cosine)
}

/// Sines and cosines of the joint angles of a block's draws.
struct Joints {
    sine: [[f64; BLOCK]; JOINTS],
    cosine: [[f64; BLOCK]; JOINTS],
}

/// What the draws of a block make of arm and cameras: one array of draws for each quantity.
struct Drawn {
    /// Sine and cosine of the joint angles' errors.
    theta: [[[f64; BLOCK]; 2]; JOINTS],
    /// Sine and cosine of the true twists.
    alpha: [[[f64; BLOCK]; 2]; JOINTS],
    a: [[f64; BLOCK]; JOINTS],
    d: [[f64; BLOCK]; JOINTS],
    rotation: [[f64; BLOCK]; 9],
    translation: [[f64; BLOCK]; 3],
}

#[inline(always)]
fn prepare(
    e: &[[f32; BLOCK]; ERRORS],
    n: usize,
    (angle, length): (f64, f64),
    twist: &Turns,
    drawn: &mut Drawn,
) {
    let n = n.min(BLOCK);
    for j in 0..JOINTS {
        let (sine, cosine) = (twist.0[j], twist.1[j]);
        let (a, d) = (ROWS[j][0], ROWS[j][1]);
        for i in 0..n {
            (drawn.theta[j][0][i], drawn.theta[j][1][i]) = small(angle * f64::from(e[4 * j][i]));
        }
        for i in 0..n {
            drawn.d[j][i] = d + length * f64::from(e[4 * j + 1][i]);
            drawn.a[j][i] = a + length * f64::from(e[4 * j + 2][i]);
        }
        for i in 0..n {
            let (s, c) = small(angle * f64::from(e[4 * j + 3][i]));
            drawn.alpha[j][0][i] = sine * c + cosine * s;
            drawn.alpha[j][1][i] = cosine * c - sine * s;
        }
    }
    for i in 0..n {
        // Rodrigues with the series of sin(w)/w and (1 - cos(w))/w^2.
        let x = angle * f64::from(e[20][i]);
        let y = angle * f64::from(e[21][i]);
        let z = angle * f64::from(e[22][i]);
        let w2 = x * x + y * y + z * z;
        let f = 1.0 + w2 * (-1.0 / 6.0 + w2 * (1.0 / 120.0 - w2 * (1.0 / 5040.0)));
        let g = 0.5 + w2 * (-1.0 / 24.0 + w2 * (1.0 / 720.0 - w2 * (1.0 / 40_320.0)));
        let (xy, xz, yz) = (g * x * y, g * x * z, g * y * z);
        let r = &mut drawn.rotation;
        r[0][i] = 1.0 - g * (w2 - x * x);
        r[1][i] = xy - f * z;
        r[2][i] = xz + f * y;
        r[3][i] = xy + f * z;
        r[4][i] = 1.0 - g * (w2 - y * y);
        r[5][i] = yz - f * x;
        r[6][i] = xz - f * y;
        r[7][i] = yz + f * x;
        r[8][i] = 1.0 - g * (w2 - z * z);
    }
    for k in 0..3 {
        for i in 0..n {
            drawn.translation[k][i] = length * f64::from(e[23 + k][i]) + CAMERA_CENTRE_M[k];
        }
    }
}

/// A point of link `j` as link `j - 1` has it, for draw `i`.
#[inline(always)]
fn down(p: [f64; 3], j: usize, q: &Joints, drawn: &Drawn, i: usize) -> [f64; 3] {
    let (sa, ca) = (drawn.alpha[j][0][i], drawn.alpha[j][1][i]);
    let x = p[0] + drawn.a[j][i];
    let y = ca * p[1] - sa * p[2];
    let z = sa * p[1] + ca * p[2] + drawn.d[j][i];
    turned([x, y, z], j, q, drawn, i)
}

/// A point turned by joint `j` of the true arm, for draw `i`.
#[inline(always)]
fn turned([x, y, z]: [f64; 3], j: usize, q: &Joints, drawn: &Drawn, i: usize) -> [f64; 3] {
    let (se, ce) = (drawn.theta[j][0][i], drawn.theta[j][1][i]);
    let (sq, cq) = (q.sine[j][i], q.cosine[j][i]);
    let s = sq * ce + cq * se;
    let c = cq * ce - sq * se;
    [c * x - s * y, s * x + c * y, z]
}

/// Where the cameras see the tip of the true arm at these joint angles, for draw `i`.
#[inline(always)]
fn seen(q: &Joints, drawn: &Drawn, i: usize) -> [f64; 3] {
    // Written out so that the loop over draws remains the innermost one.
    let p = turned(
        [
            drawn.a[4][i],
            -drawn.alpha[4][0][i] * TOOL_M,
            drawn.alpha[4][1][i] * TOOL_M + drawn.d[4][i],
        ],
        4,
        q,
        drawn,
        i,
    );
    let p = down(p, 3, q, drawn, i);
    let p = down(p, 2, q, drawn, i);
    let p = down(p, 1, q, drawn, i);
    let p = down(p, 0, q, drawn, i);
    let x = p[0] - CAMERA_CENTRE_M[0];
    let y = p[1] - CAMERA_CENTRE_M[1];
    let z = p[2] - CAMERA_CENTRE_M[2];
    let (r, t) = (&drawn.rotation, &drawn.translation);
    [
        r[0][i] * x + r[1][i] * y + r[2][i] * z + t[0][i],
        r[3][i] * x + r[4][i] * y + r[5][i] * z + t[1][i],
        r[6][i] * x + r[7][i] * y + r[8][i] * z + t[2][i],
    ]
}

/// Joint angles for the commands of `n` draws.
#[inline(always)]
fn solve(commands: &[[f64; BLOCK]; 3], n: usize, target: &BatchTarget, joints: &mut Joints) {
    let [px, py, pz] = commands;
    let (sine, cosine) = (&mut joints.sine, &mut joints.cosine);
    for i in 0..n.min(BLOCK) {
        let p = [px[i], py[i], pz[i]];
        let q = inverse(p, &target.axis, target.elbow, target.wrist);
        for j in 0..JOINTS {
            sine[j][i] = q.0[j];
            cosine[j][i] = q.1[j];
        }
    }
}

/// The errors of the present joint angles of `n` draws, and the next commands
/// `p <- p - (seen - target)`, which is the target minus the whole error vector.
#[inline(always)]
fn correct(
    joints: &Joints,
    n: usize,
    target: &BatchTarget,
    drawn: &Drawn,
    commands: &mut [[f64; BLOCK]; 3],
    out: &mut [f32; BLOCK],
) {
    let [px, py, pz] = commands;
    let goal = target.point;
    for i in 0..n.min(BLOCK) {
        let at = seen(joints, drawn, i);
        let (x, y, z) = (at[0] - goal[0], at[1] - goal[1], at[2] - goal[2]);
        out[i] = (x * x + y * y + z * z).sqrt() as f32;
        px[i] -= x;
        py[i] -= y;
        pz[i] -= z;
    }
}

/// What a block works in, kept from one to the next.
struct Scratch {
    normals: [[f32; BLOCK]; ERRORS],
    drawn: Drawn,
    joints: Joints,
    commands: [[f64; BLOCK]; 3],
    errors: [[f32; BLOCK]; STAGES],
}

impl Scratch {
    fn new() -> Self {
        Self {
            normals: [[0.0; BLOCK]; ERRORS],
            drawn: Drawn {
                theta: [[[0.0; BLOCK]; 2]; JOINTS],
                alpha: [[[0.0; BLOCK]; 2]; JOINTS],
                a: [[0.0; BLOCK]; JOINTS],
                d: [[0.0; BLOCK]; JOINTS],
                rotation: [[0.0; BLOCK]; 9],
                translation: [[0.0; BLOCK]; 3],
            },
            joints: Joints {
                sine: [[0.0; BLOCK]; JOINTS],
                cosine: [[0.0; BLOCK]; JOINTS],
            },
            commands: [[0.0; BLOCK]; 3],
            errors: [[0.0; BLOCK]; STAGES],
        }
    }
}

/// The random numbers of a block of `n` draws; those of one kind lie together.
#[inline(always)]
fn fill(key: u64, counter: u32, n: usize, normals: &mut [[f32; BLOCK]; ERRORS]) {
    let n = n.min(BLOCK);
    for (pair, rows) in normals.chunks_exact_mut(2).enumerate() {
        let [first, second] = rows else { continue };
        let at = counter.wrapping_add((pair * 2 * BLOCK) as u32);
        fill_normals(key, at, &mut first[..n], &mut second[..n]);
    }
}

/// Where the random numbers of the block that begins with this draw begin in their stream.
fn counter(first_draw: usize) -> u32 {
    (first_draw * ERRORS) as u32
}

/// A block of `n` draws, from the random numbers to the errors of all stages.
#[inline(always)]
fn block(
    (key, counter): (u64, u32),
    n: usize,
    target: &BatchTarget,
    sigma: (f64, f64),
    twist: &Turns,
    scratch: &mut Scratch,
) {
    fill(key, counter, n, &mut scratch.normals);
    prepare(&scratch.normals, n, sigma, twist, &mut scratch.drawn);
    let Scratch {
        drawn,
        joints,
        commands,
        errors,
        ..
    } = scratch;
    for (command, goal) in commands.iter_mut().zip(target.point) {
        command.fill(goal);
    }
    // The first command is the target itself, the same for all draws.
    let (sine, cosine) = inverse(target.point, &target.axis, target.elbow, target.wrist);
    for j in 0..JOINTS {
        joints.sine[j].fill(sine[j]);
        joints.cosine[j].fill(cosine[j]);
    }
    for (stage, errors) in errors.iter_mut().enumerate() {
        if stage > 0 {
            solve(commands, n, target, joints);
        }
        correct(joints, n, target, drawn, commands, errors);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn block_avx2(
    stream: (u64, u32),
    n: usize,
    target: &BatchTarget,
    sigma: (f64, f64),
    twist: &Turns,
    scratch: &mut Scratch,
) {
    block(stream, n, target, sigma, twist, scratch);
}

/// Computes batches of draws, one after the other.
pub struct Batch {
    scratch: Box<Scratch>,
    twist: Turns,
}

impl Default for Batch {
    fn default() -> Self {
        Self {
            scratch: Box::new(Scratch::new()),
            twist: (
                ROWS.map(|r| r[2].sin()),
                // The twists are whole quarter turns; their cosine has no business being 6e-17.
                ROWS.map(|r| if r[2] == 0.0 { 1.0 } else { 0.0 }),
            ),
        }
    }
}

impl Batch {
    /// The errors of `trials` independent draws of all 26 model errors at one target; `key` names
    /// the stream of draws, `angle_rad` and `length_m` are the standard deviations.
    pub fn trials(
        &mut self,
        key: u64,
        trials: usize,
        target: &BatchTarget,
        angle_rad: f64,
        length_m: f64,
    ) -> BatchErrors {
        let mut result = BatchErrors {
            errors_m: std::array::from_fn(|_| Vec::with_capacity(trials)),
        };
        let (scratch, twist) = (&mut *self.scratch, &self.twist);
        let sigma = (angle_rad, length_m);
        for first in (0..trials).step_by(BLOCK) {
            let stream = (key, counter(first));
            let kept = (trials - first).min(BLOCK);
            // Whole vectors: the surplus is dropped.
            let n = kept.next_multiple_of(8).min(BLOCK);
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has AVX2.
                unsafe { block_avx2(stream, n, target, sigma, twist, scratch) };
            } else {
                block(stream, n, target, sigma, twist, scratch);
            }
            #[cfg(not(target_arch = "x86_64"))]
            block(stream, n, target, sigma, twist, scratch);
            for (errors, block) in result.errors_m.iter_mut().zip(&scratch.errors) {
                errors.extend_from_slice(&block[..kept]);
            }
        }
        result
    }
}

/// The 26 standard normal numbers of one draw of [`Batch::trials`], for checks against other code.
#[cfg(test)]
pub fn draw(key: u64, trial: usize) -> [f64; ERRORS] {
    let mut normals = [[0.0; BLOCK]; ERRORS];
    fill(key, counter(trial / BLOCK * BLOCK), BLOCK, &mut normals);
    normals.map(|of_all| f64::from(of_all[trial % BLOCK]))
}
