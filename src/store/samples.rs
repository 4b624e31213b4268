//! Samples of an image, core by core, in a file that stays: compressed, found by [`Extent`]s, given back when they are
//! not needed any more.
//!
//! A core's samples are a *head* and *blocks*. A block is up to 8192 values of one plane (f32; or, of the counts, u16),
//! their bytes ordered by significance, as one zstd frame with a checksum. The head says which planes are constant and
//! how long each block is; its hash is in the extent. So whatever is read back is what was written, or an error. Blocks
//! are small, since neighbours read parts of a core over and over; earlier versions, whose files are still read, had
//! larger ones.

use std::{cell::RefCell, io, path::PathBuf, sync::Arc};

use super::{
    SpoolError,
    blocks::{BlockWriter, Blocks, Reader, blocks, byte, damaged, hash, number},
    cut::{Part, Piece, cut},
};
use crate::{
    disk::{Folder, Storage},
    filter::{ChannelSet, Plane, Rect, SampleTile, TileGeometry, samples::MAX_SAMPLES_PER_PIXEL},
};

/// Name of the file in its folder.
pub const SAMPLES_FILE: &str = "samples";
/// Values of a block, and of one that an earlier version wrote.
pub(super) const BLOCK: u64 = 1 << 13;
const EARLIER: u64 = 1 << 16;
/// File systems give back whole pages only.
const PAGE: u64 = 4096;
/// Memory that writing or reading a core takes at most beside the samples: a few blocks, and what zstd needs.
pub const BUFFERS: u64 = 1 << 20;

/// Where the samples of a core are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extent {
    /// First byte in the file.
    pub offset: u64,
    /// Bytes, head included.
    pub len: u64,
    /// Bytes of the head.
    pub head: u32,
    /// Hash of the head.
    pub check: [u8; 16],
}

impl Extent {
    /// Whether there could be such a one.
    pub fn possible(&self) -> bool {
        let end = self.offset.checked_add(self.len).is_some_and(|end| end < i64::MAX as u64 - PAGE);
        end && self.offset.is_multiple_of(PAGE) && u64::from(self.head) <= self.len
    }

    /// Bytes of disk that it takes.
    pub const fn room(&self) -> u64 {
        self.len.next_multiple_of(PAGE)
    }
}

/// Stored samples, and those pixels of them that are meant.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    /// The pixels whose samples are stored.
    pub stored: Rect,
    /// Where they are.
    pub extent: Extent,
    /// Pixels among them.
    pub used: Rect,
}

/// Bytes of disk that the samples of `cores` cores take at most, which have so many pixels and samples in all.
pub fn worst_case(cores: u64, pixels: u64, samples: u64, planes: usize, varying: bool) -> u64 {
    // A frame is at most a 256th longer than what is in it, and a few bytes; its length is in the head.
    let stored = |size: u64, values: u64| {
        let bytes = values.saturating_mul(size);
        bytes.saturating_add(bytes / 256 + (80 + 4) * values.div_ceil(BLOCK))
    };
    let counts = if varying { stored(2, pixels) } else { 0 };
    // Each core may begin a block and a page.
    let per_core = PAGE + 5 + (planes as u64 + 1) * (80 + 4 + 5);
    stored(4, samples).saturating_mul(planes as u64).saturating_add(counts).saturating_add(cores * per_core)
}

/// The file.
#[derive(Debug)]
pub struct SampleFile {
    file: Arc<dyn Storage>,
    path: PathBuf,
    channels: ChannelSet,
    /// Where the next core may go.
    end: std::sync::Mutex<u64>,
}

impl SampleFile {
    /// A new file in this folder, for samples with these channels.
    pub fn create(folder: &dyn Folder, channels: ChannelSet) -> io::Result<Self> {
        let path = folder.path().join(SAMPLES_FILE);
        let file = folder.create(SAMPLES_FILE).map_err(|error| named(&path, error))?;
        Ok(Self { file, path, channels, end: 0.into() })
    }

