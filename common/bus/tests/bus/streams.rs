use crate::support::*;
use rover_bus::{BusError, Role};
use rover_messages::Fault;
use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscriber_gets_values_and_late_asker_the_latest() {
    let (server, client, _presence) = pair("stream_values").await;
    let stream = server.stream::<Reading>("depth/state").await.unwrap();
    let mut each = client.watch_each::<Reading>("depth/*", 100).await.unwrap();
    settle(&server, &client).await;
    let early = get_all(client.session(), "depth/state", None)
        .await
        .remove(0)
        .1;
    assert_eq!(fault_of(early).name, "no_value_yet");
    for i in 0..10 {
        stream.publish(reading(f64::from(i))).unwrap();
    }
    for i in 0..10 {
        let (key, value) = soon(each.next_with_key()).await.unwrap();
        assert_eq!(
            (key.as_str(), value),
            ("depth/state", reading(f64::from(i)))
        );
    }
    assert_eq!(each.lost(), 0);
    let late = peer("stream_values", "late", Role::Service, &[&server, &client]).await;
    assert_eq!(
        late.latest::<Reading>("depth/state", LONG).await.unwrap(),
        reading(9.0)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn watcher_keeps_only_the_latest() {
    let (server, client, _presence) = pair("stream_latest").await;
    let stream = server.stream::<Reading>("depth/state").await.unwrap();
    let mut latest = client.watch::<Reading>("depth/state").await.unwrap();
    let mut each = client
        .watch_each::<Reading>("depth/state", 100)
        .await
        .unwrap();
    settle(&server, &client).await;
    for i in 0..10 {
        stream.publish(reading(f64::from(i))).unwrap();
    }
    while soon(each.next()).await.unwrap() != reading(9.0) {}
    // whatever was delivered before has been replaced by the last
    let mut value = soon(latest.next()).await.unwrap();
    if value != reading(9.0) {
        value = soon(latest.next()).await.unwrap();
    }
    assert_eq!(value, reading(9.0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn latest_waits_for_the_first_value() {
    let (server, client, _presence) = pair("stream_first").await;
    let stream = server.stream::<Reading>("depth/state").await.unwrap();
    let waiting = tokio::spawn(async move { client.latest::<Reading>("depth/state", LONG).await });
    stream.publish(reading(3.0)).unwrap();
    assert_eq!(waiting.await.unwrap().unwrap(), reading(3.0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn invalid_value_is_not_published() {
    let (server, _client, _presence) = pair("stream_invalid").await;
    let stream = server.stream::<Reading>("depth/state").await.unwrap();
    let e = stream.publish(reading(11.0)).unwrap_err();
    assert_eq!(
        e.to_string(),
        "depth/state: reading/1: height_m: 11, expected 0 to 10"
    );
    let e = stream.publish(reading(f64::NAN)).unwrap_err();
    assert!(matches!(e, BusError::Encode { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn value_of_another_version_is_an_error_and_the_watcher_goes_on() {
    let (server, client, _presence) = pair("stream_version").await;
    let mut watcher = client
        .watch_each::<Reading>("depth/state", 10)
        .await
        .unwrap();
    let newer = server.stream::<ReadingTwo>("depth/state").await.unwrap();
    settle(&server, &client).await;
    newer
        .publish(ReadingTwo {
            height_m: 1.0,
            label: String::new(),
        })
        .unwrap();
    let e = soon(watcher.next()).await.unwrap_err().to_string();
    assert!(
        e.contains("`application/bincode;reading/2`, expected `application/bincode;reading/1`")
    );
    server
        .session()
        .put("depth/state", r#"{"height_m":2.5,"label":"test"}"#)
        .await
        .unwrap();
    assert_eq!(soon(watcher.next()).await.unwrap(), reading(2.5));
    let e = client
        .latest::<Reading>("depth/state", LONG)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::Decode { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn picture_is_made_only_when_somebody_wants_it() {
    let (server, client, _presence) = pair("pictures").await;
    let pictures = server.picture_stream("imaging/mast/left").await.unwrap();
    settle(&server, &client).await;
    let made = Arc::new(AtomicU64::new(0));
    let publish = |byte: u8| {
        let made = made.clone();
        pictures.publish("image/png", move || {
            made.fetch_add(1, Ordering::SeqCst);
            vec![byte; 300_000].into()
        })
    };
    let ask = || get_all(client.session(), "imaging/mast/left", None);
    let nothing = ask().await.remove(0).1;
    assert_eq!(fault_of(nothing).name, "no_value_yet");
    publish(1).unwrap();
    publish(2).unwrap();
    assert_eq!(ask().await[0].1, Ok((vec![2; 300_000], "image/png".into())));
    assert_eq!(ask().await[0].1, Ok((vec![2; 300_000], "image/png".into())));
    assert_eq!(made.load(Ordering::SeqCst), 1);
    let mut raw = client.watch_raw("imaging/**", 10).await.unwrap();
    settle(&server, &client).await;
    publish(3).unwrap();
    let sample = soon(raw.next()).await.unwrap();
    assert_eq!(
        (sample.key.as_str(), sample.encoding.as_str()),
        ("imaging/mast/left", "image/png")
    );
    assert_eq!(sample.payload, vec![3; 300_000]);
    pictures.publish("image/png", || Arc::from([])).unwrap();
    let refused: Fault = fault_of(ask().await.remove(0).1);
    assert_eq!(refused.name, "no_picture");
    pictures
        .publish("image/png", || panic!("no encoder"))
        .unwrap();
    assert_eq!(fault_of(ask().await.remove(0).1).name, "no_picture");
}
