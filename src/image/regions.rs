//! Which parts of an image can be filtered, as cores arrive whose neighbours lend them their halos.
//!
//! The image is cut into *regions* on a grid. A region can be filtered as soon as all pixels within the method's reach of
//! it have arrived; the samples of a core are needed as long as it has pixels within reach of a region that is not done.

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
    /// It is filtered.
    Done,
}

/// The regions of an image.
#[derive(Debug)]
pub struct Regions {
    image: Rect,
    size: u32,
    reach: u32,
    columns: u32,
    /// Of each region, pixels in its window that have not arrived, and its state.
    all: Vec<(u64, RegionState)>,
    ready: BTreeSet<u32>,
    open: usize,
}

impl Regions {
    /// Regions of `size` x `size` pixels, filtered by a method with this reach; nothing has arrived.
    pub fn new([width, height]: [u32; 2], size: u32, reach: u32) -> Self {
        let (image, columns) = (Rect::new(0, 0, width, height), width.div_ceil(size));
        let count = (columns * height.div_ceil(size)) as usize;
        let mut regions =
            Self { image, size, reach, columns, all: Vec::with_capacity(count), ready: BTreeSet::new(), open: count };
        for index in 0..count as u32 {
            regions.all.push((regions.window(index).area(), RegionState::Waiting));
        }
        regions
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

    /// Counts the pixels of a core as arrived, each once.
    pub fn arrived(&mut self, core: &Rect) {
        for index in self.near(core) {
            let here = self.window(index).intersection(core).map_or(0, |part| part.area());
            let (missing, state) = &mut self.all[index as usize];
            *missing = missing.saturating_sub(here);
            if *missing == 0 && *state == RegionState::Waiting {
                *state = RegionState::Ready;
                self.ready.insert(index);
            }
        }
    }

    /// Nothing more will arrive: what waits is ready.
    pub fn finish(&mut self) {
        for (index, (_, state)) in self.all.iter_mut().enumerate() {
            if *state == RegionState::Waiting {
                *state = RegionState::Ready;
                self.ready.insert(index as u32);
            }
        }
    }

    /// The first region, by rows, that is ready; it is running from now on.
    pub fn start_next(&mut self) -> Option<u32> {
        let index = self.ready.pop_first()?;
        self.all[index as usize].1 = RegionState::Running;
        Some(index)
    }

    /// A region that was running is not, and can be filtered again.
    pub fn give_back(&mut self, index: u32) {
        if self.all[index as usize].1 == RegionState::Running {
            self.all[index as usize].1 = RegionState::Ready;
            self.ready.insert(index);
        }
    }

    /// A region is filtered.
    pub fn done(&mut self, index: u32) {
        let state = &mut self.all[index as usize].1;
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
        self.all[index as usize].1
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
                regions.arrived(core);
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

    #[test]
    fn finishing_makes_what_waits_ready_once() {
        let mut regions = Regions::new([32, 16], 16, 4);
        regions.arrived(&Rect::new(0, 0, 16, 16));
        assert_eq!(regions.start_next(), None);
        regions.finish();
        assert_eq!((regions.start_next(), regions.start_next(), regions.start_next()), (Some(0), Some(1), None));
        regions.give_back(0);
        regions.done(1);
        regions.give_back(1);
        assert_eq!((regions.start_next(), regions.start_next(), regions.open()), (Some(0), None, 1));
    }
}
