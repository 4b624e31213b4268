//! OpenEXR files: the finished image out, reference images in.
//!
//! The header and the blocks are the `exr` crate's; the container around them (text attributes, offset table) is written
//! here, because the crate keeps attributes in hash maps, whose order changes from run to run. Blocks are written one by
//! one in increasing order, so the same pixels and options always give the same bytes, and only one block (one tile, or
//! 1 to 32 rows) is in memory.

use super::{
    atomic::{AtomicError, AtomicFile},
    canvas::{CanvasError, Pixels, RgbImage},
};
use crate::{disk::is_full, filter::Rect};
use ::exr::{
    block::{BlockIndex, UncompressedBlock, reader::ChunksReader},
    compression::Compression,
    error::Error as LibraryError,
    math::{RoundingMode, Vec2},
    meta::{
        BlockDescription,
        attribute::{ChannelDescription, LevelMode, LineOrder, SampleType, Text, TileDescription},
        header::{Header, LayerAttributes},
        magic_number,
    },
};
use half::f16;
use std::{
    collections::{BTreeMap, HashSet},
    io::{self, BufReader, Read, Seek, SeekFrom, Write},
    path::Path,
};

/// Sizes of EXR tiles that can be asked for, in pixels.
pub const TILE_SIZES: std::ops::RangeInclusive<u32> = 16..=4096;

/// How pixel values are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrSamples {
    /// 32-bit float: the canvas bit for bit.
    #[default]
    Float,
    /// 16-bit float, rounded to nearest even. Values beyond its range become the greatest finite one, 65504, with their
    /// sign, instead of infinity, and are counted ([`ExrSummary::saturated`]).
    Half,
}

impl ExrSamples {
    /// All of them, by the names that users give.
    pub const NAMES: [(&str, Self); 2] = [("float", Self::Float), ("half", Self::Half)];
}

/// How blocks are compressed; all without loss.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrCompression {
    /// Not at all.
    None,
    /// Runs of equal bytes, row by row.
    Rle,
    /// Deflate, row by row.
    Zips,
    /// Deflate, 16 rows at a time.
    #[default]
    Zip,
    /// Wavelets, 32 rows at a time.
    Piz,
}

impl ExrCompression {
    /// All of them, by the names that users give.
    pub const NAMES: [(&str, Self); 5] =
        [("none", Self::None), ("rle", Self::Rle), ("zips", Self::Zips), ("zip", Self::Zip), ("piz", Self::Piz)];
}

/// How pixels are divided into blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrLayout {
    /// Whole rows.
    #[default]
    Scanlines,
    /// Square tiles of so many pixels, within [`TILE_SIZES`].
    Tiles(u32),
}

/// What an EXR file is like.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ExrOptions {
    /// Value type of the channels R, G and B.
    pub samples: ExrSamples,
    /// Compression.
    pub compression: ExrCompression,
    /// Scanlines or tiles.
    pub layout: ExrLayout,
    /// Text attributes by name, of 1 to 255 bytes ([`provenance`] makes the usual ones).
    pub attributes: BTreeMap<String, String>,
}

