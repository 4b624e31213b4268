//! Tiles as they come in: the header is judged and its memory reserved before the first plane is read.

use std::time::Instant;

use axum::http::StatusCode;
use bytes::{Buf, Bytes};

use super::{body::Frames, metrics::Phase, problem::Refusal, stream::Call};
use crate::{
    admission::{AdmissionError, Budget, Permit},
    filter::{
        Method, Rect, TileGeometry,
        geometry::MAX_SIDE,
        plan::{Plan, Shape, plan},
    },
    wire::{Assembler, Decoder, Event, Header, value::CountReader},
};

/// A tile all of whose samples are here, and the memory that it may use.
#[derive(Debug)]
pub(super) struct Received {
    pub(super) assembler: Assembler,
    pub(super) plan: Plan,
    pub(super) permit: Permit,
}

impl Received {
    pub(super) fn core(&self) -> Rect {
        self.assembler.header().geometry().core()
    }
}

/// What came instead of a tile.
#[derive(Debug)]
pub(super) enum Fault {
    /// This tile is refused; the ones after it can be read.
    Tile(Rect, Refusal),
    /// The stream cannot be read on.
    Stream(Option<Rect>, Refusal),
}

impl Fault {
    pub(super) fn into_refusal(self) -> Refusal {
        let (Self::Tile(_, refusal) | Self::Stream(_, refusal)) = self;
        refusal
    }
}

/// A tile that is coming in.
struct Open {
    began: Instant,
    received: Received,
    counts: CountReader,
    /// Greatest count so far.
    most: u16,
    /// Whether the counts vary and are not all there.
    counting: bool,
}

impl Open {
    fn push(&mut self, event: &Event, method: &Method, threads: usize) {
        match event {
            Event::Counts(bytes) => self.counts.push(bytes, |count| self.most = self.most.max(count)),
            // Now the counts are known: what was reserved for the worst of them is more than is needed.
            _ if self.counting => {
                let shape = self.received.assembler.header().shape();
                let shape = Shape { max_per_pixel: self.most.into(), ..shape };
                self.received.plan = plan(&shape, method);
                self.received.permit.shrink_to(self.received.plan.total(threads));
                self.counting = false;
            }
            _ => {}
        }
        self.received.assembler.push(event);
    }
}

/// Reads tiles from a body.
pub(super) struct Receiver {
    frames: Frames,
    current: Bytes,
    decoder: Decoder,
    open: Option<Open>,
}

impl Receiver {
    pub(super) fn new(frames: Frames) -> Self {
        Self { frames, current: Bytes::new(), decoder: Decoder::new(), open: None }
    }

    /// The next tile, `Ok(None)` at the end of the stream. While it waits for memory the socket is not read. After
    /// [`Fault::Tile`] it can be called again, after [`Fault::Stream`] not.
    pub(super) async fn next(&mut self, call: &Call) -> Result<Option<Received>, Fault> {
        loop {
            let Some(step) = self.step(call).await? else { return Ok(None) };
            match step {
                Step::Header(header) => {
                    let core = header.geometry().core();
                    let open = admit(call, header).await.map_err(|refusal| Fault::Tile(core, refusal))?;
                    self.open = Some(open);
                }
                Step::End => {
                    // Of a tile that was refused nothing was kept.
                    if let Some(open) = self.open.take() {
                        call.service.metrics.phase(Phase::Receive, open.began);
                        return Ok(Some(open.received));
                    }
                }
            }
        }
    }

    /// Checks that nothing follows.
    pub(super) async fn end(&mut self, call: &Call) -> Result<(), Refusal> {
        match self.step(call).await.map_err(Fault::into_refusal)? {
            None => Ok(()),
            Some(_) => Err(Refusal::new(
                StatusCode::BAD_REQUEST,
                "one_tile_only",
                "More than one tile",
                "a picture can be made of a single tile: send one, or accept application/msgpack",
            )),
        }
    }

