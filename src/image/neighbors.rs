//! Images whose tiles come as bare cores: the samples are kept until all regions that read them are filtered.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::{
    After, Announced, Claimed, Description, Image, ImageError, MAX_TILES, MIN_CORE, Outcome, Regions,
    record::CoreRecord,
};
use crate::{
    disk::Folder,
    filter::{
        Coverage, Execution, Method, Rect, SampleTile, TileGeometry, filter,
        plan::{Plan, Shape, plan},
        samples::Replaced,
    },
    stitch::{Digest, Offer, StitchError, Stitcher},
    store::{Change, Extent, SampleFile, State, samples::BUFFERS},
    wire::{Header, SampleCounts},
};

/// Sides of regions, in pixels. Larger ones have less halo to compute twice.
const SIDES: [u32; 10] = [512, 384, 320, 256, 192, 128, 96, 64, 32, 16];
/// Of an image this many regions, at least, make it come out in parts while it comes in.
const PARTS: u64 = 16;
/// No region is smaller for that.
const LEAST: u32 = 64;

/// What is kept of bare cores.
#[derive(Debug)]
pub(super) struct Neighbors {
    file: Arc<SampleFile>,
    cores: Coverage<Core>,
    pixels: u64,
    replaced: Replaced,
    regions: Regions,
    /// Regions that are being filtered.
    running: usize,
}

#[derive(Debug)]
struct Core {
    digest: Digest,
    extent: Extent,
    /// Whether its samples are not needed any more.
    dropped: bool,
}

/// A region that can be filtered.
#[derive(Debug)]
pub struct Job {
    region: u32,
    /// What of it is to be filtered, and the samples for it.
    tiles: Vec<(TileGeometry, Vec<(Rect, Extent)>)>,
    /// Bytes of memory that this needs at most.
    pub bytes: u64,
    /// Pixels of the largest of them.
    pub pixels: u64,
}

/// Where the time went in which a region was filtered.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spent {
    /// Reading its samples.
    pub read: Duration,
    /// Filtering.
    pub filter: Duration,
    /// Putting it on the canvas, and waiting until it is durable.
    pub write: Duration,
}

impl Announced {
    /// Chooses the side of the regions so that filtering one takes at most so many bytes on so many threads; if that is
    /// not possible, says what the smallest would take.
    pub fn choose_region(
        &mut self,
        size: [u32; 2],
        method: &Method,
        threads: usize,
        bytes: u64,
        most: u64,
    ) -> Result<(), u64> {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        let area = |side: u32| u64::from(side) * u64::from(side);
        let count = |side: u32| u64::from(size[0].div_ceil(side)) * u64::from(size[1].div_ceil(side));
        let cost = |side: u32| {
            let core = Rect::new(size[0].saturating_sub(side) / 2, size[1].saturating_sub(side) / 2, side, side);
            let core = core.intersection(&Rect::new(0, 0, size[0], size[1])).unwrap_or(core);
            let reach = method.reach(self.varying);
            TileGeometry::with_halo(size, core, reach).map_or(u64::MAX, |geometry| {
                let window = geometry.window();
                let cores = u64::from(window.width / MIN_CORE + 2) * u64::from(window.height / MIN_CORE + 2);
                let finding = BUFFERS + cores * (512 + 128 * self.channels.planes() as u64);
                self.cost(&geometry, method, threads, self.varying) + finding
            })
        };
        let sides = || SIDES.into_iter().filter(|&side| count(side) <= MAX_TILES as u64);
        let parts = |side: &u32| *side <= LEAST || pixels / area(*side) >= PARTS;
        let found = sides().filter(parts).find(|&side| cost(side) <= bytes);
        match found.or_else(|| sides().find(|&side| cost(side) <= most)) {
            Some(side) => {
                self.region = side;
                Ok(())
            }
            None => Err(sides().map(cost).min().unwrap_or(u64::MAX)),
        }
    }

    /// Bytes of memory that filtering such a tile takes at most, but for finding its samples.
    fn cost(&self, geometry: &TileGeometry, method: &Method, threads: usize, varying: bool) -> u64 {
        let samples = geometry.window().area() * u64::from(self.samples);
        let shape = Shape { geometry, channels: &self.channels, samples, max_per_pixel: self.samples, varying };
        plan(&shape, method).total(threads)
    }

