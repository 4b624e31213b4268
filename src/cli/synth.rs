//! `rpfd synth`.

use super::{
    args::{ThreadArgs, size},
    failure::Failure,
    filter::{folder_of, write_exr},
    progress,
};
use crate::{
    filter::{Execution, Filtered, Rect, Report, TileGeometry, geometry::tiling},
    stitch::{ExrOptions, Offer, Stitcher, atomic::AtomicFile},
    synth::{Scene, scenes},
    wire::{Format, Header, file::TileWriter},
};
use serde_json::json;
use std::{collections::BTreeMap, path::PathBuf, sync::LazyLock, time::Instant};

/// Make a tile stream of any size from a small path tracer
///
/// One tile at a time is in memory. Compressed if the name ends in .zst; the file appears when it is whole.
#[derive(clap::Args)]
#[command(after_help = HELP.as_str())]
pub(crate) struct Args {
    /// Width and height of the image in pixels
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: [u32; 2],
    /// Samples per pixel
    #[arg(long, value_name = "N")]
    spp: u32,
    /// File to write
    #[arg(short, long, value_name = "OUT.tiles[.zst]")]
    output: PathBuf,
    /// What to render: one of those below
    #[arg(long, value_name = "NAME", default_value = "all", value_parser = names())]
    scene: String,
    /// Width and height of the tiles' cores; as large as the image for one huge tile
    #[arg(long, value_name = "PIXELS", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    tile: u32,
    /// Context around each core
    #[arg(long, value_name = "PIXELS", default_value_t = 0)]
    halo: u32,
    /// Keys every random draw
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Format of the values
    #[arg(long, value_name = "FORMAT", default_value = "f32", value_parser = ["f32", "f16"])]
    format: String,
    /// Give each pixel 0 to --spp samples, at random
    #[arg(long)]
    varying: bool,
    /// Write the converged image as well
    #[arg(long, value_name = "REF.exr")]
    reference: Option<PathBuf>,
    /// Samples per pixel of the reference
    #[arg(long, value_name = "N", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(2..))]
    reference_spp: u32,
    #[command(flatten)]
    threads: ThreadArgs,
    /// Print what was done as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

static HELP: LazyLock<String> = LazyLock::new(|| {
    let scenes = scenes().iter().map(|(name, what)| format!("  {name:<12}{what}\n"));
    format!(
        "Scenes:\n{}\nExamples:\n  \
         rpfd synth --size 256x256 --spp 8 -o all.tiles.zst --reference all.exr\n  \
         rpfd synth --size 4096x4096 --spp 4 --scene glossy -o large.tiles\n  \
         rpfd synth --size 512x512 --spp 8 --tile 64 --halo 17 --varying -o haloed.tiles",
        scenes.collect::<String>()
    )
});

fn names() -> clap::builder::PossibleValuesParser {
    scenes().iter().map(|(name, _)| *name).collect::<Vec<_>>().into()
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let started = Instant::now();
    let Some(scene) = Scene::by_name(&args.scene) else {
        return Err(Failure::usage("scene", format!("no scene has the name {:?}", args.scene)));
    };
    if let Some(reference) = &args.reference {
        // What cannot be written is found out before the work.
        AtomicFile::create(reference)?;
    }
    let (pool, stop) = (args.threads.pool()?, progress::interrupted());
    let execution = Execution { seed: args.seed, pool: pool.as_ref(), stop: Some(&stop), ..Execution::default() };
    let written = tiles(args, &scene, &execution)?;
    let mut report = json!({
        "image": args.size, "scene": args.scene, "seed": args.seed, "tiles": written.tiles, "samples": written.samples,
        "files": [{ "path": args.output }],
    });
    if let Some(path) = &args.reference {
        let errors = reference(args, &scene, &execution, path)?;
        report["reference"] = json!({ "path": path, "relmse": errors[0], "mse": errors[1] });
    }
    let seconds = started.elapsed().as_secs_f64();
    report["seconds"] = seconds.into();
    if args.json {
        say!("{report:#}");
    } else {
        let Written { tiles, samples } = written;
        say!("{}: {samples} samples in {tiles} tiles, {seconds:.1} s", args.output.display());
        if let (Some(path), Some(relmse)) = (&args.reference, report["reference"]["relmse"].as_f64()) {
            say!("{}: its own relMSE is about {relmse:.2e}", path.display());
        }
    }
    Ok(())
}

struct Written {
    tiles: u64,
    /// In the cores and halos.
    samples: u64,
}

fn tiles(args: &Args, scene: &Scene, execution: &Execution) -> Result<Written, Failure> {
    let mut file = TileWriter::create(&args.output).map_err(|error| Failure::output(&error))?;
    let format = if args.format == "f16" { Format::F16 } else { Format::F32 };
    let bar = progress::bar("rendering", u64::from(args.size[0]) * u64::from(args.size[1]));
    let mut written = Written { tiles: 0, samples: 0 };
    for core in tiling(args.size, args.tile) {
        let geometry = TileGeometry::with_halo(args.size, core, args.halo)
            .map_err(|error| Failure::usage("bad_geometry", error))?;
        let tile = match args.varying {
            true => scene.tile_varying(geometry, args.spp, execution)?,
            false => scene.tile(geometry, args.spp, execution)?,
        };
        let header = Header::of(&tile, format).map_err(|fault| Failure::usage(fault.code(), fault))?;
        file.write_tile(&header, &tile).map_err(|error| Failure::output(&error))?;
        written.tiles += 1;
        written.samples += tile.total() as u64;
        bar.inc(core.area());
    }
    bar.finish_and_clear();
    file.finish().map_err(|error| Failure::output(&error))?;
    Ok(written)
}

/// Writes the converged image; says its own relMSE and MSE.
fn reference(args: &Args, scene: &Scene, execution: &Execution, path: &std::path::Path) -> Result<[f64; 2], Failure> {
    /// Side of the parts that are in memory at a time.
    const PART: u32 = 128;
    let [width, height] = args.size;
    let mut stitcher = Stitcher::new(width, height, folder_of(path))?;
    let bar = progress::bar("reference", u64::from(width) * u64::from(height));
    let mut errors = [0.0; 2];
    for core in tiling(args.size, PART) {
        let part = scene.reference(args.size, core, args.reference_spp, execution)?;
        let share = core.area() as f64 / Rect::new(0, 0, width, height).area() as f64;
        errors[0] += part.relmse * share;
        errors[1] += part.mse * share;
        let filtered = Filtered { core, rgb: part.rgb, report: Report::default() };
        if let Offer::Filter(claim) = stitcher.offer(core, [0; 32], false)? {
            stitcher.add(claim, &filtered)?;
        }
        bar.inc(core.area());
    }
    bar.finish_and_clear();
    let attributes = [
        ("software", format!("rpfd {}", env!("CARGO_PKG_VERSION"))),
        ("rpfd:scene", args.scene.clone()),
        ("rpfd:seed", args.seed.to_string()),
        ("rpfd:samples", args.reference_spp.to_string()),
    ];
    let attributes: BTreeMap<_, _> = attributes.map(|(name, value)| (name.to_owned(), value)).into();
    write_exr(&stitcher, &ExrOptions { attributes, ..ExrOptions::default() }, false, path)?;
    Ok(errors)
}
