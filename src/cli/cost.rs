//! `rpfd cost`: what filtering costs, and how that grows.

use super::{args::SimdArgs, failure::Failure, input::Input, progress, report::named};
use crate::{
    filter::{Execution, Method, Rect, Role, SampleTile, SimdLevel, TileGeometry},
    report::{
        cost::{Axis, Cost, Costs, Grid, Point, Task, input, levels, measure, memory, show},
        machine::Machine,
    },
    stitch::atomic::AtomicFile,
    store::spool::Spool,
};
use std::path::PathBuf;

/// Measure what filtering costs, and how that grows
///
/// CPU seconds per megapixel against samples per pixel (1 to 64), features (3 to 18), random parameters (0 to 8), side of
/// the tile (32 to 256, or 1024 with --full), threads (1 and 2: seconds by the clock) and SIMD levels, of a rendered
/// scene in which everything varies. One is varied, the others stay at 8 samples with 27 planes on one thread. A minute
/// or two on an idle machine; --full takes half an hour.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Method: a preset, with parameters if wanted (lean:bins=9); may be given several times
    #[arg(long = "preset", value_name = "NAME[:K=V,...]", default_values = ["lean", "paper-fast"])]
    presets: Vec<String>,
    /// What to vary
    #[arg(long = "axis", value_name = "NAME,...", value_delimiter = ',', default_values = axes(), value_parser = clap::builder::PossibleValuesParser::new(axes()))]
    axes: Vec<String>,
    /// A file of tiles, whose whole image is measured at every SIMD level as well
    #[arg(long, value_name = "IN.tiles[.zst]")]
    data: Vec<PathBuf>,
    /// Larger images, and tiles up to 1024 x 1024
    #[arg(long)]
    full: bool,
    /// Side of the image where neither tile nor threads are varied [default: 48, or 128 with --full]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..=4096))]
    side: Option<u32>,
    /// Measure each so often, but what takes seconds; times are medians
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    #[command(flatten)]
    simd: SimdArgs,
    /// Write all numbers as JSON, which `rpfd report --cost` reads; to standard output instead of the table without a
    /// file or with -
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
    /// Write the plots as SVG
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

const EXAMPLES: &str = "\
Examples:
  rpfd cost
  rpfd cost --preset lean --axis samples,threads
  rpfd cost --preset paper --axis simd --side 32 --data render.8spp.tiles.zst
  rpfd cost --json cost.json --svg cost.svg && rpfd report --folder renders --cost cost.json --html report.html";

fn axes() -> Vec<&'static str> {
    Axis::ALL.iter().map(|axis| axis.1).collect()
}

impl Args {
    /// Whether errors are told as JSON.
    pub(crate) fn json_errors(&self) -> bool {
        self.json.as_ref().is_some_and(|path| path.as_os_str() == "-")
    }
}

