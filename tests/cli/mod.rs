//! The `rpfd` command, run as users run it.

mod cost;
mod demo;
mod failures;
mod filter;
mod inspect;
mod post;
mod report;
mod stability;
mod synth;

use rpfd::{
    stitch::{RgbImage, exr},
    wire::file::{TileFile, TileWriter},
};
use serde_json::Value;
use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    process::{Command, Output},
};

/// A file of tests/data.
pub(crate) fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// Runs the command to its end.
pub(crate) fn rpfd<A: AsRef<OsStr>>(args: impl IntoIterator<Item = A>) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rpfd")).args(args).output().unwrap()
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Runs the command with `--json`, which must work, and reads what it says.
pub(crate) fn json<A: AsRef<OsStr>>(args: impl IntoIterator<Item = A>) -> Value {
    let args = args.into_iter().map(|arg| arg.as_ref().to_owned()).chain(["--json".into()]);
    let output = rpfd(args);
    assert!(output.status.success(), "{}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Runs the command with `--json`, which must fail with this exit code; returns the error's code and message.
pub(crate) fn fails<A: AsRef<OsStr>>(exit: i32, args: impl IntoIterator<Item = A>) -> (String, String) {
    let args: Vec<_> = args.into_iter().map(|arg| arg.as_ref().to_owned()).chain(["--json".into()]).collect();
    let output = rpfd(&args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(exit), "{args:?}: {said}");
    let error: Value = serde_json::from_str(said.lines().last().unwrap()).unwrap();
    assert_eq!(error["error"]["exit"], exit);
    let text = |key: &str| error["error"][key].as_str().unwrap().to_owned();
    (text("code"), text("message"))
}

/// A folder to work in.
pub(crate) struct Folder(tempfile::TempDir);

impl Folder {
    pub(crate) fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// A path in it, as text.
    pub(crate) fn path(&self, name: &str) -> String {
        self.0.path().join(name).into_os_string().into_string().unwrap()
    }

    /// What is in it, sorted.
    pub(crate) fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// Makes a stream of tiles.
    pub(crate) fn synth(&self, name: &str, args: &[&str]) -> String {
        let path = self.path(name);
        json(["synth", "-o", &path].iter().chain(args));
        path
    }
}

pub(crate) fn bytes(path: impl AsRef<Path>) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

pub(crate) fn read_exr(path: impl AsRef<Path>) -> RgbImage {
    exr::read(path.as_ref(), 1 << 20).unwrap()
}

/// Copies a file of tiles, each as often as `times` says of its number, in an order that the seed decides.
pub(crate) fn copy_tiles(from: &str, to: &str, seed: u64, times: impl Fn(usize) -> usize) {
    let (mut file, mut tiles) = (TileFile::open(from).unwrap(), Vec::new());
    while let Some(tile) = file.next_tile().unwrap() {
        tiles.push(tile);
    }
    let mut order: Vec<usize> = (0..tiles.len()).flat_map(|i| std::iter::repeat_n(i, times(i))).collect();
    if seed > 0 {
        crate::stitch::shuffle(&mut order, seed);
    }
    let mut writer = TileWriter::create(to).unwrap();
    order.into_iter().for_each(|i| writer.write_tile(&tiles[i].0, &tiles[i].1).unwrap());
    writer.finish().unwrap();
}
