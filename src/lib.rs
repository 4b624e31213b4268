//! rpfd: a streaming, tile-based denoising service for Monte Carlo renders.
//!
//! - [`filter`]: the core. Samples of one tile in, filtered pixels out; no I/O, usable alone.
//!
//! With the feature `program` (the default) everything around it:
#![forbid(unsafe_code)]

pub mod filter;
