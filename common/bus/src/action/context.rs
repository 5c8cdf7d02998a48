//! The server's view of one running goal.

use super::wire::{GoalState, Progress};
use crate::exchange::{Desk, write_as};
use rover_messages::{
    Fault, Nothing, Wire,
    codec::{self, Format},
};
use std::{
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};
use tokio::{sync::Notify, time::Instant};
use zenoh::{Wait, pubsub::Publisher, query::Query};

/// Why a goal's next step is, or is not, to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Interrupt {
    /// The commander granted the next period.
    Beat,
    /// The commander called the goal off, or this service is going down.
    Cancelled,
    /// The commander has left the network.
    CommanderLost {
        /// His name.
        name: String,
    },
    /// In lockstep: the next heartbeat did not come within its limit.
    Overdue {
        /// Wall-clock time waited, milliseconds.
        waited_ms: u64,
    },
}

impl Interrupt {
    /// The fault with which a goal interrupted like this ends: `cancelled`, `commander_lost` or
    /// `beat_overdue`; none for a heartbeat.
    pub fn to_fault(&self, service: &str) -> Option<Fault> {
        match self {
            Self::Beat => None,
            Self::Cancelled => Some(Fault::new(service, "cancelled", "the goal was cancelled")),
            Self::CommanderLost { name } => Some(Fault::new(
                service,
                "commander_lost",
                format!("the commander `{name}` has left the network"),
            )),
            Self::Overdue { waited_ms } => Some(
                Fault::new(
                    service,
                    "beat_overdue",
                    format!("no heartbeat from the commander within {waited_ms} ms"),
                )
                .with("waited_ms", *waited_ms as f64),
            ),
        }
    }
}

/// Handed to an action's handler: feedback out, heartbeats and interruptions in. Clones are the
/// same goal.
pub struct GoalContext<F> {
    pub(crate) live: Arc<Live<F>>,
}

impl<F> Clone for GoalContext<F> {
    fn clone(&self) -> Self {
        Self {
            live: self.live.clone(),
        }
    }
}

impl<F> std::fmt::Debug for GoalContext<F> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "GoalContext({})", self.live.goal_id)
    }
}

impl<F: Wire + Clone> GoalContext<F> {
    /// The goal's id.
    pub fn goal_id(&self) -> &str {
        &self.live.goal_id
    }

    /// Name of the commander.
    pub fn commander(&self) -> &str {
        &self.live.commander
    }

    /// Tells the commander, and everybody on `<action>/feedback`, how it goes. In lockstep this
    /// ends the granted period.
    pub fn feedback(&self, feedback: F) {
        self.live.feedback(feedback);
    }

    /// Waits for the commander's next heartbeat, or for what comes in its place. In lockstep the
    /// period before is over with this call, if it has not been before.
    pub async fn next_beat(&self) -> Interrupt {
        self.live.next_beat().await
    }

    /// [`Interrupt::Cancelled`] or [`Interrupt::CommanderLost`], if that has happened.
    pub fn interrupted(&self) -> Option<Interrupt> {
        self.live.lock().interrupt.clone()
    }

    /// Waits for [`Interrupt::Cancelled`] or [`Interrupt::CommanderLost`].
    pub async fn until_interrupted(&self) -> Interrupt {
        self.live.until(|state| state.interrupt.clone()).await
    }

    /// Wall-clock time since the last new heartbeat, or since the goal was accepted.
    pub fn beat_age(&self) -> Duration {
        self.live.lock().last_beat.elapsed()
    }
}

/// How an action's answers leave: heartbeat answers and the feedback stream.
pub(crate) struct Sink {
    pub(crate) beats: Desk,
    pub(crate) publisher: Publisher<'static>,
    /// Schema of the action's progress.
    pub(crate) schema: String,
}

