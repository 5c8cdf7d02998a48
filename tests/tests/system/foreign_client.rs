//! A plain Zenoh client in client mode that knows only what `ARCHITECTURE.md` says: JSON in, JSON
//! out, no code of ours on its side.

use crate::command::ROVER;
use serde_json::{Value, json};
use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    time::Duration,
};
use zenoh::{Session, query::ConsolidationMode};

/// `rover up` on a free port; stopped when dropped.
struct Up {
    child: Child,
    endpoint: String,
}

impl Up {
    fn start() -> Self {
        let mut child = Command::new(ROVER)
            .args([
                "up",
                "scenarios/bluestreak.toml",
                "--listen",
                "tcp/127.0.0.1:0",
            ])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        let mut lines = output.lines();
        let endpoint = lines
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| {
                line.split_whitespace()
                    .find(|w| w.starts_with("tcp/"))
                    .map(str::to_owned)
            })
            .expect("rover up names its endpoint");
        Self { child, endpoint }
    }
}

impl Drop for Up {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

async fn client(endpoint: &str) -> Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).await.unwrap()
}

/// One question; the answer or the refusal as JSON.
async fn ask(session: &Session, key: &str, payload: Option<Vec<u8>>) -> Result<Value, Value> {
    let mut get = session
        .get(format!("bluestreak/{key}"))
        .consolidation(ConsolidationMode::None)
        .timeout(Duration::from_secs(120));
    if let Some(payload) = payload {
        get = get.payload(payload).encoding("application/json");
    }
    let replies = get.await.unwrap();
    let reply = replies
        .recv_async()
        .await
        .unwrap_or_else(|_| panic!("{key} does not answer"));
    let parse = |bytes: &[u8]| serde_json::from_slice(bytes).expect("JSON");
    match reply.result() {
        Ok(sample) => Ok(parse(&sample.payload().to_bytes())),
        Err(error) => Err(parse(&error.payload().to_bytes())),
    }
}

async fn tell(session: &Session, key: &str, question: Value) -> Result<Value, Value> {
    ask(session, key, Some(question.to_string().into_bytes())).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_in_json_reads_selects_and_commands_and_mistakes_harm_nobody() {
    let up = Up::start();
    let session = client(&up.endpoint).await;

    let state = ask(&session, "arm/state", None).await.unwrap();
    assert_eq!(state["joints_rad"].as_array().unwrap().len(), 5, "{state}");

    // Mistakes first: each is answered with a fault that has a name, and all goes on.
    let huge = vec![b' '; 17 << 20];
    for key in [
        "target/select",
        "planner/plan",
        "servo/place",
        "servo/place/beat",
        "arm/execute",
    ] {
        let fault = ask(&session, key, Some(b"{\"pair\": 3".to_vec()))
            .await
            .unwrap_err();
        assert_eq!(fault["name"], "bad_payload", "{key}: {fault}");
        let unknown = tell(&session, key, json!({"colour": "red"}))
            .await
            .unwrap_err();
        assert_eq!(unknown["name"], "bad_payload", "{key}: {unknown}");
    }
    if let Err(fault) = ask(&session, "target/select", Some(huge)).await {
        assert_eq!(fault["name"], "payload_too_large", "{fault}");
    }
    let session = client(&up.endpoint).await;
    let nowhere = json!({"pair": "tail", "pixel_px": [1.0, 1.0]});
    let fault = tell(&session, "target/select", nowhere).await.unwrap_err();
    assert_eq!(fault["name"], "unknown_name", "{fault}");

    let scenario = rover::scenario::LoadedScenario::load("scenarios/bluestreak.toml", &[], None)
        .unwrap()
        .scenario;
    let pixel = scenario.target.pixel_px;
    let select = json!({"pair": "body", "pixel_px": pixel});
    let target = tell(&session, "target/select", select).await.unwrap();
    assert_eq!(
        target["position_m"].as_array().unwrap().len(),
        3,
        "{target}"
    );
    let current = ask(&session, "target/current", None).await.unwrap();
    assert_eq!(current, target);

    let goal = json!({
        "target": target,
        "stations_m": [0.15, 0.08, 0.04],
        "tolerance_m": 0.0005,
        "max_corrections_n": 4,
        "max_predicted_error_m": 0.01,
    });
    let order = |id: &str| json!({"goal_id": id, "commander": "visitor", "goal": goal});
    let absent = tell(&session, "servo/place", order("a")).await.unwrap_err();
    assert_eq!(absent["name"], "commander_absent", "{absent}");
    let _token = session
        .liveliness()
        .declare_token("bluestreak/presence/visitor")
        .await
        .unwrap();
    let accepted = tell(&session, "servo/place", order("b")).await.unwrap();
    assert_eq!(accepted["goal_id"], "b", "{accepted}");
    let second = tell(&session, "servo/place", order("c")).await.unwrap_err();
    assert_eq!(second["name"], "busy", "{second}");
    let mut seq = 0;
    let end = loop {
        seq += 1;
        let progress = tell(
            &session,
            "servo/place/beat",
            json!({"goal_id": "b", "seq": seq}),
        )
        .await
        .unwrap();
        let state = progress["state"].as_str().unwrap().to_owned();
        if state != "running" && state != "accepted" {
            break progress;
        }
    };
    assert_eq!(end["state"], "succeeded", "{end:#}");
    assert!(
        end["result"]["looks"]
            .as_array()
            .unwrap()
            .iter()
            .all(|l| l["found"] == true),
        "{end:#}"
    );
    let kept = tell(&session, "servo/place/result", json!({"goal_id": "b"}))
        .await
        .unwrap();
    assert_eq!(kept["result"], end["result"]);
    session.close().await.unwrap();
}
