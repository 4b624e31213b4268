//! What the real binary asks of the kernel: all that an answer says is safe was synced before it, names too; and a disk
//! that fails to sync.

use crate::service::{Answer, Server, encode, exact::whole_exr, neighbors, samples, tile, wait_until};
use rpfd::{
    filter::{Method, Rect},
    image::FILES,
};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    process::Command,
};

const SIZE: [u32; 2] = [32, 16];
const LEFT: Rect = Rect::new(0, 0, 16, 16);
const RIGHT: Rect = Rect::new(16, 0, 16, 16);

/// A library that notes what a program does to its files; see there.
struct Watch(tempfile::TempDir);

impl Watch {
    /// None where there is no compiler.
    fn new() -> Option<Self> {
        if !crate::service::has("cc", "--version") {
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fault/watch.c");
        let mut compiler = Command::new("cc");
        compiler.args(["-shared", "-fPIC", "-o"]).arg(folder.path().join("watch.so"));
        assert!(compiler.arg(source).arg("-ldl").status().unwrap().success());
        Some(Self(folder))
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rpfd"));
        command.env("LD_PRELOAD", self.0.path().join("watch.so"));
        command.env("WATCH_LOG", self.0.path().join("log")).env("FAIL_WHILE", self.fails());
        command
    }

    fn fails(&self) -> PathBuf {
        self.0.path().join("fails")
    }

    fn start(&self, folder: tempfile::TempDir) -> Server {
        let server = Server::start_by(self.command(), folder, &["--threads", "1"]);
        server.wait_recovered();
        server
    }

    /// What was noted, as the disk below this folder would have it.
    fn disk(&self, folder: &Path) -> Disk {
        let (mut disk, folder) = (Disk::default(), folder.canonicalize().unwrap());
        let log = std::fs::read_to_string(self.0.path().join("log")).unwrap();
        for line in log.lines() {
            let mut words = line.split(' ');
            let what = words.next().unwrap();
            let mut path = || words.next().and_then(|path| Path::new(path).strip_prefix(&folder).ok());
            match (what, path(), path()) {
                ("A", ..) => {
                    disk.answers += 1;
                    assert_eq!(disk.unsafe_now(), [""; 0], "answered before it was safe:\n{log}");
                }
                ("R", Some(from), Some(to)) => disk.renamed(from, to),
                (what, Some(path), _) => disk.note(what, path),
                _ => {}
            }
        }
        disk
    }
}

/// What a power loss might take.
#[derive(Default)]
struct Disk {
    /// Files with bytes that were not synced, and what has a name that was not.
    written: BTreeSet<PathBuf>,
    named: BTreeSet<PathBuf>,
    /// Where images were that are forgotten: what was still written to them need not be whole.
    forgotten: Vec<PathBuf>,
    answers: usize,
    syncs: usize,
}

impl Disk {
    fn note(&mut self, what: &str, path: &Path) {
        match what {
            "W" => drop(self.written.insert(path.into())),
            "C" => drop(self.named.insert(path.into())),
            "U" => {
                self.written.remove(path);
                self.named.remove(path);
            }
            "S" => {
                self.written.remove(path);
                self.named.retain(|name| name.parent() != Some(path));
                self.syncs += 1;
            }
            other => panic!("{other}"),
        }
    }

    fn renamed(&mut self, from: &Path, to: &Path) {
        for paths in [&mut self.written, &mut self.named] {
            let moved = |path: PathBuf| path.strip_prefix(from).map(|rest| to.join(rest)).unwrap_or(path);
            *paths = std::mem::take(paths).into_iter().map(moved).collect();
        }
        self.named.insert(to.into());
        if to.file_name().unwrap().to_str().unwrap().starts_with(".gone-") {
            self.forgotten.extend([from.into(), to.into()]);
        }
    }

