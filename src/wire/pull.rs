//! What all decoders here have in common: they keep count of the bytes and messages taken, collect maps of bounded size,
//! and after the first error say nothing else.

use super::{
    Fault, WireError,
    token::{ReservedMarker, Scanner},
};
use crate::filter::Rect;

/// Where a decoder is in its stream.
#[derive(Debug, Default)]
pub(super) struct Place {
    /// Bytes taken.
    pub(super) offset: u64,
    /// Tiles, or messages, that have ended.
    pub(super) index: u64,
    pub(super) failed: Option<WireError>,
}

/// Bytes are pushed in, something is pulled out.
pub(super) trait Pull {
    /// What comes out.
    type Out;

    fn place(&self) -> &Place;

    fn place_mut(&mut self) -> &mut Place;

    /// The tile that is being read.
    fn tile(&self) -> Option<Rect>;

    /// Takes bytes from the front of `input` up to the end of the next thing; none: all were taken, and more are needed.
    fn advance(&mut self, input: &mut &[u8]) -> Result<Option<Self::Out>, Fault>;

    /// As [`advance`](Self::advance); after an error every later call returns the same one.
    fn pull(&mut self, input: &mut &[u8]) -> Result<Option<Self::Out>, WireError> {
        self.alive()?;
        let before = input.len();
        let result = self.advance(input);
        self.place_mut().offset += (before - input.len()) as u64;
        result.map_err(|fault| {
            let error = self.error(fault);
            self.place_mut().failed = Some(error.clone());
            error
        })
    }

    /// The error that ended it, if one did.
    fn alive(&self) -> Result<(), WireError> {
        self.place().failed.clone().map_or(Ok(()), Err)
    }

    /// An error at this place.
    fn error(&self, fault: Fault) -> WireError {
        let Place { offset, index, .. } = *self.place();
        WireError { fault, offset, index, tile: self.tile() }
    }
}

/// Collects the bytes of one map.
#[derive(Debug)]
pub(super) struct MapReader {
    scanner: Scanner,
    bytes: Vec<u8>,
    limit: u64,
}

impl MapReader {
    /// Ready for a map of at most so many bytes.
    pub(super) const fn new(limit: usize) -> Self {
        Self { scanner: Scanner::new(), bytes: Vec::new(), limit: limit as u64 }
    }

    /// Whether nothing of it has come.
    pub(super) const fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Bytes that must still come at least.
    pub(super) const fn wanted(&self) -> u64 {
        self.scanner.wanted()
    }

    /// Whether this is the first byte of a map.
    pub(super) const fn starts(first: u8) -> bool {
        matches!(first, 0x80..=0x8f | 0xde | 0xdf)
    }

    /// Takes bytes from the front of `input`; the map once it is whole, and then it is ready for another.
    pub(super) fn push(&mut self, input: &mut &[u8]) -> Result<Option<Vec<u8>>, Fault> {
        loop {
            let before = *input;
            let more = self.scanner.step(input)?;
            let taken = &before[..before.len() - input.len()];
            // What is announced counts as well, and as soon as it is: what will be refused need not be waited for, and
            // it shows at the same byte in pieces of any size.
            let size = (self.bytes.len() + taken.len()) as u64;
            if size.saturating_add(self.wanted()) > self.limit {
                return Err(Fault::HeaderTooLarge { limit: self.limit });
            }
            self.bytes.extend_from_slice(taken);
            if self.scanner.ended() {
                self.scanner = Scanner::new();
                return Ok(Some(std::mem::take(&mut self.bytes)));
            }
            if !more {
                return Ok(None);
            }
        }
    }
}

impl From<ReservedMarker> for Fault {
    fn from(_: ReservedMarker) -> Self {
        Self::Malformed("the byte 0xc1, which starts no MessagePack object".to_owned())
    }
}
