//! How slow a client may be: it must not bring, or take, nothing for too long, nor too little over as long a time. Only
//! the time counts in which the service waits for the client, never that in which the client waits for the service.

use std::{
    io::{self, IoSlice},
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll, ready},
    time::Duration,
};

use axum::body::{Body, Bytes, HttpBody};
use http_body::{Frame, SizeHint};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    task::JoinHandle,
    time::{Instant, Sleep, sleep},
};

/// The slowest that a client may be.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// How long nothing may move, and over how long the rate is measured.
    pub(super) idle: Duration,
    /// Bytes a second at least.
    pub(super) rate: u64,
}

/// Adds up what moved while it was waited for.
#[derive(Debug)]
pub(super) struct Meter {
    pace: Pace,
    waited: Duration,
    bytes: u64,
}

/// Too little came in this time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slow {
    pub(super) bytes: u64,
    pub(super) waited: Duration,
}

impl Meter {
    pub(super) const fn new(pace: Pace) -> Self {
        Self { pace, waited: Duration::ZERO, bytes: 0 }
    }

    /// So many bytes moved after it was waited for them; each time when enough was waited the rate is judged.
    pub(super) fn add(&mut self, waited: Duration, bytes: u64) -> Result<(), Slow> {
        self.waited += waited;
        self.bytes = self.bytes.saturating_add(bytes);
        if self.waited < self.pace.idle {
            return Ok(());
        }
        let slow = Slow { bytes: self.bytes, waited: self.waited };
        *self = Self::new(self.pace);
        let enough = slow.waited.as_secs_f64() * self.pace.rate as f64;
        if (slow.bytes as f64) < enough { Err(slow) } else { Ok(()) }
    }

    /// How much longer it may be waited before the rate is judged.
    fn left(&self) -> Duration {
        self.pace.idle.saturating_sub(self.waited)
    }
}

/// The bodies of a connection's requests that may still be read. As long as there is one the client need not read.
#[derive(Clone, Debug)]
pub(super) struct OpenBodies(Arc<Mutex<Bodies>>);

#[derive(Debug)]
struct Bodies {
    open: usize,
    /// When the last of them ended.
    ended: Instant,
}

/// One of them, until it is dropped.
#[derive(Debug)]
pub(super) struct OpenBody(OpenBodies);

impl Default for OpenBodies {
    fn default() -> Self {
        Self(Arc::new(Mutex::new(Bodies { open: 0, ended: Instant::now() })))
    }
}

impl OpenBodies {
    pub(super) fn open(&self) -> OpenBody {
        self.lock().open += 1;
        OpenBody(self.clone())
    }

    fn lock(&self) -> MutexGuard<'_, Bodies> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long it was waited for a client since then, who had nothing left to send.
    fn waited(&self, since: Instant) -> Duration {
        let bodies = self.lock();
        if bodies.open > 0 { Duration::ZERO } else { since.max(bodies.ended).elapsed() }
    }
}

impl Drop for OpenBody {
    fn drop(&mut self) {
        let mut bodies = self.0.lock();
        bodies.open -= 1;
        bodies.ended = Instant::now();
    }
}

/// A connection that fails once its client, with nothing left to send, takes what is written too slowly.
#[derive(Debug)]
pub(super) struct Watched<S> {
    stream: S,
    bodies: OpenBodies,
    meter: Meter,
    /// Since when a write waits, and when to judge that.
    stalled: Option<(Instant, Pin<Box<Sleep>>)>,
}

impl<S> Watched<S> {
    pub(super) fn new(stream: S, pace: Pace, bodies: OpenBodies) -> Self {
        Self { stream, bodies, meter: Meter::new(pace), stalled: None }
    }

