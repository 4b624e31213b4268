//! Images whose tiles lend each other their halos: the samples are kept until all regions that read them are filtered.
//!
//! Of a pixel its core has the last word. Until that has come, what a halo brings stands for it, so that regions need not
//! wait; such pixels are kept once, as far as there is [room](Room) beside all cores that may still come. What was
//! filtered from them is *provisional*: when the cores have come their samples are compared with what was read then, and
//! only if they differ it is filtered again.

use std::{collections::BTreeMap, sync::Arc};

use super::{
    After, Announced, Description, Image, ImageError, MAX_TILES, Outcome, RegionState, Regions,
    announced::small,
    jobs::unfiltered,
    record::{CoreRecord, extent_from_bytes, extent_to_bytes},
    room::Room,
};
use crate::{
    disk::Folder,
    filter::{Coverage, Rect, SampleTile, TileGeometry, samples::Replaced},
    stitch::{Digest, StitchError, Stitcher},
    store::{Change, Extent, Records, SampleFile, Source, State},
};

/// What is kept of bare cores.
#[derive(Debug)]
pub(super) struct Neighbors {
    file: Arc<SampleFile>,
    cores: Coverage<Core>,
    /// Pixels that a halo brought before their core came.
    lent: Coverage<Lent>,
    /// By region, the tiles on the canvas that are provisional.
    provisional: BTreeMap<u32, Vec<Rect>>,
    /// Records of what was lent that are of no use any more.
    forgotten: Vec<Rect>,
    room: Room,
    pixels: u64,
    replaced: Replaced,
    regions: Regions,
    /// Regions that are being filtered.
    pub(super) running: usize,
}

#[derive(Debug)]
struct Core {
    digest: Digest,
    extent: Extent,
    /// Whether the regions know of it.
    counted: bool,
    /// Whether its samples are not needed any more.
    dropped: bool,
}

