//! `rpfd post`: a file of tiles through a service.

use super::{
    args::{ExrArgs, MethodArgs},
    failure::Failure,
    filter::folder_of,
    input::Input,
    progress,
    schedule::cut_tiles,
    token::read_secret,
};
use crate::{
    client::{Client, ClientError, State},
    filter::{Halo, SampleTile, Stopped, TileGeometry, geometry::tiling},
    image::description::channels_to_json,
    service::auth::check_token,
    stitch::atomic::AtomicFile,
    store::spool::Spool,
    wire::{Format, Header, encode_tile, value::Number},
};
use indicatif::HumanBytes;
use serde_json::json;
use std::{
    hash::{BuildHasher, RandomState},
    io::Write,
    path::{Path, PathBuf},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

/// Samples up to this size are kept in memory while they are sent.
const IN_MEMORY: u64 = 256 << 20;

/// Have a service denoise a file of tiles, and fetch the EXR
///
/// Cuts tiles with the halo that the preset reads, or bare ones with --halo neighbors, sends them, and fetches the stitched image. What fails on the way is
/// sent again. With --id, a run that was cut off can be run again: tiles that the service has are not filtered twice.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// File of tiles, plain or zstd-compressed
    #[arg(value_name = "IN.tiles[.zst]")]
    input: PathBuf,
    /// Address of the service
    #[arg(long, value_name = "URL")]
    to: String,
    /// EXR to write; it appears when it is whole
    #[arg(short, long, value_name = "OUT.exr")]
    output: PathBuf,
    /// File with the token that the service wants to see; by default the one in the environment variable RPFD_TOKEN
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Who brings the context around tiles: client, this command with every tile; neighbors, the tiles around it, so that
    /// every sample is sent once
    #[arg(long, value_name = "WHO", default_value = "client", value_parser = ["client", "neighbors"])]
    halo: String,
    /// Width and height of the cores that are sent
    #[arg(long, value_name = "PIXELS", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    tile: u32,
    /// Name of the image at the service, which then keeps it; by default one that nobody has, forgotten after the fetch
    #[arg(long)]
    id: Option<String>,
    /// Tiles under way at a time; each takes the memory of its samples twice
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=64))]
    connections: u32,
    /// How often to try each call
    #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..))]
    attempts: u32,
    /// Folder for temporary files, which have no name; that of the EXR by default
    #[arg(long, value_name = "DIR")]
    temp_dir: Option<PathBuf>,
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
  rpfd post render.tiles.zst --to http://localhost:8080 -o render.exr
  rpfd post render.tiles --to http://localhost:8080 -o render.exr --halo neighbors --tile 128
  rpfd post render.tiles --to https://farm.example -o render.exr --preset paper-fast --id shot-12-frame-7";

impl Args {
    /// The token, which is never on the command line: others may read that.
    fn token(&self) -> Result<Option<String>, Failure> {
        let token = match (&self.token_file, std::env::var("RPFD_TOKEN")) {
            (Some(path), _) => read_secret(path)?,
            (None, Ok(token)) => {
                let wrong = |error| Failure::usage("bad_token", format!("RPFD_TOKEN: {error}"));
                check_token(token.trim()).map_err(wrong)?;
                token.trim().to_owned()
            }
            (None, Err(_)) => return Ok(None),
        };
        Ok(Some(token))
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let method = args.method.method()?;
    AtomicFile::create(&args.output)?;
    let stop = progress::interrupted();
    let token = args.token()?;
    let client = Client::with_token(&args.to, args.attempts, stop.clone(), token.as_deref())?;
    let input = Input::scan(&args.input)?;
    input.check(None)?;
    let started = Instant::now();
    let bytes = input.summary.spool_bytes;
    let folder = args.temp_dir.as_deref().unwrap_or_else(|| folder_of(&args.output));
    let mut spool = if bytes > IN_MEMORY {
        eprintln!("rpfd: spooling {} of samples to a temporary file in {}", HumanBytes(bytes), folder.display());
        Spool::on_disk(folder, bytes)?
    } else {
        Spool::in_memory(bytes)
    };
    input.fill(&mut spool, &stop)?;
    let mut opening = args.method.to_json(&method);
    let neighbors = args.halo == "neighbors";
    let tiles: Vec<TileGeometry> = if neighbors {
        announce(&input, &mut opening);
        let cores = tiling(input.image(), args.tile);
        cores.filter_map(|core| TileGeometry::new(input.image(), core, Halo::default()).ok()).collect()
    } else {
        cut_tiles(&input, &method, args.tile).collect()
    };
    let id = args.id.clone().unwrap_or_else(new_id);
    client.open_image(&id, input.image(), opening)?;
    let sending = Sending { client: &client, id: &id, connections: args.connections, stop: &stop };
    let fetched = sending.send(&input, &spool, &tiles).and_then(|sent| {
        sending.fetch(neighbors || sent.stored > 0, &args.exr.query(), &args.output)?;
        Ok(sent)
    });
    let Sent { tiles, repeated, bytes, .. } = fetched.inspect_err(|_| {
        if args.id.is_none() {
            eprintln!("rpfd: the service knows the image as {id}: run again with --id {id} to go on");
        }
    })?;
    if args.id.is_none() {
        // The image is here: whether the service still has it is not worth failing for.
        let _ = client.delete_image(&id);
    }
    let seconds = started.elapsed().as_secs_f64();
    if args.json {
        let report = json!({
            "id": id, "image": input.image(), "seconds": seconds, "tiles": tiles, "repeated": repeated,
            "bytes_sent": bytes, "files": [{ "path": args.output }],
        });
        say!("{report:#}");
    } else {
        let (output, bytes) = (args.output.display(), HumanBytes(bytes));
        say!("{output}: tiles sent: {tiles} ({bytes}), there already: {repeated}, {seconds:.1} s");
    }
    Ok(())
}

/// Says of an image's tiles what the service must know before they come as bare cores.
fn announce(input: &Input, opening: &mut serde_json::Value) {
    let summary = &input.summary;
    let even = !summary.varying && summary.tiles.iter().all(|tile| tile.max_per_pixel == summary.max_per_pixel);
    opening["halo"] = "neighbors".into();
    opening[if even { "samples" } else { "max_samples" }] = summary.max_per_pixel.into();
    opening["channels"] = channels_to_json(summary.first.channels());
}

/// An id that nobody has.
pub(crate) fn new_id() -> String {
    let random = || RandomState::new().hash_one(std::process::id());
    format!("{:016x}{:016x}", random(), random())
}

/// An image that is open at a service.
pub(crate) struct Sending<'a> {
    pub(crate) client: &'a Client,
    pub(crate) id: &'a str,
    pub(crate) connections: u32,
    pub(crate) stop: &'a AtomicBool,
}

