//! What an image has survives: kills, new starts, damaged files, a full disk. Images end when nobody uses them.

use super::{Answer, Server, encode, exact::whole_exr, neighbors, samples, tile, wait_until};
use rpfd::filter::{Method, Rect};
use serde_json::json;
use std::{
    io::Write,
    process::Command,
    time::{Duration, SystemTime},
};

const SIZE: [u32; 2] = [32, 16];
const LEFT: Rect = Rect::new(0, 0, 16, 16);
const RIGHT: Rect = Rect::new(16, 0, 16, 16);

fn open(server: &Server, id: &str) {
    let body = format!(r#"{{"width": 32, "height": 16, "id": "{id}", "seed": 3}}"#);
    let status = server.post("/v1/images", body.as_bytes()).status;
    assert!([200, 201].contains(&status));
}

fn send(server: &Server, id: &str, core: Rect) -> String {
    let lines = server.post(&format!("/v1/images/{id}/tiles"), &tile(SIZE, core, 17)).lines();
    lines[0]["state"].as_str().unwrap().to_owned()
}

#[test]
fn images_are_there_after_a_stop_and_after_a_kill() {
    let server = Server::start(&[]);
    open(&server, "a");
    open(&server, "b");
    assert_eq!(send(&server, "a", LEFT), "filtered");
    let before = server.get("/v1/images/a").json();
    let partial = server.get("/v1/images/a/result.exr?partial=true").body;
    let (status, folder) = server.terminated();
    assert!(status.success());
    let mut server = Server::start_in(folder, &[]);
    for _ in 0..2 {
        let mut after = server.get("/v1/images/a").json();
        after["expires"] = before["expires"].clone();
        assert_eq!(after, before);
        assert!(server.get("/v1/images/a/result.exr?partial=true").body == partial);
        assert_eq!(send(&server, "a", LEFT), "repeated");
        let images = server.get("/v1/images").json();
        assert_eq!(images["images"].as_array().unwrap().len(), 2);
        server = Server::start_in(server.kill(), &[]);
    }
    // Another tile's channels are still refused, and the same opening is still the same.
    open(&server, "a");
    assert_eq!(send(&server, "a", RIGHT), "filtered");
    let exr = server.get("/v1/images/a/result.exr").body;
    assert_eq!((send(&server, "b", RIGHT), send(&server, "b", LEFT)), ("filtered".into(), "filtered".into()));
    assert!(server.get("/v1/images/b/result.exr").body == exr);
    // What was deleted stays so.
    assert_eq!(server.call("DELETE", "/v1/images/b", &[], &[]).status, 204);
    let server = Server::start_in(server.kill(), &[]);
    server.get("/v1/images/b").problem(404, "unknown_image");
    assert_eq!(server.get("/v1/images/a/result.exr").body, exr);
}

#[test]
fn a_replaced_tile_is_the_new_one_after_a_kill() {
    let server = Server::start(&[]);
    open(&server, "a");
    send(&server, "a", LEFT);
    let old = server.get("/v1/images/a/result.exr?partial=true").body;
    let other = encode(&samples(SIZE, LEFT, 17, 2));
    assert_eq!(server.post("/v1/images/a/tiles?replace=true", &other).lines()[0]["state"], "filtered");
    let new = server.get("/v1/images/a/result.exr?partial=true").body;
    assert_ne!(old, new);
    let server = Server::start_in(server.kill(), &[]);
    assert_eq!(server.get("/v1/images/a/result.exr?partial=true").body, new);
    assert_eq!(server.post("/v1/images/a/tiles", &other).lines()[0]["state"], "repeated");
}

#[test]
fn remains_are_removed_and_a_folder_has_one_service() {
    let server = Server::start(&[]);
    open(&server, "a");
    let images = server.data_dir().join("images");
    let second = Command::new(env!("CARGO_BIN_EXE_rpfd"))
        .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
        .arg(server.data_dir())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&second.stderr);
    assert!(second.status.code() == Some(1) && said.contains("in use by another service"), "{said}");
    let folder = server.kill();
    for name in [".new-b", ".gone-0123", "c d"] {
        std::fs::create_dir(images.join(name)).unwrap();
        std::fs::write(images.join(name).join("canvas"), b"some").unwrap();
    }
    std::fs::write(images.join("a/.tmp123"), b"half of a result").unwrap();
    let server = Server::start_in(folder, &[]);
    let mut names: Vec<_> =
        std::fs::read_dir(&images).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!(names, ["a"]);
    assert!(!images.join("a/.tmp123").exists());
    assert_eq!(send(&server, "a", LEFT), "filtered");
}