/// The attributes that say how an image was made: `software`, `rpfd:version`, `rpfd:preset`, `rpfd:seed`, and
/// `rpfd:NAME` for each parameter. No date, host or file name: the same image gives the same file.
pub fn provenance<'a>(
    preset: &str,
    seed: u64,
    parameters: impl IntoIterator<Item = (&'a str, String)>,
) -> BTreeMap<String, String> {
    let version = env!("CARGO_PKG_VERSION");
    let mut attributes: BTreeMap<_, _> =
        parameters.into_iter().map(|(name, value)| (format!("rpfd:{name}"), value)).collect();
    attributes.insert("software".into(), format!("rpfd {version}"));
    attributes.insert("rpfd:version".into(), version.into());
    attributes.insert("rpfd:preset".into(), preset.into());
    attributes.insert("rpfd:seed".into(), seed.to_string());
    attributes
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExrSummary {
    /// Length of the file in bytes.
    pub bytes: u64,
    /// Values beyond the range of half that were set to +-65504. Always 0 for float.
    pub saturated: u64,
}

/// An EXR that could not be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExrError {
    /// A tile size outside [`TILE_SIZES`].
    #[error("EXR tiles of {0} pixels: must be {min} to {max}", min = TILE_SIZES.start(), max = TILE_SIZES.end())]
    TileSize(u32),
    /// An attribute that the format cannot hold, or that means something else.
    #[error("EXR attribute {0:?}: names have 1 to 255 bytes without NUL and are not those of the format itself")]
    Attribute(String),
    /// The output file could not be made.
    #[error(transparent)]
    Output(#[from] AtomicError),
    /// The output stream failed.
    #[error("cannot write the EXR: {0}")]
    Write(io::Error),
    /// The pixels could not be read.
    #[error(transparent)]
    Canvas(#[from] CanvasError),
    /// The EXR library refused to write, which it should not.
    #[error("the EXR could not be encoded: {0}")]
    Encode(String),
    /// The file could not be opened or read.
    #[error("cannot read {name}: {source}")]
    Read {
        /// What was read.
        name: String,
        /// Why not.
        source: io::Error,
    },
    /// The file is no EXR, is damaged, or has no picture in it that can be used.
    #[error("{name} cannot be used: {why}")]
    Invalid {
        /// What was read.
        name: String,
        /// What is wrong.
        why: String,
    },
    /// The image is larger than the caller allows.
    #[error("{name} has {pixels} pixels, more than the {limit} allowed")]
    TooLarge {
        /// What was read.
        name: String,
        /// Its pixels.
        pixels: u64,
        /// Pixels allowed.
        limit: u64,
    },
}

impl ExrError {
    /// A stable code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::TileSize(_) | Self::Attribute(_) => "exr-option",
            Self::Output(error) => error.code(),
            Self::Write(error) if is_full(error) => "disk-full",
            Self::Write(_) => "output-io",
            Self::Canvas(error) => error.code(),
            Self::Encode(_) => "internal",
            Self::Read { .. } => "input-io",
            Self::Invalid { .. } => "exr-invalid",
            Self::TooLarge { .. } => "exr-too-large",
        }
    }
}

fn encode_error(error: LibraryError) -> ExrError {
    match error {
        LibraryError::Io(error) => ExrError::Write(error),
        error => ExrError::Encode(error.to_string()),
    }
}

/// Writes an EXR file: complete, durable and under its name, or not at all.
pub fn write(source: &impl Pixels, options: &ExrOptions, path: &Path) -> Result<ExrSummary, ExrError> {
    let mut file = AtomicFile::create(path)?;
    let summary = match encode(source, options, file.out()) {
        Err(ExrError::Write(error)) => return Err(file.error(error).into()),
        other => other?,
    };
    file.commit()?;
    Ok(summary)
}

/// Writes an EXR to a stream, from its current position on; the stream should buffer. After an error what was written is
/// no EXR. Memory: one block, three times at most (pixels, bytes, compressed bytes), and 8 bytes for every block.
pub fn encode(
    source: &impl Pixels,
    options: &ExrOptions,
    out: &mut (impl Write + Seek),
) -> Result<ExrSummary, ExrError> {
    let image = source.image();
    let header = header(image, options)?;
    let start = out.stream_position().map_err(ExrError::Write)?;
    let head = head_bytes(&header, options)?;
    let blocks = blocks(&header, image);
    let table_bytes = 8 * blocks.clone().count();
    // The table is filled in at the end, when the offsets are known.
    let reserve = out.write_all(&head).and_then(|()| io::copy(&mut io::repeat(0).take(table_bytes as u64), out));
    reserve.map_err(ExrError::Write)?;

    let mut table = Vec::with_capacity(table_bytes);
    let mut saturated = 0;
    let mut pixels = Vec::new();
    for rect in blocks {
        pixels.resize(rect.area() as usize, [0.0; 3]);
        source.read(rect, &mut pixels)?;
        let data = block_bytes(&pixels, rect.width as usize, options.samples, &mut saturated);
        let index = BlockIndex {
            layer: 0,
            level: Vec2(0, 0),
            pixel_position: Vec2(rect.x as usize, rect.y as usize),
            pixel_size: Vec2(rect.width as usize, rect.height as usize),
        };
        let chunk = UncompressedBlock { index, data }.compress_to_chunk(std::slice::from_ref(&header));
        let offset = out.stream_position().map_err(ExrError::Write)? - start;
        table.extend_from_slice(&offset.to_le_bytes());
        chunk.and_then(|chunk| chunk.write(out, 1)).map_err(encode_error)?;
    }
    let mut finish = || {
        let end = out.stream_position()?;
        out.seek(SeekFrom::Start(start + head.len() as u64))?;
        out.write_all(&table)?;
        out.seek(SeekFrom::Start(end))?;
        out.flush()?;
        Ok(end - start)
    };
    Ok(ExrSummary { bytes: finish().map_err(ExrError::Write)?, saturated })
}

