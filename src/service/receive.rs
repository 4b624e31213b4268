//! Tiles as they come in: the header is judged and its memory reserved before the first plane is read.

use std::time::Instant;

use axum::http::StatusCode;
use bytes::{Buf, Bytes};

use super::{body::Frames, metrics::Phase, problem::Refusal, stream::Call};
use crate::{
    admission::{AdmissionError, Permit},
    filter::{
        Rect, TileGeometry,
        geometry::MAX_SIDE,
        plan::{Plan, Shape},
    },
    wire::{Assembler, Decoder, Event, Header, value::CountReader},
};

/// A tile all of whose samples are here, and the memory that it may use.
#[derive(Debug)]
pub(super) struct Received {
    pub(super) assembler: Assembler,
    pub(super) plan: Plan,
    pub(super) permit: Permit,
    /// Room on the disk for its result, until that is read.
    pub(super) unread: Permit,
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
    /// So many failures wait to be read that no more are taken.
    pub(super) fn unread() -> Self {
        Self::Stream(None, results_unread("many tiles have failed, and nobody has read why"))
    }

    pub(super) fn into_refusal(self) -> Refusal {
        let (Self::Tile(_, refusal) | Self::Stream(_, refusal)) = self;
        refusal
    }
}

/// A tile that is coming in.
enum Open {
    /// Its counts vary, and decide how much memory it will need.
    Counting(Counting),
    /// Its memory is reserved, since then.
    Planes(Received, Instant),
}

struct Counting {
    assembler: Assembler,
    unread: Permit,
    counts: CountReader,
    /// Greatest count so far.
    most: u16,
    /// Pixels whose count is still to come.
    left: u64,
    /// Memory for the counts alone, of the share for requests.
    _held: Permit,
}

