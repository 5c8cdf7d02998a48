use crate::support::*;
use rover_bus::{ActionPolicy, BusError, Goal, GoalContext, Interrupt, Role};
use rover_messages::Fault;
use std::time::Duration;
use tokio::sync::mpsc;

type Log = mpsc::UnboundedReceiver<Interrupt>;

/// An action that reports what interrupted it and how far it had come.
async fn serve_counting(
    server: &rover_bus::Peer,
    policy: ActionPolicy,
) -> (rover_bus::Served, Log) {
    let (tell, told) = mpsc::unbounded_channel();
    let served = server
        .serve_action(
            "count/up",
            policy,
            move |context: GoalContext<Counted>, _: CountGoal| {
                let tell = tell.clone();
                async move {
                    let mut n = 0;
                    loop {
                        let next = context.next_beat().await;
                        if next == Interrupt::Beat {
                            n += 1;
                            context.feedback(Counted { n });
                            continue;
                        }
                        let fault = next.to_fault("server").unwrap().with("n", n as f64);
                        tell.send(next).unwrap();
                        return Err::<Counted, Fault>(fault);
                    }
                }
            },
        )
        .await
        .unwrap();
    (served, told)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cancel_ends_the_goal_without_another_period() {
    let (server, client, _presence) = pair("cancel").await;
    let (_served, mut log) = serve_counting(&server, LOCKSTEP).await;
    let mut goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 9 })
        .await
        .unwrap();
    goal.beat().await.unwrap();
    goal.cancel().await.unwrap();
    assert_eq!(log.recv().await, Some(Interrupt::Cancelled));
    goal.canceller().cancel().await.unwrap();
    let BusError::Fault(fault) = goal.finish(|_| {}).await.unwrap_err() else {
        panic!()
    };
    assert_eq!(
        (fault.name.as_str(), fault.details["n"]),
        ("cancelled", 1.0)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cancel_reaches_a_handler_between_its_heartbeats() {
    let (server, client, _presence) = pair("cancel_free").await;
    let _served = server
        .serve_action(
            "count/free",
            ActionPolicy::free(),
            |context: GoalContext<Counted>, _: CountGoal| async move {
                assert_eq!(context.interrupted(), None);
                let why = context.until_interrupted().await;
                assert_eq!(context.interrupted(), Some(why.clone()));
                Err::<Counted, Fault>(why.to_fault("server").unwrap())
            },
        )
        .await
        .unwrap();
    let goal: Goal<Counted, Counted> = client
        .command("count/free", &CountGoal { to: 9 })
        .await
        .unwrap();
    let canceller = goal.canceller();
    let ending = tokio::spawn(goal.finish(|_: &Counted| {}));
    canceller.cancel().await.unwrap();
    assert_eq!(
        ending.await.unwrap().unwrap_err().fault_name(),
        Some("cancelled")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cancel_that_overtakes_its_goal_is_remembered() {
    let (server, client, _presence) = pair("cancel_early").await;
    let (_served, _log) = serve_counting(&server, LOCKSTEP).await;
    settle(&server, &client).await;
    let raw = foreigner(&client).await;
    let id = serde_json::json!({ "goal_id": "early" });
    let answer = get_json(&raw, "cancel_early/count/up/cancel", id.clone())
        .await
        .unwrap();
    assert_eq!(answer["state"], "unknown");
    for _ in 0..2 {
        let goal =
            client.command_as::<_, Counted, Counted>("count/up", "early", &CountGoal { to: 1 });
        assert_eq!(goal.await.unwrap_err().fault_name(), Some("cancelled"));
    }
    let result = get_json(&raw, "cancel_early/count/up/result", id)
        .await
        .unwrap();
    assert_eq!(result["state"], "cancelled");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goal_of_an_absent_commander_is_refused() {
    let server = peer("absent", "server", Role::Service, &[]).await;
    let client = peer("absent", "commander", Role::Runner, &[&server]).await;
    let (_served, _log) = serve_counting(&server, LOCKSTEP).await;
    let goal = client.command::<_, Counted, Counted>("count/up", &CountGoal { to: 1 });
    let e = goal.await.unwrap_err();
    assert_eq!(e.fault_name(), Some("commander_absent"));
    let _presence = client.announce().await.unwrap();
    client
        .command::<_, Counted, Counted>("count/up", &CountGoal { to: 1 })
        .await
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_commander_interrupts_the_goal_and_a_new_one_starts_afresh() {
    let (server, client, presence) = pair("commander_lost").await;
    let (_served, mut log) = serve_counting(&server, LOCKSTEP).await;
    let mut goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 9 })
        .await
        .unwrap();
    goal.beat().await.unwrap();
    client.close().await;
    drop((goal, presence));
    let lost = Interrupt::CommanderLost {
        name: "commander".into(),
    };
    assert_eq!(log.recv().await, Some(lost));
    // the same name started again counts its goals from one again: a new goal all the same
    let client = peer("commander_lost", "commander", Role::Runner, &[&server]).await;
    let _presence = client.announce().await.unwrap();
    let mut goal: Goal<Counted, Counted> = loop {
        match client.command("count/up", &CountGoal { to: 9 }).await {
            Ok(goal) => break goal,
            // the handler has reported, but may not have returned
            Err(e) => assert_eq!(e.fault_name(), Some("busy")),
        }
    };
    assert_eq!(goal.beat().await.unwrap().feedback, Some(Counted { n: 1 }));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn overdue_heartbeat_interrupts_the_goal() {
    let (server, client, _presence) = pair("overdue").await;
    let policy = ActionPolicy::lockstep(Duration::from_millis(50));
    let (_served, mut log) = serve_counting(&server, policy).await;
    let goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 9 })
        .await
        .unwrap();
    let Some(Interrupt::Overdue { waited_ms }) = log.recv().await else {
        panic!()
    };
    assert!(waited_ms >= 50, "{waited_ms}");
    let e = goal.finish(|_| {}).await.unwrap_err();
    assert_eq!(e.fault_name(), Some("beat_overdue"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_server_is_noticed_at_once() {
    let (server, client, _presence) = pair("server_lost").await;
    let (tell, mut told) = mpsc::unbounded_channel();
    let _served = server
        .serve_action(
            "count/stuck",
            LOCKSTEP,
            move |context: GoalContext<Counted>, _: CountGoal| {
                let tell = tell.clone();
                async move {
                    context.next_beat().await;
                    tell.send(()).unwrap();
                    std::future::pending::<Result<Counted, Fault>>().await
                }
            },
        )
        .await
        .unwrap();
    let _announced = server.announce().await.unwrap();
    client.await_presence(&["server"], LONG).await.unwrap();
    let mut goal: Goal<Counted, Counted> = client
        .command("count/stuck", &CountGoal { to: 9 })
        .await
        .unwrap();
    goal.set_beat_limit(LONG * 10);
    let beating = tokio::spawn(async move { (goal.beat().await, goal) });
    soon(told.recv()).await.unwrap();
    server.close().await;
    let (answer, mut goal) = beating.await.unwrap();
    let e = answer.unwrap_err();
    assert!(
        matches!(&e, BusError::PeerLost { name, .. } if name == "server"),
        "{e}"
    );
    let e = goal.beat().await.unwrap_err();
    assert!(matches!(e, BusError::PeerLost { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dropped_service_interrupts_its_goal() {
    let (server, client, _presence) = pair("server_dropped").await;
    let (served, mut log) = serve_counting(&server, LOCKSTEP).await;
    let _goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 9 })
        .await
        .unwrap();
    drop(served);
    assert_eq!(log.recv().await, Some(Interrupt::Cancelled));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goal_is_unknown_to_a_server_started_anew() {
    let (server, client, _presence) = pair("server_anew").await;
    let (served, _log) = serve_counting(&server, LOCKSTEP).await;
    let goal: Goal<Counted, Counted> = client
        .command("count/up", &CountGoal { to: 9 })
        .await
        .unwrap();
    drop(served);
    let (_served, _log) = serve_counting(&server, LOCKSTEP).await;
    let e = goal.finish(|_| {}).await.unwrap_err();
    assert!(
        matches!(e, BusError::GoalUnknown { .. } | BusError::PeerLost { .. }),
        "{e}"
    );
}