#[test]
fn a_damaged_file_is_named_and_leaves_other_images_alone() {
    let server = Server::start(&[]);
    for id in ["state", "short", "canvas", "fine"] {
        open(&server, id);
        send(&server, id, LEFT);
        send(&server, id, RIGHT);
    }
    let exr = server.get("/v1/images/fine/result.exr").body;
    // Its tiles wait for others.
    server.post("/v1/images", &neighbors::opening("samples", [64, 64], "lean", ("samples", 4)));
    server.post("/v1/images/samples/tiles", &tile([64, 64], Rect::new(0, 0, 32, 64), 0)).lines();
    let folder = server.kill();
    let path = |id: &str, file: &str| folder.path().join("images").join(id).join(file);
    let flip = |path: &std::path::Path, at: usize| {
        let mut bytes = std::fs::read(path).unwrap();
        bytes[at] ^= 4;
        std::fs::write(path, bytes).unwrap();
    };
    let state = path("state", "state.redb");
    let length = std::fs::metadata(&state).unwrap().len();
    std::fs::File::options().write(true).open(&state).unwrap().set_len(length / 3).unwrap();
    std::fs::File::options().write(true).open(path("short", "canvas")).unwrap().set_len(100).unwrap();
    flip(&path("canvas", "canvas"), 1234);
    flip(&path("samples", "samples"), 5000);
    let server = Server::start_in(folder, &[]);
    for (id, file) in [("state", "state.redb"), ("short", "canvas")] {
        for problem in [
            server.get(&format!("/v1/images/{id}")).problem(500, "damaged"),
            server.post(&format!("/v1/images/{id}/tiles"), &tile(SIZE, LEFT, 0)).problem(500, "damaged"),
        ] {
            assert!(problem["detail"].as_str().unwrap().contains(&format!("{id}/{file}")), "{problem}");
        }
    }
    let damaged = server.get("/v1/images").json();
    let damaged = damaged["images"].as_array().unwrap().iter().filter(|image| image["damaged"].is_string()).count();
    assert_eq!(damaged, 2);
    let problem = server.get("/v1/images/canvas/result.exr").problem(500, "damaged");
    assert!(problem["detail"].as_str().unwrap().contains("canvas/canvas is damaged: the pixels of tile"), "{problem}");
    assert!(server.get("/v1/images/fine/result.exr").body == exr);
    // Samples are read when they are needed.
    server.post("/v1/images/samples/tiles", &tile([64, 64], Rect::new(32, 0, 32, 64), 0)).lines();
    let mut status = json!({});
    wait_until("the damage to show", || {
        status = server.get("/v1/images/samples").json();
        status["trouble"]["code"] == "damaged"
    });
    assert!(status["trouble"]["detail"].as_str().unwrap().contains("samples/samples"), "{}", status["trouble"]);
    for id in ["state", "short", "canvas", "samples"] {
        assert_eq!(server.call("DELETE", &format!("/v1/images/{id}"), &[], &[]).status, 204);
    }
    open(&server, "state");
    assert_eq!(send(&server, "state", LEFT), "filtered");
}

#[test]
fn images_that_nobody_uses_leave_the_memory_and_come_back() {
    let server = Server::start(&["--metrics-listen", "127.0.0.1:0", "--image-idle", "100ms"]);
    let whole = samples(SIZE, Rect::new(0, 0, 32, 16), 0, 1);
    let expected = whole_exr(&whole, &Method::preset("lean").unwrap(), 5);
    open(&server, "a");
    let (opening, id) = (neighbors::opening("b", SIZE, "lean", ("samples", 4)), "b");
    assert_eq!(server.post("/v1/images", &opening).status, 201);
    let bare = |core| server.post("/v1/images/b/tiles", &tile(SIZE, core, 0)).lines()[0]["state"].clone();
    let asleep = || {
        wait_until("the images to leave the memory", || server.metric("rpfd_images_in_memory") == Some(0.0));
        wait_until("their files to be closed", || {
            let open = std::fs::read_dir(format!("/proc/{}/fd", server.pid())).unwrap();
            let mut open = open.filter_map(|fd| std::fs::read_link(fd.unwrap().path()).ok());
            !open.any(|path| path.starts_with(server.data_dir().join("images")))
        });
        assert_eq!(server.metric("rpfd_images_open"), Some(2.0));
    };
    asleep();
    assert_eq!((send(&server, "a", LEFT), bare(LEFT)), ("filtered".into(), json!("stored")));
    asleep();
    // What is known of them without opening them is what is known of them.
    let list = server.get("/v1/images").json();
    assert_eq!((&list["images"][0]["pixels_done"], &list["images"][1]["tiles_stored"]), (&json!(256), &json!(1)));
    assert_eq!(server.metric("rpfd_images_in_memory"), Some(0.0));
    assert_eq!((send(&server, "a", LEFT), bare(LEFT)), ("repeated".into(), json!("repeated")));
    asleep();
    assert_eq!((send(&server, "a", RIGHT), bare(RIGHT)), ("filtered".into(), json!("stored")));
    neighbors::wait_complete(&server, id);
    asleep();
    assert!(server.get("/v1/images/b/result.exr").body == expected);
    assert_eq!(server.get("/v1/images/a/result.exr").status, 200);
}

