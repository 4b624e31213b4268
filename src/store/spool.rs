//! Samples of a whole image, kept as bare cores, from which tiles with any halo are cut.
//!
//! The tiles of a stream go in as they come, event by event, halos dropped, values as they are on the wire; a
//! [`SampleTile`] of any geometry comes out. Memory: an index (per tile a few hundred bytes; with varying samples 8 more
//! per row of the core) and buffers of fixed size; the values themselves are in one block of memory or in an unlinked
//! temporary file, which is gone when the process is.
//!
//! [`scan`](crate::wire::scan) says how many bytes a file will take before anything is written.

use std::{io, path::Path};

use super::{
    backing::Backing,
    cut::{Part, Piece, cut},
};
use crate::{
    filter::{ChannelSet, Coverage, Rect, SampleTile, TileGeometry, samples::SampleError},
    wire::{
        Event, Format, Header, SampleCounts,
        value::{CountReader, ValueReader},
    },
};

/// A spool that cannot take or give samples; says why.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SpoolError {
    /// Two cores share pixels.
    #[error("tile {tile} overlaps tile {other}: the tiles of an image must not share pixels")]
    Overlap {
        /// The core that was refused.
        tile: Rect,
        /// The core that is already there.
        other: Rect,
    },
    /// A tile of another image.
    #[error("tile {tile} differs from the tiles before in {what}: all tiles of an image must agree")]
    Disagreement {
        /// The core that was refused.
        tile: Rect,
        /// What differs.
        what: &'static str,
    },
    /// Pixels that no tile has brought.
    #[error("the window {window} needs pixels that no tile has brought: {}", list(missing))]
    Missing {
        /// The data window that was asked for.
        window: Rect,
        /// The parts of it that are missing.
        missing: Vec<Rect>,
    },
    /// More bytes than the spool may have.
    #[error("the spool would need more than the {limit} bytes that it may have")]
    Full {
        /// Bytes it may have.
        limit: u64,
    },
    /// The cut tile would have more samples than any tile may.
    #[error(transparent)]
    Samples(#[from] SampleError),
    /// The system refuses to write or read.
    #[error("the spool: {0}")]
    Io(#[from] io::Error),
}

impl SpoolError {
    /// A stable word for the kind of error.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Overlap { .. } => "overlap",
            Self::Disagreement { .. } => "disagreement",
            Self::Missing { .. } => "missing",
            Self::Full { .. } => "spool_full",
            Self::Samples(_) => "too_large",
            Self::Io(_) => "io",
        }
    }
}

/// The first few rectangles, in words.
fn list(rects: &[Rect]) -> String {
    let shown: Vec<_> = rects.iter().take(4).map(Rect::to_string).collect();
    let more = if rects.len() > 4 { format!(" and {} more", rects.len() - 4) } else { String::new() };
    format!("{}{more}", shown.join(", "))
}

/// Samples of an image, and where each of them is. See the [module](self).
#[derive(Debug)]
pub struct Spool {
    backing: Backing,
    tiles: Coverage<Stored>,
    /// Image and channels, of the first tile.
    first: Option<(Rect, ChannelSet)>,
    /// The tile that is coming in.
    open: Option<Open>,
}

/// A stored core.
#[derive(Debug)]
struct Stored {
    samples: StoredSamples,
    planes: Vec<StoredPlane>,
}

#[derive(Debug)]
enum StoredSamples {
    Uniform(u32),
    /// Where the counts are, and the position in each plane at which each row of the core starts, and their end.
    Varying {
        offset: u64,
        rows: Vec<u64>,
    },
}

#[derive(Clone, Copy, Debug)]
enum StoredPlane {
    Constant(f32),
    /// The core's values, in order, from this byte on.
    Values {
        offset: u64,
        format: Format,
    },
}

/// A tile that is coming in.
#[derive(Debug)]
struct Open {
    header: Header,
    stored: Stored,
    counts: CountReader,
    /// The runs of samples of the core in a plane of the data window, and how far the plane has come.
    cursor: Cursor,
    /// With varying samples the runs become known with the counts: (start, end) in samples, one a row.
    runs: Vec<(u64, u64)>,
    /// Pixel, and sample, of the data window at which the counts are.
    pixel: u64,
    sample: u64,
    /// Bytes of the backing ahead of this tile, to fall back to.
    before: u64,
}

/// How far a plane has come.
#[derive(Clone, Copy, Debug, Default)]
struct Cursor {
    byte: u64,
    run: usize,
}

impl Open {
    /// The samples of the core in one row: start and end in a plane of the data window.
    fn run(&self, row: usize) -> Option<(u64, u64)> {
        let (window, core) = (self.header.geometry().window(), self.header.geometry().core());
        match self.header.samples() {
            SampleCounts::Varying { .. } => self.runs.get(row).copied(),
            SampleCounts::Uniform(_) if row >= core.height as usize => None,
            SampleCounts::Uniform(n) => {
                let pixel = window.index(core.x, core.y + row as u32) as u64;
                Some((pixel * u64::from(n), (pixel + u64::from(core.width)) * u64::from(n)))
            }
        }
    }
}

