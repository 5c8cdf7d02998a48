//! The commanding side of an action.

use super::wire::{Beat, CancelRequest, GoalRequest, GoalState, Progress, beat_key, cancel_key};
use crate::{
    BusError, Peer,
    peer::{Inner, Urgency, Witness},
};
use rover_messages::{Fault, Wire};
use std::{
    marker::PhantomData,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

/// Limit for the answer to a goal or a cancel.
const CONTROL_LIMIT: Duration = Duration::from_secs(10);
/// Limit for the answer to a heartbeat: a granted period must be over within this wall-clock time.
const BEAT_LIMIT: Duration = Duration::from_secs(30);

/// A goal that was accepted. Dropping it neither cancels nor finishes it.
pub struct Goal<F, R> {
    canceller: Canceller<F, R>,
    beat_key: String,
    /// Number of the next heartbeat.
    seq: u64,
    limit: Duration,
    server: Option<Witness>,
}

/// Calls a goal off, from anywhere, while somebody else waits for its heartbeat.
pub struct Canceller<F, R> {
    inner: Arc<Inner>,
    key: String,
    id: String,
    kind: PhantomData<fn() -> (F, R)>,
}

impl<F, R> Clone for Canceller<F, R> {
    fn clone(&self) -> Self {
        Self {
            inner: self.inner.clone(),
            key: self.key.clone(),
            id: self.id.clone(),
            kind: PhantomData,
        }
    }
}

impl<F, R> std::fmt::Debug for Canceller<F, R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Canceller({} {})", self.key, self.id)
    }
}

impl<F, R> std::fmt::Debug for Goal<F, R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Goal({} {})", self.canceller.key, self.canceller.id)
    }
}

impl Peer {
    /// Gives the action on `key` a goal, with this peer as commander: it must have announced
    /// itself. The goal's id is this peer's name and a counter.
    ///
    /// # Errors
    /// [`BusError::Fault`] with `busy`, `commander_absent`, `cancelled`, `goal_id_reused` or a
    /// payload fault; those of [`Peer::ask`].
    pub async fn command<G: Wire, F: Wire, R: Wire>(
        &self,
        key: &str,
        goal: &G,
    ) -> Result<Goal<F, R>, BusError> {
        let count = self.inner.goals.fetch_add(1, Ordering::Relaxed) + 1;
        self.command_as(key, &format!("{}-{count}", self.inner.name), goal)
            .await
    }

    /// As [`Peer::command`], with an id of one's own. The same id and goal again take up the goal
    /// that was accepted before.
    ///
    /// # Errors
    /// Those of [`Peer::command`].
    pub async fn command_as<G: Wire, F: Wire, R: Wire>(
        &self,
        key: &str,
        goal_id: &str,
        goal: &G,
    ) -> Result<Goal<F, R>, BusError> {
        let request = GoalRef {
            goal_id,
            commander: &self.inner.name,
            goal,
        };
        let limit = CONTROL_LIMIT;
        let (progress, server): (Progress<F, R>, _) = self
            .inner
            .request_as(key, &request, Urgency::Clock, limit, None)
            .await?;
        Ok(Goal {
            server: server.and_then(|name| Witness::of(&self.inner.roll, name)),
            canceller: Canceller {
                inner: self.inner.clone(),
                key: key.to_owned(),
                id: goal_id.to_owned(),
                kind: PhantomData,
            },
            beat_key: beat_key(key),
            seq: progress.seq + 1,
            limit: BEAT_LIMIT,
        })
    }
}

impl<F: Wire, R: Wire> Canceller<F, R> {
    /// Calls the goal off. Its end is still to be awaited.
    ///
    /// # Errors
    /// Those of [`Peer::ask`].
    pub async fn cancel(&self) -> Result<(), BusError> {
        let request = CancelRequest {
            goal_id: self.id.clone(),
        };
        let key = cancel_key(&self.key);
        let answer: (Progress<F, R>, _) = self
            .inner
            .request(&key, &request, Urgency::Clock, CONTROL_LIMIT)
            .await?;
        tracing::debug!(goal = self.id, state = ?answer.0.state, "cancel");
        Ok(())
    }
}

