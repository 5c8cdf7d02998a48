//! Ending a mission early.

use rover_messages::Fault;
use std::sync::Arc;
use tokio::sync::watch;

/// Tells a running mission to end early, and why; the first reason counts.
#[derive(Clone, Debug)]
pub struct Abort {
    reason: Arc<watch::Sender<Option<Fault>>>,
}

impl Default for Abort {
    fn default() -> Self {
        Self {
            reason: Arc::new(watch::Sender::new(None)),
        }
    }
}

impl Abort {
    /// Ends the mission with this reason.
    pub fn now(&self, reason: Fault) {
        self.reason.send_if_modified(|present| {
            let first = present.is_none();
            if first {
                *present = Some(reason);
            }
            first
        });
    }

    /// The reason, as soon as there is one.
    pub async fn requested(&self) -> Fault {
        let mut reason = self.reason.subscribe();
        loop {
            if let Some(fault) = reason.borrow_and_update().clone() {
                return fault;
            }
            // The sender lives in `self`, so a change always comes or nobody ever asks.
            if reason.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }
}