#[derive(Debug)]
struct Lent {
    /// None while it is being written.
    extent: Option<Extent>,
    counted: bool,
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
        let (mut cores, mut lent, mut provisional) = (Coverage::default(), Coverage::default(), BTreeMap::new());
        let (mut pixels, mut replaced) = (0, Replaced::default());
        let mut wrong = None;
        let mut damage = |what: &str, rect: Rect| {
            wrong.get_or_insert(format!("the record of the samples of {what} {rect} cannot be read"));
        };
        state.each(Records::Samples, |core, bytes| {
            match CoreRecord::decode(bytes).filter(|_| image.covers(&core)) {
                Some(CoreRecord { digest, extent, replaced: more }) if cores.meeting(&core).is_empty() => {
                    let _ = cores.insert(core, Core { digest, extent, counted: true, dropped: false });
                    regions.arrived(&core, &[]);
                    pixels += core.area();
                    sum(&mut replaced, &more);
                }
                _ => damage("tile", core),
            }
        })?;
        state.each(Records::Lent, |part, bytes| match extent_from_bytes(bytes).filter(|_| image.covers(&part)) {
            Some(extent) if lent.meeting(&part).is_empty() => {
                let _ = lent.insert(part, Lent { extent: Some(extent), counted: true });
                cores.missing(&part).iter().for_each(|part| regions.lent(part));
            }
            _ => damage("a halo,", part),
        })?;
        // Some may not have been filtered.
        state.each(Records::Provisional, |tile, _| {
            if image.covers(&tile) {
                provisional.entry(regions.at(tile.x, tile.y)).or_insert_with(Vec::new).push(tile);
            }
        })?;
        if let Some(why) = wrong {
            return Err(state.damaged(why).into());
        }
        if finished {
            regions.finish();
        }
        let file = Arc::new(SampleFile::open(folder, known.channels.clone())?);
        let room = Room::new(description, known);
        let forgotten = Vec::new();
        let mut this = Self { file, cores, lent, provisional, forgotten, room, pixels, replaced, regions, running: 0 };
        // All that is ready is looked at once.
        let ready: Vec<u32> = std::iter::from_fn(|| this.regions.start_next()).collect();
        for region in ready {
            if !unfiltered(&this, stitcher, region).is_empty() {
                this.regions.give_back(region);
            } else if this.regions.last(region) && !this.provisional(region).any(|tile| stitcher.peek(&tile).is_some())
            {
                this.regions.done(region);
            } else {
                this.regions.filtered(region);
            }
        }
        // Where the samples of those were that were dropped before, there may be others now: what is in none that is needed is
        // given back below.
        this.drop_cores(&image);
        let lent: Vec<Rect> = this.lent.iter().map(|(part, _)| part).collect();
        this.drop_lent(lent);
        this.room.taken = this.extents().map(|extent| extent.room()).sum();
        this.file.keep(this.extents().collect())?;
        Ok(this)
    }

    /// Where the samples are that are needed.
    fn extents(&self) -> impl Iterator<Item = Extent> {
        let cores = self.cores.iter().filter(|(_, core)| !core.dropped).map(|(_, core)| core.extent);
        cores.chain(self.lent.iter().filter_map(|(_, lent)| lent.extent))
    }

    pub(super) fn file(&self) -> Arc<SampleFile> {
        Arc::clone(&self.file)
    }

    pub(super) const fn regions(&self) -> &Regions {
        &self.regions
    }

    /// Cores and parts of halos that are known.
    pub(super) fn entries(&self) -> usize {
        self.cores.len() + self.lent.len()
    }

    pub(super) fn count(&self) -> (usize, u64) {
        (self.cores.len(), self.pixels)
    }

    pub(super) fn absent(&self, window: &Rect) -> Vec<Rect> {
        self.cores.missing(window)
    }

    /// The parts of a rectangle that cores have brought.
    pub(super) fn present(&self, rect: &Rect) -> Vec<Rect> {
        let mut absent: Coverage<()> = Coverage::default();
        for gap in self.cores.missing(rect) {
            // The gaps are apart from each other.
            let _ = absent.insert(gap, ());
        }
        absent.missing(rect)
    }

    /// What a region waits for: pixels that have not come, or, if it is filtered, not in cores.
    pub(super) fn awaited(&self, region: u32) -> Vec<Rect> {
        let (core, window) = (self.regions.core(region), self.regions.window(region));
        let mut there: Coverage<()> = Coverage::default();
        if self.regions.state(region) == RegionState::Waiting {
            let lent = self.lent.meeting(&window).into_iter().filter(|(_, lent)| lent.counted);
            let around = lent.flat_map(|(part, _)| part.without(&core)).filter_map(|part| part.intersection(&window));
            for part in around.flat_map(|part| self.cores.missing(&part)) {
                let _ = there.insert(part, ());
            }
        }
        for (core, _) in self.cores.meeting(&window) {
            let _ = there.insert(core, ());
        }
        there.missing(&window)
    }

    /// The samples for a window: the cores', and where there are none, lent ones.
    pub(super) fn sources(&self, window: &Rect) -> Vec<Source> {
        let cores = self.cores.meeting(window).into_iter();
        let cores = cores.map(|(core, kept)| Source { stored: core, extent: kept.extent, used: core });
        let lent = self.lent.meeting(window).into_iter();
        let lent = lent.filter_map(|(part, lent)| Some((part, lent.extent?, part.intersection(window)?)));
        let lent = lent.flat_map(|(stored, extent, here)| {
            self.cores.missing(&here).into_iter().map(move |used| Source { stored, extent, used })
        });
        cores.chain(lent).collect()
    }

    pub(super) const fn replaced(&self) -> Replaced {
        self.replaced
    }

    pub(super) const fn idle(&self) -> bool {
        self.running == 0
    }

    /// The records that are of no use any more; they need not be known of again.
    pub(super) fn forget(&mut self) -> impl Iterator<Item = Change> {
        std::mem::take(&mut self.forgotten).into_iter().map(|part| Change::Remove(Records::Lent, part))
    }

    /// The first region that is ready; it is running from now on.
    pub(super) fn start_next(&mut self) -> Option<u32> {
        self.regions.start_next()
    }

    pub(super) fn give_back(&mut self, region: u32) {
        self.regions.give_back(region);
    }

    pub(super) fn set_aside(&mut self, region: u32) {
        self.regions.set_aside(region);
    }

    pub(super) fn retry(&mut self) {
        self.regions.retry();
    }

    /// A tile of a region that is provisional.
    pub(super) fn doubt(&mut self, region: u32, tile: Rect) {
        let tiles = self.provisional.entry(region).or_default();
        if !tiles.contains(&tile) {
            tiles.push(tile);
        }
    }

    pub(super) fn provisional(&self, region: u32) -> impl Iterator<Item = Rect> {
        self.provisional.get(&region).into_iter().flatten().copied()
    }

    /// A region's tiles are final: which of them were not before.
    pub(super) fn settle(&mut self, region: u32) -> Vec<Rect> {
        self.provisional.remove(&region).unwrap_or_default()
    }

    /// A core is durable.
    pub(super) fn arrived(&mut self, core: &Rect) {
        if let Some(kept) = self.cores.get_mut(core) {
            kept.counted = true;
        }
        let lent = self.lent.meeting(core).into_iter().filter(|(_, lent)| lent.counted).map(|(part, _)| part);
        let lent: Vec<Rect> = lent.collect();
        let here: Vec<Rect> = lent.iter().filter_map(|part| part.intersection(core)).collect();
        self.regions.arrived(core, &here);
        self.drop_lent(lent);
    }

    /// Pixels that a halo brought are durable.
    pub(super) fn lent(&mut self, part: &Rect) {
        let Some(lent) = self.lent.get_mut(part) else { return };
        lent.counted = true;
        // Cores may have come meanwhile.
        for part in self.cores.missing_but(part, |core| core.counted) {
            self.regions.lent(&part);
        }
        self.drop_lent(vec![*part]);
    }

    pub(super) fn finish(&mut self) {
        self.regions.finish();
    }

    /// A region is filtered, and that is durable.
    pub(super) fn filtered(&mut self, region: u32, last: bool) {
        let window = self.regions.window(region);
        if last {
            self.regions.done(region);
            for extent in self.drop_cores(&window) {
                self.file.release(&extent);
            }
        } else {
            self.regions.filtered(region);
        }
        let lent = self.lent.meeting(&window).into_iter().map(|(part, _)| part).collect();
        self.drop_lent(lent);
    }

    /// Drops the samples of cores around here that no region needs; says where they are.
    fn drop_cores(&mut self, window: &Rect) -> Vec<Extent> {
        let near = self.cores.meeting(window).into_iter();
        let near: Vec<Rect> = near.filter(|(_, kept)| !kept.dropped).map(|(core, _)| core).collect();
        let mut dropped = Vec::new();
        for core in near.into_iter().filter(|core| !self.regions.need(core)) {
            if let Some(kept) = self.cores.get_mut(&core) {
                kept.dropped = true;
                self.room.taken = self.room.taken.saturating_sub(kept.extent.room());
                dropped.push(kept.extent);
            }
        }
        dropped
    }

    /// Drops those of these lent pixels that no region needs: all cores have come, or all regions around are done.
    fn drop_lent(&mut self, parts: Vec<Rect>) {
        for part in parts {
            let wanted = |kept: &Lent| {
                let covered = self.cores.missing_but(&part, |core| core.counted).is_empty();
                let needed = |index| match self.regions.state(index) {
                    RegionState::Done => false,
                    // It may be reading them.
                    RegionState::Running => true,
                    _ => !covered,
                };
                !kept.counted || self.regions.near(&part).any(needed)
            };
            if self.lent.get(&part).is_none_or(wanted) {
                continue;
            }
            if let Some(extent) = self.lent.remove(&part).and_then(|kept| kept.extent) {
                self.room.taken = self.room.taken.saturating_sub(extent.room());
                self.file.release(&extent);
                self.forgotten.push(part);
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

    /// Chooses what to keep of a tile's halo: what is not there, and finds room. Until it is [returned](Self::return_lent)
    /// or has an extent, nobody else keeps these pixels.
    fn lend(&mut self, geometry: &TileGeometry) -> Vec<Rect> {
        let mut parts = Vec::new();
        let (core, window) = (geometry.core(), geometry.window());
        for gap in window.without(&core).flat_map(|part| self.cores.missing(&part)) {
            for part in self.lent.missing(&gap) {
                if self.lent.len() + self.forgotten.len() < self.room.cores as usize
                    && self.room.lend(&part, self.cores.len(), self.pixels)
                    && self.lent.insert(part, Lent { extent: None, counted: false }).is_ok()
                {
                    parts.push(part);
                }
            }
        }
        parts
    }

    /// Does not keep what was chosen of a halo.
    fn return_lent(&mut self, parts: &[Rect]) {
        for part in parts {
            self.lent.remove(part);
            self.room.settle(part, None);
        }
    }

    /// Keeps a core, and what was chosen of its halo.
    fn insert(&mut self, core: Rect, record: &CoreRecord, lent: &[(Rect, Extent)]) {
        let CoreRecord { digest, extent, replaced } = *record;
        let _ = self.cores.insert(core, Core { digest, extent, counted: false, dropped: false });
        self.pixels += core.area();
        self.room.taken += extent.room();
        sum(&mut self.replaced, &replaced);
        for (part, extent) in lent {
            if let Some(kept) = self.lent.get_mut(part) {
                kept.extent = Some(*extent);
                self.room.settle(part, Some(extent));
            }
        }
    }
}

fn sum(all: &mut Replaced, more: &Replaced) {
    all.color += more.color;
    all.feature += more.feature;
    all.random += more.random;
    all.film += more.film;
}

impl Image {
    /// Keeps the samples of a core, and of its halo what is not there.
    pub(super) fn keep(&self, tile: &SampleTile, digest: Digest) -> Result<Outcome, ImageError> {
        let (core, Some(announced)) = (tile.geometry().core(), &self.description.neighbors) else {
            return Ok(Outcome::Repeated);
        };
        small(&core, &tile.geometry().image())?;
        if tile.max_per_pixel() > announced.samples || tile.varying() && !announced.varying {
            return Err(announced.mismatch(core, tile.max_per_pixel().to_string()));
        }
        let known = |neighbors: &Neighbors, finished: bool| match neighbors.known(&core, digest)? {
            true => Ok(true),
            false if finished => Err(ImageError::Finished),
            false if neighbors.cores.len() >= MAX_TILES => Err(ImageError::TooManyTiles),
            false => Ok(false),
        };
        let _writer = self.writer()?;
        let (file, lent) = {
            let inner = &mut *self.write();
            let Some(neighbors) = &mut inner.neighbors else { return Ok(Outcome::Repeated) };
            if known(neighbors, inner.finished)? {
                return Ok(Outcome::Repeated);
            }
            (neighbors.file(), neighbors.lend(tile.geometry()))
        };
        let mut extents = Vec::with_capacity(1 + lent.len());
        let mut append = |part: &Rect| file.append(tile, part).map(|extent| extents.push(extent));
        let appended = append(&core).and_then(|()| lent.iter().try_for_each(append));
        let inner = &mut *self.write();
        let Some(neighbors) = &mut inner.neighbors else { return Ok(Outcome::Repeated) };
        // Another one may have brought it meanwhile.
        match appended.map_err(ImageError::from).and_then(|()| known(neighbors, inner.finished)) {
            Ok(false) => {}
            other => {
                extents.iter().for_each(|extent| file.release(extent));
                neighbors.return_lent(&lent);
                return other.map(|_| Outcome::Repeated);
            }
        }
        let record = CoreRecord { digest, extent: extents[0], replaced: tile.replaced() };
        let lent: Vec<(Rect, Extent)> = lent.into_iter().zip(extents.drain(1..)).collect();
        neighbors.insert(core, &record, &lent);
        let changes = lent.iter().map(|(part, extent)| Change::Put(Records::Lent, *part, extent_to_bytes(extent)));
        let changes = changes.chain([Change::Put(Records::Samples, core, record.encode())]);
        let after = lent.iter().map(|(part, _)| After::Lent(*part)).chain([After::Arrived(core)]);
        inner.queue(changes, after);
        Ok(Outcome::Stored)
    }
}
