//! The serving side of an action.

use super::{
    context::{GoalContext, Interrupt, Live, Sink, Taken, Waiting},
    wire::{
        Beat, CancelRequest, GoalRequest, GoalState, Progress, ResultRequest, beat_key, cancel_key,
        feedback_key, result_key,
    },
};
use crate::{
    BusError, Peer, Served,
    exchange::{Desk, Form, asked_format, is_wild, question, write},
    peer::Inner,
    query::Contained,
};
use rover_messages::{
    Fault, Wire,
    codec::{Format, MAX_PAYLOAD_BYTES},
};
use std::{
    collections::VecDeque,
    future::Future,
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};
use tokio::sync::mpsc;
use zenoh::{
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::Query,
};

/// Longest payload of a heartbeat, cancel or result question, in bytes.
const CONTROL_BYTES: usize = 4096;
/// Ended goals, and cancels of goals that have not come, that are remembered.
const REMEMBERED: usize = 256;
/// Longest wait of a heartbeat's answer for news, when not in lockstep.
const NEWS_LIMIT: Duration = Duration::from_millis(200);

/// How an action runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionPolicy {
    /// Whether the commander's heartbeats are the clock.
    pub lockstep: bool,
    /// Wall-clock limit for the next heartbeat, lockstep only.
    pub beat_limit: Duration,
}

impl ActionPolicy {
    /// Time passes by heartbeats.
    pub const fn lockstep(beat_limit: Duration) -> Self {
        Self {
            lockstep: true,
            beat_limit,
        }
    }

    /// The handler has a clock of its own.
    pub const fn free() -> Self {
        Self {
            lockstep: false,
            beat_limit: Duration::ZERO,
        }
    }
}

/// What makes two goal requests the same.
#[derive(Clone, PartialEq, Eq)]
struct Origin {
    commander: String,
    /// The commander's session; empty for foreign clients.
    session: Vec<u8>,
    format: Format,
    payload: u64,
}

impl Origin {
    /// Same request, as far as it can be told: payloads compare only within one format.
    fn repeats(&self, earlier: &Self) -> bool {
        self.commander == earlier.commander
            && (self.format != earlier.format || self.payload == earlier.payload)
    }
}

struct Running<F> {
    live: Arc<Live<F>>,
    origin: Origin,
}

struct Ended<F, R> {
    origin: Origin,
    progress: Progress<F, R>,
    /// Feedback for heartbeats that come after the end.
    unsent: Option<F>,
}

struct Table<F, R> {
    running: Option<Running<F>>,
    ended: VecDeque<Ended<F, R>>,
    cancelled_early: VecDeque<String>,
}

impl<F: Wire + Clone, R: Wire + Clone> Table<F, R> {
    fn running(&self, goal_id: &str) -> Option<&Running<F>> {
        self.running.as_ref().filter(|r| r.live.goal_id == goal_id)
    }

    fn ended(&self, goal_id: &str) -> Option<&Ended<F, R>> {
        self.ended
            .iter()
            .rev()
            .find(|e| e.progress.goal_id == goal_id)
    }

    /// What is known of a goal.
    fn progress(&self, goal_id: &str) -> Progress<F, R> {
        if let Some(running) = self.running(goal_id) {
            let (seq, feedback) = running.live.latest();
            return Progress {
                feedback,
                ..Progress::new(goal_id, seq, GoalState::Running)
            };
        }
        match self.ended(goal_id) {
            Some(ended) => ended.progress.clone(),
            None if self.cancelled_early.iter().any(|id| id == goal_id) => {
                Progress::new(goal_id, 0, GoalState::Cancelled)
            }
            None => Progress::new(goal_id, 0, GoalState::Unknown),
        }
    }
}

/// One served action.
struct Action<F, R> {
    inner: Arc<Inner>,
    policy: ActionPolicy,
    goals: Desk,
    cancels: Desk,
    results: Desk,
    feedbacks: Desk,
    sink: Arc<Sink>,
    table: Mutex<Table<F, R>>,
}

/// Interrupts the running goal when the service is dropped.
struct Stop<F: Wire + Clone, R: Wire + Clone>(Arc<Action<F, R>>);

