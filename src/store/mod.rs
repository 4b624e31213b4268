//! What is kept outside the filter's memory.
//!
//! - [`spool`]: samples of an image that does not fit into memory, as long as the process lives.
//! - [`samples`]: samples of an image, compressed, in a file that stays.
//! - [`state`]: records of what is stored, in an embedded store.

mod backing;
mod blocks;
mod cut;
pub mod samples;
pub mod spool;
pub mod state;

pub use samples::{Extent, SampleFile, Source};
pub use spool::{Spool, SpoolError};
pub use state::{Change, Records, State, StateError};