    /// Refuses samples that were not announced; of varying ones only the header is known.
    pub fn check(&self, header: &Header) -> Result<(), ImageError> {
        let core = header.geometry().core();
        small(&core, &header.geometry().image())?;
        match header.samples() {
            SampleCounts::Uniform(n) if n == self.samples || self.varying && n < self.samples => Ok(()),
            SampleCounts::Varying { .. } if self.varying => Ok(()),
            SampleCounts::Uniform(n) => Err(self.mismatch(core, n.to_string())),
            SampleCounts::Varying { .. } => Err(self.mismatch(core, "varying".to_owned())),
        }
    }

    fn mismatch(&self, core: Rect, got: String) -> ImageError {
        let most = if self.varying { "at most " } else { "" };
        ImageError::SampleCount { core, got, announced: format!("{most}{}", self.samples) }
    }
}

/// Bytes that keeping the samples of a tile of this shape takes at most.
pub fn keeping(shape: &Shape) -> Plan {
    let samples = plan(shape, &Method::default()).samples;
    // Beside what they are compressed in, what they are hashed in.
    Plan { samples, working: BUFFERS + (1 << 17), ..Plan::default() }
}

/// Refuses cores that are too small.
fn small(core: &Rect, image: &Rect) -> Result<(), ImageError> {
    let wide = core.width >= MIN_CORE || core.x == 0 || core.right() == image.width;
    let high = core.height >= MIN_CORE || core.y == 0 || core.bottom() == image.height;
    if wide && high { Ok(()) } else { Err(ImageError::TooSmall(*core)) }
}

impl Neighbors {
    pub(super) fn open(
        folder: &dyn Folder,
        state: &State,
        description: &Description,
        known: &Announced,
        stitcher: &Stitcher,
        finished: bool,
    ) -> Result<Self, ImageError> {
        let image = stitcher.image();
        let reach = description.method.reach(known.varying);
        let mut regions = Regions::new(description.size, known.region, reach);
        let (mut cores, mut pixels, mut replaced) = (Coverage::default(), 0, Replaced::default());
        let mut wrong = None;
        state.samples(|core, bytes| match CoreRecord::decode(bytes).filter(|_| image.covers(&core)) {
            Some(record) if cores.meeting(&core).is_empty() => {
                let kept = Core { digest: record.digest, extent: record.extent, dropped: false };
                let _ = cores.insert(core, kept);
                regions.arrived(&core);
                pixels += core.area();
                sum(&mut replaced, &record.replaced);
            }
            _ => drop(wrong.get_or_insert(format!("the record of the samples of tile {core} cannot be read"))),
        })?;
        if let Some(why) = wrong {
            return Err(state.damaged(why).into());
        }
        if finished {
            regions.finish();
        }
        // All that is ready is looked at once.
        let ready: Vec<u32> = std::iter::from_fn(|| regions.start_next()).collect();
        for region in ready {
            if unfiltered(&cores, stitcher, &regions.core(region)).is_empty() {
                regions.done(region);
            } else {
                regions.give_back(region);
            }
        }
        let all: Vec<Rect> = cores.iter().map(|(core, _)| core).collect();
        let mut extents = Vec::new();
        for core in all {
            let needed = regions.need(&core);
            if let Some(kept) = cores.get_mut(&core) {
                kept.dropped = !needed;
                extents.extend(needed.then_some(kept.extent));
            }
        }
        let file = Arc::new(SampleFile::open(folder, known.channels.clone(), extents)?);
        Ok(Self { file, cores, pixels, replaced, regions, running: 0 })
    }

    pub(super) fn file(&self) -> Arc<SampleFile> {
        Arc::clone(&self.file)
    }

    pub(super) const fn regions(&self) -> &Regions {
        &self.regions
    }

    pub(super) fn count(&self) -> (usize, u64) {
        (self.cores.len(), self.pixels)
    }

    pub(super) fn absent(&self, window: &Rect) -> Vec<Rect> {
        self.cores.missing(window)
    }

    pub(super) const fn replaced(&self) -> Replaced {
        self.replaced
    }

    pub(super) const fn idle(&self) -> bool {
        self.running == 0
    }

    pub(super) fn arrived(&mut self, core: &Rect) {
        self.regions.arrived(core);
    }

    pub(super) fn finish(&mut self) {
        self.regions.finish();
    }

