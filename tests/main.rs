//! The integration tests, one binary. Each part of the program has a module of its own.
#![expect(clippy::unwrap_used, reason = "a failed unwrap fails the test, in helpers too")]

mod cli;
mod service;
mod stitch;
