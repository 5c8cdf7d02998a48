//! The imaging service on a real network, with faked cameras.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

mod support;

use rover_bus::{BusError, Role};
use rover_mast_imaging::{attach_models, serve};
use rover_messages::{
    Fault,
    imaging::{CaptureRequest, FrameReference, StereoFrame},
    keys::{self, service::MAST_IMAGING},
    status::{FaultReport, ServiceStatus},
};
use support::{FakeHardware, LONG, bluestreak, peer, raw_pair};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_capture_is_the_raw_pair_with_its_models_and_can_be_looked_at() {
    let robot = bluestreak();
    let hardware = FakeHardware::start(&robot, "stow", false, |request, mut pair| {
        match request.exposure_n {
            7 => pair.left.width_px = 320,
            8 => pair.pair = "mast".into(),
            9 => return Err(Fault::new("rover_sim", "camera_dead", "no power")),
            n => pair.step += u64::from(n),
        }
        if request.exposure_n == 7 {
            pair.left.pixels.truncate(320 * 480);
        }
        Ok(pair)
    })
    .await;
    let imaging = peer(&robot, MAST_IMAGING, Role::Service, &[&hardware.peer]).await;
    let _service = serve(&imaging, robot.clone()).await.unwrap();
    let client = peer(&robot, "client", Role::Client, &[&imaging]).await;
    client.await_presence(&[MAST_IMAGING], LONG).await.unwrap();
    let capture = async |exposure_n| -> Result<StereoFrame, BusError> {
        client
            .ask(
                &keys::imaging_capture("body"),
                &CaptureRequest { exposure_n },
                LONG,
            )
            .await
    };

    let frame = capture(2).await.unwrap();
    let expected = raw_pair(robot.pair("body").unwrap());
    assert_eq!(frame.images.left, expected.left);
    assert_eq!(frame.images.step, expected.step + 2);
    assert_eq!(frame.cameras, robot.pair("body").unwrap().cameras);

    let key = format!("{}/imaging/body/left", robot.name());
    let replies = client.session().get("imaging/body/left").await.unwrap();
    let reply = replies.recv_async().await.unwrap();
    let sample = reply.result().unwrap_or_else(|e| panic!("{key}: {e:?}"));
    assert_eq!(sample.encoding().to_string(), "image/png");
    assert_eq!(&sample.payload().to_bytes()[..8], b"\x89PNG\r\n\x1a\n");

    let reference = |step| FrameReference {
        pair: "body".into(),
        step,
        exposure_n: 2,
    };
    let recall = async |step| -> Result<StereoFrame, BusError> {
        client
            .ask(&keys::imaging_recall("body"), &reference(step), LONG)
            .await
    };
    assert_eq!(recall(frame.images.step).await.unwrap(), frame);
    let error = recall(1).await.unwrap_err();
    assert_eq!(error.fault_name(), Some("frame_forgotten"), "{error}");

    for (exposure_n, name) in [
        (7, "wrong_image_size"),
        (8, "wrong_pair"),
        (9, "camera_dead"),
    ] {
        let error = capture(exposure_n).await.unwrap_err();
        assert_eq!(error.fault_name(), Some(name), "{error}");
    }
    let status: ServiceStatus = client
        .latest(&keys::status(MAST_IMAGING), LONG)
        .await
        .unwrap();
    assert_eq!(status.counters["frames"], 1);
    assert_eq!(status.counters["faults"], 4);
    assert_eq!(status.configuration_sha256, robot.configuration_sha256());
    let report: FaultReport = client
        .latest(&keys::fault(MAST_IMAGING), LONG)
        .await
        .unwrap();
    assert_eq!(
        (report.fault.name.as_str(), report.action.as_str()),
        ("camera_dead", "query refused")
    );
}

#[test]
fn a_frame_of_another_size_names_both_sizes() {
    let robot = bluestreak();
    let pair = robot.pair("body").unwrap();
    let mut raw = raw_pair(pair);
    raw.right.height_px = 479;
    let fault = attach_models(raw, &robot, pair).unwrap_err();
    assert_eq!(fault.name, "wrong_image_size");
    assert!(
        fault.message.contains("640x479") && fault.message.contains("640x480"),
        "{fault}"
    );
    assert_eq!(fault.details["expected_height_px"], 480.0);
}

#[test]
fn a_mast_pair_is_placed_by_the_mast_angles_at_the_exposure() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scenarios/robots/rocky8.toml"
    );
    let robot = rover_robot::Robot::read(std::path::Path::new(path)).unwrap();
    let pair = robot.pair("mast").unwrap();
    let black = || rover_messages::imaging::ImageData {
        width_px: 1024,
        height_px: 768,
        pixels: vec![0; 1024 * 768],
    };
    let mut raw = rover_messages::imaging::RawPair {
        pair: "mast".into(),
        sim_time_s: 1.0,
        step: 500,
        left: black(),
        right: black(),
        mast: None,
        wheels: None,
    };
    let fault = attach_models(raw.clone(), &robot, pair).unwrap_err();
    assert_eq!(fault.name, "no_mast_angles", "{fault}");
    let point = nalgebra::Vector3::new(4.0, 1.0, 0.1);
    let [pan_rad, tilt_rad] = robot.mast().unwrap().angles_towards(&point.into()).unwrap();
    let mut mast = rover_messages::mobility::MastState {
        sim_time_s: 1.0,
        step: 500,
        pan_rad,
        tilt_rad,
        moving: false,
    };
    raw.mast = Some(mast.clone());
    let frame = attach_models(raw.clone(), &robot, pair).unwrap();
    let [left, right] =
        [&frame.cameras.left, &frame.cameras.right].map(|c| c.project(&point).unwrap());
    // Pointed at, the point lies in the middle between the two views.
    assert!(
        ((left.x + right.x) / 2.0 - 511.5).abs() < 1e-6,
        "{left} {right}"
    );
    mast.moving = true;
    raw.mast = Some(mast);
    let fault = attach_models(raw, &robot, pair).unwrap_err();
    assert_eq!(fault.name, "mast_moving", "{fault}");
}
