//! Error against run time: how far filtered images are from their references, and what that costs.
//!
//! - [`metrics`], [`ssim`](mod@ssim), [`flip`](mod@flip): the numbers, with their formulas; [`scores`] puts them side by side.
//! - [`plan`]: which measurements a report needs, and the key of each.
//! - [`measure`]: one measurement; [`state`] keeps those that are done.
//! - [`rows`]: medians, the Pareto front, and how many plain samples would do as well.
//! - [`table`], [`html`], [`plots`], [`svg`]: what a reader gets to see.
//! - [`cost`]: what filtering costs, and how that grows.
//! - [`stability`]: how stable the filter is, in stiff and extreme cases.
//!
//! Errors are reproducible: they depend on the samples, the method and the seed only, and are computed in `f64` with `+
//! - * /`, square roots and the pure-Rust `libm`. Times are what they are on the [`machine`].

pub mod cost;
pub mod display;
pub mod flip;
pub mod html;
pub mod machine;
pub mod measure;
pub mod metrics;
pub mod plan;
pub mod plots;
pub mod rows;
pub mod scores;
pub mod ssim;
pub mod stability;
pub mod state;
pub mod svg;
pub mod table;

pub use metrics::{Errors, SizeMismatch, errors};
