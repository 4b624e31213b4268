//! What can be wrong with a stream of bytes, where, and what would be right.

use crate::filter::{Rect, channels::ChannelError, geometry::GeometryError, samples::SampleError};

/// A stream that cannot be read: what is wrong with it, and where.
#[derive(Clone, Debug, PartialEq)]
pub struct WireError {
    /// What is wrong.
    pub fault: Fault,
    /// Byte of the stream, from 0, at which it showed.
    pub offset: u64,
    /// Tile (or message) of the stream, from 0, in which it showed.
    pub index: u64,
    /// The tile's core, where the header could be read.
    pub tile: Option<Rect>,
}

impl WireError {
    /// The stable code of the fault.
    pub const fn code(&self) -> &'static str {
        self.fault.code()
    }
}

impl std::fmt::Display for WireError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { fault, offset, index, tile } = self;
        match tile {
            Some(tile) => write!(f, "object {index} of the stream (tile {tile}), byte {offset}: {fault}"),
            None => write!(f, "object {index} of the stream, byte {offset}: {fault}"),
        }
    }
}

impl std::error::Error for WireError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.fault)
    }
}

/// What is wrong with a stream or a header; says what would be right.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// The stream holds nothing.
    #[error("the stream is empty: there must be at least one message")]
    Empty,
    /// The stream ends too early.
    #[error("the stream ends in {place}: {missing}")]
    Truncated {
        /// Where it ends.
        place: String,
        /// What is missing there.
        missing: String,
    },
    /// The first bytes are no tile.
    #[error("this is not a tile: it starts with {0}; a tile starts with a MessagePack map whose \"type\" is \"tile\"")]
    NotATile(String),
    /// Something follows where the stream must end or a new message start.
    #[error("{0} follows the last plane: only the map of another message may")]
    Trailing(String),
    /// Bytes that are no MessagePack, or a text that is no UTF-8.
    #[error("{0}")]
    Malformed(String),
    /// Another version of the format.
    #[error("version {0}: this reader knows version 1")]
    Version(String),
    /// A key that has no meaning.
    #[error("unknown key {key:?}: {known} (keys of your own start with \"x-\")")]
    UnknownKey {
        /// The key.
        key: String,
        /// Which keys there are.
        known: String,
    },
    /// The same key twice.
    #[error("key {0:?} occurs twice: each may occur once")]
    DuplicateKey(String),
    /// A key that must be there.
    #[error("key {key:?} is missing: {right}")]
    MissingKey {
        /// The key.
        key: String,
        /// What would be right.
        right: &'static str,
    },
    /// A value of the wrong type.
    #[error("{what} is {found}: {right}")]
    WrongType {
        /// The key or plane.
        what: String,
        /// What is there.
        found: String,
        /// What would be right.
        right: String,
    },
    /// A value of the right type that means nothing.
    #[error("{what} is {found}: {right}")]
    WrongValue {
        /// The key.
        what: String,
        /// What is there.
        found: String,
        /// What would be right.
        right: String,
    },
    /// An impossible geometry.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// Impossible channels.
    #[error(transparent)]
    Channels(#[from] ChannelError),
    /// Sample counts that do not add up.
    #[error("{0}")]
    Counts(String),
    /// A plane whose size is not what the header says.
    #[error("plane {plane} is a bin of {found} bytes: the header says {expected}")]
    PlaneSize {
        /// The plane's name.
        plane: String,
        /// Bytes that it has.
        found: u64,
        /// Bytes that the header says.
        expected: u64,
    },
    /// A message's map is longer than it may be.
    #[error("a map of more than {limit} bytes: a header may have {limit} at most")]
    HeaderTooLarge {
        /// Bytes it may have.
        limit: u64,
    },
    /// More samples than a tile may have.
    #[error("{0}")]
    TooLarge(String),
}

impl Fault {
    /// A word that stays the same from version to version and says what kind of fault it is.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Empty => "empty",
            Self::Truncated { .. } => "truncated",
            Self::NotATile(_) => "not_a_tile",
            Self::Trailing(_) => "trailing",
            Self::Malformed(_) => "malformed",
            Self::Version(_) => "version",
            Self::UnknownKey { .. } => "unknown_key",
            Self::DuplicateKey(_) => "duplicate_key",
            Self::MissingKey { .. } => "missing_key",
            Self::WrongType { .. } => "wrong_type",
            Self::WrongValue { .. } => "wrong_value",
            Self::Geometry(_) => "bad_geometry",
            Self::Channels(_) => "bad_channels",
            Self::Counts(_) => "bad_counts",
            Self::PlaneSize { .. } => "plane_size",
            Self::HeaderTooLarge { .. } => "header_too_large",
            Self::TooLarge(_) => "too_large",
        }
    }
}

impl From<SampleError> for Fault {
    fn from(error: SampleError) -> Self {
        match error {
            SampleError::PerPixel(_) | SampleError::TooMany(_) => Self::TooLarge(error.to_string()),
            _ => Self::Counts(error.to_string()),
        }
    }
}
