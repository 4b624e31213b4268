//! Instructions that the filter takes, counted by callgrind and compared with `instructions.csv`: unlike times they are the
//! same on a busy machine, so that a change that costs speed is seen where it is made.
//!
//! Debian's valgrind does not know AVX-512: the counts are of AVX2. Each workload runs in this very program, started again
//! under valgrind; only what [`measured_by_callgrind`] does is counted. After a change that is meant to change the counts, and with
//! another compiler:
//!
//! ```text
//! RPFD_REGENERATE=1 cargo test --release --test instructions
//! ```
#![expect(clippy::unwrap_used, reason = "a failed unwrap fails the test, in helpers too")]

use rpfd::filter::method::Algorithm;
use rpfd::filter::{Execution, Filtered, Method, Rect, SampleTile, SimdLevel, TileGeometry, filter, scalar};
use rpfd::synth::Scene;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Preset, and the side of the square image of the scene `all` (27 planes) at 8 samples per pixel.
const WORKLOADS: [(&str, u32); 2] = [("lean", 48), ("paper-fast", 24)];
const SAMPLES: u32 = 8;
const SIMD: &str = "avx2";
/// How far a count may be off.
const TOLERANCE: f64 = 0.03;
/// Instructions of the scalar path over those of the fast path, at least.
const FLOORS: [(&str, f64); 2] = [("lean", 9.3), ("paper-fast", 8.0)];

/// What is counted, by the name of this function: it has no closures, whose names would contain its own.
#[inline(never)]
fn measured_by_callgrind(path: &str, tile: &SampleTile, method: &Method, execution: &Execution) -> Filtered {
    match (path, method.algorithm()) {
        ("scalar", Algorithm::Rpf(params)) => scalar::filter(tile, params, execution.seed),
        _ => filter(tile, method, execution),
    }
    .unwrap()
}

/// Not a test: what callgrind runs, for the workload that the environment names.
#[test]
#[ignore = "is run under callgrind by the test of counts"]
fn workload() {
    let Ok(wanted) = std::env::var("RPFD_WORKLOAD") else { return };
    let (preset, path) = wanted.split_once(' ').unwrap();
    let side = WORKLOADS.iter().find(|workload| workload.0 == preset).unwrap().1;
    let geometry = TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).unwrap();
    let tile = Scene::by_name("all").unwrap().tile(geometry, SAMPLES, &Execution::default()).unwrap();
    let Ok(simd) = SIMD.parse::<SimdLevel>() else { panic!("valgrind offers no {SIMD}") };
    let execution = Execution { simd, ..Execution::default() };
    let filtered = measured_by_callgrind(path, &tile, &Method::preset(preset).unwrap(), &execution);
    assert!(filtered.rgb.iter().flatten().all(|v| v.is_finite()));
}

/// Instructions of a workload.
fn count(preset: &str, path: &str) -> u64 {
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null", "--toggle-collect=*measured_by_callgrind*"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "workload", "--ignored", "--test-threads", "1"])
        .env("RPFD_WORKLOAD", format!("{preset} {path}"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{}{said}", String::from_utf8_lossy(&output.stdout));
    let collected = said.lines().find_map(|line| line.split_once("Collected :")).unwrap_or_else(|| panic!("{said}"));
    let count = collected.1.trim().parse().unwrap();
    assert!(count > 1_000_000, "{preset} {path}: {count} instructions, so something else was counted: {said}");
    count
}

/// Whether counts can be taken here; where `RPFD_CI` is set they must.
fn possible() -> bool {
    let valgrind = Command::new("valgrind").arg("--version").output().is_ok_and(|output| output.status.success());
    let why = match (valgrind, SIMD.parse::<SimdLevel>()) {
        (true, Ok(_)) => return true,
        (false, _) => "there is no valgrind".to_owned(),
        (_, Err(error)) => error.to_string(),
    };
    assert!(std::env::var_os("RPFD_CI").is_none(), "{why}, and RPFD_CI is set");
    println!("SKIPPED: {why}");
    false
}

fn compiler() -> String {
    let output = Command::new("rustc").arg("--version").output().unwrap();
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

fn file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bench/instructions.csv")
}

#[test]
fn instruction_counts_are_as_recorded() {
    if !possible() {
        return;
    }
    let all = WORKLOADS.iter().flat_map(|(preset, _)| ["fast", "scalar"].map(|path| (*preset, path)));
    let counts: BTreeMap<(&str, &str), u64> = std::thread::scope(|scope| {
        let running: Vec<_> =
            all.map(|(preset, path)| ((preset, path), scope.spawn(move || count(preset, path)))).collect();
        running.into_iter().map(|(of, thread)| (of, thread.join().unwrap())).collect()
    });
    let compiler = compiler();
    if std::env::var_os("RPFD_REGENERATE").is_some() {
        let lines = counts.iter().map(|((preset, path), count)| format!("{preset},{path},{count}\n"));
        let text = format!("# {compiler}, {SIMD}\npreset,path,instructions\n{}", lines.collect::<String>());
        std::fs::write(file(), text).unwrap();
    }
    let recorded = std::fs::read_to_string(file()).unwrap();
    let mut lines = recorded.lines();
    let of = lines.next().unwrap().trim_start_matches("# ").to_owned();
    assert_eq!(lines.next(), Some("preset,path,instructions"));
    let same_compiler = of == format!("{compiler}, {SIMD}");
    let mut off = Vec::new();
    let mut compared = 0;
    println!("{:<12}{:<8}{:>16}{:>16}{:>9}", "preset", "path", "counted", "recorded", "change");
    for line in lines {
        let [preset, path, expected] = line.split(',').collect::<Vec<_>>()[..] else { panic!("{line}") };
        let (counted, expected) = (counts[&(preset, path)], expected.parse::<u64>().unwrap());
        let change = counted as f64 / expected as f64 - 1.0;
        println!("{preset:<12}{path:<8}{counted:>16}{expected:>16}{:>8.2}%", 100.0 * change);
        compared += 1;
        if change.abs() > TOLERANCE {
            off.push(format!("{preset} {path}: {counted} instructions where {expected} are recorded"));
        }
    }
    assert_eq!(compared, counts.len(), "tests/bench/instructions.csv has other workloads");
    for (preset, floor) in FLOORS {
        let ratio = counts[&(preset, "scalar")] as f64 / counts[&(preset, "fast")] as f64;
        println!("{preset}: the scalar path takes {ratio:.2} times the instructions; at least {floor}");
        assert!(ratio >= floor, "{preset}: the scalar path takes only {ratio:.2} times the instructions, not {floor}");
    }
    if !same_compiler {
        println!("NOT COMPARED: recorded with {of}, this is {compiler}");
        return;
    }
    assert!(
        off.is_empty(),
        "{}\nfewer is better; if it is meant: RPFD_REGENERATE=1 cargo test --release --test instructions",
        off.join("\n")
    );
}
