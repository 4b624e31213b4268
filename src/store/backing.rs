//! Where the bytes of a spool are: a block of memory, or a file that has no name.

use std::{fs::File, io, os::unix::fs::FileExt, path::Path};

use super::SpoolError;

/// Bytes that are collected before they are written to a file.
const WRITE_BUFFER: usize = 256 << 10;

/// The bytes of a spool.
#[derive(Debug)]
pub(super) enum Backing {
    Memory { bytes: Vec<u8>, limit: u64 },
    Disk { file: File, written: u64, buffer: Vec<u8>, limit: u64 },
}

impl Backing {
    /// A block of so many bytes, reserved now.
    pub(super) fn in_memory(limit: u64) -> Self {
        Self::Memory { bytes: Vec::with_capacity(usize::try_from(limit).unwrap_or(usize::MAX)), limit }
    }

    /// A file without a name in this folder.
    pub(super) fn on_disk(folder: &Path, limit: u64) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        Ok(Self::Disk { file, written: 0, buffer: Vec::with_capacity(WRITE_BUFFER), limit })
    }

    pub(super) const fn len(&self) -> u64 {
        match self {
            Self::Memory { bytes, .. } => bytes.len() as u64,
            Self::Disk { written, buffer, .. } => *written + buffer.len() as u64,
        }
    }

    pub(super) fn append(&mut self, more: &[u8]) -> Result<(), SpoolError> {
        let (Self::Memory { limit, .. } | Self::Disk { limit, .. }) = self;
        let limit = *limit;
        if self.len().checked_add(more.len() as u64).is_none_or(|len| len > limit) {
            return Err(SpoolError::Full { limit });
        }
        match self {
            Self::Memory { bytes, .. } => bytes.extend_from_slice(more),
            Self::Disk { buffer, .. } => {
                if buffer.len() + more.len() > WRITE_BUFFER {
                    self.flush()?;
                }
                let Self::Disk { file, written, buffer, .. } = self else { return Ok(()) };
                if more.len() > WRITE_BUFFER {
                    file.write_all_at(more, *written)?;
                    *written += more.len() as u64;
                } else {
                    buffer.extend_from_slice(more);
                }
            }
        }
        Ok(())
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        if let Self::Disk { file, written, buffer, .. } = self {
            file.write_all_at(buffer, *written)?;
            *written += buffer.len() as u64;
            buffer.clear();
        }
        Ok(())
    }

    /// Back to a length that it once had.
    pub(super) fn truncate(&mut self, len: u64) {
        match self {
            Self::Memory { bytes, .. } => bytes.truncate(len as usize),
            Self::Disk { written, buffer, .. } => {
                buffer.truncate(len.saturating_sub(*written) as usize);
                // What lies behind in the file is written over.
                *written = len.min(*written);
            }
        }
    }

    pub(super) fn read(&self, offset: u64, into: &mut [u8]) -> io::Result<()> {
        match self {
            Self::Memory { bytes, .. } => {
                let end = offset as usize + into.len();
                let from = bytes.get(offset as usize..end).ok_or(io::ErrorKind::UnexpectedEof)?;
                into.copy_from_slice(from);
                Ok(())
            }
            Self::Disk { file, .. } => file.read_exact_at(into, offset),
        }
    }
}
