//! What filtering costs, in processor seconds per megapixel, and how that grows: with the samples per pixel, the
//! features, the random parameters, the size of the tile, the threads and the SIMD level. One of them is varied at a time,
//! the others stay as in [`Grid::usual`].
//!
//! - [`input`]: samples with any number of features and random parameters.
//! - [`show`]: tables and plots.

pub mod input;
pub mod show;

use super::{
    machine::{Machine, cpu_seconds, peak_resident, reset_peak, resident},
    rows::{Spread, fit},
};
use crate::filter::{
    Execution, Halo, Method, Rect, SampleTile, SimdLevel, Stopped, TileGeometry, filter,
    geometry::MAX_SIDE,
    plan::{Plan, Shape, plan},
};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// What is varied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Samples per pixel.
    Samples,
    /// Planes of features.
    Features,
    /// Planes of random parameters.
    Random,
    /// Side of a tile that has the halo that the method needs.
    Tile,
    /// Threads, on a whole image and on tiles.
    Threads,
    /// SIMD level.
    Simd,
}

impl Axis {
    /// Every axis, its name, and what it counts.
    pub const ALL: [(Self, &str, &str); 6] = [
        (Self::Samples, "samples", "samples per pixel"),
        (Self::Features, "features", "planes of features"),
        (Self::Random, "random", "random parameters"),
        (Self::Tile, "tile", "side of the tile, pixels"),
        (Self::Threads, "threads", "threads"),
        (Self::Simd, "simd", "SIMD level"),
    ];

    /// What it counts.
    pub fn unit(self) -> &'static str {
        Self::ALL.iter().find(|axis| axis.0 == self).map_or("", |axis| axis.2)
    }
}

/// What is filtered, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// What is varied; the others are as usual.
    pub axis: Axis,
    /// Preset, and what was set.
    pub preset: String,
    /// Where the samples are from, and whether they are an image or a tile of one.
    pub input: String,
    /// Samples per pixel, at most.
    pub samples: u32,
    /// Planes of features.
    pub features: u32,
    /// Planes of random parameters.
    pub random: u32,
    /// Sides of what comes out, in pixels.
    pub size: [u32; 2],
    /// Threads.
    pub threads: u32,
    /// SIMD level.
    pub simd: String,
}

impl Point {
    /// Where it lies on its axis; SIMD levels are numbered from 1, the lowest.
    pub fn x(&self) -> f64 {
        let level = || SIMD_LEVELS.iter().position(|name| *name == self.simd).map_or(0.0, |i| i as f64 + 1.0);
        match self.axis {
            Axis::Samples => f64::from(self.samples),
            Axis::Features => f64::from(self.features),
            Axis::Random => f64::from(self.random),
            Axis::Tile => f64::from(self.size[0]),
            Axis::Threads => f64::from(self.threads),
            Axis::Simd => level(),
        }
    }
}

/// Names of SIMD levels, lowest first, for plots.
const SIMD_LEVELS: [&str; 4] = ["sse2", "sse4.2", "avx2", "avx512"];

/// What it cost.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Cost {
    /// What was filtered.
    #[serde(flatten)]
    pub point: Point,
    /// Processor seconds of all threads per megapixel that comes out.
    pub cpu: Spread,
    /// Seconds by the clock per megapixel that comes out.
    pub wall: Spread,
    /// How often it was measured.
    pub repeats: usize,
}

impl Cost {
    /// What its axis is about: seconds by the clock for threads, of the processor for all others.
    pub fn seconds(&self) -> f64 {
        if self.point.axis == Axis::Threads { self.wall.median } else { self.cpu.median }
    }
}

/// How the cost grows along an axis.
#[derive(Clone, Debug, Serialize)]
pub struct Growth {
    /// The axis.
    pub axis: Axis,
    /// The preset.
    pub preset: String,
    /// What was filtered.
    pub input: String,
    /// From where to where; SIMD levels by number.
    pub from: f64,
    /// To where.
    pub to: f64,
    /// Cost there over cost here. Of threads it is below 1: its inverse is the speedup.
    pub ratio: f64,
    /// Slope through the logarithms of all points between, where both are above 0.
    pub exponent: Option<f64>,
}

