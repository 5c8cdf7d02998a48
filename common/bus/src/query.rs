//! The serving side of queries: one question, one answer or one fault.

use crate::{
    BusError, Peer,
    config::check_key,
    exchange::{Desk, asked_format, is_wild, question},
    peer::Inner,
};
use rover_messages::{Fault, Wire, codec::MAX_PAYLOAD_BYTES};
use std::{
    future::Future,
    panic::{AssertUnwindSafe, catch_unwind},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};
use tokio::sync::mpsc;
use zenoh::{
    key_expr::KeyExpr,
    query::{Query, Queryable},
};

/// Questions that may wait on one key; further ones are refused as `overloaded`.
const WAITING: usize = 256;

/// A served key; dropping it takes the offer back. Questions already accepted are still answered.
#[must_use = "dropping this stops the service"]
pub struct Served {
    pub(crate) key: String,
    pub(crate) _queryables: Vec<Queryable<()>>,
    pub(crate) _stop: Option<Box<dyn std::any::Any + Send + Sync>>,
}

impl Served {
    /// The key.
    pub fn key(&self) -> &str {
        &self.key
    }
}

impl std::fmt::Debug for Served {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Served({})", self.key)
    }
}

/// Runs a future to its end or to its panic. The future's own type is forgotten here, so that what
/// waits for a handler is compiled once per answer and not once per handler.
pub(crate) struct Contained<T>(Pin<Box<dyn Future<Output = T> + Send>>);

impl<T> Contained<T> {
    pub(crate) fn new(future: impl Future<Output = T> + Send + 'static) -> Self {
        Self(Box::pin(future))
    }
}

impl<T> Future for Contained<T> {
    /// The text of the panic as error.
    type Output = Result<T, String>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let poll = || self.0.as_mut().poll(cx);
        match catch_unwind(AssertUnwindSafe(poll)) {
            Ok(poll) => poll.map(Ok),
            Err(panic) => Poll::Ready(Err(panic_text(&*panic))),
        }
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("panic without text")
        .to_owned()
}

impl Inner {
    pub(crate) fn desk(&self, key: &str) -> Result<Desk, BusError> {
        check_key(key, false)?;
        let key = KeyExpr::try_from(key.to_owned()).map_err(|e| BusError::network(key, e))?;
        Ok(Desk {
            name: self.name.clone(),
            key,
        })
    }

    /// Declares a queryable whose callback gets every query, wildcards included.
    pub(crate) async fn queryable(
        &self,
        desk: &Desk,
        callback: impl Fn(Query) + Send + Sync + 'static,
    ) -> Result<Queryable<()>, BusError> {
        self.session
            .declare_queryable(desk.key.clone())
            .callback(callback)
            .await
            .map_err(|e| BusError::network(format!("serving {}", desk.key.as_str()), e))
    }

    /// Declares a queryable whose queries, addressed to exactly this key, are queued.
    pub(crate) async fn queued(
        &self,
        desk: &Desk,
    ) -> Result<(Queryable<()>, mpsc::Receiver<Query>), BusError> {
        let (queue, queries) = mpsc::channel(WAITING);
        let at = desk.clone();
        let callback = move |query: Query| {
            if is_wild(&query, &at.key) {
                return;
            }
            if let Err(e) = queue.try_send(query) {
                let text = format!("{WAITING} questions are waiting already");
                let (mpsc::error::TrySendError::Full(query)
                | mpsc::error::TrySendError::Closed(query)) = e;
                at.refuse(&query, &at.fault("overloaded", text), asked_format(&query));
            }
        };
        Ok((self.queryable(desk, callback).await?, queries))
    }
}

impl Peer {
    /// Serves `key`: questions are handled one after the other, in the order of their arrival.
    /// A handler that panics answers the fault `internal_error`.
    ///
    /// # Errors
    /// [`BusError::InvalidName`] for an unusable key, [`BusError::Network`].
    pub async fn serve<Q: Wire, A: Wire, H, Fut>(
        &self,
        key: &str,
        handler: H,
    ) -> Result<Served, BusError>
    where
        H: Fn(Q) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = Result<A, Fault>> + Send + 'static,
    {
        self.serve_limited(key, MAX_PAYLOAD_BYTES, handler).await
    }

    /// As [`Peer::serve`], with a limit on the question's payload in bytes; a larger one is
    /// refused as `payload_too_large` before it is decoded.
    ///
    /// # Errors
    /// Those of [`Peer::serve`].
    pub async fn serve_limited<Q: Wire, A: Wire, H, Fut>(
        &self,
        key: &str,
        limit_bytes: usize,
        handler: H,
    ) -> Result<Served, BusError>
    where
        H: Fn(Q) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = Result<A, Fault>> + Send + 'static,
    {
        let desk = self.inner.desk(key)?;
        let (queryable, mut queries) = self.inner.queued(&desk).await?;
        let handler = Arc::new(handler);
        self.inner.runtime.spawn(async move {
            while let Some(query) = queries.recv().await {
                let format = asked_format(&query);
                let answer = match question::<Q>(&query, limit_bytes, &desk.name) {
                    Ok(question) => Contained::new({
                        let handler = handler.clone();
                        async move { handler(question).await }
                    })
                    .await
                    .unwrap_or_else(|text| Err(desk.fault("internal_error", text))),
                    Err(fault) => Err(fault),
                };
                match answer {
                    Ok(answer) => desk.answer(&query, &answer, format),
                    Err(fault) => desk.refuse(&query, &fault, format),
                }
            }
        });
        Ok(Served {
            key: key.to_owned(),
            _queryables: vec![queryable],
            _stop: None,
        })
    }
}
