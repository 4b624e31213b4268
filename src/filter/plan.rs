//! What a tile will cost, as a function of its shape, before any of it is allocated.

use super::rpf::work::{self, Columns};
use super::{ChannelSet, Method, TileGeometry, Work, method::Algorithm};

/// The shape of a tile's samples, as its header announces it.
#[derive(Clone, Copy, Debug)]
pub struct Shape<'a> {
    /// Where the tile lies.
    pub geometry: &'a TileGeometry,
    /// Its channels.
    pub channels: &'a ChannelSet,
    /// Samples in the data window.
    pub samples: u64,
    /// Greatest number of samples in any pixel, or an upper bound.
    pub max_per_pixel: u32,
    /// Whether the pixels may have different numbers of samples.
    pub varying: bool,
}

/// Bytes that a tile needs: upper bounds, each at most a quarter above what is really allocated when every plane is
/// spelt out and `max_per_pixel` is exact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// The samples themselves.
    pub samples: u64,
    /// What the method keeps beside them for the whole tile.
    pub working: u64,
    /// What the method needs on each thread.
    pub per_thread: u64,
    /// The filtered core, and small things.
    pub output: u64,
}

impl Plan {
    /// All of it, on so many threads.
    pub const fn total(&self, threads: usize) -> u64 {
        self.samples + self.working + self.output + self.per_thread * threads as u64
    }
}

/// For what does not grow with the tile: names, tables, the pool's bookkeeping.
const FIXED: u64 = 16 << 10;

/// Bytes that filtering a tile of this shape will need.
pub fn plan(shape: &Shape, method: &Method) -> Plan {
    let pixels = shape.geometry.window().area();
    // 4 bytes a value; where counts vary, a start and, while it is read, a count per pixel.
    let starts = if shape.varying { pixels * (4 + 2) + 4 } else { 0 };
    let samples = shape.samples * 4 * shape.channels.planes() as u64 + starts;
    // The report may name every plane.
    let names: u64 = shape.channels.plane_channels().map(|(channel, _)| channel.name.len() as u64 + 64).sum();
    let output = shape.geometry.core().area() * 12 + FIXED + 2 * names;
    let own = match method.algorithm() {
        Algorithm::Unfiltered => Plan::default(),
        Algorithm::Gaussian(params) => super::baseline::window::plan(shape, params),
        Algorithm::Bilateral(params) => super::baseline::window::plan(shape, params),
        Algorithm::CrossBilateral(params) => super::baseline::window::plan(shape, params),
        Algorithm::Rpf(params) => super::rpf::plan(shape, params),
    };
    Plan { samples, output, ..own }
}

/// What share of the work leaving out some planes will save, for pixels with so many samples; none if the method does not
/// say. Planes alone are counted, as if every candidate were accepted: columns that are constant over a neighbourhood
/// only, and what weighs nothing, add to it.
pub fn forecast(channels: &ChannelSet, samples: u32, method: &Method, left_out: &[usize]) -> Option<Work> {
    let Algorithm::Rpf(params) = method.algorithm() else { return None };
    Some(work::forecast(params, samples, &Columns::of(channels, &[]), &Columns::of(channels, left_out)))
}
