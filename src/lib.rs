//! rpfd: a streaming, tile-based denoising service for Monte Carlo renders.
//!
//! - [`filter`]: the core. Samples of one tile in, filtered pixels out; no I/O, usable alone.
//! - [`synth`]: a small path tracer that makes such samples, for tests, benchmarks and `rpfd synth`.
//!
//! With the feature `program` (the default) everything around it:
#![forbid(unsafe_code)]

pub mod filter;
pub mod synth;
