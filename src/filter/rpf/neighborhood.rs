//! Step 1: the neighbourhood of a pixel (report, section 2.1; thesis paper, "Preprocessing the samples").
//!
//! N starts with the pixel's own samples. Then candidates are drawn: a pixel offset from a Gaussian with a standard
//! deviation of a quarter of the box, rounded to the nearest pixel, inside the box, not the pixel itself, inside the
//! *image*; and a uniformly random sample of that pixel. A candidate that differs too much from the pixel's own samples
//! in any feature is rejected.

use super::block::Block;
use super::random;
use crate::filter::geometry::Rect;
use crate::filter::lanes::{Integers, LANES, Signed, Simd, prelude::*};
use crate::filter::samples::SampleLayout;
use std::ops::Range;

/// Tries within one draw before it is dropped.
const TRIES: u64 = 8;
/// Draws whose first tries are made at once.
const FIRST: usize = 32;
/// Draws that are tried again at once: few fail.
const AGAIN: usize = LANES;
/// Slots of the alias table: a power of two above the widest box.
const SLOTS: usize = 256;

/// Offsets along one axis: a Gaussian with sigma = box / 4, rounded to whole pixels and held inside the box, as a table
/// for Walker's alias method in Vose's form (1991). The two axes are independent, so one table serves both.
#[derive(Clone, Debug)]
pub struct Offsets {
    /// Of each slot, from the high bits down: the share (of 65536) in which it stands for one offset, in 16 bits; that
    /// offset, and the other one, in 8 bits each.
    slots: Box<[u32; SLOTS]>,
}

impl Offsets {
    /// The table for one box width.
    pub fn new(width: u32) -> Self {
        let radius = (width / 2) as i32;
        let probabilities: Vec<f64> = offset_probabilities(width);
        // Vose: slots that hold too little are topped up from one that holds too much.
        let mut left: Vec<f64> = (0..SLOTS).map(|i| probabilities.get(i).map_or(0.0, |p| p * SLOTS as f64)).collect();
        let offset = |slot: usize| slot as i32 - radius;
        let mut slots = Box::new([0; SLOTS]);
        let (mut small, mut large): (Vec<usize>, Vec<usize>) = (0..SLOTS).partition(|&i| left[i] < 1.0);
        while let Some(&high) = large.last() {
            let Some(low) = small.pop() else { break };
            let share = libm::round(left[low] * 65536.0) as u32;
            slots[low] = slot(share, offset(low), offset(high));
            left[high] -= 1.0 - f64::from(share) / 65536.0;
            if left[high] < 1.0 {
                large.pop();
                small.push(high);
            }
        }
        // What remains holds 1, but for rounding.
        for full in small.into_iter().chain(large) {
            slots[full] = slot(65536, offset(full), offset(full));
        }
        Self { slots }
    }

    /// The slot for 24 random bits.
    #[inline(always)]
    const fn slot(&self, bits: u32) -> u32 {
        self.slots[bits as usize % SLOTS]
    }

    /// The offsets for 24 random bits each, with their [slots](Offsets::slot).
    #[inline(always)]
    fn pick<S: Simd>(slots: Integers<S>, bits: Integers<S>) -> Integers<S> {
        let own = ((bits >> 8) & 0xFFFF).simd_lt(slots >> 16);
        let offsets = own.select(slots >> 8, slots) << 24;
        (offsets.bitcast::<Signed<S>>() >> 24).bitcast()
    }

    /// The same for one, without lanes.
    const fn pick_one(&self, bits: u32) -> i32 {
        let slot = self.slot(bits);
        let offset = if bits >> 8 & 0xFFFF < slot >> 16 { slot >> 8 } else { slot };
        offset as i8 as i32
    }
}

