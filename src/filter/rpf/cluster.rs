//! Which candidates belong to a pixel's neighbourhood, by their features (report, section 2.1).
//!
//! A candidate is rejected if for any feature |f - mean| > max(k deviation, floor), mean and deviation being those of
//! the pixel's own samples, in f64: far from the origin the mean of f32 values lies between two of them, and rounding it
//! would move the cluster by half a step. For f32 candidates that rule is an interval with f32 ends, which are found
//! once per pixel, exactly; then sixteen features are tested by two comparisons.

use super::block::{Block, Line};
use super::params::Params;
use super::relevance::Feature;
use crate::filter::lanes::{Integers, LANES, Lanes, Mask, Simd, Wide, prelude::*, select_lanes};

/// The features that a neighbourhood's candidates may have: for each line of a record, the ends of 16 intervals.
#[derive(Debug)]
pub(crate) struct Cluster {
    lines: Vec<Interval>,
    /// Deviations allowed to each feature.
    deviations: Vec<[f64; LANES]>,
    floor: f64,
    /// Of each line a bit for each feature that any sample lacks.
    lacked: Vec<u64>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Interval {
    low: Line,
    high: Line,
    /// A bit for each feature that some own sample lacks: then candidates may lack it too.
    missing: u64,
}

impl Cluster {
    /// Room for the intervals of these features.
    pub(crate) fn new(features: &[Feature], params: &Params) -> Self {
        let lines = features.len().div_ceil(LANES);
        let mut deviations = vec![[1.0; LANES]; lines];
        for (place, feature) in deviations.as_flattened_mut().iter_mut().zip(features) {
            *place = if feature.position { params.position_threshold } else { params.feature_threshold };
        }
        let mut lacked = vec![0; lines];
        for (index, _) in features.iter().enumerate().filter(|(_, feature)| feature.may_miss) {
            lacked[index / LANES] |= 1 << (index % LANES);
        }
        Self { lines: vec![Interval::default(); lines], deviations, floor: params.threshold_floor, lacked }
    }

    /// Bytes that [`Cluster::new`] allocates.
    pub(crate) const fn bytes(features: usize) -> u64 {
        (features.div_ceil(LANES) * (size_of::<Interval>() + size_of::<[f64; LANES]>() + size_of::<u64>())) as u64
    }

    /// Sets the intervals from a pixel's own samples.
    #[inline(always)]
    pub(crate) fn set<S: Simd>(&mut self, simd: S, block: &Block, own: std::ops::Range<usize>) {
        let per_sample = block.feature_lines();
        let own = &block.features()[own.start * per_sample..own.end * per_sample];
        for (line, (interval, deviations)) in self.lines.iter_mut().zip(&self.deviations).enumerate() {
            *interval = Interval::around(simd, own[line..].iter().step_by(per_sample), deviations, self.floor);
        }
    }

    /// Moves those of some records forward, in order, whose features are all inside; says how many they are.
    #[inline(always)]
    pub(crate) fn keep<S: Simd>(&self, simd: S, block: &Block, records: &mut [u32]) -> usize {
        let mut kept = records.len();
        for (line, (interval, lacked)) in self.lines.iter().zip(&self.lacked).enumerate() {
            let (bounds, records) = (Bounds::of(simd, interval), &mut records[..kept]);
            let missing = match (interval.missing, lacked & !interval.missing) {
                (0, _) => Missing::Nowhere,
                (_, 0) => Missing::Anywhere,
                _ => Missing::Somewhere,
            };
            kept = match (block.feature_lines(), missing) {
                // Most scenes have one line.
                (1, Missing::Nowhere) => bounds.keep::<1>(simd, block, line, records, Missing::Nowhere),
                (1, Missing::Anywhere) => bounds.keep::<1>(simd, block, line, records, Missing::Anywhere),
                (_, Missing::Nowhere) => bounds.keep::<0>(simd, block, line, records, Missing::Nowhere),
                (_, Missing::Anywhere) => bounds.keep::<0>(simd, block, line, records, Missing::Anywhere),
                (_, Missing::Somewhere) => bounds.keep::<0>(simd, block, line, records, Missing::Somewhere),
            };
        }
        kept
    }

