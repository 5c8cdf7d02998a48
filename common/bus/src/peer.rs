//! One Zenoh session, and questions sent through it.

use crate::{
    BusError, NetworkConfig,
    config::check_key,
    exchange::{Form, Question, read},
    presence::{Roll, answer_roll_call},
};
use rover_messages::{Fault, codec::MAX_PAYLOAD_BYTES};
use std::{
    collections::HashMap,
    pin::Pin,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64},
    },
    time::Duration,
};
use tokio::{
    sync::{mpsc, watch},
    task::JoinHandle,
    time::{Instant, sleep_until, timeout_at},
};
use zenoh::{
    Session,
    bytes::Encoding,
    pubsub::Subscriber,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Querier, Queryable, Reply, ReplyError},
    sample::Sample,
};

/// First and longest pause before a question that nobody answered is repeated.
const PAUSE: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(200));

/// One named Zenoh session; clones share it.
#[derive(Clone)]
pub struct Peer {
    pub(crate) inner: Arc<Inner>,
}

impl std::fmt::Debug for Peer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Peer({}/{})", self.inner.namespace, self.inner.name)
    }
}

/// The runtime on which a peer's tasks run.
#[derive(Clone)]
pub(crate) struct Tasks(tokio::runtime::Handle);

impl Tasks {
    /// Starts a task. Its own type is forgotten, so that tokio's part is compiled once.
    pub(crate) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> JoinHandle<()> {
        self.spawn_boxed(Box::pin(task))
    }

    fn spawn_boxed(&self, task: Pin<Box<dyn Future<Output = ()> + Send>>) -> JoinHandle<()> {
        self.0.spawn(task)
    }
}

pub(crate) struct Inner {
    pub(crate) session: Session,
    pub(crate) name: Arc<str>,
    pub(crate) namespace: String,
    /// Zenoh's identity of this session, different at every start.
    pub(crate) id: String,
    pub(crate) runtime: Tasks,
    pub(crate) roll: Arc<Roll>,
    pub(crate) goals: AtomicU64,
    /// Whether this peer has, or is about to have, its presence announced.
    pub(crate) claims: Arc<AtomicBool>,
    _presence: Subscriber<()>,
    _roll_call: Queryable<()>,
    lines: Mutex<HashMap<(String, Urgency, u64), Arc<Line>>>,
}

/// How urgent a question is to the transport.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Urgency {
    /// Heartbeats, goals, cancels.
    Clock,
    /// Everything else.
    Normal,
}

/// A peer that was present at some moment, to notice when it is lost.
#[derive(Clone, Debug)]
pub(crate) struct Witness {
    pub(crate) name: Arc<str>,
    losses: u64,
}

impl Witness {
    /// None if `name` is not known to be present.
    pub(crate) fn of(roll: &Roll, name: Arc<str>) -> Option<Self> {
        let (alive, losses) = roll.look_up(&name);
        alive.then_some(Self { name, losses })
    }
}

/// The asking side of one key, declared once.
pub(crate) struct Line {
    querier: Querier<'static>,
    /// Whether somebody serves the key.
    served: watch::Receiver<bool>,
    /// Who answered last.
    server: Mutex<Option<Arc<str>>>,
}

enum Outcome {
    Answer(Box<Sample>),
    Refused(ReplyError),
    Nobody,
}

impl Peer {
    /// Opens the session. Must run inside a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// [`BusError::InvalidName`], [`BusError::Config`] for unusable settings, [`BusError::Open`]
    /// if an endpoint cannot be bound or reached within [`crate::CONNECT_LIMIT`].
    pub async fn open(config: NetworkConfig) -> Result<Self, BusError> {
        let zenoh_config = config.to_zenoh()?;
        let namespace = zenoh_config.get_json("namespace").unwrap_or_default();
        let namespace = serde_json::from_str::<Option<String>>(&namespace)
            .ok()
            .flatten();
        let session = zenoh::open(zenoh_config)
            .await
            .map_err(|e| BusError::Open {
                name: config.name.clone(),
                listen: config.listen.clone(),
                connect: config.connect.clone(),
                reason: e.to_string(),
            })?;
        let roll = Arc::new(Roll::default());
        let presence = Roll::subscribe(&session, roll.clone()).await?;
        let name: Arc<str> = config.name.into();
        let claims = Arc::new(AtomicBool::new(false));
        let roll_call = answer_roll_call(&session, &name, claims.clone()).await?;
        Ok(Self {
            inner: Arc::new(Inner {
                name,
                namespace: namespace.unwrap_or_default(),
                id: session.zid().to_string(),
                session,
                runtime: Tasks(tokio::runtime::Handle::current()),
                roll,
                goals: AtomicU64::new(0),
                claims,
                _presence: presence,
                _roll_call: roll_call,
                lines: Mutex::default(),
            }),
        })
    }

