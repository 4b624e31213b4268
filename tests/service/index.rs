//! What is known of images takes memory, which is reserved.

use super::{Answer, Server, head};
use rpfd::{
    filter::{Channel, ChannelSet, Rect, Role, TileGeometry, geometry::tiling},
    wire::{Format, Header, SampleCounts, encode_header},
};
use serde_json::{Value, json};
use std::io::Write;

const SIZE: [u32; 2] = [512, 512];

/// A tile of one colour.
fn plain(core: Rect) -> Vec<u8> {
    let geometry = TileGeometry::with_halo(SIZE, core, 0).unwrap();
    let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let header = Header::new(geometry, channels, SampleCounts::Uniform(1), Format::F32).unwrap();
    [encode_header(&header), vec![1, 2, 3]].concat()
}

fn open(server: &Server, id: &str) -> Answer {
    let opening = json!({ "id": id, "width": SIZE[0], "height": SIZE[1], "preset": "unfiltered" });
    server.post("/v1/images", opening.to_string().as_bytes())
}

fn used(server: &Server) -> f64 {
    server.metric("rpfd_memory_used_bytes").unwrap()
}

/// Half a MiB is for what is known of images: one of more tiles than that holds is told so, tile by tile, and keeps what it
/// has; one that nobody uses makes room for others, and who is in use does not.
#[test]
fn tiles_that_there_is_no_memory_to_know_of_are_refused() {
    let arguments = ["--memory", "4MiB", "--threads", "1", "--metrics-listen", "127.0.0.1:0"];
    let server = Server::start(&arguments);
    assert_eq!(open(&server, "a").status, 201);
    assert!(used(&server) >= f64::from(128 << 10));
    let cores: Vec<Rect> = tiling(SIZE, 16).collect();
    let body: Vec<u8> = cores.iter().flat_map(|&core| plain(core)).collect();
    let mut lines = server.post("/v1/images/a/tiles", &body).lines();
    let end = lines.pop().unwrap();
    let (stored, refused): (Vec<&Value>, _) = lines.iter().partition(|line| line["state"] == "filtered");
    assert_eq!((&end["tiles"], &end["errors"]), (&json!(stored.len()), &json!(refused.len())));
    assert!((300..800).contains(&stored.len()), "{}", stored.len());
    for line in refused {
        let problem = &line["problem"];
        assert_eq!((&problem["code"], &problem["available"]), (&json!("over_memory"), &json!(1 << 19)), "{line}");
        assert!(problem["detail"].as_str().unwrap().contains("larger tiles"), "{line}");
    }
    // What is stored is there, gaps and all.
    let status = server.get("/v1/images/a").json();
    assert_eq!(status["tiles"].as_array().unwrap().len(), stored.len());
    let area = |rect: &Value| rect[2].as_u64().unwrap() * rect[3].as_u64().unwrap();
    let missing: u64 = status["missing"].as_array().unwrap().iter().map(area).sum();
    assert_eq!(missing, 256 * (1024 - stored.len() as u64));
    // Nobody uses it any more: another one may have its place, and it another's.
    super::wait_until("the room of one that nobody uses", || open(&server, "b").status == 201);
    assert_eq!(server.get("/v1/images/a").json()["tiles_done"], json!(stored.len()));
    // As long as somebody uses it, it stays.
    let mut stream = server.connect();
    stream.write_all(head("POST", "/v1/images/a/tiles", &[], 100_000).as_bytes()).unwrap();
    stream.write_all(&plain(cores[0])).unwrap();
    let mut first = [0];
    std::io::Read::read_exact(&mut stream, &mut first).unwrap();
    let busy = open(&server, "c");
    busy.problem(503, "busy");
    assert!(busy.header("retry-after").is_some());
    server.get("/v1/images/c").problem(404, "unknown_image");
    drop(stream);
    super::wait_until("room for another", || open(&server, "c").status == 201);
    // It is all there after another start.
    let server = Server::start_in(server.kill(), &arguments);
    assert_eq!(server.get("/v1/images/a").json()["tiles_done"], json!(stored.len()));
}

/// So is what answers about images take.
#[test]
fn what_is_told_of_images_is_reserved() {
    // Room for three requests, or for one and a list of 64.
    let server = Server::start(&["--memory", "4MiB", "--threads", "1"]);
    assert_eq!(open(&server, "0").status, 201);
    let tile = plain(Rect::new(0, 0, 64, 64));
    let lines = server.post("/v1/images/0/tiles", &tile).lines();
    assert_eq!(lines[0]["state"], "filtered");
    let asked = ["/v1/images/0", "/v1/images/0/preview.png?partial=true", "/v1/images"];
    let held = [(); 2].map(|()| server.begin("/v1/filter", &[], &tile[..8], tile.len()));
    for path in asked {
        let busy = server.get(path);
        busy.problem(503, "busy");
        assert!(busy.header("retry-after").is_some(), "{path}");
    }
    drop(held);
    for path in asked {
        super::wait_until("room for an answer", || server.get(path).status == 200);
    }
    (1..=64).for_each(|id| super::wait_until("room for another", || open(&server, &id.to_string()).status < 300));
    server.get("/v1/images").problem(413, "over_memory");
}

/// What JSON grows to when it is read is reserved: a small text may come to much.
#[test]
fn what_an_opening_takes_is_reserved() {
    let server = Server::start(&["--memory", "4MiB"]);
    let nested = format!("{}1{}", "{\"\":".repeat(100), "}".repeat(100));
    let channels = vec![nested; 100].join(",");
    let opening = format!("{{\"width\": 64, \"height\": 64, \"halo\": \"neighbors\", \"channels\": [{channels}]}}");
    server.post("/v1/images", opening.as_bytes()).problem(413, "over_memory");
    let ample = Server::start(&["--memory", "64MiB"]);
    ample.post("/v1/images", opening.as_bytes()).problem(400, "bad_parameter");
}
