//! A small analytic path tracer: per-sample renders of any size, for tests, benchmarks and the command line.
//!
//! It is a real renderer: spheres, rectangles and boxes; Lambertian and rough glossy surfaces; area lights,
//! sampled with multiple importance sampling; solid textures; a thin lens; linear motion while the shutter is open; box
//! filter; paths of fixed greatest length without Russian roulette. Its samples are unbiased: the means of ever more of
//! them tend to what [`Scene::reference`] computes from independent random numbers.
//!
//! [`scenes`] lists the scenes; [`Scene::tile`] renders the samples of any tile of an image of any size, and
//! [`Scene::reference`] its converged pixels. The size of the image scales the camera: its shorter side always shows
//! the same field of view.
//!
//! # What is in a tile
//!
//! The channels are the same for every scene and in one order ([`Scene::channels`]), 27 planes. Features that a sample
//! has not are NaN: P, N, albedo, P2 and N2 where the camera's ray met nothing, P2 and N2 where the path met nothing after
//! the first hit or ended there (on a light, or absorbed). A light's albedo is what it reflects, nothing. Normals
//! point to the side that was hit. Random parameters are the uniform numbers in [0, 1) that the path was made from, with 24
//! bits: `light` for the light and the point on it that lit the first hit, `bsdf` for the lobe and the direction in
//! which the path left the first hit; they are drawn, and written, even where nothing was hit.
//!
//! What a scene has not stays in the tile as constant planes, so that leaving it out can be compared with computing it:
//!
//! | scene | constant planes | planes that vary |
//! |---|---|---|
//! | `all` | | 27 |
//! | `lens` | time = 0 | 26 |
//! | `motion` | lens = 0 | 25 |
//! | `area-light`, `glossy`, `textures` | lens = 0, time = 0 | 24 |
//! | `plain` | lens = 0, time = 0, P2 and N2 = NaN | 18 |
//!
//! # Promises
//!
//! - **Same bits** whatever the tiling, the number of threads and the machine: a sample depends on the scene, the
//!   image's size, the seed, its pixel and its number only, and is computed with `+ - * /`, square roots and the
//!   pure-Rust `libm`.
//! - **Threads are given, never taken**; memory is that of the tile that is returned.

mod camera;
mod material;
mod random;
mod render;
mod scene;
mod shape;
mod texture;
mod trace;
mod vector;

#[cfg(test)]
mod tests;

pub use render::Reference;
pub use scene::{Scene, scenes};

/// Nothing was rendered; says why.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SynthError {
    /// More samples than a tile may have.
    #[error(transparent)]
    Samples(#[from] crate::filter::samples::SampleError),
    /// The work was stopped before its end.
    #[error("stopped before the image was done")]
    Stopped,
}