impl<F: Wire + Clone, R: Wire + Clone> Drop for Stop<F, R> {
    fn drop(&mut self) {
        let running = self.0.lock().running.as_ref().map(|r| r.live.clone());
        if let Some(live) = running {
            live.interrupt(Interrupt::Cancelled);
        }
    }
}

impl Peer {
    /// Serves an action on `key`: one goal at a time, each handled by one call of `handler`. A
    /// handler that ends with the fault `cancelled` leaves the goal cancelled; one that panics
    /// leaves it failed with `internal_error`.
    ///
    /// # Errors
    /// [`BusError::InvalidName`] for an unusable key, [`BusError::Network`].
    pub async fn serve_action<G: Wire, F: Wire + Clone, R: Wire + Clone, H, Fut>(
        &self,
        key: &str,
        policy: ActionPolicy,
        handler: H,
    ) -> Result<Served, BusError>
    where
        H: Fn(GoalContext<F>, G) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = Result<R, Fault>> + Send + 'static,
    {
        let inner = &self.inner;
        let feedbacks = inner.desk(&feedback_key(key))?;
        let publisher = inner
            .session
            .declare_publisher(feedbacks.key.clone())
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::Data)
            .express(true)
            .await
            .map_err(|e| BusError::network(format!("publishing {}", feedbacks.key), e))?;
        let schema = Progress::<F, R>::schema().into_owned();
        let action = Arc::new(Action::<F, R> {
            inner: inner.clone(),
            policy,
            goals: inner.desk(key)?,
            cancels: inner.desk(&cancel_key(key))?,
            results: inner.desk(&result_key(key))?,
            feedbacks,
            sink: Arc::new(Sink {
                beats: inner.desk(&beat_key(key))?,
                publisher,
                schema,
            }),
            table: Mutex::new(Table {
                running: None,
                ended: VecDeque::new(),
                cancelled_early: VecDeque::new(),
            }),
        });
        let at = action.clone();
        let beats = inner
            .queryable(&action.sink.beats, move |query| at.on_beat(query))
            .await?;
        let at = action.clone();
        let cancels = inner
            .queryable(&action.cancels, move |query| at.on_cancel(&query))
            .await?;
        let at = action.clone();
        let results = inner
            .queryable(&action.results, move |query| at.on_result(&query))
            .await?;
        let at = action.clone();
        let reads = inner
            .queryable(&action.feedbacks, move |query| at.on_read(&query))
            .await?;
        let (goals, queries) = inner.queued(&action.goals).await?;
        inner
            .runtime
            .spawn(action.clone().take_goals(queries, Arc::new(handler)));
        Ok(Served {
            key: key.to_owned(),
            _queryables: vec![goals, beats, cancels, results, reads],
            _stop: Some(Box::new(Stop(action))),
        })
    }
}