    /// A region is filtered, and that is durable.
    pub(super) fn done(&mut self, region: u32) {
        self.regions.done(region);
        let near = self.cores.meeting(&self.regions.window(region));
        let near: Vec<Rect> = near.into_iter().filter(|(_, kept)| !kept.dropped).map(|(core, _)| core).collect();
        for core in near.into_iter().filter(|core| !self.regions.need(core)) {
            if let Some(kept) = self.cores.get_mut(&core) {
                kept.dropped = true;
                self.file.release(&kept.extent);
            }
        }
    }

    /// What is known of a core: `Ok(true)` that it is there, made from the same samples.
    fn known(&self, core: &Rect, digest: Digest) -> Result<bool, ImageError> {
        match self.cores.meeting(core).first() {
            None => Ok(false),
            Some((other, kept)) if other == core && kept.digest == digest => Ok(true),
            Some((other, _)) if other == core => Err(StitchError::Conflict(*core).into()),
            Some((other, _)) => Err(StitchError::Overlap { core: *core, other: *other }.into()),
        }
    }
}

fn sum(all: &mut Replaced, more: &Replaced) {
    all.color += more.color;
    all.feature += more.feature;
    all.random += more.random;
    all.film += more.film;
}

/// The parts of a rectangle whose samples have arrived and that are not on the canvas.
fn unfiltered<T>(cores: &Coverage<T>, stitcher: &Stitcher, rect: &Rect) -> Vec<Rect> {
    let mut absent: Coverage<()> = Coverage::default();
    for gap in cores.missing(rect) {
        // The gaps are apart from each other.
        let _ = absent.insert(gap, ());
    }
    let present = absent.missing(rect);
    present.iter().flat_map(|part| stitcher.missing_in(part)).collect()
}

impl Image {
    /// Keeps the samples of a bare core.
    pub(super) fn keep(&self, tile: &SampleTile, digest: Digest) -> Result<Outcome, ImageError> {
        let (core, Some(announced)) = (tile.geometry().core(), &self.description.neighbors) else {
            return Ok(Outcome::Repeated);
        };
        small(&core, &tile.geometry().image())?;
        if tile.max_per_pixel() > announced.samples || tile.varying() && !announced.varying {
            return Err(announced.mismatch(core, tile.max_per_pixel().to_string()));
        }
        let known = |image: &super::Inner| -> Result<bool, ImageError> {
            let Some(neighbors) = &image.neighbors else { return Ok(false) };
            if neighbors.known(&core, digest)? {
                return Ok(true);
            }
            if image.finished {
                return Err(ImageError::Finished);
            }
            if neighbors.cores.len() >= MAX_TILES { Err(ImageError::TooManyTiles) } else { Ok(false) }
        };
        let file = {
            let inner = self.read();
            if known(&inner)? {
                return Ok(Outcome::Repeated);
            }
            inner.neighbors.as_ref().map(Neighbors::file)
        };
        let Some(file) = file else { return Ok(Outcome::Repeated) };
        let _writer = self.writer()?;
        let extent = file.append(tile)?;
        let mut inner = self.write();
        // Another one may have brought it meanwhile.
        match known(&inner) {
            Ok(false) => {}
            other => {
                file.release(&extent);
                return other.map(|_| Outcome::Repeated);
            }
        }
        let record = CoreRecord { digest, extent, replaced: tile.replaced() };
        if let Some(neighbors) = &mut inner.neighbors {
            let _ = neighbors.cores.insert(core, Core { digest, extent, dropped: false });
            neighbors.pixels += core.area();
            sum(&mut neighbors.replaced, &record.replaced);
        }
        inner.queue([Change::Samples(core, record.encode())], Some(After::Arrived(core)));
        Ok(Outcome::Stored)
    }

