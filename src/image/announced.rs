//! What follows from what is announced of an image's tiles: how large its regions are, and which tiles it takes.

use super::{Announced, ImageError, MAX_TILES, MIN_CORE};
use crate::{
    filter::{
        Method, Rect, TileGeometry,
        plan::{Plan, Shape, plan},
    },
    store::samples::{BUFFERS, worst_case},
    wire::{Header, SampleCounts},
};

/// Sides of regions, in pixels. Larger ones have less halo to compute twice.
const SIDES: [u32; 10] = [512, 384, 320, 256, 192, 128, 96, 64, 32, 16];
/// Of an image this many regions, at least, make it come out in parts while it comes in.
const PARTS: u64 = 16;
/// No region is smaller for that, nor so that several fit into the memory at once: their halos would take most of the time.
const LEAST: u32 = 64;

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
        let parts = |side: &u32| *side == LEAST || *side > LEAST && pixels / area(*side) >= PARTS;
        let found = sides().filter(parts).find(|&side| cost(side) <= bytes);
        match found.or_else(|| sides().find(|&side| cost(side) <= most)) {
            Some(side) => {
                self.region = side;
                Ok(())
            }
            None => Err(sides().map(cost).min().unwrap_or(u64::MAX)),
        }
    }

    /// Bytes of disk that the samples of so many pixels take at most, brought by so many cores.
    pub(super) fn room(&self, cores: u64, pixels: u64) -> u64 {
        worst_case(cores, pixels, pixels * u64::from(self.samples), self.channels.planes(), self.varying)
    }

    /// Bytes of memory that filtering such a tile takes at most, but for finding its samples.
    pub(super) fn cost(&self, geometry: &TileGeometry, method: &Method, threads: usize, varying: bool) -> u64 {
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

    pub(super) fn mismatch(&self, core: Rect, got: String) -> ImageError {
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
pub(super) fn small(core: &Rect, image: &Rect) -> Result<(), ImageError> {
    let wide = core.width >= MIN_CORE || core.x == 0 || core.right() == image.width;
    let high = core.height >= MIN_CORE || core.y == 0 || core.bottom() == image.height;
    if wide && high { Ok(()) } else { Err(ImageError::TooSmall(*core)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, ChannelSet, Role};

    #[test]
    fn regions_are_small_only_where_no_larger_one_fits() {
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let mut announced = Announced { channels, samples: 4, varying: false, region: 0 };
        let method = Method::preset("lean").unwrap();
        let mut choose = |bytes, most| {
            let chosen = announced.choose_region([1024, 1024], &method, 1, bytes, most);
            chosen.map(|()| announced.region)
        };
        let least = choose(0, 0).unwrap_err();
        assert_eq!(choose(least, least), Ok(16));
        // Several small ones would fit at once: one large one is better.
        let side = choose(least, 8 * least).unwrap();
        assert!(side >= LEAST, "{side}");
        assert_eq!(choose(u64::MAX, u64::MAX), Ok(256));
    }
}
