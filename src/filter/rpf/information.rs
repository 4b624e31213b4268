//! Step 3: mutual information between normalised columns (report, section 3.1).
//!
//! I(X, Y) = sum p(x,y) ln( p(x,y) / (p(x) p(y)) ) in nats, over histograms of B bins (odd): a value's bin is the value
//! rounded to the nearest integer, half to even, held within +-(B-1)/2.
//!
//! Each column keeps one bit mask over the rows per bin, so that a joint count is the number of bits in x AND y; with
//! T\[n\] = n ln n, I = (sum T\[n_xy\] - sum T\[n_x\] - sum T\[n_y\] + T\[n\]) / n. Counts are integers and the sum has one fixed
//! order, so the result has the same bits everywhere.

use super::params::MAX_BINS;
use crate::filter::lanes::{LANES, Lanes, Simd, prelude::*};

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

/// The histogram of one column: its bit masks lie in [`Histograms`].
#[derive(Clone, Copy, Debug)]
struct Histogram {
    counts: [u32; MAX_BINS as usize],
    /// Sum of T over the counts.
    terms: f64,
    /// The column is constant: no information with anything.
    constant: bool,
}

/// The histograms of all columns of a neighbourhood.
#[derive(Debug)]
pub(crate) struct Histograms {
    bins: usize,
    rows: usize,
    words: usize,
    /// Whether constant columns are passed over.
    leave_out: bool,
    /// Bit masks, `[column][bin][word]`, with `words` words each.
    masks: Vec<u64>,
    histograms: Vec<Histogram>,
}

impl Histograms {
    /// Room for so many columns and rows.
    pub(crate) fn with_capacity(columns: usize, rows: usize, bins: u32, leave_out: bool) -> Self {
        let bins = bins as usize;
        Self {
            bins,
            rows: 0,
            words: 0,
            leave_out,
            masks: vec![0; columns * bins * mask_words(rows)],
            histograms: vec![Histogram { counts: [0; MAX_BINS as usize], terms: 0.0, constant: true }; columns],
        }
    }

    /// Bytes that [`Histograms::with_capacity`] allocates.
    pub(crate) const fn bytes(columns: usize, rows: usize, bins: u32) -> u64 {
        (columns * bins as usize * mask_words(rows) * size_of::<u64>() + columns * size_of::<Histogram>()) as u64
    }

    /// Starts a neighbourhood of so many rows.
    pub(crate) fn start(&mut self, rows: usize) {
        self.rows = rows;
        self.words = mask_words(rows);
    }

    /// Takes a normalised, padded column; `constant` says that it is 0 throughout.
    #[inline(always)]
    pub(crate) fn set<S: Simd>(&mut self, simd: S, column: usize, values: &[f32], constant: bool, terms: &[f64]) {
        let histogram = &mut self.histograms[column];
        histogram.constant = constant;
        if constant && self.leave_out {
            return;
        }
        let (bins, words) = (self.bins, self.words);
        let half = Lanes::splat(simd, (bins / 2) as f32);
        let masks = &mut self.masks[column * bins * words..][..bins * words];
        for (word, values) in values.chunks(64).take(words).enumerate() {
            let mut bits = [0u64; MAX_BINS as usize];
            for (part, chunk) in values.chunks_exact(LANES).enumerate() {
                let bin = Lanes::from_slice(simd, chunk).round_ties_even().max(-half).min(half) + half;
                for (index, bits) in bits[..bins].iter_mut().enumerate() {
                    *bits |= bin.simd_eq(Lanes::splat(simd, index as f32)).to_bitmask() << (part * LANES);
                }
            }
            let valid = u64::MAX >> (64 - (self.rows - word * 64).min(64));
            for (index, bits) in bits[..bins].iter().enumerate() {
                masks[index * words + word] = bits & valid;
            }
        }
        histogram.terms = 0.0;
        for (count, mask) in histogram.counts[..bins].iter_mut().zip(masks.chunks_exact(words)) {
            *count = mask.iter().map(|word| word.count_ones()).sum();
            histogram.terms += terms[*count as usize];
        }
    }

    /// Mutual information of two columns, in nats; 0 if either is constant, never below 0.
    #[inline(always)]
    pub(crate) fn information(&self, x: usize, y: usize, terms: &[f64]) -> f64 {
        let (of_x, of_y) = (&self.histograms[x], &self.histograms[y]);
        let constant = of_x.constant || of_y.constant;
        if constant && self.leave_out {
            return 0.0;
        }
        let (bins, words) = (self.bins, self.words);
        let masks = |column: usize| &self.masks[column * bins * words..][..bins * words];
        let (masks_x, masks_y) = (masks(x), masks(y));
        // The last bin of each follows from the marginal counts.
        let mut left_y = of_y.counts;
        let mut joint = 0.0;
        for (bin_x, mask_x) in masks_x.chunks_exact(words).enumerate().take(bins - 1) {
            let mut left_x = of_x.counts[bin_x];
            if left_x == 0 {
                continue;
            }
            for (bin_y, mask_y) in masks_y.chunks_exact(words).enumerate().take(bins - 1) {
                if of_y.counts[bin_y] == 0 {
                    continue;
                }
                let both: u32 = mask_x.iter().zip(mask_y).map(|(a, b)| (a & b).count_ones()).sum();
                joint += terms[both as usize];
                left_x -= both;
                left_y[bin_y] -= both;
            }
            joint += terms[left_x as usize];
            left_y[bins - 1] -= left_x;
        }
        for &left in &left_y[..bins] {
            joint += terms[left as usize];
        }
        let information = ((joint - of_x.terms - of_y.terms + terms[self.rows]) / self.rows as f64).max(0.0);
        // By definition, whatever rounding has left.
        if constant { 0.0 } else { information }
    }
}
