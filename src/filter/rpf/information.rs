//! Step 3: mutual information between normalised columns (report, section 3.1).
//!
//! I(X, Y) = sum p(x,y) ln( p(x,y) / (p(x) p(y)) ) in nats, over histograms of B bins (odd): a value's bin is the value
//! rounded to the nearest integer, half to even, held within +-(B-1)/2.
//!
//! Each column keeps one bit mask over the rows per bin, so that a joint count is the number of bits in x AND y; with
//! T\[n\] = n ln n, I = (sum T\[n_xy\] - sum T\[n_x\] - sum T\[n_y\] + T\[n\]) / n. Counts are integers and the sum has one fixed
//! order, so the result has the same bits everywhere.
//!
//! Empty bins are passed over, and the counts of each column's last bin follow from the marginals. The masks of all
//! other bins of all columns lie side by side, word by word, each in its slot, so that one column's bin is counted against
//! those of many others at once: a lane for each.

use super::params::MAX_BINS;
use super::statistics::Scale;
use crate::filter::lanes::{LANES, Lanes, Octets, Signed, Simd, Words, prelude::*};
use std::ops::Range;

/// T\[n\] = n ln n for n = 0 to `most`, with 0 ln 0 = 0.
pub(crate) fn entropy_terms(most: usize) -> Vec<f64> {
    let mut terms = Vec::with_capacity(most + 1);
    terms.extend((0..=most).map(|n| if n == 0 { 0.0 } else { n as f64 * libm::log(n as f64) }));
    terms
}

/// Words of a bit mask over so many rows.
const fn mask_words(rows: usize) -> usize {
    rows.div_ceil(64)
}

/// Rows of whole words of a bit mask.
pub(crate) const fn whole_words(rows: usize) -> usize {
    64 * mask_words(rows)
}

/// Slots that are counted at once, at most.
const SLOTS: usize = 8;
/// Bins of a column that are dealt with at once: those of the presets, but the last.
const BINS: usize = 6;

/// The histogram of one column, of its bins that are not empty.
#[derive(Clone, Copy, Debug)]
struct Histogram {
    /// Where the bit masks of its bins but the last, and their counts, lie: [`Histograms::slots`].
    first: usize,
    end: usize,
    /// Rows in its last bin.
    last: u64,
    /// Sum of T over the counts.
    terms: f64,
    /// The column is constant: no information with anything.
    constant: bool,
}

impl Histogram {
    const EMPTY: Self = Self { first: 0, end: 0, last: 0, terms: 0.0, constant: true };

    const fn slots(&self) -> usize {
        self.end - self.first
    }

    /// Whether it was not set: a constant column has slots where none is left out.
    const fn left_out(&self) -> bool {
        self.constant && self.slots() == 0
    }
}

/// The histograms of all columns of a neighbourhood.
#[derive(Debug)]
pub(crate) struct Histograms {
    bins: usize,
    rows: usize,
    words: usize,
    /// Whether constant columns and empty bins are passed over.
    leave_out: bool,
    columns: Vec<Histogram>,
    /// Bit masks of the bins of all columns but the last of each, `[word][slot]`, with `most_slots` slots each.
    slots: Vec<u64>,
    most_slots: usize,
    /// The first slot that no column has taken.
    next_slot: usize,
    /// Rows in the bin of each slot.
    counts: Vec<u64>,
    /// Rows in the bin of each slot and in each bin of x, `[bin of x][slot]`.
    joint: Vec<u64>,
    /// Columns that others are measured against, those with equally many slots together.
    order: Vec<usize>,
    /// Information of each pair of columns.
    information: Vec<f64>,
}

impl Histograms {
    /// Room for so many columns and rows.
    pub(crate) fn with_capacity(columns: usize, rows: usize, bins: u32, leave_out: bool) -> Self {
        let (bins, words) = (bins as usize, mask_words(rows));
        let most_slots = Self::most_slots(columns, bins);
        Self {
            bins,
            rows: 0,
            words: 0,
            leave_out,
            columns: vec![Histogram::EMPTY; columns],
            slots: vec![0; most_slots * words],
            most_slots,
            next_slot: 0,
            counts: vec![0; most_slots],
            joint: vec![0; bins * most_slots],
            order: Vec::with_capacity(columns),
            information: vec![0.0; columns * columns],
        }
    }

