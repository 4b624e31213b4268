//! The filter core: samples of one tile in, filtered pixels of its core out. Pure computation, no I/O.
//!
//! A [`SampleTile`] holds what the renderer drew; a [`Method`] says how to filter it; [`plan`](plan::plan) says what that
//! will cost before any of it is allocated; [`filter`] does it.
//!
//! # Promises
//!
//! - **Same bits.** A pixel's result depends on the samples within [`Method::reach`] pixels of it, on the method's
//!   parameters and on the seed; not on the tile it came in, the number of threads, or the SIMD level.
//! - **Bounded.** Never more bytes at once than [`plan`](plan::plan) says.
//! - **Threads are given, never taken.** Work runs on the pool in [`Execution`], or on the caller's thread.
//!
//! # Sources and symbols
//!
//! Sen and Darabi, *On Filtering the Noise from the Random Parameters in Monte Carlo Rendering*, ACM TOG 31(3), 2012, and
//! *Implementation of Random Parameter Filtering*, tech. report EECE-TR-11-0004, 2011; equation numbers are those of the
//! thesis paper *The problem of Monte Carlo rendering noise*.
//!
//! | paper | here |
//! |---|---|
//! | p, r, f, c | film position, random parameters, features, colour: [`Role`] |
//! | P, N, M | pixel, neighbourhood, its wanted size: `rpf/neighborhood.rs` |
//! | b, t | box width, iteration: [`rpf::Params`] |
//! | I(X, Y) | mutual information, in nats: `rpf/information.rs` |
//! | D_c^r, D_c^p, D_c^f, D_f^r, D_f^p | `Dependencies` in `rpf/weights.rs` |
//! | alpha, beta, (1 - W_c^r)^2 | `color`, `features`, `confidence` of `Weights` in `rpf/weights.rs` |
//! | sigma_8^2 | [`rpf::Params::sigma8_squared`] |

pub mod baseline;
pub mod channels;
pub mod coverage;
mod finish;
pub mod geometry;
mod lanes;
pub mod method;
pub mod oracle;
pub mod plan;
pub mod rpf;
pub mod samples;
pub mod scalar;
mod share;
mod work;

pub use channels::{Channel, ChannelSet, Role};
pub use coverage::Coverage;
pub use geometry::{Halo, Rect, TileGeometry};
pub use lanes::{SimdLevel, SimdLevelError};
pub use method::{Method, ParameterError};
pub use samples::{Counts, Plane, SampleTile};
pub use work::Work;

use std::sync::atomic::{AtomicBool, Ordering};

/// On what, and under which random seed, the work is done.
#[derive(Clone, Copy)]
pub struct Execution<'a> {
    /// Keys every random draw, together with image position and iteration.
    pub seed: u64,
    /// Threads to work on; without, the caller's thread does all of it.
    pub pool: Option<&'a rayon::ThreadPool>,
    /// Work ends soon after this becomes true.
    pub stop: Option<&'a AtomicBool>,
    /// SIMD instructions to use; the best there are by default. The bits of the result do not depend on it.
    pub simd: SimdLevel,
    /// Called from any thread with the share of the work that is done, 0 to 1, now and then.
    pub progress: Option<&'a (dyn Fn(f32) + Sync)>,
    /// Whether what can have no effect is left out: planes, columns of a neighbourhood and distances that are constant,
    /// missing or weigh nothing. On by default; off computes all of it, for the same bits in more time.
    pub leave_out: bool,
}

impl Default for Execution<'_> {
    fn default() -> Self {
        Self { seed: 0, pool: None, stop: None, simd: SimdLevel::default(), progress: None, leave_out: true }
    }
}

impl Execution<'_> {
    pub(crate) fn stopped(&self) -> bool {
        self.stop.is_some_and(|flag| flag.load(Ordering::Relaxed))
    }

    pub(crate) fn threads(&self) -> usize {
        self.pool.map_or(1, rayon::ThreadPool::current_num_threads)
    }
}