    /// Whether any of the pixel's own samples, and so any row, may lack a feature.
    pub(crate) fn missing(&self, feature: usize) -> bool {
        self.lines[feature / LANES].missing >> (feature % LANES) & 1 != 0
    }
}

impl Interval {
    /// The interval around the values of the own samples.
    #[inline(always)]
    fn around<'a, S: Simd>(
        simd: S,
        samples: impl Iterator<Item = &'a Line> + Clone,
        deviations: &[f64; LANES],
        floor: f64,
    ) -> Self {
        let (zero, one) = (Wide::splat(simd, 0.0), Wide::splat(simd, 1.0));
        // Two passes in f64, in the order of the samples: exact for equal values however far from 0.
        let (mut count, mut sum, mut missing) = ([zero; 2], [zero; 2], 0);
        for line in samples.clone() {
            let values = Lanes::from_slice(simd, &line.0);
            missing |= (!values.simd_eq(values)).to_bitmask();
            let values = wide(values);
            for half in 0..2 {
                let present = values[half].simd_eq(values[half]);
                count[half] += present.select(one, zero);
                sum[half] += present.select(values[half], zero);
            }
        }
        let mean = [sum[0] / count[0], sum[1] / count[1]];
        let mut squares = [zero; 2];
        for line in samples {
            let values = wide(Lanes::from_slice(simd, &line.0));
            for half in 0..2 {
                let deviation = values[half] - mean[half];
                squares[half] += values[half].simd_eq(values[half]).select(deviation * deviation, zero);
            }
        }
        let deviations = [Wide::from_slice(simd, &deviations[..8]), Wide::from_slice(simd, &deviations[8..])];
        let mut threshold = [Wide::splat(simd, floor); 2];
        for half in 0..2 {
            threshold[half] = (deviations[half] * (squares[half] / count[half]).sqrt()).max(threshold[half]);
        }
        let (low, high) = ends(simd, mean, threshold);
        Self { low: Line(low), high: Line(high), missing }
    }
}

/// An [`Interval`] in lanes.
struct Bounds<S: Simd> {
    low: Lanes<S>,
    high: Lanes<S>,
    missing: Mask<S>,
}

impl<S: Simd> Bounds<S> {
    #[inline(always)]
    fn of(simd: S, interval: &Interval) -> Self {
        let Interval { low, high, missing } = interval;
        let (low, high) = (Lanes::from_slice(simd, &low.0), Lanes::from_slice(simd, &high.0));
        Self { low, high, missing: Mask::from_bitmask(simd, *missing) }
    }

    /// Moves those of some records forward, in order, of which a line of features is inside; says how many they are.
    /// `LINES` are those of a record, or 0 if only the block knows.
    #[inline(always)]
    fn keep<const LINES: usize>(
        &self,
        simd: S,
        block: &Block,
        line: usize,
        records: &mut [u32],
        missing: Missing,
    ) -> usize {
        let (features, lines) = (block.features(), if LINES > 0 { LINES } else { block.feature_lines() });
        let mut kept = 0;
        // No branch on what is inside: it could not be foretold.
        for index in 0..records.len() {
            let record = records[index];
            records[kept] = record;
            let values = Lanes::from_slice(simd, &features[record as usize * lines + line].0);
            kept += usize::from(self.hold(values, missing));
        }
        kept
    }

