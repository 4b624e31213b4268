//! What a request takes beside its tiles: the buffers of its connection and of its answer, and the window of a
//! decompressor. A share of the memory is set aside for this, so that tiles and requests never wait for each other in a
//! circle: who holds memory for a tile takes from this share only what is free, and who waits for a wide window holds
//! nothing. Who waits for the counts of a tile holds a request, and so there is a part of the share for these alone.

use std::{
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll},
    time::Duration,
};

use axum::{
    body::{Body, Bytes, HttpBody},
    extract::{FromRequestParts, Request, State},
    http::{Version, header, request::Parts},
    middleware::Next,
    response::Response,
};
use http_body::{Frame, SizeHint};

use super::{
    Shared,
    connection::BUFFER,
    inflate::OVERHEAD,
    problem::{Refusal, internal},
};
use crate::admission::{AdmissionError, Budget, Permit};

/// What every request takes: what was read and not looked at, what was written and not sent, and the state of both.
pub(super) const REQUEST: u64 = 256 << 10;
/// The window that is taken from the start for a body in zstd: that of its default level.
const WINDOW: u64 = 2 << 20;

/// Bytes that came of requests over HTTP/2 and that are not charged yet, of all together: beside the memory, like
/// connections. Over HTTP/1.1 they are the connection's.
pub(super) const AHEAD: u64 = 8 << 20;
/// What a field of a head takes beside its name and value.
const FIELD: usize = 256;

/// What came of a request before it is charged: its head, and as much of its body as a client may send at once.
fn ahead(request: &Request) -> u64 {
    let fields = request.headers().iter().map(|(name, value)| name.as_str().len() + value.len() + FIELD);
    (fields.sum::<usize>() + request.uri().path().len() + BUFFER as usize) as u64
}

/// What of so much memory is for tiles, for requests, for the counts of tiles that vary in them, and for what is known of
/// images. Requests have a quarter up to 64 MiB, then an eighth; of that, a quarter is for counts. Images have half of
/// what requests and counts have.
pub(super) fn shares(memory: u64) -> [u64; 4] {
    let share = (memory / 4).min(64 << 20).max(memory / 8);
    let (counts, images) = (share / 4, share / 2);
    [memory - share - images, share - counts, counts, images]
}

/// The permit of a request: it lasts until request and answer are both done with.
#[derive(Clone, Debug)]
pub(super) struct Charge {
    permit: Arc<Mutex<Permit>>,
    budget: Budget,
    /// Over HTTP/2, for what came while it holds nothing.
    ahead: Option<Budget>,
    deadline: Duration,
}

impl Charge {
    /// So many bytes of this budget, when their turn comes.
    pub(super) async fn new(budget: &Budget, bytes: u64, deadline: Duration) -> Result<Self, AdmissionError> {
        let permit = budget.reserve(bytes, deadline).await?;
        Ok(Self { permit: Arc::new(Mutex::new(permit)), budget: budget.clone(), ahead: None, deadline })
    }

    fn permit(&self) -> MutexGuard<'_, Permit> {
        self.permit.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes what a decompressor with such a window needs, unless as much was taken before; if it is not there it does
    /// not wait for it.
    pub(super) fn add_window(&self, window: u64) -> Result<(), Refusal> {
        self.permit().grow_to(REQUEST + OVERHEAD + window).map_err(for_window)
    }

    /// Takes so many bytes more, for an answer that needs them; if they are not there it does not wait for them.
    pub(super) fn add(&self, bytes: u64) -> Result<(), Refusal> {
        let mut permit = self.permit();
        let all = permit.bytes() + bytes;
        permit.grow_to(all).map_err(|error| {
            let mut refusal = Refusal::from(error);
            refusal.0.title = "The request needs more memory than there is for it".to_owned();
            refusal
        })
    }

    /// As [`Self::add_window`] at the start of a body, when nothing else is held: waits for its turn, and until then gives
    /// back what it has.
    pub(super) async fn wait_window(&self, window: u64) -> Result<(), Refusal> {
        let bytes = REQUEST + OVERHEAD + window;
        let grown = self.permit().grow_to(bytes);
        let taken = match grown {
            Err(AdmissionError::Busy { .. }) => {
                let _ahead = match &self.ahead {
                    Some(ahead) => Some(ahead.reserve(BUFFER.into(), Duration::ZERO).await.map_err(for_window)?),
                    None => None,
                };
                self.permit().shrink_to(0);
                self.budget.reserve(bytes, self.deadline).await.map(|permit| *self.permit() = permit)
            }
            grown => grown,
        };
        taken.map_err(for_window)
    }
}

fn for_window(error: AdmissionError) -> Refusal {
    let mut refusal = Refusal::from(error);
    refusal.0.title = "The body's compression needs more memory than there is".to_owned();
    refusal
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
    let two = request.version() == Version::HTTP_2;
    let came = service.ahead.reserve(if two { ahead(&request) } else { 0 }, Duration::ZERO).await?;
    let mut charge = Charge::new(&service.requests, wanted, service.config.queue_deadline).await?;
    drop(came);
    charge.ahead = two.then(|| service.ahead.clone());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        config::{Config, MIN_MEMORY, THREAD_MEMORY},
        filter::{
            Channel, ChannelSet, Method, Rect, Role, TileGeometry,
            plan::{Shape, plan},
        },
        image::{Announced, Description, INDEX_STEP},
    };

    #[test]
    fn the_least_memory_makes_a_service() {
        let (method, size) = (Method::default(), [128, 128]);
        let channel = |name: &str, role, components| Channel::new(name, role, components);
        let channels = ChannelSet::new(vec![
            channel("color", Role::Color, 3),
            channel("P", Role::Feature { position: true }, 3),
            channel("N", Role::Feature { position: false }, 3),
            channel("albedo", Role::Feature { position: false }, 3),
            channel("lens", Role::Random { uniform: true }, 2),
        ])
        .unwrap();
        let geometry = TileGeometry::with_halo(size, Rect::new(56, 56, 16, 16), method.reach(false)).unwrap();
        let samples = geometry.window().area();
        let shape = Shape { geometry: &geometry, channels: &channels, samples, max_per_pixel: 1, varying: false };
        for threads in [1, 2, 8, 9, 64, 1024] {
            let [tiles, requests, _, images] = shares(MIN_MEMORY.max(THREAD_MEMORY * threads as u64));
            let needed = plan(&shape, &method).total(threads);
            assert!(needed <= tiles, "{threads} threads: {needed} of {tiles} bytes");
            assert!(3 * REQUEST <= requests);
            let neighbors = Announced { channels: channels.clone(), samples: 1, varying: false, region: 16 };
            let description = Description { neighbors: Some(neighbors), ..Description::plain(size, method.clone()) };
            assert!(description.index_bytes() + INDEX_STEP <= images);
        }
        assert_eq!(shares(Config::default().memory.0).iter().sum::<u64>(), Config::default().memory.0);
    }
}