    /// This peer's name.
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    /// The namespace all its keys lie in; empty if none.
    pub fn namespace(&self) -> &str {
        &self.inner.namespace
    }

    /// Endpoints at which others can connect to this peer.
    pub async fn locators(&self) -> Vec<String> {
        self.inner
            .session
            .info()
            .locators()
            .await
            .iter()
            .map(ToString::to_string)
            .collect()
    }

    /// The Zenoh session, for what this crate does not offer.
    pub fn session(&self) -> &Session {
        &self.inner.session
    }

    /// Closes the session, for all clones.
    pub async fn close(self) {
        if let Err(e) = self.inner.session.close().await {
            tracing::debug!(peer = %self.inner.name, "closing: {e}");
        }
    }

    /// Asks one question on `key`. If nobody answers it is repeated until `limit`, so a server
    /// may see a question twice.
    ///
    /// # Errors
    /// [`BusError::Fault`] for the server's refusal, [`BusError::NoAnswer`] if nobody serves the
    /// key, [`BusError::Timeout`] if the server is silent, [`BusError::PeerLost`] if it leaves the
    /// network meanwhile, [`BusError::Decode`] for an unusable answer.
    pub async fn ask<Q: rover_messages::Wire, A: rover_messages::Wire>(
        &self,
        key: &str,
        question: &Q,
        limit: Duration,
    ) -> Result<A, BusError> {
        self.inner
            .request(key, question, Urgency::Normal, limit)
            .await
            .map(|(answer, _)| answer)
    }
}

impl Inner {
    /// The asking side of `key` with Zenoh's own timeout at least `limit`; made on first use.
    async fn line(
        &self,
        key: &str,
        urgency: Urgency,
        limit: Duration,
    ) -> Result<Arc<Line>, BusError> {
        check_key(key, false)?;
        // A few timeouts, not one for each limit: queriers stay declared.
        let timeout_s = limit
            .as_secs()
            .saturating_add(1)
            .checked_next_power_of_two();
        let timeout_s = timeout_s.unwrap_or(u64::MAX).min(1 << 20);
        let name = (key.to_owned(), urgency, timeout_s);
        let known = |lines: &Mutex<HashMap<_, Arc<Line>>>| {
            lines
                .lock()
                .unwrap_or_else(|e| e.into_inner())
                .get(&name)
                .cloned()
        };
        if let Some(line) = known(&self.lines) {
            return Ok(line);
        }
        let error = |e| BusError::network(format!("asking on {key}"), e);
        let querier = self
            .session
            .declare_querier(key.to_owned())
            .consolidation(ConsolidationMode::None)
            .congestion_control(CongestionControl::Block)
            .priority(match urgency {
                Urgency::Clock => Priority::RealTime,
                Urgency::Normal => Priority::InteractiveHigh,
            })
            .express(true)
            .timeout(Duration::from_secs(timeout_s))
            .await
            .map_err(error)?;
        let (tell, served) = watch::channel(false);
        let tell = Arc::new(tell);
        let told = tell.clone();
        querier
            .matching_listener()
            .callback(move |status| {
                told.send_replace(status.matching());
            })
            .background()
            .await
            .map_err(error)?;
        // The listener reports changes; the state before it is asked for.
        if querier.matching_status().await.map_err(error)?.matching() {
            tell.send_replace(true);
        }
        let line = Arc::new(Line {
            querier,
            served,
            server: Mutex::default(),
        });
        let mut lines = self.lines.lock().unwrap_or_else(|e| e.into_inner());
        Ok(lines.entry(name).or_insert(line).clone())
    }

    /// Asks until answered; also gives the name of who answered.
    pub(crate) async fn request<Q: Question, A: Form>(
        &self,
        key: &str,
        question: &Q,
        urgency: Urgency,
        limit: Duration,
    ) -> Result<(A, Option<Arc<str>>), BusError> {
        self.request_as(key, question, urgency, limit, None).await
    }

    /// As [`Inner::request`]; gives up when `server` is lost.
    pub(crate) async fn request_as<Q: Question, A: Form>(
        &self,
        key: &str,
        question: &Q,
        urgency: Urgency,
        limit: Duration,
        server: Option<&Witness>,
    ) -> Result<(A, Option<Arc<str>>), BusError> {
        let encoded = question.bytes();
        let (payload, mark) = encoded.map_err(|error| BusError::Encode {
            key: key.to_owned(),
            error,
        })?;
        let (sample, line) = self
            .exchange(key, payload, mark.into(), urgency, limit, server)
            .await?;
        let server = sample.attachment().and_then(|a| {
            a.try_to_string()
                .ok()
                .map(|name| Arc::<str>::from(name.as_ref()))
        });
        line.server
            .lock()
            .unwrap_or_else(|e| e.into_inner())
            .clone_from(&server);
        let mark = sample.encoding().to_string();
        read(&sample.payload().to_bytes(), &mark, MAX_PAYLOAD_BYTES)
            .map(|answer| (answer, server))
            .map_err(|error| BusError::Decode {
                key: key.to_owned(),
                error,
            })
    }

