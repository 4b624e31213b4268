//! `rpfd demo`: everything once, on a real render.

use super::{
    args::{MethodArgs, SimdArgs},
    failure::Failure,
    filter::Offline,
    input::Input,
    post::{Sending, Sent, new_id},
    progress,
    schedule::cut_tiles,
};
use crate::{
    client::Client,
    config::{ByteSize, Config},
    filter::{Method, TileGeometry},
    picture::{Panel, write_comparison},
    report::{Errors, errors},
    service::{ServeError, Service},
    stitch::{ExrOptions, RgbImage, atomic::AtomicFile, exr},
    store::spool::Spool,
};
use serde_json::{Value, json};
use std::{
    net::{Ipv4Addr, SocketAddr},
    path::{Path, PathBuf},
    thread::JoinHandle,
    time::Instant,
};
use tokio::sync::oneshot;

/// See it work: a real render through the real service
///
/// Starts the service on a free port of this machine, streams the tiles of a render that the repository carries through
/// it over HTTP, and compares what comes back with the reference.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Folder to write to; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
    /// Print what was found as JSON
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    simd: SimdArgs,
    #[command(flatten)]
    method: MethodArgs,
}

const EXAMPLES: &str = "\
Examples:
  rpfd demo
  rpfd demo --out /tmp/demo --preset paper-fast";

/// The render: what the image is called, the samples, the reference, and the reference's own relMSE (tests/data).
const TILES: &str = "depth_of_field.8spp.tiles.zst";
const REFERENCE: &str = "depth_of_field.reference.exr";
const REFERENCE_RELMSE: f64 = 2.9e-4;

/// Cores that are sent.
const TILE: u32 = 64;
/// Pixels of the picture for each of the image.
const ZOOM: u32 = 4;
/// Pixels that an image may have.
const MAX_PIXELS: u64 = 1 << 24;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let method = args.method.method()?;
    let data = data_folder()?;
    let made = std::fs::create_dir_all(&args.out);
    made.map_err(|error| Failure::failed("output_io", format!("cannot make {}: {error}", args.out.display())))?;
    let [before, after, picture] = ["before.exr", "after.exr", "comparison.png"].map(|name| args.out.join(name));
    for path in [&before, &after, &picture] {
        AtomicFile::create(path)?;
    }
    let input = Input::scan(&data.join(TILES))?;
    input.check(None)?;
    let reference = exr::read(&data.join(REFERENCE), MAX_PIXELS).map_err(|e| Failure::input(e.code(), &e))?;

    let unfiltered = mean(args, &input, &before)?;
    let filtered = through_the_service(args, &method, &input, &after)?;
    let image = |path: &Path| exr::read(path, MAX_PIXELS).map_err(Failure::from);
    let images = [image(&before)?, image(&after)?, reference];
    compare(&images, &picture)?;
    let [mean, denoised, reference] = &images;
    let against = |image: &RgbImage| {
        errors(&image.pixels, &reference.pixels).map_err(|error| Failure::input("picture_size", error))
    };
    let found = [(against(mean)?, unfiltered), (against(denoised)?, filtered.seconds)];
    let files = [before, after, picture];
    if args.json {
        say!("{:#}", report(&method, &input, &found, &filtered, &files));
    } else {
        print(&method, &input, &found, &filtered, &files);
    }
    Ok(())
}

/// Where the repository's data are: where it was built, else here.
fn data_folder() -> Result<PathBuf, Failure> {
    let folders = [Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data"), PathBuf::from("tests/data")];
    folders.into_iter().find(|folder| folder.join(TILES).is_file()).ok_or_else(|| {
        let why = format!("tests/data/{TILES} is not here: run the demo in a clone of the repository");
        Failure::input("not_found", why)
    })
}

/// Writes the mean of each pixel's samples; says how long it took.
fn mean(args: &Args, input: &Input, path: &Path) -> Result<f64, Failure> {
    let started = Instant::now();
    let offline = Offline {
        method: Method::preset("unfiltered")?,
        seed: 0,
        leave_out: true,
        simd: args.simd.level,
        threads: 1,
        pool: None,
        stop: Default::default(),
        memory: ByteSize(1 << 30),
        folder: &args.out,
    };
    offline.run(input)?.stitcher.write_exr(&ExrOptions::default(), false, path)?;
    Ok(started.elapsed().as_secs_f64())
}

/// What went through the service.
struct Filtered {
    address: SocketAddr,
    sent: Sent,
    threads: usize,
    /// From the first tile to the whole EXR.
    seconds: f64,
}

fn through_the_service(args: &Args, method: &Method, input: &Input, path: &Path) -> Result<Filtered, Failure> {
    let stop = progress::interrupted();
    let folder = tempfile::tempdir_in(&args.out)
        .map_err(|error| Failure::failed("output_io", format!("cannot write to {}: {error}", args.out.display())))?;
    let config = Config {
        listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)),
        data_dir: folder.path().to_owned(),
        simd: args.simd.level,
        ..Config::default()
    };
    let threads = config.threads;
    let running = Running::start(config)?;
    let mut spool = Spool::in_memory(input.summary.spool_bytes);
    input.fill(&mut spool, &stop)?;
    let tiles: Vec<TileGeometry> = cut_tiles(input, method, TILE).collect();

    let started = Instant::now();
    let client = Client::new(&format!("http://{}", running.address), 6, stop.clone())?;
    let id = new_id();
    client.open_image(&id, input.image(), args.method.to_json(method))?;
    let sending = Sending { client: &client, id: &id, connections: 2, stop: &stop };
    let sent = sending.send(input, &spool, &tiles)?;
    sending.fetch(sent.stored > 0, &[], path)?;
    let seconds = started.elapsed().as_secs_f64();
    let address = running.address;
    drop(client);
    running.stop()?;
    Ok(Filtered { address, sent, threads, seconds })
}

