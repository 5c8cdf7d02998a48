//! Access control, network files, and failures to open.

use crate::support::*;
use rover_bus::{BusError, NetworkConfig, Peer, Role};
use rover_messages::{Nothing, codec::Format};
use std::{path::PathBuf, time::Duration};

fn shipped(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../scenarios/networks")
        .join(name)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn service_can_neither_read_nor_ask_nor_feed_the_simulators_own_keys() {
    let simulator = peer("acl", "rover_sim", Role::Simulator, &[]).await;
    let runner = peer("acl", "runner", Role::Runner, &[&simulator]).await;
    let service = peer("acl", "servo", Role::Service, &[&simulator, &runner]).await;
    let truth = simulator.stream::<Reading>("sim/truth/pose").await.unwrap();
    let open = simulator.stream::<Reading>("arm/state").await.unwrap();
    let _score = simulator
        .serve("sim/truth/score", |_: Nothing| async { Ok(Nothing {}) })
        .await;
    truth.publish(reading(1.0)).unwrap();
    open.publish(reading(2.0)).unwrap();
    // the runner may, the service may not
    let value: Reading = runner.latest("sim/truth/pose", LONG).await.unwrap();
    assert_eq!(value, reading(1.0));
    let _: Nothing = runner
        .ask("sim/truth/score", &Nothing {}, LONG)
        .await
        .unwrap();
    let value: Reading = service.latest("arm/state", LONG).await.unwrap();
    assert_eq!(value, reading(2.0));
    let limit = Duration::from_millis(200);
    let e = service
        .latest::<Reading>("sim/truth/pose", limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
    let e = service
        .ask::<_, Nothing>("sim/truth/score", &Nothing {}, limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
    // wildcards do not get around it, for questions or subscriptions
    let answers = get_all(service.session(), "**", None).await;
    assert!(
        answers.iter().any(|(key, _)| key == "arm/state"),
        "{answers:?}"
    );
    assert!(
        answers.iter().all(|(key, _)| !key.starts_with("sim")),
        "{answers:?}"
    );
    let mut everything = service.watch_raw("**", 100).await.unwrap();
    let mut everything_for_runner = runner.watch_raw("**", 100).await.unwrap();
    settle(&simulator, &service).await;
    settle(&simulator, &runner).await;
    truth.publish(reading(3.0)).unwrap();
    open.publish(reading(4.0)).unwrap();
    assert_eq!(soon(everything.next()).await.unwrap().key, "arm/state");
    assert_eq!(
        soon(everything_for_runner.next()).await.unwrap().key,
        "sim/truth/pose"
    );
    // nor can it pretend to be the simulator
    let forged = service.stream::<Reading>("sim/truth/forged").await.unwrap();
    let honest = service.stream::<Reading>("servo/status").await.unwrap();
    honest.publish(reading(6.0)).unwrap();
    settle(&service, &runner).await;
    forged.publish(reading(5.0)).unwrap();
    honest.publish(reading(7.0)).unwrap();
    let last = rover_messages::codec::encode(&reading(7.0), Format::Bincode).unwrap();
    let mut keys = Vec::new();
    loop {
        let sample = soon(everything_for_runner.next()).await.unwrap();
        keys.push(sample.key);
        if sample.payload == last {
            break;
        }
    }
    assert!(!keys.contains(&"sim/truth/forged".to_owned()), "{keys:?}");
    let e = runner
        .latest::<Reading>("sim/truth/forged", limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_reach_all_peers_of_a_mesh_through_one() {
    let a = peer("mesh", "a", Role::Service, &[]).await;
    let b = peer("mesh", "b", Role::Service, &[&a]).await;
    let c = peer("mesh", "c", Role::Service, &[&a, &b]).await;
    let client = peer("mesh", "client", Role::Client, &[&b]).await;
    let _presence = client.announce().await.unwrap();
    for (peer, key) in [(&a, "a/count"), (&b, "b/count"), (&c, "c/count")] {
        let _served = peer.serve_action(key, LOCKSTEP, count).await.unwrap();
        let goal = client.command(key, &CountGoal { to: 2 }).await.unwrap();
        let result: Counted = goal.finish(|_: &Counted| {}).await.unwrap();
        assert_eq!(result.n, 2);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn endpoint_that_nobody_listens_on_is_an_error() {
    let closed = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let nowhere = format!("tcp/{}", closed.local_addr().unwrap());
    drop(closed);
    for role in [Role::Client, Role::Service] {
        let config = NetworkConfig::new("nowhere", "a", role, std::slice::from_ref(&nowhere));
        let e = Peer::open(config).await.unwrap_err();
        assert!(matches!(&e, BusError::Open { .. }), "{e}");
        assert!(e.to_string().contains(&nowhere), "{e}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shipped_files_amount_to_the_defaults() {
    let with_file = |name: &str, file: &str, role, connect: &[String]| NetworkConfig {
        file: Some(shipped(file)),
        ..NetworkConfig::new("shipped", name, role, connect)
    };
    for (file, role, others) in [
        ("service.json5", Role::Service, vec![]),
        (
            "client.json5",
            Role::Client,
            vec!["tcp/127.0.0.1:1".to_owned()],
        ),
    ] {
        let from_file = with_file("a", file, role, &others).to_zenoh().unwrap();
        let config = NetworkConfig::new("shipped", "a", role, &others)
            .to_zenoh()
            .unwrap();
        for part in [
            "mode",
            "connect",
            "listen",
            "scouting",
            "transport",
            "adminspace",
            "timestamping",
            "namespace",
            "metadata",
        ] {
            let (found, expected) = (from_file.get_json(part), config.get_json(part));
            assert_eq!(found.unwrap(), expected.unwrap(), "{file}: {part}");
        }
    }
    let server = Peer::open(with_file("server", "service.json5", Role::Service, &[]))
        .await
        .unwrap();
    let client = with_file(
        "client",
        "client.json5",
        Role::Client,
        &server.locators().await,
    );
    let client = Peer::open(client).await.unwrap();
    let _served = serve_height(&server, "height/halve").await;
    let answer: Reading = client
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
    assert_eq!(client.namespace(), "shipped");
    // the file's access control speaks of namespace `rover`
    let simulator = peer("rover", "rover_sim", Role::Simulator, &[]).await;
    let _score = simulator
        .serve("sim/truth/score", |_: Nothing| async { Ok(Nothing {}) })
        .await;
    let service = NetworkConfig {
        namespace: String::new(),
        connect: simulator.locators().await,
        ..with_file("server", "service.json5", Role::Service, &[])
    };
    let service = Peer::open(service).await.unwrap();
    assert_eq!(service.namespace(), "rover");
    let limit = Duration::from_millis(100);
    let e = service
        .ask::<_, Nothing>("sim/truth/score", &Nothing {}, limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
}

#[test]
fn unreadable_file_is_named() {
    let config = NetworkConfig {
        file: Some("no/such/file.json5".into()),
        ..NetworkConfig::new("n", "a", Role::Service, &[])
    };
    let e = config.to_zenoh().unwrap_err().to_string();
    assert!(e.contains("no/such/file.json5"), "{e}");
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("typo.json5");
    std::fs::write(&path, "{ mode: \"peer\", scoutin: {} }").unwrap();
    let config = NetworkConfig {
        file: Some(path),
        ..config
    };
    let e = config.to_zenoh().unwrap_err().to_string();
    assert!(e.contains("typo.json5") && e.contains("scoutin"), "{e}");
}

/// The shipped pattern with the test's certificates and a free loopback port.
fn secure(directory: &std::path::Path, name: &str) -> PathBuf {
    let certificates = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/bus/certificates");
    let text = std::fs::read_to_string(shipped("secure.json5")).unwrap();
    let text = text
        .replace("/etc/rover/tls/rover.", &format!("/etc/rover/tls/{name}."))
        .replace("/etc/rover/tls", certificates.to_str().unwrap())
        .replace("tls/192.0.2.10:7447", "tls/127.0.0.1:0");
    let path = directory.join(format!("{name}.json5"));
    std::fs::write(&path, text).unwrap();
    path
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn shipped_secure_network_lets_everybody_do_what_his_certificate_says() {
    let directory = tempfile::tempdir().unwrap();
    let open = async |name: &str, certificate: &str, connect: &[String]| {
        let config = NetworkConfig {
            file: Some(secure(directory.path(), certificate)),
            ..NetworkConfig::new("", name, Role::Service, connect)
        };
        Peer::open(config).await
    };
    let robot = open("server", "rover", &[]).await.unwrap();
    let at = robot.locators().await;
    assert!(at[0].starts_with("tls/127.0.0.1:"), "{at:?}");
    let _served = serve_height(&robot, "height/halve").await;
    let state = robot.stream::<Reading>("arm/state").await.unwrap();
    state.publish(reading(2.0)).unwrap();
    let limit = Duration::from_millis(200);

    let operator = open("operator", "operator", &at).await.unwrap();
    let answer: Reading = operator
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
    let viewer = open("viewer", "viewer", &at).await.unwrap();
    let value: Reading = viewer.latest("arm/state", LONG).await.unwrap();
    assert_eq!(value, reading(2.0));
    let e = viewer
        .ask::<_, Reading>("height/halve", &reading(3.0), limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");

    // without a certificate, or without encryption, there is no link at all
    let plain = vec![at[0].replace("tls/", "tcp/")];
    let e = Peer::open(NetworkConfig::new("rover", "x", Role::Client, &plain))
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::Open { .. }), "{e}");
    let e = Peer::open(NetworkConfig::new("rover", "x", Role::Client, &at))
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::Open { .. }), "{e}");
}
