//! Tiles cut from the spool are those that were never taken apart.

use super::*;
use rpfd::{
    filter::geometry::tiling,
    store::{Spool, SpoolError},
    wire::{
        file::{TileFile, TileWriter},
        scan::scan,
    },
};

const IMAGE: [u32; 2] = [33, 21];

fn feed(spool: &mut Spool, bytes: &[u8], piece: usize) -> Result<(), SpoolError> {
    let mut decoder = Decoder::new();
    for mut chunk in bytes.chunks(piece) {
        while let Some(event) = decoder.next(&mut chunk).unwrap() {
            spool.push(&event)?;
        }
    }
    Ok(())
}

fn geometry(core: Rect, halo: u32) -> TileGeometry {
    TileGeometry::with_halo(IMAGE, core, halo).unwrap()
}

/// Cores of different sizes and halos, formats, and counts.
fn stream(size: u32, halo: u32, varying: impl Fn(usize) -> bool) -> Vec<u8> {
    let tiles = tiling(IMAGE, size).enumerate().map(|(i, core)| {
        let format = if i % 3 == 0 { Format::F16 } else { Format::F32 };
        encode(&tile_of(geometry(core, halo), varying(i), 4), format)
    });
    tiles.collect::<Vec<_>>().concat()
}

#[test]
fn any_tile_can_be_cut_from_any_tiles() {
    let folder = tempfile::tempdir().unwrap();
    for varying in [false, true] {
        for (size, halo) in [(64, 0), (10, 0), (10, 7), (1, 0), (16, 3)] {
            for disk in [false, true] {
                let mut spool =
                    if disk { Spool::on_disk(folder.path(), 1 << 20).unwrap() } else { Spool::in_memory(1 << 20) };
                feed(&mut spool, &stream(size, halo, |_| varying), 1000).unwrap();
                assert_eq!(spool.missing(&Rect::new(0, 0, 33, 21)), []);
                for core in [Rect::new(0, 0, 33, 21), Rect::new(9, 5, 6, 11), Rect::new(32, 20, 1, 1)] {
                    for halo in [0, 4, 99] {
                        let wanted = tile_of(geometry(core, halo), varying, 4);
                        let cut = spool.cut(*wanted.geometry()).unwrap();
                        assert_same(&cut, &wanted);
                        assert_eq!(cut.plane(7), &Plane::Constant(0.25));
                        assert_eq!(cut.varying(), varying);
                    }
                }
            }
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the file has no name");
}

#[test]
fn pieces_of_any_size_give_the_same_spool() {
    let bytes = stream(13, 2, |i| i % 2 == 0);
    let whole = geometry(Rect::new(0, 0, 33, 21), 0);
    let cut = |piece: usize| {
        let mut spool = Spool::in_memory(1 << 20);
        feed(&mut spool, &bytes, piece).unwrap();
        spool.cut(whole).unwrap()
    };
    let first = cut(usize::MAX);
    assert!(first.varying(), "some tiles vary, so their image does");
    for piece in [1, 3, 50] {
        assert_same(&cut(piece), &first);
    }
}

#[test]
fn constants_that_differ_are_spelt_out() {
    let color = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let tile = |x: u32, value: f32| {
        let geometry = TileGeometry::new([4, 1], Rect::new(x, 0, 2, 1), Halo::default()).unwrap();
        let planes = vec![Plane::Constant(value), Plane::Constant(1.0), Plane::Values(vec![x as f32, 2.0, 3.0, 4.0])];
        SampleTile::new(geometry, color.clone(), Counts::Uniform(2), planes).unwrap()
    };
    let mut spool = Spool::in_memory(16);
    feed(&mut spool, &encode(&tile(0, 1.5), Format::F16), 9).unwrap();
    feed(&mut spool, &encode(&tile(2, 2.5), Format::F16), 9).unwrap();
    assert_eq!(spool.bytes(), 16);
    let cut = spool.cut(TileGeometry::new([4, 1], Rect::new(1, 0, 2, 1), Halo::default()).unwrap()).unwrap();
    assert_eq!(cut.plane(0), &Plane::Values(vec![1.5, 1.5, 2.5, 2.5]));
    assert_eq!(cut.plane(1), &Plane::Constant(1.0));
    assert_eq!(cut.plane(2), &Plane::Values(vec![3.0, 4.0, 2.0, 2.0]));
}

#[test]
fn what_does_not_fit_is_refused_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let a = encode(&tile_of(geometry(Rect::new(0, 0, 16, 16), 2), true, 4), Format::F32);
    let b = encode(&tile_of(geometry(Rect::new(16, 0, 16, 16), 2), true, 4), Format::F32);
    let over = encode(&tile_of(geometry(Rect::new(15, 15, 4, 4), 0), true, 4), Format::F32);
    let used = |bytes: &[u8]| {
        let mut spool = Spool::in_memory(1 << 20);
        feed(&mut spool, bytes, 100).unwrap();
        spool.bytes()
    };
    let both = used(&a) + used(&b);
    for limit in [both, both - 1] {
        for mut spool in [Spool::in_memory(limit), Spool::on_disk(folder.path(), limit).unwrap()] {
            feed(&mut spool, &a, 100).unwrap();
            assert_eq!(feed(&mut spool, &a, 100).unwrap_err().code(), "overlap");
            let error = feed(&mut spool, &over, 100).unwrap_err();
            assert!(matches!(error, SpoolError::Overlap { .. }), "{error}");
            // A stream that breaks off leaves nothing either.
            feed(&mut spool, &b[..b.len() / 2], 100).unwrap();
            spool.discard();
            assert_eq!(spool.bytes(), used(&a));
            let result = feed(&mut spool, &b, 100);
            if limit == both {
                result.unwrap();
                let core = Rect::new(4, 3, 20, 9);
                assert_same(&spool.cut(geometry(core, 1)).unwrap(), &tile_of(geometry(core, 1), true, 4));
            } else {
                assert_eq!(result.unwrap_err().code(), "spool_full");
                assert_eq!(spool.tiles().collect::<Vec<_>>(), [Rect::new(0, 0, 16, 16)]);
            }
        }
    }
}

#[test]
fn missing_pixels_are_listed() {
    let mut spool = Spool::in_memory(1 << 20);
    let core = Rect::new(8, 8, 8, 8);
    assert_eq!(spool.cut(geometry(core, 0)).unwrap_err().code(), "missing");
    feed(&mut spool, &encode(&tile_of(geometry(core, 4), false, 4), Format::F32), 99).unwrap();
    spool.cut(geometry(core, 0)).unwrap();
    let error = spool.cut(geometry(Rect::new(8, 8, 9, 8), 0)).unwrap_err();
    assert!(error.to_string().contains("[16, 8, 1, 8]"), "{error}");
    let other = TileGeometry::new([50, 50], core, Halo::default()).unwrap();
    assert_eq!(spool.cut(other).unwrap_err().code(), "disagreement");
    let there = TileGeometry::new([50, 50], Rect::new(0, 0, 2, 2), Halo::default()).unwrap();
    let error = feed(&mut spool, &encode(&tile_of(there, false, 4), Format::F32), 99).unwrap_err();
    assert_eq!(error.code(), "disagreement");
}

#[test]
fn a_scan_says_how_large_a_spool_will_be() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tiles.zst");
    let mut out = TileWriter::create(&path).unwrap();
    std::io::Write::write_all(&mut out, &stream(10, 5, |i| i % 2 == 0)).unwrap();
    out.finish().unwrap();
    let summary = scan(&path).unwrap();
    let mut spool = Spool::in_memory(summary.spool_bytes);
    let mut file = TileFile::open(&path).unwrap();
    while let Some(event) = file.next_event().unwrap() {
        spool.push(&event).unwrap();
    }
    assert_eq!(spool.bytes(), summary.spool_bytes);
    assert!(summary.varying);
}
