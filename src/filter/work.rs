//! What a method did, and what it could leave out, in one unit.

/// An estimate of the work for a tile's core, in *steps*: one step is about what the difference of two samples in one
/// column costs. It is a sum of counts times fixed costs (`rpf/work.rs`), not a measurement: the same samples and
/// parameters give the same numbers on any machine, and the tiles of an image add up: `done` and all that was left out are
/// together the same whatever the tiling. The halo's work is not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// What was done.
    pub done: u64,
    /// Left out with whole planes ([`LeftOut`](super::LeftOut)).
    pub planes: u64,
    /// Left out for columns that are constant over a neighbourhood, though not over the tile.
    pub columns: u64,
    /// Left out for differences that add nothing: in columns that weigh nothing (features with beta 0, colours with alpha
    /// 0), and in those that are constant over a neighbourhood.
    pub distances: u64,
}

impl Work {
    /// What was left out.
    pub const fn saved(&self) -> u64 {
        self.planes + self.columns + self.distances
    }

    /// The share of all work that was left out, 0 to 1; 0 of none.
    pub fn saved_share(&self) -> f64 {
        let all = self.done + self.saved();
        if all == 0 { 0.0 } else { self.saved() as f64 / all as f64 }
    }
}

impl std::ops::AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        self.done = self.done.saturating_add(other.done);
        self.planes = self.planes.saturating_add(other.planes);
        self.columns = self.columns.saturating_add(other.columns);
        self.distances = self.distances.saturating_add(other.distances);
    }
}
