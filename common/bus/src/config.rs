//! From a peer's role and endpoints to a Zenoh configuration.
//!
//! The defaults (see `scenarios/networks/*.json5` for the same as files): loopback only, no
//! scouting of any kind, every link named by an explicit endpoint, and opening fails if one of
//! them cannot be reached. Peers do not pass on messages between other peers, so every peer
//! connects to all that were started before it; clients reach everybody through any one peer.

use crate::BusError;
use rover_files::FileError;
use std::{path::PathBuf, time::Duration};
use zenoh::key_expr::keyexpr;

/// Time after which a silent link counts as lost. A process that ends is noticed at once; this
/// is for one that hangs.
pub const LEASE: Duration = Duration::from_secs(10);
/// Limit for reaching an endpoint when a session is opened.
pub const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// How many batches of 64 kB a stream may be ahead of its link before samples are dropped: enough
/// for a picture and for a short stall of a busy machine.
const STREAM_QUEUE: usize = 16;
/// Largest message the transport puts together, in bytes. It is twice the largest payload
/// ([`rover_messages::codec::MAX_PAYLOAD_BYTES`]), so that a payload over that limit still
/// arrives and gets an answer that says so; anything larger is dropped by the transport.
pub const MAX_MESSAGE_BYTES: usize = 32 * 1024 * 1024;

/// What a peer is; decides its place in the network and what it may see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A service: peer; everything under `sim/` is denied in both directions.
    Service,
    /// The simulator or the hardware driver: peer.
    Simulator,
    /// What starts, watches and judges a run: peer.
    Runner,
    /// A tool attached to one peer.
    Client,
}

/// How a peer joins the network.
#[derive(Clone, Debug)]
pub struct NetworkConfig {
    /// Prefix of all keys, one per robot; empty with a `file` keeps the file's.
    pub namespace: String,
    /// Name of this peer: its presence and the name in Zenoh's admin space. One key chunk.
    pub name: String,
    /// Endpoints to listen on; empty means a free loopback port (or the file's).
    pub listen: Vec<String>,
    /// Endpoints to connect to; all must be reachable.
    pub connect: Vec<String>,
    /// What this peer is.
    pub role: Role,
    /// A Zenoh configuration file (JSON5) instead of the defaults; the fields above apply on top
    /// of it where they are not empty.
    pub file: Option<PathBuf>,
}

impl NetworkConfig {
    /// A peer on a free loopback port, connected to `connect`.
    pub fn new(namespace: &str, name: &str, role: Role, connect: &[String]) -> Self {
        Self {
            namespace: namespace.into(),
            name: name.into(),
            listen: Vec::new(),
            connect: connect.to_vec(),
            role,
            file: None,
        }
    }

    /// The Zenoh configuration that this amounts to.
    ///
    /// # Errors
    /// [`BusError::InvalidName`] for an unusable name or namespace, [`BusError::Config`] for an
    /// unreadable file or a value that Zenoh refuses.
    pub fn to_zenoh(&self) -> Result<zenoh::Config, BusError> {
        check_name("peer name", &self.name)?;
        let own_namespace = !self.namespace.is_empty() || self.file.is_none();
        if own_namespace {
            check_namespace(&self.namespace)?;
        }
        let mut config = match &self.file {
            Some(path) => {
                let refused = |reason: String| BusError::Config {
                    setting: path.display().to_string(),
                    reason,
                };
                // Zenoh would say where in its own source the file was missed.
                std::fs::read(path).map_err(|e| refused(FileError::from(e).to_string()))?;
                zenoh::Config::from_file(path).map_err(|e| refused(e.to_string()))?
            }
            None => self.defaults()?,
        };
        let mut on_top = Vec::new();
        if own_namespace {
            on_top.push(("namespace", json(&self.namespace)));
        }
        if !self.listen.is_empty() {
            on_top.push(("listen/endpoints", json(&self.listen)));
        }
        if !self.connect.is_empty() {
            on_top.push(("connect/endpoints", json(&self.connect)));
        }
        on_top.push((
            "metadata",
            serde_json::json!({ "name": self.name }).to_string(),
        ));
        insert_all(&mut config, &on_top)?;
        Ok(config)
    }

