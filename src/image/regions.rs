//! Which parts of an image can be filtered, as cores arrive whose neighbours lend them their halos.
//!
//! The image is cut into *regions* on a grid. A region can be filtered as soon as its own pixels have arrived in cores,
//! and those within the method's reach of it in cores or lent by halos. Of a pixel its core has the last word: a region that
//! was filtered with lent ones is looked at again when the cores have come. The samples of a core are needed as long as
//! it has pixels within reach of a region that is not done.

use std::collections::BTreeSet;

use crate::filter::Rect;

/// How far a region is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RegionState {
    /// It waits for cores.
    Waiting,
    /// It can be filtered.
    Ready,
    /// It is being filtered.
    Running,
    /// It can be filtered, but not within the memory that there is.
    TooLarge,
    /// It is filtered with lent pixels, and waits for their cores.
    Filtered,
    /// It is filtered for good.
    Done,
}

/// The regions of an image.
#[derive(Debug)]
pub struct Regions {
    image: Rect,
    size: u32,
    reach: u32,
    columns: u32,
    all: Vec<Region>,
    ready: BTreeSet<u32>,
    aside: Vec<u32>,
    open: usize,
    /// Nothing more will arrive.
    finished: bool,
}

#[derive(Debug)]
struct Region {
    /// Pixels in its window that have not arrived in cores.
    coreless: u64,
    /// Those that it waits for: not those around it that are lent.
    lacking: u64,
    state: RegionState,
}

impl Regions {
    /// Regions of `size` x `size` pixels, filtered by a method with this reach; nothing has arrived.
    pub fn new([width, height]: [u32; 2], size: u32, reach: u32) -> Self {
        let (image, columns) = (Rect::new(0, 0, width, height), width.div_ceil(size));
        let count = (columns * height.div_ceil(size)) as usize;
        let (all, ready, aside) = (Vec::with_capacity(count), BTreeSet::new(), Vec::new());
        let mut regions = Self { image, size, reach, columns, all, ready, aside, open: count, finished: false };
        for index in 0..count as u32 {
            let pixels = regions.window(index).area();
            regions.all.push(Region { coreless: pixels, lacking: pixels, state: RegionState::Waiting });
        }
        regions
    }

    /// The region of a pixel.
    pub const fn at(&self, x: u32, y: u32) -> u32 {
        y / self.size * self.columns + x / self.size
    }

    /// The pixels of a region.
    pub fn core(&self, index: u32) -> Rect {
        let (x, y) = (index % self.columns * self.size, index / self.columns * self.size);
        Rect::new(x, y, self.size.min(self.image.width - x), self.size.min(self.image.height - y))
    }

    /// The pixels that filtering a region reads.
    pub fn window(&self, index: u32) -> Rect {
        self.core(index).grown(self.reach, &self.image)
    }

    /// The regions whose windows have pixels of this rectangle.
    pub fn near(&self, rect: &Rect) -> impl Iterator<Item = u32> + use<> {
        let (near, size, columns) = (rect.grown(self.reach, &self.image), self.size, self.columns);
        let rows = near.y / size..=(near.bottom() - 1) / size;
        rows.flat_map(move |row| (near.x / size..=(near.right() - 1) / size).map(move |column| row * columns + column))
    }

    /// Counts the pixels of a core as arrived, each once; `lent` are those that were lent before.
    pub fn arrived(&mut self, core: &Rect, lent: &[Rect]) {
        for index in self.near(core) {
            let here = common(&self.window(index), core);
            let known: u64 = lent.iter().map(|part| self.around(index, part)).sum();
            let region = &mut self.all[index as usize];
            region.coreless = region.coreless.saturating_sub(here);
            region.lacking = region.lacking.saturating_sub(here - known);
            self.look(index);
        }
    }

