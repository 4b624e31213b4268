//! Writes tiles.

use std::io::{self, Write};

use rmp::encode as pack;

use super::{Fault, Format, Header, SampleCounts, VERSION};
use crate::filter::{Plane, Role, SampleTile};

/// Writing into memory does not fail.
type Infallible<T> = Result<T, pack::ValueWriteError<io::Error>>;

/// The map of a header.
pub fn encode_header(header: &Header) -> Vec<u8> {
    let mut out = Vec::with_capacity(1024);
    let written = write_header(header, &mut out);
    debug_assert!(written.is_ok(), "a Vec takes all bytes");
    out
}

fn write_header(header: &Header, out: &mut Vec<u8>) -> Infallible<()> {
    let (geometry, channels) = (header.geometry(), header.channels().channels());
    let (image, core, halo) = (geometry.image(), geometry.core(), geometry.halo());
    pack::write_map_len(out, (8 + usize::from(header.varying()) + header.extra().len()) as u32)?;
    write_text(out, "type", "tile")?;
    pack::write_str(out, "version")?;
    pack::write_uint(out, u64::from(VERSION))?;
    write_numbers(out, "image", &[image.width, image.height])?;
    write_numbers(out, "tile", &[core.x, core.y, core.width, core.height])?;
    write_numbers(out, "halo", &[halo.left, halo.top, halo.right, halo.bottom])?;
    pack::write_str(out, "samples")?;
    match header.samples() {
        SampleCounts::Uniform(n) => {
            pack::write_uint(out, u64::from(n))?;
        }
        SampleCounts::Varying { total } => {
            pack::write_str(out, "varying")?;
            pack::write_str(out, "total")?;
            pack::write_uint(out, total)?;
        }
    }
    write_text(out, "format", header.format().name())?;
    pack::write_str(out, "channels")?;
    pack::write_array_len(out, channels.len() as u32)?;
    for (channel, own) in channels.iter().zip(&header.own) {
        let role = match channel.role {
            Role::Film => "film",
            Role::Color => "color",
            Role::Feature { .. } => "feature",
            Role::Random { .. } => "random",
        };
        let told = matches!(channel.role, Role::Feature { position: true } | Role::Random { uniform: false });
        let pairs = 3 + usize::from(told) + usize::from(own.format.is_some()) + own.extra.len();
        pack::write_map_len(out, pairs as u32)?;
        write_text(out, "name", &channel.name)?;
        write_text(out, "role", role)?;
        pack::write_str(out, "components")?;
        pack::write_uint(out, u64::from(channel.components))?;
        match channel.role {
            Role::Feature { position: true } => write_text(out, "space", "position")?,
            Role::Random { uniform: false } => {
                pack::write_str(out, "uniform")?;
                pack::write_bool(out, false).map_err(pack::ValueWriteError::InvalidMarkerWrite)?;
            }
            _ => {}
        }
        if let Some(format) = own.format {
            write_text(out, "format", format.name())?;
        }
        for extra in &own.extra {
            pack::write_str(out, &extra.key)?;
            out.extend_from_slice(&extra.value);
        }
    }
    for extra in header.extra() {
        pack::write_str(out, &extra.key)?;
        out.extend_from_slice(&extra.value);
    }
    Ok(())
}

fn write_text(out: &mut Vec<u8>, key: &str, value: &str) -> Infallible<()> {
    pack::write_str(out, key)?;
    pack::write_str(out, value)
}

fn write_numbers(out: &mut Vec<u8>, key: &str, values: &[u32]) -> Infallible<()> {
    pack::write_str(out, key)?;
    pack::write_array_len(out, values.len() as u32)?;
    values.iter().try_for_each(|&value| pack::write_uint(out, u64::from(value)).map(drop))
}

/// Writes a tile: the header, the counts if they vary, and the planes in the header's formats, those of equal values as
/// one number. Only a buffer of 64 KiB is kept. A header that does not fit the tile is [`io::ErrorKind::InvalidInput`].
pub fn encode_tile(header: &Header, tile: &SampleTile, out: &mut impl Write) -> io::Result<()> {
    let same = header.geometry() == tile.geometry()
        && header.channels() == tile.channels()
        && header.total() == tile.total() as u64
        && header.varying() == tile.varying();
    if !same {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the header is not of this tile"));
    }
    out.write_all(&encode_header(header))?;
    if header.varying() {
        let pixels = tile.geometry().window().area() as usize;
        write_bin_len(out, 2 * pixels as u64)?;
        let count = |pixel: usize| tile.samples_of(pixel).len() as u16;
        write_all(out, (0..pixels).map(count), |count, bytes| bytes.extend_from_slice(&count.to_le_bytes()))?;
    }
    for plane in 0..tile.channels().planes() {
        let format = header.plane_format(plane);
        match tile.plane(plane) {
            Plane::Constant(value) => write_constant(out, format, *value)?,
            Plane::Values(values) => write_values(out, format, values)?,
        }
    }
    Ok(())
}

/// A plane of equal values.
fn write_constant(out: &mut impl Write, format: Format, value: f32) -> io::Result<()> {
    pack::write_f32(out, format.round(super::value::Number::F32(value))).map_err(into_io)
}

/// A plane as a bin.
pub(super) fn write_values(out: &mut impl Write, format: Format, values: &[f32]) -> io::Result<()> {
    write_bin_len(out, format.bytes() * values.len() as u64)?;
    write_all(out, values.iter(), |&value, bytes| format.write(value, bytes))
}

fn write_bin_len(out: &mut impl Write, bytes: u64) -> io::Result<()> {
    let too_long = || io::Error::new(io::ErrorKind::InvalidInput, Fault::TooLarge(format!("a bin of {bytes} bytes")));
    let bytes = u32::try_from(bytes).map_err(|_| too_long())?;
    pack::write_bin_len(out, bytes).map(drop).map_err(into_io)
}

fn write_all<T>(
    out: &mut impl Write,
    mut values: impl Iterator<Item = T>,
    write: impl Fn(T, &mut Vec<u8>),
) -> io::Result<()> {
    const VALUES: usize = 16 << 10;
    let mut bytes = Vec::with_capacity(4 * VALUES);
    loop {
        values.by_ref().take(VALUES).for_each(|value| write(value, &mut bytes));
        if bytes.is_empty() {
            return Ok(());
        }
        out.write_all(&bytes)?;
        bytes.clear();
    }
}

fn into_io(error: pack::ValueWriteError<io::Error>) -> io::Error {
    match error {
        pack::ValueWriteError::InvalidMarkerWrite(error) | pack::ValueWriteError::InvalidDataWrite(error) => error,
    }
}
