//! Why an image cannot do something.

use std::io;

use super::{MAX_TILES, MIN_CORE};
use crate::{
    disk,
    filter::{Rect, Stopped},
    stitch::{CanvasError, StitchError},
    store::{SpoolError, StateError},
};

/// Why an image cannot do something.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The stitcher refuses.
    #[error(transparent)]
    Stitch(#[from] StitchError),
    /// The store fails.
    #[error(transparent)]
    State(#[from] StateError),
    /// The samples make no tile.
    #[error(transparent)]
    Samples(SpoolError),
    /// A file cannot be made or written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It takes no more tiles.
    #[error("the image was finished: it takes no more tiles")]
    Finished,
    /// It has as many tiles as it may have.
    #[error("an image has {MAX_TILES} tiles at most: send larger ones")]
    TooManyTiles,
    /// Other channels than those of the tile that came first.
    #[error("the tile's channels are not those of the tile that came first")]
    Channels,
    /// A bare core that is too small.
    #[error(
        "tile {0} is too small: cores must have {MIN_CORE} x {MIN_CORE} pixels at least, fewer only at the image's edge"
    )]
    TooSmall(Rect),
    /// Numbers of samples that were not announced.
    #[error("tile {core} has {got} samples per pixel: the image was opened with {announced}")]
    SampleCount {
        /// The core.
        core: Rect,
        /// What it has, in words.
        got: String,
        /// What was announced, in words.
        announced: String,
    },
    /// A region that cannot be filtered within the memory there is.
    #[error(
        "tile {core} cannot be made smaller, needs {needed} bytes of memory with its halo, and {most} is all there is: \
         start the service with more"
    )]
    TooLarge {
        /// A single pixel, or a tile that is to be filtered again.
        core: Rect,
        /// Bytes needed.
        needed: u64,
        /// Bytes there are.
        most: u64,
    },
    /// The work was stopped.
    #[error(transparent)]
    Stopped(#[from] Stopped),
}

impl From<SpoolError> for ImageError {
    fn from(error: SpoolError) -> Self {
        match error {
            SpoolError::Io(error) => Self::Io(error),
            error => Self::Samples(error),
        }
    }
}

impl From<CanvasError> for ImageError {
    fn from(error: CanvasError) -> Self {
        Self::Stitch(error.into())
    }
}

impl ImageError {
    /// Whether bytes on the disk are not what was written.
    pub fn is_damage(&self) -> bool {
        match self {
            Self::Stitch(error) => error.code() == "damaged",
            Self::State(error) => error.code() == "damaged",
            Self::Io(error) => error.kind() == io::ErrorKind::InvalidData,
            _ => false,
        }
    }

    /// Whether the disk has no space left.
    pub fn is_full(&self) -> bool {
        match self {
            Self::Stitch(error) => error.code() == "disk-full",
            Self::State(error) => error.code() == "disk-full",
            Self::Io(error) => disk::is_full(error),
            _ => false,
        }
    }
}