    /// A file that was made before; [`Self::keep`] is to be called before anything is appended.
    pub fn open(folder: &dyn Folder, channels: ChannelSet) -> io::Result<Self> {
        let path = folder.path().join(SAMPLES_FILE);
        let file = folder.open(SAMPLES_FILE).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => named(&path, io::Error::new(io::ErrorKind::InvalidData, "it is missing")),
            _ => named(&path, error),
        })?;
        Ok(Self { file, path, channels, end: 0.into() })
    }

    /// Gives back what is in none of these extents.
    pub fn keep(&self, mut extents: Vec<Extent>) -> io::Result<()> {
        let Self { file, path, .. } = self;
        extents.sort_unstable_by_key(|extent| extent.offset);
        let mut end = 0u64;
        for extent in &extents {
            let start = extent.offset / PAGE * PAGE;
            if start > end {
                file.release(end, start - end);
            }
            end = (extent.offset + extent.len).next_multiple_of(PAGE);
        }
        let len = file.len().map_err(|error| named(path, error))?;
        let needed = extents.last().map_or(0, |extent| extent.offset + extent.len);
        if len < needed {
            let why = format!("it has {len} bytes, but {needed} were written");
            return Err(named(path, io::Error::new(io::ErrorKind::InvalidData, why)));
        }
        file.set_len(needed).map_err(|error| named(path, error))?;
        *self.end.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = end;
        Ok(())
    }

    /// Writes a tile's samples of a part of its data window. They are durable after [`Self::sync`].
    pub fn append(&self, tile: &SampleTile, part: &Rect) -> io::Result<Extent> {
        let window = tile.geometry().window();
        let rows = || (part.y..part.bottom()).map(|y| (window.index(part.x, y), window.index(part.right() - 1, y)));
        let samples: u64 = rows().map(|(a, b)| (tile.samples_of(b).end - tile.samples_of(a).start) as u64).sum();
        let room = worst_case(1, part.area(), samples, self.channels.planes(), tile.varying());
        let room = room.next_multiple_of(PAGE);
        let offset = {
            let mut end = self.end.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            *end += room;
            *end - room
        };
        let written = self.write_part(tile, part, offset, samples);
        written.map_err(|error| {
            self.file.release(offset, room);
            named(&self.path, error)
        })
    }

    fn write_part(&self, tile: &SampleTile, part: &Rect, offset: u64, samples: u64) -> io::Result<Extent> {
        let window = tile.geometry().window();
        let pixels = |y| window.index(part.x, y)..window.index(part.x, y) + part.width as usize;
        let tables: u64 = (0..self.channels.planes())
            .map(|plane| match tile.plane(plane) {
                Plane::Constant(_) => 5,
                Plane::Values(_) => 1 + 4 * samples.div_ceil(BLOCK),
            })
            .sum();
        let counts = if tile.varying() { 4 * part.area().div_ceil(BLOCK) } else { 0 };
        let mut head = Vec::with_capacity((5 + counts + tables) as usize);
        let mut out = BlockWriter::new(&*self.file, offset + 5 + counts + tables)?;
        if tile.varying() {
            head.push(3);
            head.extend_from_slice(&[0; 4]);
            for y in part.y..part.bottom() {
                pixels(y).try_for_each(|p| out.push(&(tile.samples_of(p).len() as u16).to_le_bytes(), &mut head))?;
            }
            out.end(&mut head)?;
        } else {
            head.push(2);
            head.extend_from_slice(&tile.max_per_pixel().to_le_bytes());
        }
        for plane in 0..self.channels.planes() {
            match tile.plane(plane) {
                Plane::Constant(value) => {
                    head.push(0);
                    head.extend_from_slice(&value.to_le_bytes());
                }
                Plane::Values(values) => {
                    head.push(1);
                    for y in part.y..part.bottom() {
                        let row = pixels(y);
                        let row = tile.samples_of(row.start).start..tile.samples_of(row.end - 1).end;
                        values[row].iter().try_for_each(|value| out.push(&value.to_le_bytes(), &mut head))?;
                    }
                    out.end(&mut head)?;
                }
            }
        }
        self.file.write(offset, &head)?;
        let len = out.at - offset;
        Ok(Extent { offset, len, head: head.len() as u32, check: hash(&head) })
    }

    /// Waits until all that was appended is on the disk.
    pub fn sync(&self) -> io::Result<()> {
        self.file.sync().map_err(|error| named(&self.path, error))
    }

    /// Gives the space of a core back.
    pub fn release(&self, extent: &Extent) {
        let (start, end) = (extent.offset.next_multiple_of(PAGE), (extent.offset + extent.len).next_multiple_of(PAGE));
        self.file.release(start, end.saturating_sub(start));
    }

    /// A tile of this geometry, from sources whose used pixels do not overlap; pixels of none of them are pixels without
    /// samples.
    pub fn cut(&self, geometry: TileGeometry, sources: &[Source]) -> Result<SampleTile, SpoolError> {
        let reader = Reader {
            file: &*self.file,
            caches: RefCell::default(),
            decompressor: RefCell::new(zstd::bulk::Decompressor::new()?),
        };
        let pieces = sources.iter().map(|&Source { stored, extent, used }| {
            let part = StoredPart::open(&reader, stored, &extent, self.channels.planes());
            Ok(Piece { stored, used, part: part.map_err(|error| named(&self.path, error))? })
        });
        let pieces = pieces.collect::<io::Result<Vec<_>>>()?;
        cut(geometry, &self.channels, &pieces).map_err(|error| match error {
            SpoolError::Io(error) => named(&self.path, error).into(),
            error => error,
        })
    }

    /// Memory that [`Self::cut`] takes at most beside the tile itself.
    pub fn cut_bytes(&self, sources: &[Source]) -> u64 {
        let per_part = 256 + 64 * self.channels.planes() as u64;
        BUFFERS
            + sources
                .iter()
                .map(|from| per_part + 3 * u64::from(from.extent.head) + 8 * u64::from(from.stored.height))
                .sum::<u64>()
    }
}

