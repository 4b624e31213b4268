//! `rpfd synth`: the same samples whatever the tiling.

use super::*;
use rpfd::{
    filter::{Rect, SampleTile, TileGeometry},
    store::spool::Spool,
};

/// All samples of a file of 40 x 30 pixels, as one tile.
fn whole(path: &str) -> SampleTile {
    let mut spool = Spool::in_memory(1 << 22);
    let mut file = TileFile::open(path).unwrap();
    while let Some(event) = file.next_event().unwrap() {
        spool.push(&event).unwrap();
    }
    spool.cut(TileGeometry::with_halo([40, 30], Rect::new(0, 0, 40, 30), 0).unwrap()).unwrap()
}

fn same(a: &SampleTile, b: &SampleTile) -> bool {
    let plane = |tile: &SampleTile, p| (0..tile.total()).map(|i| tile.value(p, i).to_bits()).collect::<Vec<_>>();
    (0..1200).all(|pixel| a.samples_of(pixel) == b.samples_of(pixel)) && (0..27).all(|p| plane(a, p) == plane(b, p))
}

#[test]
fn tiles_are_the_same_for_any_tiling() {
    let folder = Folder::new();
    for extra in [&[][..], &["--varying"], &["--format", "f16"]] {
        let make = |name: &str, tile: &str, halo: &str, threads: &str| {
            let common =
                ["--size", "40x30", "--spp", "3", "--seed", "7", "--tile", tile, "--halo", halo, "--threads", threads];
            whole(&folder.synth(name, &[&common[..], extra].concat()))
        };
        let expected = make("a.tiles", "100", "0", "1");
        assert!(same(&expected, &make("b.tiles", "16", "0", "2")));
        assert!(same(&expected, &make("c.tiles.zst", "7", "5", "1")));
        assert_eq!(expected.varying(), extra.contains(&"--varying"));
    }
}

#[test]
fn the_reference_does_not_depend_on_the_tiles() {
    let folder = Folder::new();
    let (a, b) = (folder.path("a.exr"), folder.path("b.exr"));
    for (reference, tile) in [(&a, "16"), (&b, "64")] {
        let args = ["--size", "40x30", "--spp", "1", "--tile", tile, "--reference", reference, "--reference-spp", "8"];
        folder.synth("t.tiles", &[&args[..], &["--scene", "plain"]].concat());
    }
    assert!(bytes(&a) == bytes(&b));
    assert_eq!(folder.names(), ["a.exr", "b.exr", "t.tiles"]);
    let image = read_exr(&a);
    assert_eq!((image.width, image.height), (40, 30));
    assert!(image.pixels.iter().all(|p| p.iter().all(|v| v.is_finite())));
}

#[test]
fn compression_goes_by_the_name() {
    let folder = Folder::new();
    let args = ["--size", "16x16", "--spp", "1"];
    let (plain, zst) = (folder.synth("a.tiles", &args), folder.synth("a.tiles.zst", &args));
    assert!(!bytes(plain).starts_with(b"\x28\xb5\x2f\xfd") && bytes(zst).starts_with(b"\x28\xb5\x2f\xfd"));
}

#[test]
fn help_lists_the_scenes() {
    let output = rpfd(["synth", "--help"]);
    let help = String::from_utf8(output.stdout).unwrap();
    assert!(rpfd::synth::scenes().iter().all(|(name, what)| help.contains(name) && help.contains(what)));
}
