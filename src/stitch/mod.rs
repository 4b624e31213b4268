//! The image being assembled: filtered cores in, in any order; an EXR out.
//!
//! - [`canvas`]: their pixels, in a file.
//! - [`digest`](mod@digest): whether two tiles bring the same samples.
//! - [`exr`]: the finished image as OpenEXR; reference images.
//! - [`atomic`]: files that are complete or not there.
//!
//! [`Stitcher`] joins them. A core goes through it in two steps, since filtering takes long and happens elsewhere:
//! [`Stitcher::offer`] says before the filter whether the core is wanted, [`Stitcher::add`] takes the result. Between the
//! two the core is claimed; the [`Claim`] is the right to deliver it, and dropping it (an error, a cut connection) gives
//! the core free again.
//!
//! What happens when the same core comes twice is decided by the digest of its samples:
//!
//! | the core is | same samples | other samples | other samples, `replace` |
//! |---|---|---|---|
//! | stored | repeated | conflict | filtered, and takes the old one's place |
//! | claimed | filtered too; the second to arrive is repeated | busy | filtered; the one offered last stays |
//!
//! A stored core that lacked halo is not repeated but filtered again, and takes its own place, with `replace`.
//! A core that overlaps a stored or claimed one without being equal to it is refused, `replace` or not.
//!
//! The stitcher does no locking and no waiting; an image has one owner that all calls go through.

pub mod atomic;
pub mod canvas;
pub mod digest;
pub mod exr;
mod totals;

pub use canvas::{Canvas, CanvasError, Pixels, RgbImage};
pub use digest::{digest, window_digest};
pub use exr::{ExrCompression, ExrError, ExrLayout, ExrOptions, ExrSamples, ExrSummary};
pub use totals::Totals;

use crate::filter::{
    Coverage, Filtered, Rect, Report, TileGeometry,
    geometry::{GeometryError, Halo},
};
use std::{
    collections::BTreeMap,
    path::Path,
    sync::{Arc, Weak},
};

use totals::count;

/// A digest of a core's samples: equal digests mean equal samples.
pub type Digest = [u8; 32];

/// Why a core was refused, or the image could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StitchError {
    /// The core has no pixels or sticks out of the image.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// The core overlaps another one.
    #[error("tile {core} overlaps tile {other}, which came before: cores of one image must be equal or apart")]
    Overlap {
        /// The core that was refused.
        core: Rect,
        /// One that it overlaps.
        other: Rect,
    },
    /// The core is stored, made from other samples.
    #[error("tile {0} is already there, made from other samples; ask for it to be replaced if that is meant")]
    Conflict(Rect),
    /// The core is just being made from other samples.
    #[error("tile {0} is just being made from other samples that came before")]
    Busy(Rect),
    /// While the core was filtered another one, offered later with `replace`, took its place.
    #[error("tile {0} was replaced by a later one before it was done")]
    Superseded(Rect),
    /// Pixels are missing.
    #[error("the image is not complete: {pixels} pixels are missing, the first of them in {first}")]
    Incomplete {
        /// Pixels missing.
        pixels: u64,
        /// The first of the missing regions.
        first: Rect,
    },
    /// What was delivered is not what was claimed.
    #[error("the result is not that of tile {0}")]
    Mismatch(Rect),
    /// The canvas failed.
    #[error(transparent)]
    Canvas(#[from] CanvasError),
    /// The EXR could not be written.
    #[error(transparent)]
    Exr(#[from] ExrError),
}

impl StitchError {
    /// A stable code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Geometry(_) => "invalid-geometry",
            Self::Overlap { .. } => "tile-overlap",
            Self::Conflict(_) => "tile-conflict",
            Self::Busy(_) => "tile-busy",
            Self::Superseded(_) => "tile-superseded",
            Self::Incomplete { .. } => "image-incomplete",
            Self::Mismatch(_) => "internal",
            Self::Canvas(error) => error.code(),
            Self::Exr(error) => error.code(),
        }
    }
}

/// What to do with an offered core.
#[derive(Debug)]
#[must_use]
pub enum Offer {
    /// Filter it and [`add`](Stitcher::add) the result.
    Filter(Claim),
    /// Nothing: it is stored, made from the same samples.
    Repeated,
}

/// The right to deliver a core. Dropping it gives the core free.
#[derive(Debug)]
pub struct Claim {
    core: Rect,
    digest: Digest,
    replace: bool,
    /// Position in the order of all offers.
    turn: u64,
    alive: Arc<()>,
}

