//! Fuzzing on stable Rust: examples, changed at random, into everything that reads what others wrote.
//!
//! `RPFD_FUZZ=10000000` is the number of executions of each target (20000 if it is not set), `RPFD_FUZZ_SEED` where the
//! random numbers start. A run is the same each time; what fails is written to `tests/fuzz_findings`, where, as in
//! `tests/fuzz/corpus`, every file is tried at the start of each run: its name starts with that of the target.
//!
//! A target is a function that takes bytes, panics if a promise is broken, and says how far they came.
#![expect(clippy::unwrap_used, reason = "a failed unwrap fails the test, in helpers too")]

mod config;
mod decoder;
mod http;
mod image;
mod mutate;
mod results;
mod store;
mod text;

use std::{
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use mutate::Random;
use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATIONS: PeakAlloc = PeakAlloc;

/// One target at a time, with all that it prepares: what others allocate would count.
static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn variable(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |value| value.parse().expect(name))
}

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// The files of a folder whose names start so, in order.
fn files(name: &str, start: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let entries = std::fs::read_dir(folder(name)).into_iter().flatten().map(|entry| entry.unwrap().path());
    let wanted = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(start));
    let mut paths: Vec<_> = entries.filter(wanted).collect();
    paths.sort();
    paths.into_iter().map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
}

/// The example messages of `proto/vectors`, good and bad.
fn vectors() -> Vec<Vec<u8>> {
    files("proto/vectors", "")
        .into_iter()
        .filter(|(path, _)| path.extension().is_some_and(|e| e == "msgpack"))
        .map(|f| f.1)
        .collect()
}

/// Runs a target of a test that is [`alone`]: all files first, then as many times as were asked for, over `share`, with what `make` makes. How far
/// the inputs came is counted, printed, and returned.
fn fuzz(
    _alone: &MutexGuard<'static, ()>,
    name: &str,
    share: u64,
    mut make: impl FnMut(&mut Random) -> Vec<u8>,
    mut target: impl FnMut(&[u8], &mut Random) -> &'static str,
) -> BTreeMap<&'static str, u64> {
    let (seed, executions) = (variable("RPFD_FUZZ_SEED", 1), variable("RPFD_FUZZ", 20_000) / share);
    let mut random = Random::new(seed);
    let mut reached = BTreeMap::new();
    let mut known: Vec<_> = files("tests/fuzz_findings", name);
    known.extend(files("tests/fuzz/corpus", name));
    for (path, input) in &known {
        let tried = catch_unwind(AssertUnwindSafe(|| target(input, &mut random)));
        assert!(tried.is_ok(), "{} fails", path.display());
    }
    let started = Instant::now();
    for execution in 0..executions {
        let input = make(&mut random);
        match catch_unwind(AssertUnwindSafe(|| target(&input, &mut random))) {
            Ok(reach) => *reached.entry(reach).or_default() += 1,
            Err(_) => {
                let path = folder("tests/fuzz_findings").join(format!("{name}-{seed}-{execution}"));
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(&path, &input).unwrap();
                panic!("execution {execution} of seed {seed} fails: {}", path.display());
            }
        }
    }
    let seconds = started.elapsed().as_secs_f64();
    println!("{name}: {executions} executions in {seconds:.0} s, {} files; {reached:?}", known.len());
    reached
}
