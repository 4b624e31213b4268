//! `rpfd filter`: a file of tiles in, an EXR out, without a service.

use super::{
    args::{ExrArgs, MethodArgs, SimdArgs, ThreadArgs},
    failure::Failure,
    input::Input,
    progress,
    schedule::{Schedule, Way, cut_tiles},
};
use crate::{
    config::ByteSize,
    filter::{Execution, Filtered, Halo, Method, SampleTile, SimdLevel, Stopped, filter},
    picture::write_png,
    stitch::{ExrOptions, Offer, Pixels, Stitcher, atomic::AtomicFile},
    store::spool::Spool,
    wire::message::WorkCounts,
};
use indicatif::{HumanBytes, ProgressBar};
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

/// Denoise a file of tiles into an EXR
///
/// The file is looked through first and then filtered in bounded memory, whatever tiling it has: bare cores, tiles with
/// a halo, one huge tile. Tiles that bring the halo that the preset reads are filtered as they come; others are cut anew
/// from their cores, which are kept in memory if they fit, else in a temporary file. The EXR is the same in all cases.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// File of tiles, plain or zstd-compressed
    #[arg(value_name = "IN.tiles[.zst]")]
    input: PathBuf,
    /// EXR to write; it appears when it is whole
    #[arg(short, long, value_name = "OUT.exr")]
    output: PathBuf,
    /// Write a PNG to look at as well: sRGB, clipped
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    /// Write the image even if tiles are missing; they are left black
    #[arg(long)]
    partial: bool,
    /// Memory to use at most, tiles, spool and scratch together
    #[arg(long, value_name = "SIZE", default_value = "2GiB")]
    memory: ByteSize,
    /// Folder for temporary files, which have no name; that of the EXR by default
    #[arg(long, value_name = "DIR")]
    temp_dir: Option<PathBuf>,
    #[command(flatten)]
    threads: ThreadArgs,
    #[command(flatten)]
    simd: SimdArgs,
    /// Print what was done as JSON
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    exr: ExrArgs,
}

const EXAMPLES: &str = "\
Examples:
  rpfd filter render.tiles.zst -o render.exr --png render.png
  rpfd filter huge.tiles -o huge.exr --memory 512MiB --temp-dir /scratch
  rpfd filter render.tiles -o render.exr --preset paper-fast --set bins=9 --half --compression piz";

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let method = args.method.method()?;
    if args.png.as_ref() == Some(&args.output) {
        return Err(Failure::usage("same_output", "--png and --output name the same file"));
    }
    // What cannot be written is found out before the work.
    for path in [Some(&args.output), args.png.as_ref()].into_iter().flatten() {
        AtomicFile::create(path)?;
    }
    let input = Input::scan(&args.input)?;
    input.check(Some(args.partial))?;
    let folder = args.temp_dir.as_deref().unwrap_or_else(|| folder_of(&args.output));
    let offline = Offline {
        method,
        seed: args.method.seed,
        leave_out: args.method.leave_out(),
        simd: args.simd.level,
        threads: args.threads.count(),
        pool: args.threads.pool()?,
        stop: progress::interrupted(),
        memory: args.memory,
        folder,
    };
    let started = Instant::now();
    let run = offline.run(&input)?;
    let seconds = started.elapsed().as_secs_f64();
    let exr = write_exr(&run.stitcher, &args.exr.options(&offline.method, offline.seed), args.partial, &args.output)?;
    let mut files = vec![json!({ "path": args.output, "bytes": exr.bytes, "saturated": exr.saturated })];
    if let Some(path) = &args.png {
        write_picture(&run.stitcher, path)?;
        files.push(json!({ "path": path }));
    }
    let report = run.report(&offline, &input, seconds);
    if args.json {
        let mut report = report;
        report["files"] = files.into();
        say!("{report:#}");
    } else {
        print_summary(args, &run, seconds);
    }
    Ok(())
}

/// The folder that a file is in.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes the stitched image.
pub(crate) fn write_exr(
    stitcher: &Stitcher,
    options: &ExrOptions,
    partial: bool,
    path: &Path,
) -> Result<crate::stitch::ExrSummary, Failure> {
    let spinner = progress::spinner(format!("writing {}", path.display()));
    let summary = stitcher.write_exr(options, partial, path)?;
    spinner.finish_and_clear();
    Ok(summary)
}

fn write_picture(stitcher: &Stitcher, path: &Path) -> Result<(), Failure> {
    let mut file = AtomicFile::create(path)?;
    let (pixels, image) = (stitcher.pixels(), stitcher.image());
    write_png(file.out(), image.width, image.height, |y, row| {
        Ok(pixels.read(crate::filter::Rect::new(0, y, image.width, 1), row)?)
    })?;
    Ok(file.commit()?)
}

