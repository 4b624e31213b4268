//! Step 2: normalising a column over the neighbourhood to zero mean and unit deviation (report, section 2.2).
//!
//! A column whose values are all equal becomes exactly 0. Everything is relative to the column's first value, and scaled
//! by a power of two where its size would overflow or vanish in squares: a world coordinate of 1e6 with centimetre
//! detail, and radiances of 1e-30 or 1e38, normalise as well as any others.
//!
//! Columns are padded to whole lanes with copies of their first value ([`pad`]).

use crate::filter::lanes::{LANES, Lanes, Simd, Wide, keep_first, prelude::*, sum};

/// What a column's values span.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Span {
    /// Least value.
    pub(crate) min: f32,
    /// Greatest value.
    pub(crate) max: f32,
    /// A power of two that brings the values to a size whose squares and sums neither overflow nor vanish; mostly 1.
    pub(crate) scale: f32,
    /// Sum of the values less the first one; of use where the scale is 1.
    total: f32,
}

impl Span {
    /// Whether all values are equal.
    pub(crate) fn constant(&self) -> bool {
        self.min == self.max
    }
}

/// Replaces missing values (NaN) among the first `n` of a padded column by the mean of the others, so that they stand in
/// the middle: z = 0. If all are missing they become 0. A column with missing values is shifted to its first value and
/// scaled by a power of two, which normalising does not see: far from the origin the mean itself would be rounded away
/// from the middle.
#[inline(always)]
pub(crate) fn impute<S: Simd>(simd: S, column: &mut [f32], n: usize) {
    column[n..].fill(f32::NAN);
    let (zero, one, none) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 1.0), [Wide::splat(simd, 0.0); 2]);
    let (mut present, mut size, mut total) = (zero, zero, none);
    for chunk in column.chunks_exact(LANES) {
        let values = Lanes::from_slice(simd, chunk);
        let there = values.simd_eq(values);
        present += there.select(one, zero);
        size = size.max(there.select(values.abs(), zero));
    }
    // Whole numbers far below 2^24.
    let present = sum(present);
    if present == n as f32 {
        pad(column, n);
        return;
    }
    let first = if present > 0.0 { column.iter().find(|v| !v.is_nan()) } else { None };
    let Some(&first) = first else {
        column.fill(0.0);
        return;
    };
    let scale = safe_scale(size.reduce_max());
    let (scale, first) = (Lanes::splat(simd, scale), Lanes::splat(simd, first * scale));
    for chunk in column.chunks_exact(LANES) {
        let values = Lanes::from_slice(simd, chunk);
        let (low, high) = values.simd_eq(values).select(values * scale - first, zero).widen();
        total = [total[0] + low, total[1] + high];
    }
    let mean = Lanes::splat(simd, ((total[0] + total[1]).to_array().iter().sum::<f64>() / f64::from(present)) as f32);
    for chunk in column.chunks_exact_mut(LANES) {
        let values = Lanes::from_slice(simd, chunk);
        values.simd_eq(values).select(values * scale - first, mean).store_slice(chunk);
    }
    pad(column, n);
}

/// Fills the column up from its n-th value to whole lanes.
#[inline(always)]
pub(crate) fn pad(column: &mut [f32], n: usize) {
    let first = column[0];
    column[n..].fill(first);
}

/// What the values of some padded columns span. Several at a time, so that the sums of one do not wait for those of
/// another.
#[inline(always)]
fn spans<S: Simd, const N: usize>(simd: S, columns: &[&mut [f32]; N]) -> [Span; N] {
    let zero = Lanes::splat(simd, 0.0);
    let mut first = [zero; N];
    for (first, column) in first.iter_mut().zip(columns) {
        *first = Lanes::splat(simd, column[0]);
    }
    let (mut min, mut max, mut total) = (first, first, [zero; N]);
    for start in (0..columns[0].len()).step_by(LANES) {
        for k in 0..N {
            let values = Lanes::from_slice(simd, &columns[k][start..start + LANES]);
            min[k] = min[k].min(values);
            max[k] = max[k].max(values);
            total[k] += values - first[k]; // the padding adds 0
        }
    }
    let mut spans = [Span::default(); N];
    for k in 0..N {
        let (min, max) = (min[k].reduce_min(), max[k].reduce_max());
        spans[k] = Span { min, max, scale: safe_scale(min.abs().max(max.abs())), total: sum(total[k]) };
    }
    spans
}

