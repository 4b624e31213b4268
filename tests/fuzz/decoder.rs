//! Tile streams.

use super::{ALLOCATIONS, alone, fuzz, mutate::Random, mutate::mutate, vectors};
use rpfd::{
    filter::{Channel, ChannelSet, Method, Rect, Role, SampleTile, TileGeometry, plan::plan},
    wire::{Assembler, Decoder, Event, Format, Header, SampleCounts, encode_header, encode_tile},
};

/// More than this a tile may not reserve here, as a service would refuse it.
const MEMORY: u64 = 1 << 20;

pub(super) const WORDS: &[&[u8]] = &[
    b"\xa7samples",
    b"\xa5total",
    b"\xa7varying",
    b"\xa4type",
    b"\xa4tile",
    b"\xa4halo",
    b"\xa5image",
    b"\xa8channels",
    b"\xa4name",
    b"\xa4role",
    b"\xa5color",
    b"\xa7feature",
    b"\xa6random",
    b"\xa4film",
    b"\xaacomponents",
    b"\xa6format",
    b"\xa3f16",
    b"\xa3f32",
    b"\xa3x-a",
    b"\xa5space",
    b"\xa8position",
    b"\xa7uniform",
    b"\xc2",
    b"\xc3",
    b"\xc4\x00",
    b"\xc5\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff",
    b"\xca\x7f\xc0\x00\x00",
];

/// A small tile that is right: any geometry, channels, counts and formats.
pub(super) fn tile(random: &mut Random) -> Vec<u8> {
    let mut side = || 1 + random.below(4) as u32;
    let (core, halo) = ([side(), side()], [0; 4].map(|_| side() - 1));
    let image = [core[0] + halo[0] + halo[2] + side(), core[1] + halo[1] + halo[3] + side()];
    let rect = Rect::new(halo[0], halo[1], core[0], core[1]);
    let geometry = TileGeometry::with_halo(image, rect, halo[0].min(halo[1])).unwrap();
    let mut channels = vec![Channel::new("color", Role::Color, 3)];
    for index in 0..random.below(4) {
        let role = match random.below(3) {
            0 => Role::Feature { position: random.one_in(2) },
            1 => Role::Random { uniform: random.one_in(2) },
            _ if index == 0 => Role::Film,
            _ => Role::Feature { position: false },
        };
        let components = if role == Role::Film { 2 } else { 1 + random.below(4) as u32 };
        channels.push(Channel::new(format!("c{index}"), role, components));
    }
    let channels = ChannelSet::new(channels).unwrap();
    let pixels = geometry.window().area();
    let (counts, list) = if random.one_in(3) {
        let list: Vec<u16> = (0..pixels).map(|_| random.below(4) as u16).collect();
        (SampleCounts::Varying { total: list.iter().map(|&n| u64::from(n)).sum() }, list)
    } else {
        (SampleCounts::Uniform(random.below(4) as u32), Vec::new())
    };
    let format = if random.one_in(2) { Format::F16 } else { Format::F32 };
    let header = Header::new(geometry, channels, counts, format).unwrap();
    let mut bytes = encode_header(&header);
    let bin = |bytes: &mut Vec<u8>, length: u64| {
        bytes.extend([0xc5, (length >> 8) as u8, length as u8]);
    };
    if header.varying() {
        bin(&mut bytes, 2 * pixels);
        list.iter().for_each(|count| bytes.extend(count.to_le_bytes()));
    }
    for plane in 0..header.channels().planes() {
        if random.one_in(3) {
            bytes.push(random.below(128) as u8);
        } else {
            let length = header.total() * header.plane_format(plane).bytes();
            bin(&mut bytes, length);
            (0..length).for_each(|_| bytes.push(random.next() as u8));
        }
    }
    bytes
}

