//! Tiles and references of a scene.

use super::SynthError;
use super::random::{Numbers, Stream, pixel_key};
use super::scene::Scene;
use super::trace::{Hit, Sample};
use crate::filter::samples::{MAX_SAMPLES_PER_PIXEL, SampleError, sample_total};
use crate::filter::{Channel, ChannelSet, Counts, Execution, Plane, Rect, Role, SampleTile, TileGeometry};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Planes of a tile.
const PLANES: usize = 27;
/// First plane of P2 and N2, of the lens, and of the time.
const SECOND: std::ops::Range<usize> = 14..20;
const LENS: std::ops::Range<usize> = 20..22;
const TIME: usize = 22;

/// A converged image, and how far it may still be from the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// The pixels it covers.
    pub rect: Rect,
    /// Linear radiance: planes R, G, B, each one value per pixel of `rect`, row-major.
    pub rgb: [Vec<f32>; 3],
    /// Samples per pixel that were taken.
    pub samples: u32,
    /// Expected relMSE against the truth, mean of (x - r)^2 / (r^2 + 0.01) over pixels and channels, estimated from the
    /// difference of the two halves of the samples. To be subtracted from errors measured against this image. Too low
    /// where so few samples were taken that rare bright ones are missing; with 2048 it is within a half in these scenes.
    pub relmse: f64,
    /// Expected mean square error against the truth, estimated in the same way.
    pub mse: f64,
}

impl Scene {
    /// The channels of every tile, the same for all scenes: film, color, P, N, albedo, P2, N2, lens, time, light, bsdf;
    /// 27 planes.
    pub fn channels(&self) -> ChannelSet {
        let feature = |position| Role::Feature { position };
        let random = Role::Random { uniform: true };
        let channels = [
            ("film", Role::Film, 2),
            ("color", Role::Color, 3),
            ("P", feature(true), 3),
            ("N", feature(false), 3),
            ("albedo", feature(false), 3),
            ("P2", feature(true), 3),
            ("N2", feature(false), 3),
            ("lens", random, 2),
            ("time", random, 1),
            ("light", random, 2),
            ("bsdf", random, 2),
        ];
        let channels = channels.map(|(name, role, components)| Channel::new(name, role, components)).to_vec();
        let Ok(set) = ChannelSet::new(channels) else { unreachable!("a fixed list, which the tests make") };
        set
    }

    /// The samples of a tile's data window, `samples` of them in every pixel, under the seed of `execution`.
    ///
    /// Sample i of pixel (x, y) depends on the scene, the image's size, the seed, x, y and i only.
    pub fn tile(&self, geometry: TileGeometry, samples: u32, execution: &Execution) -> Result<SampleTile, SynthError> {
        self.render(geometry, Counts::Uniform(samples), execution)
    }

    /// As [`Scene::tile`], with 0 to `most` samples in each pixel, evenly distributed; they are the first of those that
    /// [`Scene::tile`] takes.
    pub fn tile_varying(
        &self,
        geometry: TileGeometry,
        most: u32,
        execution: &Execution,
    ) -> Result<SampleTile, SynthError> {
        if most > MAX_SAMPLES_PER_PIXEL {
            return Err(SampleError::PerPixel(most).into());
        }
        let window = geometry.window();
        // Before the counts take any memory.
        sample_total(window.area(), &Counts::Uniform(most))?;
        let count = |x, y| {
            let [number, _] = Numbers::new(pixel_key(execution.seed, Stream::Counts, x, y), 0).pair(0);
            (number * f64::from(most + 1)) as u16
        };
        let rows = window.y..window.bottom();
        let counts = rows.flat_map(|y| (window.x..window.right()).map(move |x| count(x, y))).collect();
        self.render(geometry, Counts::Varying(counts), execution)
    }

    fn render(&self, geometry: TileGeometry, counts: Counts, execution: &Execution) -> Result<SampleTile, SynthError> {
        let (image, window) = (geometry.image(), geometry.window());
        let total = sample_total(window.area(), &counts)? as usize;
        let mut planes: Vec<Plane> = (0..PLANES)
            .map(|plane| self.constant(plane).map_or_else(|| Plane::Values(vec![0.0; total]), Plane::Constant))
            .collect();
        let width = window.width as usize;
        let in_row = |row: usize| match &counts {
            Counts::Uniform(n) => width * *n as usize,
            Counts::Varying(counts) => counts[row * width..(row + 1) * width].iter().map(|&n| usize::from(n)).sum(),
        };
        // Every row gets its part of each plane that varies.
        let mut rest: Vec<(usize, &mut [f32])> = Vec::with_capacity(PLANES);
        for (plane, values) in planes.iter_mut().enumerate() {
            if let Plane::Values(values) = values {
                rest.push((plane, values));
            }
        }
        let mut rows = Vec::with_capacity(window.height as usize);
        for row in 0..window.height as usize {
            let count = in_row(row);
            let parts =
                rest.iter_mut().map(|(plane, values)| (*plane, values.split_off_mut(..count).unwrap_or_default()));
            rows.push((row, parts.collect::<Vec<_>>()));
        }
        for_each_row(rows, execution, |(row, mut parts)| {
            let (y, mut at) = (window.y + row as u32, 0);
            for column in 0..width {
                let x = window.x + column as u32;
                let here = match &counts {
                    Counts::Uniform(n) => *n,
                    Counts::Varying(counts) => u32::from(counts[row * width + column]),
                };
                let key = pixel_key(execution.seed, Stream::Samples, x, y);
                for i in 0..here {
                    let sample = self.sample([image.width, image.height], x, y, Numbers::new(key, i));
                    let values = values(&sample, x, y);
                    for (plane, part) in &mut parts {
                        part[at] = values[*plane];
                    }
                    at += 1;
                }
            }
        })?;
        Ok(SampleTile::new(geometry, self.channels(), counts, planes)?)
    }

