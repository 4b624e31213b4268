//! Sixteen f32 lanes, the same on every CPU: the only file that names the SIMD crate.
//!
//! Only operations that IEEE 754 defines exactly are used (no fused multiply-add, no approximate reciprocals), sums run
//! over 16 lanes in order and are folded in one fixed tree, and [`exp_neg`] is a polynomial of our own: so every level
//! gives the same bits, the baseline included.

use fearless_simd::Level;

pub(crate) use fearless_simd::{Simd, dispatch, prelude};

use prelude::*;

/// Number of lanes; columns are padded to a multiple of it.
pub(crate) const LANES: usize = 16;

/// Sixteen lanes at one SIMD level.
pub(crate) type Lanes<S> = fearless_simd::f32x16<S>;

/// Eight lanes of f64.
pub(crate) type Wide<S> = fearless_simd::f64x8<S>;

/// Sixty-four lanes of signed 8 bits.
pub(crate) type Octets<S> = fearless_simd::i8x64<S>;

/// Eight lanes of 64 bits.
pub(crate) type Words<S> = fearless_simd::u64x8<S>;

/// Sixteen lanes of signed 32 bits.
pub(crate) type Signed<S> = fearless_simd::i32x16<S>;

/// A truth value for each of sixteen lanes.
pub(crate) type Mask<S> = fearless_simd::mask32x16<S>;

/// Sixteen lanes of 32 bits.
pub(crate) type Integers<S> = fearless_simd::u32x16<S>;

/// `n` rounded up to whole lanes.
pub(crate) const fn padded(n: usize) -> usize {
    n.next_multiple_of(LANES)
}

/// Which SIMD instructions are used. The result has the same bits at every level.
#[derive(Clone, Copy, Debug)]
pub struct SimdLevel(Level);

impl Default for SimdLevel {
    fn default() -> Self {
        Self(Level::new())
    }
}

/// A level that is not among those of this CPU.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this CPU has no SIMD level {0:?}: write auto for the best, or one that it has: {has}", has = SimdLevel::names().join(", "))]
pub struct SimdLevelError(String);

impl std::str::FromStr for SimdLevel {
    type Err = SimdLevelError;

    /// Reads `auto` or the name of a level that this CPU has.
    fn from_str(text: &str) -> Result<Self, SimdLevelError> {
        let named = || Self::available().into_iter().find(|(name, _)| *name == text).map(|(_, level)| level);
        let level = if text == "auto" { Some(Self::default()) } else { named() };
        level.ok_or_else(|| SimdLevelError(text.to_owned()))
    }
}

impl PartialEq for SimdLevel {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl SimdLevel {
    /// The levels that this CPU has, lowest first, with their names.
    pub fn available() -> Vec<(&'static str, Self)> {
        Self::up_to(Level::new())
    }

    /// The names of the levels that this CPU has, lowest first.
    pub fn names() -> Vec<&'static str> {
        Self::available().into_iter().map(|(name, _)| name).collect()
    }

    /// Its name, as [`SimdLevel::available`] has it.
    pub fn name(self) -> &'static str {
        Self::up_to(self.0).last().map_or("none", |(name, _)| name)
    }

    /// A level and those below it, lowest first, with their names.
    fn up_to(best: Level) -> Vec<(&'static str, Self)> {
        let mut levels = Vec::new();
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        {
            levels.extend(best.as_sse2().map(|s| ("sse2", Self(s.level()))));
            levels.extend(best.as_sse4_2().map(|s| ("sse4.2", Self(s.level()))));
            levels.extend(best.as_avx2().map(|s| ("avx2", Self(s.level()))));
            levels.extend(best.as_avx512().map(|s| ("avx512", Self(s.level()))));
        }
        if levels.is_empty() {
            levels.push(("best", Self(best)));
        }
        levels
    }

    pub(crate) const fn level(self) -> Level {
        self.0
    }
}

/// Sum of the lanes in a fixed tree: lane i with lane i + 8, then + 4, + 2, + 1.
#[inline(always)]
pub(crate) fn sum<S: Simd>(lanes: Lanes<S>) -> f32 {
    let (low, high) = lanes.split();
    let (low, high) = (low + high).split();
    let last: [f32; 4] = (low + high).to_array();
    (last[0] + last[2]) + (last[1] + last[3])
}

/// Lanes of half a vector: rows that are transposed at a time, since AVX2 has registers for no more.
pub(crate) const HALF: usize = LANES / 2;

/// Half a vector.
pub(crate) type Half<S> = fearless_simd::f32x8<S>;

/// Columns that are transposed at a time.
pub(crate) const QUARTER: usize = LANES / 4;

/// A quarter of a vector.
pub(crate) type Quarter<S> = fearless_simd::f32x4<S>;

