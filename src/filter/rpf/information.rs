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
//! other bins of all columns lie side by side, word by word, so that one column's bin is counted against those of many
//! others at once: a lane for each.

use super::params::MAX_BINS;
use crate::filter::lanes::{LANES, Lanes, Octets, Signed, Simd, Words, prelude::*};
use std::ops::Range;

/// T\[n\] = n ln n for n = 0 to `most`, with 0 ln 0 = 0.
pub(crate) fn entropy_terms(most: usize) -> Vec<f64> {
    let mut terms = Vec::with_capacity(most + 1);
    terms.extend((0..=most).map(|n| if n == 0 { 0.0 } else { n as f64 * libm::log(n as f64) }));
    terms
}

/// Words of a bit mask over so many rows.
pub(crate) const fn mask_words(rows: usize) -> usize {
    rows.div_ceil(64)
}

/// Words that are counted at once.
const WORDS: usize = 8;
/// Bins of x that are counted at once.
const BINS: usize = 4;

/// The histogram of one column, of its bins that are not empty.
#[derive(Clone, Copy, Debug)]
struct Histogram {
    /// How many bins are not empty, and their counts.
    occupied: usize,
    counts: [u32; MAX_BINS as usize],
    /// Where the bit masks of these, but the last, lie in [`Histograms::slots`].
    slot: usize,
    /// Sum of T over the counts.
    terms: f64,
    /// The column is constant: no information with anything.
    constant: bool,
}

impl Histogram {
    const EMPTY: Self = Self { occupied: 1, counts: [0; MAX_BINS as usize], slot: 0, terms: 0.0, constant: true };

