//! Step 2: normalising a column over the neighbourhood to zero mean and unit deviation (report, section 2.2).
//!
//! A column whose values are all equal becomes exactly 0. Everything is relative to the column's first value, and scaled
//! by a power of two where its size would overflow or vanish in squares: a world coordinate of 1e6 with centimetre
//! detail, and radiances of 1e-30 or 1e38, normalise as well as any others.
//!
//! Columns are padded to whole lanes with copies of their first value ([`pad`]).

use crate::filter::lanes::{LANES, Lanes, Simd, keep_first, prelude::*, sum};

/// What a column's values span.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Span {
    /// Least value.
    pub(crate) min: f32,
    /// Greatest value.
    pub(crate) max: f32,
    /// A power of two that brings the values to a size whose squares and sums neither overflow nor vanish; mostly 1.
    pub(crate) scale: f32,
}

impl Span {
    /// Whether all values are equal.
    pub(crate) fn constant(&self) -> bool {
        self.min == self.max
    }
}

/// Replaces missing values (NaN) by the mean of the others, so that they stand in the middle: z = 0. If all are missing
/// they become 0.
pub(crate) fn impute(column: &mut [f32]) {
    let present = column.iter().filter(|v| !v.is_nan());
    let count = present.clone().count();
    if count < column.len() {
        let mean = if count == 0 { 0.0 } else { present.map(|&v| f64::from(v)).sum::<f64>() / count as f64 };
        column.iter_mut().filter(|v| v.is_nan()).for_each(|v| *v = mean as f32);
    }
}

/// Fills the column up from its n-th value to whole lanes.
#[inline(always)]
pub(crate) fn pad(column: &mut [f32], n: usize) {
    let first = column[0];
    column[n..].fill(first);
}

/// What the values of a padded column span.
#[inline(always)]
pub(crate) fn span<S: Simd>(simd: S, column: &[f32]) -> Span {
    let mut min = Lanes::splat(simd, column[0]);
    let mut max = min;
    for chunk in column.chunks_exact(LANES) {
        let values = Lanes::from_slice(simd, chunk);
        min = min.min(values);
        max = max.max(values);
    }
    let min = min.to_array().into_iter().fold(column[0], f32::min);
    let max = max.to_array().into_iter().fold(column[0], f32::max);
    Span { min, max, scale: safe_scale(min.abs().max(max.abs())) }
}

/// A power of two by which values of this size are safe to square and to sum 65536 of.
fn safe_scale(size: f32) -> f32 {
    const EXPONENT_BIAS: u32 = 127;
    const LEAST: f32 = f32::from_bits((EXPONENT_BIAS - 20) << 23);
    const GREATEST: f32 = f32::from_bits((EXPONENT_BIAS + 40) << 23);
    if (LEAST..=GREATEST).contains(&size) || size == 0.0 {
        return 1.0;
    }
    // The power of two that brings the size to between 1 and 2; a denormal is brought as near as f32 can.
    let exponent = (size.to_bits() >> 23).clamp(1, 2 * EXPONENT_BIAS - 1);
    f32::from_bits((2 * EXPONENT_BIAS - exponent) << 23)
}

/// Brings the first `n` values of a padded column to zero mean and unit deviation (with n, not n - 1), in place; what a
/// column of equal values becomes is exactly 0. Two-pass and shifted. The padding's values mean nothing afterwards.
#[inline(always)]
pub(crate) fn normalise<S: Simd>(simd: S, column: &mut [f32], n: usize, span: &Span) {
    if span.constant() {
        column.fill(0.0);
        return;
    }
    let scale = Lanes::splat(simd, span.scale);
    let first = Lanes::splat(simd, column[0] * span.scale);
    let zero = Lanes::splat(simd, 0.0);
    let mut total = zero;
    for chunk in column.chunks_exact_mut(LANES) {
        let shifted = Lanes::from_slice(simd, chunk) * scale - first;
        shifted.store_slice(chunk);
        total += shifted; // the padding adds 0
    }
    let mean = Lanes::splat(simd, sum(total) / n as f32);
    let mut squares = zero;
    for (index, chunk) in column.chunks_exact(LANES).enumerate() {
        let deviation = Lanes::from_slice(simd, chunk) - mean;
        squares += keep_first(simd, deviation * deviation, n - index * LANES);
    }
    let inverse = Lanes::splat(simd, 1.0 / (sum(squares) / n as f32).sqrt());
    for chunk in column.chunks_exact_mut(LANES) {
        ((Lanes::from_slice(simd, chunk) - mean) * inverse).store_slice(chunk);
    }
}