    /// Bytes that [`Histograms::with_capacity`] allocates.
    pub(crate) const fn bytes(columns: usize, rows: usize, bins: u32) -> u64 {
        let (words, most_slots) = (mask_words(rows), Self::most_slots(columns, bins as usize));
        let masks = most_slots * (words + 1 + bins as usize) * size_of::<u64>();
        let column = size_of::<Histogram>() + size_of::<usize>() + columns * size_of::<f64>();
        (masks + columns * column) as u64
    }

    /// Slots of so many columns, and as many again as may be counted without being needed.
    const fn most_slots(columns: usize, bins: usize) -> usize {
        columns * (bins - 1) + SLOTS
    }

    /// Starts a neighbourhood of so many rows.
    pub(crate) fn start(&mut self, rows: usize) {
        self.rows = rows;
        self.words = mask_words(rows);
        self.next_slot = 0;
        self.columns.fill(Histogram::EMPTY);
    }

    /// Takes a column of zero mean, filled up to [whole words](whole_words) with any values, which `scale` brings to unit
    /// deviation. When all are set, [`Histograms::finish`] counts.
    #[inline(always)]
    pub(crate) fn set<S: Simd>(&mut self, simd: S, column: usize, values: &[f32], scale: &Scale) {
        let (first, constant, half) = (self.next_slot, scale.constant(), (self.bins / 2) as i8);
        if constant && self.leave_out {
            return;
        }
        let [low, high] = match self.leave_out {
            true => scale.ends.map(|end| (end.round_ties_even() as i8).clamp(-half, half)),
            false => [-half, half],
        };
        self.next_slot = first + (high - low) as usize;
        self.columns[column] = Histogram { first, end: self.next_slot, constant, ..Histogram::EMPTY };
        for slot in (first..self.next_slot).step_by(BINS) {
            let low = low + (slot - first) as i8;
            match self.next_slot - slot {
                1 => self.set_masks::<S, 1>(simd, values, scale.inverse, slot, low),
                2 => self.set_masks::<S, 2>(simd, values, scale.inverse, slot, low),
                3 => self.set_masks::<S, 3>(simd, values, scale.inverse, slot, low),
                4 => self.set_masks::<S, 4>(simd, values, scale.inverse, slot, low),
                5 => self.set_masks::<S, 5>(simd, values, scale.inverse, slot, low),
                _ => self.set_masks::<S, BINS>(simd, values, scale.inverse, slot, low),
            }
        }
    }

    /// Sets the masks of `N` slots, from `slot` on, to those of the bins from `low` on.
    #[inline(always)]
    fn set_masks<S: Simd, const N: usize>(&mut self, simd: S, values: &[f32], inverse: f32, slot: usize, low: i8) {
        let (inverse, half) = (Lanes::splat(simd, inverse), (self.bins / 2) as i8);
        let (least, greatest) = (Octets::splat(simd, -half), Octets::splat(simd, half));
        let mut bins = [least; N];
        for (bin, index) in bins.iter_mut().zip(low..) {
            *bin = Octets::splat(simd, index);
        }
        let rows = self.slots.chunks_exact_mut(self.most_slots);
        for (values, places) in values.as_chunks::<64>().0.iter().zip(rows) {
            let mut parts = [Signed::splat(simd, 0); 64 / LANES];
            for part in 0..64 / LANES {
                parts[part] = nearest(simd, Lanes::from_slice(simd, &values[part * LANES..][..LANES]) * inverse);
            }
            let halves = [parts[0].saturating_narrow(parts[1]), parts[2].saturating_narrow(parts[3])];
            let values = halves[0].saturating_narrow(halves[1]).max(least).min(greatest);
            let places = &mut places[slot..slot + N];
            for k in 0..N {
                places[k] = values.simd_eq(bins[k]).to_bitmask();
            }
        }
    }

