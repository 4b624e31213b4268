//! A disk that is full: files may not grow beyond a limit, and later they may.

use crate::service::{Answer, Server, encode, exact::whole_exr, neighbors, samples, tile, wait_until};
use rpfd::filter::{Method, Rect, geometry::tiling};
use std::process::Command;

/// A service whose files may have so many bytes. Writing more is an error, and no signal.
fn limited(folder: tempfile::TempDir, bytes: u64) -> Server {
    let mut shell = Command::new("sh");
    // The unit of `ulimit -f` is 512 bytes in a POSIX shell.
    let script = format!("trap '' XFSZ; ulimit -S -f {}; exec \"$@\"", bytes / 512);
    shell.args(["-c", &script, "sh", env!("CARGO_BIN_EXE_rpfd")]);
    // Debian's sh counts so; where sh is bash it has to be told.
    shell.env("POSIXLY_CORRECT", "1");
    let server = Server::start_by(shell, folder, &["--memory", "64MiB"]);
    server.wait_recovered();
    server
}

fn unlimit(server: &Server) {
    let pid = server.pid().to_string();
    assert!(Command::new("prlimit").args(["--pid", &pid, "--fsize=unlimited"]).status().unwrap().success());
}

const SIZE: [u32; 2] = [96, 96];

/// What opens an image, and the halo that its tiles then bring.
fn openings() -> [(u32, Vec<u8>); 2] {
    [
        (17, br#"{"width": 96, "height": 96, "id": "a", "seed": 5, "preset": "lean"}"#.to_vec()),
        (0, neighbors::opening("a", SIZE, "lean", ("samples", 4))),
    ]
}

#[test]
fn a_full_disk_refuses_tiles_and_the_image_stays_usable() {
    if Command::new("prlimit").arg("--version").output().is_err() {
        assert!(std::env::var_os("RPFD_CI").is_none(), "CI has prlimit");
        println!("skipped: prlimit is not there");
        return;
    }
    let method = Method::preset("lean").unwrap();
    let expected = whole_exr(&samples(SIZE, Rect::new(0, 0, 96, 96), 0, 1), &method, 5);
    for (halo, opening) in openings() {
        let server = Server::start(&[]);
        assert_eq!(server.post("/v1/images", &opening).status, 201);
        let cores: Vec<Rect> = tiling(SIZE, 32).collect();
        // The store as it is may be written to, samples and canvas hardly.
        let folder = server.kill();
        let canvas = folder.path().join("images/a/canvas");
        assert_eq!(std::fs::metadata(&canvas).unwrap().len(), 96 * 96 * 12);
        let limit = if halo == 0 { 1_200_000 } else { 96 * 96 * 12 - 20_000 };
        let server = limited(folder, limit);
        let body: Vec<u8> = cores.iter().flat_map(|&core| tile(SIZE, core, halo)).collect();
        let lines = server.post("/v1/images/a/tiles", &body).lines();
        let refused = lines.iter().filter(|line| line["problem"]["code"] == "disk_full").count();
        assert!(refused > 0, "{lines:?}");
        assert_eq!(lines.last().unwrap()["errors"], refused, "{lines:?}");
        assert_eq!(server.get("/livez").status, 200);
        unlimit(&server);
        // What was refused is sent again; what was acknowledged is known.
        let lines = server.post("/v1/images/a/tiles", &body).lines();
        assert_eq!(lines.last().unwrap()["errors"], 0, "{lines:?}");
        wait_until("the image", || server.get("/v1/images/a").json()["complete"] == true);
        assert!(server.get("/v1/images/a/result.exr").body == expected);
        let again = server.post("/v1/images/a/tiles", &encode(&samples(SIZE, cores[0], 0, 1))).lines();
        assert_eq!(again[0]["state"], "repeated");
    }
}

/// A service whose data folder is a file system of so many bytes, in a name space of its own; none where the kernel
/// does not allow that. With `RPFD_CI` set the tool must be there.
fn mounted(bytes: u64) -> Option<Server> {
    let folder = tempfile::tempdir().unwrap();
    let mount = format!("mount -t tmpfs -o size={bytes} tmpfs \"$FOLDER\"");
    let command = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "--map-root-user", "sh", "-c", script, "sh", env!("CARGO_BIN_EXE_rpfd")]);
        command.env("FOLDER", folder.path());
        command
    };
    match command(&mount).output() {
        Ok(output) if output.status.success() => {}
        refused => {
            let there = refused.is_ok() || std::env::var_os("RPFD_CI").is_none();
            assert!(there, "unshare cannot be run: {refused:?}");
            println!("skipped: a tmpfs cannot be mounted here: {refused:?}");
            return None;
        }
    }
    let command = command(&format!("{mount} && exec \"$@\""));
    Some(Server::start_by(command, folder, &["--memory", "64MiB", "--disk-reserve", "64KiB"]))
}