/// Scales some padded columns of equal length to a safe size, and says what their values spanned before.
#[inline(always)]
pub(crate) fn make_safe<S: Simd, const N: usize>(simd: S, columns: &mut [&mut [f32]; N]) -> [Span; N] {
    let mut before = spans(simd, columns);
    for (column, span) in columns.iter_mut().zip(&mut before) {
        if span.scale != 1.0 {
            for value in column.iter_mut() {
                *value *= span.scale;
            }
            span.total = spans(simd, &[&mut **column])[0].total;
        }
    }
    before
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

/// What brings a column [of zero mean](center) to unit deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Scale {
    /// Inverse of the deviation (with n, not n - 1); 0 if all values are equal, since not even rounding may leave anything
    /// of them then.
    pub(crate) inverse: f32,
    /// The least and the greatest value at unit deviation.
    pub(crate) ends: [f32; 2],
}

impl Scale {
    /// Whether all values are equal.
    pub(crate) fn constant(&self) -> bool {
        self.inverse == 0.0
    }
}

/// Brings the first `n` values of some padded columns, [of safe size](make_safe), to zero mean, in place, and says what
/// brings them to unit deviation. Two-pass and shifted. The padding's values mean nothing afterwards.
#[inline(always)]
pub(crate) fn center<S: Simd, const N: usize>(
    simd: S,
    columns: &mut [&mut [f32]; N],
    n: usize,
    spans: &[Span; N],
) -> [Scale; N] {
    let mut shifts = [[0.0; 2]; N];
    for k in 0..N {
        shifts[k] = [columns[k][0], spans[k].total / n as f32];
    }
    let mut squares = [Lanes::splat(simd, 0.0); N];
    let whole = n - n % LANES;
    for start in (0..whole).step_by(LANES) {
        for k in 0..N {
            let deviation = shift(simd, &mut columns[k][start..start + LANES], shifts[k]);
            squares[k] += deviation * deviation;
        }
    }
    let mut scales = [Scale::default(); N];
    for k in 0..N {
        if whole < n {
            let deviation = shift(simd, &mut columns[k][whole..whole + LANES], shifts[k]);
            squares[k] += keep_first(simd, deviation * deviation, n - whole);
        }
        let Span { min, max, scale, .. } = spans[k];
        let inverse = if spans[k].constant() { 0.0 } else { 1.0 / (sum(squares[k]) / n as f32).sqrt() };
        let [first, mean] = shifts[k];
        scales[k] = Scale { inverse, ends: [min, max].map(|end| (end * scale - first - mean) * inverse) };
    }
    scales
}

/// Brings the first `n` values of some padded columns, [of safe size](make_safe), to zero mean and a deviation of their
/// `factor`, in place; a column of equal values becomes exactly 0. The padding's values mean nothing afterwards.
#[cfg(test)]
#[inline(always)]
pub(crate) fn normalise<S: Simd, const N: usize>(
    simd: S,
    columns: &mut [&mut [f32]; N],
    n: usize,
    spans: &[Span; N],
    factors: &[f32; N],
) {
    let scales = center(simd, columns, n, spans);
    for k in 0..N {
        multiply(simd, columns[k], &scales[k], factors[k]);
    }
}

/// Brings a padded column [of zero mean](center) to a deviation of `factor`.
#[inline(always)]
pub(crate) fn multiply<S: Simd>(simd: S, column: &mut [f32], scale: &Scale, factor: f32) {
    let (inverse, factor) = (Lanes::splat(simd, scale.inverse), Lanes::splat(simd, factor));
    for place in column.chunks_exact_mut(LANES) {
        (Lanes::from_slice(simd, place) * inverse * factor).store_slice(place);
    }
}

/// Takes two numbers away from some values, one after the other.
#[inline(always)]
fn shift<S: Simd>(simd: S, values: &mut [f32], [first, mean]: [f32; 2]) -> Lanes<S> {
    let shifted = Lanes::from_slice(simd, values) - Lanes::splat(simd, first) - Lanes::splat(simd, mean);
    shifted.store_slice(values);
    shifted
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
        dispatch!(SimdLevel::default().level(), simd => {
            impute(simd, &mut column, 4);
            let mut columns = [&mut column[..]];
            let spans = make_safe(simd, &mut columns);
            normalise(simd, &mut columns, 4, &spans, &[1.0]);
        });
        assert!(column[3].abs() < 1e-6, "{:?}", &column[..4]);
    }

    #[test]
    fn missing_values_among_the_greatest_stay_finite() {
        let mut column = [0.0; LANES];
        column[..5].copy_from_slice(&[f32::MAX, f32::NAN, -f32::MAX, -f32::MAX, f32::NAN]);
        dispatch!(SimdLevel::default().level(), simd => impute(simd, &mut column, 5));
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
