//! What every service's shell does alike: it tells its state, counts, reports its faults, and
//! shows that it is alive.
//!
//! ```ignore
//! let shell = ServiceShell::new(peer, &robot, "arm_planner").await?;
//! let served = peer.serve("planner/plan", { let shell = shell.clone(); move |q| { .. } }).await?;
//! shell.start(vec![served]).await // presence comes last: whoever sees it can ask every key
//! ```

pub mod frames;
pub mod motion;
mod reach;

pub use reach::{joints_refusal, reach_refusal};

use rover_bus::{BusError, Peer, Presence, Served, Stream};
use rover_messages::{
    Fault, keys,
    status::{FaultReport, ServiceStatus},
};
use rover_robot::Robot;
use std::{
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Instant,
};

/// State of a service that waits for something to do.
pub const READY: &str = "ready";

/// Bookkeeping of one service: what it does, what it has counted, its last fault. Cheap to clone;
/// all clones are the same service. Every change is published on `<service>/status`.
#[derive(Clone)]
pub struct ServiceShell {
    inner: Arc<Inner>,
}

struct Inner {
    peer: Peer,
    status: Mutex<ServiceStatus>,
    statuses: Stream<ServiceStatus>,
    faults: Stream<FaultReport>,
}

/// A running service; it ends when this is dropped.
#[must_use = "the service ends when its handle is dropped"]
pub struct Service {
    shell: ServiceShell,
    // Fields drop in this order: presence ends before the keys fall silent.
    _presence: Presence,
    _served: Vec<Served>,
}

/// The service does what its state says while this lives, then it is [`READY`] again.
#[must_use = "the activity ends when this is dropped"]
pub struct Activity {
    shell: ServiceShell,
}

impl ServiceShell {
    /// Declares `<name>/status` and `fault/<name>` and publishes the first status.
    ///
    /// # Errors
    /// [`BusError`] when a key cannot be declared.
    pub async fn new(peer: &Peer, robot: &Robot, name: &str) -> Result<Self, BusError> {
        let status = ServiceStatus {
            service: name.into(),
            state: READY.into(),
            last_fault: None,
            counters: Default::default(),
            busy_s: Default::default(),
            configuration_sha256: robot.configuration_sha256().into(),
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let inner = Inner {
            peer: peer.clone(),
            statuses: peer.stream(&keys::status(name)).await?,
            faults: peer.stream(&keys::fault(name)).await?,
            status: Mutex::new(status),
        };
        let shell = Self {
            inner: Arc::new(inner),
        };
        shell.change(|_| ());
        Ok(shell)
    }

    /// Announces the service's presence, after everything that it serves has been declared: who
    /// sees the presence may ask any of its keys.
    ///
    /// # Errors
    /// [`BusError`] when a service of that name is present already, or the token cannot be
    /// declared.
    pub async fn start(self, served: Vec<Served>) -> Result<Service, BusError> {
        let presence = self.inner.peer.announce().await?;
        Ok(Service {
            shell: self,
            _presence: presence,
            _served: served,
        })
    }

    /// The service's name.
    pub fn name(&self) -> String {
        self.lock().service.clone()
    }

    /// The present status.
    pub fn status(&self) -> ServiceStatus {
        self.lock().clone()
    }

    /// Says what the service is doing.
    pub fn state(&self, state: &str) {
        self.change(|s| s.state = state.into());
    }

    /// Says what the service is doing until the returned value is dropped.
    pub fn activity(&self, state: &str) -> Activity {
        self.state(state);
        Activity {
            shell: self.clone(),
        }
    }

    /// Adds one to a counter.
    pub fn count(&self, counter: &str) {
        self.change(|s| *s.counters.entry(counter.into()).or_default() += 1);
    }

    /// Computes, and counts the wall time of it under a kind of
    /// [`work`](rover_messages::status::work). The status that tells it is the next one published.
    pub fn timed<T>(&self, work: &str, compute: impl FnOnce() -> T) -> T {
        let since = Instant::now();
        let computed = compute();
        let busy_s = since.elapsed().as_secs_f64();
        *self.lock().busy_s.entry(work.into()).or_default() += busy_s;
        computed
    }

    /// Reports a fault on `fault/<service>` with what was done about it (`goal refused`, `arm
    /// stopped`), keeps it as the last fault and counts it under `faults`.
    pub fn fault(&self, fault: &Fault, action: &str) {
        tracing::warn!(fault = %fault, action, "fault");
        self.change(|s| {
            s.last_fault = Some(fault.clone());
            *s.counters.entry("faults".into()).or_default() += 1;
        });
        let report = FaultReport {
            fault: fault.clone(),
            action: action.into(),
        };
        if let Err(error) = self.inner.faults.publish(report) {
            tracing::warn!(%error, "a fault could not be published");
        }
    }

    /// Counts an answer under `counter`, or reports the refusal, and hands the outcome on.
    ///
    /// # Errors
    /// The outcome's own fault.
    pub fn answered<T>(&self, outcome: Result<T, Fault>, counter: &str) -> Result<T, Fault> {
        match &outcome {
            Ok(_) => self.count(counter),
            Err(fault) => self.fault(fault, "query refused"),
        }
        outcome
    }

    fn lock(&self) -> MutexGuard<'_, ServiceStatus> {
        // Every change is a single assignment, so a poisoned status is still whole.
        self.inner
            .status
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, change: impl FnOnce(&mut ServiceStatus)) {
        // Published under the lock, so that statuses appear in the order of their changes.
        let mut status = self.lock();
        change(&mut status);
        if let Err(error) = self.inner.statuses.publish(status.clone()) {
            tracing::warn!(%error, "the status could not be published");
        }
    }
}

impl Service {
    /// The service's bookkeeping.
    pub fn shell(&self) -> &ServiceShell {
        &self.shell
    }
}

impl Drop for Activity {
    fn drop(&mut self) {
        self.shell.state(READY);
    }
}

impl fmt::Debug for ServiceShell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServiceShell")
            .field("status", &self.status())
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Service {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Service")
            .field("status", &self.shell.status())
            .finish_non_exhaustive()
    }
}