    /// Goes on to the next header or end of a tile.
    async fn step(&mut self, call: &Call) -> Result<Option<Step>, Fault> {
        loop {
            let Self { current, decoder, open, .. } = self;
            let mut input = &current[..];
            let event = decoder.next(&mut input);
            let taken = current.len() - input.len();
            let step = match event {
                Ok(Some(Event::Header(header))) => Some(Step::Header(header)),
                Ok(Some(Event::TileEnd)) => Some(Step::End),
                Ok(Some(event)) => {
                    if let Some(open) = open {
                        open.push(&event, &call.method, call.service.config.threads);
                    }
                    None
                }
                Ok(None) => {
                    let frame = self.frames.next().await;
                    let tile = || self.decoder.header().map(|header| header.geometry().core());
                    match frame.map_err(|refusal| Fault::Stream(tile(), refusal))? {
                        Some(frame) => self.current = frame,
                        None => {
                            let finished = self.decoder.finish();
                            return finished.map(|()| None).map_err(|error| Fault::Stream(tile(), error.into()));
                        }
                    }
                    continue;
                }
                Err(error) => return Err(Fault::Stream(error.tile, error.into())),
            };
            self.current.advance(taken);
            if step.is_some() {
                return Ok(step);
            }
        }
    }
}

enum Step {
    Header(Header),
    End,
}

/// Judges a header, and waits for the memory that its tile needs.
async fn admit(call: &Call, header: Header) -> Result<Open, Refusal> {
    call.check(&header)?;
    let (threads, budget) = (call.service.config.threads, &call.service.budget);
    let plan = plan(&header.shape(), &call.method);
    let needed = plan.total(threads);
    if let Err(error) = budget.check(needed) {
        return Err(too_large(error, &header, &call.method, threads, budget));
    }
    // What this request's own tiles hold will be free again: that is no queue.
    let (waiting, asked) = (call.service.metrics.wait(), Instant::now());
    let reserved = budget.reserve_after(needed, call.idle(), call.service.config.queue_deadline).await;
    call.service.metrics.phase(Phase::Queue, asked);
    drop(waiting);
    let received = Received { assembler: Assembler::new(&header), plan, permit: reserved? };
    Ok(Open { began: Instant::now(), received, counts: CountReader::default(), most: 0, counting: header.varying() })
}

/// The answer to a tile that never fits, with the size that would.
fn too_large(error: AdmissionError, header: &Header, method: &Method, threads: usize, budget: &Budget) -> Refusal {
    let mut refusal = Refusal::from(error);
    let fits = largest_core(header, method, threads, budget);
    let advice = match fits {
        Some(side) => format!("a core of {side} x {side} pixels with this halo and as many samples would fit"),
        None => "not even a single pixel with this halo and as many samples would fit".to_owned(),
    };
    refusal.0.detail = format!("{}: {advice}", refusal.0.detail);
    refusal.0.more.insert("fits".to_owned(), fits.map(|side| [side, side]).into_iter().flatten().collect());
    refusal
}

/// Side of the largest square core that fits into the budget, other things being equal.
fn largest_core(header: &Header, method: &Method, threads: usize, budget: &Budget) -> Option<u32> {
    let (halo, window) = (header.geometry().halo(), header.geometry().window());
    let per_pixel = header.total().div_ceil(window.area());
    let fits = |side: u32| {
        let core = Rect::new(halo.left, halo.top, side, side);
        TileGeometry::new([MAX_SIDE, MAX_SIDE], core, halo).is_ok_and(|geometry| {
            let samples = per_pixel * geometry.window().area();
            let shape = Shape { geometry: &geometry, samples, ..header.shape() };
            budget.check(plan(&shape, method).total(threads)).is_ok()
        })
    };
    // The need grows with the side.
    let (mut good, mut bad) = (0, 1 << 16);
    while bad - good > 1 {
        let middle = good + (bad - good) / 2;
        if fits(middle) { good = middle } else { bad = middle }
    }
    (good > 0).then_some(good)
}
