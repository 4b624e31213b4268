//! Which cores are taken, which refused, and what the image says about itself.

use super::{digest, filtered, put, shuffle, stitched, value};
use rpfd::{
    filter::{Rect, geometry::tiling},
    stitch::{Added, Canvas, Claim, Digest, Offer, Pixels, Stitcher, Totals},
};

const A: Digest = [1; 32];
const B: Digest = [2; 32];

fn stitcher() -> Stitcher {
    Stitcher::new(64, 48, &std::env::temp_dir()).unwrap()
}

fn claim(stitcher: &mut Stitcher, core: Rect, digest: Digest, replace: bool) -> Claim {
    match stitcher.offer(core, digest, replace).unwrap() {
        Offer::Filter(claim) => claim,
        Offer::Repeated => panic!("{core} is there"),
    }
}

fn code(result: Result<Offer, rpfd::stitch::StitchError>) -> &'static str {
    result.unwrap_err().code()
}

/// The service moves an image between threads.
const _: fn() = || {
    fn movable<T: Send + Sync + 'static>() {}
    movable::<(Stitcher, Claim)>();
};

#[test]
fn tells_what_is_missing_whatever_the_order() {
    let mut cores: Vec<Rect> = tiling([64, 48], 16).collect();
    let mut totals: Option<Totals> = None;
    for seed in 0..5 {
        shuffle(&mut cores, seed);
        let mut stitcher = stitcher();
        assert_eq!(stitcher.missing(), [Rect::new(0, 0, 64, 48)]);
        for (i, &core) in cores.iter().enumerate() {
            assert!(!stitcher.is_complete());
            put(&mut stitcher, core);
            let missing: u64 = stitcher.missing().iter().map(Rect::area).sum();
            assert_eq!(missing, 64 * 48 - 256 * (i as u64 + 1));
            assert_eq!(stitcher.pixels_done(), 256 * (i as u64 + 1));
        }
        assert!(stitcher.is_complete());
        assert_eq!(stitcher.missing(), []);
        let got = stitcher.totals();
        assert_eq!((got.tiles, got.pixels, got.samples), (12, 64 * 48, 64 * 48 * 4));
        // To the last bit: sums of floats are in a fixed order.
        assert_eq!(totals.get_or_insert(got.clone()), &got);
    }
}

#[test]
fn overlaps_are_refused_and_named() {
    let mut stitcher = stitcher();
    put(&mut stitcher, Rect::new(0, 0, 32, 32));
    let error = stitcher.offer(Rect::new(31, 31, 8, 8), A, true).unwrap_err();
    assert_eq!(error.code(), "tile-overlap");
    assert_eq!(
        error.to_string(),
        "tile [31, 31, 8, 8] overlaps tile [0, 0, 32, 32], which came before: cores of one image must be equal or apart"
    );
    // A core with the same corner is another core all the same.
    assert_eq!(code(stitcher.offer(Rect::new(0, 0, 32, 16), A, true)), "tile-overlap");
    assert_eq!(code(stitcher.offer(Rect::new(0, 0, 64, 48), A, true)), "tile-overlap");
    // A claim counts as long as it lives.
    let claim = claim(&mut stitcher, Rect::new(32, 0, 32, 32), A, false);
    assert_eq!(code(stitcher.offer(Rect::new(40, 0, 8, 8), A, false)), "tile-overlap");
    drop(claim);
    put(&mut stitcher, Rect::new(40, 0, 8, 8));
    assert_eq!(code(stitcher.offer(Rect::new(32, 0, 32, 32), A, false)), "tile-overlap");
}

#[test]
fn geometry_is_checked() {
    let mut stitcher = stitcher();
    for core in [Rect::new(0, 0, 0, 1), Rect::new(63, 0, 2, 1), Rect::new(u32::MAX, 0, 2, 1), Rect::new(0, 48, 1, 1)] {
        assert_eq!(code(stitcher.offer(core, A, false)), "invalid-geometry");
    }
    assert_eq!(Stitcher::new(0, 1, &std::env::temp_dir()).unwrap_err().code(), "invalid-geometry");
    assert_eq!(Stitcher::new(1 << 21, 1, &std::env::temp_dir()).unwrap_err().code(), "invalid-geometry");
}

#[test]
fn the_same_core_again() {
    let core = Rect::new(16, 16, 16, 16);
    let mut stitcher = stitcher();
    put(&mut stitcher, core);
    assert!(matches!(stitcher.offer(core, digest(1), false).unwrap(), Offer::Repeated));
    assert!(matches!(stitcher.offer(core, digest(1), true).unwrap(), Offer::Repeated));
    assert_eq!(code(stitcher.offer(core, B, false)), "tile-conflict");
    let claim = claim(&mut stitcher, core, B, true);
    let mut other = filtered(core);
    other.rgb[1][0] = 7.0;
    other.report.samples = 5;
    assert_eq!(stitcher.add(claim, &other).unwrap(), Added::Stored);
    assert_eq!(stitcher.totals().samples, 5);
    assert_eq!(stitcher.pixels_done(), 256);
    let mut pixel = [[0.0; 3]];
    stitcher.pixels().read(Rect::new(16, 16, 1, 1), &mut pixel).unwrap();
    assert_eq!(pixel[0], [value(16, 16, 0), 7.0, value(16, 16, 2)]);
    assert!(matches!(stitcher.offer(core, B, false).unwrap(), Offer::Repeated));
    assert_eq!(code(stitcher.offer(core, digest(1), false)), "tile-conflict");
}