/// Growth from the first point of each line to the last, and of samples from 8 to 32 as well.
pub fn growth(costs: &[Cost]) -> Vec<Growth> {
    let mut lines: Vec<Vec<&Cost>> = Vec::new();
    for cost in costs {
        let same = |a: &Point, b: &Point| (a.axis, &a.preset, &a.input) == (b.axis, &b.preset, &b.input);
        match lines.iter_mut().find(|line| same(&line[0].point, &cost.point)) {
            Some(line) => line.push(cost),
            None => lines.push(vec![cost]),
        }
    }
    let mut found = Vec::new();
    for mut line in lines {
        line.sort_by(|a, b| a.point.x().total_cmp(&b.point.x()));
        let between = |from: f64, to: f64| {
            let inside: Vec<&&Cost> = line.iter().filter(|cost| (from..=to).contains(&cost.point.x())).collect();
            let (first, last) = (inside.first()?, inside.last()?);
            let points: Vec<_> = inside.iter().map(|cost| (cost.point.x(), cost.seconds())).collect();
            let Point { axis, preset, input, .. } = first.point.clone();
            let (from, to, ratio) = (first.point.x(), last.point.x(), last.seconds() / first.seconds());
            (from < to).then(|| Growth { axis, preset, input, from, to, ratio, exponent: fit(&points) })
        };
        found.extend(between(f64::NEG_INFINITY, f64::INFINITY));
        if line[0].point.axis == Axis::Samples {
            found.extend(between(8.0, 32.0).filter(|growth| (growth.from, growth.to) == (8.0, 32.0)));
        }
    }
    found
}

/// Bytes that a tile needs.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Memory {
    /// Preset, and what was set.
    pub preset: String,
    /// Planes.
    pub planes: u32,
    /// Sides of the tile, which is an image of its own.
    pub size: [u32; 2],
    /// Samples per pixel.
    pub samples: u32,
    /// Threads.
    pub threads: u32,
    /// Bytes planned: the samples,
    pub planned_samples: u64,
    /// what is beside them for the whole tile,
    pub planned_working: u64,
    /// on each thread,
    pub planned_per_thread: u64,
    /// and for what comes out.
    pub planned_output: u64,
    /// Growth of the process's resident size, at its peak, where the system tells.
    pub resident: Option<u64>,
}

/// The values that each axis takes, and the usual ones.
#[derive(Clone, Debug)]
pub struct Grid {
    /// Side of the image where neither tile nor threads are varied.
    pub side: u32,
    /// Side of the whole image that threads are tried on.
    pub image: u32,
    /// Samples per pixel.
    pub samples: Vec<u32>,
    /// Planes of features, in threes.
    pub features: Vec<u32>,
    /// Random parameters.
    pub random: Vec<u32>,
    /// Sides of tiles.
    pub tiles: Vec<u32>,
    /// Threads.
    pub threads: Vec<u32>,
}

impl Grid {
    /// What is measured in a minute or two.
    pub fn usual() -> Self {
        Self {
            side: 48,
            image: 256,
            samples: vec![1, 2, 4, 8, 16, 32, 64],
            features: vec![3, 6, 9, 12, 15, 18],
            random: vec![0, 1, 2, 4, 6, 8],
            tiles: vec![32, 64, 128, 256],
            threads: vec![1, 2],
        }
    }

    /// Larger images and tiles.
    pub fn full() -> Self {
        Self { side: 128, image: 1024, tiles: vec![32, 64, 128, 256, 512, 1024], ..Self::usual() }
    }

