//! What travels on an action's keys.

use crate::exchange::Form;
use rover_messages::{Fault, Wire};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Keys of the action on `key`: goal on the key itself, the rest below it.
pub(crate) fn beat_key(key: &str) -> String {
    format!("{key}/beat")
}
pub(crate) fn cancel_key(key: &str) -> String {
    format!("{key}/cancel")
}
pub(crate) fn result_key(key: &str) -> String {
    format!("{key}/result")
}
pub(crate) fn feedback_key(key: &str) -> String {
    format!("{key}/feedback")
}

/// Question on the action's own key: starts a goal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(bound(serialize = "G: Serialize", deserialize = "G: Deserialize<'de>"))]
#[serde(deny_unknown_fields)]
pub struct GoalRequest<G> {
    /// Chosen by the commander; the same id twice is one goal.
    pub goal_id: String,
    /// Name under which the commander is present; it must stay present while the goal runs.
    pub commander: String,
    /// What to do.
    pub goal: G,
}

/// Question on `<action>/beat`: the commander is there and grants the next period.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Beat {
    /// The goal.
    pub goal_id: String,
    /// 1, 2, 3, ...; the same number twice grants one period.
    pub seq: u64,
}

/// Question on `<action>/cancel`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CancelRequest {
    /// The goal, which need not have arrived yet.
    pub goal_id: String,
}

/// Question on `<action>/result`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResultRequest {
    /// The goal.
    pub goal_id: String,
}

rover_messages::wire! {
    Beat = "beat/1",
    CancelRequest = "cancel_request/1",
    ResultRequest = "result_request/1",
}

/// State of a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GoalState {
    /// Accepted; its first period has not been granted yet.
    Accepted,
    /// Being worked on.
    Running,
    /// Ended with a result.
    Succeeded,
    /// Ended with a fault.
    Failed,
    /// Ended because it was cancelled.
    Cancelled,
    /// This server does not know it.
    Unknown,
}

impl GoalState {
    /// Whether nothing more will happen to the goal.
    pub fn is_end(self) -> bool {
        !matches!(self, Self::Accepted | Self::Running)
    }
}

/// Answer to every question of an action, and what `<action>/feedback` publishes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(bound(
    serialize = "F: Serialize, R: Serialize",
    deserialize = "F: Deserialize<'de>, R: Deserialize<'de>"
))]
#[serde(deny_unknown_fields)]
pub struct Progress<F, R> {
    /// The goal.
    pub goal_id: String,
    /// Number of the heartbeat that this answers; the last one received in other answers.
    pub seq: u64,
    /// Its state.
    pub state: GoalState,
    /// The latest feedback, if there has been any.
    pub feedback: Option<F>,
    /// The result, after success.
    pub result: Option<R>,
    /// The fault, after failure or cancel.
    pub fault: Option<Fault>,
}

impl<F, R> Progress<F, R> {
    pub(crate) fn new(goal_id: &str, seq: u64, state: GoalState) -> Self {
        Self {
            goal_id: goal_id.into(),
            seq,
            state,
            feedback: None,
            result: None,
            fault: None,
        }
    }
}

impl<G: Wire> Form for GoalRequest<G> {
    fn schema() -> Cow<'static, str> {
        format!("goal/1({})", G::SCHEMA).into()
    }
    fn check(&self) -> Result<(), String> {
        check_id("goal_id", &self.goal_id)?;
        check_id("commander", &self.commander)?;
        self.goal.validate().map_err(|e| format!("goal.{e}"))
    }
}

impl<F: Wire, R: Wire> Form for Progress<F, R> {
    fn schema() -> Cow<'static, str> {
        format!("progress/1({},{})", F::SCHEMA, R::SCHEMA).into()
    }
    fn check(&self) -> Result<(), String> {
        let feedback = self.feedback.as_ref().map_or(Ok(()), Wire::validate);
        feedback.map_err(|e| format!("feedback.{e}"))?;
        let result = self.result.as_ref().map_or(Ok(()), Wire::validate);
        result.map_err(|e| format!("result.{e}"))
    }
}

fn check_id(field: &str, id: &str) -> Result<(), String> {
    if (1..=128).contains(&id.len()) {
        Ok(())
    } else {
        Err(format!(
            "{field}: {} characters, expected 1 to 128",
            id.len()
        ))
    }
}