impl Claim {
    /// The core that is claimed.
    pub const fn core(&self) -> Rect {
        self.core
    }

    /// The digest of its samples.
    pub const fn digest(&self) -> Digest {
        self.digest
    }
}

/// What became of a delivered core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Added {
    /// It is on the canvas.
    Stored,
    /// The same core from the same samples came first.
    Repeated,
}

/// What a claim will do to the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The core is new on the canvas.
    New,
    /// It takes the place of one that is stored.
    Replaces,
    /// Nothing: the same core from the same samples came first.
    Repeats,
}

#[derive(Debug)]
struct Stored {
    digest: Digest,
    turn: u64,
    report: Report,
}

impl Stored {
    /// Whether the same samples need not be filtered again: they were, and with all the halo that the method reads, or
    /// nobody asks for better.
    fn done_with(&self, digest: Digest, replace: bool) -> bool {
        self.digest == digest && (self.report.exact() || !replace)
    }
}

#[derive(Debug)]
struct Pending {
    digest: Digest,
    alive: Weak<()>,
}

impl Pending {
    fn is(&self, claim: &Claim) -> bool {
        self.alive.as_ptr() == Arc::as_ptr(&claim.alive)
    }
}

#[derive(Debug, Default)]
struct Entry {
    /// Apart from the list, which has empty places.
    stored: Option<Box<Stored>>,
    pending: Vec<Pending>,
}

impl Entry {
    fn forget_dead(&mut self) {
        self.pending.retain(|pending| pending.alive.strong_count() > 0);
    }
}

/// An image being assembled.
#[derive(Debug)]
pub struct Stitcher {
    /// How many tiles did without a plane, by its name and why; not kept tile by tile, since the names are many bytes.
    left_out: BTreeMap<(String, &'static str), u64>,
    coverage: Coverage<Entry>,
    canvas: Canvas,
    done: u64,
    turn: u64,
}

impl Stitcher {
    /// An empty image, its canvas in a file without a name in `directory`.
    pub fn new(width: u32, height: u32, directory: &Path) -> Result<Self, StitchError> {
        TileGeometry::new([width, height], Rect::new(0, 0, 1, 1), Halo::default())?;
        Ok(Self::on(Canvas::temporary(width, height, directory)?))
    }

    /// An image on a given canvas, none of whose pixels count yet: see [`Self::restore`].
    pub fn on(canvas: Canvas) -> Self {
        Self { coverage: Coverage::default(), canvas, done: 0, turn: 0, left_out: BTreeMap::new() }
    }

    /// Asks whether a core, made from samples with this digest, is wanted.
    ///
    /// With `replace` a stored core made from other samples may be replaced.
    pub fn offer(&mut self, core: Rect, digest: Digest, replace: bool) -> Result<Offer, StitchError> {
        self.check(core)?;
        if let Some(entry) = self.coverage.get_mut(&core) {
            entry.forget_dead();
            match &entry.stored {
                Some(stored)
                    if stored.done_with(digest, replace) && entry.pending.iter().all(|p| p.digest == digest) =>
                {
                    return Ok(Offer::Repeated);
                }
                Some(stored) if stored.digest != digest && !replace => return Err(StitchError::Conflict(core)),
                _ => {}
            }
            if !replace && entry.pending.iter().any(|pending| pending.digest != digest) {
                return Err(StitchError::Busy(core));
            }
        } else {
            self.insert(core, Entry::default())?;
        }
        self.turn += 1;
        let claim = Claim { core, digest, replace, turn: self.turn, alive: Arc::new(()) };
        if let Some(entry) = self.coverage.get_mut(&core) {
            entry.pending.push(Pending { digest, alive: Arc::downgrade(&claim.alive) });
        }
        Ok(Offer::Filter(claim))
    }

    /// Says what [`Self::add`] will do.
    pub fn judge(&self, claim: &Claim) -> Result<Verdict, StitchError> {
        let core = claim.core;
        // The entry lives as long as the claim, unless the claim is another image's.
        let entry = self.coverage.get(&core).ok_or(StitchError::Mismatch(core))?;
        if !entry.pending.iter().any(|pending| pending.is(claim)) {
            return Err(StitchError::Mismatch(core));
        }
        match &entry.stored {
            None => Ok(Verdict::New),
            Some(stored) if stored.done_with(claim.digest, claim.replace) => Ok(Verdict::Repeats),
            Some(stored) if stored.turn > claim.turn => Err(StitchError::Superseded(core)),
            Some(stored) if stored.digest != claim.digest && !claim.replace => Err(StitchError::Conflict(core)),
            Some(_) => Ok(Verdict::Replaces),
        }
    }

