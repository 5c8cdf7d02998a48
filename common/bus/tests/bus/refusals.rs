//! Bad payloads on every kind of key: a typed refusal, and the service lives on.

use crate::support::*;
use rover_bus::{Beat, CancelRequest, Goal, GoalRequest, ResultRequest};
use rover_messages::codec::{self, Format, MAX_PAYLOAD_BYTES};
use zenoh::Session;

const BINCODE: &str = "application/bincode";

/// Sends everything that can be wrong with a payload of `schema`; `good` is a valid one.
async fn abuse(raw: &Session, key: &str, schema: &str, good: Vec<u8>, limit: usize) {
    let mark = format!("{BINCODE};{schema}");
    let (name, version) = schema.rsplit_once('/').unwrap();
    let mut long = good.clone();
    long.push(0);
    let mut short = good.clone();
    short.pop();
    let cases: Vec<(&str, Vec<u8>, String, &str)> = vec![
        ("cut short", short, mark.clone(), "bad_payload"),
        ("byte too many", long, mark.clone(), "bad_payload"),
        ("no bytes", vec![], mark.clone(), "bad_payload"),
        ("noise", vec![0xFF; 64], mark.clone(), "bad_payload"),
        ("too large", vec![0; limit + 1], mark, "payload_too_large"),
        (
            "too large JSON",
            vec![b' '; limit + 1],
            "application/json".into(),
            "payload_too_large",
        ),
        (
            "version",
            good.clone(),
            format!("{BINCODE};{name}/{version}9"),
            "wrong_version",
        ),
        (
            "name",
            good.clone(),
            format!("{BINCODE};other/1"),
            "wrong_version",
        ),
        ("no schema", good.clone(), BINCODE.into(), "wrong_version"),
        (
            "no JSON",
            b"{\"goal_id\":".to_vec(),
            "application/json".into(),
            "bad_payload",
        ),
        (
            "other JSON",
            b"[1,2]".to_vec(),
            "application/json".into(),
            "bad_payload",
        ),
        (
            "unknown field",
            b"{\"colour\":1}".to_vec(),
            String::new(),
            "bad_payload",
        ),
        ("picture", good, "image/png".into(), "bad_payload"),
    ];
    for (what, payload, encoding, expected) in cases {
        let asked_in_bincode = encoding.starts_with(BINCODE);
        let answer = get(raw, key, payload, &encoding).await;
        let (_, mark) = answer.clone().expect_err(what);
        assert_eq!(
            mark.starts_with(BINCODE),
            asked_in_bincode,
            "{key}: {what}: {mark}"
        );
        let fault = fault_of(answer);
        assert_eq!(fault.name, expected, "{key}: {what}: {fault}");
        assert_eq!(fault.service, "server");
        assert!(
            fault.message.contains(key.split_once('/').unwrap().1),
            "{fault}"
        );
    }
}

fn binary<T: serde::Serialize>(value: &T) -> Vec<u8> {
    codec::encode_value(value, "", Format::Bincode).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_questions_are_refused_and_the_service_lives_on() {
    let (server, client, _presence) = pair("bad_query").await;
    let _served = serve_height(&server, "height/halve").await;
    let raw = foreigner(&server).await;
    let good = binary(&reading(1.0));
    abuse(
        &raw,
        "bad_query/height/halve",
        "reading/1",
        good,
        MAX_PAYLOAD_BYTES,
    )
    .await;
    let fault = get_json(
        &raw,
        "bad_query/height/halve",
        serde_json::json!({"height_m": 11.0, "label": ""}),
    )
    .await
    .unwrap_err();
    assert_eq!(
        fault.message,
        "height/halve: reading/1: height_m: 11, expected 0 to 10"
    );
    let answer: Reading = client
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn limit_of_a_key_holds() {
    let (server, client, _presence) = pair("limit").await;
    let _served = server
        .serve_limited("height/small", 30, |question: Reading| async move {
            Ok(question)
        })
        .await
        .unwrap();
    let _: Reading = client
        .ask("height/small", &reading(3.0), LONG)
        .await
        .unwrap();
    let long = Reading {
        height_m: 1.0,
        label: "x".repeat(30),
    };
    let e = client
        .ask::<_, Reading>("height/small", &long, LONG)
        .await
        .unwrap_err();
    assert_eq!(e.fault_name(), Some("payload_too_large"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_payloads_do_not_disturb_an_action() {
    let (server, client, _presence) = pair("bad_action").await;
    let _served = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let raw = foreigner(&server).await;
    let goal_id = || "commander-1".to_owned();
    let request = GoalRequest {
        goal_id: goal_id(),
        commander: "commander".into(),
        goal: CountGoal { to: 2 },
    };
    let goal_good = binary(&request);
    let key = "bad_action/count/up";
    abuse(
        &raw,
        key,
        "goal/1(count_goal/1)",
        goal_good.clone(),
        MAX_PAYLOAD_BYTES,
    )
    .await;
    let mut goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 2 })
        .await
        .unwrap();
    goal.beat().await.unwrap();
    abuse(
        &raw,
        key,
        "goal/1(count_goal/1)",
        goal_good,
        MAX_PAYLOAD_BYTES,
    )
    .await;
    let beat = binary(&Beat {
        goal_id: goal_id(),
        seq: 2,
    });
    abuse(&raw, "bad_action/count/up/beat", "beat/1", beat, 4096).await;
    let cancel = binary(&CancelRequest { goal_id: goal_id() });
    abuse(
        &raw,
        "bad_action/count/up/cancel",
        "cancel_request/1",
        cancel,
        4096,
    )
    .await;
    let result = binary(&ResultRequest { goal_id: goal_id() });
    abuse(
        &raw,
        "bad_action/count/up/result",
        "result_request/1",
        result,
        4096,
    )
    .await;
    // nothing of it granted a period, cancelled or replaced the goal
    assert_eq!(goal.beat().await.unwrap().feedback, Some(Counted { n: 2 }));
    assert_eq!(goal.finish(|_| {}).await.unwrap().n, 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flood_beyond_the_transport_limit_is_dropped_and_the_link_survives() {
    let (server, client, _presence) = pair("flood").await;
    let _served = serve_height(&server, "height/halve").await;
    let raw = foreigner(&server).await;
    raw.put(
        "flood/height/noise",
        vec![0_u8; rover_bus::MAX_MESSAGE_BYTES + 1],
    )
    .await
    .unwrap();
    let answer = get_json(
        &raw,
        "flood/height/halve",
        serde_json::json!({"height_m": 2.0, "label": ""}),
    );
    assert_eq!(answer.await.unwrap()["height_m"], 1.0);
    let answer: Reading = client
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
}