/// How files of tiles are filtered here.
pub(crate) struct Offline<'a> {
    pub(crate) method: Method,
    pub(crate) seed: u64,
    /// Whether what can have no effect is left out.
    pub(crate) leave_out: bool,
    pub(crate) simd: SimdLevel,
    pub(crate) threads: usize,
    pub(crate) pool: Option<rayon::ThreadPool>,
    pub(crate) stop: Arc<AtomicBool>,
    pub(crate) memory: ByteSize,
    /// For the canvas, and for what does not fit in memory.
    pub(crate) folder: &'a Path,
}

/// What came of a file.
pub(crate) struct Run {
    pub(crate) stitcher: Stitcher,
    schedule: Schedule,
    /// The narrowest halo that a tile had, by side, of those that needed any there.
    halo_had: Option<Halo>,
}

impl Offline<'_> {
    /// Filters all tiles of a file, which has been checked.
    pub(crate) fn run(&self, input: &Input) -> Result<Run, Failure> {
        let schedule = Schedule::new(input, &self.method, self.threads, self.memory)?;
        if let Way::Cut { on_disk: true, .. } = schedule.way {
            let (bytes, folder) = (HumanBytes(input.summary.spool_bytes), self.folder.display());
            let memory = HumanBytes(self.memory.0);
            eprintln!("rpfd: spooling {bytes} of samples to a temporary file in {folder}, since --memory is {memory}");
        }
        let [width, height] = input.image();
        let stitcher = Stitcher::new(width, height, self.folder)?;
        let mut run = Run { stitcher, schedule, halo_had: None };
        let total = u64::from(width) * u64::from(height);
        let Way::Cut { size, on_disk } = run.schedule.way else {
            self.as_they_come(input, &mut run, &progress::bar("filtering", total))?;
            return Ok(run);
        };
        let bytes = input.summary.spool_bytes;
        let mut spool = if on_disk { Spool::on_disk(self.folder, bytes)? } else { Spool::in_memory(bytes) };
        input.fill(&mut spool, &self.stop)?;
        let bar = progress::bar("filtering", total);
        for geometry in cut_tiles(input, &self.method, size) {
            self.tile(&mut run, &spool.cut_partial(geometry)?, &bar)?;
        }
        bar.finish_and_clear();
        Ok(run)
    }

    fn as_they_come(&self, input: &Input, run: &mut Run, bar: &ProgressBar) -> Result<(), Failure> {
        let mut file = input.open()?;
        for expected in &input.summary.tiles {
            // Planned was what the first look at the file has found.
            let header = file
                .next_header()?
                .filter(|header| *header.geometry() == expected.geometry && header.total() == expected.samples);
            let Some(header) = header else {
                let path = input.path.display();
                return Err(Failure::input("changed", format!("{path}: it has changed while it was read")));
            };
            self.tile(run, &file.read_tile(&header)?, bar)?;
        }
        bar.finish_and_clear();
        Ok(())
    }

    fn tile(&self, run: &mut Run, tile: &SampleTile, bar: &ProgressBar) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Stopped.into());
        }
        let core = tile.geometry().core();
        let before = bar.position();
        let advance = |share: f32| bar.set_position(before + (f64::from(share) * core.area() as f64) as u64);
        let execution = Execution {
            seed: self.seed,
            pool: self.pool.as_ref(),
            stop: Some(&self.stop),
            progress: Some(&advance),
            leave_out: self.leave_out,
            simd: self.simd,
        };
        let filtered = filter(tile, &self.method, &execution)?;
        bar.set_position(before + core.area());
        run.note(&filtered);
        // No core comes twice: the file was checked for that.
        match run.stitcher.offer(core, [0; 32], false)? {
            Offer::Filter(claim) => drop(run.stitcher.add(claim, &filtered)?),
            Offer::Repeated => {}
        }
        Ok(())
    }
}

impl Run {
    /// Sums up what the stitcher does not.
    fn note(&mut self, filtered: &Filtered) {
        let (had, needed) = (filtered.report.halo, filtered.report.halo_needed);
        let narrowest =
            self.halo_had.get_or_insert(Halo { left: u32::MAX, top: u32::MAX, right: u32::MAX, bottom: u32::MAX });
        for (narrowest, had, needed) in [
            (&mut narrowest.left, had.left, needed.left),
            (&mut narrowest.top, had.top, needed.top),
            (&mut narrowest.right, had.right, needed.right),
            (&mut narrowest.bottom, had.bottom, needed.bottom),
        ] {
            // At the image's edge there is no more to be had.
            if needed > 0 {
                *narrowest = (*narrowest).min(had);
            }
        }
    }