impl<F: Wire + Clone, R: Wire + Clone> Action<F, R> {
    fn lock(&self) -> MutexGuard<'_, Table<F, R>> {
        self.table.lock().unwrap_or_else(|e| e.into_inner())
    }

    /// Takes goals one after the other; the handlers run on tasks of their own.
    async fn take_goals<G: Wire, H, Fut>(
        self: Arc<Self>,
        mut queries: mpsc::Receiver<Query>,
        handler: Arc<H>,
    ) where
        H: Fn(GoalContext<F>, G) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = Result<R, Fault>> + Send + 'static,
    {
        while let Some(query) = queries.recv().await {
            let format = asked_format(&query);
            let by = &self.goals.name;
            let taken = match question::<GoalRequest<G>>(&query, MAX_PAYLOAD_BYTES, by) {
                Ok(request) => self.take(request, origin_of(&query), handler.clone()).await,
                Err(fault) => Err(fault),
            };
            match taken {
                Ok(progress) => self.goals.answer(&query, &progress, format),
                Err(fault) => self.goals.refuse(&query, &fault, format),
            }
        }
    }

    async fn take<G: Wire, H, Fut>(
        self: &Arc<Self>,
        request: GoalRequest<G>,
        mut origin: Origin,
        handler: Arc<H>,
    ) -> Result<Progress<F, R>, Fault>
    where
        H: Fn(GoalContext<F>, G) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = Result<R, Fault>> + Send + 'static,
    {
        let GoalRequest {
            goal_id,
            commander,
            goal,
        } = request;
        origin.commander.clone_from(&commander);
        if let Some(known) = self.recall(&goal_id, &origin)? {
            return Ok(known);
        }
        let (_, losses) = self.inner.roll.look_up(&commander);
        match self.inner.is_present(&commander).await {
            Ok(true) => {}
            Ok(false) => {
                let text = format!("`presence/{commander}` is not on the network");
                return Err(self.goals.fault("commander_absent", text));
            }
            Err(e) => return Err(self.goals.fault("commander_absent", e.to_string())),
        }
        let limit = self.policy.lockstep.then_some(self.policy.beat_limit);
        let live = Live::new(goal_id.clone(), commander.clone(), limit, self.sink.clone());
        let live = Arc::new(live);
        {
            let mut table = self.lock();
            self.refuse_cancelled(&table, &goal_id)?; // it may have come in between
            table.running = Some(Running {
                live: live.clone(),
                origin,
            });
        }
        let roll = self.inner.roll.clone();
        let watched = live.clone();
        let watch = self.inner.runtime.spawn(async move {
            roll.lost_since(&commander, losses).await;
            watched.interrupt(Interrupt::CommanderLost { name: commander });
        });
        let action = self.clone();
        self.inner.runtime.spawn(async move {
            let context = GoalContext { live: live.clone() };
            let outcome = Contained::new(async move { handler(context, goal).await }).await;
            watch.abort();
            let result =
                outcome.unwrap_or_else(|text| Err(action.goals.fault("internal_error", text)));
            action.end(&live, result);
        });
        Ok(Progress::new(&goal_id, 0, GoalState::Accepted))
    }

    /// What a goal already known is answered with; an error if it cannot be taken at all.
    fn recall(&self, goal_id: &str, origin: &Origin) -> Result<Option<Progress<F, R>>, Fault> {
        let mut table = self.lock();
        self.refuse_cancelled(&table, goal_id)?;
        if let Some(running) = &table.running {
            let same = running.live.goal_id == goal_id && origin.repeats(&running.origin);
            if same {
                return Ok(Some(table.progress(goal_id)));
            }
            let live = &running.live;
            let text = format!("working on goal `{}` of `{}`", live.goal_id, live.commander);
            return Err(self.goals.fault("busy", text));
        }
        match table.ended(goal_id).map(|e| &e.origin) {
            None => Ok(None),
            // A commander that has been started anew counts from the beginning.
            Some(earlier) if earlier.session != origin.session => {
                table.ended.retain(|e| e.progress.goal_id != goal_id);
                Ok(None)
            }
            Some(earlier) if origin.repeats(earlier) => Ok(Some(table.progress(goal_id))),
            Some(_) => {
                let text = format!("`{goal_id}` was another goal before, expected a new goal_id");
                Err(self.goals.fault("goal_id_reused", text))
            }
        }
    }

    fn refuse_cancelled(&self, table: &Table<F, R>, goal_id: &str) -> Result<(), Fault> {
        if table.cancelled_early.iter().any(|id| id == goal_id) {
            let text = format!("goal `{goal_id}` was cancelled before it came");
            return Err(self.goals.fault("cancelled", text));
        }
        Ok(())
    }

    fn end(&self, live: &Live<F>, result: Result<R, Fault>) {
        let mut progress = Progress::new(&live.goal_id, 0, GoalState::Succeeded);
        match result {
            Ok(result) => progress.result = Some(result),
            Err(fault) => {
                let cancelled = fault.name == "cancelled";
                progress.state = if cancelled {
                    GoalState::Cancelled
                } else {
                    GoalState::Failed
                };
                progress.fault = Some(fault);
            }
        }
        if let Err(e) = write(&progress, Format::Bincode) {
            progress.state = GoalState::Failed;
            progress.result = None;
            progress.fault = Some(self.goals.fault("bad_answer", e.to_string()));
        }
        // First remember the end, then mark it: a heartbeat given back finds it here.
        let mut table = self.lock();
        let Some(Running { origin, .. }) = table.running.take() else {
            return;
        };
        let (waiting, latest, unsent, seq) = live.end();
        progress.seq = seq;
        progress.feedback = latest;
        table.ended.push_back(Ended {
            origin,
            progress: progress.clone(),
            unsent: unsent.clone(),
        });
        while table.ended.len() > REMEMBERED {
            table.ended.pop_front();
        }
        drop(table);
        self.sink.publish(write(&progress, Format::Bincode));
        progress.feedback = unsent;
        for Waiting { query, seq, format } in waiting {
            progress.seq = seq;
            self.sink.beats.answer(&query, &progress, format);
        }
    }

    /// Runs in Zenoh's callback: nothing here waits.
    fn on_beat(self: &Arc<Self>, query: Query) {
        let desk = &self.sink.beats;
        if is_wild(&query, &desk.key) {
            return;
        }
        let format = asked_format(&query);
        let beat = match question::<Beat>(&query, CONTROL_BYTES, &desk.name) {
            Ok(beat) => beat,
            Err(fault) => return desk.refuse(&query, &fault, format),
        };
        let running = self.lock().running(&beat.goal_id).map(|r| r.live.clone());
        let mut waiting = Waiting {
            query,
            seq: beat.seq,
            format,
        };
        if let Some(live) = running {
            match live.beat(waiting) {
                Taken::Answered => return,
                Taken::Owed if self.policy.lockstep => return,
                Taken::Owed => {
                    self.inner.runtime.spawn(async move {
                        tokio::time::sleep(NEWS_LIMIT).await;
                        live.answer_without_news(beat.seq);
                    });
                    return;
                }
                Taken::Ended(ended) => waiting = ended,
            }
        }
        let table = self.lock();
        let mut progress = table.progress(&beat.goal_id);
        progress.feedback = table.ended(&beat.goal_id).and_then(|e| e.unsent.clone());
        progress.seq = beat.seq;
        drop(table);
        desk.answer(&waiting.query, &progress, format);
    }

    fn on_cancel(&self, query: &Query) {
        if is_wild(query, &self.cancels.key) {
            return;
        }
        let format = asked_format(query);
        let by = &self.cancels.name;
        let goal_id = match question::<CancelRequest>(query, CONTROL_BYTES, by) {
            Ok(request) => request.goal_id,
            Err(fault) => return self.cancels.refuse(query, &fault, format),
        };
        let mut table = self.lock();
        let progress = table.progress(&goal_id);
        if let Some(running) = table.running(&goal_id) {
            running.live.interrupt(Interrupt::Cancelled);
        } else if progress.state == GoalState::Unknown {
            table.cancelled_early.push_back(goal_id);
            while table.cancelled_early.len() > REMEMBERED {
                table.cancelled_early.pop_front();
            }
        }
        drop(table);
        self.cancels.answer(query, &progress, format);
    }

    fn on_result(&self, query: &Query) {
        if is_wild(query, &self.results.key) {
            return;
        }
        let format = asked_format(query);
        match question::<ResultRequest>(query, CONTROL_BYTES, &self.results.name) {
            Ok(request) => {
                let progress = self.lock().progress(&request.goal_id);
                self.results.answer(query, &progress, format);
            }
            Err(fault) => self.results.refuse(query, &fault, format),
        }
    }

    /// The feedback stream answers with the latest progress of the latest goal.
    fn on_read(&self, query: &Query) {
        let format = asked_format(query);
        let table = self.lock();
        let running = table.running.as_ref().map(|r| r.live.goal_id.as_str());
        let latest = running.or_else(|| table.ended.back().map(|e| e.progress.goal_id.as_str()));
        let progress = latest.map(|goal_id| table.progress(goal_id));
        drop(table);
        match progress {
            Some(progress) => self.feedbacks.answer(query, &progress, format),
            None if is_wild(query, &self.feedbacks.key) => {}
            None => {
                let fault = self
                    .feedbacks
                    .fault("no_value_yet", "there has been no goal yet");
                self.feedbacks.refuse(query, &fault, format);
            }
        }
    }
}

fn origin_of(query: &Query) -> Origin {
    let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
    // FNV-1a
    let hash = payload.iter().fold(0xcbf2_9ce4_8422_2325_u64, |h, b| {
        (h ^ u64::from(*b)).wrapping_mul(0x100_0000_01b3)
    });
    Origin {
        commander: String::new(),
        session: query
            .attachment()
            .map(|a| a.to_bytes().into_owned())
            .unwrap_or_default(),
        format: query.encoding().map_or(Format::Json, |e| {
            rover_messages::codec::format_of(&e.to_string())
        }),
        payload: hash,
    }
}