impl Spool {
    /// A spool in memory: one block of `bytes` is reserved now, and more than that refused.
    pub fn in_memory(bytes: u64) -> Self {
        Self::new(Backing::in_memory(bytes))
    }

    /// A spool in an unlinked file in this folder, of at most `limit` bytes.
    pub fn on_disk(folder: &Path, limit: u64) -> Result<Self, SpoolError> {
        Ok(Self::new(Backing::on_disk(folder, limit)?))
    }

    fn new(backing: Backing) -> Self {
        Self { backing, tiles: Coverage::default(), first: None, open: None }
    }

    /// Takes the next event of a tile stream. After an error of a tile, or when its stream ends early, nothing of the
    /// tile stays; events up to the next header are ignored.
    pub fn push(&mut self, event: &Event) -> Result<(), SpoolError> {
        let result = self.take(event);
        if result.is_err() {
            self.discard();
        }
        result
    }

    /// Forgets the tile that is coming in, if one is.
    pub fn discard(&mut self) {
        if let Some(open) = self.open.take() {
            self.backing.truncate(open.before);
        }
    }

    fn take(&mut self, event: &Event) -> Result<(), SpoolError> {
        if let Event::Header(header) = event {
            self.discard();
            return self.start(header);
        }
        let (Some(open), backing) = (&mut self.open, &mut self.backing) else { return Ok(()) };
        match event {
            Event::Counts(bytes) => {
                let (window, core) = (open.header.geometry().window(), open.header.geometry().core());
                let mut kept = Vec::new();
                let Open { counts, pixel, sample, runs, .. } = open;
                counts.push(bytes, |count| {
                    let x = window.x + (*pixel % u64::from(window.width)) as u32;
                    let y = window.y + (*pixel / u64::from(window.width)) as u32;
                    if core.contains(x, y) {
                        if x == core.x {
                            runs.push((*sample, *sample));
                        }
                        if let Some((_, end)) = runs.last_mut() {
                            *end += u64::from(count);
                        }
                        kept.extend_from_slice(&count.to_le_bytes());
                    }
                    *pixel += 1;
                    *sample += u64::from(count);
                });
                backing.append(&kept)?;
            }
            Event::Constant { value, .. } => {
                open.start_planes();
                open.stored.planes.push(StoredPlane::Constant(*value));
            }
            Event::Values { plane, bytes } => {
                open.start_planes();
                if open.cursor.byte == 0 {
                    let format = open.header.plane_format(*plane);
                    open.stored.planes.push(StoredPlane::Values { offset: backing.len(), format });
                }
                open.keep(*plane, bytes, backing)?;
            }
            Event::PlaneEnd { plane } => {
                open.start_planes();
                if open.cursor.byte == 0 {
                    // A plane without samples.
                    let format = open.header.plane_format(*plane);
                    open.stored.planes.push(StoredPlane::Values { offset: backing.len(), format });
                }
                open.cursor = Cursor::default();
            }
            Event::TileEnd => return self.end(),
            Event::Header(_) => {}
        }
        Ok(())
    }

    fn start(&mut self, header: &Header) -> Result<(), SpoolError> {
        let tile = header.geometry().core();
        if let Some((image, channels)) = &self.first {
            let disagreement = |what| Err(SpoolError::Disagreement { tile, what });
            if *image != header.geometry().image() {
                return disagreement("the size of the image");
            }
            if channels != header.channels() {
                return disagreement("the channels");
            }
        }
        if let Some(&(other, _)) = self.tiles.meeting(&tile).first() {
            return Err(SpoolError::Overlap { tile, other });
        }
        let before = self.backing.len();
        let samples = match header.samples() {
            SampleCounts::Uniform(n) => StoredSamples::Uniform(n),
            SampleCounts::Varying { .. } => StoredSamples::Varying { offset: before, rows: Vec::new() },
        };
        self.open = Some(Open {
            header: header.clone(),
            stored: Stored { samples, planes: Vec::with_capacity(header.channels().planes()) },
            counts: CountReader::default(),
            cursor: Cursor::default(),
            runs: Vec::new(),
            pixel: 0,
            sample: 0,
            before,
        });
        Ok(())
    }

    fn end(&mut self) -> Result<(), SpoolError> {
        self.backing.flush()?;
        let Some(open) = self.open.take() else { return Ok(()) };
        let (geometry, tile) = (open.header.geometry(), open.header.geometry().core());
        self.tiles.insert(tile, open.stored).map_err(|other| SpoolError::Overlap { tile, other })?;
        self.first.get_or_insert_with(|| (geometry.image(), open.header.channels().clone()));
        Ok(())
    }