impl Sink {
    /// Answers heartbeats with a progress without result.
    fn answer<F: Wire>(&self, waiting: Vec<Waiting>, mut progress: Progress<F, Nothing>) {
        for Waiting { query, seq, format } in waiting {
            progress.seq = seq;
            match write_as(&progress, &self.schema, format) {
                Ok(bytes) => {
                    let mark = codec::encoding_of(&self.schema, format);
                    self.beats.answer_bytes(&query, bytes, mark);
                }
                Err(e) => {
                    let fault = self.beats.fault("bad_answer", e.to_string());
                    self.beats.refuse(&query, &fault, format);
                }
            }
        }
    }

    /// Publishes bytes of a progress on the feedback stream.
    pub(crate) fn publish(&self, bytes: Result<Vec<u8>, codec::CodecError>) {
        let key = self.publisher.key_expr().as_str();
        let mark = codec::encoding_of(&self.schema, Format::Bincode);
        match bytes {
            Ok(bytes) => {
                if let Err(e) = self.publisher.put(bytes).encoding(mark).wait() {
                    tracing::debug!(key, "feedback not published: {e}");
                }
            }
            Err(e) => tracing::warn!(key, "feedback not published: {e}"),
        }
    }
}

/// A heartbeat whose answer is due later.
pub(crate) struct Waiting {
    pub(crate) query: Query,
    pub(crate) seq: u64,
    pub(crate) format: Format,
}

/// A goal while it runs.
pub(crate) struct Live<F> {
    pub(crate) goal_id: String,
    pub(crate) commander: String,
    /// Wall-clock limit for the next heartbeat in lockstep; none otherwise.
    beat_limit: Option<Duration>,
    sink: Arc<Sink>,
    state: Mutex<State<F>>,
    changed: Notify,
}

struct State<F> {
    /// Last heartbeat received, handed to the handler, and answered.
    granted: u64,
    taken: u64,
    answered: u64,
    waiting: Vec<Waiting>,
    /// Latest feedback, and the one that no heartbeat's answer has carried yet.
    latest: Option<F>,
    unsent: Option<F>,
    /// What the answer to heartbeat `answered` carried.
    repeated: Option<F>,
    interrupt: Option<Interrupt>,
    ended: bool,
    last_beat: Instant,
}

/// What became of a heartbeat.
pub(crate) enum Taken {
    /// Answered.
    Answered,
    /// To be answered later.
    Owed,
    /// Given back: the goal has ended.
    Ended(Waiting),
}

/// What is left when a goal ends: unanswered heartbeats, latest feedback, unsent feedback, number
/// of the last heartbeat.
pub(crate) type Remains<F> = (Vec<Waiting>, Option<F>, Option<F>, u64);