/// An error that names its file.
fn named(path: &std::path::Path, error: io::Error) -> io::Error {
    let why = format!("{}: {error}", path.display());
    if error.kind() == io::ErrorKind::UnexpectedEof {
        return io::Error::new(io::ErrorKind::InvalidData, why);
    }
    io::Error::new(error.kind(), why)
}

/// A core in the file.
struct StoredPart<'a> {
    reader: &'a Reader<'a>,
    uniform: Option<u32>,
    counts: Blocks,
    /// With varying samples those ahead of each row, and all of them.
    rows: Vec<u64>,
    planes: Vec<Result<Blocks, f32>>,
}

impl<'a> StoredPart<'a> {
    fn open(reader: &'a Reader<'a>, core: Rect, extent: &Extent, planes: usize) -> io::Result<Self> {
        let invalid = || damaged(format_args!("the head of tile {core}"));
        let mut bytes = vec![0; extent.head as usize];
        reader.file.read(extent.offset, &mut bytes)?;
        if hash(&bytes) != extent.check {
            return Err(invalid());
        }
        let (mut head, mut at) = (&bytes[..], extent.offset + u64::from(extent.head));
        let mut part = Self { reader, uniform: None, counts: Blocks::default(), rows: Vec::new(), planes: Vec::new() };
        let mut samples = 0;
        let kind = byte(&mut head).ok_or_else(invalid)?;
        let block = if kind < 2 { EARLIER } else { BLOCK };
        match (kind, number(&mut head)) {
            (0 | 2, Some(n)) if n <= MAX_SAMPLES_PER_PIXEL => {
                part.uniform = Some(n);
                samples += core.area() * u64::from(n);
            }
            (1 | 3, Some(_)) => {
                part.counts = blocks(&mut head, &mut at, core.area(), block).ok_or_else(invalid)?;
                part.rows.push(0);
                let mut counts = vec![0; core.width as usize];
                for row in 0..u64::from(core.height) {
                    reader.read(&part.counts, row * u64::from(core.width), &mut counts, u16::from_le_bytes)?;
                    samples += counts.iter().map(|&count| u64::from(count)).sum::<u64>();
                    part.rows.push(samples);
                }
            }
            _ => return Err(invalid()),
        }
        for _ in 0..planes {
            let plane = match byte(&mut head) {
                Some(0) => Err(f32::from_bits(number(&mut head).ok_or_else(invalid)?)),
                Some(1) => Ok(blocks(&mut head, &mut at, samples, block).ok_or_else(invalid)?),
                _ => return Err(invalid()),
            };
            part.planes.push(plane);
        }
        if head.is_empty() && at == extent.offset + extent.len { Ok(part) } else { Err(invalid()) }
    }
}