    /// Counts pixels as lent by a halo, that are there in no other way.
    pub fn lent(&mut self, part: &Rect) {
        for index in self.near(part) {
            let here = self.around(index, part);
            let region = &mut self.all[index as usize];
            region.lacking = region.lacking.saturating_sub(here);
            self.look(index);
        }
    }

    /// Pixels of a part of the image that a region reads and that are not its own.
    fn around(&self, index: u32, part: &Rect) -> u64 {
        common(&self.window(index), part) - common(&self.core(index), part)
    }

    /// Nothing more will arrive: what waits is ready.
    pub fn finish(&mut self) {
        self.finished = true;
        (0..self.count()).for_each(|index| self.look(index));
    }

    /// Whether what a region reads does not change any more.
    pub fn last(&self, index: u32) -> bool {
        self.finished || self.all[index as usize].coreless == 0
    }

    /// Makes a region ready if it is.
    fn look(&mut self, index: u32) {
        let (last, region) = (self.last(index), &mut self.all[index as usize]);
        let ready = match region.state {
            RegionState::Waiting => last || region.lacking == 0,
            RegionState::Filtered => last,
            _ => false,
        };
        if ready {
            region.state = RegionState::Ready;
            self.ready.insert(index);
        }
    }

    /// The first region, by rows, that is ready; it is running from now on.
    pub fn start_next(&mut self) -> Option<u32> {
        let index = self.ready.pop_first()?;
        self.all[index as usize].state = RegionState::Running;
        Some(index)
    }

    /// A region that was running is not, and can be filtered again.
    pub fn give_back(&mut self, index: u32) {
        if self.state(index) == RegionState::Running {
            self.all[index as usize].state = RegionState::Ready;
            self.ready.insert(index);
        }
    }

    /// A region that was running cannot be filtered for now, and keeps no others waiting.
    pub fn set_aside(&mut self, index: u32) {
        self.all[index as usize].state = RegionState::TooLarge;
        self.aside.push(index);
    }

    /// Those that were set aside can be filtered again.
    pub fn retry(&mut self) {
        for index in std::mem::take(&mut self.aside) {
            self.all[index as usize].state = RegionState::Ready;
            self.ready.insert(index);
        }
    }

    /// A region that was running is filtered, but not from what it [reads last](Self::last).
    pub fn filtered(&mut self, index: u32) {
        self.all[index as usize].state = RegionState::Filtered;
        self.look(index);
    }

    /// A region is filtered for good.
    pub fn done(&mut self, index: u32) {
        let state = &mut self.all[index as usize].state;
        if *state != RegionState::Done {
            *state = RegionState::Done;
            self.ready.remove(&index);
            self.open -= 1;
        }
    }

    /// Whether some region still needs this core's samples.
    pub fn need(&self, core: &Rect) -> bool {
        self.near(core).any(|index| self.state(index) != RegionState::Done)
    }

    /// How far a region is.
    pub fn state(&self, index: u32) -> RegionState {
        self.all[index as usize].state
    }

    /// Number of regions.
    pub fn count(&self) -> u32 {
        self.all.len() as u32
    }

    /// Regions that can be filtered.
    pub fn ready(&self) -> usize {
        self.ready.len()
    }

    /// Regions that are not done.
    pub const fn open(&self) -> usize {
        self.open
    }
}

