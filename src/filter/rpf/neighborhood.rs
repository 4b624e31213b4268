//! Step 1: the neighbourhood of a pixel (report, section 2.1; thesis paper, "Preprocessing the samples").
//!
//! N starts with the pixel's own samples. Then candidates are drawn: a pixel offset from a Gaussian with a standard
//! deviation of a quarter of the box, rounded to the nearest pixel, inside the box, not the pixel itself, inside the
//! *image*; and a uniformly random sample of that pixel. A candidate that differs too much from the pixel's own samples
//! in any feature is rejected.

use super::block::Block;
use super::cluster::Cluster;
use super::random;
use crate::filter::geometry::Rect;
use crate::filter::lanes::Simd;
use crate::filter::samples::SampleLayout;
use std::ops::Range;

/// Tries within one draw before it is dropped.
const TRIES: u64 = 8;
/// Draws whose bits are made at once.
const DRAWS: usize = 64;
/// Slots of the alias table: a power of two above the widest box.
const SLOTS: usize = 256;

/// Offsets along one axis: a Gaussian with sigma = box / 4, rounded to whole pixels and held inside the box, as a table
/// for Walker's alias method in Vose's form (1991). The two axes are independent, so one table serves both.
#[derive(Clone, Debug)]
pub struct Offsets {
    /// Of each slot: the share (of 65536) in which it stands for `own`, else for `other`.
    slots: Box<[Slot; SLOTS]>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Slot {
    share: u32,
    /// `other`, then `own`.
    offsets: [i16; 2],
}

impl Offsets {
    /// The table for one box width.
    pub fn new(width: u32) -> Self {
        let radius = (width / 2) as i16;
        let probabilities: Vec<f64> = offset_probabilities(width);
        // Vose: slots that hold too little are topped up from one that holds too much.
        let mut left: Vec<f64> = (0..SLOTS).map(|i| probabilities.get(i).map_or(0.0, |p| p * SLOTS as f64)).collect();
        let offset = |slot: usize| slot as i16 - radius;
        let mut slots = Box::new([Slot::default(); SLOTS]);
        let (mut small, mut large): (Vec<usize>, Vec<usize>) = (0..SLOTS).partition(|&i| left[i] < 1.0);
        while let Some(&high) = large.last() {
            let Some(low) = small.pop() else { break };
            let share = libm::round(left[low] * 65536.0) as u32;
            slots[low] = Slot { share, offsets: [offset(high), offset(low)] };
            left[high] -= 1.0 - f64::from(share) / 65536.0;
            if left[high] < 1.0 {
                large.pop();
                small.push(high);
            }
        }
        // What remains holds 1, but for rounding.
        for full in small.into_iter().chain(large) {
            slots[full] = Slot { share: 65536, offsets: [offset(full); 2] };
        }
        Self { slots }
    }

    /// The offsets in x and y for 48 random bits.
    #[inline(always)]
    fn both(&self, bits: u64) -> (i32, i32) {
        (self.pick(bits), self.pick(bits >> 24))
    }

    /// The offset for 24 random bits.
    #[inline(always)]
    fn pick(&self, bits: u64) -> i32 {
        let slot = &self.slots[bits as usize % SLOTS];
        let fraction = (bits >> 8) as u32 & 0xFFFF;
        // A lookup rather than a branch, which could not be foretold.
        i32::from(slot.offsets[usize::from(fraction < slot.share)])
    }
}

/// Probability of each offset of an axis, from -width/2 to width/2.
pub(crate) fn offset_probabilities(width: u32) -> Vec<f64> {
    let radius = (width / 2) as i32;
    let sigma = f64::from(width) / 4.0;
    let below = |x: f64| 0.5 * libm::erfc(-x / (sigma * std::f64::consts::SQRT_2));
    let mass = |offset: i32| below(f64::from(offset) + 0.5) - below(f64::from(offset) - 0.5);
    let all: f64 = (-radius..=radius).map(mass).sum();
    (-radius..=radius).map(|offset| mass(offset) / all).collect()
}

/// The pixel whose neighbourhood is drawn.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Center {
    /// Image coordinates.
    pub(crate) x: u32,
    /// Image coordinates.
    pub(crate) y: u32,
    /// Key of its draws, from [`random::pixel_key`].
    pub(crate) key: u64,
    /// Wanted rows, its own samples included.
    pub(crate) wanted: usize,
}

