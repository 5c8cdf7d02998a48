use crate::support::*;
use rover_bus::{BusError, NetworkConfig, Peer, Role};
use std::time::Duration;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn barrier_opens_when_all_are_present_and_names_the_missing() {
    let a = peer("barrier", "a", Role::Service, &[]).await;
    let b = peer("barrier", "b", Role::Service, &[&a]).await;
    let _a = a.announce().await.unwrap();
    let e = a
        .await_presence(&["a", "b", "c"], Duration::from_millis(50))
        .await
        .unwrap_err();
    let BusError::Absent { missing, .. } = e else {
        panic!("{e}")
    };
    assert_eq!(missing, ["b", "c"]);
    assert!(!a.is_present("b").await.unwrap());
    let waiting = {
        let a = a.clone();
        tokio::spawn(async move { a.await_presence(&["a", "b"], LONG).await })
    };
    let _b = b.announce().await.unwrap();
    waiting.await.unwrap().unwrap();
    assert!(a.is_present("b").await.unwrap() && b.is_present("a").await.unwrap());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn second_instance_of_a_name_is_refused() {
    let a = peer("twice", "arm", Role::Service, &[]).await;
    let b = peer("twice", "arm", Role::Service, &[&a]).await;
    let first = a.announce().await.unwrap();
    let e = b.announce().await.unwrap_err();
    assert_eq!(
        e.to_string(),
        "`arm` is already present in namespace `twice`, expected one instance"
    );
    let mut watcher = b.watch_presence().await.unwrap();
    while soon(watcher.next()).await.unwrap() != ("arm".into(), true) {}
    drop(first);
    while soon(watcher.next()).await.unwrap() != ("arm".into(), false) {}
    let _second = b.announce().await.unwrap();
    assert!(a.announce().await.is_err());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_two_that_start_at_once_at_most_one_is_announced() {
    for round in 0..10 {
        let namespace = format!("race{round}");
        let a = peer(&namespace, "arm", Role::Service, &[]).await;
        let b = peer(&namespace, "arm", Role::Service, &[&a]).await;
        let one = tokio::spawn(async move { a.announce().await.map(|p| (a, p)) });
        let two = tokio::spawn(async move { b.announce().await.map(|p| (b, p)) });
        let (one, two) = (one.await.unwrap(), two.await.unwrap());
        assert!(one.is_err() || two.is_err());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn coming_and_going_is_watched() {
    let a = peer("watched", "a", Role::Service, &[]).await;
    let _a = a.announce().await.unwrap();
    let b = peer("watched", "b", Role::Service, &[&a]).await;
    let mut watcher = b.watch_presence().await.unwrap();
    assert_eq!(soon(watcher.next()).await.unwrap(), ("a".into(), true));
    let c = peer("watched", "c", Role::Client, &[&a]).await;
    let _c = c.announce().await.unwrap();
    drop(c);
    let d = peer("watched", "d", Role::Service, &[&a, &b]).await;
    let announced = d.announce().await.unwrap();
    while soon(watcher.next()).await.unwrap() != ("d".into(), true) {}
    d.close().await;
    drop(announced);
    while soon(watcher.next()).await.unwrap() != ("d".into(), false) {}
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn namespaces_do_not_see_each_other() {
    let a = peer("robot/one", "arm", Role::Service, &[]).await;
    let b = peer("robot/two", "arm", Role::Service, &[&a]).await;
    let _a = a.announce().await.unwrap();
    let _b = b.announce().await.unwrap();
    let _served = serve_height(&a, "height/halve").await;
    let limit = Duration::from_millis(50);
    let e = b
        .ask::<_, Reading>("height/halve", &reading(1.0), limit)
        .await
        .unwrap_err();
    assert!(matches!(e, BusError::NoAnswer { .. }), "{e}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unusable_names_are_refused_before_anything_is_opened() {
    for (namespace, name) in [
        ("n", ""),
        ("n", "a/b"),
        ("n", "a*"),
        ("", "a"),
        ("a//b", "a"),
    ] {
        let e = Peer::open(NetworkConfig::new(namespace, name, Role::Service, &[])).await;
        assert!(
            matches!(e, Err(BusError::InvalidName { .. })),
            "{namespace} {name}"
        );
    }
}
