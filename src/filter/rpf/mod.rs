//! Random Parameter Filtering, one file per part of the algorithm.

pub mod params;

pub use params::Params;
