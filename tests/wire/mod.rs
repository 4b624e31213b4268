//! The wire format and what is built on it: codec, example messages, files, the spool, and other people's clients.

mod codec;
mod files;
pub(crate) mod interop;
mod spool;
mod vectors;

use rpfd::{
    filter::{
        Channel, ChannelSet, Counts, Halo, Plane, Rect, Role, SampleTile, TileGeometry,
        samples::{MAX_SAMPLES_PER_PIXEL, SampleError},
    },
    wire::{
        Assembler, Decoder, Event, Format, Header, WireError, encode_tile,
        value::{CountReader, ValueReader},
    },
};

/// A small generator.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn below(&mut self, n: u32) -> u32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) % u64::from(n)) as u32
    }

    /// A number of few bits, which f16 can hold.
    pub(crate) fn value(&mut self) -> f32 {
        (self.below(2048) as f32 - 1024.0) / 64.0
    }
}

/// Channels of every role, 9 planes.
pub(crate) fn channels() -> ChannelSet {
    ChannelSet::new(vec![
        Channel::new("film", Role::Film, 2),
        Channel::new("color", Role::Color, 3),
        Channel::new("P", Role::Feature { position: true }, 2),
        Channel::new("time", Role::Random { uniform: true }, 1),
        Channel::new("angle", Role::Random { uniform: false }, 1),
    ])
    .unwrap()
}

/// A tile of random values, a function of the place in the image and the seed; some planes are constant, some pixels
/// have no samples if they vary, some features are missing.
pub(crate) fn tile_of(geometry: TileGeometry, varying: bool, seed: u64) -> SampleTile {
    let (window, channels) = (geometry.window(), channels());
    let at = |x: u32, y: u32| Random(seed ^ u64::from(y) << 32 ^ u64::from(x) << 8);
    let (mut counts, mut planes) = (Vec::new(), vec![Vec::new(); channels.planes()]);
    for y in window.y..window.bottom() {
        for x in window.x..window.right() {
            let mut random = at(x, y);
            random.below(2);
            let n = if varying { random.below(5) } else { 3 };
            counts.push(n as u16);
            for _ in 0..n {
                for (plane, values) in planes.iter_mut().enumerate() {
                    values.push(match plane {
                        5 if random.below(7) == 0 => f32::NAN,
                        _ => random.value(),
                    });
                }
            }
        }
    }
    let counts = if varying { Counts::Varying(counts) } else { Counts::Uniform(3) };
    let mut planes: Vec<_> = planes.into_iter().map(Plane::Values).collect();
    planes[7] = Plane::Constant(0.25);
    SampleTile::new(geometry, channels, counts, planes).unwrap()
}

pub(crate) fn encode(tile: &SampleTile, format: Format) -> Vec<u8> {
    let mut out = Vec::new();
    encode_tile(&Header::of(tile, format).unwrap(), tile, &mut out).unwrap();
    out
}

/// All that a tile holds, NaN equal to NaN.
pub(crate) fn assert_same(a: &SampleTile, b: &SampleTile) {
    assert_eq!(a.geometry(), b.geometry());
    assert_eq!(a.channels(), b.channels());
    assert_eq!(a.total(), b.total());
    let pixels = a.geometry().window().area() as usize;
    assert!((0..pixels).all(|pixel| a.samples_of(pixel) == b.samples_of(pixel)));
    for plane in 0..a.channels().planes() {
        for sample in 0..a.total() {
            let (x, y) = (a.value(plane, sample), b.value(plane, sample));
            assert!(x == y || x.is_nan() && y.is_nan(), "plane {plane}, sample {sample}: {x} and {y}");
        }
    }
}

/// A tile as it is on the wire, before anything is replaced.
#[derive(Debug, Default)]
pub(crate) struct Raw {
    pub(crate) header: Option<Header>,
    pub(crate) counts: Vec<u16>,
    pub(crate) planes: Vec<Vec<f32>>,
}

/// Reads a whole stream, cut into pieces by `piece`.
pub(crate) fn read_raw(bytes: &[u8], mut piece: impl FnMut() -> usize) -> Result<Vec<Raw>, WireError> {
    let (mut decoder, mut tiles) = (Decoder::new(), Vec::<Raw>::new());
    let (mut counts, mut values) = (CountReader::default(), None);
    let mut rest = bytes;
    while !rest.is_empty() {
        let (mut input, after) = rest.split_at(piece().min(rest.len()));
        rest = after;
        while let Some(event) = decoder.next(&mut input)? {
            if let Event::Header(header) = event {
                tiles.push(Raw { header: Some(header), ..Raw::default() });
                continue;
            }
            let tile = tiles.last_mut().unwrap();
            let header = tile.header.as_ref().unwrap();
            match event {
                Event::Counts(bytes) => counts.push(bytes, |n| tile.counts.push(n)),
                Event::Constant { plane, value } => {
                    assert_eq!(plane, tile.planes.len());
                    tile.planes.push(vec![value; header.total() as usize]);
                }
                Event::Values { plane, bytes } => {
                    assert!(!bytes.is_empty());
                    assert_eq!(plane, tile.planes.len());
                    let (reader, list) =
                        values.get_or_insert_with(|| (ValueReader::new(header.plane_format(plane)), Vec::new()));
                    reader.push(bytes, |piece| list.extend_from_slice(piece));
                }
                Event::PlaneEnd { plane } => {
                    assert_eq!(plane, tile.planes.len());
                    tile.planes.push(values.take().map_or_else(Vec::new, |(_, list)| list));
                }
                Event::TileEnd => assert_eq!(tile.planes.len(), header.channels().planes()),
                Event::Header(_) => unreachable!(),
            }
        }
        assert!(input.is_empty(), "a decoder that wants more has taken all");
    }
    decoder.finish()?;
    Ok(tiles)
}

/// Reads a stream of one tile.
pub(crate) fn assemble(bytes: &[u8]) -> SampleTile {
    let (mut decoder, mut assembler, mut input) = (Decoder::new(), None, bytes);
    while let Some(event) = decoder.next(&mut input).unwrap() {
        match &event {
            Event::Header(header) => assembler = Some(Assembler::new(header)),
            event => assembler.as_mut().unwrap().push(event),
        }
    }
    decoder.finish().unwrap();
    assembler.unwrap().finish().unwrap()
}
