//! `rpfd report`: error against run time, of every method on any number of renders.

mod data;

use super::{args::SimdArgs, failure::Failure, progress};
use crate::{
    filter::{Execution, Method, Rect, SampleTile, SimdLevel, method::PRESETS},
    report::{
        cost::{self, Costs},
        html::{Page, page},
        machine::Machine,
        measure::{MeasureError, Measurement, measure, middle},
        plan::{Key, subset},
        plots,
        rows::{BASE, Own, Row, rows},
        state::State,
        svg, table,
    },
    stitch::atomic::AtomicFile,
};
use data::{DataArg, DataSet, SynthArg, Wanted};
use indicatif::ProgressBar;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
};

/// The preset that takes hours on whole images.
const SLOW: &str = "paper";

/// Steps of the progress bar for one measurement.
const STEPS: u64 = 1000;

/// Measure error against run time
///
/// Filters renders by every method, each image as one tile, and compares what comes out with the references. A render
/// of s samples per pixel serves every smaller count: the first so many samples of each pixel are taken, in the order
/// of the file. `unfiltered` is always among the methods, since the others are compared with it. Errors are the same
/// whenever and wherever they are measured; times are those of this machine as it was.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Samples, their reference, and the reference's own relMSE where it is known; files named NAME.NNspp.tiles[.zst]
    /// of one NAME and reference are one data set
    #[arg(long, value_name = "TILES=REF.exr[:OWN_RELMSE]", value_parser = data::data_arg)]
    data: Vec<DataArg>,
    /// Every NAME.NNspp.tiles[.zst] with NAME.reference.exr in a folder; reference-noise.json has the references' own
    /// errors: {"NAME": {"relmse": ..., "mse": ...}}
    #[arg(long, value_name = "DIR")]
    folder: Vec<PathBuf>,
    /// A scene of `rpfd synth`, rendered here with its reference
    #[arg(long, value_name = "SCENE@WxH", value_parser = data::synth_arg)]
    synth: Vec<SynthArg>,
    /// Samples per pixel of the references of --synth
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(2..))]
    reference_spp: u32,
    /// Method: a preset, with parameters if wanted (lean:bins=9,boxes=17,7); by default every preset, `paper` only with
    /// --crop
    #[arg(long = "preset", value_name = "NAME[:K=V,...]")]
    presets: Vec<String>,
    /// Measure each method that has a tolerance with these as well (lean:tolerance=1e-3), and compare
    #[arg(long, value_name = "E,...", value_delimiter = ',')]
    tolerance: Vec<String>,
    /// Samples per pixel; by default as many as the files have, and 8 of --synth
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=65535))]
    spp: Vec<u32>,
    /// Threads to filter on
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "1", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Vec<u32>,
    #[command(flatten)]
    simd: SimdArgs,
    /// Measure each so often; times are medians
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Measure this part of each image as well, as an image of its own, whose reference's own error is not
    /// known; then `paper` is measured on the part only
    #[arg(long, value_name = "X,Y,W,H", value_parser = crop)]
    crop: Option<Rect>,
    /// CPU seconds that rendering one sample per pixel takes per megapixel: adds the cost of samples and filter
    /// together, and of the plain samples of equal error
    #[arg(long, value_name = "S", value_parser = seconds)]
    seconds_per_sample: Option<f64>,
    /// What `rpfd cost --json FILE` has measured: adds its plots to the page
    #[arg(long, value_name = "FILE", requires = "html")]
    cost: Option<PathBuf>,
    /// Keys every random draw of the methods and of --synth
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Keep finished measurements here, and do not repeat those that are here
    #[arg(long, value_name = "FILE")]
    state: Option<PathBuf>,
    /// Write all numbers as JSON; to standard output instead of the table without a file or with -
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
    /// Write all numbers as CSV
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write one page with plots, pictures and tables, which needs no other file
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write the plots of error against time as SVG
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

const EXAMPLES: &str = "\
Examples:
  rpfd report --synth all@128x128 --spp 2,8 --html report.html
  rpfd report --folder renders --repeats 3 --state report.state --html report.html --csv report.csv
  rpfd report --data a.8spp.tiles.zst=a.exr:2e-4 --preset lean --preset lean:bins=9 --seconds-per-sample 5";

