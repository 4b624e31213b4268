//! The header of a tile: all that a reader must know before the first plane.

use super::{Fault, Format, encode_header, token};
use crate::filter::{
    Channel, ChannelSet, Role, SampleTile, TileGeometry,
    plan::Shape,
    samples::{MAX_SAMPLES, MAX_SAMPLES_PER_PIXEL, SampleError},
};

/// The version of the format that this module reads and writes.
pub const VERSION: u32 = 1;

/// Most bytes that the map of a header may have.
pub const MAX_HEADER: usize = 64 << 10;

/// Samples of the data window's pixels, as the header announces them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleCounts {
    /// The same number in each, 0 to [`MAX_SAMPLES_PER_PIXEL`].
    Uniform(u32),
    /// A number of its own for each, in a plane ahead of all others.
    Varying {
        /// The sum of these numbers.
        total: u64,
    },
}

/// A key starting with `x-`, which means nothing here and is carried along.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extra {
    /// The key, `x-` included.
    pub key: String,
    /// Its value: one whole MessagePack object.
    pub value: Vec<u8>,
}

/// What a channel has on the wire beyond its meaning.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Own {
    pub(super) format: Option<Format>,
    pub(super) extra: Vec<Extra>,
}

/// The header of a tile, checked: sizes taken from it are within all limits.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    geometry: TileGeometry,
    channels: ChannelSet,
    samples: SampleCounts,
    format: Format,
    pub(super) own: Vec<Own>,
    extra: Vec<Extra>,
}

impl Header {
    /// Checks and makes a header; planes are written in `format`, the film position always in f32.
    ///
    /// Refuses more than [`MAX_SAMPLES_PER_PIXEL`] samples in a pixel, more than [`MAX_SAMPLES`] in the tile, planes of
    /// more than 4 GiB (the most that a MessagePack `bin` can hold), and headers of more than [`MAX_HEADER`] bytes.
    pub fn new(
        geometry: TileGeometry,
        channels: ChannelSet,
        samples: SampleCounts,
        format: Format,
    ) -> Result<Self, Fault> {
        let own = vec![Own::default(); channels.channels().len()];
        Self::checked(geometry, channels, samples, format, own, Vec::new())
    }

    pub(super) fn checked(
        geometry: TileGeometry,
        channels: ChannelSet,
        samples: SampleCounts,
        format: Format,
        own: Vec<Own>,
        extra: Vec<Extra>,
    ) -> Result<Self, Fault> {
        let pixels = geometry.window().area();
        let total = match samples {
            SampleCounts::Uniform(n) if n > MAX_SAMPLES_PER_PIXEL => return Err(SampleError::PerPixel(n).into()),
            SampleCounts::Uniform(n) => pixels.checked_mul(u64::from(n)).ok_or(SampleError::TooMany(u64::MAX))?,
            SampleCounts::Varying { total } => {
                let most = pixels.saturating_mul(u64::from(MAX_SAMPLES_PER_PIXEL));
                if total > most {
                    let why = format!("\"total\" is {total}: {pixels} pixels can have {most} samples at most");
                    return Err(Fault::Counts(why));
                }
                total
            }
        };
        if total > MAX_SAMPLES || pixels > MAX_SAMPLES {
            return Err(SampleError::TooMany(total.max(pixels)).into());
        }
        let header = Self { geometry, channels, samples, format, own, extra };
        let counts = if header.varying() { 2 * pixels } else { 0 };
        let longest = (0..header.channels.planes()).map(|plane| header.plane_bytes(plane)).max().unwrap_or(0);
        let longest = longest.max(counts);
        if longest > u64::from(u32::MAX) {
            return Err(Fault::TooLarge(format!(
                "a plane of {longest} bytes: a MessagePack bin holds {} at most; send smaller tiles",
                u32::MAX
            )));
        }
        if encode_header(&header).len() > MAX_HEADER {
            return Err(Fault::HeaderTooLarge { limit: MAX_HEADER as u64 });
        }
        Ok(header)
    }

