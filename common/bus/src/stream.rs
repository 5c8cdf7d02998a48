//! Streams: published values of which only the latest counts.

use crate::{
    BusError, Peer,
    config::check_key,
    exchange::{Desk, asked_format, is_wild, read, write},
    peer::Urgency,
};
use rover_messages::{
    Wire,
    codec::{self, Format, MAX_PAYLOAD_BYTES},
};
use std::{
    marker::PhantomData,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};
use tokio::{
    sync::mpsc,
    time::{Instant, timeout_at},
};
use zenoh::{
    Wait,
    bytes::Encoding,
    handlers::{RingChannel, RingChannelHandler},
    pubsub::{Publisher, Subscriber},
    qos::{CongestionControl, Priority},
    query::{Query, Queryable},
    sample::Sample,
};

/// The publishing side of a stream.
pub struct Stream<T> {
    desk: Desk,
    publisher: Publisher<'static>,
    latest: Arc<Mutex<Option<T>>>,
    encoding: Encoding,
    _queryable: Queryable<()>,
}

impl<T> std::fmt::Debug for Stream<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Stream({})", self.desk.key.as_str())
    }
}

impl<T: Wire + Clone> Stream<T> {
    /// Publishes a value. Whoever asks from now on gets it; a subscriber whose link is congested
    /// misses it. Never waits for a subscriber.
    ///
    /// # Errors
    /// [`BusError::Encode`] if the value is not valid; [`BusError::Network`] if the session is
    /// closed.
    pub fn publish(&self, value: T) -> Result<(), BusError> {
        let bytes = write(&value, Format::Bincode).map_err(|error| BusError::Encode {
            key: self.desk.key.to_string(),
            error,
        })?;
        // One lock for both, so that the last value published is the one kept.
        let mut latest = self.latest.lock().unwrap_or_else(|e| e.into_inner());
        *latest = Some(value);
        let put = self
            .publisher
            .put(bytes)
            .encoding(self.encoding.clone())
            .wait();
        drop(latest);
        put.map_err(|e| BusError::network(format!("publishing {}", self.desk.key.as_str()), e))
    }
}

/// The publishing side of a stream of pictures: image files as they are.
pub struct PictureStream {
    key: String,
    work: mpsc::UnboundedSender<Work>,
    _queryable: Queryable<()>,
}

impl std::fmt::Debug for PictureStream {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PictureStream({})", self.key)
    }
}

type Producer = Box<dyn FnOnce() -> Arc<[u8]> + Send>;

enum Work {
    Picture(String, Producer),
    Query(Query),
}

impl PictureStream {
    /// Publishes a picture of the given media type (`image/png`). `producer` makes the bytes on
    /// another thread, and only if somebody subscribes or asks; no bytes mean that it could not.
    ///
    /// # Errors
    /// [`BusError::Closed`] if the peer's runtime has ended.
    pub fn publish<P>(&self, content_type: &str, producer: P) -> Result<(), BusError>
    where
        P: FnOnce() -> Arc<[u8]> + Send + 'static,
    {
        self.work
            .send(Work::Picture(content_type.to_owned(), Box::new(producer)))
            .map_err(|_| BusError::Closed {
                what: self.key.clone(),
            })
    }
}

/// The task behind a picture stream.
struct Gallery {
    desk: Desk,
    publisher: Publisher<'static>,
    pending: Option<Producer>,
    picture: Option<(String, Arc<[u8]>)>,
}

impl Gallery {
    async fn run(mut self, mut work: mpsc::UnboundedReceiver<Work>) {
        while let Some(item) = work.recv().await {
            match item {
                Work::Picture(media_type, producer) => {
                    self.pending = Some(producer);
                    self.picture = Some((media_type, Arc::default()));
                    let wanted = self.publisher.matching_status().await;
                    // A newer one is waiting already: nobody needs this one.
                    if work.is_empty() && wanted.is_ok_and(|status| status.matching()) {
                        self.put().await;
                    }
                }
                Work::Query(query) => self.answer(&query).await,
            }
        }
    }

    async fn make(&mut self) -> Option<(String, Arc<[u8]>)> {
        if let Some(producer) = self.pending.take() {
            let bytes = tokio::task::spawn_blocking(producer)
                .await
                .unwrap_or_default();
            if let Some(picture) = &mut self.picture {
                picture.1 = bytes;
            }
        }
        self.picture.clone().filter(|(_, bytes)| !bytes.is_empty())
    }

    async fn put(&mut self) {
        let Some((media_type, bytes)) = self.make().await else {
            tracing::warn!(key = self.desk.key.as_str(), "no picture could be made");
            return;
        };
        let put = self.publisher.put(bytes.to_vec()).encoding(media_type);
        if let Err(e) = put.await {
            tracing::debug!(key = self.desk.key.as_str(), "picture not published: {e}");
        }
    }