    fn slots(&self) -> Range<usize> {
        self.slot..self.slot + self.occupied - 1
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
    /// Bit masks of the bins of one column, `[bin][word]`, with `words` words each.
    masks: Vec<u64>,
    /// Bit masks of the bins of all columns but the last of each, `[word][slot]`, with `most_slots` slots each.
    slots: Vec<u64>,
    most_slots: usize,
    /// The first slot that no column has taken.
    next_slot: usize,
    /// Rows in the bin of each slot, and how many of these are in the last bin of x.
    counts: Vec<u64>,
    left: Vec<u64>,
    /// Rows in the bin of each slot and in each other bin of x, `[bin of x][slot]`.
    joint: Vec<u64>,
    /// Information of each column with x.
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
            masks: vec![0; bins * words],
            slots: vec![0; most_slots * words],
            most_slots,
            next_slot: 0,
            counts: vec![0; most_slots],
            left: vec![0; most_slots],
            joint: vec![0; (bins - 1).next_multiple_of(BINS) * most_slots],
            information: vec![0.0; columns],
        }
    }

    /// Bytes that [`Histograms::with_capacity`] allocates.
    pub(crate) const fn bytes(columns: usize, rows: usize, bins: u32) -> u64 {
        let (words, most_slots) = (mask_words(rows), Self::most_slots(columns, bins as usize));
        let per_slot = words + 2 + (bins as usize - 1).next_multiple_of(BINS);
        let masks = (bins as usize * words + most_slots * per_slot) * size_of::<u64>();
        (masks + columns * (size_of::<Histogram>() + size_of::<f64>())) as u64
    }

    /// Slots of so many columns, and as many again as may be counted without being needed.
    const fn most_slots(columns: usize, bins: usize) -> usize {
        columns * (bins - 1) + WORDS
    }

    /// Starts a neighbourhood of so many rows.
    pub(crate) fn start(&mut self, rows: usize) {
        self.rows = rows;
        self.words = mask_words(rows);
        self.next_slot = 0;
    }

    /// Takes a normalised, padded column; `constant` says that it is 0 throughout. Those that others are measured against
    /// together must come one after another, in order.
    #[inline(always)]
    pub(crate) fn set<S: Simd>(&mut self, simd: S, column: usize, values: &[f32], constant: bool, terms: &[f64]) {
        let (bins, words) = (self.bins, self.words);
        let histogram = &mut self.columns[column];
        *histogram = Histogram { slot: self.next_slot, constant, ..Histogram::EMPTY };
        if constant && self.leave_out {
            histogram.counts[0] = self.rows as u32;
            return;
        }
        let half = Lanes::splat(simd, (bins / 2) as f32);
        let masks = &mut self.masks[..bins * words];
        for (word, values) in values.chunks(64).take(words).enumerate() {
            let mut parts = [Signed::splat(simd, 0); 64 / LANES];
            for (part, chunk) in parts.iter_mut().zip(values.chunks_exact(LANES)) {
                *part = (Lanes::from_slice(simd, chunk).round_ties_even().max(-half).min(half) + half).to_int();
            }
            let halves = [parts[0].relaxed_narrow(parts[1]), parts[2].relaxed_narrow(parts[3])];
            let bin = halves[0].relaxed_narrow(halves[1]);
            let valid = u64::MAX >> (64 - (self.rows - word * 64).min(64));
            for (index, mask) in masks[word..].iter_mut().step_by(words).enumerate() {
                *mask = bin.simd_eq(Octets::splat(simd, index as i8)).to_bitmask() & valid;
            }
        }
        histogram.occupied = 0;
        for mask in masks.chunks_exact(words) {
            // All but the last will keep their slots.
            let slot = histogram.slot + histogram.occupied;
            let mut count = 0;
            for (word, slots) in mask.iter().zip(self.slots.chunks_exact_mut(self.most_slots)) {
                count += word.count_ones();
                slots[slot] = *word;
            }
            if count > 0 || !self.leave_out {
                self.counts[slot] = u64::from(count);
                histogram.counts[histogram.occupied] = count;
                histogram.terms += terms[count as usize];
                histogram.occupied += 1;
            }
        }
        self.next_slot = histogram.slots().end;
    }

    /// Mutual information of the column x with each of some others, which follow one another, in nats; 0 where either is
    /// constant, never below 0.
    #[inline(always)]
    pub(crate) fn information<S: Simd>(&mut self, simd: S, x: usize, others: &Range<usize>, terms: &[f64]) -> &[f64] {
        let Self { columns, slots, most_slots, counts, left, joint, information, .. } = self;
        let (most_slots, rows) = (*most_slots, self.rows);
        let information = &mut information[others.clone()];
        let (of_x, others) = (&columns[x], &columns[others.clone()]);
        let (Some(first), Some(last)) = (others.first(), others.last()) else { return information };
        if of_x.constant && self.leave_out {
            information.fill(0.0);
            return information;
        }
        let bins = of_x.occupied - 1;
        for slot in (first.slot..last.slots().end).step_by(WORDS) {
            let mut rest = Words::from_slice(simd, &counts[slot..slot + WORDS]);
            for bin in (0..bins).step_by(BINS) {
                let mut both = [Words::splat(simd, 0); BINS];
                for slots in slots.chunks_exact(most_slots).take(self.words) {
                    let word = Words::from_slice(simd, &slots[slot..slot + WORDS]);
                    // Beyond the last bin these are another column's, and not used.
                    let of_x = &slots[of_x.slot + bin..][..BINS];
                    for k in 0..BINS {
                        both[k] += (word & Words::splat(simd, of_x[k])).count_ones();
                    }
                }
                for (k, both) in both.into_iter().enumerate() {
                    both.store_slice(&mut joint[(bin + k) * most_slots + slot..][..WORDS]);
                    if bin + k < bins {
                        rest -= both;
                    }
                }
            }
            rest.store_slice(&mut left[slot..slot + WORDS]);
        }
        for (information, of_y) in information.iter_mut().zip(others) {
            let slots = of_y.slots();
            let (mut sum, mut last_of_y) = (0.0, of_y.counts[slots.len()]);
            for (joint, &count) in joint.chunks_exact(most_slots).zip(&of_x.counts[..bins]) {
                let mut last = count;
                for &both in &joint[slots.clone()] {
                    sum += terms[both as usize];
                    last -= both as u32;
                }
                sum += terms[last as usize];
                last_of_y -= last;
            }
            for &left in &left[slots] {
                sum += terms[left as usize];
            }
            sum += terms[last_of_y as usize];
            sum = ((sum - of_x.terms - of_y.terms + terms[rows]) / rows as f64).max(0.0);
            // By definition, whatever rounding has left.
            *information = if of_x.constant || of_y.constant { 0.0 } else { sum };
        }
        information
    }
}