    /// A header for this tile, all of it in one format.
    pub fn of(tile: &SampleTile, format: Format) -> Result<Self, Fault> {
        let total = tile.total() as u64;
        let samples =
            if tile.varying() { SampleCounts::Varying { total } } else { SampleCounts::Uniform(tile.max_per_pixel()) };
        Self::new(*tile.geometry(), tile.channels().clone(), samples, format)
    }

    /// With a format of its own for the channel of this name.
    pub fn with_channel_format(mut self, name: &str, format: Format) -> Result<Self, Fault> {
        let Some(index) = self.channels.channels().iter().position(|c| c.name == name) else {
            let what = "the channel with a format of its own".to_owned();
            let right = "it must be one of the tile's channels".to_owned();
            return Err(Fault::WrongValue { what, found: format!("{name:?}"), right });
        };
        check_film(&self.channels.channels()[index], Some(format))?;
        self.own[index].format = Some(format);
        let Self { geometry, channels, samples, format, own, extra } = self;
        Self::checked(geometry, channels, samples, format, own, extra)
    }

    /// With a key of the writer's own, which must start with `x-`, and its value, which must be one MessagePack object.
    pub fn with_extra(mut self, key: impl Into<String>, value: Vec<u8>) -> Result<Self, Fault> {
        let key = key.into();
        if !key.starts_with("x-") {
            return Err(Fault::UnknownKey { key, known: KEYS.join(", ") });
        }
        if self.extra.iter().any(|e| e.key == key) {
            return Err(Fault::DuplicateKey(key));
        }
        if token::object_len(&value) != Some(value.len()) {
            return Err(Fault::Malformed(format!("the value of {key:?} is not one MessagePack object")));
        }
        self.extra.push(Extra { key, value });
        let Self { geometry, channels, samples, format, own, extra } = self;
        Self::checked(geometry, channels, samples, format, own, extra)
    }

    /// Where the tile lies.
    pub const fn geometry(&self) -> &TileGeometry {
        &self.geometry
    }

    /// Its channels, in the order of the planes.
    pub const fn channels(&self) -> &ChannelSet {
        &self.channels
    }

    /// Its samples.
    pub const fn samples(&self) -> SampleCounts {
        self.samples
    }

    /// The format of all channels without one of their own.
    pub const fn format(&self) -> Format {
        self.format
    }

    /// Keys of the writer's own.
    pub fn extra(&self) -> &[Extra] {
        &self.extra
    }

    /// Whether a plane of sample counts comes ahead of all others.
    pub const fn varying(&self) -> bool {
        matches!(self.samples, SampleCounts::Varying { .. })
    }

    /// Samples in the data window, up to [`MAX_SAMPLES`].
    pub const fn total(&self) -> u64 {
        match self.samples {
            SampleCounts::Uniform(n) => n as u64 * self.geometry.window().area(),
            SampleCounts::Varying { total } => total,
        }
    }

    /// Most samples that any pixel can have: with varying counts a bound that knows only their sum.
    pub fn max_per_pixel(&self) -> u32 {
        match self.samples {
            SampleCounts::Uniform(n) => n,
            SampleCounts::Varying { total } => total.min(u64::from(MAX_SAMPLES_PER_PIXEL)) as u32,
        }
    }

    /// How the values of a plane are written; `plane` is below [`ChannelSet::planes`].
    pub fn plane_format(&self, plane: usize) -> Format {
        let mut end = 0;
        for (channel, own) in self.channels.channels().iter().zip(&self.own) {
            end += channel.components as usize;
            if plane < end {
                return if channel.role == Role::Film { Format::F32 } else { own.format.unwrap_or(self.format) };
            }
        }
        self.format
    }

    /// Bytes of a plane when it is spelt out.
    pub fn plane_bytes(&self, plane: usize) -> u64 {
        // MAX_SAMPLES * 4 is far below 2^64.
        self.total() * self.plane_format(plane).bytes()
    }