/// A service on a thread of its own.
struct Running {
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    thread: JoinHandle<Result<(), ServeError>>,
}

impl Running {
    fn start(config: Config) -> Result<Self, Failure> {
        let service = Service::bind(config)?;
        let address = service.local_addr();
        let runtime = tokio::runtime::Runtime::new().map_err(|error| Failure::failed("runtime", error))?;
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::spawn(move || {
            runtime.block_on(service.run(async {
                // If this end is dropped, that is as good.
                let _ = stopped.await;
            }))
        });
        Ok(Self { address, stop, thread })
    }

    fn stop(self) -> Result<(), Failure> {
        let _ = self.stop.send(());
        match self.thread.join() {
            Ok(result) => Ok(result?),
            Err(_) => Err(Failure::failed("internal", "the service has panicked")),
        }
    }
}

fn compare(images: &[RgbImage; 3], path: &Path) -> Result<(), Failure> {
    let labels = ["8 samples", "denoised", "reference"];
    let panels: Vec<_> =
        labels.into_iter().zip(images).map(|(label, image)| Panel { label, pixels: &image.pixels }).collect();
    let mut file = AtomicFile::create(path)?;
    write_comparison(file.out(), images[0].width, images[0].height, &panels, ZOOM)?;
    Ok(file.commit()?)
}

/// Errors, and the seconds that it took.
type Found = [(Errors, f64); 2];

fn report(method: &Method, input: &Input, found: &Found, filtered: &Filtered, files: &[PathBuf; 3]) -> Value {
    let one = |(errors, seconds): &(Errors, f64)| {
        json!({
            "relmse": errors.relmse,
            "relmse_trimmed": errors.relmse_trimmed,
            "mse": errors.mse,
            "psnr": errors.psnr,
            "smape": errors.smape,
            "seconds": seconds,
        })
    };
    json!({
        "image": input.image(),
        "samples": input.summary.samples,
        "preset": method.preset_name(),
        "service": { "address": filtered.address.to_string(), "threads": filtered.threads },
        "tiles": filtered.sent.tiles,
        "bytes_sent": filtered.sent.bytes,
        "before": one(&found[0]),
        "after": one(&found[1]),
        "reference_relmse": REFERENCE_RELMSE,
        "files": files,
    })
}

fn print(method: &Method, input: &Input, found: &Found, filtered: &Filtered, files: &[PathBuf; 3]) {
    let [width, height] = input.image();
    let Filtered { address, sent, threads, .. } = filtered;
    say!("depth of field, {width} x {height} pixels, {} samples, by Mitsuba 3", input.summary.samples);
    say!(
        "{} tiles ({}) through the service at http://{address}, preset {}, {threads} threads\n",
        sent.tiles,
        indicatif::HumanBytes(sent.bytes),
        method.preset_name()
    );
    say!("{:<26} {:>10} {:>10} {:>8}", "", "before", "after", "");
    let [(before, mean), (after, seconds)] = found;
    let row = |name: &str, get: fn(&Errors) -> f64| {
        let (before, after) = (get(before), get(after));
        say!("{name:<26} {before:>10.5} {after:>10.5} {:>7.1}x", before / after);
    };
    row("relMSE", |e| e.relmse);
    row("relMSE, worst 0.1 % off", |e| e.relmse_trimmed);
    row("MSE", |e| e.mse);
    row("SMAPE", |e| e.smape);
    say!("{:<26} {:>10.2} {:>10.2} {:>+7.1}", "PSNR, dB", before.psnr, after.psnr, after.psnr - before.psnr);
    say!("{:<26} {mean:>10.2} {seconds:>10.2}", "seconds");
    say!("\nthe reference's own relMSE is {REFERENCE_RELMSE:.1e}");
    files.iter().for_each(|path| say!("{}", path.display()));
}