#[test]
fn images_that_nobody_uses_expire() {
    let server = Server::start(&["--image-ttl", "1"]);
    let seconds = || SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs();
    let (before, opened) = (seconds(), server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "a"}"#));
    let (expires, after) = (opened.json()["expires"].as_u64().unwrap(), seconds());
    assert!(expires > before && expires <= after + 1, "{before} {expires} {after}");
    // The list is no use of them.
    wait_until("the image to expire", || server.get("/v1/images").json()["images"] == json!([]));
    server.get("/v1/images/a").problem(404, "unknown_image");
    // It is forgotten first, and its files are removed then.
    wait_until("its files to be gone", || std::fs::read_dir(server.data_dir().join("images")).unwrap().count() == 0);
}

#[test]
fn the_last_use_is_known_after_a_new_start() {
    const HOUR: Duration = Duration::from_secs(3600);
    let arguments = ["--image-ttl", "1d", "--image-idle", "100ms"];
    let server = Server::start(&arguments);
    open(&server, "old");
    open(&server, "used");
    let folder = server.kill();
    let images = folder.path().join("images");
    let now = SystemTime::now();
    for (id, hours) in [("old", 25), ("used", 23)] {
        let file = std::fs::File::create(images.join(id).join("touched")).unwrap();
        file.set_modified(now - hours * HOUR).unwrap();
    }
    let server = Server::start_in(folder, &arguments);
    wait_until("the old one to expire", || !images.join("old").exists());
    let expires = |server: &Server| server.get("/v1/images").json()["images"][0]["expires"].as_u64().unwrap();
    let seconds = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs();
    assert_eq!(expires(&server), seconds(now + HOUR));
    // Each use counts, also for those who come later.
    assert_eq!(server.get("/v1/images/used").status, 200);
    let later = expires(&server);
    assert!(later >= seconds(now + 24 * HOUR), "{later}");
    let server = Server::start_in(server.kill(), &arguments);
    assert!(expires(&server) >= later);
}

#[test]
fn images_that_somebody_is_at_work_on_do_not_expire() {
    let server = Server::start(&["--image-ttl", "1"]);
    let (body, mut begun) = (tile(SIZE, LEFT, 0), None);
    // On a machine that stalls it may expire before somebody comes.
    wait_until("somebody to be at work on it", || {
        open(&server, "a");
        begun = server.try_begin("/v1/images/a/tiles", &[], &body[..body.len() / 2], body.len());
        begun.is_some()
    });
    let mut stream = begun.unwrap();
    // The list is no use of it, and this stream began long before.
    let expires = || server.get("/v1/images").json()["images"][0]["expires"].as_u64();
    let first = expires().unwrap();
    wait_until("three times its time", || expires().expect("the image is there") > first + 3);
    stream.write_all(&body[body.len() / 2..]).unwrap();
    assert_eq!(Answer::read(&mut stream).lines()[0]["state"], "filtered");
    drop(stream);
    wait_until("the image to expire", || expires().is_none());
}

#[test]
fn a_full_quota_refuses_images_and_never_tiles() {
    let server = Server::start(&[]);
    open(&server, "a");
    let bytes = server.get("/v1/images/a").json()["disk"].as_u64().unwrap();
    drop(server);
    let server = Server::start(&["--disk", &(2 * bytes).to_string()]);
    open(&server, "a");
    open(&server, "b");
    let problem = server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "c"}"#).problem(507, "disk_quota");
    assert_eq!((&problem["needed"], &problem["free"]), (&json!(bytes), &json!(0)));
    let problem = server
        .post("/v1/images", &neighbors::opening("d", [4096, 4096], "lean", ("samples", 64)))
        .problem(507, "disk_quota");
    assert!(problem["needed"].as_u64().unwrap() > 4096 * 4096 * 64 * 27 * 4);
    for id in ["a", "b"] {
        assert_eq!((send(&server, id, LEFT), send(&server, id, RIGHT)), ("filtered".into(), "filtered".into()));
        assert_eq!(server.get(&format!("/v1/images/{id}/result.exr")).status, 200);
    }
    // What is set aside is known again after a new start, and free again after the image.
    let server = Server::start_in(server.kill(), &["--disk", &(2 * bytes).to_string()]);
    server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "c"}"#).problem(507, "disk_quota");
    assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
    open(&server, "c");
}
