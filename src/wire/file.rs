//! Files of tiles: a tile stream on disk, plain or compressed with zstd.

use std::{
    fs::File,
    io::{self, BufWriter, Chain, Cursor, Read, Write},
    path::{Path, PathBuf},
};

use super::{Assembler, Decoder, Event, Header, WireError, encode_tile, pull::Pull};
use crate::filter::{SampleTile, samples::SampleError};

/// Largest window that a compressed file may ask for, as a power of two: 128 MiB.
pub const MAX_WINDOW_LOG: u32 = 27;

/// What a zstd frame starts with.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// Most bytes that the head of a zstd frame has.
const ZSTD_HEADER: usize = 18;

/// Bytes that the head of a zstd frame has, or the least that it must have if these first ones do not tell yet.
pub(crate) fn frame_head_len(head: &[u8]) -> usize {
    match head {
        [a, b, c, d, descriptor, ..] if [*a, *b, *c, *d] == ZSTD_MAGIC => {
            let single = descriptor & 0x20 != 0;
            let content = [usize::from(single), 2, 4, 8][usize::from(descriptor >> 6)];
            5 + usize::from(!single) + [0, 1, 2, 4][usize::from(descriptor & 3)] + content
        }
        _ => 5,
    }
}

/// The window of a zstd frame with this head (RFC 8878, 3.1.1.1), at most what is allowed; never 0. Of what is no zstd
/// frame, 1.
pub(crate) fn window_bytes(head: &[u8]) -> u64 {
    let at = |index: usize| u64::from(head.get(index).copied().unwrap_or(0));
    if !head.starts_with(&ZSTD_MAGIC) {
        return 1;
    }
    let descriptor = at(4);
    let window = if descriptor & 0x20 == 0 {
        let base = 1 << (10 + (at(5) >> 3));
        base + base / 8 * (at(5) & 7)
    } else {
        // A single segment: the window is the content, whose size comes after the dictionary's number.
        let from = 5 + [0, 1, 2, 4][(descriptor & 3) as usize];
        let field = |bytes: usize| (0..bytes).rev().fold(0, |sum, k| sum << 8 | at(from + k));
        match descriptor >> 6 {
            0 => field(1),
            1 => field(2) + 256,
            2 => field(4),
            _ => field(8),
        }
    };
    window.clamp(1, 1 << MAX_WINDOW_LOG)
}

/// Bytes read at a time.
const BUFFER: usize = 256 << 10;

/// A file that cannot be read or written; says which and why.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault}", path.display())]
pub struct FileError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub fault: Box<FileFault>,
}

/// What is wrong with a file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FileFault {
    /// The system refuses.
    #[error(transparent)]
    Io(io::Error),
    /// It is no whole zstd stream, or asks for a window above [`MAX_WINDOW_LOG`].
    #[error("the compressed data cannot be read: {0}")]
    Compression(io::Error),
    /// It is no tile stream.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The samples do not fit their shape.
    #[error(transparent)]
    Samples(#[from] SampleError),
}

impl FileError {
    fn io(path: PathBuf, error: io::Error) -> Self {
        Self { path, fault: Box::new(FileFault::Io(error)) }
    }

    /// A stable word for the kind of fault: that of the [`WireError`], or `not_found`, `io`, `truncated`, `compression`.
    pub fn code(&self) -> &'static str {
        match &*self.fault {
            FileFault::Io(error) if error.kind() == io::ErrorKind::NotFound => "not_found",
            FileFault::Io(_) => "io",
            FileFault::Compression(error) if error.kind() == io::ErrorKind::UnexpectedEof => "truncated",
            FileFault::Compression(_) => "compression",
            FileFault::Wire(error) => error.code(),
            FileFault::Samples(_) => "bad_counts",
        }
    }
}

/// Reads a file of tiles in pieces. Compression is told by the first bytes, not by the name.
pub struct TileFile {
    path: PathBuf,
    source: Box<dyn Read + Send>,
    /// Bytes of the decompressor's window; 0 where nothing is compressed.
    window: u64,
    buffer: Vec<u8>,
    start: usize,
    end: usize,
    decoder: Decoder,
}