    /// What a plane holds throughout, if the scene has nothing to vary it.
    fn constant(&self, plane: usize) -> Option<f32> {
        if SECOND.contains(&plane) && !self.second_hits {
            return Some(f32::NAN);
        }
        let unused = (LENS.contains(&plane) && !self.camera.has_lens()) || (plane == TIME && !self.moves());
        unused.then_some(0.0)
    }

    /// What the means of ever more samples tend to, in a part of an image of `image` pixels: at least two `samples` per
    /// pixel, an odd number rounded up. The random numbers are independent of those of tiles, whatever the seed, and
    /// sums run in `f64`.
    ///
    /// # Panics
    ///
    /// If `rect` does not lie inside the image.
    pub fn reference(
        &self,
        image: [u32; 2],
        rect: Rect,
        samples: u32,
        execution: &Execution,
    ) -> Result<Reference, SynthError> {
        assert!(Rect::new(0, 0, image[0], image[1]).covers(&rect), "{rect} does not lie inside the image");
        let half = samples.div_ceil(2).max(1);
        let (width, area) = (rect.width as usize, rect.area() as usize);
        let mut rgb = [(); 3].map(|()| vec![0.0_f32; area]);
        let mut errors = vec![[0.0; 2]; rect.height as usize];
        let [red, green, blue] = &mut rgb;
        let chunk = width.max(1);
        let planes = red.chunks_mut(chunk).zip(green.chunks_mut(chunk)).zip(blue.chunks_mut(chunk));
        let rows: Vec<_> = planes.zip(&mut errors).enumerate().collect();
        for_each_row(rows, execution, |(row, (((red, green), blue), error))| {
            let y = rect.y + row as u32;
            for column in 0..width {
                let x = rect.x + column as u32;
                let key = pixel_key(execution.seed, Stream::Reference, x, y);
                let sum = |range: std::ops::Range<u32>| {
                    range.fold([0.0; 3], |[r, g, b], i| {
                        let color = self.sample(image, x, y, Numbers::new(key, i)).color;
                        [r + color.x, g + color.y, b + color.z]
                    })
                };
                let halves = [sum(0..half), sum(half..2 * half)];
                for (channel, out) in [&mut *red, &mut *green, &mut *blue].into_iter().enumerate() {
                    let [a, b] = halves.map(|sums| sums[channel] / f64::from(half));
                    let mean = 0.5 * (a + b);
                    // The mean's variance is a quarter of the expected square of the halves' difference.
                    let square = 0.25 * (a - b) * (a - b);
                    error[0] += square / (mean * mean + 0.01);
                    error[1] += square;
                    out[column] = mean as f32;
                }
            }
        })?;
        let values = (3 * area).max(1) as f64;
        let [relmse, mse] = [0, 1].map(|k| errors.iter().map(|row| row[k]).sum::<f64>() / values);
        Ok(Reference { rect, rgb, samples: 2 * half, relmse, mse })
    }
}

/// A sample in the order of the planes.
fn values(sample: &Sample, x: u32, y: u32) -> [f32; PLANES] {
    let [fx, fy] = sample.film;
    let nothing = [f32::NAN; 3];
    let feature = |hit: Option<Hit>, which: fn(&Hit) -> [f32; 3]| hit.as_ref().map_or(nothing, which);
    let [r, g, b] = sample.color.to_f32();
    let [px, py, pz] = feature(sample.first, |hit| hit.position.to_f32());
    let [nx, ny, nz] = feature(sample.first, |hit| hit.normal.to_f32());
    let [ar, ag, ab] = feature(sample.first, |hit| hit.albedo.to_f32());
    let [qx, qy, qz] = feature(sample.second, |hit| hit.position.to_f32());
    let [mx, my, mz] = feature(sample.second, |hit| hit.normal.to_f32());
    let [film_x, film_y] = [(f64::from(x) + fx) as f32, (f64::from(y) + fy) as f32];
    let [lens_u, lens_v, time] = [sample.lens[0], sample.lens[1], sample.time].map(|v| v as f32);
    let [light_u, light_v] = sample.light.map(|v| v as f32);
    let [bsdf_u, bsdf_v] = sample.bsdf.map(|v| v as f32);
    [
        film_x, film_y, r, g, b, px, py, pz, nx, ny, nz, ar, ag, ab, qx, qy, qz, mx, my, mz, lens_u, lens_v, time,
        light_u, light_v, bsdf_u, bsdf_v,
    ]
}

/// Does the rows on the pool, or one after another on this thread; reports progress and heeds the stop flag after each.
fn for_each_row<T: Send>(
    rows: Vec<T>,
    execution: &Execution,
    work: impl Fn(T) + Sync + Send,
) -> Result<(), SynthError> {
    let (count, done) = (rows.len(), AtomicUsize::new(0));
    let stopped = || execution.stop.is_some_and(|flag| flag.load(Ordering::Relaxed));
    let one = |row| {
        if stopped() {
            return;
        }
        work(row);
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if let Some(progress) = execution.progress {
            progress(done as f32 / count as f32);
        }
    };
    match execution.pool {
        Some(pool) => pool.install(|| rows.into_par_iter().for_each(one)),
        None => rows.into_iter().for_each(one),
    }
    if stopped() { Err(SynthError::Stopped) } else { Ok(()) }
}
