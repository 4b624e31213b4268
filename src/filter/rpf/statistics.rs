//! Step 2: normalising a column over the neighbourhood to zero mean and unit deviation (report, section 2.2).
//!
//! A column whose values are all equal becomes exactly 0. Everything is relative to the column's first value, and scaled
//! by a power of two where its size would overflow or vanish in squares: a world coordinate of 1e6 with centimetre
//! detail, and radiances of 1e-30 or 1e38, normalise as well as any others.
//!
//! Columns are padded to whole lanes with copies of their first value ([`pad`]).

use crate::filter::lanes::{LANES, Lanes, Simd, keep_first, prelude::*, sum};

/// What a column's values span.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
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
/// they become 0. A column with missing values is shifted to its first value and scaled by a power of two, which
/// normalising does not see: far from the origin the mean itself would be rounded away from the middle.
pub(crate) fn impute(column: &mut [f32]) {
    let present = column.iter().filter(|v| !v.is_nan());
    let count = present.clone().count();
    if count == column.len() {
        return;
    }
    let Some(&first) = present.clone().next() else {
        column.fill(0.0);
        return;
    };
    let scale = safe_scale(present.fold(0.0, |size: f32, v| size.max(v.abs())));
    let mut sum = 0.0;
    for value in column.iter_mut().filter(|v| !v.is_nan()) {
        *value = *value * scale - first * scale;
        sum += f64::from(*value);
    }
    let mean = (sum / count as f64) as f32;
    column.iter_mut().filter(|v| v.is_nan()).for_each(|v| *v = mean);
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
    // A small size is brought to between 1 and 2, a denormal as near as f32 can; a great one only as far down as it must,
    // since what is small beside it would lose bits below 2^-126.
    let target = if size > GREATEST { EXPONENT_BIAS + 39 } else { EXPONENT_BIAS };
    let exponent = (size.to_bits() >> 23).max(1);
    f32::from_bits((EXPONENT_BIAS + target - exponent) << 23)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::lanes::{SimdLevel, dispatch};

    /// The missing stand at z = 0, also where the mean of the others is far from the origin and between two f32.
    #[test]
    fn missing_values_stand_in_the_middle_far_from_the_origin() {
        let mut column = vec![0.0; LANES];
        column[..4].copy_from_slice(&[16_777_216.0, 16_777_218.0, 16_777_218.0, f32::NAN]);
        impute(&mut column[..4]);
        pad(&mut column, 4);
        dispatch!(SimdLevel::default().level(), simd => {
            let span = span(simd, &column);
            normalise(simd, &mut column, 4, &span);
        });
        assert!(column[3].abs() < 1e-6, "{:?}", &column[..4]);
    }

    #[test]
    fn missing_values_among_the_greatest_stay_finite() {
        let mut column = [f32::MAX, f32::NAN, -f32::MAX, -f32::MAX, f32::NAN];
        impute(&mut column);
        assert!(column.iter().all(|v| v.is_finite()), "{column:?}");
    }

    /// Colours are scaled as a whole: beside f32::MAX, one of 1e-3 keeps all its bits.
    #[test]
    fn small_values_keep_their_bits_beside_the_greatest() {
        for size in [f32::MAX, 1e30, 1e-3, 1e-44] {
            let scale = safe_scale(size);
            assert!((1e-3 * scale).is_normal() && (1e-3 * scale) / scale == 1e-3, "{size:e}: {scale:e}");
            let square = (2.0 * (size * scale)).powi(2) * 65536.0;
            assert!(square.is_normal(), "{size:e}: {square:e}");
        }
    }
}
