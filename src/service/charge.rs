//! What a request takes beside its tiles: the buffers of its connection and of its answer, and the window of a
//! decompressor. A share of the memory is set aside for this, so that tiles and requests never wait for each other in a
//! circle: who holds memory for a tile takes from this share only what is free.

use std::{
    pin::Pin,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll},
};

use axum::{
    body::{Body, Bytes, HttpBody},
    extract::{FromRequestParts, Request, State},
    http::{header, request::Parts},
    middleware::Next,
    response::Response,
};
use http_body::{Frame, SizeHint};

use super::{
    Shared,
    inflate::OVERHEAD,
    problem::{Refusal, internal},
};
use crate::admission::Permit;

/// What every request takes: what was read and not looked at, what was written and not sent, and the state of both.
pub(super) const REQUEST: u64 = 256 << 10;
/// The window that is taken from the start for a body in zstd: that of its default level.
const WINDOW: u64 = 2 << 20;

/// Memory that is set aside for requests, of so much in all: a quarter up to 64 MiB, then an eighth.
pub(super) const fn share(memory: u64) -> u64 {
    let quarter = if memory / 4 < 64 << 20 { memory / 4 } else { 64 << 20 };
    if memory / 8 > quarter { memory / 8 } else { quarter }
}

/// The permit of a request: it lasts until request and answer are both done with.
#[derive(Clone, Debug)]
pub(super) struct Charge(Arc<Mutex<Permit>>);

impl Charge {
    pub(super) fn new(permit: Permit) -> Self {
        Self(Arc::new(Mutex::new(permit)))
    }

    /// Takes what a window needs, unless as much was taken before. It does not wait for it: see the module.
    pub(super) fn add_window(&self, window: u64) -> Result<(), Refusal> {
        let mut permit = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        permit.grow_to(REQUEST + OVERHEAD + window).map_err(|error| {
            let mut refusal = Refusal::from(error);
            refusal.0.title = "The body's compression needs more memory than there is".to_owned();
            refusal
        })
    }
}

/// Takes a request's memory before anything is done for it, waiting for its turn, and keeps it until the answer is sent.
pub(super) async fn charge(
    State(service): State<Shared>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    let packed = request.headers().contains_key(header::CONTENT_ENCODING);
    let wanted = REQUEST + if packed { OVERHEAD + WINDOW } else { 0 };
    let wanted = wanted.min(service.requests.total());
    let permit = service.requests.reserve(wanted, service.config.queue_deadline).await?;
    let charge = Charge::new(permit);
    request.extensions_mut().insert(charge.clone());
    let response = next.run(request).await;
    Ok(response.map(|body| keep(body, charge)))
}

/// A body that keeps something until it is sent, or nobody wants it any more.
pub(super) fn keep(body: Body, kept: impl Send + Unpin + 'static) -> Body {
    Body::new(Kept { body, _kept: kept })
}

struct Kept<T> {
    body: Body,
    _kept: T,
}

impl<T: Unpin> HttpBody for Kept<T> {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl<S: Sync> FromRequestParts<S> for Charge {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Refusal> {
        parts.extensions.get().cloned().ok_or_else(|| internal("a request without a charge").into())
    }
}