    /// Whether 16 features are inside, or missing where they may be.
    #[inline(always)]
    fn hold(&self, values: Lanes<S>, missing: Missing) -> bool {
        // A missing value is neither inside nor outside.
        let outside = values.simd_lt(self.low) | values.simd_gt(self.high);
        match missing {
            Missing::Nowhere => (values.simd_ge(self.low) & values.simd_le(self.high)).all_true(),
            Missing::Anywhere => !outside.any_true(),
            Missing::Somewhere => !(outside | !values.simd_eq(values) & !self.missing).any_true(),
        }
    }
}

/// Which features of a candidate may be missing.
#[derive(Clone, Copy, Debug)]
enum Missing {
    Nowhere,
    /// Those that the interval says.
    Somewhere,
    /// All that are missing in any record.
    Anywhere,
}

/// A bit for each lane.
const ALL: u64 = (1 << LANES) - 1;

#[inline(always)]
fn wide<S: Simd>(values: Lanes<S>) -> [Wide<S>; 2] {
    let (low, high) = values.widen();
    [low, high]
}

/// The least and the greatest f32 that are no further from the mean than the threshold, distances being rounded to f64.
/// Where the mean is NaN (no own sample has the feature) nothing is inside.
#[inline(always)]
fn ends<S: Simd>(simd: S, mean: [Wide<S>; 2], threshold: [Wide<S>; 2]) -> ([f32; LANES], [f32; LANES]) {
    let opposite = [-mean[0], -mean[1]];
    let (mut high, high_found) = upper_ends(simd, mean, threshold);
    let (mut low, low_found) = upper_ends(simd, opposite, threshold);
    if high_found & low_found != ALL {
        let (mean, opposite) = (lanes_of(mean), lanes_of(opposite));
        let threshold = lanes_of(threshold);
        for lane in 0..LANES {
            if (high_found & low_found) >> lane & 1 == 0 {
                high[lane] = upper_end(mean[lane], threshold[lane]);
                low[lane] = upper_end(opposite[lane], threshold[lane]);
            }
        }
    }
    (low.map(|end| -end), high)
}

/// The greatest f32 that are no more than the threshold above the mean, and a bit for each that was found.
#[inline(always)]
fn upper_ends<S: Simd>(simd: S, mean: [Wide<S>; 2], threshold: [Wide<S>; 2]) -> ([f32; LANES], u64) {
    let greatest = Lanes::splat(simd, f32::MAX);
    let sum = (mean[0] + threshold[0]).narrow(mean[1] + threshold[1]).min(greatest).max(-greatest);
    let end = select_lanes(simd, below(sum, mean, threshold), sum, -next_above(simd, -sum));
    // Not so where the mean is so much greater than the end that the distance is rounded by more than the end is.
    (end.to_array(), below(end, mean, threshold) & !below(next_above(simd, end), mean, threshold))
}

/// A bit for each value that is no more than the threshold above the mean.
#[inline(always)]
fn below<S: Simd>(values: Lanes<S>, mean: [Wide<S>; 2], threshold: [Wide<S>; 2]) -> u64 {
    let values = wide(values);
    let low = (values[0] - mean[0]).simd_le(threshold[0]).to_bitmask();
    low | (values[1] - mean[1]).simd_le(threshold[1]).to_bitmask() << (LANES / 2)
}

/// The next greater f32 of each.
#[inline(always)]
fn next_above<S: Simd>(simd: S, values: Lanes<S>) -> Lanes<S> {
    let zero = Lanes::splat(simd, 0.0);
    // Adding 0 makes -0 a 0.
    let bits = (values + zero).bitcast::<Integers<S>>();
    values.simd_lt(zero).select((bits - 1).bitcast(), (bits + 1).bitcast::<Lanes<S>>())
}

/// One of [`upper_ends`], by bisection; negative infinity if there is none.
#[cold]
fn upper_end(mean: f64, threshold: f64) -> f32 {
    // The finite f32 in order, as integers.
    let value = |key: i64| if key < 0 { -f32::from_bits(-key as u32) } else { f32::from_bits(key as u32) };
    let inside = |key: i64| f64::from(value(key)) - mean <= threshold;
    let last = i64::from(f32::MAX.to_bits());
    let (mut low, mut high) = (-last, last + 1);
    if !inside(low) {
        return f32::NEG_INFINITY;
    }
    while high - low > 1 {
        let middle = (low + high) / 2;
        if inside(middle) { low = middle } else { high = middle }
    }
    value(low)
}

