//! The stages of the filter, and the whole, against the scalar path in the same run:
//!
//! ```text
//! cargo bench --features bench                  # all; a table of the ratios at the end
//! cargo bench --features bench -- stage         # or what has this in its name
//! ```
//!
//! A stage is timed where it stands: those before it have just run on the same pixel, as in the filter, and pixels follow
//! one another as there. Times are medians on one thread: by the clock of the stages, which take microseconds, and of the
//! processor for the whole.
#![expect(clippy::unwrap_used, reason = "a failed unwrap ends the benchmark")]

use criterion::{BenchmarkId, Criterion};
use rpfd::filter::method::Algorithm;
use rpfd::filter::rpf::stages::{STAGES, Stage, with_stages};
use rpfd::filter::rpf::{Offsets, Params};
use rpfd::filter::scalar::{self, Scalar};
use rpfd::filter::{Execution, Method, Rect, SampleTile, SimdLevel, TileGeometry, filter};
use rpfd::report::{machine::cpu_seconds, plan::subset};
use rpfd::store::Spool;
use rpfd::synth::Scene;
use rpfd::wire::file::TileFile;
use std::cell::RefCell;
use std::hint::black_box;
use std::path::Path;
use std::time::{Duration, Instant};

const SAMPLES: u32 = 8;
/// Preset and iteration whose stages are timed: the most neighbours there are.
const STAGED: (&str, usize) = ("paper-fast", 2);

fn params(preset: &str) -> Params {
    match Method::preset(preset).unwrap().algorithm() {
        Algorithm::Rpf(params) => params.clone(),
        _ => unreachable!("only RPF has a scalar path"),
    }
}

/// All 27 planes of the synthetic scene vary.
fn synth(side: u32) -> SampleTile {
    let geometry = TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).unwrap();
    Scene::by_name("all").unwrap().tile(geometry, SAMPLES, &Execution::default()).unwrap()
}

/// The middle of the real render of the repository.
fn depth_of_field(side: u32) -> SampleTile {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/depth_of_field.8spp.tiles.zst");
    let (mut file, mut spool, mut image) = (TileFile::open(&path).unwrap(), Spool::in_memory(1 << 30), None);
    while let Some(event) = file.next_event().unwrap() {
        if let rpfd::wire::Event::Header(header) = &event {
            image = Some(header.geometry().image());
        }
        spool.push(&event).unwrap();
    }
    let Rect { width, height, .. } = image.unwrap();
    let whole = TileGeometry::with_halo([width, height], Rect::new(0, 0, width, height), 0).unwrap();
    subset(&spool.cut(whole).unwrap(), Rect::new((width - side) / 2, (height - side) / 2, side, side), SAMPLES).unwrap()
}

/// Seconds of everything that was timed: group, name, path, and each time.
#[derive(Default)]
struct Times(RefCell<Vec<(String, String, f64)>>);

impl Times {
    /// Times `work`, which says what of its time counts, once per iteration.
    fn bench(
        &self,
        criterion: &mut Criterion,
        group: &str,
        name: &str,
        path: &str,
        mut work: impl FnMut() -> Duration,
    ) {
        let mut criterion = criterion.benchmark_group(group);
        criterion.bench_function(BenchmarkId::new(name, path), |bencher| {
            bencher.iter_custom(|iterations| {
                let spent: Duration = (0..iterations).map(|_| work()).sum();
                let each = spent.as_secs_f64() / iterations as f64;
                self.0.borrow_mut().push((format!("{group}, {name}"), path.to_owned(), each));
                spent
            });
        });
    }

    fn median(&self, name: &str, path: &str) -> Option<f64> {
        let times = self.0.borrow();
        let mut times: Vec<f64> = times.iter().filter(|time| time.0 == name && time.1 == path).map(|t| t.2).collect();
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied()
    }