    /// Everything to measure of a method along an axis, from 8 samples per pixel with 27 planes on one thread; what can
    /// share samples comes together. SIMD levels are those of this CPU.
    pub fn tasks(&self, axis: Axis, method: &Method, label: &str, simd: SimdLevel) -> Vec<Task> {
        let square = |side: u32| TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).ok();
        // In the middle of an image that holds all that the tile reads.
        let in_image = |side: u32| {
            let halo = method.reach(false);
            let all = side.checked_add(2 * halo).filter(|all| *all <= MAX_SIDE)?;
            TileGeometry::with_halo([all, all], Rect::new(halo, halo, side, side), halo).ok()
        };
        let task = |geometry: Option<TileGeometry>, input: String| {
            let geometry = geometry?;
            let core = geometry.core();
            let point = Point {
                axis,
                preset: label.to_owned(),
                input,
                samples: 8,
                features: input::FEATURES,
                random: input::RANDOM,
                size: [core.width, core.height],
                threads: 1,
                simd: simd.name().to_owned(),
            };
            Some(Task { point, geometry, simd })
        };
        let image = || task(square(self.side), "image".to_owned());
        let vary = |values: &[u32], set: fn(&mut Point, u32)| {
            let one = |&value: &u32| {
                let mut task = image()?;
                set(&mut task.point, value);
                Some(task)
            };
            values.iter().filter_map(one).collect::<Vec<_>>()
        };
        match axis {
            Axis::Samples => vary(&self.samples, |point, value| point.samples = value),
            Axis::Features => vary(&self.features, |point, value| point.features = value),
            Axis::Random => vary(&self.random, |point, value| point.random = value),
            Axis::Tile => self.tiles.iter().filter_map(|&side| task(in_image(side), "tile".to_owned())).collect(),
            Axis::Threads => {
                let whole = task(square(self.image), format!("image of {0} x {0}", self.image));
                let tiles = [256, 64].map(|side| task(in_image(side), format!("tile of {side} x {side}")));
                let shapes = [whole].into_iter().chain(tiles).flatten();
                let on = |task: Task| {
                    self.threads.iter().map(move |&threads| {
                        let mut task = task.clone();
                        task.point.threads = threads;
                        task
                    })
                };
                shapes.flat_map(on).collect()
            }
            Axis::Simd => levels(image()),
        }
    }
}

/// A task at every SIMD level.
pub fn levels(task: Option<Task>) -> Vec<Task> {
    let at = |(name, simd): (&str, SimdLevel)| {
        let mut task = task.clone()?;
        task.point.simd = name.to_owned();
        Some(Task { simd, ..task })
    };
    SimdLevel::available().into_iter().filter_map(at).collect()
}

/// One thing to measure.
#[derive(Clone, Debug)]
pub struct Task {
    /// What is filtered, and how.
    pub point: Point,
    /// Where it lies.
    pub geometry: TileGeometry,
    /// SIMD level.
    pub simd: SimdLevel,
}

/// No measurement is repeated that has taken so many processor seconds in all.
const ENOUGH: f64 = 2.0;

/// Filters a tile, `repeats` times but for what takes long.
pub fn measure(
    tile: &SampleTile,
    method: &Method,
    point: Point,
    execution: &Execution,
    repeats: usize,
) -> Result<Cost, Stopped> {
    let megapixels = tile.geometry().core().area() as f64 * 1e-6;
    let (mut cpu, mut wall) = (Vec::new(), Vec::new());
    while cpu.len() < repeats.max(1) && cpu.iter().sum::<f64>() * megapixels < ENOUGH {
        let (before, started) = (cpu_seconds(), Instant::now());
        filter(tile, method, execution)?;
        cpu.push((cpu_seconds() - before) / megapixels);
        wall.push(started.elapsed().as_secs_f64() / megapixels);
    }
    let repeats = cpu.len();
    Ok(Cost { point, cpu: Spread::of(cpu), wall: Spread::of(wall), repeats })
}

