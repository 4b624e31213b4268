//! `rpfd inspect`: what is in a file of tiles, and what is wrong with it.

use super::{
    args::{MethodArgs, ThreadArgs},
    failure::Failure,
    input::Input,
};
use crate::{
    filter::{
        Halo, Method, Role,
        method::{Algorithm, PRESETS},
        plan::{forecast, plan},
    },
    image::description::channels_to_json,
    wire::scan::PlaneSummary,
};
use indicatif::HumanBytes;
use serde_json::{Value, json};
use std::path::PathBuf;

/// Say what is in a file of tiles, and what is wrong with it
///
/// Exits with 3 if it cannot be read, or is not a whole image: then the findings are printed all the same.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// File of tiles, plain or zstd-compressed
    #[arg(value_name = "IN.tiles[.zst]")]
    input: PathBuf,
    /// Print it as JSON
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    threads: ThreadArgs,
}

const EXAMPLES: &str = "\
Examples:
  rpfd inspect render.tiles.zst
  rpfd inspect render.tiles --preset paper --json | jq .memory";

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let method = args.method.method()?;
    let input = Input::scan(&args.input)?;
    let report = report(&input, &method, args.method.leave_out(), args.threads.count())?;
    if args.json {
        say!("{report:#}")
    } else {
        print(&report)
    }
    input.check(None)
}

/// Everything, for programs.
fn report(input: &Input, method: &Method, leave_out: bool, threads: usize) -> Result<Value, Failure> {
    let summary = &input.summary;
    let tiles = || summary.tiles.iter();
    let core_areas = tiles().map(|tile| tile.geometry.core().area());
    // Zeros that say that there is no such feature, where all of a channel is 0.
    let zero = |plane: &PlaneSummary| plane.min == 0.0 && plane.max == 0.0 && plane.infinite == 0;
    let channels = summary.first.channels().plane_channels().enumerate().map(|(index, (channel, component))| {
        let first = index - component as usize;
        let all = &summary.planes[first..first + channel.components as usize];
        let none = channel.zero_is_missing() && all.iter().all(zero);
        let reason = left_out(&summary.planes[first..=index], channel.role, none, method);
        // Without leaving anything out, what a method does not look at is not looked at all the same.
        (channel.role, reason.filter(|why| leave_out || *why == "unused"))
    });
    let channels: Vec<_> = channels.collect();
    let planes = summary.planes.iter().zip(&channels).map(|(plane, &(role, reason))| {
        let range = (plane.finite > 0).then_some([plane.min, plane.max]);
        json!({
            "name": plane.name,
            "role": role_name(role),
            "format": plane.format.name(),
            "min": range.map(|r| r[0]),
            "max": range.map(|r| r[1]),
            "mean": plane.mean(),
            "nan": plane.nan,
            "infinite": plane.infinite,
            "constant_tiles": plane.constant_tiles,
            "left_out": reason,
        })
    });
    let planes: Vec<_> = planes.collect();
    let without: Vec<usize> = (0..channels.len()).filter(|&plane| channels[plane].1.is_some()).collect();
    let pixels: u64 = core_areas.clone().sum();
    let per_pixel = (summary.samples as f64 / pixels as f64).round() as u32;
    let work = forecast(summary.first.channels(), per_pixel.max(1), method, &without);
    let plane_bytes = tiles().map(|tile| tile.samples * size_of::<f32>() as u64).sum::<u64>();
    let presets = PRESETS.iter().map(|(name, _)| Method::preset(name).map_err(Failure::from));
    let mut halos = Vec::new();
    for preset in presets {
        let preset = preset?;
        let enough =
            tiles().filter(|tile| tile.geometry.halo().covers(&tile.geometry.halo_for(preset.reach(tile.varying))));
        let needed = preset.reach(input.varying());
        halos.push(json!({ "preset": preset.preset_name(), "needed": needed, "tiles_with_enough": enough.count() }));
    }
    let cost = |tile| plan(&input.shape_of(tile), method).total(threads);
    let faults = input.faults().into_iter().map(|(code, message)| json!({ "code": code, "message": message }));
    Ok(json!({
        "path": input.path,
        "compressed": summary.compressed,
        "image": input.image(),
        "tiles": summary.tiles.len(),
        "covered_pixels": core_areas.clone().sum::<u64>(),
        "largest_core": core_areas.max(),
        "halo": { "least": halo(input, u32::MAX, u32::min), "most": halo(input, 0, u32::max) },
        "samples": {
            "total": summary.samples,
            "per_pixel": (!summary.varying).then(|| summary.first.max_per_pixel()),
            "most": summary.max_per_pixel,
            "mean": summary.samples as f64 / tiles().map(|t| t.geometry.core().area()).sum::<u64>() as f64,
        },
        "channels": channels_to_json(summary.first.channels()),
        "planes": planes,
        "preset": method.preset_name(),
        "left_out": {
            "planes": without.len(),
            "bytes": without.len() as u64 * plane_bytes,
            "saved": work.map(|work| work.saved_share()),
        },
        "halo_needed": halos,
        "memory": {
            "threads": threads,
            "largest_tile": tiles().map(cost).max(),
            "spool": summary.spool_bytes,
        },
        "missing": summary.missing.iter().map(|r| [r.x, r.y, r.width, r.height]).collect::<Vec<_>>(),
        "faults": faults.collect::<Vec<_>>(),
    }))
}

