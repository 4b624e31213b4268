//! Step 5: the cross-bilateral filter over samples (eq. 6, 7).
//!
//! c''_i = sum_j w_ij c'_j / sum_j w_ij with w_ij = exp( -g/2 ( sum_k alpha_k dz_ck^2 + sum_k beta_k dz_fk^2 ) ). The
//! factors go into the columns first, so that a distance is a plain sum of squared differences.

use super::statistics::Span;
use crate::filter::lanes::{LANES, Lanes, Simd, exp_neg, keep_first, prelude::*, sum};

/// The columns of a neighbourhood that the filter reads.
pub(crate) struct Distances<'a> {
    /// Scaled columns, one after another, each `stride` values apart and padded to whole lanes.
    pub(crate) columns: &'a [f32],
    /// Values between the starts of two columns.
    pub(crate) stride: usize,
    /// Which columns count; the colours at the end, one that equals another as that other once more.
    pub(crate) active: &'a [usize],
    /// The three colour channels, laid out like `columns`, scaled by their [`Span::scale`].
    pub(crate) radiance: &'a [f32],
    /// What each colour channel spans.
    pub(crate) spans: &'a [Span; 3],
    /// Of each colour channel the first that has the same values: of the others nothing is read.
    pub(crate) twins: &'a [usize; 3],
    /// Rows.
    pub(crate) rows: usize,
}

/// Samples filtered at once, so that a column is read once for all of them.
const BLOCK: usize = 4;

/// Filters the first samples of the neighbourhood, as many as `out` has triples (R, G, B next to each other).
#[inline(always)]
pub(crate) fn filter<S: Simd>(simd: S, distances: &Distances, out: &mut [f32]) {
    match distances.twins {
        [0, 0, 0] => filter_channels::<S, 1>(simd, distances, out),
        _ => filter_channels::<S, 3>(simd, distances, out),
    }
}

/// Filters `C` colour channels: all, or only the first, with which the others are equal.
#[inline(always)]
fn filter_channels<S: Simd, const C: usize>(simd: S, distances: &Distances, out: &mut [f32]) {
    let mut first = 0;
    let mut blocks = out.chunks_exact_mut(3 * BLOCK);
    for block in &mut blocks {
        filter_block::<S, BLOCK, C>(simd, distances, first, block);
        first += BLOCK;
    }
    for single in blocks.into_remainder().chunks_exact_mut(3) {
        filter_block::<S, 1, C>(simd, distances, first, single);
        first += 1;
    }
}

/// Filters `N` samples, from `first` on. Each sample's sums run in the same order whatever the block.
#[inline(always)]
fn filter_block<S: Simd, const N: usize, const C: usize>(
    simd: S,
    distances: &Distances,
    first: usize,
    out: &mut [f32],
) {
    let Distances { columns, stride, active, radiance, spans, twins, rows } = *distances;
    let zero = Lanes::splat(simd, 0.0);
    let (mut weights, mut sums) = ([zero; N], [[zero; C]; N]);
    // Of one channel the last column's squares are added as often as it is there, which gives the bits of adding each.
    let again = if C == 1 { active.windows(2).filter(|pair| pair[0] == pair[1]).count() } else { 0 };
    for start in (0..rows).step_by(LANES) {
        let (mut distance, mut squares) = ([zero; N], [zero; N]);
        for &column in &active[..active.len() - again] {
            let column = &columns[column * stride..][..stride];
            let values = Lanes::from_slice(simd, &column[start..start + LANES]);
            for (n, &own) in column[first..first + N].iter().enumerate() {
                let difference = values - Lanes::splat(simd, own);
                let square = difference * difference;
                distance[n] += square;
                // Kept only where it may be wanted: registers are few.
                if C == 1 {
                    squares[n] = square;
                }
            }
        }
        for _ in 0..again {
            for n in 0..N {
                distance[n] += squares[n];
            }
        }
        let mut colors = [zero; C];
        for (k, color) in colors.iter_mut().enumerate() {
            *color = Lanes::from_slice(simd, &radiance[twins[k] * stride + start..][..LANES]);
        }
        for n in 0..N {
            let weight = keep_first(simd, exp_neg(simd, distance[n]), rows - start);
            weights[n] += weight;
            for k in 0..C {
                sums[n][k] += weight * colors[k];
            }
        }
    }
    for (n, out) in out.chunks_exact_mut(3).enumerate() {
        let weight = sum(weights[n]);
        for k in 0..3 {
            let Span { min, max, scale, .. } = spans[k];
            // The mean lies between the least and the greatest value; rounding must not take it out, nor to infinity.
            let mean = (sum(sums[n][k % C]) / weight).max(min * scale).min(max * scale);
            // What underflows to -0 becomes 0.
            out[k] = mean / scale + 0.0;
        }
    }
}
