//! The body of a request: frames as they come, decompressed if they are compressed.

use std::{
    io,
    pin::Pin,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use axum::{
    body::{Body, BodyDataStream, HttpBody},
    extract::Request,
    http::{HeaderMap, StatusCode, header},
};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use tokio::{runtime::Handle, time::timeout};

use super::{
    charge::Charge,
    inflate::{Inflate, Inflated},
    pace::{Meter, OpenBodies, OpenBody, Pace},
    problem::Refusal,
};

/// How long the rest of a body is read, and thrown away, whose request was answered already.
const LINGER: Duration = Duration::from_secs(10);
/// How long it may bring nothing before that is given up.
const LINGER_IDLE: Duration = Duration::from_secs(1);

/// Reads a body. Nothing is read before it is asked for, so a client that says `Expect: 100-continue` is told to go on
/// only then.
pub(super) struct Frames {
    source: BodyDataStream,
    inflate: Option<Inflate>,
    /// What came and is not decompressed yet.
    packed: Bytes,
    charge: Charge,
    pace: Pace,
    meter: Meter,
    /// Whether something of it was handed on.
    begun: bool,
    ended: bool,
}

impl Frames {
    /// Judges the content encoding. What decompressing takes is added to the request's charge.
    pub(super) fn new(headers: &HeaderMap, body: Body, charge: Charge, pace: Pace) -> Result<Self, Refusal> {
        let mut encodings = headers
            .get_all(header::CONTENT_ENCODING)
            .into_iter()
            .flat_map(|value| value.to_str().unwrap_or("?").split(','))
            .map(|name| name.trim().to_ascii_lowercase())
            .filter(|name| !name.is_empty() && name != "identity");
        let inflate = match (encodings.next().as_deref(), encodings.next()) {
            (None, _) => None,
            (Some("zstd"), None) => Some(Inflate::zstd()),
            (Some("gzip" | "x-gzip"), None) => {
                charge.add_window(0)?;
                Some(Inflate::gzip())
            }
            _ => {
                return Err(Refusal::new(
                    StatusCode::UNSUPPORTED_MEDIA_TYPE,
                    "unsupported_encoding",
                    "The content encoding is not known",
                    "Content-Encoding may be zstd or gzip, one of them, or be absent",
                ));
            }
        };
        let (source, meter) = (body.into_data_stream(), Meter::new(pace));
        Ok(Self { source, inflate, packed: Bytes::new(), charge, pace, meter, begun: false, ended: false })
    }

    /// The next bytes, never none; `Ok(None)` at the end of the body. Between tiles nothing need come for a while;
    /// elsewhere what comes must not come too slowly.
    pub(super) async fn next(&mut self, between: bool) -> Result<Option<Bytes>, Refusal> {
        loop {
            let inflated = match &mut self.inflate {
                // What was held is let go of before the next bytes take its place.
                None => Ok(Some(Inflated::Bytes(std::mem::take(&mut self.packed)))),
                Some(inflate) => inflate.next(&mut self.packed),
            };
            match inflated.map_err(|error| self.fault(&error))? {
                Some(Inflated::Bytes(bytes)) if !bytes.is_empty() => {
                    self.begun = true;
                    return Ok(Some(bytes));
                }
                // From then on the request may hold memory for a tile.
                Some(Inflated::Window(window)) if self.begun => self.charge.add_window(window)?,
                Some(Inflated::Window(window)) => self.charge.wait_window(window).await?,
                _ if self.ended => return Ok(None),
                _ => self.read(between).await?,
            }
        }
    }

    /// Waits for more.
    async fn read(&mut self, between: bool) -> Result<(), Refusal> {
        let asked = Instant::now();
        let frame = timeout(self.pace.idle, self.source.next()).await;
        let waited = if between { Duration::ZERO } else { asked.elapsed() };
        match frame {
            Err(_) => return Err(self.late(format!("nothing came for {} seconds", self.pace.idle.as_secs_f64()))),
            Ok(Some(Ok(frame))) => {
                if let Err(slow) = self.meter.add(waited, frame.len() as u64) {
                    let (bytes, seconds, rate) = (slow.bytes, slow.waited.as_secs_f64(), self.pace.rate);
                    let detail = format!("{bytes} bytes came in {seconds:.1} seconds: {rate} a second must");
                    return Err(self.late(detail));
                }
                self.packed = frame;
            }
            Ok(Some(Err(error))) => {
                self.ended = true;
                let (title, detail) = ("The request's body cannot be read", format!("it was cut off: {error}"));
                return Err(Refusal::new(StatusCode::BAD_REQUEST, "body_cut", title, detail));
            }
            Ok(None) => {
                self.ended = true;
                if let Some(inflate) = &mut self.inflate {
                    inflate.finish().map_err(|error| self.fault(&error))?;
                }
            }
        }
        Ok(())
    }

    fn late(&mut self, detail: String) -> Refusal {
        self.ended = true;
        Refusal::new(StatusCode::REQUEST_TIMEOUT, "body_timeout", "The request's body does not come", detail)
    }

    /// What to say of compressed data that cannot be read.
    fn fault(&mut self, error: &io::Error) -> Refusal {
        self.ended = true;
        let bad =
            |code, detail| Refusal::new(StatusCode::BAD_REQUEST, code, "The request's body cannot be read", detail);
        match error.kind() {
            io::ErrorKind::UnexpectedEof => bad("truncated", "the compressed data ends too early".to_owned()),
            _ => bad("compression", format!("the compressed data cannot be read: {error}")),
        }
    }

    /// All of the body, which may have so many bytes.
    pub(super) async fn all(mut self, limit: usize) -> Result<Vec<u8>, Refusal> {
        let mut all = Vec::new();
        while let Some(frame) = self.next(false).await? {
            if all.len() + frame.len() > limit {
                return Err(Refusal::new(
                    StatusCode::PAYLOAD_TOO_LARGE,
                    "body_too_large",
                    "The request's body is too large",
                    format!("it may have {limit} bytes"),
                ));
            }
            all.extend_from_slice(&frame);
        }
        Ok(all)
    }
}

/// A body whose rest is read and thrown away, for a while, when it is dropped: a client that still sends would otherwise
/// see its connection reset, and not the answer. Not so if the client waits for the word to go on, and never got it.
struct Lingering {
    /// The body, and the word to the connection that it is open.
    inner: Option<(BodyDataStream, Option<OpenBody>)>,
    waits: bool,
}

/// Makes a request's body one that [lingers](Lingering).
pub(super) async fn linger(request: Request) -> Request {
    if request.body().is_end_stream() {
        return request;
    }
    let waits = request.headers().contains_key(header::EXPECT);
    let open = request.extensions().get::<OpenBodies>().map(OpenBodies::open);
    request.map(|body| Body::from_stream(Lingering { inner: Some((body.into_data_stream(), open)), waits }))
}

impl Stream for Lingering {
    type Item = Result<Bytes, axum::Error>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.waits = false;
        let Some((inner, _)) = &mut self.inner else { return Poll::Ready(None) };
        let polled = inner.poll_next_unpin(context);
        if !matches!(polled, Poll::Pending | Poll::Ready(Some(Ok(_)))) {
            self.inner = None;
        }
        polled
    }
}