    /// Most bytes that the tile can have on the wire, header included.
    pub fn wire_bytes(&self) -> u64 {
        let planes: u64 = (0..self.channels.planes()).map(|plane| 5 + self.plane_bytes(plane)).sum();
        let counts = if self.varying() { 5 + 2 * self.geometry.window().area() } else { 0 };
        MAX_HEADER as u64 + counts + planes
    }

    /// The shape by which [`plan`](crate::filter::plan::plan) says what the tile will cost.
    pub fn shape(&self) -> Shape<'_> {
        Shape {
            geometry: &self.geometry,
            channels: &self.channels,
            samples: self.total(),
            max_per_pixel: self.max_per_pixel(),
            varying: self.varying(),
        }
    }
}

/// A film position in f16 would be off by whole pixels.
pub(super) fn check_film(channel: &Channel, format: Option<Format>) -> Result<(), Fault> {
    if channel.role == Role::Film && format == Some(Format::F16) {
        let what = format!("\"format\" of channel {:?}", channel.name);
        let right = "a film position is always f32".to_owned();
        return Err(Fault::WrongValue { what, found: "\"f16\"".to_owned(), right });
    }
    Ok(())
}

/// Every key of a header that means something.
pub(super) const KEYS: [&str; 9] =
    ["type", "version", "image", "tile", "halo", "samples", "total", "format", "channels"];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Halo, Rect};

    fn geometry(width: u32, height: u32) -> TileGeometry {
        TileGeometry::new([width, height], Rect::new(0, 0, width, height), Halo::default()).unwrap()
    }

    fn color() -> ChannelSet {
        ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap()
    }

    fn code(width: u32, height: u32, samples: SampleCounts, format: Format) -> &'static str {
        Header::new(geometry(width, height), color(), samples, format).map_or_else(|f| f.code(), |_| "ok")
    }

    #[test]
    fn limits_are_exact() {
        use SampleCounts::{Uniform, Varying};
        assert_eq!(code(1, 1, Uniform(65535), Format::F32), "ok");
        assert_eq!(code(1, 1, Uniform(65536), Format::F32), "too_large");
        assert_eq!(code(2, 1, Varying { total: 2 * 65535 }, Format::F32), "ok");
        assert_eq!(code(2, 1, Varying { total: 2 * 65535 + 1 }, Format::F32), "bad_counts");
        // A bin holds 2^32 - 1 bytes: 2^30 - 1 values of f32, 2^31 - 1 of f16.
        assert_eq!(code(1 << 20, 1 << 10, Uniform(1), Format::F32), "too_large");
        assert_eq!(code((1 << 20) - 1, 1 << 10, Uniform(1), Format::F32), "ok");
        assert_eq!(code(1 << 20, 1 << 10, Uniform(1), Format::F16), "ok");
        assert_eq!(code(1 << 20, 1 << 11, Uniform(1), Format::F16), "too_large");
        assert_eq!(code(1 << 20, 1 << 11, Uniform(0), Format::F16), "ok");
        assert_eq!(code(1 << 20, 1 << 12, Uniform(0), Format::F16), "too_large");
        assert_eq!(code(1 << 20, 1 << 11, Varying { total: 0 }, Format::F16), "too_large");
    }

    #[test]
    fn header_size_is_limited() {
        let header = Header::new(geometry(1, 1), color(), SampleCounts::Uniform(1), Format::F32).unwrap();
        let bin = |n: usize| [&[0xc5, (n >> 8) as u8, n as u8][..], &vec![0; n]].concat();
        let room = MAX_HEADER - encode_header(&header).len() - 4 - 3;
        let full = header.clone().with_extra("x-a", bin(room)).unwrap();
        assert_eq!(encode_header(&full).len(), MAX_HEADER);
        assert_eq!(header.clone().with_extra("x-a", bin(room + 1)).unwrap_err().code(), "header_too_large");
        assert_eq!(header.clone().with_extra("x-a", vec![]).unwrap_err().code(), "malformed");
        assert_eq!(header.with_extra("y", vec![0xc0]).unwrap_err().code(), "unknown_key");
    }
}
