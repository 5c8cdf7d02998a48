//! What can go wrong between two peers.

use rover_messages::{Fault, codec::CodecError};
use std::time::Duration;
use thiserror::Error;

/// Failure of a bus operation; the text says what, where and what was expected.
#[derive(Debug, Error)]
pub enum BusError {
    /// A name, namespace or key that the network cannot carry.
    #[error("{what} `{found}`: {expected}")]
    InvalidName {
        /// What kind of name.
        what: &'static str,
        /// The name.
        found: String,
        /// What it should look like.
        expected: &'static str,
    },
    /// A setting that Zenoh refuses, or a network file that cannot be read.
    #[error("network setting {setting}: {reason}")]
    Config {
        /// Path of the setting or of the file.
        setting: String,
        /// Zenoh's reason.
        reason: String,
    },
    /// The session could not be opened.
    #[error("{name}: no session (listen {listen:?}, connect {connect:?}): {reason}")]
    Open {
        /// Name of this peer.
        name: String,
        /// Endpoints to listen on.
        listen: Vec<String>,
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// Zenoh's reason.
        reason: String,
    },
    /// A Zenoh operation failed.
    #[error("{what}: {reason}")]
    Network {
        /// The operation and its key.
        what: String,
        /// Zenoh's reason.
        reason: String,
    },
    /// This session or the other end of a handle was closed.
    #[error("{what}: the session is closed")]
    Closed {
        /// What was being waited for.
        what: String,
    },
    /// Another instance with the same name is on the network.
    #[error("`{name}` is already present in namespace `{namespace}`, expected one instance")]
    AlreadyPresent {
        /// The name.
        name: String,
        /// The namespace.
        namespace: String,
    },
    /// The presence barrier was not reached.
    #[error("not present after {:.3} s: {}", waited.as_secs_f64(), missing.join(", "))]
    Absent {
        /// Names that did not announce themselves.
        missing: Vec<String>,
        /// How long was waited.
        waited: Duration,
    },
    /// Nobody answers on this key.
    #[error("{key}: nobody answered within {:.3} s", waited.as_secs_f64())]
    NoAnswer {
        /// The key.
        key: String,
        /// How long was tried.
        waited: Duration,
    },
    /// Somebody is there but did not answer in time.
    #[error("{key}: no answer within {:.3} s", limit.as_secs_f64())]
    Timeout {
        /// The key.
        key: String,
        /// The limit.
        limit: Duration,
    },
    /// The peer that was answering has left the network.
    #[error("{key}: `{name}` has left the network")]
    PeerLost {
        /// The key.
        key: String,
        /// Name of the peer, or its key where it never gave its name.
        name: String,
    },
    /// A server does not know a goal it had accepted; it has been restarted.
    #[error("{key}: goal `{goal_id}` is unknown to the server, which must have been restarted")]
    GoalUnknown {
        /// The action's key.
        key: String,
        /// The goal.
        goal_id: String,
    },
    /// A refusal or failure by name.
    #[error(transparent)]
    Fault(Fault),
    /// A message that arrived and cannot be used.
    #[error("{key}: {error}")]
    Decode {
        /// The key.
        key: String,
        /// What was found and expected.
        error: CodecError,
    },
    /// A message that cannot be sent.
    #[error("{key}: {error}")]
    Encode {
        /// The key.
        key: String,
        /// What was found and expected.
        error: CodecError,
    },
}

impl BusError {
    /// Name of the fault behind it, if it is one.
    pub fn fault_name(&self) -> Option<&str> {
        match self {
            Self::Fault(fault) => Some(&fault.name),
            _ => None,
        }
    }

    /// The same failure as a fault that `service` raises: a fault of another service is passed on
    /// as it is, everything else gets a stable name (`peer_lost`, `no_answer`, `timeout`,
    /// `bad_message`, `network`).
    pub fn into_fault(self, service: &str) -> Fault {
        let name = match &self {
            Self::Fault(_) => "",
            Self::PeerLost { .. } | Self::GoalUnknown { .. } => "peer_lost",
            Self::NoAnswer { .. } | Self::Absent { .. } => "no_answer",
            Self::Timeout { .. } => "timeout",
            Self::Decode { .. } | Self::Encode { .. } => "bad_message",
            _ => "network",
        };
        match self {
            Self::Fault(fault) => fault,
            other => Fault::new(service, name, other.to_string()),
        }
    }

    pub(crate) fn network(what: impl Into<String>, reason: impl ToString) -> Self {
        Self::Network {
            what: what.into(),
            reason: reason.to_string(),
        }
    }
}
