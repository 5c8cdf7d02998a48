//! Target selection on a real network, with faked frames of a textured plane.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

#[path = "../../mast_imaging/tests/support/mod.rs"]
mod support;

use rover_bus::{BusError, Role};
use rover_geometry::Point;
use rover_messages::{
    keys::{self, service::TARGET_SELECTION},
    status::ServiceStatus,
    target::{SelectRequest, Target},
};
use rover_target_selection::serve;
use support::{FakeHardware, GROUND_M, LONG, bluestreak, peer, pixel_of};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pixel_becomes_a_target_or_a_refusal_with_numbers() {
    let robot = bluestreak();
    let hardware = FakeHardware::start(&robot, "stow", true, |_, pair| Ok(pair)).await;
    let selection = peer(&robot, TARGET_SELECTION, Role::Service, &[&hardware.peer]).await;
    let _service = serve(&selection, robot.clone()).await.unwrap();
    let client = peer(&robot, "client", Role::Client, &[&selection]).await;
    client
        .await_presence(&[TARGET_SELECTION], LONG)
        .await
        .unwrap();
    let select = async |pair: &str, pixel_px| -> Result<Target, BusError> {
        let request = SelectRequest {
            pair: pair.into(),
            pixel_px,
        };
        client.ask(keys::TARGET_SELECT, &request, LONG).await
    };

    let pixel_px = pixel_of(&robot, 0.55, -0.02);
    let target = select("body", pixel_px).await.unwrap();
    let truth = Point::new(0.55, -0.02, GROUND_M);
    assert!(
        target.position_m.distance(&truth) < 2e-3,
        "{:?}",
        target.position_m
    );
    assert!(target.normal.unit.z > 0.999, "{:?}", target.normal);
    assert_eq!(
        (target.pair.as_str(), target.pixel_px, target.sim_time_s),
        ("body", pixel_px, 1.5)
    );
    assert!(
        target.sigma_mm().iter().all(|s| *s > 0.0 && *s < 5.0),
        "{:?}",
        target.sigma_mm()
    );
    let right = robot
        .pair("body")
        .unwrap()
        .cameras
        .right
        .project(&truth.coords)
        .unwrap();
    let found = target.right_pixel_px;
    assert!((found[0] - right.x).hypot(found[1] - right.y) < 0.2);
    let current: Target = client.latest(keys::TARGET_CURRENT, LONG).await.unwrap();
    assert_eq!(current, target);

    let refusals = [
        ("body", [700.0, 20.0], "pixel_outside_image", "width_px"),
        (
            "body",
            pixel_of(&robot, 0.55, 0.18),
            "no_texture",
            "needed_dn",
        ),
        (
            "body",
            pixel_of(&robot, 0.95, -0.02),
            "out_of_reach",
            "beyond_reach_m",
        ),
        ("periscope", [320.0, 240.0], "unknown_name", ""),
    ];
    for (pair, pixel_px, name, number) in refusals {
        let Err(BusError::Fault(fault)) = select(pair, pixel_px).await else {
            panic!("{name}: expected a fault");
        };
        assert_eq!(fault.name, name, "{fault}");
        assert!(
            number.is_empty() || fault.details.contains_key(number),
            "{fault:?}"
        );
    }
    let kept: Target = client.latest(keys::TARGET_CURRENT, LONG).await.unwrap();
    assert_eq!(kept, target);
    let status: ServiceStatus = client
        .latest(&keys::status(TARGET_SELECTION), LONG)
        .await
        .unwrap();
    assert_eq!(status.state, "ready");
    assert_eq!(
        (status.counters["targets"], status.counters["faults"]),
        (1, 4)
    );
    assert_eq!(status.last_fault.unwrap().name, "unknown_name");
}
