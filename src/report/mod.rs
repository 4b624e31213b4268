//! How far an image is from its reference.

pub mod metrics;
pub mod stability;

pub use metrics::{Errors, SizeMismatch, errors};