    /// The next region that can be filtered, in tiles that take at most `most` bytes, and have at most so many pixels,
    /// each.
    pub fn next_job(&self, threads: usize, most: u64, pixels: u64) -> Result<Option<Job>, ImageError> {
        self.check()?;
        let mut inner = self.write();
        let inner = &mut *inner;
        let (Some(neighbors), Some(announced)) = (&mut inner.neighbors, &self.description.neighbors) else {
            return Ok(None);
        };
        while let Some(region) = neighbors.regions.start_next() {
            let mut job = Job { region, tiles: Vec::new(), bytes: 0, pixels: 0 };
            let mut rects = unfiltered(&neighbors.cores, &inner.stitcher, &neighbors.regions.core(region));
            while let Some(core) = rects.pop() {
                let reach = self.description.method.reach(announced.varying);
                let geometry =
                    TileGeometry::with_halo(self.description.size, core, reach).map_err(StitchError::from)?;
                let window = geometry.window();
                let cores = neighbors.cores.meeting(&window).into_iter();
                let cores: Vec<_> = cores.map(|(core, kept)| (core, kept.extent)).collect();
                // Pixels that are not there are pixels without samples.
                let varying = announced.varying || !neighbors.cores.missing(&window).is_empty();
                let bytes = announced.cost(&geometry, &self.description.method, threads, varying)
                    + neighbors.file.cut_bytes(&cores);
                let single = core.area() == 1;
                if bytes <= most && (core.area() <= pixels || single) {
                    job.bytes = job.bytes.max(bytes);
                    job.pixels = job.pixels.max(core.area());
                    job.tiles.push((geometry, cores));
                } else if !single {
                    rects.extend(halves(core));
                } else {
                    neighbors.regions.give_back(region);
                    return Err(ImageError::TooLarge { core, needed: bytes, most });
                }
            }
            if !job.tiles.is_empty() {
                neighbors.running += 1;
                return Ok(Some(job));
            }
            neighbors.done(region);
        }
        Ok(None)
    }

    /// Filters a region, and puts it on the canvas; durable when it returns. Parts of it that were done before it was
    /// stopped are kept. The seed is the image's, whatever the execution says, and so is what is left out.
    pub fn run(self: &Arc<Self>, job: &Job, execution: &Execution) -> Result<Spent, ImageError> {
        let mut spent = Spent::default();
        let mut parts = job.tiles.iter();
        let done = parts.try_for_each(|(geometry, cores)| self.filter_part(geometry, cores, execution, &mut spent));
        let mut inner = self.write();
        if let Some(neighbors) = &mut inner.neighbors {
            neighbors.running -= 1;
            if done.is_err() {
                neighbors.regions.give_back(job.region);
            }
        }
        done?;
        inner.queue([], Some(After::RegionDone(job.region)));
        drop(inner);
        let started = Instant::now();
        self.flush()?;
        spent.write += started.elapsed();
        Ok(spent)
    }

    /// A region that will not be filtered now.
    pub fn give_back(&self, job: &Job) {
        if let Some(neighbors) = &mut self.write().neighbors {
            neighbors.running -= 1;
            neighbors.regions.give_back(job.region);
        }
    }

    fn filter_part(
        self: &Arc<Self>,
        geometry: &TileGeometry,
        cores: &[(Rect, Extent)],
        execution: &Execution,
        spent: &mut Spent,
    ) -> Result<(), ImageError> {
        if execution.stopped() {
            return Err(crate::filter::Stopped.into());
        }
        let (file, claim) = {
            let mut inner = self.write();
            let Some(file) = inner.neighbors.as_ref().map(Neighbors::file) else { return Ok(()) };
            match inner.stitcher.offer(geometry.core(), [0; 32], false)? {
                Offer::Repeated => return Ok(()),
                Offer::Filter(claim) => (file, Claimed { image: Arc::clone(self), claim: Some(claim) }),
            }
        };
        let started = Instant::now();
        let tile = file.cut(*geometry, cores)?;
        spent.read += started.elapsed();
        let Description { seed, leave_out, .. } = self.description;
        let began = Instant::now();
        let filtered = filter(&tile, &self.description.method, &Execution { seed, leave_out, ..*execution })?;
        drop(tile);
        spent.filter += began.elapsed();
        let began = Instant::now();
        self.add(claim, &filtered, started.elapsed().as_secs_f64())?;
        spent.write += began.elapsed();
        Ok(())
    }
}

/// A rectangle of more than one pixel in two, across its longer side.
fn halves(rect: Rect) -> [Rect; 2] {
    let Rect { x, y, width, height } = rect;
    if width >= height {
        let left = width / 2;
        [Rect::new(x, y, left, height), Rect::new(x + left, y, width - left, height)]
    } else {
        let top = height / 2;
        [Rect::new(x, y, width, top), Rect::new(x, y + top, width, height - top)]
    }
}
