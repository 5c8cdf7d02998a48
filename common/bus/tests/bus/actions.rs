use crate::support::*;
use rover_bus::{
    ActionPolicy, Beat, BusError, Goal, GoalContext, GoalRequest, GoalState, Interrupt, Progress,
};
use rover_messages::{Fault, codec};
use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lockstep_goal_moves_one_period_for_each_heartbeat() {
    let (server, client, _presence) = pair("lockstep").await;
    let _served = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let mut goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 3 })
        .await
        .unwrap();
    assert_eq!(goal.id(), "commander-1");
    for n in 1..=2 {
        let progress = goal.beat().await.unwrap();
        assert_eq!((progress.seq, progress.state), (n, GoalState::Running));
        assert_eq!(progress.feedback, Some(Counted { n }));
    }
    let mut seen = Vec::new();
    let result = goal.finish(|f| seen.push(f.n)).await.unwrap();
    assert_eq!((result, seen), (Counted { n: 3 }, vec![3]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn thousand_heartbeats_each_grant_exactly_one_period() {
    let (server, client, _presence) = pair("thousand").await;
    let _served = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let goal = client
        .command("count/up", &CountGoal { to: 1000 })
        .await
        .unwrap();
    let mut seen = Vec::new();
    let result: Counted = goal.finish(|f: &Counted| seen.push(f.n)).await.unwrap();
    assert_eq!(result.n, 1000);
    assert_eq!(seen, (1..=1000).collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn period_without_feedback_ends_with_the_next_wait() {
    let (server, client, _presence) = pair("silent_period").await;
    let _served = server
        .serve_action(
            "count/silent",
            LOCKSTEP,
            |context: GoalContext<Counted>, goal: CountGoal| async move {
                for _ in 0..goal.to {
                    assert_eq!(context.next_beat().await, Interrupt::Beat);
                }
                assert_eq!(context.next_beat().await, Interrupt::Beat);
                Ok(Counted { n: goal.to })
            },
        )
        .await
        .unwrap();
    let mut goal: Goal<Counted, Counted> = client
        .command("count/silent", &CountGoal { to: 2 })
        .await
        .unwrap();
    for seq in 1..=2 {
        let progress = goal.beat().await.unwrap();
        assert_eq!((progress.seq, progress.feedback), (seq, None));
    }
    assert_eq!(goal.beat().await.unwrap().result, Some(Counted { n: 2 }));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn free_goal_runs_without_heartbeats_and_reports_all_the_same() {
    let (server, client, _presence) = pair("free").await;
    let (go, gate) = tokio::sync::watch::channel(0_u64);
    let _served = server
        .serve_action(
            "count/free",
            ActionPolicy::free(),
            move |context: GoalContext<Counted>, goal: CountGoal| {
                let mut gate = gate.clone();
                async move {
                    for n in 1..=goal.to {
                        gate.wait_for(|g| *g >= n).await.unwrap();
                        context.feedback(Counted { n });
                    }
                    Ok(Counted { n: goal.to })
                }
            },
        )
        .await
        .unwrap();
    let mut feedback = client.watch_raw("count/free/feedback", 10).await.unwrap();
    settle(&server, &client).await;
    let mut goal: Goal<Counted, Counted> = client
        .command("count/free", &CountGoal { to: 2 })
        .await
        .unwrap();
    let quiet = goal.beat().await.unwrap();
    assert_eq!((quiet.state, quiet.feedback), (GoalState::Running, None));
    go.send_replace(1);
    let mut first = goal.beat().await.unwrap();
    while first.feedback.is_none() {
        first = goal.beat().await.unwrap();
    }
    assert_eq!(first.feedback, Some(Counted { n: 1 }));
    go.send_replace(2);
    let mut last = Vec::new();
    let result = goal.finish(|f| last.push(f.n)).await.unwrap();
    assert_eq!((result.n, last), (2, vec![2]));
    for state in ["running", "running", "succeeded"] {
        let sample = soon(feedback.next()).await.unwrap();
        let schema = "progress/1(counted/1,counted/1)";
        assert_eq!(sample.encoding, format!("application/bincode;{schema}"));
        let progress: Progress<Counted, Counted> =
            codec::decode_value(&sample.payload, schema, codec::Format::Bincode, 1000).unwrap();
        assert_eq!(serde_json::to_value(progress.state).unwrap(), state);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn same_goal_twice_is_one_goal() {
    let (server, client, _presence) = pair("idempotent").await;
    let started = Arc::new(AtomicU64::new(0));
    let starts = started.clone();
    let _served = server
        .serve_action("count/up", LOCKSTEP, move |context, goal| {
            starts.fetch_add(1, Ordering::SeqCst);
            count(context, goal)
        })
        .await
        .unwrap();
    let to_two = CountGoal { to: 2 };
    let mut goal: Goal<Counted, Counted> =
        client.command_as("count/up", "g", &to_two).await.unwrap();
    goal.beat().await.unwrap();
    // taken up again while it runs: goes on where it was
    let again: Goal<Counted, Counted> = client.command_as("count/up", "g", &to_two).await.unwrap();
    assert_eq!(again.finish(|f| assert_eq!(f.n, 2)).await.unwrap().n, 2);
    // and after its end: answered from memory
    let ended: Goal<Counted, Counted> = client.command_as("count/up", "g", &to_two).await.unwrap();
    assert_eq!(ended.finish(|_| {}).await.unwrap().n, 2);
    assert_eq!(started.load(Ordering::SeqCst), 1);
    let other = client.command_as::<_, Counted, Counted>("count/up", "g", &CountGoal { to: 5 });
    assert_eq!(
        other.await.unwrap_err().fault_name(),
        Some("goal_id_reused")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn second_goal_is_refused_as_busy_not_queued() {
    let (server, client, _presence) = pair("busy").await;
    let _served = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let first: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 1 })
        .await
        .unwrap();
    let second = client
        .command::<_, Counted, Counted>("count/up", &CountGoal { to: 1 })
        .await;
    let e = second.unwrap_err();
    assert_eq!(e.fault_name(), Some("busy"));
    assert!(
        e.to_string().contains("`commander-1` of `commander`"),
        "{e}"
    );
    first.finish(|_| {}).await.unwrap();
    let third: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 1 })
        .await
        .unwrap();
    assert_eq!(third.finish(|_| {}).await.unwrap().n, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn repeated_heartbeat_grants_nothing_new_and_a_skipped_one_is_refused() {
    let (server, client, _presence) = pair("beats").await;
    let _served = server
        .serve_action("count/up", LOCKSTEP, count)
        .await
        .unwrap();
    let mut goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 2 })
        .await
        .unwrap();
    assert_eq!(goal.beat().await.unwrap().feedback, Some(Counted { n: 1 }));
    let raw = foreigner(&client).await;
    let beat = |seq: u64| {
        get_json(
            &raw,
            "beats/count/up/beat",
            serde_json::json!({"goal_id": "commander-1", "seq": seq}),
        )
    };
    assert_eq!(beat(1).await.unwrap()["feedback"]["n"], 1);
    for seq in [0, 3, 7] {
        let fault = beat(seq).await.unwrap_err();
        assert_eq!(fault.name, "beat_out_of_order");
        assert_eq!(
            (fault.details["found_seq"], fault.details["expected_seq"]),
            (seq as f64, 2.0)
        );
    }
    assert_eq!(goal.beat().await.unwrap().feedback, Some(Counted { n: 2 }));
    assert_eq!(beat(3).await.unwrap()["state"], "succeeded");
    assert_eq!(beat(3).await.unwrap()["result"]["n"], 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn failure_keeps_its_fault_and_a_panic_becomes_one() {
    let (server, client, _presence) = pair("failure").await;
    let _served = server
        .serve_action(
            "count/fail",
            ActionPolicy::free(),
            |_: GoalContext<Counted>, goal: CountGoal| async move {
                assert!(goal.to > 0, "counting to nothing");
                Err::<Counted, _>(
                    Fault::new("server", "stuck", "cannot count").with("to", goal.to as f64),
                )
            },
        )
        .await
        .unwrap();
    let goal: Goal<Counted, Counted> = client
        .command("count/fail", &CountGoal { to: 4 })
        .await
        .unwrap();
    let BusError::Fault(fault) = goal.finish(|_| {}).await.unwrap_err() else {
        panic!()
    };
    assert_eq!((fault.name.as_str(), fault.details["to"]), ("stuck", 4.0));
    let goal: Goal<Counted, Counted> = client
        .command("count/fail", &CountGoal { to: 0 })
        .await
        .unwrap();
    let e = goal.finish(|_| {}).await.unwrap_err();
    assert_eq!(e.fault_name(), Some("internal_error"));
    assert!(e.to_string().contains("counting to nothing"), "{e}");
}

#[test]
fn binary_layout_of_goals_and_heartbeats_is_frozen() {
    let binary = |bytes: Result<Vec<u8>, codec::CodecError>| bytes.unwrap();
    let beat = Beat {
        goal_id: "g-1".into(),
        seq: 300,
    };
    assert_eq!(
        binary(codec::encode(&beat, codec::Format::Bincode)),
        [3, b'g', b'-', b'1', 251, 0x2C, 0x01]
    );
    let goal = GoalRequest {
        goal_id: "g".into(),
        commander: "c".into(),
        goal: CountGoal { to: 7 },
    };
    let bytes = codec::encode_value(&goal, "goal/1(count_goal/1)", codec::Format::Bincode);
    assert_eq!(binary(bytes), [1, b'g', 1, b'c', 7]);
    let progress = Progress {
        goal_id: "g".into(),
        seq: 2,
        state: GoalState::Succeeded,
        feedback: None::<Counted>,
        result: Some(Counted { n: 9 }),
        fault: None,
    };
    let bytes = codec::encode_value(&progress, "progress/1", codec::Format::Bincode);
    assert_eq!(binary(bytes), [1, b'g', 2, 2, 0, 1, 9, 0]);
}