/// Pixels that two rectangles have in common.
fn common(one: &Rect, other: &Rect) -> u64 {
    one.intersection(other).map_or(0, |part| part.area())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Coverage, geometry::tiling};

    /// Against the definition: all pixels of the window are there.
    #[test]
    fn a_region_is_ready_when_its_window_is_there() {
        for (image, size, reach, tile) in
            [([50, 40], 16, 5, 7), ([50, 40], 20, 17, 16), ([33, 5], 16, 0, 16), ([9, 60], 64, 3, 8)]
        {
            let mut regions = Regions::new(image, size, reach);
            let mut there = Coverage::default();
            let mut cores: Vec<Rect> = tiling(image, tile).collect();
            let mut state = 11u64;
            for i in (1..cores.len()).rev() {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                cores.swap(i, (state >> 33) as usize % (i + 1));
            }
            for core in &cores {
                there.insert(*core, ()).unwrap();
                regions.arrived(core, &[]);
                for index in 0..regions.count() {
                    let ready = there.missing(&regions.window(index)).is_empty();
                    assert_eq!(regions.state(index) == RegionState::Ready, ready);
                }
            }
            // Samples are needed until the last region around them is done.
            while let Some(index) = regions.start_next() {
                regions.done(index);
                for core in &cores {
                    let near = (0..regions.count()).filter(|&i| regions.window(i).intersection(core).is_some());
                    let needed = near.clone().any(|i| regions.state(i) != RegionState::Done);
                    assert_eq!(near.collect::<Vec<_>>(), regions.near(core).collect::<Vec<_>>());
                    assert_eq!(regions.need(core), needed);
                }
            }
            assert_eq!(regions.open(), 0);
        }
    }

    /// Against the definition, with halos that lend some of the pixels before their cores come.
    #[test]
    fn lent_pixels_count_around_a_region() {
        let image = Rect::new(0, 0, 50, 40);
        let mut regions = Regions::new([50, 40], 16, 5);
        let (mut there, mut lent) = (Coverage::default(), Coverage::default());
        let mut filtered = 0;
        // Rows from below, so that halos lend much.
        let cores: Vec<Rect> = tiling([50, 40], 12).collect();
        for core in cores.iter().rev() {
            let before: Vec<Rect> = lent.meeting(core).iter().filter_map(|(part, _)| part.intersection(core)).collect();
            there.insert(*core, ()).unwrap();
            regions.arrived(core, &before);
            for part in core.grown(7, &image).without(core).flat_map(|part| there.missing(&part)) {
                for part in lent.missing(&part) {
                    lent.insert(part, ()).unwrap();
                    regions.lent(&part);
                }
            }
            for index in 0..regions.count() {
                let (own, window) = (regions.core(index), regions.window(index));
                let absent = there.missing(&window);
                let around = absent.iter().flat_map(|part| part.without(&own));
                let lacking = around.flat_map(|part| lent.missing(&part)).count() + there.missing(&own).len();
                assert_eq!(regions.last(index), absent.is_empty());
                match regions.state(index) {
                    RegionState::Waiting => assert!(lacking > 0),
                    RegionState::Ready => assert!(lacking == 0),
                    RegionState::Filtered => assert!(!absent.is_empty()),
                    state => panic!("{state:?}"),
                }
            }
            // Some are filtered at once, and once more when all cores are there.
            while let Some(index) = regions.start_next() {
                if regions.last(index) {
                    regions.give_back(index);
                    break;
                }
                regions.filtered(index);
                filtered += 1;
            }
        }
        assert!(filtered > 3, "{filtered}");
        while let Some(index) = regions.start_next() {
            assert!(regions.last(index));
            regions.done(index);
        }
        assert_eq!(regions.open(), 0);
    }

    #[test]
    fn finishing_makes_what_waits_ready_once() {
        let mut regions = Regions::new([32, 16], 16, 4);
        regions.arrived(&Rect::new(0, 0, 16, 16), &[]);
        assert_eq!(regions.start_next(), None);
        regions.finish();
        assert_eq!((regions.start_next(), regions.start_next(), regions.start_next()), (Some(0), Some(1), None));
        regions.give_back(0);
        regions.done(1);
        regions.give_back(1);
        assert_eq!((regions.start_next(), regions.start_next(), regions.open()), (Some(0), None, 1));
        // What is set aside is not ready until it is tried again, and open all the while.
        regions.set_aside(0);
        regions.finish();
        assert_eq!((regions.start_next(), regions.ready(), regions.open()), (None, 0, 1));
        regions.retry();
        regions.retry();
        assert_eq!((regions.start_next(), regions.start_next(), regions.open()), (Some(0), None, 1));
    }
}
