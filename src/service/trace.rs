//! What is told of every request: its id, the trace it belongs to, a line in the log, and numbers.

use std::{
    hash::{BuildHasher, RandomState},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Instant,
};

use axum::{
    body::{Body, HttpBody},
    extract::{MatchedPath, Request, State},
    http::{HeaderMap, HeaderName, HeaderValue},
    middleware::Next,
    response::Response,
};
use bytes::Bytes;
use hyper::body::{Frame, SizeHint};
use tracing::{Instrument, Span, field::Empty};

use super::{Shared, auth::Pass, connection::Stream, metrics::Counted, problem::Said};

/// The header that names a request.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
const TRACE_PARENT: HeaderName = HeaderName::from_static("traceparent");
const TRACE_RESPONSE: HeaderName = HeaderName::from_static("traceresponse");
/// Most characters of a request's id.
const MAX_ID: usize = 128;

/// 16 hex digits that nobody has.
fn random() -> u64 {
    RandomState::new().hash_one("request")
}

/// The id that the client has chosen, if it can be one, else a new one.
fn request_id(headers: &HeaderMap) -> String {
    let fine = |b: u8| b.is_ascii_alphanumeric() || b"._-:/+=".contains(&b);
    let given = headers.get(REQUEST_ID).and_then(|value| value.to_str().ok());
    let given = given.filter(|id| (1..=MAX_ID).contains(&id.len()) && id.bytes().all(fine));
    given.map_or_else(|| format!("{:016x}{:016x}", random(), random()), ToOwned::to_owned)
}

/// The trace that a request belongs to, as W3C Trace Context says it.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Trace {
    trace: String,
    parent: String,
    flags: String,
}

impl Trace {
    /// Reads `traceparent`; one that is not as it should be is ignored, as the standard says.
    fn of(headers: &HeaderMap) -> Option<Self> {
        let mut values = headers.get_all(TRACE_PARENT).into_iter();
        let (value, None) = (values.next()?.to_str().ok()?, values.next()) else { return None };
        let mut parts = value.splitn(5, '-');
        let mut hex = |length: usize| {
            let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
            parts.next().filter(|part| part.len() == length && part.bytes().all(digit))
        };
        let (version, trace, parent, flags) = (hex(2)?, hex(32)?, hex(16)?, hex(2)?);
        let more = parts.next();
        let zeros = |text: &str| text.bytes().all(|b| b == b'0');
        // Later versions may have more behind it.
        if version == "ff" || (version == "00" && more.is_some()) || zeros(trace) || zeros(parent) {
            return None;
        }
        Some(Self { trace: trace.to_owned(), parent: parent.to_owned(), flags: flags.to_owned() })
    }
}

