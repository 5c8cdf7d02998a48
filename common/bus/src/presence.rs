//! Who is on the network: liveliness tokens `presence/<name>`.

use crate::{
    BusError, Peer,
    exchange::{Desk, asked_format, is_wild},
    peer::Inner,
};
use rover_messages::codec::{self, Format, MAX_PAYLOAD_BYTES};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};
use tokio::{
    sync::{mpsc, watch},
    time::timeout,
};
use zenoh::{
    Session,
    key_expr::KeyExpr,
    liveliness::LivelinessToken,
    pubsub::Subscriber,
    query::{ConsolidationMode, QueryTarget, Queryable},
    sample::{Sample, SampleKind},
};

/// Limit for asking the other peers which tokens they hold.
const TOKEN_LIMIT: Duration = Duration::from_secs(2);
const PREFIX: &str = "presence/";
/// Query that every peer answers, each for itself.
const ROLL_CALL: &str = "roll_call";

#[derive(Clone, Copy, Default)]
struct Seen {
    alive: bool,
    losses: u64,
}

/// What this peer knows about the presence of all others; kept by a liveliness subscription.
#[derive(Default)]
pub(crate) struct Roll {
    seen: watch::Sender<BTreeMap<String, Seen>>,
    watchers: Mutex<Vec<mpsc::UnboundedSender<(String, bool)>>>,
}

impl Roll {
    pub(crate) async fn subscribe(
        session: &Session,
        roll: Arc<Self>,
    ) -> Result<Subscriber<()>, BusError> {
        session
            .liveliness()
            .declare_subscriber(format!("{PREFIX}*"))
            .history(true)
            .callback(move |sample| roll.note(&sample))
            .await
            .map_err(|e| BusError::network("watching presence", e))
    }

    fn note(&self, sample: &Sample) {
        let Some(name) = sample.key_expr().as_str().strip_prefix(PREFIX) else {
            return;
        };
        let alive = sample.kind() == SampleKind::Put;
        // lock first: a new watcher takes its snapshot under the same lock
        let mut watchers = self.watchers.lock().unwrap_or_else(|e| e.into_inner());
        let changed = self.seen.send_if_modified(|seen| {
            let entry = seen.entry(name.to_owned()).or_default();
            let changed = entry.alive != alive;
            entry.alive = alive;
            entry.losses += u64::from(changed && !alive);
            changed
        });
        if changed {
            watchers.retain(|w| w.send((name.to_owned(), alive)).is_ok());
        }
    }

    /// Whether `name` is known to be present, and how often it has been lost so far.
    pub(crate) fn look_up(&self, name: &str) -> (bool, u64) {
        let seen = self.seen.borrow();
        let entry = seen.get(name).copied().unwrap_or_default();
        (entry.alive, entry.losses)
    }

    /// Completes when `name` has been lost more often than `losses` times.
    pub(crate) async fn lost_since(&self, name: &str, losses: u64) {
        let mut seen = self.seen.subscribe();
        let lost = |s: &BTreeMap<String, Seen>| s.get(name).is_some_and(|e| e.losses > losses);
        if seen.wait_for(lost).await.map(drop).is_err() {
            std::future::pending::<()>().await;
        }
    }

    fn missing(seen: &BTreeMap<String, Seen>, names: &[&str]) -> Vec<String> {
        let absent = |n: &&&str| !seen.get(**n).is_some_and(|e| e.alive);
        names
            .iter()
            .filter(absent)
            .map(|n| (*n).to_owned())
            .collect()
    }
}

/// A peer's own announcement; dropping it takes the announcement back.
#[derive(Debug)]
pub struct Presence {
    _token: LivelinessToken,
    _claim: Claim,
}

/// A peer's claim to its name; given back on drop.
#[derive(Debug)]
struct Claim(Arc<AtomicBool>);

impl Drop for Claim {
    fn drop(&mut self) {
        self.0.store(false, Ordering::SeqCst);
    }
}

/// Every peer's answer on [`ROLL_CALL`].
#[derive(Serialize, Deserialize)]
pub(crate) struct Present {
    name: String,
    /// Zenoh's identity of the session.
    id: String,
    /// Whether it has, or is about to have, its presence announced.
    claims: bool,
}
rover_messages::wire! { Present = "present/1" }

/// Changes of presence, in order, beginning with everybody who is present already.
#[derive(Debug)]
pub struct PresenceWatcher {
    changes: mpsc::UnboundedReceiver<(String, bool)>,
}

impl PresenceWatcher {
    /// The next change: a name, and whether it is present now. `None` when the peer is closed.
    pub async fn next(&mut self) -> Option<(String, bool)> {
        self.changes.recv().await
    }
}

/// Serves the roll call for the session of `desk`.
pub(crate) async fn answer_roll_call(
    session: &Session,
    name: &Arc<str>,
    claims: Arc<AtomicBool>,
) -> Result<Queryable<()>, BusError> {
    let error = |e| BusError::network(format!("serving {ROLL_CALL}"), e);
    let key = KeyExpr::try_from(ROLL_CALL).map_err(error)?;
    let desk = Desk {
        name: name.clone(),
        key,
    };
    let id = session.zid().to_string();
    session
        .declare_queryable(ROLL_CALL)
        .callback(move |query| {
            if !is_wild(&query, &desk.key) {
                let claims = claims.load(Ordering::SeqCst);
                let present = Present {
                    name: desk.name.to_string(),
                    id: id.clone(),
                    claims,
                };
                desk.answer(&query, &present, asked_format(&query));
            }
        })
        .await
        .map_err(error)
}