/// Rows become columns: lane `i` of row `j` becomes lane `j` of vector `i`.
#[inline(always)]
pub(crate) fn transpose<S: Simd>(rows: [Quarter<S>; HALF]) -> [Half<S>; QUARTER] {
    // Rows 4 apart lie in the two halves of a vector, so that nothing crosses from one half to the other.
    let [a, b, c, d, e, f, g, h] = rows;
    let (a, b, c, d) = (a.combine(e), b.combine(f), c.combine(g), d.combine(h));
    let ((ac, ac_high), (bd, bd_high)) = (interleave_quarters(a, c), interleave_quarters(b, d));
    let ((first, second), (third, fourth)) = (interleave_quarters(ac, bd), interleave_quarters(ac_high, bd_high));
    [first, second, third, fourth]
}

/// The values of two vectors by turns, quarter by quarter: of their low halves, and of their high halves.
#[inline(always)]
fn interleave_quarters<S: Simd>(a: Half<S>, b: Half<S>) -> (Half<S>, Half<S>) {
    let (low, high) = a.interleave(b);
    let ((low, low_rest), (high, high_rest)) = (low.split(), high.split());
    (low.combine(high), low_rest.combine(high_rest))
}

/// Lanes below `n` are kept, the others become 0.
#[inline(always)]
pub(crate) fn keep_first<S: Simd>(simd: S, lanes: Lanes<S>, n: usize) -> Lanes<S> {
    if n >= LANES {
        return lanes;
    }
    select_lanes(simd, (1 << n) - 1, lanes, Lanes::splat(simd, 0.0))
}

/// Lanes whose bit is set are of `a`, the others of `b`.
#[inline(always)]
pub(crate) fn select_lanes<S: Simd>(simd: S, bits: u64, a: Lanes<S>, b: Lanes<S>) -> Lanes<S> {
    Mask::from_bitmask(simd, bits).select(a, b)
}

/// Beyond this, [`exp_neg`] is 0: e^-80 is 1.8e-35.
const EXP_END: f32 = 80.0;

/// exp(-x) for x >= 0 (infinity included), within 2 units in the last place; 0 for x > 80.
///
/// Cody and Waite's reduction to |r| <= ln(2)/2 with ln 2 in two parts, then a polynomial of degree 6.
#[inline(always)]
pub(crate) fn exp_neg<S: Simd>(simd: S, x: Lanes<S>) -> Lanes<S> {
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let lanes = |v: f32| Lanes::splat(simd, v);
    let near = x.simd_le(lanes(EXP_END));
    let y = -x.min(lanes(EXP_END));
    let k = (y * lanes(LOG2_E)).round_ties_even();
    let r = (y - k * lanes(LN_2_HIGH)) - k * lanes(LN_2_LOW);
    let mut p = lanes(1.0 / 720.0);
    for c in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = p * r + lanes(c);
    }
    let exponent: Signed<S> = (k + lanes(127.0)).to_int();
    near.select(p * (exponent << 23).bitcast::<Lanes<S>>(), lanes(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_close_and_the_same_on_every_level() {
        let mut reference: Option<Vec<u32>> = None;
        for (name, level) in SimdLevel::available() {
            let mut bits = Vec::new();
            let mut worst = 0.0f64;
            for step in 0..20_000u32 {
                let x: [f32; LANES] = std::array::from_fn(|lane| (step * 16 + lane as u32) as f32 * 2.51e-4);
                let y: [f32; LANES] = dispatch!(level.level(), simd =>
                    exp_neg(simd, Lanes::from_slice(simd, &x)).to_array());
                for (x, y) in x.into_iter().zip(y) {
                    bits.push(y.to_bits());
                    let exact = libm::exp(-f64::from(x));
                    if x <= EXP_END {
                        worst = worst.max((f64::from(y) - exact).abs() / exact);
                    } else {
                        assert_eq!(y, 0.0);
                    }
                }
            }
            assert!(worst < 2.5e-7, "{name}: relative error {worst:e}");
            assert_eq!(*reference.get_or_insert_with(|| bits.clone()), bits, "{name}");
        }
    }

    #[test]
    fn levels_have_names() {
        for (name, level) in SimdLevel::available() {
            assert_eq!((name.parse(), level.name()), (Ok(level), name));
        }
        assert_eq!("auto".parse(), Ok(SimdLevel::default()));
        assert_eq!(SimdLevel::names().last(), Some(&SimdLevel::default().name()));
        let error = "mmx".parse::<SimdLevel>().unwrap_err().to_string();
        assert!(error.contains("\"mmx\"") && error.ends_with(&SimdLevel::names().join(", ")), "{error}");
    }

    #[test]
    fn exp_at_its_ends() {
        for (_, level) in SimdLevel::available() {
            let x = [0.0, 80.0, 80.1, f32::MAX, f32::INFINITY, 1e-30, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            let y: [f32; LANES] =
                dispatch!(level.level(), simd => exp_neg(simd, Lanes::from_slice(simd, &x)).to_array());
            assert_eq!(y[0], 1.0);
            assert!(y[1] > 0.0);
            assert_eq!(y[2..5], [0.0; 3]);
            assert_eq!(y[5], 1.0);
        }
    }
}