/// The blocks of the image, in the order in which they are written: increasing y, then x.
fn blocks(header: &Header, image: Rect) -> impl Iterator<Item = Rect> + Clone + use<> {
    let Vec2(width, height) = header.max_block_pixel_size();
    (0..image.height).step_by(height).flat_map(move |y| {
        (0..image.width)
            .step_by(width)
            .map(move |x| Rect::new(x, y, (width as u32).min(image.width - x), (height as u32).min(image.height - y)))
    })
}

/// The block's values as the format orders them: row by row, within a row channel by channel, by name.
fn block_bytes(pixels: &[[f32; 3]], width: usize, samples: ExrSamples, saturated: &mut u64) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(pixels.len() * 12);
    for row in pixels.chunks_exact(width) {
        for channel in [2, 1, 0] {
            let values = row.iter().map(|pixel| pixel[channel]);
            match samples {
                ExrSamples::Float => values.for_each(|v| bytes.extend_from_slice(&v.to_ne_bytes())),
                ExrSamples::Half => values.for_each(|v| bytes.extend_from_slice(&to_half(v, saturated).to_ne_bytes())),
            }
        }
    }
    bytes
}

/// Rounds to half; what would become infinite becomes +-65504 and is counted. NaN is the one quiet NaN, so that the file
/// does not depend on the processor.
fn to_half(value: f32, saturated: &mut u64) -> f16 {
    let half = f16::from_f32(value);
    if half.is_infinite() {
        *saturated += 1;
        f16::MAX.copysign(half)
    } else if half.is_nan() {
        f16::NAN
    } else {
        half
    }
}

fn header(image: Rect, options: &ExrOptions) -> Result<Header, ExrError> {
    let samples = match options.samples {
        ExrSamples::Float => SampleType::F32,
        ExrSamples::Half => SampleType::F16,
    };
    let compression = match options.compression {
        ExrCompression::None => Compression::Uncompressed,
        ExrCompression::Rle => Compression::RLE,
        ExrCompression::Zips => Compression::ZIP1,
        ExrCompression::Zip => Compression::ZIP16,
        ExrCompression::Piz => Compression::PIZ,
    };
    let layout = match options.layout {
        ExrLayout::Scanlines => BlockDescription::ScanLines,
        ExrLayout::Tiles(size) if TILE_SIZES.contains(&size) => BlockDescription::Tiles(TileDescription {
            tile_size: Vec2(size as usize, size as usize),
            level_mode: LevelMode::Singular,
            rounding_mode: RoundingMode::Down,
        }),
        ExrLayout::Tiles(size) => return Err(ExrError::TileSize(size)),
    };
    let channels = ["B", "G", "R"].map(|name| ChannelDescription::new(name, samples, false));
    let size = Vec2(image.width as usize, image.height as usize);
    let header = Header::new(Text::from("rgb"), size, channels.into_iter().collect());
    Ok(header.with_attributes(LayerAttributes::default()).with_encoding(compression, layout, LineOrder::Increasing))
}

