//! A plain Zenoh client in client mode, JSON only, attached to one peer of a mesh.

use crate::support::*;
use rover_bus::Role;
use rover_messages::Nothing;
use serde_json::json;
use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_client_reads_asks_commands_and_cancels() {
    let (server, client, _presence) = pair("foreign").await;
    // attached to the commander's peer, so that everything goes through it
    let raw = foreigner(&client).await;
    let stream = server.stream::<Reading>("depth/state").await.unwrap();
    stream.publish(reading(2.0)).unwrap();
    let _served = serve_height(&server, "height/halve").await;
    let _action = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    settle(&server, &client).await;

    // a stream: JSON unless bincode is asked for
    let json_text = Ok((
        br#"{"height_m":2.0,"label":"test"}"#.to_vec(),
        "application/json".into(),
    ));
    for selector in [
        "foreign/depth/state",
        "foreign/*/state",
        "foreign/depth/state?encoding=json",
    ] {
        let answers = get_all(&raw, selector, None).await;
        assert_eq!(
            answers,
            [("foreign/depth/state".to_owned(), json_text.clone())]
        );
    }
    let answers = get_all(&raw, "foreign/depth/state?encoding=bincode", None).await;
    let (bytes, mark) = answers[0].1.clone().unwrap();
    assert_eq!(mark, "application/bincode;reading/1");
    let value: Reading = rover_messages::codec::decode_marked(&bytes, &mark, 100).unwrap();
    assert_eq!(value, reading(2.0));

    // a query, marked as JSON and not marked at all
    let answer = get_json(
        &raw,
        "foreign/height/halve",
        json!({"height_m": 5, "label": "x"}),
    )
    .await;
    assert_eq!(answer.unwrap(), json!({"height_m": 2.5, "label": "x"}));
    for mark in [
        "",
        "text/plain",
        "zenoh/string",
        "application/json;reading/1",
    ] {
        let text = br#"{"height_m":4,"label":"x"}"#.to_vec();
        let (bytes, mark) = get(&raw, "foreign/height/halve", text, mark).await.unwrap();
        assert_eq!(
            (bytes.as_slice(), mark.as_str()),
            (&br#"{"height_m":2.0,"label":"x"}"#[..], "application/json")
        );
    }
    let fault = get_json(
        &raw,
        "foreign/height/halve",
        json!({"height_m": 9.5, "label": "x"}),
    )
    .await;
    assert_eq!(fault.unwrap_err().name, "too_high");

    // an action, with presence of its own
    let _token = raw
        .liveliness()
        .declare_token("foreign/presence/stranger")
        .await
        .unwrap();
    let goal = json!({"goal_id": "g1", "commander": "stranger", "goal": {"to": 2}});
    for _ in 0..2 {
        let accepted = get_json(&raw, "foreign/count/up", goal.clone())
            .await
            .unwrap();
        assert_eq!(accepted["goal_id"], "g1");
    }
    let beat = |seq: u64| {
        get_json(
            &raw,
            "foreign/count/up/beat",
            json!({"goal_id": "g1", "seq": seq}),
        )
    };
    let first = beat(1).await.unwrap();
    assert_eq!(
        (&first["state"], &first["feedback"]),
        (&json!("running"), &json!({"n": 1}))
    );
    let running = get_json(&raw, "foreign/count/up/result", json!({"goal_id": "g1"}))
        .await
        .unwrap();
    assert_eq!(
        (&running["state"], &running["result"]),
        (&json!("running"), &json!(null))
    );
    let feedback = get_all(&raw, "foreign/count/up/feedback", None).await;
    let (bytes, _) = feedback[0].1.clone().unwrap();
    let feedback: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
    assert_eq!(feedback["feedback"], json!({"n": 1}));
    let last = beat(2).await.unwrap();
    let last = if last["state"] == "running" {
        beat(3).await.unwrap()
    } else {
        last
    };
    assert_eq!(
        (&last["state"], &last["result"]),
        (&json!("succeeded"), &json!({"n": 2}))
    );

    let goal = json!({"goal_id": "g2", "commander": "stranger", "goal": {"to": 2}});
    get_json(&raw, "foreign/count/up", goal).await.unwrap();
    get_json(&raw, "foreign/count/up/cancel", json!({"goal_id": "g2"}))
        .await
        .unwrap();
    let end = get_json(
        &raw,
        "foreign/count/up/beat",
        json!({"goal_id": "g2", "seq": 1}),
    )
    .await;
    let end = end.unwrap();
    assert_eq!(
        (&end["state"], &end["fault"]["name"]),
        (&json!("cancelled"), &json!("cancelled"))
    );
    let other = json!({"goal_id": "g3", "commander": "nobody", "goal": {"to": 2}});
    let fault = get_json(&raw, "foreign/count/up", other).await.unwrap_err();
    assert_eq!(fault.name, "commander_absent");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn question_without_payload_is_an_empty_one() {
    let server = peer("empty", "server", Role::Service, &[]).await;
    let _served = server
        .serve("arm/stop", |_: Nothing| async { Ok(reading(1.0)) })
        .await
        .unwrap();
    let raw = foreigner(&server).await;
    let answers = get_all(&raw, "empty/arm/stop", None).await;
    assert!(answers[0].1.is_ok(), "{answers:?}");
    let missing = serve_height(&server, "height/halve").await;
    let answers = get_all(&raw, "empty/height/halve", None).await;
    let fault = fault_of(answers[0].1.clone());
    assert!(
        fault.message.contains("missing field `height_m`"),
        "{fault}"
    );
    drop(missing);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wildcards_read_streams_and_run_nothing() {
    let server = peer("wild", "server", Role::Service, &[]).await;
    let stopped = Arc::new(AtomicU64::new(0));
    let count_stops = stopped.clone();
    let _served = server
        .serve("arm/stop", move |_: Nothing| {
            count_stops.fetch_add(1, Ordering::SeqCst);
            async { Ok(Nothing {}) }
        })
        .await
        .unwrap();
    let _action = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let stream = server.stream::<Reading>("arm/status").await.unwrap();
    let _empty = server.stream::<Reading>("mast/status").await.unwrap();
    stream.publish(reading(1.0)).unwrap();
    let raw = foreigner(&server).await;
    for selector in ["wild/**", "wild/*/status", "**"] {
        let answers = get_all(&raw, selector, None).await;
        let streams: Vec<_> = answers
            .iter()
            .filter(|(key, _)| key.starts_with("wild/"))
            .collect();
        assert_eq!(streams.len(), 1, "{selector}: {answers:?}");
        assert_eq!(streams[0].0, "wild/arm/status");
    }
    assert_eq!(stopped.load(Ordering::SeqCst), 0);
    get_all(&raw, "wild/arm/stop", None).await;
    assert_eq!(stopped.load(Ordering::SeqCst), 1);
}
