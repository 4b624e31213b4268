//! How far an image is from its reference, and how stable the filter is.

pub mod metrics;
pub mod stability;

pub use metrics::{Errors, SizeMismatch, errors};