/// A core that lacked halo is filtered again on request, with the same samples, and then no more.
#[test]
fn an_inexact_core_can_be_replaced_by_itself() {
    let core = Rect::new(16, 16, 16, 16);
    let mut stitcher = stitcher();
    let first = claim(&mut stitcher, core, A, false);
    let mut poor = filtered(core);
    poor.report.halo_needed.left = 9;
    poor.rgb[0][0] = 7.0;
    assert_eq!(stitcher.add(first, &poor).unwrap(), Added::Stored);
    assert!(matches!(stitcher.offer(core, A, false).unwrap(), Offer::Repeated));
    let again = claim(&mut stitcher, core, A, true);
    assert_eq!(stitcher.add(again, &filtered(core)).unwrap(), Added::Stored);
    let mut pixel = [[0.0; 3]];
    stitcher.pixels().read(Rect::new(16, 16, 1, 1), &mut pixel).unwrap();
    assert_eq!(pixel[0][0], value(16, 16, 0));
    assert!(matches!(stitcher.offer(core, A, true).unwrap(), Offer::Repeated));
    assert_eq!(stitcher.pixels_done(), 256);
}

#[test]
fn two_requests_with_one_core_at_once() {
    let core = Rect::new(0, 0, 8, 8);
    // The same samples: both may filter, one is stored.
    let mut s = stitcher();
    let (first, second) = (claim(&mut s, core, A, false), claim(&mut s, core, A, false));
    assert_eq!(code(s.offer(core, B, false)), "tile-busy");
    assert_eq!(s.add(second, &filtered(core)).unwrap(), Added::Stored);
    assert!(matches!(s.offer(core, A, false).unwrap(), Offer::Repeated));
    assert_eq!(s.add(first, &filtered(core)).unwrap(), Added::Repeated);
    assert_eq!(code(s.offer(core, B, false)), "tile-conflict");

    // One gives up: the other is free to come.
    let mut s = stitcher();
    drop(claim(&mut s, core, A, false));
    let other = claim(&mut s, core, B, false);
    assert_eq!(s.add(other, &filtered(core)).unwrap(), Added::Stored);

    // Other samples with `replace`: the one offered last stays, whichever is done first.
    for late_first in [false, true] {
        let mut s = stitcher();
        let (early, late) = (claim(&mut s, core, A, false), claim(&mut s, core, B, true));
        if late_first {
            assert_eq!(s.add(late, &filtered(core)).unwrap(), Added::Stored);
            assert_eq!(s.add(early, &filtered(core)).unwrap_err().code(), "tile-superseded");
        } else {
            assert_eq!(s.add(early, &filtered(core)).unwrap(), Added::Stored);
            assert_eq!(s.add(late, &filtered(core)).unwrap(), Added::Stored);
        }
        assert!(matches!(s.offer(core, B, false).unwrap(), Offer::Repeated));
        assert_eq!(s.pixels_done(), 64);
    }
}

#[test]
fn a_result_that_was_not_claimed_is_refused() {
    let (mut one, mut other) = (stitcher(), stitcher());
    let core = Rect::new(0, 0, 8, 8);
    let wrong = claim(&mut one, core, A, false);
    assert_eq!(one.add(wrong, &filtered(Rect::new(8, 0, 8, 8))).unwrap_err().code(), "internal");
    let mut short = filtered(core);
    short.rgb[2].pop();
    let wrong = claim(&mut one, core, A, false);
    assert_eq!(one.add(wrong, &short).unwrap_err().code(), "internal");
    let foreign = claim(&mut one, core, A, false);
    let _own = claim(&mut other, core, A, false);
    assert_eq!(other.add(foreign, &filtered(core)).unwrap_err().code(), "internal");
    assert_eq!((one.pixels_done(), other.pixels_done()), (0, 0));
}

#[test]
fn a_kept_canvas_is_taken_up_again() {
    let directory = tempfile::tempdir().unwrap();
    let folder = rpfd::disk::Directory::new(directory.path());
    let mut first = Stitcher::on(Canvas::create(64, 48, &folder, "canvas").unwrap());
    let cores: Vec<Rect> = tiling([64, 48], 24).collect();
    cores.iter().for_each(|&core| put(&mut first, core));
    first.canvas().sync().unwrap();
    drop(first);
    // All cores are on the canvas, but the last was never recorded: its pixels do not count, and do not show.
    let mut again = Stitcher::on(Canvas::open(64, 48, &folder, "canvas").unwrap());
    let (last, recorded) = cores.split_last().unwrap();
    for &core in recorded {
        again.restore(core, digest(1), filtered(core).report).unwrap();
    }
    assert_eq!(again.restore(recorded[0], digest(1), filtered(*last).report).unwrap_err().code(), "tile-conflict");
    assert_eq!(again.missing(), [*last]);
    let mut pixels = vec![[1.0; 3]; 64 * 48];
    again.pixels().read(again.image(), &mut pixels).unwrap();
    for (i, pixel) in pixels.iter().enumerate() {
        let (x, y) = (i as u32 % 64, i as u32 / 64);
        let expected = if last.contains(x, y) { [0.0; 3] } else { [0, 1, 2].map(|c| value(x, y, c)) };
        assert_eq!(*pixel, expected);
    }
    assert!(matches!(again.offer(recorded[0], digest(1), false).unwrap(), Offer::Repeated));
    put(&mut again, *last);
    assert!(again.is_complete());
    let whole = stitched(64, 48, 24, 1, directory.path());
    assert_eq!(again.totals(), whole.totals());
}