impl Open {
    /// Takes an event; says whether now the counts are all there.
    fn push(&mut self, event: &Event) -> bool {
        match self {
            Self::Planes(received, _) => received.assembler.push(event),
            Self::Counting(counting) => {
                counting.assembler.push(event);
                if let Event::Counts(bytes) = event {
                    let Counting { counts, most, left, .. } = counting;
                    counts.push(bytes, |count| {
                        *most = (*most).max(count);
                        *left = left.saturating_sub(1);
                    });
                    return *left == 0;
                }
            }
        }
        false
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
            let Some(step) = self.step().await? else { return Ok(None) };
            match (step, self.open.take()) {
                (Step::Header(header), _) => self.open = Some(announce(call, header).await?),
                (Step::Counted, Some(Open::Counting(counting))) => {
                    let Counting { assembler, unread, most, .. } = counting;
                    self.open = Some(admit(call, assembler, unread, most.into()).await?);
                }
                (Step::End, Some(Open::Planes(received, began))) => {
                    call.service.metrics.phase(Phase::Receive, began);
                    return Ok(Some(received));
                }
                // Of a tile that was refused nothing was kept.
                _ => {}
            }
        }
    }

    /// Checks that nothing follows.
    pub(super) async fn end(&mut self) -> Result<(), Refusal> {
        match self.step().await.map_err(Fault::into_refusal)? {
            None => Ok(()),
            Some(_) => Err(Refusal::new(
                StatusCode::BAD_REQUEST,
                "one_tile_only",
                "More than one tile",
                "a picture can be made of a single tile: send one, or accept application/msgpack",
            )),
        }
    }

    /// Goes on to the next header, or end of a tile or of its counts.
    async fn step(&mut self) -> Result<Option<Step>, Fault> {
        loop {
            let Self { current, decoder, open, .. } = self;
            let mut input = &current[..];
            let event = decoder.next(&mut input);
            let taken = current.len() - input.len();
            let step = match event {
                Ok(Some(Event::Header(header))) => Some(Step::Header(header)),
                Ok(Some(Event::TileEnd)) => Some(Step::End),
                Ok(Some(event)) => open.as_mut().is_some_and(|open| open.push(&event)).then_some(Step::Counted),
                Ok(None) => {
                    // The bytes that were taken need not be held while others are waited for.
                    self.current = Bytes::new();
                    let frame = self.frames.next(self.decoder.between()).await;
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
    Counted,
    End,
}

/// Judges a header, and waits for what its tile needs: room for the result first, which holds no memory.
async fn announce(call: &Call, header: Header) -> Result<Open, Fault> {
    let (geometry, service) = (*header.geometry(), &call.service);
    let tile = |refusal| Fault::Tile(geometry.core(), refusal);
    call.check(&header).map_err(tile)?;
    // What never fits is said at once.
    let (left, even) = (geometry.window().area(), header.total().div_ceil(geometry.window().area()));
    if header.varying() {
        let shape = Shape { max_per_pixel: even as u32, ..header.shape() };
        let fits = service.counts.check(count_bytes(left));
        fits.map_err(|error| tile(too_large(error, &header, &shape, call)))?;
    } else {
        fits(call, &header, header.max_per_pixel()).map_err(tile)?;
    }
    let deadline = service.config.queue_deadline;
    // The results of this request's own tiles, which are being made, are nobody's to read yet.
    let unread = service.unread.reserve_after(call.result_bytes(geometry.core()), call.idle(), deadline).await;
    // Whoever does not read what there is gets no more.
    let unread = unread.map_err(|error| {
        let why = format!("there is no room for this result on the service's disk: {error}");
        Fault::Stream(Some(geometry.core()), results_unread(&why))
    })?;
    let assembler = Assembler::new(&header);
    if !header.varying() {
        return admit(call, assembler, unread, header.max_per_pixel()).await;
    }
    let held = service.counts.reserve(count_bytes(left), deadline).await.map_err(|error| tile(error.into()))?;
    let (counts, most) = (CountReader::default(), 0);
    Ok(Open::Counting(Counting { assembler, unread, counts, most, left, _held: held }))
}

/// Memory for the counts of so many pixels.
const fn count_bytes(pixels: u64) -> u64 {
    2 * pixels
}

/// What a tile needs whose pixels have so many samples at most; refused if it never fits.
fn fits(call: &Call, header: &Header, max_per_pixel: u32) -> Result<(Plan, u64), Refusal> {
    let (threads, budget) = (call.service.config.threads, &call.service.budget);
    let shape = Shape { max_per_pixel, ..header.shape() };
    let plan = call.plan(&shape);
    let needed = plan.total(threads);
    budget.check(needed).map_err(|error| too_large(error, header, &shape, call))?;
    Ok((plan, needed))
}

/// Waits for the memory of a tile whose counts are known.
async fn admit(call: &Call, mut assembler: Assembler, unread: Permit, max_per_pixel: u32) -> Result<Open, Fault> {
    let header = assembler.header();
    let tile = |refusal| Fault::Tile(header.geometry().core(), refusal);
    let (plan, needed) = fits(call, header, max_per_pixel).map_err(tile)?;
    // What this request's own tiles hold will be free again: that is no queue.
    let (waiting, asked) = (call.service.metrics.wait(), Instant::now());
    let permit = call.service.reserve(needed, call.idle(), call.service.config.queue_deadline).await;
    call.service.metrics.phase(Phase::Queue, asked);
    drop(waiting);
    let permit = permit.map_err(|error| tile(error.into()))?;
    let (planes, values) = (header.channels().planes(), header.total());
    assembler.reuse(call.service.spare.take(planes, values));
    Ok(Open::Planes(Received { assembler, plan, permit, unread }, Instant::now()))
}

/// The answer when there is no room for results.
fn results_unread(why: &str) -> Refusal {
    let detail = format!("{why}: read results as they come, or send fewer tiles at a time");
    Refusal::new(StatusCode::INSUFFICIENT_STORAGE, "results_unread", "Too many results wait to be read", detail)
}

/// The answer to a tile that never fits, with the size that would.
fn too_large(error: AdmissionError, header: &Header, shape: &Shape, call: &Call) -> Refusal {
    let mut refusal = Refusal::from(error);
    let fits = largest_core(header, shape, call);
    let advice = match fits {
        Some(side) => format!("a core of {side} x {side} pixels with this halo and as many samples would fit"),
        None => "not even a single pixel with this halo and as many samples would fit".to_owned(),
    };
    refusal.0.detail = format!("{}: {advice}", refusal.0.detail);
    refusal.0.more.insert("fits".to_owned(), fits.map(|side| [side, side]).into_iter().flatten().collect());
    refusal
}

/// Side of the largest square core that fits into the budget, other things being equal.
fn largest_core(header: &Header, shape: &Shape, call: &Call) -> Option<u32> {
    let (halo, window) = (header.geometry().halo(), header.geometry().window());
    let service = &call.service;
    let per_pixel = header.total().div_ceil(window.area());
    let fits = |side: u32| {
        let core = Rect::new(halo.left, halo.top, side, side);
        TileGeometry::new([MAX_SIDE, MAX_SIDE], core, halo).is_ok_and(|geometry| {
            let samples = per_pixel * geometry.window().area();
            let shape = Shape { geometry: &geometry, samples, ..*shape };
            let counts = if shape.varying { count_bytes(geometry.window().area()) } else { 0 };
            service.budget.check(call.plan(&shape).total(service.config.threads)).is_ok()
                && service.counts.check(counts).is_ok()
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