/// Magic number, version and flags, attributes.
fn head_bytes(header: &Header, options: &ExrOptions) -> Result<Vec<u8>, ExrError> {
    const VERSION: u32 = 2;
    const TILED: u32 = 0x200;
    const LONG_NAMES: u32 = 0x400;
    let mut version = VERSION;
    if header.blocks.has_tiles() {
        version |= TILED;
    }
    let mut own = HashSet::new();
    for (name, _) in header.all_named_attributes() {
        own.insert(name.to_vec());
    }
    for name in options.attributes.keys() {
        if !(1..=255).contains(&name.len()) || name.contains('\0') || own.contains(name.as_bytes()) {
            return Err(ExrError::Attribute(name.clone()));
        }
        if name.len() > 31 {
            version |= LONG_NAMES;
        }
    }
    let mut head = magic_number::BYTES.to_vec();
    head.extend_from_slice(&version.to_le_bytes());
    header.write(&mut head).map_err(encode_error)?;
    head.pop(); // the end of the attributes, since ours follow
    for (name, value) in &options.attributes {
        let length = i32::try_from(value.len()).map_err(|_| ExrError::Attribute(name.clone()))?;
        head.extend_from_slice(name.as_bytes());
        head.extend_from_slice(b"\0string\0");
        head.extend_from_slice(&length.to_le_bytes());
        head.extend_from_slice(value.as_bytes());
    }
    head.push(0);
    Ok(head)
}

/// Reads R, G and B of an EXR file: those without a layer, else of the first layer (by name) that has all three. Half,
/// float and unsigned values; any compression but HTJ2K; scanlines or tiles, of which the finest level; the data window.
/// Alpha is ignored. More than `max_pixels` pixels are refused before memory is reserved for them.
pub fn read(path: &Path, max_pixels: u64) -> Result<RgbImage, ExrError> {
    let name = path.display().to_string();
    match std::fs::File::open(path) {
        Ok(file) => decode(BufReader::new(file), &name, max_pixels),
        Err(source) => Err(ExrError::Read { name, source }),
    }
}

/// As [`read`], from any buffered source; `name` is what errors call it.
pub fn decode(source: impl Read + Seek, name: &str, max_pixels: u64) -> Result<RgbImage, ExrError> {
    let invalid = |why: String| ExrError::Invalid { name: name.to_owned(), why };
    let failed = |error: LibraryError| match error {
        LibraryError::Io(source) => ExrError::Read { name: name.to_owned(), source },
        LibraryError::NotSupported(why) | LibraryError::Invalid(why) => invalid(why.into_owned()),
        LibraryError::Aborted => invalid("aborted".into()),
    };
    let reader = ::exr::block::read(source, false).map_err(failed)?;
    let found = reader.headers().iter().enumerate().find_map(|(layer, header)| {
        let channels = (!header.deep).then(|| rgb_channels(header))??;
        Some((layer, header.clone(), channels))
    });
    let (layer, header, channels) = found.ok_or_else(|| invalid("it has no channels R, G and B".into()))?;
    let Vec2(width, height) = header.layer_size;
    let pixels = width as u64 * height as u64;
    // A block is read before it is looked at, so its size counts too.
    let block = (header.max_block_byte_size() / header.channels.bytes_per_pixel.max(1)) as u64;
    if pixels > max_pixels || block > max_pixels.max(1 << 24) {
        return Err(ExrError::TooLarge { name: name.to_owned(), pixels: pixels.max(block), limit: max_pixels });
    }
    if header.channels.list.iter().any(|channel| channel.sampling != Vec2(1, 1)) {
        return Err(invalid("it has subsampled channels".into()));
    }
    let too_large = |_| ExrError::TooLarge { name: name.to_owned(), pixels, limit: max_pixels };
    let (width, height) = (u32::try_from(width).map_err(too_large)?, u32::try_from(height).map_err(too_large)?);

    let mut image = RgbImage { width, height, pixels: vec![[0.0; 3]; pixels as usize] };
    let mut seen = HashSet::new();
    let mut covered = 0;
    let wanted = reader.filter_chunks(true, |_, _, block| block.layer == layer && block.level == Vec2(0, 0));
    for block in wanted.map_err(failed)?.sequential_decompressor(false) {
        let block = block.map_err(failed)?;
        if !seen.insert((block.index.pixel_position.x(), block.index.pixel_position.y())) {
            return Err(invalid("it has a block twice".into()));
        }
        covered += block.index.pixel_size.area() as u64;
        for line in block.lines(&header.channels) {
            let Some(component) = channels.iter().position(|&channel| channel == line.location.channel) else {
                continue;
            };
            let Vec2(x, y) = line.location.position;
            let start = y * width as usize + x;
            let row = &mut image.pixels[start..start + line.location.sample_count];
            decode_line(line.value, header.channels.list[channels[component]].sample_type, |i, v| {
                row[i][component] = v
            });
        }
    }
    if covered != pixels {
        return Err(invalid(format!("{covered} of its {pixels} pixels are there")));
    }
    Ok(image)
}