    /// Sends a payload until it is answered, refused, or hopeless.
    pub(crate) async fn exchange(
        &self,
        key: &str,
        payload: impl Into<zenoh::bytes::ZBytes>,
        encoding: Encoding,
        urgency: Urgency,
        limit: Duration,
        server: Option<&Witness>,
    ) -> Result<(Box<Sample>, Arc<Line>), BusError> {
        let payload = payload.into();
        let line = self.line(key, urgency, limit).await?;
        let deadline = Instant::now() + limit;
        let mut served = line.served.clone();
        let server = server.cloned().or_else(|| {
            let name = line
                .server
                .lock()
                .unwrap_or_else(|e| e.into_inner())
                .clone();
            name.and_then(|name| Witness::of(&self.roll, name))
        });
        let lost = || BusError::PeerLost {
            key: key.to_owned(),
            name: server.as_ref().map_or(key, |s| &s.name).to_owned(),
        };
        let server_lost = async {
            match &server {
                Some(server) => self.roll.lost_since(&server.name, server.losses).await,
                None => std::future::pending().await,
            }
        };
        tokio::pin!(server_lost);
        let mut ever_served = *served.borrow_and_update();
        let mut pause = PAUSE.0;
        loop {
            let attempt = timeout_at(deadline, self.attempt(&line, payload.clone(), &encoding));
            let outcome = tokio::select! {
                outcome = attempt => outcome,
                () = &mut server_lost => return Err(lost()),
            };
            match outcome {
                Ok(Ok(Outcome::Answer(sample))) => return Ok((sample, line)),
                Ok(Ok(Outcome::Refused(e))) => return Err(refusal(key, &e, limit)),
                Ok(Ok(Outcome::Nobody)) => {}
                Ok(Err(e)) => return Err(e),
                Err(_) if ever_served => {
                    return Err(BusError::Timeout {
                        key: key.to_owned(),
                        limit,
                    });
                }
                Err(_) => break,
            }
            // Nobody answered: either nobody is there, or he left with the question, or Zenoh
            // lost it while the link was young. Wait for a change, and try again.
            let again = Instant::now() + pause;
            let wait_for_server = !*served.borrow();
            if wait_for_server && ever_served {
                return Err(lost());
            }
            tokio::select! {
                changed = served.changed() => if changed.is_err() {
                    return Err(BusError::Closed { what: key.to_owned() });
                },
                () = &mut server_lost => return Err(lost()),
                () = sleep_until(again), if !wait_for_server => {}
                () = sleep_until(deadline) => break,
            }
            ever_served |= *served.borrow_and_update();
            pause = (pause * 2).min(PAUSE.1);
        }
        Err(BusError::NoAnswer {
            key: key.to_owned(),
            waited: limit,
        })
    }

    async fn attempt(
        &self,
        line: &Line,
        payload: zenoh::bytes::ZBytes,
        encoding: &Encoding,
    ) -> Result<Outcome, BusError> {
        let (tell, mut told) = mpsc::unbounded_channel::<Reply>();
        line.querier
            .get()
            .payload(payload)
            .encoding(encoding.clone())
            .attachment(self.id.as_bytes())
            .callback(move |reply| {
                let _ = tell.send(reply);
            })
            .await
            .map_err(|e| BusError::network(format!("asking on {}", line.querier.key_expr()), e))?;
        Ok(match told.recv().await.map(Reply::into_result) {
            Some(Ok(sample)) => Outcome::Answer(Box::new(sample)),
            Some(Err(e)) => Outcome::Refused(e),
            None => Outcome::Nobody,
        })
    }
}

/// What an error reply means: a fault, or Zenoh's own timeout.
fn refusal(key: &str, error: &ReplyError, limit: Duration) -> BusError {
    let bytes = error.payload().to_bytes();
    let encoding = error.encoding().to_string();
    if encoding.starts_with("zenoh/string") && bytes.as_ref() == b"Timeout" {
        return BusError::Timeout {
            key: key.to_owned(),
            limit,
        };
    }
    match read::<Fault>(&bytes, &encoding, MAX_PAYLOAD_BYTES) {
        Ok(fault) => BusError::Fault(fault),
        Err(error) => BusError::Decode {
            key: key.to_owned(),
            error,
        },
    }
}