    /// Puts a filtered core on the canvas. If that fails the core is missing afterwards.
    pub fn add(&mut self, claim: Claim, filtered: &Filtered) -> Result<Added, StitchError> {
        let core = claim.core;
        if filtered.core != core || filtered.rgb.iter().any(|plane| plane.len() as u64 != core.area()) {
            self.release(&claim);
            return Err(StitchError::Mismatch(core));
        }
        let [r, g, b] = &filtered.rgb;
        let canvas = self.canvas.clone();
        self.add_with(claim, &filtered.report, || canvas.write(core, [r, g, b]).map(drop))
    }

    /// As [`Self::add`], `write` putting the pixels on the canvas.
    pub fn add_with(
        &mut self,
        claim: Claim,
        report: &Report,
        write: impl FnOnce() -> Result<(), CanvasError>,
    ) -> Result<Added, StitchError> {
        let core = claim.core;
        let verdict = self.judge(&claim);
        let mismatch = || StitchError::Mismatch(core);
        let entry = self.coverage.get_mut(&core).ok_or_else(mismatch)?;
        entry.pending.retain(|pending| !pending.is(&claim));
        match verdict? {
            Verdict::Repeats => {
                if let Some(stored) = &mut entry.stored {
                    stored.turn = stored.turn.max(claim.turn);
                }
                return Ok(Added::Repeated);
            }
            Verdict::Replaces => {
                entry.stored = None;
                self.done -= core.area();
            }
            Verdict::New => {}
        }
        write()?;
        let mut report = report.clone();
        count(&mut self.left_out, &mut report);
        entry.stored = Some(Box::new(Stored { digest: claim.digest, turn: claim.turn, report }));
        self.done += core.area();
        Ok(Added::Stored)
    }

    /// Gives a claim up, and forgets its core if nobody else has claimed it.
    pub fn release(&mut self, claim: &Claim) {
        let Some(entry) = self.coverage.get_mut(&claim.core) else { return };
        entry.forget_dead();
        entry.pending.retain(|pending| !pending.is(claim));
        if entry.stored.is_none() && entry.pending.is_empty() {
            self.coverage.remove(&claim.core);
        }
    }

    /// Counts a core as stored that is on the canvas already, after a restart. Cores that are known or claimed are
    /// refused.
    pub fn restore(&mut self, core: Rect, digest: Digest, report: Report) -> Result<(), StitchError> {
        self.check(core)?;
        if self.coverage.get(&core).is_some() {
            return Err(StitchError::Conflict(core));
        }
        let mut report = report;
        count(&mut self.left_out, &mut report);
        let stored = Some(Box::new(Stored { digest, turn: 0, report }));
        self.insert(core, Entry { stored, pending: Vec::new() })?;
        self.done += core.area();
        Ok(())
    }

    fn insert(&mut self, core: Rect, entry: Entry) -> Result<(), StitchError> {
        self.coverage.insert(core, entry).map_err(|other| StitchError::Overlap { core, other })
    }

    /// Refuses a core outside the image or across others; forgets claims that were given up on the way.
    fn check(&mut self, core: Rect) -> Result<(), StitchError> {
        let Rect { width, height, .. } = self.image();
        TileGeometry::new([width, height], core, Halo::default())?;
        let meeting: Vec<Rect> = self.coverage.meeting(&core).into_iter().map(|(other, _)| other).collect();
        for other in meeting.into_iter().filter(|other| *other != core) {
            let entry = self.coverage.get_mut(&other);
            if entry.is_some_and(|entry| {
                entry.forget_dead();
                entry.stored.is_some() || !entry.pending.is_empty()
            }) {
                return Err(StitchError::Overlap { core, other });
            }
            self.coverage.remove(&other);
        }
        Ok(())
    }

    /// The image as a rectangle at (0, 0).
    pub fn image(&self) -> Rect {
        self.canvas.image()
    }

    /// The canvas. Where pixels are missing it may hold remains of an interrupted write: see [`Self::pixels`].
    pub const fn canvas(&self) -> &Canvas {
        &self.canvas
    }

