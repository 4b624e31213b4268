//! The image being assembled, and the files that come out of it.

mod assemble;
mod exr_file;
mod reference;

use rpfd::{
    filter::{Filtered, Rect, Report},
    stitch::{Added, Digest, Offer, Stitcher},
};

/// A value for each pixel and channel that tells them all apart, over the whole range of exponents that images have.
pub(crate) fn value(x: u32, y: u32, channel: u32) -> f32 {
    let hash = (x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca77) ^ channel.wrapping_mul(0xc2b2_ae3d))
        .wrapping_mul(0x27d4_eb2f);
    let mantissa = f32::from_bits(0x3f80_0000 | (hash >> 9));
    mantissa * 2f32.powi((hash & 31) as i32 - 22)
}

/// What the filter would give for this core.
pub(crate) fn filtered(core: Rect) -> Filtered {
    let plane = |channel| {
        let pixels = (core.y..core.bottom()).flat_map(|y| (core.x..core.right()).map(move |x| (x, y)));
        pixels.map(|(x, y)| value(x, y, channel)).collect()
    };
    let report = Report {
        samples: core.area() * 4,
        spikes: u64::from(core.x),
        energy_in: 0.1 * f64::from(core.x + 3 * core.y),
        energy_out: 0.1,
        ..Report::default()
    };
    Filtered { core, rgb: [plane(0), plane(1), plane(2)], report }
}

pub(crate) fn digest(n: u8) -> Digest {
    [n; 32]
}

/// Offers and adds a core that must be wanted.
pub(crate) fn put(stitcher: &mut Stitcher, core: Rect) {
    let Offer::Filter(claim) = stitcher.offer(core, digest(1), false).unwrap() else { panic!("{core} is there") };
    assert_eq!(stitcher.add(claim, &filtered(core)).unwrap(), Added::Stored);
}

/// Puts things into another order, the same one for the same seed.
pub(crate) fn shuffle<T>(things: &mut [T], mut seed: u64) {
    for i in (1..things.len()).rev() {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        things.swap(i, (seed >> 33) as usize % (i + 1));
    }
}

/// A whole image, its tiles put in an order that the seed decides.
pub(crate) fn stitched(width: u32, height: u32, tile: u32, seed: u64, directory: &std::path::Path) -> Stitcher {
    let mut stitcher = Stitcher::new(width, height, directory).unwrap();
    let mut cores: Vec<Rect> = rpfd::filter::geometry::tiling([width, height], tile).collect();
    shuffle(&mut cores, seed);
    cores.into_iter().for_each(|core| put(&mut stitcher, core));
    stitcher
}