impl Inner {
    /// Whether another peer claims this peer's name; every peer is asked.
    async fn has_rival(&self) -> Result<bool, BusError> {
        let (tell, mut told) = mpsc::unbounded_channel();
        self.session
            .get(ROLL_CALL)
            .target(QueryTarget::All)
            .consolidation(ConsolidationMode::None)
            .timeout(TOKEN_LIMIT)
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    let _ = tell.send(sample.payload().to_bytes().into_owned());
                }
            })
            .await
            .map_err(|e| BusError::network(ROLL_CALL, e))?;
        let mut rival = false;
        while let Some(bytes) = told.recv().await {
            let present: Present =
                codec::decode(&bytes, Format::Json, MAX_PAYLOAD_BYTES).map_err(|error| {
                    BusError::Decode {
                        key: ROLL_CALL.to_owned(),
                        error,
                    }
                })?;
            rival |= present.claims && *present.name == *self.name && present.id != self.id;
        }
        Ok(rival)
    }

    /// Whether any token matches; asks the other peers.
    async fn tokens(&self, key: &str) -> Result<Vec<String>, BusError> {
        let error = |e| BusError::network(format!("tokens on {key}"), e);
        let (tell, mut told) = mpsc::unbounded_channel();
        self.session
            .liveliness()
            .get(key)
            .timeout(TOKEN_LIMIT)
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    let _ = tell.send(sample.key_expr().as_str().to_owned());
                }
            })
            .await
            .map_err(error)?;
        let mut keys = Vec::new();
        while let Some(key) = told.recv().await {
            keys.push(key);
        }
        Ok(keys)
    }

    /// Whether `name` is present: from the roll, or else by asking.
    pub(crate) async fn is_present(&self, name: &str) -> Result<bool, BusError> {
        crate::config::check_name("peer name", name)?;
        Ok(self.roll.look_up(name).0 || !self.tokens(&format!("{PREFIX}{name}")).await?.is_empty())
    }
}

impl Peer {
    /// Announces this peer on `presence/<name>`.
    ///
    /// # Errors
    /// [`BusError::AlreadyPresent`] if another instance of that name is on the network or is
    /// just being announced; of two that start at the same moment both may be refused, never
    /// none.
    pub async fn announce(&self) -> Result<Presence, BusError> {
        let inner = &self.inner;
        let refused = || BusError::AlreadyPresent {
            name: inner.name.to_string(),
            namespace: inner.namespace.clone(),
        };
        // Claim first, then ask: of two that claim at once, whoever asks later hears the other.
        if inner.claims.swap(true, Ordering::SeqCst) {
            return Err(refused());
        }
        let claim = Claim(inner.claims.clone());
        let key = format!("{PREFIX}{}", inner.name);
        if inner.has_rival().await? || !inner.tokens(&key).await?.is_empty() {
            return Err(refused());
        }
        let token = inner.session.liveliness().declare_token(key).await;
        let token =
            token.map_err(|e| BusError::network(format!("announcing `{}`", inner.name), e))?;
        Ok(Presence {
            _token: token,
            _claim: claim,
        })
    }

    /// Waits until all `names` are present.
    ///
    /// # Errors
    /// [`BusError::Absent`] with the missing names after `limit`.
    pub async fn await_presence(&self, names: &[&str], limit: Duration) -> Result<(), BusError> {
        let mut seen = self.inner.roll.seen.subscribe();
        let all = seen.wait_for(|seen| Roll::missing(seen, names).is_empty());
        if matches!(timeout(limit, all).await, Ok(Ok(_))) {
            return Ok(());
        }
        let missing = Roll::missing(&self.inner.roll.seen.borrow(), names);
        if missing.is_empty() {
            Ok(())
        } else {
            Err(BusError::Absent {
                missing,
                waited: limit,
            })
        }
    }

    /// Watches everybody's presence, this peer's included.
    ///
    /// # Errors
    /// None at present.
    pub async fn watch_presence(&self) -> Result<PresenceWatcher, BusError> {
        let (tell, changes) = mpsc::unbounded_channel();
        let mut watchers = self
            .inner
            .roll
            .watchers
            .lock()
            .unwrap_or_else(|e| e.into_inner());
        for (name, entry) in self
            .inner
            .roll
            .seen
            .borrow()
            .iter()
            .filter(|(_, e)| e.alive)
        {
            let _ = tell.send((name.clone(), entry.alive));
        }
        watchers.push(tell);
        Ok(PresenceWatcher { changes })
    }

    /// Whether `name` is present now.
    ///
    /// # Errors
    /// [`BusError::InvalidName`] if it is no name, [`BusError::Network`] if nobody can be asked.
    pub async fn is_present(&self, name: &str) -> Result<bool, BusError> {
        self.inner.is_present(name).await
    }
}
