//! The wire format: tiles of samples in, results out, as MessagePack. `proto/tile.md` is the normative text.
//!
//! The codec does no I/O: bytes are pushed into a [`Decoder`] in pieces of any size and come out as [`Event`]s; an
//! [`Assembler`] makes a [`SampleTile`](crate::filter::SampleTile) of them. [`encode_tile`] is the way back. Results, errors
//! and the end of a result stream are [`message`]s, read by a [`ResultDecoder`]. Only [`file`](mod@file) and
//! [`scan`] touch files.
//!
//! What a decoder promises, whatever is pushed into it:
//!
//! - it keeps at most one header ([`MAX_HEADER`]) and a few bytes of markers; planes pass through;
//! - a length that was read is only ever compared with what the validated header says, never allocated;
//! - it never recurses, and takes time linear in the bytes, however small the pieces;
//! - the first error ends it: every later call returns the same one.

pub mod assemble;
pub mod decoder;
pub mod encoder;
pub mod error;
pub mod file;
pub mod header;
mod header_read;
pub mod message;
pub mod problem;
mod pull;
pub mod results;
pub mod scan;
mod token;
pub mod value;

pub use assemble::Assembler;
pub use decoder::{Decoder, Event};
pub use encoder::{encode_header, encode_tile};
pub use error::{Fault, WireError};
pub use header::{Header, MAX_HEADER, SampleCounts, VERSION};
pub use message::{Message, TileReport, TileResult};
pub use problem::Problem;
pub use results::ResultDecoder;
pub use value::Format;