/// The work was stopped before its end; nothing was filtered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("stopped before the tile was done")]
pub struct Stopped;

/// The filtered pixels of a tile's core.
#[derive(Clone, Debug, PartialEq)]
pub struct Filtered {
    /// The core.
    pub core: Rect,
    /// Linear radiance: planes R, G, B, each one value per pixel of the core, row-major.
    pub rgb: [Vec<f32>; 3],
    /// What happened.
    pub report: Report,
}

/// What happened while a tile was filtered. Counts are of the core unless said, so that the tiles of an image add up.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Samples in the core.
    pub samples: u64,
    /// Values made finite, in the whole data window.
    pub replaced: samples::Replaced,
    /// Colour values that the spike step set to their pixel's mean, over all iterations.
    pub spikes: u64,
    /// Sum of the core's pixel values over channels, before.
    pub energy_in: f64,
    /// Sum of the core's pixel values over channels, after.
    pub energy_out: f64,
    /// Pixels without samples that got their neighbours' mean.
    pub filled: u64,
    /// Pixels without samples that stayed black, since no neighbour had any.
    pub unfilled: u64,
    /// Pixels with samples that were passed through, since filtering could take less than the tolerance off their relMSE.
    pub settled: u64,
    /// Sum over these pixels of what filtering could have taken off at most, by estimate: divided by the number of all
    /// pixels it is what the image's relMSE may be higher for it.
    pub settled_error: f64,
    /// The halo that the tile had.
    pub halo: Halo,
    /// The halo that it would need for the same bits as in the whole image.
    pub halo_needed: Halo,
    /// Planes that the method did not need to look at, and why.
    pub left_out: Vec<LeftOut>,
    /// Bytes of these planes, over the data window: those that are constant or missing were not kept, the others not read.
    pub left_out_bytes: u64,
    /// How much was done, and how much left out, by estimate; of RPF only.
    pub work: Option<Work>,
}

impl Report {
    /// Whether the tile had all the context that the method reads.
    pub const fn exact(&self) -> bool {
        self.halo.covers(&self.halo_needed)
    }

    /// Says which planes of a tile were left out.
    fn leaving_out(self, left_out: Vec<LeftOut>, tile: &SampleTile) -> Self {
        let left_out_bytes = left_out.len() as u64 * tile.total() as u64 * size_of::<f32>() as u64;
        Self { left_out, left_out_bytes, ..self }
    }
}

/// A plane that was left out of the computation, which changes nothing in the result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Name of the plane ([`ChannelSet::plane_name`]).
    pub plane: String,
    /// Why it has no effect.
    pub reason: LeftOutReason,
}

/// Why a plane has no effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LeftOutReason {
    /// All its values in the data window are equal: no information, no distance.
    Constant,
    /// Every sample lacks this feature.
    Missing,
    /// The method does not look at such planes.
    Unused,
    /// A colour plane with the values of an earlier one: what becomes of that one is its result as well.
    Equal,
}

impl LeftOutReason {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Constant, Self::Missing, Self::Unused, Self::Equal];

    /// A stable word for reports: `constant`, `missing`, `unused`, `equal`.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Constant => "constant",
            Self::Missing => "missing",
            Self::Unused => "unused",
            Self::Equal => "equal",
        }
    }
}

/// Filters a tile. With a pool all of it is done there, what is not shared out as well.
pub fn filter(tile: &SampleTile, method: &Method, execution: &Execution) -> Result<Filtered, Stopped> {
    let work = || match method.algorithm() {
        method::Algorithm::Unfiltered => baseline::mean::filter(tile, execution),
        method::Algorithm::Gaussian(params) => baseline::window::filter(tile, params, execution),
        method::Algorithm::Bilateral(params) => baseline::window::filter(tile, params, execution),
        method::Algorithm::CrossBilateral(params) => baseline::window::filter(tile, params, execution),
        method::Algorithm::Rpf(params) => rpf::filter(tile, params, execution),
    };
    match execution.pool {
        Some(pool) => pool.install(work),
        None => work(),
    }
}