    /// All of it, for programs.
    pub(crate) fn report(&self, offline: &Offline, input: &Input, seconds: f64) -> Value {
        let totals = self.stitcher.totals();
        let sides = |halo: Halo| [halo.left, halo.top, halo.right, halo.bottom];
        let had = sides(self.halo_had.unwrap_or_default()).map(|side| (side < u32::MAX).then_some(side));
        let left_out = self.stitcher.left_out().iter();
        let (way, spooled) = match self.schedule.way {
            Way::AsTheyCome => (json!("as they come"), json!(null)),
            Way::Cut { size, on_disk } => {
                let place = if on_disk { "disk" } else { "memory" };
                (json!({ "cut": size }), json!({ "bytes": input.summary.spool_bytes, "in": place }))
            }
        };
        let replaced = totals.replaced;
        let ratio = totals.energy_out / totals.energy_in;
        json!({
            "image": input.image(),
            "seconds": seconds,
            "threads": offline.threads,
            "simd": offline.simd.name(),
            "preset": offline.method.preset_name(),
            "seed": offline.seed,
            "parameters": offline.method.parameters().into_iter().collect::<BTreeMap<_, _>>(),
            "tiles": totals.tiles,
            "tiling": way,
            "pixels": totals.pixels,
            "missing_pixels": u64::from(input.image()[0]) * u64::from(input.image()[1]) - totals.pixels,
            "samples": totals.samples,
            "spikes": totals.spikes,
            "replaced": {
                "color": replaced.color, "feature": replaced.feature, "random": replaced.random, "film": replaced.film,
            },
            "filled": totals.filled,
            "unfilled": totals.unfilled,
            "energy_in": totals.energy_in,
            "energy_out": totals.energy_out,
            "energy_ratio": ratio.is_finite().then_some(ratio),
            "halo_had": had,
            "halo_needed": sides(totals.halo_needed),
            "short_of_halo": totals.short_of_halo,
            "leave_out": offline.leave_out,
            "left_out": left_out
                .map(|((plane, reason), tiles)| json!({ "plane": plane, "reason": reason, "tiles": tiles }))
                .collect::<Vec<_>>(),
            "settled": totals.settled,
            "settled_error": totals.settled_error,
            "left_out_bytes": totals.left_out_bytes,
            "work": totals.work.map(WorkCounts::from),
            "memory": { "limit": offline.memory.0, "planned": self.schedule.bytes },
            "spool": spooled,
        })
    }
}

/// Why planes were left out.
fn reason_in_words(reason: &str) -> &str {
    match reason {
        "constant" => "they are constant",
        "missing" => "no sample has them",
        "unused" => "the method does not look at them",
        "equal" => "they equal an earlier colour plane",
        other => other,
    }
}

fn print_summary(args: &Args, run: &Run, seconds: f64) {
    let totals = run.stitcher.totals();
    let image = run.stitcher.image();
    say!(
        "{}: {} x {} pixels, {} samples in {} tiles, {seconds:.1} s",
        args.output.display(),
        image.width,
        image.height,
        totals.samples,
        totals.tiles
    );
    if let Some(png) = &args.png {
        say!("{}: to look at", png.display());
    }
    say!(
        "energy {:.4} of the input's, {} colour values were spikes",
        totals.energy_out / totals.energy_in,
        totals.spikes
    );
    let mut left_out: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (plane, reason) in run.stitcher.left_out().keys() {
        left_out.entry(reason).or_default().push(plane);
    }
    for (reason, planes) in left_out {
        say!("left out, since {}: {}", reason_in_words(reason), planes.join(", "));
    }
    if let Some(work) = totals.work.filter(|work| work.saved() > 0) {
        let bytes = HumanBytes(totals.left_out_bytes);
        say!("which saved about {:.0} % of the work, and {bytes} of planes", 100.0 * work.saved_share());
    }
    if totals.settled > 0 {
        let (share, error) =
            (totals.settled as f64 / totals.pixels as f64, totals.settled_error / totals.pixels as f64);
        let percent = 100.0 * share;
        say!(
            "{} pixels ({percent:.1} %) were within the tolerance and passed through: relMSE + {error:.2e} at most, on average",
            totals.settled
        );
    }
    if totals.replaced.total() > 0 {
        say!("{} values were not finite and were replaced", totals.replaced.total());
    }
    if totals.unfilled > 0 {
        say!("{} pixels have no samples anywhere near and stay black", totals.unfilled);
    }
    let missing = image.area() - totals.pixels;
    if missing > 0 {
        say!("{missing} pixels are missing and are black");
    }
}