fn crop(text: &str) -> Result<Rect, String> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let right = "write X,Y,WIDTH,HEIGHT in pixels, like 32,32,64,64";
    match numbers.as_deref() {
        Some(&[x, y, width, height]) if width > 0 && height > 0 => Ok(Rect::new(x, y, width, height)),
        _ => Err(right.to_owned()),
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|s: &f64| *s > 0.0 && s.is_finite());
    seconds.ok_or_else(|| "write a number of seconds above 0".to_owned())
}

/// A method and what it is called.
pub(super) struct Named {
    pub(super) label: String,
    pub(super) method: Method,
}

/// Reads `NAME:k=v,k=v`; what has no `=` goes on with the value before it.
pub(super) fn named(text: &str) -> Result<Named, Failure> {
    let (preset, settings) = text.split_once(':').unwrap_or((text, ""));
    let mut pairs: Vec<(&str, String)> = Vec::new();
    for part in settings.split(',').filter(|part| !part.is_empty()) {
        match (part.split_once('='), pairs.last_mut()) {
            (Some((name, value)), _) => pairs.push((name, value.to_owned())),
            (None, Some((_, value))) => *value = format!("{value},{part}"),
            (None, None) => return Err(Failure::usage("parameter", format!("{text:?}: write NAME:k=v,k=v"))),
        }
    }
    Ok(Named { label: text.to_owned(), method: Method::with(preset, pairs)? })
}

impl Args {
    /// Whether errors are told as JSON.
    pub(crate) fn json_errors(&self) -> bool {
        self.json.as_deref() == Some(Path::new("-"))
    }

    fn methods(&self) -> Result<Vec<Named>, Failure> {
        let wanted: Vec<String> = match self.presets.is_empty() {
            true => PRESETS.iter().map(|p| p.0.to_owned()).filter(|p| p != SLOW || self.crop.is_some()).collect(),
            false => self.presets.clone(),
        };
        let mut methods = vec![named(BASE)?];
        for text in wanted {
            let method = named(&text)?;
            let has = method.method.parameters().iter().any(|(name, _)| *name == "tolerance");
            let tolerances = self.tolerance.iter().filter(|_| has).map(|e| {
                let comma = if text.contains(':') { ',' } else { ':' };
                named(&format!("{text}{comma}tolerance={e}"))
            });
            for method in [Ok(method)].into_iter().chain(tolerances) {
                let method = method?;
                if !methods.iter().any(|known| known.label == method.label) {
                    methods.push(method);
                }
            }
        }
        Ok(methods)
    }

    /// Files that are written, made before the work.
    fn outputs(&self) -> Result<[Option<AtomicFile>; 4], Failure> {
        let json = self.json.as_ref().filter(|_| !self.json_errors());
        let make = |path: Option<&PathBuf>| path.map(|path| AtomicFile::create(path)).transpose();
        Ok([make(json)?, make(self.csv.as_ref())?, make(self.html.as_ref())?, make(self.svg.as_ref())?])
    }
}

impl From<MeasureError> for Failure {
    fn from(error: MeasureError) -> Self {
        match error {
            MeasureError::Stopped(stopped) => stopped.into(),
            MeasureError::Picture(error) => error.into(),
            MeasureError::Size(error) => Self::input("picture_size", error),
        }
    }
}

/// One measurement that the report needs.
struct Job {
    /// Indices of the data set and of its source.
    set: usize,
    source: usize,
    part: Rect,
    method: usize,
    key: Key,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if args.data.is_empty() && args.folder.is_empty() && args.synth.is_empty() {
        return Err(Failure::usage("no_data", "nothing to measure: give --data, --folder or --synth"));
    }
    let methods = args.methods()?;
    let cost = args.cost.as_deref().map(read_cost).transpose()?;
    let outputs = args.outputs()?;
    let mut state = match &args.state {
        Some(path) => State::open(path).map_err(|error| state_failure(path, &error))?,
        None => State::default(),
    };
    let stop = progress::interrupted();
    let execution = Execution { stop: Some(&stop), ..Execution::default() };
    let wanted = Wanted {
        data: &args.data,
        folders: &args.folder,
        synth: &args.synth,
        spp: args.spp.iter().copied().max().unwrap_or(8),
        reference_spp: args.reference_spp,
        seed: args.seed,
    };
    let sets = data::find(&wanted, &execution)?;
    let jobs = jobs(args, &sets, &methods)?;
    measure_all(args, &sets, &methods, &jobs, &mut state, &stop)?;