impl<F: Wire + Clone> Live<F> {
    pub(crate) fn new(
        goal_id: String,
        commander: String,
        beat_limit: Option<Duration>,
        sink: Arc<Sink>,
    ) -> Self {
        Self {
            goal_id,
            commander,
            beat_limit,
            sink,
            state: Mutex::new(State {
                granted: 0,
                taken: 0,
                answered: 0,
                waiting: Vec::new(),
                latest: None,
                unsent: None,
                repeated: None,
                interrupt: None,
                ended: false,
                last_beat: Instant::now(),
            }),
            changed: Notify::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State<F>> {
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }

    fn progress(&self, feedback: Option<F>) -> Progress<F, Nothing> {
        Progress {
            feedback,
            ..Progress::new(&self.goal_id, 0, GoalState::Running)
        }
    }

    /// Number of the last heartbeat and the latest feedback.
    pub(crate) fn latest(&self) -> (u64, Option<F>) {
        let state = self.lock();
        (state.granted, state.latest.clone())
    }

    /// Takes a heartbeat.
    pub(crate) fn beat(&self, beat: Waiting) -> Taken {
        let mut state = self.lock();
        if state.ended {
            return Taken::Ended(beat);
        }
        let (waiting, feedback) = if self.beat_limit.is_some() {
            let expected = state.answered + 1;
            if beat.seq == expected {
                if state.granted < expected {
                    state.granted = expected;
                    state.last_beat = Instant::now();
                }
                state.waiting.push(beat);
                drop(state);
                self.changed.notify_waiters();
                return Taken::Owed;
            }
            if beat.seq != state.answered || beat.seq == 0 {
                drop(state);
                let text = format!("heartbeat {}, expected {expected}", beat.seq);
                let fault = self.sink.beats.fault("beat_out_of_order", text);
                let fault = fault
                    .with("found_seq", beat.seq as f64)
                    .with("expected_seq", expected as f64);
                self.sink.beats.refuse(&beat.query, &fault, beat.format);
                return Taken::Answered;
            }
            (beat, state.repeated.clone())
        } else {
            state.granted += 1;
            state.last_beat = Instant::now();
            let unsent = state.unsent.take();
            if unsent.is_none() {
                state.waiting.push(beat);
                drop(state);
                self.changed.notify_waiters();
                return Taken::Owed;
            }
            (beat, unsent)
        };
        drop(state);
        self.changed.notify_waiters();
        self.sink.answer(vec![waiting], self.progress(feedback));
        Taken::Answered
    }

    /// Answers what has been waiting since before `moment` without news; not in lockstep.
    pub(crate) fn answer_without_news(&self, seq: u64) {
        let mut state = self.lock();
        let (due, later) = state.waiting.drain(..).partition(|w| w.seq <= seq);
        state.waiting = later;
        drop(state);
        self.sink.answer(due, self.progress(None));
    }

    fn feedback(&self, feedback: F) {
        let mut state = self.lock();
        if state.ended {
            return;
        }
        state.latest = Some(feedback.clone());
        state.unsent = Some(feedback.clone());
        let answer = self.end_period(&mut state);
        let seq = state.granted;
        drop(state);
        if let Some((waiting, feedback)) = answer {
            self.sink.answer(waiting, self.progress(feedback));
        }
        let progress = Progress {
            seq,
            ..self.progress(Some(feedback))
        };
        self.sink
            .publish(write_as(&progress, &self.sink.schema, Format::Bincode));
    }

    /// The heartbeats that can be answered now, and the feedback that goes with them.
    fn end_period(&self, state: &mut State<F>) -> Option<(Vec<Waiting>, Option<F>)> {
        if self.beat_limit.is_some() {
            if state.taken == state.answered {
                return None;
            }
            state.answered = state.taken;
            state.repeated = state.unsent.take();
            return Some((std::mem::take(&mut state.waiting), state.repeated.clone()));
        }
        if state.waiting.is_empty() {
            return None;
        }
        Some((std::mem::take(&mut state.waiting), state.unsent.take()))
    }

    async fn next_beat(&self) -> Interrupt {
        if self.beat_limit.is_some() {
            let mut state = self.lock();
            let answer = self.end_period(&mut state);
            drop(state);
            if let Some((waiting, feedback)) = answer {
                self.sink.answer(waiting, self.progress(feedback));
            }
        }
        let started = Instant::now();
        let next = self.until(|state| {
            if state.interrupt.is_some() {
                return state.interrupt.clone();
            }
            let beat = state.taken < state.granted;
            state.taken = state.granted;
            beat.then_some(Interrupt::Beat)
        });
        match self.beat_limit {
            None => next.await,
            Some(limit) => {
                tokio::time::timeout(limit, next)
                    .await
                    .unwrap_or_else(|_| Interrupt::Overdue {
                        waited_ms: started.elapsed().as_millis() as u64,
                    })
            }
        }
    }

    /// Waits until `look` finds something.
    async fn until<T>(&self, mut look: impl FnMut(&mut State<F>) -> Option<T>) -> T {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            if let Some(found) = look(&mut self.lock()) {
                return found;
            }
            changed.await;
        }
    }

    /// Interrupts the goal; the first reason stays.
    pub(crate) fn interrupt(&self, why: Interrupt) {
        self.lock().interrupt.get_or_insert(why);
        self.changed.notify_waiters();
    }

    /// Marks the goal as ended: from now on heartbeats are given back.
    pub(crate) fn end(&self) -> Remains<F> {
        let mut state = self.lock();
        state.ended = true;
        let waiting = std::mem::take(&mut state.waiting);
        (
            waiting,
            state.latest.take(),
            state.unsent.take(),
            state.granted,
        )
    }
}