    /// Judges what a write has come to.
    fn judge(&mut self, context: &mut Context<'_>, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        let Poll::Pending = written else {
            let waited = self.stalled.take().map_or(Duration::ZERO, |(since, _)| self.bodies.waited(since));
            let bytes = if let Poll::Ready(Ok(bytes)) = &written { *bytes as u64 } else { 0 };
            if self.meter.add(waited, bytes).is_err() {
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
            return written;
        };
        loop {
            let left = self.meter.left();
            let (since, timer) = self.stalled.get_or_insert_with(|| (Instant::now(), Box::pin(sleep(left))));
            ready!(timer.as_mut().poll(context));
            let waited = self.bodies.waited(*since);
            self.stalled = None;
            if self.meter.add(waited, 0).is_err() {
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Watched<S> {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, into)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Watched<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.judge(context, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, bytes);
        self.judge(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

/// The body of an answer over HTTP/2. It is let go of, with all that it holds, once the client, with nothing left to
/// send, takes it too slowly; if more is asked for then, that fails.
pub(super) struct Taken {
    taking: Arc<Mutex<Taking>>,
    watch: JoinHandle<()>,
}

struct Taking {
    body: Option<Body>,
    bodies: OpenBodies,
    meter: Meter,
    /// Since when the head, or a part, waits to be taken: the next part is asked for once it is.
    since: Option<Instant>,
}

impl Taking {
    /// What is still to be waited before the client is judged.
    fn left(&self) -> Duration {
        let left = self.meter.left();
        self.since.map_or(left, |since| left.saturating_sub(self.bodies.waited(since)))
    }

    /// Adds the time waited up to now, if it was; gives the body if that was too long.
    fn judge(&mut self) -> Option<Body> {
        let since = self.since.as_mut()?;
        let waited = self.bodies.waited(*since);
        *since = Instant::now();
        if self.meter.add(waited, 0).is_err() { self.body.take() } else { None }
    }
}

fn lock(taking: &Mutex<Taking>) -> MutexGuard<'_, Taking> {
    taking.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Taken {
    /// Must be called within a tokio runtime.
    pub(super) fn new(body: Body, pace: Pace, bodies: OpenBodies) -> Self {
        let taking = Taking { body: Some(body), bodies, meter: Meter::new(pace), since: Some(Instant::now()) };
        let taking = Arc::new(Mutex::new(taking));
        let watched = Arc::clone(&taking);
        let watch = tokio::spawn(async move {
            loop {
                let left = lock(&watched).left();
                sleep(left.max(Duration::from_millis(1))).await;
                // Dropped when nothing is locked any more.
                let slow = lock(&watched).judge();
                if slow.is_some() {
                    return;
                }
            }
        });
        Self { taking, watch }
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.watch.abort();
    }
}

impl HttpBody for Taken {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let mut taking = lock(&self.taking);
        let slow = taking.judge();
        taking.since = None;
        let Some(body) = &mut taking.body else {
            drop((taking, slow));
            return Poll::Ready(Some(Err(axum::Error::new(io::Error::from(io::ErrorKind::TimedOut)))));
        };
        let polled = Pin::new(body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled {
            let bytes = frame.data_ref().map_or(0, |data| data.len() as u64);
            // No time was waited for these yet.
            let _ = taking.meter.add(Duration::ZERO, bytes);
            taking.since = Some(Instant::now());
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        lock(&self.taking).body.as_ref().is_some_and(Body::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        lock(&self.taking).body.as_ref().map_or_else(SizeHint::default, Body::size_hint)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    const PACE: Pace = Pace { idle: Duration::from_secs(10), rate: 100 };

    #[test]
    fn the_rate_is_that_of_the_time_waited() {
        let mut meter = Meter::new(PACE);
        // 1000 bytes in 10 seconds will do, 999 will not.
        assert_eq!(meter.add(Duration::from_secs(9), 900), Ok(()));
        assert_eq!(meter.left(), Duration::from_secs(1));
        assert_eq!(meter.add(Duration::from_secs(1), 100), Ok(()));
        assert_eq!(meter.add(Duration::from_secs(4), 999), Ok(()));
        let slow = Slow { bytes: 999, waited: PACE.idle };
        assert_eq!(meter.add(Duration::from_secs(6), 0), Err(slow));
        // What came without being waited for counts, and each time it starts anew.
        assert_eq!(meter.add(Duration::ZERO, 5000), Ok(()));
        assert_eq!(meter.add(Duration::from_secs(50), 0), Ok(()));
        assert!(meter.add(Duration::from_secs(10), 0).is_err());
    }

    #[test]
    fn who_does_not_read_is_given_up_unless_he_still_sends() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let (bodies, idle) = (OpenBodies::default(), Duration::from_millis(50));
            let (near, mut far) = duplex(64);
            let mut watched = Watched::new(near, Pace { idle, rate: 10_000 }, bodies.clone());
            let body = bodies.open();
            let reader = async {
                // Several windows: nothing happens to a client that may still send.
                sleep(9 * idle / 2).await;
                let sent = Instant::now();
                drop(body);
                let mut read = [0; 64];
                far.read_exact(&mut read).await.unwrap();
                sent
            };
            let write = async { (watched.write_all(&[7; 1000]).await, Instant::now()) };
            let ((written, ended), sent) = tokio::join!(write, reader);
            assert_eq!(written.unwrap_err().kind(), io::ErrorKind::TimedOut);
            // What passed while he sent is not his time to read.
            assert!(ended - sent >= idle);
        });
    }

    #[test]
    fn who_does_not_take_an_answer_loses_it_unless_he_still_sends() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let (bodies, idle) = (OpenBodies::default(), Duration::from_millis(50));
            let alive = Arc::new(());
            let held = Arc::downgrade(&alive);
            let parts = futures_util::stream::repeat_with(move || {
                let _held = &alive;
                Ok::<_, io::Error>(Bytes::from_static(b"part"))
            });
            let open = bodies.open();
            let mut taken = Taken::new(Body::from_stream(parts), Pace { idle, rate: 1000 }, bodies);
            let mut next = async || std::future::poll_fn(|context| Pin::new(&mut taken).poll_frame(context)).await;
            assert!(next().await.unwrap().is_ok());
            // Several windows: nothing happens to a client that may still send.
            sleep(9 * idle / 2).await;
            let sent = Instant::now();
            drop(open);
            while held.strong_count() > 0 {
                sleep(idle / 10).await;
            }
            assert!(sent.elapsed() >= idle);
            assert!(next().await.unwrap().is_err());
        });
    }
}
