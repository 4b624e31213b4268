//! Files of tiles: written whole or not at all, read compressed or not, looked through.

use super::*;
use rpfd::{
    filter::geometry::tiling,
    wire::{
        file::{TileFile, TileWriter},
        scan::scan,
    },
};
use std::path::Path;

fn write(path: &Path, tiles: &[SampleTile], format: Format) {
    let mut out = TileWriter::create(path).unwrap();
    for tile in tiles {
        out.write_tile(&Header::of(tile, format).unwrap(), tile).unwrap();
    }
    assert!(!path.exists(), "it appears when it is finished");
    out.finish().unwrap();
}

fn tiles(halo: u32, varying: bool) -> Vec<SampleTile> {
    let geometry = |core| TileGeometry::with_halo([30, 20], core, halo).unwrap();
    tiling([30, 20], 8).map(|core| tile_of(geometry(core), varying, 1)).collect()
}

#[test]
fn plain_and_compressed_files_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let tiles = tiles(3, true);
    let (plain, small) = (folder.path().join("a.tiles"), folder.path().join("a.tiles.zst"));
    write(&plain, &tiles, Format::F16);
    write(&small, &tiles, Format::F16);
    // Compression is told by the bytes, not by the name.
    let renamed = folder.path().join("b.tiles");
    std::fs::copy(&small, &renamed).unwrap();
    for (path, compressed) in [(&plain, false), (&small, true), (&renamed, true)] {
        let mut file = TileFile::open(path).unwrap();
        assert_eq!(file.compressed(), compressed);
        for tile in &tiles {
            assert_same(tile, &file.next_tile().unwrap().unwrap().1);
        }
        assert!(file.next_tile().unwrap().is_none());
        let mut file = TileFile::open(path).unwrap();
        let mut headers = 0;
        while file.next_header().unwrap().is_some() {
            headers += 1;
        }
        assert_eq!(headers, tiles.len());
    }
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(names.len(), 3, "nothing else is left");
}

#[test]
fn an_unfinished_file_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tiles");
    std::fs::write(&path, "before").unwrap();
    let tile = &tiles(0, false)[0];
    let mut out = TileWriter::create(&path).unwrap();
    out.write_tile(&Header::of(tile, Format::F32).unwrap(), tile).unwrap();
    drop(out);
    assert_eq!(std::fs::read(&path).unwrap(), b"before");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    let error = TileWriter::create(folder.path().join("none/a.tiles")).unwrap_err();
    assert_eq!(error.code(), "not_found");
}

#[test]
fn errors_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tiles.zst");
    let code = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let error = scan(&path).unwrap_err();
        assert!(error.to_string().contains("a.tiles.zst"), "{error}");
        error.code()
    };
    write(&folder.path().join("whole.tiles.zst"), &tiles(0, false), Format::F32);
    let whole = std::fs::read(folder.path().join("whole.tiles.zst")).unwrap();
    assert_eq!(code(&whole[..whole.len() / 2]), "truncated");
    assert_eq!(code(b""), "empty");
    assert_eq!(code(b"P6 1 1 255"), "not_a_tile");
    let mut damaged = whole.clone();
    damaged[4..12].fill(0xff);
    assert_eq!(code(&damaged), "compression");
    assert_eq!(scan(folder.path().join("nothing")).unwrap_err().code(), "not_found");
    // A window of 256 MiB is refused. Only a long stream is given one.
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
    encoder.window_log(28).unwrap();
    std::io::Write::write_all(&mut encoder, &[0; 1 << 20]).unwrap();
    assert_eq!(code(&encoder.finish().unwrap()), "compression");
}

#[test]
fn a_scan_says_what_is_in_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tiles");
    for varying in [false, true] {
        let tiles = tiles(3, varying);
        let _ = std::fs::remove_file(&path);
        write(&path, &tiles, Format::F16);
        let summary = scan(&path).unwrap();
        assert!(summary.whole() && summary.halos && summary.varying == varying);
        assert_eq!(summary.tiles.len(), 12);
        assert_eq!(summary.max_per_pixel, tiles.iter().map(SampleTile::max_per_pixel).max().unwrap());
        let whole = TileGeometry::new([30, 20], Rect::new(0, 0, 30, 20), Halo::default()).unwrap();
        let whole = tile_of(whole, varying, 1);
        assert_eq!(summary.samples, whole.total() as u64);
        for (plane, found) in summary.planes.iter().enumerate() {
            let values = (0..whole.total()).map(|sample| whole.value(plane, sample));
            let finite = || values.clone().filter(|v| v.is_finite());
            let range = (finite().fold(f32::INFINITY, f32::min), finite().fold(f32::NEG_INFINITY, f32::max));
            assert_eq!((found.min, found.max), range, "{}", found.name);
            // Of a position a sample has all components or none; one that is constant stays so.
            assert_eq!(found.nan > 0, (5..7).contains(&plane));
            assert_eq!(found.constant_tiles, if plane == 7 { 12 } else { 0 });
        }

        write_without_check(&path, &tiles[1..]);
        let summary = scan(&path).unwrap();
        assert_eq!(summary.missing, [Rect::new(0, 0, 8, 8)]);
        let mut twice: Vec<_> = tiles.clone();
        twice.push(tiles[3].clone());
        write_without_check(&path, &twice);
        let core = *tiles[3].geometry();
        assert_eq!(scan(&path).unwrap().overlap, Some([core.core(), core.core()]));
        let other = TileGeometry::new([31, 20], Rect::new(0, 0, 8, 8), Halo::default()).unwrap();
        write_without_check(&path, &[tiles[1].clone(), tile_of(other, false, 1)]);
        let summary = scan(&path).unwrap();
        assert_eq!(summary.disagreement, Some((other.core(), "the size of the image")));
        assert!(!summary.whole() && summary.varying == varying);
    }
}

fn write_without_check(path: &Path, tiles: &[SampleTile]) {
    std::fs::remove_file(path).unwrap();
    write(path, tiles, Format::F16);
}