/// A slot of [`Offsets`] that stands for the offset `own` in its share, else for `other`.
const fn slot(share: u32, own: i32, other: i32) -> u32 {
    // All of it would be one too many for 16 bits.
    let other = if share >> 16 == 0 { other } else { own };
    share << 16 | (own as u32 & 0xFF) << 8 | other as u32 & 0xFF
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

/// In place of the record of a draw that is dropped.
const NOWHERE: u32 = u32::MAX;

/// Rows that a buffer for so many must have: a multiple of draws is made at once.
pub(crate) const fn room_for(rows: usize) -> usize {
    rows + FIRST - 1
}

/// Makes the draws around a pixel that are wanted beside its own samples; `rows` then begins with the records that they
/// end at, in order, and they are so many. It has [room](room_for) for them; the draws that take more than one try are
/// kept in `unfinished` meanwhile.
#[inline(always)]
pub(crate) fn draw<S: Simd>(
    simd: S,
    around: &Around,
    count: usize,
    rows: &mut [u32],
    unfinished: &mut Vec<u32>,
) -> usize {
    unfinished.clear();
    let mut dropped = false;
    for (first, batch) in (0..count).step_by(FIRST).zip(rows.as_chunks_mut::<FIRST>().0) {
        // All of them, wanted or not: a fixed number of them the compiler puts into lanes.
        let tries = around.attempt::<S, FIRST>(simd, |index| (first + index) as u64 * TRIES);
        *batch = tries.records;
        let wanted = u64::MAX >> (u64::BITS as usize - FIRST.min(count - first));
        dropped |= tries.dropped & wanted != 0;
        let mut failed = tries.failed & wanted;
        while failed != 0 {
            unfinished.push(first as u32 + failed.trailing_zeros());
            failed &= failed - 1;
        }
    }
    for attempt in 1..TRIES {
        let mut left = 0;
        for start in (0..unfinished.len()).step_by(AGAIN) {
            let mut batch = [0; AGAIN];
            let number = AGAIN.min(unfinished.len() - start);
            batch[..number].copy_from_slice(&unfinished[start..start + number]);
            let tries = around.attempt::<S, AGAIN>(simd, |index| u64::from(batch[index]) * TRIES + attempt);
            dropped |= tries.dropped != 0;
            for (index, &draw) in batch[..number].iter().enumerate() {
                rows[draw as usize] = tries.records[index];
                unfinished[left] = draw;
                left += usize::from(tries.failed >> index & 1 != 0);
            }
        }
        unfinished.truncate(left);
    }
    if !dropped && unfinished.is_empty() {
        return count;
    }
    for &draw in &*unfinished {
        rows[draw as usize] = NOWHERE;
    }
    let mut kept = 0;
    for draw in 0..count {
        rows[kept] = rows[draw];
        kept += usize::from(rows[draw] != NOWHERE);
    }
    kept
}

/// What some tries end at.
struct Tries<const N: usize> {
    /// Of each the record, or [`NOWHERE`].
    records: [u32; N],
    /// A bit for each that has to be made again.
    failed: u64,
    /// A bit for each whose draw is dropped: it ends where there are no samples.
    dropped: u64,
}

/// What draws are made around.
pub(crate) struct Around<'a> {
    pub(crate) image: &'a Rect,
    pub(crate) block: &'a Block,
    pub(crate) offsets: &'a Offsets,
    pub(crate) center: &'a Center,
}

impl Around<'_> {
    /// Makes some tries, in lanes.
    #[inline(always)]
    fn attempt<S: Simd, const N: usize>(&self, simd: S, counter: impl Fn(usize) -> u64) -> Tries<N> {
        let Self { image, block, offsets, center } = *self;
        let (window, layout) = (block.window(), block.layout());
        let per_pixel = if let SampleLayout::Uniform { per_pixel, .. } = layout { *per_pixel } else { 0 };
        let (mut bits, mut picks, mut slots) = ([[0; N]; 2], [0; N], [[0; N]; 2]);
        for index in 0..N {
            let random = random::bits(center.key, counter(index));
            (bits[0][index], bits[1][index]) = (random as u32, (random >> 24) as u32);
            let pick = (random::mix(random) >> 32) as u32;
            picks[index] = if per_pixel > 0 { pick_of(pick, per_pixel) } else { pick };
        }
        for axis in 0..2 {
            for index in 0..N {
                slots[axis][index] = offsets.slot(bits[axis][index]);
            }
        }
        let lanes = |value: u32| Integers::splat(simd, value);
        let mut tries = Tries { records: [0; N], failed: 0, dropped: 0 };
        for start in (0..N).step_by(LANES) {
            let at = |values: &[u32; N]| Integers::from_slice(simd, &values[start..start + LANES]);
            let dx = Offsets::pick(at(&slots[0]), at(&bits[0]));
            let dy = Offsets::pick(at(&slots[1]), at(&bits[1]));
            // What would be below 0 is a great number.
            let (x, y) = (lanes(center.x) + dx, lanes(center.y) + dy);
            let inside = x.simd_lt(lanes(image.width)) & y.simd_lt(lanes(image.height));
            let (x, y) = (x - lanes(window.x), y - lanes(window.y));
            let here = x.simd_lt(lanes(window.width)) & y.simd_lt(lanes(window.height));
            let pixel = y * lanes(window.width) + x;
            let record = if per_pixel > 0 { pixel * lanes(per_pixel) + at(&picks) } else { pixel };
            here.select(record, lanes(NOWHERE)).store_slice(&mut tries.records[start..start + LANES]);
            let failed = (!inside | (dx | dy).simd_eq(lanes(0))).to_bitmask();
            tries.failed |= failed << start;
            tries.dropped |= (!here).to_bitmask() << start;
        }
        if let SampleLayout::Varying { starts } = layout {
            for (index, (record, &pick)) in tries.records.iter_mut().zip(&picks).enumerate() {
                if *record != NOWHERE {
                    let (start, end) = (starts[*record as usize], starts[*record as usize + 1]);
                    *record = if start < end { start + pick_of(pick, end - start) } else { NOWHERE };
                    tries.dropped |= u64::from(start == end) << index;
                }
            }
        }
        tries.dropped &= !tries.failed;
        tries
    }
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
        let (dx, dy) = (offsets.pick_one(bits as u32), offsets.pick_one((bits >> 24) as u32));
        let (Some(x), Some(y)) = (center.x.checked_add_signed(dx), center.y.checked_add_signed(dy)) else { continue };
        if (dx, dy) != (0, 0) && image.contains(x, y) {
            return window.contains(x, y).then(|| (window.index(x, y), bits));
        }
    }
    None
}