    /// Counts the rows in each bin of the columns that were set.
    #[inline(always)]
    pub(crate) fn finish<S: Simd>(&mut self, simd: S, terms: &[f64]) {
        let Self { columns, slots, most_slots, counts, .. } = self;
        let (stride, rows) = (*most_slots, self.rows as u64);
        let slots = &mut slots[..stride * self.words];
        let valid = Words::splat(simd, u64::MAX >> (whole_words(self.rows) - self.rows));
        for slot in (0..self.next_slot).step_by(SLOTS) {
            let place = &mut slots[stride * (self.words - 1) + slot..][..SLOTS];
            (Words::from_slice(simd, place) & valid).store_slice(place);
            let mut count = Words::splat(simd, 0);
            for slots in slots.chunks_exact(stride) {
                count += Words::from_slice(simd, &slots[slot..slot + SLOTS]).count_ones();
            }
            count.store_slice(&mut counts[slot..slot + SLOTS]);
        }
        for histogram in columns.iter_mut().filter(|histogram| !histogram.left_out()) {
            let (mut end, mut last, mut sum) = (histogram.first, rows, 0.0);
            for slot in histogram.first..histogram.end {
                let count = counts[slot];
                last -= count;
                sum += terms[count as usize];
                if count > 0 || !self.leave_out {
                    if end < slot {
                        counts[end] = count;
                        slots.chunks_exact_mut(stride).for_each(|slots| slots[end] = slots[slot]);
                    }
                    end += 1;
                }
            }
            *histogram = Histogram { end, last, terms: sum + terms[last as usize], ..*histogram };
        }
    }

    /// Measures the mutual information of each of some columns with each of some others, which were set one after another,
    /// in order.
    #[inline(always)]
    pub(crate) fn measure<S: Simd>(&mut self, simd: S, columns: Range<usize>, others: Range<usize>, terms: &[f64]) {
        let width = self.columns.len();
        // Those with equally many slots together: what comes next is foreseen then.
        self.order.clear();
        for slots in 0..self.bins {
            let counts = |column: &usize| {
                let histogram = &self.columns[*column];
                histogram.slots() == slots && !histogram.left_out()
            };
            self.order.extend(others.clone().filter(counts));
        }
        for x in columns {
            self.information[x * width..][others.clone()].fill(0.0);
            if self.columns[x].left_out() {
                continue;
            }
            self.count_joint(simd, x);
            let Self { columns, joint, most_slots, counts, order, information, .. } = self;
            let (of_x, information) = (&columns[x], &mut information[x * width..][..width]);
            let mut counts_of_x = [of_x.last; MAX_BINS as usize];
            counts_of_x[..of_x.slots()].copy_from_slice(&counts[of_x.first..of_x.end]);
            let joint = Joint { cells: joint, stride: *most_slots, counts: &counts_of_x[..=of_x.slots()], terms };
            for &other in order.iter() {
                let of_y = &columns[other];
                let sum = match of_y.slots() {
                    1 => joint.sum::<1>(of_y.first),
                    2 => joint.sum::<2>(of_y.first),
                    3 => joint.sum::<3>(of_y.first),
                    4 => joint.sum::<4>(of_y.first),
                    5 => joint.sum::<5>(of_y.first),
                    BINS => joint.sum::<BINS>(of_y.first),
                    slots => joint.sum_of(of_y.first, slots),
                };
                let sum = ((sum - of_x.terms - of_y.terms + terms[self.rows]) / self.rows as f64).max(0.0);
                // By definition, whatever rounding has left.
                information[other] = if of_x.constant || of_y.constant { 0.0 } else { sum };
            }
        }
    }