    async fn answer(&mut self, query: &Query) {
        match self.make().await {
            Some((media_type, bytes)) => self.desk.answer_bytes(query, bytes.to_vec(), media_type),
            None if is_wild(query, &self.desk.key) => {}
            None => {
                let (name, text) = match self.picture {
                    None => ("no_value_yet", "no picture has been published yet"),
                    Some(_) => ("no_picture", "the latest picture could not be made"),
                };
                self.desk
                    .refuse(query, &self.desk.fault(name, text), asked_format(query));
            }
        }
    }
}

/// The subscribing side of a stream.
pub struct Watcher<T> {
    key: String,
    source: Source,
    lost: Arc<AtomicU64>,
    kind: PhantomData<fn() -> T>,
}

enum Source {
    Latest(Subscriber<RingChannelHandler<Sample>>),
    Each(
        mpsc::Receiver<Sample>,
        #[allow(dead_code, reason = "undeclared on drop")] Subscriber<()>,
    ),
}

impl<T> std::fmt::Debug for Watcher<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Watcher({})", self.key)
    }
}

impl<T: Wire> Watcher<T> {
    /// The next value. With [`Peer::watch`] values that were replaced meanwhile are skipped.
    ///
    /// # Errors
    /// [`BusError::Decode`] for a value that is not a `T`; the watcher goes on.
    /// [`BusError::Closed`] when the session is closed.
    pub async fn next(&mut self) -> Result<T, BusError> {
        self.next_with_key().await.map(|(_, value)| value)
    }

    /// As [`Watcher::next`], with the key it was published on.
    ///
    /// # Errors
    /// Those of [`Watcher::next`].
    pub async fn next_with_key(&mut self) -> Result<(String, T), BusError> {
        let sample = match &mut self.source {
            Source::Latest(subscriber) => subscriber.recv_async().await.ok(),
            Source::Each(samples, _) => samples.recv().await,
        };
        let sample = sample.ok_or_else(|| BusError::Closed {
            what: self.key.clone(),
        })?;
        let key = sample.key_expr().to_string();
        let mark = sample.encoding().to_string();
        match read(&sample.payload().to_bytes(), &mark, MAX_PAYLOAD_BYTES) {
            Ok(value) => Ok((key, value)),
            Err(error) => Err(BusError::Decode { key, error }),
        }
    }

    /// Values dropped because the queue of [`Peer::watch_each`] was full.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

/// One sample as it travelled.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawSample {
    /// Key inside the namespace.
    pub key: String,
    /// Mark of the payload, e.g. `application/bincode;arm_state/1`.
    pub encoding: String,
    /// The payload.
    pub payload: Vec<u8>,
}

/// Subscription to samples of any type, for recorders.
pub struct RawWatcher {
    key: String,
    samples: mpsc::Receiver<Sample>,
    lost: Arc<AtomicU64>,
    _subscriber: Subscriber<()>,
}

impl RawWatcher {
    /// The next sample.
    ///
    /// # Errors
    /// [`BusError::Closed`] when the session is closed.
    pub async fn next(&mut self) -> Result<RawSample, BusError> {
        let sample = self.samples.recv().await;
        let sample = sample.ok_or_else(|| BusError::Closed {
            what: self.key.clone(),
        })?;
        Ok(RawSample {
            key: sample.key_expr().to_string(),
            encoding: sample.encoding().to_string(),
            payload: sample.payload().to_bytes().into_owned(),
        })
    }

    /// Samples dropped because the queue was full.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

impl Peer {
    async fn publisher(
        &self,
        desk: &Desk,
        priority: Priority,
    ) -> Result<Publisher<'static>, BusError> {
        self.inner
            .session
            .declare_publisher(desk.key.clone())
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .express(true)
            .await
            .map_err(|e| BusError::network(format!("publishing {}", desk.key.as_str()), e))
    }

    /// Opens a stream on `key`.
    ///
    /// # Errors
    /// [`BusError::InvalidName`] for an unusable key, [`BusError::Network`].
    pub async fn stream<T: Wire + Clone>(&self, key: &str) -> Result<Stream<T>, BusError> {
        let desk = self.inner.desk(key)?;
        let latest = Arc::new(Mutex::new(None::<T>));
        let (at, kept, runtime) = (desk.clone(), latest.clone(), self.inner.runtime.clone());
        let queryable = self.inner.queryable(&desk, move |query| {
            let (at, kept) = (at.clone(), kept.clone());
            runtime.spawn(async move {
                let value = kept.lock().unwrap_or_else(|e| e.into_inner()).clone();
                let format = asked_format(&query);
                match value {
                    Some(value) => at.answer(&query, &value, format),
                    None if is_wild(&query, &at.key) => {}
                    None => {
                        let fault = at.fault("no_value_yet", "nothing has been published yet");
                        at.refuse(&query, &fault, format);
                    }
                }
            });
        });
        Ok(Stream {
            publisher: self.publisher(&desk, Priority::Data).await?,
            latest,
            encoding: codec::encoding::<T>(Format::Bincode).into(),
            _queryable: queryable.await?,
            desk,
        })
    }