    /// Of files that an image needs, and of all names.
    fn unsafe_now(&self) -> Vec<&str> {
        let needed = |path: &&PathBuf| {
            let name = path.file_name().unwrap().to_str().unwrap();
            FILES.contains(&name) && !["touched", "result.exr"].contains(&name)
        };
        let kept = |path: &&PathBuf| !self.forgotten.iter().any(|gone| path.starts_with(gone));
        let all = self.written.iter().filter(needed).filter(kept).chain(&self.named);
        all.map(|path| path.to_str().unwrap()).collect()
    }
}

/// What became of a tile, or the code of the problem.
fn state(answer: &Answer) -> String {
    let said = if answer.status == 200 { answer.lines()[0].clone() } else { answer.json() };
    let word = [&said["state"], &said["problem"]["code"], &said["code"]].into_iter().rfind(|word| word.is_string());
    word.unwrap().as_str().unwrap().to_owned()
}

fn send(server: &Server, path: &str, tile: &[u8]) -> String {
    state(&server.post(&format!("/v1/images/{path}"), tile))
}

fn openings(id: &str) -> [(u32, Vec<u8>); 2] {
    let client = format!(r#"{{"width": 32, "height": 16, "id": "{id}", "seed": 5, "preset": "lean"}}"#);
    [(17, client.into_bytes()), (0, neighbors::opening(id, SIZE, "lean", ("samples", 4)))]
}

#[test]
fn what_is_answered_is_on_the_disk() {
    let Some(watch) = Watch::new() else { return };
    for (halo, opening) in openings("a") {
        // Folders that are made for it must be there too.
        let server = watch.start(tempfile::tempdir().unwrap());
        assert_eq!(server.post("/v1/images", &opening).status, 201);
        let kept = if halo == 0 { "stored" } else { "filtered" };
        assert_eq!(send(&server, "a/tiles", &tile(SIZE, LEFT, halo)), kept);
        if halo > 0 {
            let other = encode(&samples(SIZE, LEFT, halo, 2));
            assert_eq!(send(&server, "a/tiles?replace=true", &other), "filtered");
        }
        assert_eq!(server.call("POST", "/v1/images/a/finish", &[], &[]).json()["finished"], true);
        wait_until("what there is to be filtered", || {
            server.get("/v1/images/a").json()["regions_open"].as_u64().is_none_or(|open| open == 0)
        });
        assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
        // Before the log is read nobody writes to it any more.
        let folder = server.kill();
        let disk = watch.disk(folder.path());
        // Opened, sent, the end of a stream, deleted.
        assert!(disk.answers >= 4 && disk.syncs > 10, "{} answers, {} syncs", disk.answers, disk.syncs);
    }
}

#[test]
fn a_finished_image_is_finished_after_a_kill() {
    let server = Server::start(&[]);
    assert_eq!(server.post("/v1/images", &openings("a")[0].1).status, 201);
    assert_eq!(server.call("POST", "/v1/images/a/finish", &[], &[]).json()["finished"], true);
    let server = Server::start_in(server.kill(), &[]);
    assert_eq!(server.get("/v1/images/a").json()["finished"], true);
    assert_eq!(send(&server, "a/tiles", &tile(SIZE, LEFT, 17)), "image_finished");
}

#[test]
fn an_exr_is_on_the_disk_when_the_command_ends() {
    let Some(watch) = Watch::new() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (tiles, exr) = (folder.path().join("tiles"), folder.path().join("frame.exr"));
    std::fs::write(&tiles, tile(SIZE, Rect::new(0, 0, 32, 16), 0)).unwrap();
    let mut command = watch.command();
    command.arg("filter").arg(&tiles).arg("-o").arg(&exr);
    let output = command.output().unwrap();
    assert!(output.status.success() && exr.exists(), "{}", String::from_utf8_lossy(&output.stderr));
    let log = std::fs::read_to_string(watch.0.path().join("log")).unwrap();
    // Its bytes, while it has another name, and then its name.
    let at = |line: &str| log.lines().enumerate().filter(|(_, noted)| noted.starts_with(line)).last().map(|(at, _)| at);
    let folder = folder.path().canonicalize().unwrap();
    let [written, synced] = ["W", "S"].map(|what| at(&format!("{what} {}/.rpfd-", folder.display())));
    let named = log.lines().position(|noted| noted == format!("S {}", folder.display()));
    assert!(written.is_some() && written < synced && synced < named, "{log}");
}

#[test]
fn a_disk_that_fails_to_sync_refuses_tiles_and_other_images_go_on() {
    let Some(watch) = Watch::new() else { return };
    let method = Method::preset("lean").unwrap();
    let expected = whole_exr(&samples(SIZE, Rect::new(0, 0, 32, 16), 0, 1), &method, 5);
    for (file, neighbors) in [("canvas", 0), ("state.redb", 0), ("samples", 1), ("state.redb", 1)] {
        let server = watch.start(tempfile::tempdir().unwrap());
        for id in ["a", "b"] {
            assert_eq!(server.post("/v1/images", &openings(id)[neighbors].1).status, 201);
        }
        let (halo, kept) = if neighbors == 0 { (17, "filtered") } else { (0, "stored") };
        let both = [LEFT, RIGHT].map(|core| tile(SIZE, core, halo));
        std::fs::write(watch.fails(), format!("/a/{file}")).unwrap();
        for _ in 0..2 {
            assert_eq!(send(&server, "a/tiles", &both[0]), "storage", "{file}");
            assert_eq!(server.get("/livez").status, 200);
        }
        assert_eq!(send(&server, "b/tiles", &both[0]), kept);
        std::fs::remove_file(watch.fails()).unwrap();
        assert_eq!(send(&server, "b/tiles", &both[1]), kept);
        for tile in &both {
            assert!([kept, "repeated"].contains(&&*send(&server, "a/tiles", tile)), "{file}");
        }
        let server = Server::start_in(server.kill(), &[]);
        for id in ["a", "b"] {
            neighbors::wait_complete(&server, id);
            assert!(server.get(&format!("/v1/images/{id}/result.exr")).body == expected, "{file}, {id}");
        }
    }
}