    /// Bytes of the backing that are used.
    pub const fn bytes(&self) -> u64 {
        self.backing.len()
    }

    /// Cores that are there.
    pub fn tiles(&self) -> impl Iterator<Item = Rect> {
        self.tiles.iter().map(|(core, _)| core)
    }

    /// The parts of a window that no tile has brought, as rectangles that do not overlap.
    pub fn missing(&self, window: &Rect) -> Vec<Rect> {
        self.tiles.missing(window)
    }

    /// The channels of the image, once a tile is in.
    pub fn channels(&self) -> Option<&ChannelSet> {
        self.first.as_ref().map(|(_, channels)| channels)
    }

    /// A tile of this geometry, which must be of the same image. Memory: the tile, 4 bytes a pixel, and a row of samples.
    pub fn cut(&self, geometry: TileGeometry) -> Result<SampleTile, SpoolError> {
        let window = geometry.window();
        let missing = self.missing(&window);
        if missing.is_empty() { self.cut_partial(geometry) } else { Err(SpoolError::Missing { window, missing }) }
    }

    /// As [`cut`](Self::cut), but pixels that no tile has brought are pixels without samples.
    pub fn cut_partial(&self, geometry: TileGeometry) -> Result<SampleTile, SpoolError> {
        let (window, tile) = (geometry.window(), geometry.core());
        let Some((image, channels)) = &self.first else {
            return Err(SpoolError::Missing { window, missing: vec![window] });
        };
        if geometry.image() != *image {
            return Err(SpoolError::Disagreement { tile, what: "the size of the image" });
        }
        let backing = &self.backing;
        let meeting = self.tiles.meeting(&window).into_iter();
        let piece = |(core, stored)| Piece { stored: core, used: core, part: SpoolPart { stored, backing } };
        let parts: Vec<_> = meeting.map(piece).collect();
        cut(geometry, channels, &parts)
    }
}

/// A core, and where its bytes are.
struct SpoolPart<'a> {
    stored: &'a Stored,
    backing: &'a Backing,
}

impl Part for SpoolPart<'_> {
    fn uniform(&self) -> Option<u32> {
        match self.stored.samples {
            StoredSamples::Uniform(n) => Some(n),
            StoredSamples::Varying { .. } => None,
        }
    }

    fn counts(&self, pixel: u64, into: &mut [u16]) -> io::Result<()> {
        let StoredSamples::Varying { offset, .. } = &self.stored.samples else { return Ok(()) };
        let mut bytes = vec![0; 2 * into.len()];
        self.backing.read(offset + 2 * pixel, &mut bytes)?;
        into.iter_mut().zip(bytes.as_chunks::<2>().0).for_each(|(to, from)| *to = u16::from_le_bytes(*from));
        Ok(())
    }

    fn row_start(&self, row: u32) -> io::Result<u64> {
        match &self.stored.samples {
            StoredSamples::Varying { rows, .. } => Ok(rows[row as usize]),
            StoredSamples::Uniform(_) => Ok(0),
        }
    }

    fn constant(&self, plane: usize) -> Option<f32> {
        match self.stored.planes[plane] {
            StoredPlane::Constant(value) => Some(value),
            StoredPlane::Values { .. } => None,
        }
    }

    fn values(&self, plane: usize, sample: u64, into: &mut [f32]) -> io::Result<()> {
        let StoredPlane::Values { offset, format } = self.stored.planes[plane] else { return Ok(()) };
        let mut bytes = vec![0; into.len() * format.bytes() as usize];
        self.backing.read(offset + sample * format.bytes(), &mut bytes)?;
        let mut slots = into.iter_mut();
        ValueReader::new(format)
            .push(&bytes, |piece| piece.iter().zip(&mut slots).for_each(|(value, slot)| *slot = *value));
        Ok(())
    }
}

impl Open {
    /// With the counts all in, the rows of the core are known.
    fn start_planes(&mut self) {
        if let StoredSamples::Varying { rows, .. } = &mut self.stored.samples
            && rows.is_empty()
        {
            let mut at = 0;
            rows.push(0);
            rows.extend(self.runs.iter().map(|(start, end)| {
                at += end - start;
                at
            }));
        }
    }

    /// Keeps what of these bytes, the next of a plane, belongs to the core.
    fn keep(&mut self, plane: usize, bytes: &[u8], backing: &mut Backing) -> Result<(), SpoolError> {
        let size = self.header.plane_format(plane).bytes();
        let (from, to) = (self.cursor.byte, self.cursor.byte + bytes.len() as u64);
        while let Some((start, end)) = self.run(self.cursor.run) {
            let (start, end) = (start * size, end * size);
            let (first, last) = (start.max(from), end.min(to));
            if first < last {
                backing.append(&bytes[(first - from) as usize..(last - from) as usize])?;
            }
            if end > to {
                break;
            }
            self.cursor.run += 1;
        }
        self.cursor.byte = to;
        Ok(())
    }
}