/// Names a request, lets it be answered, and tells of it.
pub(super) async fn observe(State(service): State<Shared>, mut request: Request, next: Next) -> Response {
    let began = Instant::now();
    let route = request.extensions().get::<MatchedPath>().map_or("other", MatchedPath::as_str).to_owned();
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let (id, trace) = (request_id(request.headers()), Trace::of(request.headers()));
    // An error's, so that all that is logged within it has the id, however little is logged.
    let span = tracing::error_span!("request", id, token = Empty, trace_id = Empty, parent_id = Empty, span_id = Empty);
    let mut trace_response = None;
    if let Some(Trace { trace, parent, flags }) = trace {
        let own = format!("{:016x}", random().max(1));
        span.record("trace_id", &trace).record("parent_id", parent).record("span_id", &own);
        trace_response = HeaderValue::try_from(format!("00-{trace}-{own}-{flags}")).ok();
    }
    let mut kept = Kept {
        service: Arc::clone(&service),
        _counted: service.metrics.enter(),
        _stream: request.extensions_mut().remove::<Stream>(),
        _pass: None,
        span: span.clone(),
        route,
        began,
        bytes: 0,
        whole: false,
    };
    let mut response = next.run(request).instrument(span.clone()).await;
    if let Some(Said(problem)) = response.extensions_mut().remove() {
        service.metrics.problem(&problem.code);
        response = Said(problem).with_request_id(&id, response);
    }
    let status = response.status().as_u16();
    service.metrics.answered(&kept.route, &method, status);
    let _entered = span.enter();
    tracing::info!(%method, path, status, seconds = began.elapsed().as_secs_f64(), "request");
    if let Ok(id) = HeaderValue::try_from(id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    if let Some(value) = trace_response {
        response.headers_mut().insert(TRACE_RESPONSE, value);
    }
    kept._pass = response.extensions_mut().remove();
    response.map(|body| Body::new(Told { body, kept }))
}

/// What lasts until all of an answer is sent, or nobody is left to read it.
struct Kept {
    service: Shared,
    _counted: Counted,
    _stream: Option<Stream>,
    _pass: Option<Arc<Pass>>,
    span: Span,
    route: String,
    began: Instant,
    bytes: u64,
    whole: bool,
}

impl Drop for Kept {
    fn drop(&mut self) {
        let taken = self.began.elapsed();
        self.service.metrics.sent(&self.route, taken);
        let _entered = self.span.enter();
        tracing::debug!(seconds = taken.as_secs_f64(), bytes = self.bytes, whole = self.whole, "answer ended");
    }
}

/// An answer's body, and what lasts as long.
struct Told {
    body: Body,
    kept: Kept,
}

impl HttpBody for Told {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => self.kept.bytes += frame.data_ref().map_or(0, |data| data.len() as u64),
            Poll::Ready(None) => self.kept.whole = true,
            _ => {}
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(name: HeaderName, values: &[&str]) -> HeaderMap {
        values.iter().map(|value| (name.clone(), value.parse().unwrap())).collect()
    }

    #[test]
    fn a_request_id_is_taken_or_made() {
        let id = |value: &str| request_id(&headers(REQUEST_ID, &[value]));
        assert_eq!(id("shot-12/frame_7:a.b+c="), "shot-12/frame_7:a.b+c=");
        assert_eq!(id(&"x".repeat(128)), "x".repeat(128));
        let made = |id: String| id.len() == 32 && id.bytes().all(|b| b.is_ascii_hexdigit());
        for bad in ["", "a b", "a\"b", "a{b}", &"x".repeat(129)] {
            assert!(made(id(bad)), "{bad}");
        }
        assert!(made(request_id(&HeaderMap::new())) && request_id(&HeaderMap::new()) != request_id(&HeaderMap::new()));
    }

    #[test]
    fn a_trace_is_read_as_the_standard_says() {
        let (trace, parent) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
        let of = |values: &[&str]| Trace::of(&headers(TRACE_PARENT, values));
        let good = format!("00-{trace}-{parent}-01");
        let read = of(&[&good]).unwrap();
        assert_eq!((read.trace.as_str(), read.parent.as_str(), read.flags.as_str()), (trace, parent, "01"));
        // A version to come, with more behind it.
        assert_eq!(of(&[&format!("cc-{trace}-{parent}-01-what-the-future-brings")]).unwrap().trace, trace);
        assert_eq!(of(&[&format!("cc-{trace}-{parent}-01")]).unwrap().trace, trace);
        for bad in [
            format!("ff-{trace}-{parent}-01"),
            format!("00-{trace}-{parent}-01-more"),
            format!("00-{trace}-{parent}-01-"),
            format!("cc-{trace}-{parent}-01.more"),
            format!("00-{}-{parent}-01", trace.to_uppercase()),
            format!("00-{}-{parent}-01", "0".repeat(32)),
            format!("00-{trace}-{}-01", "0".repeat(16)),
            format!("00-{trace}-{parent}"),
            format!("00-{trace}-{parent}-1"),
            format!("00-{trace}-{parent}-0x"),
            format!("0-{trace}-{parent}-01"),
            format!("00-{}-{parent}-01", &trace[1..]),
            format!(" 00-{trace}-{parent}-01"),
            String::new(),
        ] {
            assert_eq!(of(&[&bad]), None, "{bad}");
        }
        assert_eq!(of(&[&good, &good]), None);
        assert_eq!(of(&[]), None);
    }
}
