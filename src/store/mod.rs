//! What is kept outside the filter's memory: the samples of images that do not fit into it.

mod backing;
pub mod spool;

pub use spool::{Spool, SpoolError};
