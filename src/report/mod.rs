//! How far an image is from its reference.

pub mod metrics;

pub use metrics::{Errors, SizeMismatch, errors};