    /// Opens a stream of pictures on `key`.
    ///
    /// # Errors
    /// Those of [`Peer::stream`].
    pub async fn picture_stream(&self, key: &str) -> Result<PictureStream, BusError> {
        let desk = self.inner.desk(key)?;
        let publisher = self.publisher(&desk, Priority::DataLow).await?;
        let (work, worked) = mpsc::unbounded_channel();
        let ask = work.clone();
        let callback = move |query| {
            let _ = ask.send(Work::Query(query));
        };
        let queryable = self.inner.queryable(&desk, callback).await?;
        let gallery = Gallery {
            desk,
            publisher,
            pending: None,
            picture: None,
        };
        self.inner.runtime.spawn(gallery.run(worked));
        Ok(PictureStream {
            key: key.to_owned(),
            work,
            _queryable: queryable,
        })
    }

    /// Watches a stream, or several by wildcards; only the latest value is kept until it is
    /// fetched. Begins with the next value published; the present one is [`Peer::latest`].
    ///
    /// # Errors
    /// [`BusError::InvalidName`] for an unusable key, [`BusError::Network`].
    pub async fn watch<T: Wire>(&self, key: &str) -> Result<Watcher<T>, BusError> {
        check_key(key, true)?;
        let subscriber = self
            .inner
            .session
            .declare_subscriber(key.to_owned())
            .with(RingChannel::new(1))
            .await
            .map_err(|e| BusError::network(format!("watching {key}"), e))?;
        Ok(Watcher {
            key: key.to_owned(),
            source: Source::Latest(subscriber),
            lost: Arc::default(),
            kind: PhantomData,
        })
    }

    /// Watches a stream, or several by wildcards, of which every value counts (faults, feedback):
    /// up to `capacity` values wait to be fetched, further ones are dropped and counted.
    ///
    /// # Errors
    /// Those of [`Peer::watch`].
    pub async fn watch_each<T: Wire>(
        &self,
        key: &str,
        capacity: usize,
    ) -> Result<Watcher<T>, BusError> {
        let (subscriber, samples, lost) = self.queue_samples(key, capacity).await?;
        Ok(Watcher {
            key: key.to_owned(),
            source: Source::Each(samples, subscriber),
            lost,
            kind: PhantomData,
        })
    }

    /// Watches samples of any type as they travel; as [`Peer::watch_each`].
    ///
    /// # Errors
    /// Those of [`Peer::watch`].
    pub async fn watch_raw(&self, key: &str, capacity: usize) -> Result<RawWatcher, BusError> {
        let (subscriber, samples, lost) = self.queue_samples(key, capacity).await?;
        Ok(RawWatcher {
            key: key.to_owned(),
            samples,
            lost,
            _subscriber: subscriber,
        })
    }

    async fn queue_samples(
        &self,
        key: &str,
        capacity: usize,
    ) -> Result<(Subscriber<()>, mpsc::Receiver<Sample>, Arc<AtomicU64>), BusError> {
        check_key(key, true)?;
        let (queue, samples) = mpsc::channel(capacity.max(1));
        let lost = Arc::new(AtomicU64::new(0));
        let count = lost.clone();
        let subscriber = self
            .inner
            .session
            .declare_subscriber(key.to_owned())
            .callback(move |sample| {
                if queue.try_send(sample).is_err() {
                    count.fetch_add(1, Ordering::Relaxed);
                }
            })
            .await
            .map_err(|e| BusError::network(format!("watching {key}"), e))?;
        Ok((subscriber, samples, lost))
    }

    /// The latest value of a stream; waits up to `limit` for the first one.
    ///
    /// # Errors
    /// Those of [`Peer::ask`].
    pub async fn latest<T: Wire>(&self, key: &str, limit: Duration) -> Result<T, BusError> {
        let deadline = Instant::now() + limit;
        let first = self.read_latest(key, limit).await;
        if first.as_ref().err().and_then(BusError::fault_name) != Some("no_value_yet") {
            return first;
        }
        // The stream is open but empty. Subscribe, then ask again for what came in between.
        let mut watcher = self.watch::<T>(key).await?;
        let left = deadline.saturating_duration_since(Instant::now());
        match self.read_latest(key, left).await {
            Err(BusError::Timeout { .. } | BusError::NoAnswer { .. }) => return first,
            Err(BusError::Fault(fault)) if fault.name == "no_value_yet" => {}
            other => return other,
        }
        timeout_at(deadline, watcher.next()).await.unwrap_or(first)
    }

    async fn read_latest<T: Wire>(&self, key: &str, limit: Duration) -> Result<T, BusError> {
        let encoding = codec::encoding::<T>(Format::Bincode).into();
        let (sample, _) = self
            .inner
            .exchange(key, Vec::new(), encoding, Urgency::Normal, limit, None)
            .await?;
        let mark = sample.encoding().to_string();
        read(&sample.payload().to_bytes(), &mark, MAX_PAYLOAD_BYTES).map_err(|error| {
            BusError::Decode {
                key: key.to_owned(),
                error,
            }
        })
    }
}