/// What a stream comes to, in pieces of this size: what was reached, and all events and the error in words, hashed.
fn read(bytes: &[u8], piece: usize, again: bool) -> (&'static str, u64) {
    let before = ALLOCATIONS.current_usage() as u64;
    ALLOCATIONS.reset_peak_usage();
    let (mut decoder, mut open, mut reached) = (Decoder::new(), None, "nothing");
    let (mut largest, mut hash) = (0, 0xcbf2_9ce4_8422_2325_u64);
    let mut say = |what: &[u8]| what.iter().for_each(|&b| hash = (hash ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    let mut tiles = Vec::new();
    let (mut failed, mut counts) = (None, Vec::new());
    'stream: for mut chunk in bytes.chunks(piece) {
        loop {
            match decoder.next(&mut chunk) {
                Ok(None) => break,
                Ok(Some(Event::Header(header))) => {
                    reached = reached.max("of a header");
                    say(&encode_header(&header));
                    let planned = plan(&header.shape(), &Method::preset("unfiltered").unwrap());
                    let needed = planned.samples + planned.output;
                    open = (needed <= MEMORY).then(|| Assembler::new(&header));
                    largest = if open.is_some() { needed.max(largest) } else { largest };
                }
                Ok(Some(Event::TileEnd)) => {
                    reached = "the end of a tile";
                    say(b"end");
                    if let Some(open) = open.take() {
                        let header = open.header().clone();
                        // The counts were checked, so all fits.
                        let tile = open.finish().unwrap();
                        if again {
                            tiles.push((header, tile));
                        }
                    }
                }
                Ok(Some(event)) => {
                    // Whether counts add up shows at their end, before or after some of them have come out.
                    match &event {
                        Event::Counts(bytes) => counts.extend_from_slice(bytes),
                        _ => say(&std::mem::take(&mut counts)),
                    }
                    match &event {
                        Event::Values { bytes, .. } => say(bytes),
                        Event::Constant { plane, value } => say(format!("{plane} {}", value.to_bits()).as_bytes()),
                        Event::PlaneEnd { plane } => {
                            say(&[*plane as u8]);
                            reached = reached.max("of a plane");
                        }
                        _ => {}
                    }
                    if let Some(open) = &mut open {
                        open.push(&event);
                    }
                }
                Err(error) => {
                    assert_eq!(decoder.next(&mut &b"\x80"[..]), Err(error.clone()));
                    failed = Some(error);
                    break 'stream;
                }
            }
        }
    }
    if failed.is_none() {
        failed = decoder.finish().err();
    }
    if let Some(error) = &failed {
        // In words it may show what follows, as far as it has come.
        say(format!("{} {} {} {:?}", error.code(), error.offset, error.index, error.tile).as_bytes());
        assert!(error.to_string().len() < (1 << 17));
    }
    // A header is read from at most 64 KiB, into names and words.
    let peak = (ALLOCATIONS.peak_usage() as u64).saturating_sub(before);
    let header = 32 * bytes.len().min(1 << 16) as u64 + (16 << 10);
    let kept = if again { 16 * bytes.len() as u64 + MEMORY } else { 0 };
    assert!(peak <= largest + header + kept, "{peak} bytes at the peak, {largest} reserved, for {} bytes", bytes.len());
    for (header, tile) in tiles {
        // What was read, written, and read again stays the same. (But for the first time: a sample without a feature may
        // have a component of it, one that is constant, since the others say it.)
        let Some((_, tile)) = written(&header, &tile) else { continue };
        let (first, tile) = written(&header, &tile).unwrap();
        assert_eq!(written(&header, &tile).unwrap().0, first);
    }
    (reached, hash)
}

/// A tile as it is written, and what is read of that; none if the header's formats cannot hold it.
fn written(header: &Header, tile: &SampleTile) -> Option<(Vec<u8>, SampleTile)> {
    let mut bytes = Vec::new();
    encode_tile(header, tile, &mut bytes).ok()?;
    let (mut decoder, mut input, mut assembler) = (Decoder::new(), &bytes[..], Assembler::new(header));
    while let Some(event) = decoder.next(&mut input).unwrap() {
        assembler.push(&event);
    }
    Some((bytes, assembler.finish().unwrap()))
}

#[test]
fn tile_streams() {
    let alone = alone();
    let examples = vectors();
    let make = |random: &mut Random| {
        let mut bytes = if random.one_in(3) { random.pick(&examples).clone() } else { tile(random) };
        if random.one_in(8) {
            bytes.extend(tile(random));
        }
        if !random.one_in(10) {
            mutate(&mut bytes, random, &examples, WORDS);
        }
        bytes
    };
    let reached = fuzz(&alone, "decoder", 1, make, |bytes, random| {
        let (reached, whole) = read(bytes, usize::MAX, false);
        // Now and then: the same in pieces, and what comes of writing it again.
        if random.one_in(4) {
            let piece = 1 + random.below(40);
            assert_eq!(read(bytes, piece, random.one_in(4)), (reached, whole), "in pieces of {piece}");
        }
        reached
    });
    // Enough come far.
    let executions: u64 = reached.values().sum();
    assert!(reached["the end of a tile"] > executions / 10, "{reached:?}");
}
