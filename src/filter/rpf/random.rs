//! Counter-based random numbers: a draw is a hash of what it is for, so it never depends on order, tile or thread.

/// Step between the counters of one key: the golden ratio in 64 bits.
const STEP: u64 = 0x9E37_79B9_7F4A_7C15;

/// SplitMix64's output function (Steele, Lea and Flood 2014): a bijection that passes as random.
#[inline(always)]
pub(crate) const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// The key of all draws for one pixel of the image in one iteration.
pub(crate) const fn pixel_key(seed: u64, x: u32, y: u32, iteration: usize) -> u64 {
    let position = ((x as u64) << 32) | y as u64;
    mix(mix(mix(seed.wrapping_add(STEP)) ^ position).wrapping_add((iteration as u64 + 1).wrapping_mul(STEP)))
}

/// 64 random bits for the counter-th draw of a key.
#[inline(always)]
pub(crate) const fn bits(key: u64, counter: u64) -> u64 {
    mix(key.wrapping_add(counter.wrapping_mul(STEP)))
}