impl TileFile {
    /// Opens a file.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self, FileError> {
        let path = path.into();
        match File::open(&path) {
            Ok(file) => Self::from_reader(path, file),
            Err(error) => Err(FileError::io(path, error)),
        }
    }

    /// Reads from anything; `path` is what errors call it.
    pub fn from_reader(path: impl Into<PathBuf>, mut source: impl Read + Send + 'static) -> Result<Self, FileError> {
        let path = path.into();
        let opened = (|| {
            let mut head = Vec::with_capacity(ZSTD_HEADER);
            source.by_ref().take(ZSTD_HEADER as u64).read_to_end(&mut head)?;
            let window = if head.starts_with(&ZSTD_MAGIC) { window_bytes(&head) } else { 0 };
            let source: Chain<_, _> = Cursor::new(head).chain(source);
            let source: Box<dyn Read + Send> = if window > 0 {
                let mut source = zstd::Decoder::new(source)?;
                source.window_log_max(MAX_WINDOW_LOG)?;
                Box::new(source)
            } else {
                Box::new(source)
            };
            Ok((source, window))
        })();
        match opened {
            Ok((source, window)) => {
                let (buffer, decoder) = (vec![0; BUFFER], Decoder::new());
                Ok(Self { path, source, window, buffer, start: 0, end: 0, decoder })
            }
            Err(error) => Err(FileError::io(path, error)),
        }
    }

    /// Whether the file is compressed.
    pub const fn compressed(&self) -> bool {
        self.window > 0
    }

    /// Bytes that the decompressor keeps of what it has read, by the head of the file; 0 where nothing is compressed.
    pub const fn window_bytes(&self) -> u64 {
        self.window
    }

    /// The next event; `Ok(None)` at the end of a whole stream.
    pub fn next_event(&mut self) -> Result<Option<Event<'_>>, FileError> {
        loop {
            let mut input = &self.buffer[self.start..self.end];
            let step = self.decoder.pull(&mut input);
            let from = self.start;
            self.start = self.end - input.len();
            match step {
                Ok(Some(step)) => return Ok(Some(step.event(&self.buffer[from..self.start]))),
                Ok(None) => {}
                Err(error) => return Err(self.fail(error.into())),
            }
            match self.source.read(&mut self.buffer) {
                Ok(0) => return self.decoder.finish().map(|()| None).map_err(|error| self.fail(error.into())),
                Ok(len) => (self.start, self.end) = (0, len),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                // What the decompressor says has no number of the system's.
                Err(error) if self.compressed() && error.raw_os_error().is_none() => {
                    return Err(self.fail(FileFault::Compression(error)));
                }
                Err(error) => return Err(self.fail(FileFault::Io(error))),
            }
        }
    }

    /// The next header, whatever is left of the tile before it being skipped; `Ok(None)` at the end.
    pub fn next_header(&mut self) -> Result<Option<Header>, FileError> {
        loop {
            match self.next_event()? {
                Some(Event::Header(header)) => return Ok(Some(header)),
                Some(_) => {}
                None => return Ok(None),
            }
        }
    }

    /// The samples that follow `header`, which [`next_header`](Self::next_header) has just returned.
    pub fn read_tile(&mut self, header: &Header) -> Result<SampleTile, FileError> {
        let mut assembler = Assembler::new(header);
        while let Some(event) = self.next_event()? {
            if event == Event::TileEnd {
                break;
            }
            assembler.push(&event);
        }
        assembler.finish().map_err(|error| self.fail(error.into()))
    }

    /// The next tile; `Ok(None)` at the end. It is read whole: see first what it costs if the file is not trusted.
    pub fn next_tile(&mut self) -> Result<Option<(Header, SampleTile)>, FileError> {
        let Some(header) = self.next_header()? else { return Ok(None) };
        let tile = self.read_tile(&header)?;
        Ok(Some((header, tile)))
    }

    /// The error for a file without tiles.
    pub(super) fn empty(&self) -> FileError {
        self.fail(FileFault::Wire(WireError { fault: super::Fault::Empty, offset: 0, index: 0, tile: None }))
    }

    fn fail(&self, fault: FileFault) -> FileError {
        FileError { path: self.path.clone(), fault: Box::new(fault) }
    }
}

impl std::fmt::Debug for TileFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TileFile").field("path", &self.path).field("decoder", &self.decoder).finish_non_exhaustive()
    }
}

