//! Step 1: the neighbourhood of a pixel (report, section 2.1; thesis paper, "Preprocessing the samples").
//!
//! N starts with the pixel's own samples. Then candidates are drawn: a pixel offset from a Gaussian with a standard
//! deviation of a quarter of the box, rounded to the nearest pixel, inside the box, not the pixel itself, inside the
//! *image*; and a uniformly random sample of that pixel. A candidate that differs too much from the pixel's own samples
//! in any feature is rejected.

use super::random;
use super::relevance::Relevant;
use crate::filter::geometry::Rect;
use crate::filter::{Plane, SampleTile};

/// Tries within one draw before it is dropped.
const TRIES: u64 = 8;
/// Slots of the alias table: a power of two above the widest box.
const SLOTS: usize = 256;

/// Offsets along one axis: a Gaussian with sigma = box / 4, rounded to whole pixels and held inside the box, as a table
/// for Walker's alias method in Vose's form (1991). The two axes are independent, so one table serves both.
#[derive(Clone, Debug)]
pub struct Offsets {
    /// Of each slot: the share (of 65536) in which it stands for `own`, else for `other`.
    slots: Vec<Slot>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Slot {
    share: u32,
    own: i16,
    other: i16,
}

impl Offsets {
    /// The table for one box width.
    pub fn new(width: u32) -> Self {
        let radius = (width / 2) as i16;
        let probabilities: Vec<f64> = offset_probabilities(width);
        // Vose: slots that hold too little are topped up from one that holds too much.
        let mut left: Vec<f64> = (0..SLOTS).map(|i| probabilities.get(i).map_or(0.0, |p| p * SLOTS as f64)).collect();
        let offset = |slot: usize| slot as i16 - radius;
        let mut slots = vec![Slot::default(); SLOTS];
        let (mut small, mut large): (Vec<usize>, Vec<usize>) = (0..SLOTS).partition(|&i| left[i] < 1.0);
        while let Some(&high) = large.last() {
            let Some(low) = small.pop() else { break };
            let share = libm::round(left[low] * 65536.0) as u32;
            slots[low] = Slot { share, own: offset(low), other: offset(high) };
            left[high] -= 1.0 - f64::from(share) / 65536.0;
            if left[high] < 1.0 {
                large.pop();
                small.push(high);
            }
        }
        // What remains holds 1, but for rounding.
        for full in small.into_iter().chain(large) {
            slots[full] = Slot { share: 65536, own: offset(full), other: offset(full) };
        }
        Self { slots }
    }