/// Where R, G and B are in a header's channels.
fn rgb_channels(header: &Header) -> Option<[usize; 3]> {
    let names: Vec<String> = header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
    let find = |name: &str| names.iter().position(|other| other == name);
    let mut layers: Vec<&str> = names.iter().filter_map(|name| name.strip_suffix('R')).collect();
    layers.sort_by_key(|layer| (!layer.is_empty(), *layer));
    layers.iter().filter(|layer| layer.is_empty() || layer.ends_with('.')).find_map(|layer| {
        let [r, g, b] = ["R", "G", "B"].map(|c| find(&format!("{layer}{c}")));
        Some([r?, g?, b?])
    })
}

fn decode_line(bytes: &[u8], samples: SampleType, mut put: impl FnMut(usize, f32)) {
    match samples {
        SampleType::F16 => {
            (bytes.as_chunks().0.iter().enumerate()).for_each(|(i, bytes)| put(i, f16::from_ne_bytes(*bytes).to_f32()))
        }
        SampleType::F32 => {
            (bytes.as_chunks().0.iter().enumerate()).for_each(|(i, bytes)| put(i, f32::from_ne_bytes(*bytes)))
        }
        SampleType::U32 => {
            (bytes.as_chunks().0.iter().enumerate()).for_each(|(i, bytes)| put(i, u32::from_ne_bytes(*bytes) as f32));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_saturates_and_counts() {
        let mut saturated = 0;
        let mut half = |v| to_half(v, &mut saturated).to_f32();
        assert_eq!(half(65504.0), 65504.0);
        assert_eq!(half(65519.0), 65504.0);
        assert_eq!(half(65520.0), 65504.0);
        assert_eq!(half(-1e30), -65504.0);
        assert_eq!(half(f32::INFINITY), 65504.0);
        assert_eq!(half(-0.0).to_bits(), (-0.0f32).to_bits());
        assert_eq!(half(6e-8), 5.960_464_5e-8);
        assert!(half(f32::NAN).is_nan());
        assert_eq!(saturated, 3);
    }

    #[test]
    fn attributes_of_the_format_are_not_replaced() {
        let image = RgbImage { width: 1, height: 1, pixels: vec![[1.0; 3]] };
        for name in ["compression", "dataWindow", "channels", "", "a\0b", &"x".repeat(256)] {
            let options = ExrOptions { attributes: [(name.to_owned(), String::new())].into(), ..Default::default() };
            let error = encode(&image, &options, &mut io::Cursor::new(Vec::new())).unwrap_err();
            assert_eq!(error.code(), "exr-option", "{name}");
        }
    }

    #[test]
    fn tile_sizes_are_limited() {
        let image = RgbImage { width: 1, height: 1, pixels: vec![[1.0; 3]] };
        for (size, fine) in [(15, false), (16, true), (4096, true), (4097, false)] {
            let options = ExrOptions { layout: ExrLayout::Tiles(size), ..Default::default() };
            assert_eq!(encode(&image, &options, &mut io::Cursor::new(Vec::new())).is_ok(), fine, "{size}");
        }
    }
}