    /// Counts the rows in each bin of x and in each slot of the columns in `order`.
    #[inline(always)]
    fn count_joint<S: Simd>(&mut self, simd: S, x: usize) {
        let Self { columns, slots, most_slots, counts, joint, order, .. } = self;
        let others = order.iter().map(|&column| &columns[column]);
        let first = others.clone().map(|histogram| histogram.first).min().unwrap_or(0);
        let (others, bins) = (first..others.map(|histogram| histogram.end).max().unwrap_or(0), columns[x].slots());
        let (joint, rest) = joint[..(bins + 1) * *most_slots].split_at_mut(bins * *most_slots);
        rest[others.clone()].copy_from_slice(&counts[others.clone()]);
        let masks = Masks { slots: &slots[..*most_slots * self.words], stride: *most_slots };
        for (bin, joint) in (0..bins).step_by(BINS).zip(joint.chunks_mut(BINS * *most_slots)) {
            let x = columns[x].first + bin;
            match bins - bin {
                1 => masks.count::<S, 1>(simd, x, others.clone(), joint, rest),
                2 => masks.count::<S, 2>(simd, x, others.clone(), joint, rest),
                3 => masks.count::<S, 3>(simd, x, others.clone(), joint, rest),
                4 => masks.count::<S, 4>(simd, x, others.clone(), joint, rest),
                5 => masks.count::<S, 5>(simd, x, others.clone(), joint, rest),
                _ => masks.count::<S, BINS>(simd, x, others.clone(), joint, rest),
            }
        }
    }

    /// Mutual information of the column x with some others, in nats, as [measured](Histograms::measure); 0 where either is
    /// constant, never below 0.
    pub(crate) fn information(&self, x: usize, others: &Range<usize>) -> &[f64] {
        &self.information[x * self.columns.len()..][others.clone()]
    }
}

/// The bit masks of [`Histograms::slots`].
struct Masks<'a> {
    slots: &'a [u64],
    stride: usize,
}

impl Masks<'_> {
    /// Rows in `N` slots, from `x` on, and in each of some others: into `joint`, and taken away from `rest`.
    #[inline(always)]
    fn count<S: Simd, const N: usize>(
        &self,
        simd: S,
        x: usize,
        others: Range<usize>,
        joint: &mut [u64],
        rest: &mut [u64],
    ) {
        let lanes = <S::u64s as SimdBase<S>>::LEN;
        for slot in others.step_by(lanes) {
            let mut both = [S::u64s::splat(simd, 0); N];
            for slots in self.slots.chunks_exact(self.stride) {
                let word = S::u64s::from_slice(simd, &slots[slot..slot + lanes]);
                let of_x = &slots[x..x + N];
                for k in 0..N {
                    both[k] += (word & S::u64s::splat(simd, of_x[k])).count_ones();
                }
            }
            let mut left = S::u64s::from_slice(simd, &rest[slot..slot + lanes]);
            for k in 0..N {
                both[k].store_slice(&mut joint[k * self.stride + slot..][..lanes]);
                left -= both[k];
            }
            left.store_slice(&mut rest[slot..slot + lanes]);
        }
    }
}

/// The joint histograms of a column x with others: the rows in each bin of x and in each slot.
struct Joint<'a> {
    cells: &'a [u64],
    stride: usize,
    /// Rows in each bin of x.
    counts: &'a [u64],
    terms: &'a [f64],
}

impl Joint<'_> {
    /// [`Joint::sum_of`] where the number of slots is known.
    #[inline(always)]
    fn sum<const N: usize>(&self, first: usize) -> f64 {
        self.sum_of(first, N)
    }

    /// Sum of T over the joint counts of x and a column with so many slots from `first` on.
    #[inline(always)]
    fn sum_of(&self, first: usize, slots: usize) -> f64 {
        let mut sum = 0.0;
        for (cells, &count) in self.cells.chunks_exact(self.stride).zip(self.counts) {
            let mut last = count;
            for &both in &cells[first..first + slots] {
                sum += self.terms[both as usize];
                last -= both;
            }
            sum += self.terms[last as usize];
        }
        sum
    }
}

/// The nearest integers, half to even, of values of a size below 2^22: normalised ones are no greater than the square root
/// of their number.
#[inline(always)]
fn nearest<S: Simd>(simd: S, values: Lanes<S>) -> Signed<S> {
    // Added to this, the last bit of a value is worth 1.
    const SHIFT: f32 = 12_582_912.0;
    (values + Lanes::splat(simd, SHIFT)).bitcast::<Signed<S>>() - Signed::splat(simd, SHIFT.to_bits() as i32)
}
