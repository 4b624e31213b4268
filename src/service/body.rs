//! The body of a request: frames as they come, decompressed if they are compressed.

use std::{
    io,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use async_compression::{
    tokio::bufread::{GzipDecoder, ZstdDecoder},
    zstd::DParameter,
};
use axum::{
    body::{Body, BodyDataStream},
    extract::Request,
    http::{HeaderMap, StatusCode, header},
};
use bytes::Bytes;
use futures_util::{Stream, StreamExt, TryStreamExt};
use tokio::{runtime::Handle, time::timeout};
use tokio_util::io::{ReaderStream, StreamReader};

use super::problem::Refusal;
use crate::wire::file::MAX_WINDOW_LOG;

/// Bytes decompressed at a time.
const BUFFER: usize = 64 << 10;
/// How long the rest of a body is read, and thrown away, whose request was answered already.
const LINGER: Duration = Duration::from_secs(10);
/// How long it may bring nothing before that is given up.
const LINGER_IDLE: Duration = Duration::from_secs(1);

type Source = Pin<Box<dyn Stream<Item = io::Result<Bytes>> + Send>>;

/// Reads a body. Nothing is read before it is asked for, so a client that says `Expect: 100-continue` is told to go on
/// only then.
pub(super) struct Frames {
    source: Source,
    idle: Duration,
    ended: bool,
}

/// The connection failed, not what came over it.
#[derive(Debug, thiserror::Error)]
#[error("the request's body was cut off: {0}")]
struct Cut(axum::Error);

impl Frames {
    /// Judges the content encoding; `idle` is how long to wait for a frame.
    pub(super) fn new(headers: &HeaderMap, body: Body, idle: Duration) -> Result<Self, Refusal> {
        let raw = body.into_data_stream().map_err(|error| io::Error::other(Cut(error)));
        let mut encodings = headers
            .get_all(header::CONTENT_ENCODING)
            .into_iter()
            .flat_map(|value| value.to_str().unwrap_or("?").split(','))
            .map(|name| name.trim().to_ascii_lowercase())
            .filter(|name| !name.is_empty() && name != "identity");
        let source: Source = match (encodings.next().as_deref(), encodings.next()) {
            (None, _) => Box::pin(raw),
            (Some("zstd"), None) => {
                let window = DParameter::window_log_max(MAX_WINDOW_LOG);
                let mut decoder = ZstdDecoder::with_params(StreamReader::new(raw), &[window]);
                decoder.multiple_members(true);
                Box::pin(ReaderStream::with_capacity(decoder, BUFFER))
            }
            (Some("gzip" | "x-gzip"), None) => {
                let mut decoder = GzipDecoder::new(StreamReader::new(raw));
                decoder.multiple_members(true);
                Box::pin(ReaderStream::with_capacity(decoder, BUFFER))
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
        Ok(Self { source, idle, ended: false })
    }

    /// The next bytes, never none; `Ok(None)` at the end of the body.
    pub(super) async fn next(&mut self) -> Result<Option<Bytes>, Refusal> {
        while !self.ended {
            let Ok(frame) = timeout(self.idle, self.source.next()).await else {
                self.ended = true;
                return Err(Refusal::new(
                    StatusCode::REQUEST_TIMEOUT,
                    "body_timeout",
                    "The request's body does not come",
                    format!("nothing came for {} seconds", self.idle.as_secs_f64()),
                ));
            };
            match frame {
                Some(Ok(frame)) if frame.is_empty() => {}
                Some(Ok(frame)) => return Ok(Some(frame)),
                Some(Err(error)) => {
                    self.ended = true;
                    return Err(fault(&error));
                }
                None => self.ended = true,
            }
        }
        Ok(None)
    }

    /// All of the body, which may have so many bytes.
    pub(super) async fn all(mut self, limit: usize) -> Result<Vec<u8>, Refusal> {
        let mut all = Vec::new();
        while let Some(frame) = self.next().await? {
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
    inner: Option<BodyDataStream>,
    waits: bool,
}

/// Makes a request's body one that [lingers](Lingering).
pub(super) async fn linger(request: Request) -> Request {
    let waits = request.headers().contains_key(header::EXPECT);
    request.map(|body| Body::from_stream(Lingering { inner: Some(body.into_data_stream()), waits }))
}

impl Stream for Lingering {
    type Item = Result<Bytes, axum::Error>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.waits = false;
        let Some(inner) = &mut self.inner else { return Poll::Ready(None) };
        let polled = inner.poll_next_unpin(context);
        if !matches!(polled, Poll::Pending | Poll::Ready(Some(Ok(_)))) {
            self.inner = None;
        }
        polled
    }
}

impl Drop for Lingering {
    fn drop(&mut self) {
        if let (Some(mut inner), false, Ok(runtime)) = (self.inner.take(), self.waits, Handle::try_current()) {
            let rest = async move { while let Ok(Some(Ok(_))) = timeout(LINGER_IDLE, inner.next()).await {} };
            runtime.spawn(timeout(LINGER, rest));
        }
    }
}

/// What to say of a body that cannot be read.
fn fault(error: &io::Error) -> Refusal {
    let bad = |code, detail| Refusal::new(StatusCode::BAD_REQUEST, code, "The request's body cannot be read", detail);
    match error.get_ref() {
        Some(inner) if inner.is::<Cut>() => bad("body_cut", error.to_string()),
        _ if error.kind() == io::ErrorKind::UnexpectedEof => {
            bad("truncated", "the compressed data ends too early".to_owned())
        }
        _ => bad("compression", format!("the compressed data cannot be read: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(encoding: Option<&str>, body: Vec<u8>) -> Result<Frames, Refusal> {
        let mut headers = HeaderMap::new();
        encoding.map(|encoding| headers.insert(header::CONTENT_ENCODING, encoding.parse().unwrap()));
        Frames::new(&headers, Body::from(body), Duration::from_secs(5))
    }

    fn all(encoding: Option<&str>, body: Vec<u8>) -> Result<Vec<u8>, String> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let code = |refusal: Refusal| refusal.0.code;
        runtime.block_on(async { frames(encoding, body).map_err(code)?.all(100_000).await.map_err(code) })
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

    #[test]
    fn a_window_beyond_the_limit_is_refused() {
        let packed = |log: u32| {
            let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
            encoder.window_log(log).unwrap();
            encoder.include_contentsize(false).unwrap();
            io::Write::write_all(&mut encoder, b"small").unwrap();
            io::Write::flush(&mut encoder).unwrap();
            encoder.finish().unwrap()
        };
        assert_eq!(all(Some("zstd"), packed(MAX_WINDOW_LOG)), Ok(b"small".to_vec()));
        assert_eq!(all(Some("zstd"), packed(MAX_WINDOW_LOG + 1)).unwrap_err(), "compression");
    }
}
