//! A disk that is full: files may not grow beyond a limit, and later they may.

use crate::service::{Server, encode, exact::whole_exr, neighbors, samples, tile, wait_for};
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
    Server::start_by(shell, folder, &["--memory", "64MiB"])
}

fn unlimit(server: &Server) {
    let pid = server.pid().to_string();
    assert!(Command::new("prlimit").args(["--pid", &pid, "--fsize=unlimited"]).status().unwrap().success());
}

#[test]
fn a_full_disk_refuses_tiles_and_the_image_stays_usable() {
    if Command::new("prlimit").arg("--version").output().is_err() {
        assert!(std::env::var_os("RPFD_CI").is_none(), "CI has prlimit");
        println!("skipped: prlimit is not there");
        return;
    }
    const SIZE: [u32; 2] = [96, 96];
    let method = Method::preset("lean").unwrap();
    let expected = whole_exr(&samples(SIZE, Rect::new(0, 0, 96, 96), 0, 1), &method, 5);
    for (halo, opening) in [
        (17, br#"{"width": 96, "height": 96, "id": "a", "seed": 5, "preset": "lean"}"#.to_vec()),
        (0, neighbors::opening("a", SIZE, "lean", ("samples", 4))),
    ] {
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
        wait_for("the image", || server.get("/v1/images/a").json()["complete"] == true);
        assert!(server.get("/v1/images/a/result.exr").body == expected);
        let again = server.post("/v1/images/a/tiles", &encode(&samples(SIZE, cores[0], 0, 1))).lines();
        assert_eq!(again[0]["state"], "repeated");
    }
}

#[test]
fn an_image_that_cannot_be_made_leaves_nothing() {
    let server = limited(tempfile::tempdir().unwrap(), 64 << 10);
    server.post("/v1/images", br#"{"width": 512, "height": 512, "id": "a"}"#).problem(507, "disk_full");
    server.get("/v1/images/a").problem(404, "unknown_image");
    assert_eq!(std::fs::read_dir(server.data_dir().join("images")).unwrap().count(), 0);
}