    let measured = jobs.iter().filter_map(|job| {
        let measurement: &Measurement = state.get(&job.key)?;
        Some((job.key.clone(), methods[job.method].label.clone(), measurement.clone()))
    });
    // What is known of a whole image says little of a part of it.
    let own = |job: &Job| if job.key.part { Own::default() } else { sets[job.set].own };
    let own: BTreeMap<String, Own> = jobs.iter().map(|job| (job.key.data.clone(), own(job))).collect();
    let rows = rows(&measured.collect::<Vec<_>>(), &own);
    let mut references = BTreeMap::new();
    for job in &jobs {
        if !references.contains_key(&job.key.data) {
            let picture = middle(&sets[job.set].reference_of(job.part), job.part.width as usize)?;
            references.insert(job.key.data.clone(), picture);
        }
    }
    write(args, &rows, &references, cost.as_ref(), outputs)
}

/// What `rpfd cost` has written.
fn read_cost(path: &Path) -> Result<Costs, Failure> {
    let fail = |code, error: &dyn std::fmt::Display| Failure::input(code, format!("{}: {error}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| fail("io", &error))?;
    cost::show::from_json(&text)
        .map_err(|error| fail("bad_json", &format!("not what rpfd cost --json writes: {error}")))
}

fn state_failure(path: &Path, error: &std::io::Error) -> Failure {
    let message = format!("{}: {error}", path.display());
    match error.kind() {
        std::io::ErrorKind::InvalidData => Failure::input("bad_state", message),
        _ => Failure::failed("output_io", message),
    }
}

/// Everything that is to be measured, in the order of the report.
fn jobs(args: &Args, sets: &[DataSet], methods: &[Named]) -> Result<Vec<Job>, Failure> {
    let mut jobs = Vec::new();
    let (version, cpu) = (Machine::build(), Machine::here(args.simd.level).cpu);
    for (index, set) in sets.iter().enumerate() {
        let image = Rect::new(0, 0, set.image[0], set.image[1]);
        if let Some(part) = args.crop.filter(|part| image.intersection(part) != Some(*part)) {
            let [width, height] = set.image;
            return Err(Failure::usage("crop", format!("{part} does not lie inside {}: {width} x {height}", set.name)));
        }
        let mut counts = if args.spp.is_empty() { set.counts() } else { args.spp.clone() };
        counts.sort_unstable();
        counts.dedup();
        for spp in counts {
            let Some(source) = set.serving(spp) else {
                eprintln!("rpfd: {} has fewer than {spp} samples per pixel: left out", set.name);
                continue;
            };
            for part in [image].into_iter().chain(args.crop) {
                let data = if part == image { set.name.clone() } else { format!("{} {part}", set.name) };
                for (number, named) in methods.iter().enumerate() {
                    if args.crop.is_some() && part == image && named.method.preset_name() == SLOW {
                        continue;
                    }
                    let key = |threads: u32, repeat| Key {
                        data: data.clone(),
                        content: set.content(source),
                        crop: [part.x, part.y, part.width, part.height],
                        part: part != image,
                        spp,
                        preset: named.method.preset_name().to_owned(),
                        parameters: Key::parameters_of(&named.method),
                        threads: threads as usize,
                        simd: args.simd.level.name().to_owned(),
                        cpu: cpu.clone(),
                        seed: args.seed,
                        repeat,
                        version: version.clone(),
                    };
                    let keys = args.threads.iter().flat_map(|&t| (0..args.repeats).map(move |r| (t, r)));
                    let job = |(t, r)| Job { set: index, source, part, method: number, key: key(t, r) };
                    jobs.extend(keys.map(job));
                }
            }
        }
    }
    if jobs.is_empty() {
        return Err(Failure::usage("no_data", "nothing to measure: no data set has as many samples per pixel"));
    }
    Ok(jobs)
}

/// Samples that are in memory: an image's, and the part and number of them that is measured.
#[derive(Default)]
struct Loaded {
    whole: Option<((usize, usize), SampleTile)>,
    cut: Option<(CutOf, Cut)>,
}

/// Data set, source, part, and samples per pixel.
type CutOf = (usize, usize, Rect, u32);

/// Samples and their reference.
type Cut = (SampleTile, Vec<[f32; 3]>);

impl Loaded {
    /// The samples of a job, and its reference.
    fn of(&mut self, job: &Job, set: &DataSet, stop: &AtomicBool) -> Result<&Cut, Failure> {
        let cut_of = (job.set, job.source, job.part, job.key.spp);
        let cut = match self.cut.take().filter(|(of, _)| *of == cut_of) {
            Some((_, cut)) => cut,
            None => {
                let from = (job.set, job.source);
                // Another image's memory is free before.
                let tile = match self.whole.take().filter(|(of, _)| *of == from) {
                    Some((_, tile)) => tile,
                    None => set.read(job.source, &Execution { stop: Some(stop), ..Execution::default() })?,
                };
                let few = subset(&tile, job.part, job.key.spp);
                self.whole = Some((from, tile));
                (few.map_err(|error| Failure::input("samples", error))?, set.reference_of(job.part))
            }
        };
        Ok(&self.cut.insert((cut_of, cut)).1)
    }
}

/// Makes the measurements that are not there yet.
fn measure_all(
    args: &Args,
    sets: &[DataSet],
    methods: &[Named],
    jobs: &[Job],
    state: &mut State,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let mut pools: BTreeMap<usize, Option<rayon::ThreadPool>> = BTreeMap::new();
    for &threads in &args.threads {
        let pool = (threads > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(threads as usize).build());
        let pool = pool.transpose();
        let pool =
            pool.map_err(|error| Failure::failed("threads", format!("cannot start {threads} threads: {error}")))?;
        pools.insert(threads as usize, pool);
    }
    let bar = progress::bar("measuring", jobs.len() as u64 * STEPS);
    let mut loaded = Loaded::default();
    for (done, job) in jobs.iter().enumerate() {
        let position = done as u64 * STEPS;
        bar.set_position(position);
        if state.get(&job.key).is_some() {
            continue;
        }
        let (tile, reference) = loaded.of(job, &sets[job.set], stop)?;
        let measurement = one(job, methods, tile, reference, (&pools, args.simd.level, stop), (&bar, position))?;
        let add = state.add(job.key.clone(), measurement);
        add.map_err(|error| Failure::failed("output_io", format!("the state file: {error}")))?;
    }
    bar.finish_and_clear();
    Ok(())
}

fn one(
    job: &Job,
    methods: &[Named],
    tile: &SampleTile,
    reference: &[[f32; 3]],
    (pools, simd, stop): (&BTreeMap<usize, Option<rayon::ThreadPool>>, SimdLevel, &AtomicBool),
    (bar, position): (&ProgressBar, u64),
) -> Result<Measurement, Failure> {
    let report = |share: f32| bar.set_position(position + (share * STEPS as f32) as u64);
    let execution = Execution {
        seed: job.key.seed,
        pool: pools.get(&job.key.threads).and_then(Option::as_ref),
        stop: Some(stop),
        progress: Some(&report),
        simd,
        ..Execution::default()
    };
    let mut measurement = measure(tile, reference, &methods[job.method].method, &execution)?;
    if job.key.repeat > 0 {
        measurement.pictures = None;
    }
    Ok(measurement)
}

fn write(
    args: &Args,
    rows: &[Row],
    references: &BTreeMap<String, String>,
    cost: Option<&Costs>,
    outputs: [Option<AtomicFile>; 4],
) -> Result<(), Failure> {
    let (machine, seconds_per_sample) = (Machine::here(args.simd.level), args.seconds_per_sample);
    let json = || format!("{:#}\n", table::json(rows, seconds_per_sample, &machine));
    let html = || page(&Page { rows, references, machine: &machine, seconds_per_sample, cost });
    // Whole images where there are such.
    let plotted: Vec<Row> =
        rows.iter().filter(|row| !row.key.part || rows.iter().all(|row| row.key.part)).cloned().collect();
    let plots = || svg::draw(&plots::error_time(&plotted), 3);
    let contents: [&dyn Fn() -> String; 4] = [&json, &|| table::csv(rows, seconds_per_sample), &html, &plots];
    crate::cli::write_texts(outputs, contents)?;
    if args.json_errors() {
        say!("{}", json().trim_end());
        return Ok(());
    }
    let Machine { cpu, cores, simd, os, version } = &machine;
    say!("{version} on {cpu}, {cores} processors, SIMD {simd}, {os}\n");
    say!("{}", table::text(&table::cells(rows, seconds_per_sample)));
    say!("{}", table::notes(rows, seconds_per_sample).join("\n"));
    for (_, table, note) in table::others(rows) {
        say!("\n{}\n{note}", table::text(&table));
    }
    say!("\n{}", table::formulas());
    for path in [&args.csv, &args.html, &args.svg].into_iter().flatten() {
        say!("{}", path.display());
    }
    Ok(())
}
