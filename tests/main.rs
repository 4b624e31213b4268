//! The integration tests: one binary, one module for each part of the program.
#![expect(clippy::unwrap_used, reason = "a failed unwrap fails the test, in helpers too")]

mod cli;
mod fault;
mod load;
mod quality;
mod service;
mod stitch;
mod wire;
