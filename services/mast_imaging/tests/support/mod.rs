//! A robot's hardware and imaging, faked: a textured plane as the believed cameras see it.

#![allow(dead_code, missing_docs)]

use nalgebra::Vector2;
use rover_bus::{NetworkConfig, Peer, Presence, Role, Served, Stream};
use rover_cameras::Camera;
use rover_messages::{
    Fault,
    arm::{ArmState, Motion},
    imaging::{CaptureRequest, ImageData, RawPair, StereoFrame},
    keys,
};
use rover_robot::{CameraPairDescription, Robot};
use std::{sync::Arc, time::Duration};

/// Longer than anything takes; reached only when something is wrong.
pub const LONG: Duration = Duration::from_secs(120);
/// Height of the plane, rover frame, m.
pub const GROUND_M: f64 = 0.38;
/// Where the plane has no texture: y, rover frame, m.
pub const BARE_Y_M: std::ops::Range<f64> = 0.12..0.24;

pub fn bluestreak() -> Arc<Robot> {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scenarios/robots/bluestreak.toml"
    );
    Arc::new(Robot::read(std::path::Path::new(path)).unwrap())
}

/// The pixel of the pair's left image at which a place of the plane is seen.
pub fn pixel_of(robot: &Robot, x: f64, y: f64) -> [f64; 2] {
    let camera = &robot.pair("body").unwrap().cameras.left;
    camera
        .project(&nalgebra::Vector3::new(x, y, GROUND_M))
        .unwrap()
        .into()
}

/// Smooth noise with features of `size_m`, 0 to 1.
fn noise(x: f64, y: f64, size_m: f64) -> f64 {
    let (x, y) = (x / size_m, y / size_m);
    let (i, j) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (smooth(x - i), smooth(y - j));
    let hash = |a: f64, b: f64| {
        let mut h = (a as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (b as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        ((h ^ (h >> 32)) & 0xffff) as f64 / 65535.0
    };
    let row = |b: f64| hash(i, b) * (1.0 - u) + hash(i + 1.0, b) * u;
    row(j) * (1.0 - v) + row(j + 1.0) * v
}

fn grey(x: f64, y: f64) -> f64 {
    if BARE_Y_M.contains(&y) {
        return 120.0;
    }
    40.0 + 170.0 * (0.6 * noise(x, y, 0.015) + 0.4 * noise(x + 3.1, y - 1.7, 0.04))
}

fn picture(camera: &Camera) -> ImageData {
    let (width_px, height_px) = (camera.width_px, camera.height_px);
    let mut pixels = Vec::with_capacity((width_px * height_px) as usize);
    for v in 0..height_px {
        for u in 0..width_px {
            let ray = camera
                .ray(&Vector2::new(f64::from(u), f64::from(v)))
                .unwrap();
            let range = (GROUND_M - ray.origin.z) / ray.direction.z;
            let seen = if range > 0.0 && range < 5.0 {
                let p = ray.at(range);
                grey(p.x, p.y)
            } else {
                220.0
            };
            pixels.push(seen.round() as u8);
        }
    }
    ImageData {
        width_px,
        height_px,
        pixels,
    }
}

pub fn raw_pair(pair: &CameraPairDescription) -> RawPair {
    RawPair {
        pair: pair.name.clone(),
        sim_time_s: 1.5,
        step: 750,
        left: picture(&pair.cameras.left),
        right: picture(&pair.cameras.right),
        mast: None,
        wheels: None,
    }
}

pub fn arm_at(joints_rad: &[f64]) -> ArmState {
    ArmState {
        sim_time_s: 1.5,
        step: 750,
        joints_rad: joints_rad.to_vec(),
        rates_rad_s: vec![0.0; joints_rad.len()],
        contact: false,
        switch_travel_m: 0.0,
        tip_force_n: 0.0,
        motion: Motion::Idle,
        stop_reason: None,
    }
}

/// A peer connected to all `others`.
pub async fn peer(robot: &Robot, name: &str, role: Role, others: &[&Peer]) -> Peer {
    let mut connect = Vec::new();
    for other in others {
        connect.extend(other.locators().await);
    }
    Peer::open(NetworkConfig::new(robot.name(), name, role, &connect))
        .await
        .unwrap()
}

/// Arm at rest in `posture`, cameras, and the frames that the imaging service would make of them.
pub struct FakeHardware {
    pub peer: Peer,
    pub arm: Stream<ArmState>,
    _served: Vec<Served>,
    _presence: Presence,
}

impl FakeHardware {
    /// `grab` changes what the cameras send.
    pub async fn start(
        robot: &Robot,
        posture: &str,
        with_imaging: bool,
        grab: impl Fn(CaptureRequest, RawPair) -> Result<RawPair, Fault> + Clone + Send + Sync + 'static,
    ) -> Self {
        let peer = peer(robot, keys::service::HARDWARE, Role::Simulator, &[]).await;
        let arm = peer.stream(keys::ARM_STATE).await.unwrap();
        arm.publish(arm_at(robot.posture(posture).unwrap()))
            .unwrap();
        let mut served = Vec::new();
        for pair in &robot.description().cameras {
            let raw = raw_pair(pair);
            if with_imaging {
                let frame = StereoFrame {
                    images: raw.clone(),
                    cameras: pair.cameras.clone(),
                };
                let key = keys::imaging_capture(&pair.name);
                let capture = peer.serve(&key, move |_: CaptureRequest| {
                    let frame = frame.clone();
                    async move { Ok(frame) }
                });
                served.push(capture.await.unwrap());
            }
            let grab = grab.clone();
            let key = keys::camera_grab(&pair.name);
            let grabbed = peer.serve(&key, move |request: CaptureRequest| {
                let answer = grab(request, raw.clone());
                async move { answer }
            });
            served.push(grabbed.await.unwrap());
        }
        let presence = peer.announce().await.unwrap();
        Self {
            peer,
            arm,
            _served: served,
            _presence: presence,
        }
    }
}