impl Part for StoredPart<'_> {
    fn uniform(&self) -> Option<u32> {
        self.uniform
    }

    fn counts(&self, pixel: u64, into: &mut [u16]) -> io::Result<()> {
        self.reader.read(&self.counts, pixel, into, u16::from_le_bytes)
    }

    fn row_start(&self, row: u32) -> io::Result<u64> {
        Ok(self.rows[row as usize])
    }

    fn constant(&self, plane: usize) -> Option<f32> {
        self.planes[plane].as_ref().err().copied()
    }

    fn values(&self, plane: usize, sample: u64, into: &mut [f32]) -> io::Result<()> {
        let Ok(blocks) = &self.planes[plane] else { return Ok(()) };
        self.reader.read(blocks, sample, into, f32::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        disk::Directory,
        filter::{Channel, Counts, Role},
    };

    const RECT: Rect = Rect { x: 0, y: 0, width: 300, height: 300 };

    /// Values of a plane with 2 samples a pixel: three blocks of an earlier version, many of this one.
    fn values(plane: u32) -> Vec<f32> {
        (0..RECT.area() as u32 * 2).map(|i| (i.wrapping_mul(2_654_435_761 + plane) >> 9) as f32).collect()
    }

    fn tile(geometry: TileGeometry, channels: &ChannelSet, counts: Counts) -> SampleTile {
        let planes = (0..3).map(|plane| Plane::Values(values(plane))).collect();
        SampleTile::new(geometry, channels.clone(), counts, planes).unwrap()
    }

    #[test]
    fn what_was_written_is_read_also_if_an_earlier_version_did() {
        let folder = tempfile::tempdir().unwrap();
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let file = SampleFile::create(&Directory::new(folder.path()), channels.clone()).unwrap();
        let whole = TileGeometry::with_halo([300, 300], RECT, 0).unwrap();
        let part = TileGeometry::with_halo([300, 300], Rect::new(120, 70, 90, 200), 9).unwrap();
        let window = part.window();
        let pixels =
            (window.y..window.bottom()).flat_map(|y| (window.x..window.right()).map(move |x| RECT.index(x, y)));
        let pixels: Vec<usize> = pixels.collect();
        // Of every third pixel the next has a sample.
        let counts: Vec<u16> = (0..RECT.area()).map(|i| [3, 1, 2][i as usize % 3]).collect();
        for counts in [Counts::Uniform(2), Counts::Varying(counts)] {
            let stored = tile(whole, &channels, counts.clone());
            let mut extents = vec![file.append(&stored, &RECT).unwrap()];
            if counts == Counts::Uniform(2) {
                extents.push(append_as_before(&file));
            }
            for extent in extents {
                let cut = file.cut(part, &[Source { stored: RECT, extent, used: RECT }]).unwrap();
                for (here, &there) in pixels.iter().enumerate() {
                    let (here, there) = (cut.samples_of(here), stored.samples_of(there));
                    assert_eq!(here.len(), there.len());
                    for plane in 0..3 {
                        let there = there.clone().map(|sample| stored.value(plane, sample));
                        assert!(here.clone().map(|sample| cut.value(plane, sample)).eq(there));
                    }
                }
            }
        }
    }

    /// As the first version wrote the uniform samples.
    fn append_as_before(file: &SampleFile) -> Extent {
        let (mut head, mut blocks) = (vec![0, 2, 0, 0, 0], Vec::new());
        for plane in 0..3 {
            head.push(1);
            for block in values(plane).chunks(1 << 16) {
                let bytes = (0..4).flat_map(|byte| block.iter().map(move |value| value.to_le_bytes()[byte]));
                let packed = zstd::bulk::compress(&bytes.collect::<Vec<u8>>(), 1).unwrap();
                head.extend_from_slice(&(packed.len() as u32).to_le_bytes());
                blocks.extend(packed);
            }
        }
        let offset = 64 << 20;
        file.file.write(offset, &head).unwrap();
        file.file.write(offset + head.len() as u64, &blocks).unwrap();
        Extent { offset, len: (head.len() + blocks.len()) as u64, head: head.len() as u32, check: hash(&head) }
    }
}
