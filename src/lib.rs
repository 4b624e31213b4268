//! rpfd: a streaming, tile-based denoising service for Monte Carlo renders.
//!
//! - [`filter`]: the core. Samples of one tile in, filtered pixels out; no I/O, usable alone.
//!
//! With the feature `program` (the default) everything around it:
//!
//! - [`store`]: samples on disk, from which tiles of any size are cut.
//! - [`wire`]: tiles and results as MessagePack, without I/O, and files of tiles.
#![forbid(unsafe_code)]

pub mod filter;
#[cfg(feature = "program")]
pub mod store;
#[cfg(feature = "program")]
pub mod wire;
