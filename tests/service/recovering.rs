//! A service that is started again answers at once, and takes calls about images when it knows them.

use super::{Server, wait_until, whole};
use std::{
    io::{BufRead, BufReader},
    process::{Command, Stdio},
};

/// More images that cannot be read than a pipe holds lines about them.
const IMAGES: usize = 1500;

/// A service that cannot go on recovering until its log is read.
fn recovering(arguments: &[&str]) -> Server {
    let folder = tempfile::tempdir().unwrap();
    for i in 0..IMAGES {
        let image = folder.path().join(format!("images/broken-{i}"));
        std::fs::create_dir_all(&image).unwrap();
        std::fs::write(image.join("state.redb"), b"not what was written").unwrap();
    }
    let mut command = Command::new("env");
    // Whatever else there may be to say would have to wait too.
    command.args(["RUST_LOG=error", env!("CARGO_BIN_EXE_rpfd")]).stderr(Stdio::piped());
    Server::start_by(command, folder, arguments)
}

#[test]
fn it_answers_while_it_recovers() {
    let mut server = recovering(&["--metrics-listen", "127.0.0.1:0"]);
    assert_eq!(server.get("/livez").status, 200);
    let ready = server.get("/readyz");
    ready.problem(503, "recovering");
    assert_eq!(ready.header("retry-after"), Some("5"));
    assert_eq!(server.metric("rpfd_ready"), Some(0.0));
    assert_eq!(server.get("/openapi.json").status, 200);
    // What needs no image is done.
    assert_eq!(server.post("/v1/filter", &whole(16)).messages().len(), 2);
    let opening = br#"{"width": 16, "height": 16, "id": "new"}"#;
    for (method, path) in [
        ("POST", "/v1/images"),
        ("GET", "/v1/images"),
        ("GET", "/v1/images/broken-1"),
        ("DELETE", "/v1/images/broken-1"),
        ("POST", "/v1/images/broken-1/tiles"),
        ("POST", "/v1/images/broken-1/finish"),
        ("GET", "/v1/images/broken-1/result.exr"),
        ("GET", "/v1/images/broken-1/preview.png"),
    ] {
        let refused = server.call(method, path, &[], opening);
        refused.problem(503, "recovering");
        assert_eq!(refused.header("retry-after"), Some("5"), "{method} {path}");
    }
    server.get("/v1/nothing").problem(404, "not_found");
    // All goes on once the log is read.
    let log = BufReader::new(server.child.stderr.take().unwrap());
    let log = std::thread::spawn(move || {
        log.lines().filter(|line| line.as_ref().unwrap().contains("cannot be opened")).count()
    });
    wait_until("the images to be recovered", || server.get("/readyz").status == 200);
    assert_eq!(server.metric("rpfd_ready"), Some(1.0));
    assert_eq!(server.get("/v1/images").json()["images"].as_array().unwrap().len(), IMAGES);
    server.get("/v1/images/broken-1").problem(500, "damaged");
    assert_eq!(server.call("DELETE", "/v1/images/broken-1", &[], &[]).status, 204);
    assert_eq!(server.terminate().code(), Some(0));
    assert_eq!(log.join().unwrap(), IMAGES);
}

#[test]
fn it_stops_while_it_recovers() {
    let server = recovering(&[]);
    server.get("/readyz").problem(503, "recovering");
    assert_eq!(server.terminate().code(), Some(0));
}