impl<F: Wire, R: Wire> Goal<F, R> {
    /// The goal's id.
    pub fn id(&self) -> &str {
        &self.canceller.id
    }

    /// Sets the wall-clock limit for the answer to a heartbeat, 30 s unless set.
    pub fn set_beat_limit(&mut self, limit: Duration) {
        self.limit = limit;
    }

    /// Sends the next heartbeat and waits for its answer: in lockstep when the granted period is
    /// over, else on news or after 200 ms. The answer carries the feedback that is new. After an
    /// error the next call repeats the same heartbeat.
    ///
    /// # Errors
    /// [`BusError::PeerLost`] if the server has left the network since it accepted the goal;
    /// those of [`Peer::ask`].
    pub async fn beat(&mut self) -> Result<Progress<F, R>, BusError> {
        let beat = Beat {
            goal_id: self.canceller.id.clone(),
            seq: self.seq,
        };
        let (progress, _) = self
            .canceller
            .inner
            .request_as(
                &self.beat_key,
                &beat,
                Urgency::Clock,
                self.limit,
                self.server.as_ref(),
            )
            .await?;
        self.seq += 1;
        Ok(progress)
    }

    /// Calls the goal off; see [`Canceller::cancel`].
    ///
    /// # Errors
    /// Those of [`Peer::ask`].
    pub async fn cancel(&self) -> Result<(), BusError> {
        self.canceller.cancel().await
    }

    /// A handle to call the goal off while [`Goal::beat`] or [`Goal::finish`] is waiting.
    pub fn canceller(&self) -> Canceller<F, R> {
        self.canceller.clone()
    }

    /// Sends heartbeats until the goal has ended.
    ///
    /// # Errors
    /// [`BusError::Fault`] with the goal's fault if it failed or was cancelled;
    /// [`BusError::GoalUnknown`] if the server has forgotten it; those of [`Goal::beat`].
    pub async fn finish(mut self, mut on_feedback: impl FnMut(&F) + Send) -> Result<R, BusError> {
        loop {
            let progress = self.beat().await?;
            if let Some(feedback) = &progress.feedback {
                on_feedback(feedback);
            }
            match progress.state {
                GoalState::Accepted | GoalState::Running => {}
                GoalState::Succeeded => return progress.result.ok_or_else(|| self.incomplete()),
                GoalState::Failed | GoalState::Cancelled => {
                    let fault = progress.fault.map(BusError::Fault);
                    return Err(fault.unwrap_or_else(|| self.incomplete()));
                }
                GoalState::Unknown => {
                    return Err(BusError::GoalUnknown {
                        key: self.canceller.key.clone(),
                        goal_id: self.canceller.id.clone(),
                    });
                }
            }
        }
    }

    fn incomplete(&self) -> BusError {
        let text = format!(
            "goal `{}` ended without result and without fault",
            self.id()
        );
        BusError::Fault(Fault::new(&self.canceller.key, "bad_answer", text))
    }
}

/// A [`GoalRequest`] around a borrowed goal; the same bytes.
#[derive(serde::Serialize)]
struct GoalRef<'a, G> {
    goal_id: &'a str,
    commander: &'a str,
    goal: &'a G,
}

impl<G: Wire> crate::exchange::Question for GoalRef<'_, G> {
    fn bytes(&self) -> Result<(Vec<u8>, String), rover_messages::codec::CodecError> {
        use crate::exchange::{Form, write_marked};
        use rover_messages::codec::CodecError;
        let schema = GoalRequest::<G>::schema();
        self.goal.validate().map_err(|reason| CodecError::Invalid {
            schema: schema.to_string(),
            reason,
        })?;
        write_marked(self, &schema)
    }
}