    fn print(&self) {
        println!("\n{:<46}{:<9}{:>12}{:>12}{:>9}", "", "SIMD", "fast", "scalar", "ratio");
        let mut seen = Vec::new();
        for (name, path, _) in self.0.borrow().iter() {
            if path == "scalar" || seen.contains(&(name, path)) {
                continue;
            }
            seen.push((name, path));
            let (Some(fast), Some(scalar)) = (self.median(name, path), self.median(name, "scalar")) else { continue };
            let text = |seconds: f64| match seconds {
                0.1.. => format!("{seconds:.3} s"),
                1e-4.. => format!("{:.2} ms", 1e3 * seconds),
                _ => format!("{:.2} us", 1e6 * seconds),
            };
            println!("{name:<46}{path:<9}{:>12}{:>12}{:>8.2}x", text(fast), text(scalar), scalar / fast);
        }
    }
}

fn timed<T>(work: impl FnOnce() -> T) -> Duration {
    let started = Instant::now();
    black_box(work());
    started.elapsed()
}

fn cpu_timed<T>(work: impl FnOnce() -> T) -> Duration {
    let before = cpu_seconds();
    black_box(work());
    Duration::from_secs_f64(cpu_seconds() - before)
}

/// The block of pixels whose stages are timed.
const BLOCK: Rect = Rect::new(24, 24, 16, 16);

/// Its pixels row by row, again and again.
fn pixels() -> impl Iterator<Item = (u32, u32)> {
    (0..).map(move |i: u32| (BLOCK.x + i % 16, BLOCK.y + i / 16 % 16))
}

fn stages(criterion: &mut Criterion, times: &Times) {
    let (tile, (preset, t)) = (synth(64), STAGED);
    let params = params(preset);
    let level = SimdLevel::default();
    let execution = Execution { simd: level, ..Execution::default() };
    for (wanted, name) in STAGES {
        with_stages(&tile, &params, t, &execution, &BLOCK, |stages| {
            let mut at = pixels();
            times.bench(criterion, "stage", name, level.name(), || {
                let (x, y) = at.next().unwrap_or_default();
                for (stage, _) in STAGES {
                    if stage == wanted {
                        return timed(|| stages.run(stage, x, y));
                    }
                    stages.run(stage, x, y);
                }
                Duration::ZERO
            });
        });
        let mut scalar = Scalar::new(&tile, &params, 0);
        let (colors, offsets) = (scalar.initial(), Offsets::new(params.boxes[t]));
        let mut at = pixels();
        times.bench(criterion, "stage", name, "scalar", || {
            let (x, y) = at.next().unwrap_or_default();
            let mut out = vec![[0.0; 3]; SAMPLES as usize];
            let mut weights = None;
            for (stage, _) in STAGES {
                let spent = match stage {
                    Stage::Select => timed(|| scalar.select(&offsets, t, x, y)),
                    Stage::Gather => timed(|| scalar.gather(0, &colors)),
                    Stage::Normalise => timed(|| scalar.normalise(0)),
                    Stage::Histograms => timed(|| scalar.histogram()),
                    Stage::Information => timed(|| weights = Some(scalar.weigh(t))),
                    Stage::Bilateral => timed(|| scalar.bilateral(weights.as_ref().unwrap(), &mut out)),
                    Stage::Spikes => timed(|| Scalar::spikes(&mut out)),
                };
                if stage == wanted {
                    return spent;
                }
            }
            Duration::ZERO
        });
    }
}

fn whole(criterion: &mut Criterion, times: &Times) {
    for (preset, side) in [("lean", 64), ("paper-fast", 32), ("paper", 10)] {
        for (scene, tile) in [("all", synth(side)), ("depth_of_field", depth_of_field(side))] {
            let (method, params) = (Method::preset(preset).unwrap(), params(preset));
            let name = format!("{preset} of {scene}, {side} x {side}");
            for (level, simd) in SimdLevel::available() {
                let execution = Execution { simd, ..Execution::default() };
                times.bench(criterion, "whole", &name, level, || cpu_timed(|| filter(&tile, &method, &execution)));
            }
            times.bench(criterion, "whole", &name, "scalar", || cpu_timed(|| scalar::filter(&tile, &params, 0)));
        }
    }
}

fn main() {
    let criterion = Criterion::default().sample_size(10).warm_up_time(Duration::from_millis(200));
    let criterion = criterion.measurement_time(Duration::from_millis(800)).without_plots();
    let mut criterion = criterion.configure_from_args();
    let times = Times::default();
    stages(&mut criterion, &times);
    whole(&mut criterion, &times);
    criterion.final_summary();
    times.print();
}