/// The halo by side over all tiles, where the image does not end.
fn halo(input: &Input, start: u32, pick: fn(u32, u32) -> u32) -> [Option<u32>; 4] {
    let sides = |halo: Halo| [halo.left, halo.top, halo.right, halo.bottom];
    let mut found = [start; 4];
    let mut any = [false; 4];
    for tile in &input.summary.tiles {
        let room = sides(tile.geometry.halo_for(1));
        for (side, had) in sides(tile.geometry.halo()).into_iter().enumerate().filter(|(side, _)| room[*side] > 0) {
            found[side] = pick(found[side], had);
            any[side] = true;
        }
    }
    std::array::from_fn(|side| any[side].then_some(found[side]))
}

const fn role_name(role: Role) -> &'static str {
    match role {
        Role::Film => "film",
        Role::Color => "color",
        Role::Feature { .. } => "feature",
        Role::Random { .. } => "random",
    }
}

/// Why a plane, the last of these of a channel, has no effect in any tile, if so; `none` says that no sample has the
/// feature.
fn left_out(planes: &[PlaneSummary], role: Role, none: bool, method: &Method) -> Option<&'static str> {
    let (plane, earlier) = planes.split_last()?;
    let holes = plane.nan + plane.infinite;
    match role {
        Role::Color => {
            let equal = earlier.iter().any(|earlier| earlier.digest == plane.digest);
            (equal && matches!(method.algorithm(), Algorithm::Rpf(_))).then_some("equal")
        }
        _ if !method.reads(&role) => Some("unused"),
        _ if none || (plane.finite == 0 && plane.infinite == 0) => Some("missing"),
        _ if plane.min >= plane.max && holes == 0 => Some("constant"),
        _ => None,
    }
}

fn print(report: &Value) {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let bytes = |value: &Value| HumanBytes(value.as_u64().unwrap_or(0)).to_string();
    let samples = &report["samples"];
    say!("{}: image {} in {} tiles", text(&report["path"]), report["image"], report["tiles"]);
    match samples["per_pixel"].as_u64() {
        Some(n) => say!("samples: {} in all, {n} per pixel", samples["total"]),
        None => say!(
            "samples: {} in all, {:.2} per pixel on average, {} at most",
            samples["total"],
            samples["mean"].as_f64().unwrap_or(0.0),
            samples["most"]
        ),
    }
    say!("\n{:<16} {:<8} {:<4} {:>13} {:>13} {:>13}", "plane", "role", "", "min", "max", "mean");
    for plane in report["planes"].as_array().into_iter().flatten() {
        let number = |key: &str| plane[key].as_f64().map_or_else(|| "-".to_owned(), |v| format!("{v:.6}"));
        let mut notes = Vec::new();
        for (key, what) in [("nan", "NaN"), ("infinite", "infinite")] {
            if let Some(count) = plane[key].as_u64().filter(|&count| count > 0) {
                notes.push(format!("{count} {what}"));
            }
        }
        notes.extend(plane["left_out"].as_str().map(|why| format!("left out: {why}")));
        let (name, role, format) = (text(&plane["name"]), text(&plane["role"]), text(&plane["format"]));
        let (min, max, mean) = (number("min"), number("max"), number("mean"));
        say!("{name:<16} {role:<8} {format:<4} {min:>13} {max:>13} {mean:>13}  {}", notes.join(", "));
    }
    let left_out = &report["left_out"];
    if left_out["planes"] != 0 {
        let saved = left_out["saved"].as_f64();
        let saved = saved.map_or_else(String::new, |s| {
            format!(", and about {:.0} % of the work of {}", 100.0 * s, text(&report["preset"]))
        });
        say!("leaving out {} planes saves {} of planes{saved}", left_out["planes"], bytes(&left_out["bytes"]));
    }
    say!(
        "\nhalo, [left, top, right, bottom]: {} at least, {} at most",
        report["halo"]["least"],
        report["halo"]["most"]
    );
    for halo in report["halo_needed"].as_array().into_iter().flatten() {
        let (preset, needed, enough) = (text(&halo["preset"]), &halo["needed"], &halo["tiles_with_enough"]);
        say!("  {preset:<12} needs {needed:>3}: {enough} of {} tiles have it", report["tiles"]);
    }
    let memory = &report["memory"];
    say!(
        "memory for {} on {} threads: {} for the largest tile as it is; {} to spool all samples",
        text(&report["preset"]),
        memory["threads"],
        bytes(&memory["largest_tile"]),
        bytes(&memory["spool"])
    );
    for fault in report["faults"].as_array().into_iter().flatten() {
        say!("wrong: {} ({})", text(&fault["message"]), text(&fault["code"]));
    }
}
