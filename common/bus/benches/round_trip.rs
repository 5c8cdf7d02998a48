//! A question and its answer of 64 B and of one 640x480 picture: this layer beside raw Zenoh with
//! the same links, priorities and sizes, in the same run.
#![allow(clippy::unwrap_used, missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use rover_bus::{NetworkConfig, Peer, Role};
use rover_messages::{Nothing, Wire, imaging::ImageData};
use serde::{Deserialize, Serialize};
use std::time::Duration;
use tokio::runtime::Runtime;
use zenoh::{
    Session,
    qos::{CongestionControl, Priority},
    query::ConsolidationMode,
};

const LIMIT: Duration = Duration::from_secs(20);

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Small {
    numbers: [f64; 8],
}
rover_messages::wire! { Small = "bench_small/1" }

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Picture {
    image: ImageData,
}
rover_messages::wire! { Picture = "bench_picture/1" }

fn picture() -> Picture {
    let (width_px, height_px) = (640, 480);
    let pixels = (0..width_px * height_px).map(|i| i as u8).collect();
    let image = ImageData {
        width_px,
        height_px,
        pixels,
    };
    Picture { image }
}

async fn pair(namespace: &str) -> (Peer, Peer) {
    let open = |name: &'static str, connect: Vec<String>| async move {
        Peer::open(NetworkConfig::new(namespace, name, Role::Runner, &connect)).await
    };
    let server = open("server", vec![]).await.unwrap();
    let client = open("client", server.locators().await).await.unwrap();
    (server, client)
}

async fn raw_ask(querier: &zenoh::query::Querier<'_>) -> usize {
    let replies = querier.get().payload([0u8; 8]).await.unwrap();
    let reply = replies.recv_async().await.unwrap();
    reply.result().unwrap().payload().to_bytes().len()
}

/// Serves `bytes` on `key` without this crate.
async fn raw_serve(session: &Session, key: &str, bytes: Vec<u8>) -> impl Sized + use<> {
    let queryable = session.declare_queryable(key.to_owned()).await.unwrap();
    tokio::spawn(async move {
        while let Ok(query) = queryable.recv_async().await {
            let key = query.key_expr().clone();
            query.reply(key, bytes.clone()).express(true).await.unwrap();
        }
    })
}

async fn ready<T: Wire + Clone>(server: &Peer, key: &str, answer: T) -> impl Sized + use<T> {
    server
        .serve(key, move |_: Nothing| {
            let answer = answer.clone();
            async move { Ok(answer) }
        })
        .await
        .unwrap()
}

fn round_trips(c: &mut Criterion) {
    let runtime = Runtime::new().unwrap();
    let (server, client) = runtime.block_on(pair("bench"));
    let small = Small { numbers: [1.0; 8] };
    let _small = runtime.block_on(ready(&server, "small", small.clone()));
    let _picture = runtime.block_on(ready(&server, "picture", picture()));
    let _raw_small = runtime.block_on(raw_serve(server.session(), "raw/small", vec![1; 64]));
    let _raw_picture = runtime.block_on(raw_serve(
        server.session(),
        "raw/picture",
        vec![1; 640 * 480],
    ));
    for (name, key) in [("64 B", "small"), ("307 kB", "picture")] {
        let mut group = c.benchmark_group(name);
        let querier = runtime.block_on(async {
            let key = format!("raw/{key}");
            let querier = client.session().declare_querier(key);
            querier
                .consolidation(ConsolidationMode::None)
                .congestion_control(CongestionControl::Block)
                .priority(Priority::InteractiveHigh)
                .express(true)
                .timeout(LIMIT)
                .await
                .unwrap()
        });
        // Both answers are there before anything is timed.
        runtime.block_on(async {
            let matching = querier.matching_listener().await.unwrap();
            if !querier.matching_status().await.unwrap().matching() {
                matching.recv_async().await.unwrap();
            }
        });
        group.bench_function("raw zenoh", |b| {
            b.iter(|| runtime.block_on(raw_ask(&querier)));
        });
        if key == "small" {
            group.bench_function("bus", |b| {
                b.iter(|| runtime.block_on(client.ask::<_, Small>(key, &Nothing {}, LIMIT)));
            });
        } else {
            group.bench_function("bus", |b| {
                b.iter(|| runtime.block_on(client.ask::<_, Picture>(key, &Nothing {}, LIMIT)));
            });
        }
        group.finish();
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .measurement_time(Duration::from_secs(3))
        .warm_up_time(Duration::from_secs(1));
    targets = round_trips
}
criterion_main!(benches);