    /// The offset for 24 random bits.
    #[inline(always)]
    fn pick(&self, bits: u64) -> i32 {
        let slot = self.slots[bits as usize % SLOTS];
        let fraction = (bits >> 8) as u32 & 0xFFFF;
        i32::from(if fraction < slot.share { slot.own } else { slot.other })
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

/// The rows of a neighbourhood: own samples first, then what was drawn and accepted.
#[derive(Debug)]
pub(crate) struct Rows {
    /// Position of each row's sample in the planes.
    pub(crate) samples: Vec<u32>,
    /// The pixel of each row, by its index in the data window.
    pub(crate) pixels: Vec<u32>,
}

impl Rows {
    /// Room for so many rows.
    pub(crate) fn with_capacity(rows: usize) -> Self {
        Self { samples: Vec::with_capacity(rows), pixels: Vec::with_capacity(rows) }
    }
}

/// What a candidate is tested against, for one feature: the pixel's own samples. In f64: far from the origin the mean
/// of f32 values lies between two of them, and rounding it would move the cluster by half a step.
#[derive(Clone, Copy, Debug)]
struct Cluster {
    mean: f64,
    threshold: f64,
    /// Whether any own sample lacks the feature: then candidates may lack it too.
    missing: bool,
}

/// How wide a cluster may be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clustering {
    /// Standard deviations for world positions.
    pub(crate) position: f64,
    /// Standard deviations for other features.
    pub(crate) feature: f64,
    /// Never tighter than this, in the feature's unit.
    pub(crate) floor: f64,
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

/// Fills `rows` with the neighbourhood of a pixel that has samples.
pub(crate) fn gather_rows(
    rows: &mut Rows,
    tile: &SampleTile,
    relevant: &Relevant,
    offsets: &Offsets,
    clustering: &Clustering,
    center: &Center,
) {
    let window = tile.geometry().window();
    rows.samples.clear();
    rows.pixels.clear();
    let pixel = window.index(center.x, center.y);
    let own = tile.samples_of(pixel);
    let own_count = own.len();
    for sample in own.clone() {
        rows.samples.push(sample as u32);
        rows.pixels.push(pixel as u32);
    }
    let image = tile.geometry().image();
    for draw in 0..center.wanted.saturating_sub(own_count) as u64 {
        let Some((pixel, bits)) = candidate(&image, &window, offsets, center, draw) else { continue };
        let samples = tile.samples_of(pixel);
        if !samples.is_empty() {
            rows.samples.push(pick_sample(bits, &samples));
            rows.pixels.push(pixel as u32);
        }
    }
    // One feature at a time, so that each pass reads one plane and the survivors shrink.
    for feature in relevant.features() {
        let deviations = if feature.position { clustering.position } else { clustering.feature };
        match tile.plane(feature.plane) {
            Plane::Values(values) => {
                let cluster = cluster(&values[own.clone()], deviations, clustering.floor);
                keep_cluster(rows, own_count, |sample| values[sample as usize], &cluster);
            }
            // Here only if nothing is to be left out: this rejects no row.
            Plane::Constant(value) => {
                let cluster = cluster(&[*value], deviations, clustering.floor);
                keep_cluster(rows, own_count, |_| *value, &cluster);
            }
        }
    }
}

/// A uniformly random one of a pixel's samples, for the bits that chose the pixel.
#[inline(always)]
pub(super) fn pick_sample(bits: u64, samples: &std::ops::Range<usize>) -> u32 {
    let chosen = ((random::mix(bits) >> 32) * samples.len() as u64) >> 32;
    (samples.start as u64 + chosen) as u32
}

/// The pixel (index in the data window) that a draw ends at, and its bits; none if all tries fail, or if it ends where
/// the data window, for want of halo, has no samples.
#[inline(always)]
pub(super) fn candidate(
    image: &Rect,
    window: &Rect,
    offsets: &Offsets,
    center: &Center,
    draw: u64,
) -> Option<(usize, u64)> {
    for attempt in 0..TRIES {
        let bits = random::bits(center.key, draw * TRIES + attempt);
        let (dx, dy) = (offsets.pick(bits), offsets.pick(bits >> 24));
        let (Some(x), Some(y)) = (center.x.checked_add_signed(dx), center.y.checked_add_signed(dy)) else { continue };
        if (dx, dy) != (0, 0) && image.contains(x, y) {
            return window.contains(x, y).then(|| (window.index(x, y), bits));
        }
    }
    None
}

/// Mean and spread of the pixel's own values, two-pass in f64: exact for equal values however far from 0.
fn cluster(own: &[f32], deviations: f64, floor: f64) -> Cluster {
    let present = own.iter().filter(|v| !v.is_nan()).map(|&v| f64::from(v));
    let count = present.clone().count() as f64;
    let mean = present.clone().sum::<f64>() / count;
    let variance = present.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
    let threshold = (deviations * variance.sqrt()).max(floor);
    // Without any, the mean is NaN, and no candidate that has the feature passes.
    Cluster { mean, threshold, missing: own.iter().any(|v| v.is_nan()) }
}

/// Keeps the own rows, and of the others those inside the cluster.
fn keep_cluster(rows: &mut Rows, own: usize, value: impl Fn(u32) -> f32, cluster: &Cluster) {
    let Rows { samples, pixels } = rows;
    let mut kept = own;
    for row in own..samples.len() {
        let value = value(samples[row]);
        let inside =
            (f64::from(value) - cluster.mean).abs() <= cluster.threshold || (cluster.missing && value.is_nan());
        samples[kept] = samples[row];
        pixels[kept] = pixels[row];
        kept += usize::from(inside);
    }
    samples.truncate(kept);
    pixels.truncate(kept);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Far from the origin the mean of a pixel's own values lies between two f32: candidates are compared with the mean
    /// itself, not with the f32 next to it.
    #[test]
    fn clusters_far_from_the_origin_are_not_shifted() {
        let step = 0.007_812_5;
        let values: Vec<f32> = [0.0, 1.0, 1.0, 1.0, 14.0, -13.0, -12.0, 13.0].map(|i| 1e5 + i * step).to_vec();
        let mut rows = Rows { samples: (0..8).collect(), pixels: vec![0; 8] };
        // The mean is 0.75 steps above 1e5, and 0.1 is 12.8 steps.
        keep_cluster(&mut rows, 4, |sample| values[sample as usize], &cluster(&values[..4], 3.0, 0.1));
        assert_eq!(rows.samples, [0, 1, 2, 3, 6, 7]);
    }
}
