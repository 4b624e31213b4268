//! What is written is read back, in pieces of any size, and nothing else.

use super::*;
use rpfd::wire::{SampleCounts, encode_header};

fn geometry() -> TileGeometry {
    TileGeometry::new([20, 10], Rect::new(3, 2, 5, 4), Halo { left: 3, top: 1, right: 2, bottom: 0 }).unwrap()
}

#[test]
fn tiles_come_back() {
    for varying in [false, true] {
        for format in [Format::F32, Format::F16] {
            let tile = tile_of(geometry(), varying, 1);
            let bytes = encode(&tile, format);
            let back = assemble(&bytes);
            assert_same(&tile, &back);
            assert_eq!(back.plane(7), &Plane::Constant(0.25));
            assert_eq!(back.varying(), varying);
            assert_eq!(encode(&back, format), bytes);
            let header = Header::of(&tile, format).unwrap();
            assert!(header.wire_bytes() >= bytes.len() as u64);
        }
    }
}

#[test]
fn no_samples_come_back() {
    for counts in [Counts::Uniform(0), Counts::Varying(vec![0; 70])] {
        let planes = vec![Plane::Values(Vec::new()); channels().planes()];
        let tile = SampleTile::new(
            TileGeometry::new([10, 7], Rect::new(0, 0, 10, 7), Halo::default()).unwrap(),
            channels(),
            counts,
            planes,
        )
        .unwrap();
        assert_same(&tile, &assemble(&encode(&tile, Format::F16)));
    }
}

#[test]
fn most_samples_in_a_pixel() {
    let one = TileGeometry::new([1, 1], Rect::new(0, 0, 1, 1), Halo::default()).unwrap();
    let color = || ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let tile = |n: u32| {
        let plane = || Plane::Values((0..n).map(|i| i as f32).collect());
        SampleTile::new(one, color(), Counts::Uniform(n), vec![plane(), plane(), plane()])
    };
    let most = tile(MAX_SAMPLES_PER_PIXEL).unwrap();
    assert_same(&most, &assemble(&encode(&most, Format::F32)));
    assert_eq!(tile(MAX_SAMPLES_PER_PIXEL + 1).unwrap_err(), SampleError::PerPixel(65536));
}

#[test]
fn headers_come_back_with_what_they_carry() {
    let samples = SampleCounts::Varying { total: 12 };
    let header = Header::new(geometry(), channels(), samples, Format::F16).unwrap();
    let header = header.with_channel_format("color", Format::F32).unwrap();
    let header = header.with_extra("x-a", b"\x91\x91\xc0".to_vec()).unwrap();
    let header = header.with_extra("x-", b"\xa1z".to_vec()).unwrap();
    let mut bytes: &[u8] = &encode_header(&header);
    let Some(Event::Header(back)) = Decoder::new().next(&mut bytes).unwrap() else { panic!() };
    assert_eq!(back, header);
    let formats: Vec<_> = (0..9).map(|plane| back.plane_format(plane).name()).collect();
    assert_eq!(formats, ["f32", "f32", "f32", "f32", "f32", "f16", "f16", "f16", "f16"]);
    let code = |result: Result<Header, rpfd::wire::Fault>| result.unwrap_err().code();
    assert_eq!(code(header.clone().with_channel_format("film", Format::F16)), "wrong_value");
    assert_eq!(code(header.clone().with_channel_format("nothing", Format::F16)), "wrong_value");
    assert_eq!(code(header.clone().with_extra("x-a", vec![0xc0])), "duplicate_key");
    assert_eq!(code(header.with_extra("x-b", vec![0xc0, 0xc0])), "malformed");
}

#[test]
fn a_header_of_another_tile_is_refused() {
    let (tile, other) = (tile_of(geometry(), false, 1), tile_of(geometry(), true, 1));
    let header = Header::of(&tile, Format::F32).unwrap();
    let error = encode_tile(&header, &other, &mut Vec::new()).unwrap_err();
    assert_eq!(error.kind(), std::io::ErrorKind::InvalidInput);
}

/// A stream of two tiles, in equal pieces, in pieces of random sizes, and cut off anywhere.
#[test]
fn every_chunking_gives_the_same_tiles() {
    let mut random = Random(5);
    let stream =
        [encode(&tile_of(geometry(), true, 1), Format::F16), encode(&tile_of(geometry(), false, 2), Format::F32)];
    let stream = stream.concat();
    let show = |result: Result<Vec<Raw>, WireError>| match result {
        Ok(tiles) => format!("{tiles:?}"),
        Err(error) => error.code().to_owned(),
    };
    let whole = show(read_raw(&stream, || usize::MAX));
    assert!(whole.starts_with('['));
    for piece in [1, 2, 3, 5, 8, 64, 1000] {
        assert_eq!(show(read_raw(&stream, || piece)), whole);
    }
    for _ in 0..200 {
        let most = 1 + random.below(200);
        assert_eq!(show(read_raw(&stream, || 1 + random.below(most) as usize)), whole);
    }
    // Cut anywhere, it is truncated, and says so; the same however it came.
    for end in 1..stream.len() {
        let complete = end == encode(&tile_of(geometry(), true, 1), Format::F16).len();
        let expected = if complete { "ok" } else { "truncated" };
        let result = read_raw(&stream[..end], || 1 + random.below(99) as usize);
        assert_eq!(result.map_or_else(|error| error.code(), |_| "ok"), expected, "cut at {end}");
    }
}

/// A byte changed anywhere never breaks a promise: the same answer in one piece and byte by byte, and no panic.
#[test]
fn damaged_streams_give_the_same_answer_in_any_pieces() {
    let mut random = Random(11);
    let small =
        TileGeometry::new([4, 4], Rect::new(1, 1, 2, 2), Halo { left: 1, top: 0, right: 0, bottom: 1 }).unwrap();
    let stream = encode(&tile_of(small, true, 3), Format::F16);
    let answer = |bytes: &[u8], piece: usize| match read_raw(bytes, || piece) {
        Ok(tiles) => format!("{:?}", tiles.iter().map(|t| (&t.header, &t.counts, t.planes.len())).collect::<Vec<_>>()),
        Err(error) => error.code().to_owned(),
    };
    for _ in 0..20_000 {
        let mut bad = stream.clone();
        for _ in 0..1 + random.below(3) {
            let at = random.below(bad.len() as u32) as usize;
            bad[at] = random.below(256) as u8;
        }
        assert_eq!(answer(&bad, usize::MAX), answer(&bad, 1), "{bad:x?}");
    }
}

#[test]
fn errors_say_where() {
    let tile = tile_of(geometry(), false, 1);
    let stream = encode(&tile, Format::F32);
    let two = [&stream[..], &stream[..stream.len() - 10]].concat();
    let error = read_raw(&two, || 77).unwrap_err();
    assert_eq!((error.index, error.offset, error.tile), (1, two.len() as u64, Some(Rect::new(3, 2, 5, 4))));
    let text = error.to_string();
    assert!(text.contains("plane angle") && text.contains("10 bytes of it and 0 of 9 planes are missing"), "{text}");
    // The first error stays.
    let mut decoder = Decoder::new();
    let first = decoder.next(&mut &b"\x01"[..]).unwrap_err();
    assert_eq!(decoder.next(&mut &stream[..]).unwrap_err(), first);
    assert_eq!(decoder.finish().unwrap_err(), first);
}