    /// Number of pixels stored.
    pub const fn pixels_done(&self) -> u64 {
        self.done
    }

    /// Whether every pixel is stored.
    pub fn is_complete(&self) -> bool {
        self.done == self.image().area()
    }

    /// The pixels that are not stored, as few rectangles, by rows. They do not depend on the order of arrival.
    pub fn missing(&self) -> Vec<Rect> {
        self.coverage.missing_but(&self.image(), |entry| entry.stored.is_some())
    }

    /// The parts of a rectangle that are not stored.
    pub fn missing_in(&self, rect: &Rect) -> Vec<Rect> {
        self.coverage.missing_but(rect, |entry| entry.stored.is_some())
    }

    /// The digest of the samples of a stored core.
    pub fn peek(&self, core: &Rect) -> Option<Digest> {
        Some(self.coverage.get(core)?.stored.as_ref()?.digest)
    }

    /// The stored tiles by rows, with their reports.
    pub fn tiles(&self) -> impl Iterator<Item = (Rect, &Report)> {
        self.coverage.iter().filter_map(|(core, entry)| Some((core, &entry.stored.as_ref()?.report)))
    }

    /// How many times a tile was stored that did without a plane, by the plane's name and the reason. The tiles' own
    /// reports ([`Self::tiles`]) do not say it.
    pub const fn left_out(&self) -> &BTreeMap<(String, &'static str), u64> {
        &self.left_out
    }

    /// Number of stored and claimed tiles.
    pub fn known(&self) -> usize {
        self.coverage.len()
    }

    /// Sums over the stored tiles; the same whatever the order of arrival.
    pub fn totals(&self) -> Totals {
        let mut totals = Totals::default();
        self.tiles().for_each(|(core, report)| totals.add(&core, report));
        totals
    }

    /// Refuses while pixels are missing, unless `partial`. Otherwise says how many are.
    pub fn check_complete(&self, partial: bool) -> Result<u64, StitchError> {
        let pixels = self.image().area() - self.done;
        if pixels > 0 && !partial {
            let first = self.missing()[0];
            return Err(StitchError::Incomplete { pixels, first });
        }
        Ok(pixels)
    }

    /// The stored pixels, black where they are missing.
    pub fn pixels(&self) -> StoredPixels {
        let missing = if self.is_complete() { Vec::new() } else { self.missing() };
        StoredPixels { canvas: self.canvas.clone(), missing }
    }

    /// Writes the image as an EXR file: complete, durable and under its name, or not at all.
    ///
    /// While pixels are missing this is an error, unless `partial`: then they are black, and the attribute
    /// `rpfd:missing` says how many there are.
    pub fn write_exr(&self, options: &ExrOptions, partial: bool, path: &Path) -> Result<ExrSummary, StitchError> {
        let options = self.options(options, partial)?;
        Ok(exr::write(&self.pixels(), &options, path)?)
    }

    /// As [`Self::write_exr`], to a stream that buffers.
    pub fn encode_exr(
        &self,
        options: &ExrOptions,
        partial: bool,
        out: &mut (impl std::io::Write + std::io::Seek),
    ) -> Result<ExrSummary, StitchError> {
        let options = self.options(options, partial)?;
        Ok(exr::encode(&self.pixels(), &options, out)?)
    }

    fn options(&self, options: &ExrOptions, partial: bool) -> Result<ExrOptions, StitchError> {
        let mut options = options.clone();
        let missing = self.check_complete(partial)?;
        if missing > 0 {
            options.attributes.insert("rpfd:missing".into(), missing.to_string());
        }
        Ok(options)
    }
}

/// The pixels of a [`Stitcher`] at a moment; those that are missing are black, whatever an interrupted write left on the
/// canvas. Cores that are stored later do not show, unless they replace one.
#[derive(Debug)]
pub struct StoredPixels {
    canvas: Canvas,
    missing: Vec<Rect>,
}

impl Pixels for StoredPixels {
    fn image(&self) -> Rect {
        self.canvas.image()
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        self.canvas.read(rect, pixels)?;
        // Missing regions are ordered by y.
        let below = self.missing.partition_point(|gap| gap.y < rect.bottom());
        for gap in self.missing[..below].iter().filter_map(|gap| gap.intersection(&rect)) {
            for y in gap.y..gap.bottom() {
                let start = rect.index(gap.x, y);
                pixels[start..start + gap.width as usize].fill([0.0; 3]);
            }
        }
        Ok(())
    }
}