/// What was sent.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sent {
    pub(crate) tiles: u64,
    /// Of these, tiles that were there already.
    pub(crate) repeated: u64,
    /// Of these, tiles that are not filtered yet.
    pub(crate) stored: u64,
    pub(crate) bytes: u64,
}

impl Sending<'_> {
    /// Cuts and sends tiles, several at a time, and waits for all of them. The first failure ends it.
    pub(crate) fn send(&self, input: &Input, spool: &Spool, tiles: &[TileGeometry]) -> Result<Sent, Failure> {
        let bar = progress::bar("sending  ", tiles.len() as u64);
        let (next, sum) = (AtomicUsize::new(0), Mutex::new(Ok(Sent::default())));
        let one = |geometry: &TileGeometry| -> Result<(State, u64), Failure> {
            let bytes = encode(&spool.cut(*geometry)?, &input.summary.first)?;
            let state = self.client.send_tile(self.id, geometry.core(), &bytes)?;
            Ok((state, bytes.len() as u64))
        };
        std::thread::scope(|scope| {
            for _ in 0..self.connections {
                scope.spawn(|| {
                    while let Some(geometry) = tiles.get(next.fetch_add(1, Ordering::Relaxed)) {
                        let sent = if self.stop.load(Ordering::Relaxed) { Err(Stopped.into()) } else { one(geometry) };
                        let mut sum = sum.lock().unwrap_or_else(PoisonError::into_inner);
                        match (&mut *sum, sent) {
                            (Ok(sum), Ok((state, bytes))) => {
                                sum.tiles += 1;
                                sum.repeated += u64::from(state == State::Repeated);
                                sum.stored += u64::from(state == State::Stored);
                                sum.bytes += bytes;
                                bar.inc(1);
                            }
                            // Another connection has failed.
                            (Err(_), _) => return,
                            (Ok(_), Err(failure)) => *sum = Err(failure),
                        }
                    }
                });
            }
        });
        bar.finish_and_clear();
        sum.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Fetches the stitched image; with `wait` tiles that the service has not filtered yet are waited for.
    pub(crate) fn fetch(&self, wait: bool, query: &[(&str, String)], path: &Path) -> Result<(), Failure> {
        let spinner = progress::spinner(format!("fetching {}", path.display()));
        let begin = || AtomicFile::create(path).map_err(|error| ClientError::Output(std::io::Error::other(error)));
        loop {
            match self.client.fetch_exr(self.id, query, begin, |file, bytes| file.out().write_all(bytes)) {
                Err(ClientError::Refused { problem, .. })
                    if wait && problem.code == "image_incomplete" && !self.stop.load(Ordering::Relaxed) =>
                {
                    std::thread::sleep(Duration::from_millis(500));
                }
                fetched => {
                    fetched?.commit()?;
                    spinner.finish_and_clear();
                    return Ok(());
                }
            }
        }
    }
}

/// A tile as it is sent: in half precision the channels that came so, as far as it loses nothing, else in single.
fn encode(tile: &SampleTile, first: &Header) -> Result<Vec<u8>, Failure> {
    let wrong = |fault: crate::wire::Fault| Failure::usage(fault.code(), format!("{fault}; --tile sets their size"));
    let mut header = Header::of(tile, Format::F32).map_err(wrong)?;
    let mut plane = 0;
    for channel in tile.channels().channels() {
        let planes = plane..plane + channel.components as usize;
        plane = planes.end;
        let half = |plane| {
            let exact =
                |value: f32| value.is_nan() || Format::F16.round(Number::F32(value)).to_bits() == value.to_bits();
            first.plane_format(plane) == Format::F16 && (0..tile.total()).all(|i| exact(tile.value(plane, i)))
        };
        if planes.clone().all(half) {
            header = header.with_channel_format(&channel.name, Format::F16).map_err(wrong)?;
        }
    }
    let mut bytes = Vec::new();
    encode_tile(&header, tile, &mut bytes).map_err(|error| Failure::failed("internal", error))?;
    Ok(bytes)
}
