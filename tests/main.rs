//! The integration tests: one binary, one module for each part of the program.

#![expect(clippy::unwrap_used, reason = "a test that panics has failed, which is what it is for")]

mod wire;