/// The side of the tile whose memory is measured.
const MEMORY_SIDE: u32 = 256;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let methods = args.presets.iter().map(|text| named(text)).collect::<Result<Vec<_>, _>>()?;
    let make = |path: Option<&PathBuf>| path.map(|path| AtomicFile::create(path)).transpose();
    let outputs = [make(args.json.as_ref().filter(|_| !args.json_errors()))?, make(args.svg.as_ref())?];
    let inputs = args.data.iter().map(|path| Input::scan(path)).collect::<Result<Vec<_>, _>>()?;
    inputs.iter().try_for_each(|input| input.check(None))?;
    let grid = if args.full { Grid::full() } else { Grid::usual() };
    let grid = Grid { side: args.side.unwrap_or(grid.side), ..grid };
    let stop = progress::interrupted();
    let execution = Execution { stop: Some(&stop), simd: args.simd.level, ..Execution::default() };

    // First, while the process holds nothing else.
    let memory = methods.iter().map(|named| memory(&named.method, &named.label, MEMORY_SIDE, &execution));
    let memory = memory.collect::<Result<Vec<_>, _>>()?;
    let mut work = Vec::new();
    for named in &methods {
        for (axis, name, _) in Axis::ALL {
            if args.axes.iter().any(|wanted| wanted == name) {
                let tasks = grid.tasks(axis, &named.method, &named.label, args.simd.level);
                work.extend(tasks.into_iter().map(|task| (&named.method, task)));
            }
        }
    }
    let bar = progress::bar("measuring", (work.len() + inputs.len()) as u64);
    let mut costs: Vec<Cost> = Vec::new();
    let mut last: Option<(Task, SampleTile)> = None;
    for (method, task) in work {
        let tile = match last.take().filter(|(before, _)| same_samples(before, &task)) {
            Some((_, tile)) => tile,
            None => {
                let Point { samples, features, random, .. } = task.point;
                input::tile(task.geometry, samples, features, random, &execution)?
            }
        };
        costs.push(one(&tile, method, &task, &execution, args.repeats)?);
        last = Some((task, tile));
        bar.inc(1);
    }
    drop(last);
    for file in &inputs {
        let tile = read(file, &execution)?;
        for named in &methods {
            for task in levels(Some(task(&tile, file, &named.label, args.simd.level))) {
                costs.push(one(&tile, &named.method, &task, &execution, args.repeats)?);
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    // By axis, as they are read.
    costs.sort_by_key(|cost| cost.point.axis);
    write(args, &Costs { machine: Machine::here(args.simd.level), costs, memory }, outputs)
}

/// Whether two tasks filter the same samples.
fn same_samples(a: &Task, b: &Task) -> bool {
    let of = |task: &Task| (task.geometry, task.point.samples, task.point.features, task.point.random);
    of(a) == of(b)
}

fn one(tile: &SampleTile, method: &Method, task: &Task, execution: &Execution, repeats: u32) -> Result<Cost, Failure> {
    let threads = task.point.threads as usize;
    let pool = (threads > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(threads).build()).transpose();
    let pool = pool.map_err(|error| Failure::failed("threads", format!("cannot start {threads} threads: {error}")))?;
    let execution = Execution { pool: pool.as_ref(), simd: task.simd, ..*execution };
    Ok(measure(tile, method, task.point.clone(), &execution, repeats as usize)?)
}

/// A file's whole image as one tile.
fn read(file: &Input, execution: &Execution) -> Result<SampleTile, Failure> {
    let [width, height] = file.image();
    let geometry = TileGeometry::with_halo([width, height], Rect::new(0, 0, width, height), 0)
        .map_err(|error| Failure::usage("bad_geometry", error))?;
    let mut spool = Spool::in_memory(file.summary.spool_bytes);
    let never = Default::default();
    file.fill(&mut spool, execution.stop.unwrap_or(&never))?;
    Ok(spool.cut(geometry)?)
}

fn task(tile: &SampleTile, file: &Input, label: &str, simd: SimdLevel) -> Task {
    let count = |wanted: fn(&Role) -> bool| tile.channels().planes_of(wanted).len() as u32;
    let name = file.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let point = Point {
        axis: Axis::Simd,
        preset: label.to_owned(),
        input: name,
        samples: tile.max_per_pixel(),
        features: count(|role| matches!(role, Role::Feature { .. })),
        random: count(|role| matches!(role, Role::Random { .. })),
        size: file.image(),
        threads: 1,
        simd: simd.name().to_owned(),
    };
    Task { point, geometry: *tile.geometry(), simd }
}

fn write(args: &Args, costs: &Costs, outputs: [Option<AtomicFile>; 2]) -> Result<(), Failure> {
    let json = || format!("{:#}\n", show::json(costs));
    let contents: [&dyn Fn() -> String; 2] = [&json, &|| show::svg(&costs.costs)];
    crate::cli::write_texts(outputs, contents)?;
    if args.json_errors() {
        say!("{}", json().trim_end());
        return Ok(());
    }
    let Machine { cpu, cores, os, version, .. } = &costs.machine;
    say!("{version} on {cpu}, {cores} processors, {os}\n\n{}", show::text(costs).trim_end());
    Ok(())
}