    fn defaults(&self) -> Result<zenoh::Config, BusError> {
        let client = self.role == Role::Client;
        let listen = if client {
            "[]"
        } else {
            r#"["tcp/127.0.0.1:0"]"#
        };
        let mut settings = vec![
            ("mode", json(if client { "client" } else { "peer" })),
            ("listen/endpoints", listen.to_owned()),
            ("connect/exit_on_failure", "true".to_owned()),
            ("connect/timeout_ms", CONNECT_LIMIT.as_millis().to_string()),
            (
                "connect/retry",
                r#"{ period_init_ms: 50, period_max_ms: 500, period_increase_factor: 2 }"#.into(),
            ),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
            ("timestamping/enabled", "false".to_owned()),
            ("adminspace/enabled", "true".to_owned()),
            (
                "adminspace/permissions",
                "{ read: true, write: false }".to_owned(),
            ),
            ("transport/link/tx/lease", LEASE.as_millis().to_string()),
            (
                "transport/link/tx/queue/size/data",
                STREAM_QUEUE.to_string(),
            ),
            (
                "transport/link/tx/queue/size/data_low",
                STREAM_QUEUE.to_string(),
            ),
            (
                "transport/link/rx/max_message_size",
                MAX_MESSAGE_BYTES.to_string(),
            ),
            (
                "transport/shared_memory/transport_optimization/messages",
                r#"["put"]"#.to_owned(),
            ),
        ];
        if self.role == Role::Service {
            settings.push(("access_control", no_simulator(&self.namespace)));
        }
        let mut config = zenoh::Config::default();
        insert_all(&mut config, &settings)?;
        Ok(config)
    }
}

/// Access control that hides the simulator's own keys from a service, in both directions. Zenoh
/// checks keys as they are on the wire, namespace included.
fn no_simulator(namespace: &str) -> String {
    serde_json::json!({
        "enabled": true,
        "default_permission": "allow",
        "rules": [{
            "id": "no simulator truth",
            "messages": ["put", "delete", "declare_subscriber", "query", "reply",
                "declare_queryable", "liveliness_token", "liveliness_query",
                "declare_liveliness_subscriber"],
            "flows": ["ingress", "egress"],
            "permission": "deny",
            "key_exprs": [format!("{namespace}/sim/**")],
        }],
        "subjects": [{ "id": "everybody" }],
        "policies": [{ "rules": ["no simulator truth"], "subjects": ["everybody"] }],
    })
    .to_string()
}

fn json<T: serde::Serialize + ?Sized>(value: &T) -> String {
    serde_json::json!(value).to_string()
}

fn insert_all(config: &mut zenoh::Config, settings: &[(&str, String)]) -> Result<(), BusError> {
    for (path, value) in settings {
        config
            .insert_json5(path, value)
            .map_err(|e| BusError::Config {
                setting: format!("{path} = {value}"),
                reason: e.to_string(),
            })?;
    }
    Ok(())
}

/// Checks a name that becomes one chunk of a key.
pub(crate) fn check_name(what: &'static str, name: &str) -> Result<(), BusError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    if !name.is_empty() && name.len() <= 128 && name.chars().all(plain) {
        return Ok(());
    }
    Err(BusError::InvalidName {
        what,
        found: name.to_owned(),
        expected: "expected 1 to 128 letters, digits, `_`, `-` or `.`",
    })
}

fn check_namespace(namespace: &str) -> Result<(), BusError> {
    let invalid = || BusError::InvalidName {
        what: "namespace",
        found: namespace.to_owned(),
        expected: "expected names joined by `/`, e.g. `rover` or `site/rover`",
    };
    namespace
        .split('/')
        .try_for_each(|chunk| check_name("namespace", chunk).map_err(|_| invalid()))
}

/// Checks a key, wildcards allowed or not.
pub(crate) fn check_key(key: &str, wildcards: bool) -> Result<(), BusError> {
    let found = || key.to_owned();
    match keyexpr::new(key) {
        Ok(ke) if wildcards || !ke.is_wild() => Ok(()),
        Ok(_) => Err(BusError::InvalidName {
            what: "key",
            found: found(),
            expected: "expected a key without wildcards",
        }),
        Err(_) => Err(BusError::InvalidName {
            what: "key",
            found: found(),
            expected: "expected names joined by single `/`",
        }),
    }
}