impl Drop for Lingering {
    fn drop(&mut self) {
        if let (Some((mut inner, open)), false, Ok(runtime)) = (self.inner.take(), self.waits, Handle::try_current()) {
            let rest = async move {
                while let Ok(Some(Ok(_))) = timeout(LINGER_IDLE, inner.next()).await {}
                drop(open);
            };
            runtime.spawn(timeout(LINGER, rest));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        admission::Budget,
        service::{charge::REQUEST, inflate::OVERHEAD},
        wire::{Problem, file::MAX_WINDOW_LOG},
    };

    const PACE: Pace = Pace { idle: Duration::from_secs(5), rate: 1 };

    /// What a body comes to, by a request for which there is so much memory; or the code of the problem.
    fn read(encoding: Option<&str>, body: Body, memory: u64, pace: Pace) -> Result<Vec<u8>, String> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let mut headers = HeaderMap::new();
        encoding.map(|encoding| headers.insert(header::CONTENT_ENCODING, encoding.parse().unwrap()));
        runtime.block_on(async {
            let charge = Charge::new(&Budget::new(memory, 1), REQUEST, PACE.idle).await.unwrap();
            let frames = Frames::new(&headers, body, charge, pace);
            let code = |refusal: Refusal| refusal.0.code;
            frames.map_err(code)?.all(100_000).await.map_err(code)
        })
    }

