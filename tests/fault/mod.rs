//! Kills, power losses and full disks at random points: no acknowledged tile is lost, and the image is the same, byte for
//! byte. `RPFD_FAULTS` says how many rounds there are (a few by default), `RPFD_SEED` where they begin; each prints its
//! seed, so that it can be run again alone.

mod full;
mod kill;
mod power;
mod synced;

/// How many rounds, and the seed of the first.
pub(crate) fn rounds(few: u64) -> impl Iterator<Item = u64> {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let first = number("RPFD_SEED").unwrap_or(1);
    first..first + number("RPFD_FAULTS").unwrap_or(few)
}

/// A stream of numbers that the seed decides.
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d)
    }

    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % limit
    }
}
