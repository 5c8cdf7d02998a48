//! Questions and actions that an abort interrupts.

use super::{Abort, CANCEL_LIMIT, RUNNER};
use rover_bus::{BusError, GoalState, Peer};
use rover_messages::{Fault, Wire};
use std::{future::Future, time::Duration};

/// The answer, unless the run is aborted before it comes.
pub(super) async fn unless<T>(
    abort: &Abort,
    answer: impl Future<Output = Result<T, BusError>>,
) -> Result<T, Fault> {
    tokio::select! {
        biased;
        reason = abort.requested() => Err(reason),
        answer = answer => answer.map_err(|e| e.into_fault(RUNNER)),
    }
}

/// Commands an action and follows it to its end; an abort or the limit cancels it.
pub(super) async fn act<G: Wire, F: Wire, R: Wire>(
    peer: &Peer,
    abort: &Abort,
    limit: Duration,
    key: &str,
    goal: &G,
    mut on_feedback: impl AsyncFnMut(&F),
) -> Result<R, Fault> {
    let fault = |error: BusError| error.into_fault(RUNNER);
    let mut goal = unless(abort, peer.command::<G, F, R>(key, goal)).await?;
    let deadline = tokio::time::Instant::now() + limit;
    loop {
        let early = tokio::select! {
            biased;
            progress = goal.beat() => {
                let progress = progress.map_err(fault)?;
                if let Some(feedback) = &progress.feedback {
                    on_feedback(feedback).await;
                }
                match progress.state {
                    GoalState::Accepted | GoalState::Running => continue,
                    GoalState::Succeeded => return progress.result.ok_or_else(|| {
                        Fault::new(RUNNER, "bad_message", format!("{key}: success without result"))
                    }),
                    _ => return Err(progress.fault.unwrap_or_else(|| {
                        Fault::new(RUNNER, "cancelled", format!("{key}: the goal was cancelled"))
                    })),
                }
            }
            reason = abort.requested() => reason,
            () = tokio::time::sleep_until(deadline) => Fault::new(
                RUNNER,
                "timeout",
                format!("{key}: not finished after limits.action_s = {} s", limit.as_secs_f64()),
            ),
        };
        // Ends by itself once the goal is cancelled; the reason for the abort is what counts.
        let wound_down = async {
            goal.cancel().await?;
            loop {
                let state = goal.beat().await?.state;
                if !matches!(state, GoalState::Accepted | GoalState::Running) {
                    return Ok::<(), BusError>(());
                }
            }
        };
        match tokio::time::timeout(CANCEL_LIMIT, wound_down).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(%error, key, "the cancelled goal was lost"),
            Err(_) => tracing::warn!(key, "the cancelled goal did not end in time"),
        }
        return Err(early);
    }
}
