use crate::support::*;
use rover_bus::{BusError, Role};
use rover_messages::{Fault, Nothing};
use std::time::{Duration, Instant};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn question_is_answered_or_refused_by_name() {
    let (server, client, _presence) = pair("query_answer").await;
    let _served = serve_height(&server, "height/halve").await;
    let answer: Reading = client
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
    let e = client
        .ask::<_, Reading>("height/halve", &reading(9.5), LONG)
        .await
        .unwrap_err();
    let BusError::Fault(fault) = e else {
        panic!("{e}")
    };
    assert_eq!(
        (fault.name.as_str(), fault.details["height_m"]),
        ("too_high", 9.5)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn questions_are_handled_in_order_one_at_a_time() {
    let (server, client, _presence) = pair("query_order").await;
    let log = std::sync::Arc::new(std::sync::Mutex::new(Vec::new()));
    let kept = log.clone();
    let _served = server
        .serve("height/log", move |question: Reading| {
            let log = kept.clone();
            async move {
                log.lock().unwrap().push(question.height_m);
                tokio::task::yield_now().await;
                log.lock().unwrap().push(question.height_m);
                Ok(Nothing {})
            }
        })
        .await
        .unwrap();
    let first = reading(1.0);
    let _: Nothing = client.ask("height/log", &first, LONG).await.unwrap();
    let (a, b) = (reading(2.0), reading(3.0));
    let (x, y) = tokio::join!(
        client.ask::<_, Nothing>("height/log", &a, LONG),
        client.ask::<_, Nothing>("height/log", &b, LONG)
    );
    x.unwrap();
    y.unwrap();
    let log = log.lock().unwrap().clone();
    assert_eq!(log.len(), 6);
    assert!(log.chunks(2).all(|pair| pair[0] == pair[1]), "{log:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn panic_in_a_handler_is_a_fault_and_the_service_lives_on() {
    let (server, client, _presence) = pair("query_panic").await;
    let _served = server
        .serve("height/panic", |question: Reading| async move {
            assert!(question.height_m > 1.0, "too low");
            Ok(Nothing {})
        })
        .await
        .unwrap();
    let e = client
        .ask::<_, Nothing>("height/panic", &reading(0.5), LONG)
        .await
        .unwrap_err();
    assert_eq!(e.fault_name(), Some("internal_error"));
    assert!(e.to_string().contains("too low"), "{e}");
    let _: Nothing = client
        .ask("height/panic", &reading(2.0), LONG)
        .await
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answer_that_cannot_be_encoded_is_a_fault() {
    let (server, client, _presence) = pair("query_bad_answer").await;
    let _served = server
        .serve("height/bad", |_: Nothing| async {
            Ok(reading(f64::INFINITY))
        })
        .await
        .unwrap();
    let e = client
        .ask::<_, Reading>("height/bad", &Nothing {}, LONG)
        .await
        .unwrap_err();
    assert_eq!(e.fault_name(), Some("bad_answer"));
    let _odd = server
        .serve("height/odd", |_: Nothing| async {
            Err::<Nothing, _>(Fault::new("server", "odd", "odd").with("x_m", f64::NAN))
        })
        .await
        .unwrap();
    let e = client
        .ask::<_, Nothing>("height/odd", &Nothing {}, LONG)
        .await
        .unwrap_err();
    assert_eq!(e.fault_name(), Some("odd"));
    assert!(e.to_string().contains("[x_m = NaN]"), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_there_and_nobody_answering_are_told_apart() {
    let (server, client, _presence) = pair("query_silence").await;
    let short = Duration::from_millis(100);
    let e = client
        .ask::<_, Nothing>("height/none", &Nothing {}, short)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
    let _served = server
        .serve("height/mute", |_: Nothing| {
            std::future::pending::<Result<Nothing, Fault>>()
        })
        .await
        .unwrap();
    settle(&server, &client).await;
    let e = client
        .ask::<_, Nothing>("height/mute", &Nothing {}, short)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::Timeout { .. }), "{e}");
    let e = client
        .ask::<_, Nothing>("height/*", &Nothing {}, short)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::InvalidName { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn question_waits_for_a_server_that_comes_later() {
    let (server, client, _presence) = pair("query_later").await;
    let asking = tokio::spawn(async move {
        client
            .ask::<_, Reading>("height/halve", &reading(4.0), LONG)
            .await
    });
    let _served = serve_height(&server, "height/halve").await;
    assert_eq!(asking.await.unwrap().unwrap(), reading(2.0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn server_that_leaves_with_the_question_is_noticed_at_once() {
    let (server, client, _presence) = pair("query_lost").await;
    let (tell, mut told) = tokio::sync::mpsc::unbounded_channel();
    let _served = server
        .serve("height/mute", move |_: Nothing| {
            let _ = tell.send(());
            std::future::pending::<Result<Nothing, Fault>>()
        })
        .await
        .unwrap();
    let _announced = server.announce().await.unwrap();
    let asking = tokio::spawn(async move {
        let started = Instant::now();
        (
            client
                .ask::<_, Nothing>("height/mute", &Nothing {}, LONG * 3)
                .await,
            started.elapsed(),
        )
    });
    soon(told.recv()).await.unwrap();
    server.close().await;
    let (answer, took) = asking.await.unwrap();
    let e = answer.unwrap_err();
    assert!(matches!(e, BusError::PeerLost { .. }), "{e} after {took:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dropped_server_no_longer_answers() {
    let (server, client, _presence) = pair("query_dropped").await;
    let served = serve_height(&server, "height/halve").await;
    let _: Reading = client
        .ask("height/halve", &reading(4.0), LONG)
        .await
        .unwrap();
    drop(served);
    let e = client
        .ask::<_, Reading>("height/halve", &reading(4.0), LONG)
        .await
        .unwrap_err();
    assert!(
        matches!(e, BusError::PeerLost { .. } | BusError::NoAnswer { .. }),
        "{e}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn megabytes_of_answer_arrive() {
    let (server, client, _presence) = pair("query_big").await;
    let _served = server
        .serve("label/long", |_: Nothing| async {
            Ok(Reading {
                height_m: 1.0,
                label: "x".repeat(4_000_000),
            })
        })
        .await
        .unwrap();
    let answer: Reading = client.ask("label/long", &Nothing {}, LONG).await.unwrap();
    assert_eq!(answer.label.len(), 4_000_000);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peer_asks_itself() {
    let alone = peer("query_self", "alone", Role::Service, &[]).await;
    let _served = serve_height(&alone, "height/halve").await;
    let answer: Reading = alone
        .ask("height/halve", &reading(3.0), LONG)
        .await
        .unwrap();
    assert_eq!(answer, reading(1.5));
}