/// Fills `rows` with the records of a neighbourhood, those of the pixel's own samples first, and says how many they
/// are. `rows` has room for the wanted number; the pixel has samples.
#[inline(always)]
pub(crate) fn gather_rows<S: Simd>(
    simd: S,
    rows: &mut [u32],
    image: &Rect,
    block: &Block,
    offsets: &Offsets,
    cluster: &Cluster,
    center: &Center,
) -> usize {
    let own = block.samples_of(center.x, center.y);
    let mut kept = own.len();
    for (row, sample) in rows.iter_mut().zip(own) {
        *row = sample as u32;
    }
    let mut drawn = [0; DRAWS];
    let draws = center.wanted.saturating_sub(kept) as u64;
    for first in (0..draws).step_by(DRAWS) {
        let last = draws.min(first + DRAWS as u64);
        let drawn = match block.layout() {
            SampleLayout::Uniform { per_pixel, .. } => draw(
                image,
                block.window(),
                offsets,
                center,
                first..last,
                #[inline(always)]
                |pixel| (pixel as u32 * per_pixel, *per_pixel),
                &mut drawn,
            ),
            SampleLayout::Varying { starts } => draw(
                image,
                block.window(),
                offsets,
                center,
                first..last,
                #[inline(always)]
                |pixel| (starts[pixel], starts[pixel + 1] - starts[pixel]),
                &mut drawn,
            ),
        };
        kept = cluster.keep(simd, block, drawn, rows, kept);
    }
    kept
}

/// Makes some of a pixel's draws; says which records they end at. `samples` has the first record, and the number of
/// records, of a pixel.
#[inline(always)]
fn draw<'a>(
    image: &Rect,
    window: &Rect,
    offsets: &Offsets,
    center: &Center,
    draws: Range<u64>,
    samples: impl Fn(usize) -> (u32, u32),
    drawn: &'a mut [u32; DRAWS],
) -> &'a [u32] {
    let (mut bits, mut picks) = ([0; DRAWS], [0; DRAWS]);
    for (index, (bits, pick)) in bits.iter_mut().zip(&mut picks).enumerate() {
        *bits = random::bits(center.key, (draws.start + index as u64) * TRIES);
        *pick = random::mix(*bits) >> 32;
    }
    let (x, y) = (center.x - window.x, center.y - window.y);
    let mut count = 0;
    for (draw, (&bits, &pick)) in draws.zip(bits.iter().zip(&picks)) {
        let (dx, dy) = offsets.both(bits);
        let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
        let (pixel, pick) = if (x < window.width) & (y < window.height) & (dx | dy != 0) {
            (y as usize * window.width as usize + x as usize, pick)
        } else if let Some((pixel, bits)) = candidate(image, window, offsets, center, draw) {
            (pixel, random::mix(bits) >> 32)
        } else {
            continue;
        };
        let (start, number) = samples(pixel);
        drawn[count % DRAWS] = start + ((pick * u64::from(number)) >> 32) as u32;
        count += usize::from(number > 0);
    }
    &drawn[..count]
}

/// A uniformly random one of a pixel's samples, for the bits that chose the pixel.
#[inline(always)]
pub(super) fn pick_sample(bits: u64, samples: &Range<usize>) -> u32 {
    let chosen = ((random::mix(bits) >> 32) * samples.len() as u64) >> 32;
    (samples.start as u64 + chosen) as u32
}

/// The pixel (index in the data window) that a draw ends at, and its bits; none if all tries fail, or if it ends where
/// the data window, for want of halo, has no samples.
pub(super) fn candidate(
    image: &Rect,
    window: &Rect,
    offsets: &Offsets,
    center: &Center,
    draw: u64,
) -> Option<(usize, u64)> {
    for attempt in 0..TRIES {
        let bits = random::bits(center.key, draw * TRIES + attempt);
        let (dx, dy) = offsets.both(bits);
        let (Some(x), Some(y)) = (center.x.checked_add_signed(dx), center.y.checked_add_signed(dy)) else { continue };
        if (dx, dy) != (0, 0) && image.contains(x, y) {
            return window.contains(x, y).then(|| (window.index(x, y), bits));
        }
    }
    None
}