fn lanes_of<S: Simd>(halves: [Wide<S>; 2]) -> [f64; LANES] {
    let mut lanes = [0.0; LANES];
    halves.iter().zip(lanes.chunks_exact_mut(LANES / 2)).for_each(|(half, place)| half.store_slice(place));
    lanes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::lanes::{SimdLevel, dispatch};

    /// The ends that a pixel's own values lead to.
    fn interval(own: &[f32], deviations: f64, floor: f64) -> Vec<(f32, f32)> {
        let lines: Vec<Line> = own.iter().map(|&v| Line([v; LANES])).collect();
        let ends = SimdLevel::available().into_iter().map(|(_, level)| {
            dispatch!(level.level(), simd => {
                let interval = Interval::around(simd, lines.iter(), &[deviations; LANES], floor);
                (interval.low.0[3], interval.high.0[11])
            })
        });
        ends.collect()
    }

    /// Far from the origin the mean of a pixel's own values lies between two f32: candidates are compared with the mean
    /// itself, not with the f32 next to it.
    #[test]
    fn clusters_far_from_the_origin_are_not_shifted() {
        let step = 0.007_812_5;
        let own = [0.0, 1.0, 1.0, 1.0].map(|i| 1e5 + i * step);
        // The mean is 0.75 steps above 1e5, and 0.1 is 12.8 steps.
        for ends in interval(&own, 3.0, 0.1) {
            assert_eq!(ends, (1e5 - 12.0 * step, 1e5 + 13.0 * step));
        }
    }

    /// The ends are the last f32 that the rule in f64 accepts, whatever the sizes of mean, deviation and floor.
    #[test]
    fn ends_are_exact() {
        let mut bits = 1u64;
        let mut value = || {
            bits = crate::filter::rpf::random::mix(bits.wrapping_add(0x9E37_79B9));
            let value = f32::from_bits((bits >> 32) as u32);
            if value.is_finite() { value + 0.0 } else { 0.5 }
        };
        for case in 0..20_000 {
            let base = value();
            let own: Vec<f32> = match case % 4 {
                0 => (0..5).map(|_| value()).collect(),
                1 => vec![base; 3],
                2 => (0..8).map(|i| base * (1.0 + i as f32 * 1e-6)).filter(|v| v.is_finite()).collect(),
                _ => (0..4).map(|i| f32::from_bits(value().to_bits() % (1 << 23)) * i as f32).collect(),
            };
            let (deviations, floor) = ([1.0, 3.0, 30.0][case % 3], [0.0, 0.1, 1e30, 1e-40][case % 4]);
            let present = own.iter().map(|&v| f64::from(v));
            let mean = present.clone().fold(0.0, |a, b| a + b) / own.len() as f64;
            let squares = present.map(|v| (v - mean) * (v - mean)).fold(0.0, |a, b| a + b);
            let threshold = (deviations * (squares / own.len() as f64).sqrt()).max(floor);
            let inside = |v: f32| v.is_finite() && (f64::from(v) - mean).abs() <= threshold;
            for (low, high) in interval(&own, deviations, floor) {
                assert!(inside(low) && inside(high), "{own:?}: {low:e}..{high:e}");
                assert!(!inside(low.next_down()) && !inside(high.next_up()), "{own:?}: {low:e}..{high:e}");
            }
        }
    }

    #[test]
    fn without_own_values_only_the_missing_are_inside() {
        for (low, high) in interval(&[f32::NAN; 3], 3.0, 0.1) {
            assert_eq!((low, high), (f32::INFINITY, f32::NEG_INFINITY));
        }
    }
}
