//! Messages and peers for the tests.

use rover_bus::{ActionPolicy, GoalContext, Interrupt, NetworkConfig, Peer, Role, Served};
use rover_messages::{Fault, Nothing, Wire, codec};
use serde::{Deserialize, Serialize};
use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};
use zenoh::{Session, bytes::Encoding, query::Reply};

/// Longer than anything takes; reached only when something is wrong.
pub const LONG: Duration = Duration::from_secs(20);

/// What comes, or a failure instead of a test that never ends.
pub async fn soon<T>(event: impl Future<Output = T>) -> T {
    let waited = tokio::time::timeout(LONG, event).await;
    waited.unwrap_or_else(|_| panic!("nothing came within {LONG:?}"))
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reading {
    pub height_m: f64,
    pub label: String,
}
impl Wire for Reading {
    const SCHEMA: &'static str = "reading/1";
    fn validate(&self) -> Result<(), String> {
        rover_messages::wire::in_range("height_m", self.height_m, 0.0, 10.0)
    }
}

pub fn reading(height_m: f64) -> Reading {
    Reading {
        height_m,
        label: "test".into(),
    }
}

/// Same name, next version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadingTwo {
    pub height_m: f64,
    pub label: String,
}
rover_messages::wire! { ReadingTwo = "reading/2" }

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CountGoal {
    pub to: u64,
}
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counted {
    pub n: u64,
}
rover_messages::wire! { CountGoal = "count_goal/1", Counted = "counted/1" }

pub async fn peer(namespace: &str, name: &str, role: Role, others: &[&Peer]) -> Peer {
    let mut connect = Vec::new();
    for other in others {
        connect.extend(other.locators().await);
    }
    Peer::open(NetworkConfig::new(namespace, name, role, &connect))
        .await
        .unwrap()
}

/// A server and a commander that has announced itself; its presence is dropped with the tuple.
pub async fn pair(namespace: &str) -> (Peer, Peer, rover_bus::Presence) {
    let server = peer(namespace, "server", Role::Service, &[]).await;
    let client = peer(namespace, "commander", Role::Runner, &[&server]).await;
    let presence = client.announce().await.unwrap();
    (server, client, presence)
}

pub async fn serve_height(server: &Peer, key: &str) -> Served {
    server
        .serve(key, |question: Reading| async move {
            if question.height_m > 9.0 {
                let fault = Fault::new("server", "too_high", "9 m at most");
                return Err(fault.with("height_m", question.height_m));
            }
            Ok(Reading {
                height_m: question.height_m / 2.0,
                label: question.label,
            })
        })
        .await
        .unwrap()
}

/// After this the server knows all that `client` has declared so far: declarations and questions
/// travel in order on one link.
pub async fn settle(server: &Peer, client: &Peer) {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let key = format!("settle/{}", COUNT.fetch_add(1, Ordering::Relaxed));
    let _served = server
        .serve(&key, |_: Nothing| async { Ok(Nothing {}) })
        .await
        .unwrap();
    let _: Nothing = client.ask(&key, &Nothing {}, LONG).await.unwrap();
}

pub const LOCKSTEP: ActionPolicy = ActionPolicy::lockstep(LONG);

/// Counts one for each heartbeat up to the goal.
pub async fn count(context: GoalContext<Counted>, goal: CountGoal) -> Result<Counted, Fault> {
    let mut n = 0;
    while n < goal.to {
        match context.next_beat().await {
            Interrupt::Beat => {
                n += 1;
                context.feedback(Counted { n });
            }
            other => return Err(other.to_fault("server").unwrap().with("n", n as f64)),
        }
    }
    Ok(Counted { n })
}

/// A Zenoh session without our code, attached as client.
pub async fn foreigner(peer: &Peer) -> Session {
    let mut config = zenoh::Config::default();
    let locators = serde_json::to_string(&peer.locators().await).unwrap();
    for (path, value) in [
        ("mode", r#""client""#),
        ("connect/endpoints", locators.as_str()),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(path, value).unwrap();
    }
    zenoh::open(config).await.unwrap()
}

/// What a plain `get` yields: payload and encoding, or those of the error.
pub type Answer = Result<(Vec<u8>, String), (Vec<u8>, String)>;

pub async fn get_all(
    session: &Session,
    selector: &str,
    payload: Option<(Vec<u8>, &str)>,
) -> Vec<(String, Answer)> {
    let mut get = session.get(selector).timeout(LONG);
    if let Some((bytes, encoding)) = payload {
        get = get.payload(bytes).encoding(Encoding::from(encoding));
    }
    let replies = get.await.unwrap();
    let mut answers = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        answers.push(plain(&reply));
    }
    answers
}

fn plain(reply: &Reply) -> (String, Answer) {
    match reply.result() {
        Ok(s) => (
            s.key_expr().to_string(),
            Ok((
                s.payload().to_bytes().into_owned(),
                s.encoding().to_string(),
            )),
        ),
        Err(e) => (
            String::new(),
            Err((
                e.payload().to_bytes().into_owned(),
                e.encoding().to_string(),
            )),
        ),
    }
}

pub async fn get(session: &Session, key: &str, payload: Vec<u8>, encoding: &str) -> Answer {
    let mut answers = get_all(session, key, Some((payload, encoding))).await;
    assert_eq!(answers.len(), 1, "{key}: {answers:?}");
    answers.remove(0).1
}

/// Asks in JSON and expects JSON back, error or not.
pub async fn get_json(
    session: &Session,
    key: &str,
    question: serde_json::Value,
) -> Result<serde_json::Value, Fault> {
    match get(
        session,
        key,
        question.to_string().into_bytes(),
        "application/json",
    )
    .await
    {
        Ok((bytes, encoding)) => {
            assert_eq!(encoding, "application/json");
            Ok(serde_json::from_slice(&bytes).unwrap())
        }
        Err((bytes, encoding)) => {
            assert_eq!(encoding, "application/json");
            Err(serde_json::from_slice(&bytes).unwrap())
        }
    }
}

pub fn fault_of(answer: Answer) -> Fault {
    let (bytes, encoding) = answer.expect_err("a refusal");
    codec::decode_marked(&bytes, &encoding, 100_000).unwrap()
}
