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
use crate::filter::lanes::{Integers, LANES, Simd, prelude::*};
use crate::filter::samples::SampleLayout;
use std::ops::Range;

/// Tries within one draw before it is dropped.
const TRIES: u64 = 8;
/// Draws whose bits are made at once.
const DRAWS: usize = 32;
/// Slots of the alias table: a power of two above the widest box.
const SLOTS: usize = 256;
/// Parts of a slot that have an offset each, unless the two that the slot stands for meet there.
const PARTS: usize = 16;

/// Offsets along one axis: a Gaussian with sigma = box / 4, rounded to whole pixels and held inside the box, as a table
/// for Walker's alias method in Vose's form (1991). The two axes are independent, so one table serves both.
#[derive(Clone, Debug)]
pub struct Offsets {
    /// Of each slot: the share (of 65536) in which it stands for `own`, else for `other`.
    slots: Box<[Slot; SLOTS]>,
    /// The offset of each part of each slot, `[part][slot]`, where it is one: nearly everywhere.
    parts: Box<[i8; PARTS * SLOTS]>,
}

/// In place of the offset of a part that has two.
const EITHER: i8 = i8::MIN;

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
        let mut parts = Box::new([EITHER; PARTS * SLOTS]);
        for (index, place) in parts.iter_mut().enumerate() {
            let (slot, start) = (slots[index % SLOTS], (index / SLOTS * 65536 / PARTS) as u32);
            let [other, own] = slot.offsets;
            let end = start + (65536 / PARTS) as u32;
            *place = if slot.share <= start {
                other as i8
            } else if slot.share >= end {
                own as i8
            } else {
                *place
            };
        }
        Self { slots, parts }
    }

    /// Where [`Offsets::parts`] has the offset for 24 random bits: their slot, and the first bits of their fraction.
    #[inline(always)]
    const fn part(bits: u64) -> u16 {
        (bits & 0xFF | bits >> 12 & 0xF00) as u16
    }

    /// The offset that a part has, or [`EITHER`].
    #[inline(always)]
    fn of_part(&self, part: u16) -> u32 {
        i32::from(self.parts[usize::from(part) % (PARTS * SLOTS)]) as u32
    }

    /// The offsets in x and y for 48 random bits.
    fn both(&self, bits: u64) -> (i32, i32) {
        (self.pick(bits), self.pick(bits >> 24))
    }

    /// The offset for 24 random bits.
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
        let count = draw(simd, image, block, offsets, center, first..last, &mut drawn);
        kept = cluster.keep(simd, block, &drawn[..count], rows, kept);
    }
    kept
}

/// Makes some of a pixel's draws, [`DRAWS`] at most; `drawn` then starts with the records they end at, and they are so
/// many.
#[inline(always)]
fn draw<S: Simd>(
    simd: S,
    image: &Rect,
    block: &Block,
    offsets: &Offsets,
    center: &Center,
    draws: Range<u64>,
    drawn: &mut [u32; DRAWS],
) -> usize {
    let Pixels { pixels, picks, mut missed } = draw_pixels(simd, image, block.window(), offsets, center, draws.clone());
    let count = (draws.end - draws.start) as usize;
    let places = drawn.iter_mut().zip(pixels.iter().zip(&picks));
    match block.layout() {
        SampleLayout::Uniform { per_pixel, .. } => {
            for (place, (&pixel, &pick)) in places {
                *place = pixel * per_pixel + pick_of(pick, *per_pixel);
            }
        }
        SampleLayout::Varying { starts } => {
            for (draw, (place, (&pixel, &pick))) in places.enumerate().take(count) {
                let (start, end) = (starts[pixel as usize], starts[pixel as usize + 1]);
                *place = start + pick_of(pick, end - start);
                missed |= u64::from(start == end) << draw;
            }
        }
    }
    if missed == 0 {
        return count;
    }
    let mut kept = 0;
    for draw in (0..count).filter(|draw| missed >> draw & 1 == 0) {
        drawn[kept] = drawn[draw];
        kept += 1;
    }
    kept
}

/// What some draws end at.
struct Pixels {
    /// Pixels (indices in the data window).
    pixels: [u32; DRAWS],
    /// Random bits to pick one of their samples by.
    picks: [u32; DRAWS],
    /// A bit for each draw that ends nowhere.
    missed: u64,
}

/// The pixels that some draws end at.
#[inline(always)]
fn draw_pixels<S: Simd>(
    simd: S,
    image: &Rect,
    window: &Rect,
    offsets: &Offsets,
    center: &Center,
    draws: Range<u64>,
) -> Pixels {
    let (mut pixels, mut picks) = ([0; DRAWS], [0; DRAWS]);
    let count = (draws.end - draws.start) as usize;
    let (mut bits, mut parts) = ([0; DRAWS], [[0; DRAWS]; 2]);
    let (mut dx, mut dy) = ([0; DRAWS], [0; DRAWS]);
    // All of them, wanted or not: a fixed number of them the compiler puts into lanes.
    for index in 0..DRAWS {
        bits[index] = random::bits(center.key, (draws.start + index as u64) * TRIES);
        picks[index] = (random::mix(bits[index]) >> 32) as u32;
        (parts[0][index], parts[1][index]) = (Offsets::part(bits[index]), Offsets::part(bits[index] >> 24));
    }
    for index in 0..DRAWS {
        (dx[index], dy[index]) = (offsets.of_part(parts[0][index]), offsets.of_part(parts[1][index]));
    }
    // The first try, which mostly is the last, in lanes.
    let (x, y) = (lanes(simd, center.x - window.x), lanes(simd, center.y - window.y));
    let (width, height) = (lanes(simd, window.width), lanes(simd, window.height));
    let (none, either) = (lanes(simd, 0), lanes(simd, i32::from(EITHER) as u32));
    let mut done = 0;
    for start in (0..DRAWS).step_by(LANES) {
        let dx = Integers::from_slice(simd, &dx[start..start + LANES]);
        let dy = Integers::from_slice(simd, &dy[start..start + LANES]);
        let (x, y) = (x + dx, y + dy);
        let undone = dx.simd_eq(either) | dy.simd_eq(either) | (dx | dy).simd_eq(none);
        let here = x.simd_lt(width) & y.simd_lt(height) & !undone;
        here.select(y * width + x, none).store_slice(&mut pixels[start..start + LANES]);
        done |= here.to_bitmask() << start;
    }
    let (mut undone, mut missed) = (!done & u64::MAX >> (u64::BITS as usize - count), 0);
    while undone != 0 {
        let draw = undone.trailing_zeros() as usize;
        undone &= undone - 1;
        match candidate(image, window, offsets, center, draws.start + draw as u64) {
            Some((pixel, bits)) => (pixels[draw], picks[draw]) = (pixel as u32, (random::mix(bits) >> 32) as u32),
            None => missed |= 1 << draw,
        }
    }
    Pixels { pixels, picks, missed }
}

#[inline(always)]
fn lanes<S: Simd>(simd: S, value: u32) -> Integers<S> {
    Integers::splat(simd, value)
}

/// One of so many, for 32 random bits.
#[inline(always)]
const fn pick_of(bits: u32, number: u32) -> u32 {
    ((bits as u64 * number as u64) >> 32) as u32
}

/// A uniformly random one of a pixel's samples, for the bits that chose the pixel.
pub(super) fn pick_sample(bits: u64, samples: &Range<usize>) -> u32 {
    samples.start as u32 + pick_of((random::mix(bits) >> 32) as u32, samples.len() as u32)
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