/// Writes a file of tiles, compressed if its name ends in `.zst`. It appears under its name when it is finished, whole,
/// or not at all.
pub struct TileWriter {
    path: PathBuf,
    out: Out,
    /// Where it is written until it is finished; none for what is no ordinary file (a pipe, a device).
    temporary: Option<tempfile::TempPath>,
}

enum Out {
    Plain(BufWriter<File>),
    Zstd(Box<zstd::Encoder<'static, File>>),
}

impl TileWriter {
    /// Starts a file; an existing one stays until [`finish`](Self::finish).
    pub fn create(path: impl Into<PathBuf>) -> Result<Self, FileError> {
        let path = path.into();
        match Self::start(&path) {
            Ok((out, temporary)) => Ok(Self { path, out, temporary }),
            Err(error) => Err(FileError::io(path, error)),
        }
    }

    fn start(path: &Path) -> io::Result<(Out, Option<tempfile::TempPath>)> {
        let special = std::fs::metadata(path).is_ok_and(|found| !found.is_file());
        let (file, temporary) = if special {
            (File::create(path)?, None)
        } else {
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let mut builder = tempfile::Builder::new();
            #[cfg(unix)]
            builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
            let (file, temporary) = builder.prefix(".rpfd-").suffix(".tmp").tempfile_in(folder)?.into_parts();
            (file, Some(temporary))
        };
        let out = if path.extension().is_some_and(|extension| extension == "zst") {
            let mut out = zstd::Encoder::new(file, 3)?;
            // Without, damage to samples would go unseen.
            out.include_checksum(true)?;
            Out::Zstd(Box::new(out))
        } else {
            Out::Plain(BufWriter::with_capacity(BUFFER, file))
        };
        Ok((out, temporary))
    }

    /// Writes a tile.
    pub fn write_tile(&mut self, header: &Header, tile: &SampleTile) -> Result<(), FileError> {
        encode_tile(header, tile, self).map_err(|error| FileError::io(self.path.clone(), error))
    }

    /// Writes what is left, sees it on the disk, and gives the file its name.
    pub fn finish(self) -> Result<(), FileError> {
        let Self { path, out, temporary } = self;
        let finished = (|| {
            let file = match out {
                Out::Plain(out) => out.into_inner().map_err(io::IntoInnerError::into_error)?,
                Out::Zstd(out) => out.finish()?,
            };
            if let Some(temporary) = temporary {
                file.sync_all()?;
                temporary.persist(&path).map_err(|error| error.error)?;
            }
            Ok(())
        })();
        finished.map_err(|error| FileError::io(path, error))
    }
}

impl Write for TileWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.out {
            Out::Plain(out) => out.write(bytes),
            Out::Zstd(out) => out.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.out {
            Out::Plain(out) => out.flush(),
            Out::Zstd(out) => out.flush(),
        }
    }
}

impl std::fmt::Debug for TileWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TileWriter").field("path", &self.path).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_is_what_the_frame_says() {
        let window = |head: &[u8]| window_bytes(&[&ZSTD_MAGIC, head].concat());
        // A window descriptor: exponent 11, mantissa 0 and 4.
        assert_eq!((window(&[0x00, 0x58]), window(&[0x04, 0x5c])), (2 << 20, 3 << 20));
        // Single segments: sizes of 1, 2 (less 256) and 4 bytes, the last behind a dictionary's number of 1 byte.
        assert_eq!((window(&[0x20, 200]), window(&[0x60, 0, 1])), (200, 512));
        assert_eq!(window(&[0xa1, 9, 0, 0, 1, 0]), 1 << 16);
        // What is beyond the limit is refused when it is read.
        assert_eq!((window(&[0x00, 0xff]), window(&[])), (1 << MAX_WINDOW_LOG, 1 << 10));
        // A skippable frame has none.
        assert_eq!(window_bytes(b"\x50\x2a\x4d\x18\x03"), 1);
        let mut encoder = zstd::Encoder::new(Vec::new(), 3).unwrap();
        encoder.write_all(&[7; 1 << 22]).unwrap();
        assert_eq!(window_bytes(&encoder.finish().unwrap()), 2 << 20);
    }
}
