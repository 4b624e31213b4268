//! Which measurements a report needs.

use crate::filter::{
    Method, Rect, SampleTile, TileGeometry,
    samples::{Counts, Plane, SampleError},
};
use serde::{Deserialize, Serialize};

/// What a measurement depends on: one of the same key is not made again.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    /// Name of the data set.
    pub data: String,
    /// What tells its content from any other's: BLAKE3 of the files, or how it was rendered.
    pub content: String,
    /// Part of the image that is measured: x, y, width, height in pixels.
    pub crop: [u32; 4],
    /// Whether that is a part only.
    pub part: bool,
    /// Samples per pixel: the first so many of each.
    pub spp: u32,
    /// The preset.
    pub preset: String,
    /// All parameters, `name=value`.
    pub parameters: Vec<String>,
    /// Threads that filtered.
    pub threads: usize,
    /// SIMD level that they used.
    #[serde(default)]
    pub simd: String,
    /// What the processor calls itself: times of another are not this one's.
    #[serde(default)]
    pub cpu: String,
    /// Keys the method's random draws.
    pub seed: u64,
    /// 0 for the first time the same is measured.
    pub repeat: u32,
    /// Version and build of the program.
    pub version: String,
}

impl Key {
    /// The parameters of a method as a key has them.
    pub fn parameters_of(method: &Method) -> Vec<String> {
        method.parameters().iter().map(|(name, value)| format!("{name}={value}")).collect()
    }
}

/// Part of an image as an image of its own: no context around it. `tile` must have no halo and cover the part.
///
/// Of each pixel the first `samples` samples are taken, in the order of the file, or all if it has no more: a render of
/// s samples holds one of every smaller number.
pub fn subset(tile: &SampleTile, part: Rect, samples: u32) -> Result<SampleTile, SampleError> {
    let window = tile.geometry().window();
    let kept: Vec<_> = (part.y..part.bottom())
        .flat_map(|y| (part.x..part.right()).map(move |x| (x, y)))
        .map(|(x, y)| {
            let all = tile.samples_of(((y - window.y) * window.width + (x - window.x)) as usize);
            all.start..all.end.min(all.start + samples as usize)
        })
        .collect();
    let counts = match tile.varying() {
        true => Counts::Varying(kept.iter().map(|range| range.len() as u16).collect()),
        false => Counts::Uniform(samples.min(tile.max_per_pixel())),
    };
    let planes = (0..tile.channels().planes()).map(|plane| match tile.plane(plane) {
        Plane::Constant(value) => Plane::Constant(*value),
        Plane::Values(values) => Plane::Values(kept.iter().flat_map(|range| &values[range.clone()]).copied().collect()),
    });
    let planes = planes.collect();
    let image = tile.geometry().image();
    // The part lies inside the image, which it keeps its place in: random draws are keyed by it.
    let geometry = TileGeometry::new([image.width, image.height], part, Default::default()).unwrap_or(*tile.geometry());
    SampleTile::new(geometry, tile.channels().clone(), counts, planes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{filter::Execution, synth::Scene};

    fn whole() -> TileGeometry {
        TileGeometry::with_halo([9, 7], Rect::new(0, 0, 9, 7), 0).unwrap()
    }

    fn same(a: &SampleTile, b: &SampleTile) {
        assert_eq!((a.total(), a.max_per_pixel(), a.geometry()), (b.total(), b.max_per_pixel(), b.geometry()));
        for plane in 0..a.channels().planes() {
            assert!((0..a.total()).all(|i| a.value(plane, i).to_bits() == b.value(plane, i).to_bits()));
        }
    }

    #[test]
    fn the_first_samples_of_each_pixel() {
        let scene = Scene::by_name("all").unwrap();
        let tile = |geometry, spp| scene.tile(geometry, spp, &Execution::default()).unwrap();
        let full = tile(whole(), 5);
        same(&subset(&full, Rect::new(0, 0, 9, 7), 3).unwrap(), &tile(whole(), 3));
        same(&subset(&full, Rect::new(0, 0, 9, 7), 9).unwrap(), &full);
        let part = Rect::new(2, 3, 4, 2);
        let cut = TileGeometry::with_halo([9, 7], part, 0).unwrap();
        same(&subset(&full, part, 5).unwrap(), &tile(cut, 5));
    }

    #[test]
    fn pixels_with_fewer_samples_keep_them() {
        let full = Scene::by_name("all").unwrap().tile_varying(whole(), 6, &Execution::default()).unwrap();
        let few = subset(&full, Rect::new(0, 0, 9, 7), 2).unwrap();
        for pixel in 0..63 {
            let (all, first) = (full.samples_of(pixel), few.samples_of(pixel));
            assert_eq!(first.len(), all.len().min(2));
            assert!(all.zip(first).all(|(a, b)| full.value(3, a).to_bits() == few.value(3, b).to_bits()));
        }
    }
}