    /// Why a body is refused.
    fn refused(body: Body, pace: Pace) -> Box<Problem> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let charge = Charge::new(&Budget::new(1 << 20, 1), REQUEST, PACE.idle).await.unwrap();
            Frames::new(&HeaderMap::new(), body, charge, pace).unwrap().all(100_000).await.unwrap_err().0
        })
    }

    fn all(encoding: Option<&str>, body: Vec<u8>) -> Result<Vec<u8>, String> {
        read(encoding, Body::from(body), 1 << 30, PACE)
    }

    #[test]
    fn bodies_are_decompressed() {
        let data: Vec<u8> = (0..100_000u32).map(|i| (i / 7) as u8).collect();
        let packed = zstd::encode_all(&data[..], 3).unwrap();
        assert_eq!(all(None, data.clone()), Ok(data.clone()));
        assert_eq!(all(Some("identity"), data.clone()), Ok(data.clone()));
        assert_eq!(all(Some("ZSTD"), packed.clone()), Ok(data.clone()));
        // Two frames, one after another, are as good as one.
        let (a, b) = data.split_at(500);
        let two = [zstd::encode_all(a, 3).unwrap(), zstd::encode_all(b, 3).unwrap()].concat();
        assert_eq!(all(Some("zstd"), two), Ok(data.clone()));
        assert_eq!(all(Some("zstd"), packed[..packed.len() - 4].to_vec()).unwrap_err(), "truncated");
        assert_eq!(all(Some("zstd"), data.clone()).unwrap_err(), "compression");
        assert_eq!(all(Some("gzip"), data.clone()).unwrap_err(), "compression");
        assert_eq!(all(Some("br"), data.clone()).unwrap_err(), "unsupported_encoding");
        assert_eq!(all(Some("gzip, zstd"), data.clone()).unwrap_err(), "unsupported_encoding");
        assert_eq!(all(None, [&data[..], b"1"].concat()).unwrap_err(), "body_too_large");
    }

    /// A small body whose window is large.
    fn packed(log: u32) -> Vec<u8> {
        let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
        encoder.window_log(log).unwrap();
        encoder.include_contentsize(false).unwrap();
        io::Write::write_all(&mut encoder, b"small").unwrap();
        io::Write::flush(&mut encoder).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn a_window_beyond_the_limit_is_refused() {
        assert_eq!(all(Some("zstd"), packed(MAX_WINDOW_LOG)), Ok(b"small".to_vec()));
        assert_eq!(all(Some("zstd"), packed(MAX_WINDOW_LOG + 1)).unwrap_err(), "compression");
    }

    #[test]
    fn a_window_beyond_the_memory_is_refused() {
        let memory = REQUEST + OVERHEAD + (8 << 20);
        // A later frame may have a wider window than the first.
        let two = |log| [packed(20), packed(log)].concat();
        assert_eq!(read(Some("zstd"), two(23).into(), memory, PACE), Ok(b"smallsmall".to_vec()));
        assert_eq!(read(Some("zstd"), two(23).into(), memory - 1, PACE).unwrap_err(), "over_memory");
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        io::Write::write_all(&mut gzip, b"small").unwrap();
        let gzip = gzip.finish().unwrap();
        let memory = REQUEST + OVERHEAD;
        assert_eq!(read(Some("gzip"), gzip.clone().into(), memory, PACE), Ok(b"small".to_vec()));
        assert_eq!(read(Some("gzip"), gzip.into(), memory - 1, PACE).unwrap_err(), "over_memory");
    }

    #[test]
    fn a_wide_window_waits_for_its_turn_and_holds_nothing() {
        let total = REQUEST + OVERHEAD + (8 << 20);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let headers = [(header::CONTENT_ENCODING, "zstd".parse().unwrap())].into_iter().collect();
        runtime.block_on(async {
            let budget = Budget::new(total, 2);
            let other = budget.reserve(4 << 20, PACE.idle).await.unwrap();
            let read = |body: Vec<u8>, deadline| {
                let (budget, headers) = (budget.clone(), HeaderMap::clone(&headers));
                tokio::spawn(async move {
                    let charge = Charge::new(&budget, REQUEST, deadline).await.unwrap();
                    Frames::new(&headers, body.into(), charge, PACE).unwrap().all(1000).await.map_err(|r| r.0.code)
                })
            };
            let waits = read(packed(23), Duration::from_secs(600));
            while budget.waiting() == 0 {
                tokio::task::yield_now().await;
            }
            assert_eq!(budget.free(), total - (4 << 20));
            // Not for ever, and not behind what was handed on already.
            assert_eq!(read(packed(23), Duration::from_millis(1)).await.unwrap().unwrap_err(), "busy");
            let behind = [packed(20), packed(23)].concat();
            assert_eq!(read(behind, Duration::from_secs(600)).await.unwrap().unwrap_err(), "busy");
            drop(other);
            assert_eq!(waits.await.unwrap(), Ok(b"small".to_vec()));
            assert_eq!(budget.free(), total);
        });
    }

    #[test]
    fn a_trickle_is_given_up() {
        // Something is there whenever it is asked for, after a while, but 50 seconds of it would not be 10 kB.
        let pace = Pace { idle: Duration::from_millis(100), rate: 100_000 };
        let trickle = futures_util::stream::repeat_with(|| {
            std::thread::sleep(Duration::from_millis(20));
            Ok::<_, io::Error>(Bytes::from_static(b"x"))
        });
        let slow = refused(Body::from_stream(trickle.take(100)), pace);
        assert_eq!(slow.code, "body_timeout");
        assert!(slow.detail.contains("bytes came in") && slow.detail.contains("100000 a second"), "{}", slow.detail);
        let silent = refused(Body::from_stream(futures_util::stream::pending::<Result<Bytes, io::Error>>()), pace);
        assert_eq!((&*silent.code, &*silent.detail), ("body_timeout", "nothing came for 0.1 seconds"));
    }
}