/// Bytes for an image of 27 planes: what is planned, and what the process grows by while it is taken in and filtered. To
/// be called first: what a process has freed and keeps is not counted.
pub fn memory(
    method: &Method,
    label: &str,
    side: u32,
    execution: &Execution,
) -> Result<Memory, crate::synth::SynthError> {
    let window = Rect::new(0, 0, side, side);
    let geometry = TileGeometry::new([side, side], window, Halo::default()).unwrap_or_else(|_| unreachable!());
    let can_reset = reset_peak();
    let before = resident().filter(|_| can_reset);
    let tile = input::tile(geometry, 8, input::FEATURES, input::RANDOM, execution)?;
    filter(&tile, method, execution).map_err(|Stopped| crate::synth::SynthError::Stopped)?;
    let resident = peak_resident().zip(before).map(|(peak, before)| peak.saturating_sub(before));
    let shape = Shape {
        geometry: &geometry,
        channels: tile.channels(),
        samples: tile.total() as u64,
        max_per_pixel: 8,
        varying: false,
    };
    let Plan { samples, working, per_thread, output } = plan(&shape, method);
    Ok(Memory {
        preset: label.to_owned(),
        planes: tile.channels().planes() as u32,
        size: [side, side],
        samples: 8,
        threads: execution.pool.map_or(1, rayon::ThreadPool::current_num_threads) as u32,
        planned_samples: samples,
        planned_working: working,
        planned_per_thread: per_thread,
        planned_output: output,
        resident,
    })
}

/// All of it, as it is written and read again.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Costs {
    /// Where it was measured.
    pub machine: Machine,
    /// What was measured.
    pub costs: Vec<Cost>,
    /// Of tiles with all planes.
    pub memory: Vec<Memory>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cost(axis: Axis, x: u32, seconds: f64) -> Cost {
        let point = Point {
            axis,
            preset: "lean".into(),
            input: "image".into(),
            samples: if axis == Axis::Samples { x } else { 8 },
            features: 15,
            random: if axis == Axis::Random { x } else { 7 },
            size: [48, 48],
            threads: if axis == Axis::Threads { x } else { 1 },
            simd: "avx2".into(),
        };
        let spread = |seconds| Spread { median: seconds, min: seconds, max: seconds };
        Cost { point, cpu: spread(seconds), wall: spread(2.0 * seconds), repeats: 1 }
    }

    #[test]
    fn growth_is_between_the_ends() {
        let samples = [1, 8, 32, 64].map(|x| cost(Axis::Samples, x, f64::from(x * x)));
        let threads = [2, 1].map(|x| cost(Axis::Threads, x, 1.0 / f64::from(x)));
        let random = [0, 8].map(|x| cost(Axis::Random, x, f64::from(x + 8)));
        let growth = growth(&[&samples[..], &threads, &random].concat());
        let found: Vec<_> = growth.iter().map(|g| (g.axis, g.from, g.to, g.ratio)).collect();
        assert_eq!(
            found,
            [
                (Axis::Samples, 1.0, 64.0, 4096.0),
                (Axis::Samples, 8.0, 32.0, 16.0),
                (Axis::Threads, 1.0, 2.0, 0.5),
                (Axis::Random, 0.0, 8.0, 2.0),
            ]
        );
        assert!((growth[1].exponent.unwrap() - 2.0).abs() < 1e-12 && growth[3].exponent.is_none());
    }

    #[test]
    fn every_axis_has_its_tasks() {
        let (grid, simd) = (Grid::full(), SimdLevel::default());
        for (preset, reach) in [("lean", 17 + 6), ("paper-fast", 55)] {
            let method = Method::preset(preset).unwrap();
            for (axis, ..) in Axis::ALL {
                let tasks = grid.tasks(axis, &method, preset, simd);
                let count = match axis {
                    Axis::Samples => 7,
                    Axis::Features | Axis::Random | Axis::Tile | Axis::Threads => 6,
                    Axis::Simd => SimdLevel::available().len(),
                };
                assert_eq!(tasks.len(), count, "{axis:?}");
                let mut x: Vec<f64> = tasks.iter().map(|task| task.point.x()).collect();
                x.dedup();
                assert_eq!(x.len(), tasks.len(), "{axis:?}");
                for task in tasks {
                    assert_eq!(task.geometry.core().width, task.point.size[0]);
                    if task.point.input.starts_with("tile") {
                        let needed = task.geometry.halo_for(method.reach(false));
                        assert!(task.geometry.halo().covers(&needed) && needed.left <= reach && needed.left > 0);
                    }
                }
            }
        }
    }
}
