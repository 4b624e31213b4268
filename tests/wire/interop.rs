//! Programs that share no code with ours: the Python client and the maker of the example messages.

use super::*;
use rpfd::{
    filter::{Filtered, Report},
    wire::{Problem, TileReport, message},
};
use std::{
    path::Path,
    process::{Command, Output},
};

/// Runs a script of `proto`, or says that the test is skipped where there is no Python with these modules; with
/// `RPFD_CI` set that is a failure.
pub(crate) fn python(modules: &str, script: &str, args: &[&Path]) -> Option<Output> {
    run_python(modules, &Path::new(env!("CARGO_MANIFEST_DIR")).join("proto").join(script), args)
}

/// The same for any script.
pub(crate) fn run_python(modules: &str, script: &Path, args: &[&Path]) -> Option<Output> {
    let python =
        |args: &[&std::ffi::OsStr]| Command::new("python3").args(args).env("PYTHONDONTWRITEBYTECODE", "1").output();
    let there = python(&["-c".as_ref(), format!("import {modules}").as_ref()]).is_ok_and(|o| o.status.success());
    if !there {
        assert!(std::env::var_os("RPFD_CI").is_none(), "there is no python3 with {modules}");
        eprintln!("SKIPPED: there is no python3 with {modules}");
        return None;
    }
    let args: Vec<_> = std::iter::once(script.as_os_str()).chain(args.iter().map(|a| a.as_os_str())).collect();
    let output = python(&args).unwrap();
    eprintln!("{}", String::from_utf8_lossy(&output.stderr));
    Some(output)
}

pub(crate) const CLIENT: &str = "clients/python/rpfd_client.py";

#[test]
fn the_vectors_are_what_their_maker_makes_and_fit_the_schema() {
    if let Some(output) = python("numpy, msgpack, jsonschema", "vectors/make.py", &["--check".as_ref()]) {
        assert!(output.status.success());
    }
}

#[test]
fn the_python_client_writes_what_we_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("example.tiles");
    let Some(output) = python("numpy, msgpack", CLIENT, &["example".as_ref(), &path]) else { return };
    assert!(output.status.success());
    let summary = rpfd::wire::scan::scan(&path).unwrap();
    assert!(summary.whole() && summary.halos);
    assert_eq!((summary.tiles.len(), summary.samples, summary.max_per_pixel), (4, 16 * 16 * 4, 4));
    let tile = rpfd::wire::file::TileFile::open(&path).unwrap().next_tile().unwrap().unwrap().1;
    assert_eq!(tile.value(0, 4), 1.5);
    assert_eq!(tile.plane(6), &Plane::Constant(0.5));
}

#[test]
fn the_python_client_reads_what_we_write() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ours.tiles");
    let geometry = TileGeometry::with_halo([20, 10], Rect::new(3, 2, 5, 4), 2).unwrap();
    let tiles = [tile_of(geometry, true, 1), tile_of(geometry, false, 2)];
    std::fs::write(&path, tiles.iter().flat_map(|tile| encode(tile, Format::F16)).collect::<Vec<_>>()).unwrap();
    let Some(output) = python("numpy, msgpack", CLIENT, &["info".as_ref(), &path]) else { return };
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap().replace("NaN", "null");
    assert_eq!(text.lines().count(), 2);
    for (line, tile) in text.lines().zip(&tiles) {
        let header: serde_json::Value = serde_json::from_str(line).unwrap();
        for plane in 0..tile.channels().planes() {
            let sum = match tile.plane(plane) {
                Plane::Constant(value) => f64::from(*value),
                Plane::Values(values) => values.iter().map(|&v| f64::from(v)).sum(),
            };
            assert_eq!(header["sums"][plane].as_f64(), (!sum.is_nan()).then_some(sum));
        }
        let counts = tile.varying().then_some(tile.total() as u64);
        assert_eq!(header["counts"].as_u64(), counts);
    }
}

#[test]
fn the_python_client_reads_our_results() {
    let folder = tempfile::tempdir().unwrap();
    let (path, image) = (folder.path().join("results.msgpack"), folder.path().join("image.npy"));
    let mut out = Vec::new();
    for core in [Rect::new(2, 0, 2, 2), Rect::new(0, 0, 2, 2)] {
        let plane = |k: u32| (0..4).map(|i| (core.x * 100 + k * 10 + i) as f32).collect();
        let filtered = Filtered { core, rgb: [plane(0), plane(1), plane(2)], report: Report::default() };
        message::encode_result([4, 3], &filtered, &TileReport::default(), &mut out).unwrap();
    }
    let good = out.clone();
    message::encode_end(2, 0, &mut out).unwrap();
    std::fs::write(&path, &out).unwrap();
    let Some(output) = python("numpy, msgpack", CLIENT, &["image".as_ref(), &path, &image]) else { return };
    assert!(output.status.success());
    let npy = std::fs::read(&image).unwrap();
    let values: Vec<f32> =
        npy[npy.len() - 4 * 36..].as_chunks::<4>().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
    assert_eq!(values[..12], [0.0, 10.0, 20.0, 1.0, 11.0, 21.0, 200.0, 210.0, 220.0, 201.0, 211.0, 221.0]);
    assert!(values[24..].iter().all(|v| v.is_nan()));

    // An error is told, and a stream without an end is cut.
    let mut failed = good.clone();
    message::encode_error(None, &Problem::new(400, "truncated", "Cut", "it was cut"), &mut failed).unwrap();
    message::encode_end(2, 1, &mut failed).unwrap();
    for (bytes, wanted) in [(failed, "it was cut"), (good, "it has no end")] {
        std::fs::write(&path, bytes).unwrap();
        let Some(output) = python("numpy, msgpack", CLIENT, &["image".as_ref(), &path, &image]) else { return };
        assert!(!output.status.success());
        assert!(String::from_utf8_lossy(&output.stderr).contains(wanted));
    }
}

/// Real renders, written by another client, where `RPFD_DATA` names their folder.
#[test]
fn real_renders_are_read() {
    let Some(folder) = std::env::var_os("RPFD_DATA") else {
        eprintln!("SKIPPED: RPFD_DATA is not set");
        return;
    };
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let tiles = |path: &std::path::PathBuf| path.to_string_lossy().contains(".tiles");
    // The smallest is enough: the others are made by the same program.
    let path = paths.filter(tiles).min_by_key(|path| std::fs::metadata(path).unwrap().len()).unwrap();
    let summary = rpfd::wire::scan::scan(&path).unwrap();
    assert!(summary.whole(), "{}", path.display());
    assert!(summary.samples > 0 && summary.max_per_pixel > 0 && !summary.varying);
}
