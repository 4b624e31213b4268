//! rpfd: a streaming, tile-based denoising service for Monte Carlo renders.
//!
//! - [`filter`]: the core. Samples of one tile in, filtered pixels out; no I/O, usable alone.
//! - [`synth`]: a small path tracer that makes such samples, for tests, benchmarks and `rpfd synth`.
//!
//! With the feature `program` (the default) everything around it:
//!
//! - `admission`: the memory budget.
//! - `config`: what the service is told when it starts.
//! - `service`: tiles in, results and images out, over HTTP.
//! - `stitch`: the image being assembled from filtered tiles, and OpenEXR files.
//! - `picture`: PNG pictures of linear images, alone and side by side.
//! - `report`: how far an image is from its reference, and what that took; stiff and extreme cases.
//! - `disk`: files that must survive a power loss.
//! - `store`: samples on disk, from which tiles of any size are cut; records of what is stored.
//! - `image`: an image that is being assembled, and kept safe: stitched pixels, samples, records.
//! - `wire`: tiles and results as MessagePack, without I/O, and files of tiles.
//! - `client`: HTTP client of the service, with retries.
//! - `cli`: the `rpfd` command, one file per subcommand.
#![forbid(unsafe_code)]

#[cfg(feature = "program")]
pub mod admission;
#[cfg(feature = "program")]
pub mod cli;
#[cfg(feature = "program")]
pub mod client;
#[cfg(feature = "program")]
pub mod config;
#[cfg(feature = "program")]
pub mod disk;
pub mod filter;
#[cfg(feature = "program")]
pub mod image;
#[cfg(feature = "program")]
pub mod picture;
#[cfg(feature = "program")]
pub mod report;
#[cfg(feature = "program")]
pub mod service;
#[cfg(feature = "program")]
pub mod stitch;
#[cfg(feature = "program")]
pub mod store;
pub mod synth;
#[cfg(feature = "program")]
pub mod wire;