#[test]
fn a_full_file_system_refuses_tiles_and_the_image_stays_usable() {
    let method = Method::preset("lean").unwrap();
    let expected = whole_exr(&samples(SIZE, Rect::new(0, 0, 96, 96), 0, 1), &method, 5);
    for (halo, opening) in openings() {
        let Some(server) = mounted(32 << 20) else { return };
        assert_eq!(server.get("/readyz").status, 200);
        assert_eq!(server.post("/v1/images", &opening).status, 201);
        // As the service sees it.
        let folder = format!("/proc/{}/root{}", server.pid(), server.data_dir().display());
        let ballast = std::path::Path::new(&folder).join("ballast");
        let file = std::fs::File::create(&ballast).unwrap();
        let fill = |mut file: &std::fs::File| {
            let full = std::io::copy(&mut std::io::repeat(7), &mut file).unwrap_err();
            assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
        };
        fill(&file);
        // For a stream of answers there is room, and for less than a tile.
        file.set_len(file.metadata().unwrap().len() - (96 << 10)).unwrap();
        let body: Vec<u8> = tiling(SIZE, 48).flat_map(|core| tile(SIZE, core, halo)).collect();
        let lines = server.post("/v1/images/a/tiles", &body).lines();
        let refused = lines.iter().filter(|line| line["problem"]["code"] == "disk_full").count();
        assert!(refused > 0, "{lines:?}");
        assert_eq!(lines.last().unwrap()["errors"], refused, "{lines:?}");
        // Without even that, none begins; what an answer took may be free a little later.
        let full = |what: &str, status: u16, code: &str, ask: &dyn Fn() -> Answer| {
            wait_until(what, || {
                fill(&file);
                let answer = ask();
                answer.status >= 500 && answer.problem(status, code).is_object()
            });
        };
        full("tiles to be refused", 507, "disk_full", &|| server.post("/v1/images/a/tiles", &body));
        full("it to be unready", 503, "low_disk", &|| server.get("/readyz"));
        server.post("/v1/images", br#"{"width": 16, "height": 16, "id": "b"}"#).problem(507, "disk_full");
        // Emptied first: what another test starts just then has the file open too, for a moment.
        file.set_len(0).unwrap();
        std::fs::remove_file(&ballast).unwrap();
        let lines = server.post("/v1/images/a/tiles", &body).lines();
        assert_eq!(lines.last().unwrap()["errors"], 0, "{lines:?}");
        wait_until("the image", || server.get("/v1/images/a").json()["complete"] == true);
        assert!(server.get("/v1/images/a/result.exr").body == expected);
        server.get("/v1/images/b").problem(404, "unknown_image");
    }
}

#[test]
fn an_image_that_cannot_be_made_leaves_nothing() {
    let server = limited(tempfile::tempdir().unwrap(), 64 << 10);
    server.post("/v1/images", br#"{"width": 512, "height": 512, "id": "a"}"#).problem(507, "disk_full");
    server.get("/v1/images/a").problem(404, "unknown_image");
    assert_eq!(std::fs::read_dir(server.data_dir().join("images")).unwrap().count(), 0);
}
