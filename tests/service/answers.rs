//! Answers on their way: what they take of the disk is reserved, and given back when nobody wants them any more.

use super::{Answer, Server, head, wait_until};
use rpfd::{
    filter::{Channel, ChannelSet, Rect, Role, TileGeometry},
    wire::{Format, Header, SampleCounts, encode_header},
};
use serde_json::json;
use std::{io::Write, net::TcpStream, os::unix::fs::MetadataExt};

const METRICS: [&str; 2] = ["--metrics-listen", "127.0.0.1:0"];
const UNREAD: &str = "rpfd_unread_results_bytes";
const IN_FLIGHT: &str = "rpfd_requests_in_flight";
const IMAGES: &str = "rpfd_images_disk_bytes";

/// A tile all of whose pixels are the same: a large one in a few bytes.
fn flat(image: [u32; 2], core: Rect) -> Vec<u8> {
    let geometry = TileGeometry::with_halo(image, core, 0).unwrap();
    let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let header = Header::new(geometry, channels, SampleCounts::Uniform(1), Format::F32).unwrap();
    let mut bytes = encode_header(&header);
    bytes.extend([0.5f32, 0.25, 0.125].iter().flat_map(|value| [&[0xca][..], &value.to_be_bytes()].concat()));
    bytes
}

/// An image of two halves, of which the left is there.
fn half(server: &Server, size: [u32; 2]) {
    let opening = json!({ "id": "a", "width": size[0], "height": size[1], "preset": "unfiltered" }).to_string();
    assert_eq!(server.post("/v1/images", opening.as_bytes()).status, 201);
    send(server, size, 0);
}

fn send(server: &Server, size: [u32; 2], x: u32) {
    let lines = server.post("/v1/images/a/tiles", &flat(size, Rect::new(x, 0, size[0] / 2, size[1]))).lines();
    assert_eq!(lines[0]["state"], "filtered", "{lines:?}");
}

/// Asks for something, and does not read the answer.
fn ask(server: &Server, path: &str) -> TcpStream {
    let mut stream = server.connect();
    stream.write_all(head("GET", path, &[], 0).as_bytes()).unwrap();
    stream
}

#[test]
fn what_nobody_reads_is_reserved_and_beyond_the_limit_refused() {
    // The EXR has 12 MiB, and a few for its rows.
    const SIZE: [u32; 2] = [1024, 1024];
    let server = Server::start(&[&METRICS[..], &["--unread-results", "16MiB"]].concat());
    half(&server, SIZE);
    let (exr, png) = ("/v1/images/a/result.exr?partial=true&compression=none", "/v1/images/a/preview.png?partial=true");
    let unread = ask(&server, exr);
    wait_until("the answer to be kept", || server.metric(UNREAD) > Some(f64::from(12 << 20)));
    assert!(server.metric(UNREAD) <= Some(f64::from(16 << 20)));
    let problem = server.get(exr).problem(507, "results_unread");
    assert!(problem["detail"].as_str().unwrap().contains("read theirs"), "{problem}");
    // What is smaller has room.
    assert_eq!((server.get(png).status, server.get("/v1/images/a").status), (200, 200));
    drop(unread);
    wait_until("the room to be free", || server.metric(UNREAD) == Some(0.0));
    assert_eq!(server.get(exr).status, 200);
    wait_until("the room to be free", || server.metric(UNREAD) == Some(0.0));
    let few = Server::start(&["--unread-results", "1MiB"]);
    half(&few, SIZE);
    few.get(exr).problem(507, "results_unread");
    assert_eq!(few.get("/v1/images/a").status, 200);
    // The whole result has the image's own room.
    send(&few, SIZE, 512);
    assert_eq!(few.get("/v1/images/a/result.exr?compression=none").status, 200);
}

#[test]
fn a_result_has_the_images_own_room_once() {
    // More than sockets hold.
    const SIZE: [u32; 2] = [2048, 1024];
    let server = Server::start(&METRICS);
    half(&server, SIZE);
    send(&server, SIZE, 1024);
    let set_aside = server.metric(IMAGES);
    assert!(set_aside > Some(f64::from(1024 * 1024 * 2 * 36)));
    let path = "/v1/images/a/result.exr?compression=none";
    let mut first = ask(&server, path);
    wait_until("the result", || server.data_dir().join("images/a/result.exr").exists());
    let again = ask(&server, path);
    wait_until("both to be under way", || server.metric(IN_FLIGHT) == Some(2.0));
    assert_eq!(server.metric(UNREAD), Some(0.0));
    // Another form of it, while the one that is kept is read.
    let other = ask(&server, "/v1/images/a/result.exr?compression=none&layout=tiles");
    wait_until("the other form", || server.metric(UNREAD) > Some(f64::from(24 << 20)));
    // Without the image its disk is free only when nobody reads of it any more.
    assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
    drop(other);
    wait_until("the other form's room to be free", || server.metric(UNREAD) == Some(0.0));
    assert_eq!(server.metric(IMAGES), set_aside);
    let answer = Answer::read(&mut first);
    assert!(answer.status == 200 && answer.body.len() > 24 << 20, "{}", answer.status);
    assert_eq!(server.metric(IMAGES), set_aside);
    drop((first, again));
    wait_until("the image's room to be free", || server.metric(IMAGES) == Some(0.0));
}

#[test]
fn a_client_that_leaves_stops_the_encoding_of_its_result() {
    const SIZE: [u32; 2] = [1024, 2048];
    let server = Server::start(&METRICS);
    half(&server, SIZE);
    send(&server, SIZE, 512);
    let (folder, path) = (server.data_dir().join("images/a"), "/v1/images/a/result.exr");
    let beginnings = || {
        let files = std::fs::read_dir(&folder).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
        files.filter(|name| name.starts_with(".tmp")).count()
    };
    // Seconds of work: 8192 tiles. On a machine that stalls it may be done before the client has gone, or that is seen:
    // then another form of it is asked for.
    let kept = || std::fs::metadata(folder.join("result.exr")).ok().map(|file| file.ino());
    // What is known of the image.
    wait_until("nothing else to be under way", || server.metric(IN_FLIGHT) == Some(0.0));
    let known = server.metric("rpfd_memory_used_bytes");
    let stopped = (16..48).any(|side| {
        let before = kept();
        let gone = ask(&server, &format!("{path}?compression=piz&tile={side}"));
        wait_until("the encoding to begin", || beginnings() == 1 || kept() != before);
        drop(gone);
        wait_until("the encoding to end", || server.metric(IN_FLIGHT) == Some(0.0) && beginnings() == 0);
        kept() == before
    });
    assert!(stopped, "it was encoded all the same");
    for metric in [IN_FLIGHT, UNREAD] {
        wait_until(metric, || server.metric(metric) == Some(0.0));
    }
    wait_until("its memory to be free", || server.metric("rpfd_memory_used_bytes") <= known);
    // The next has its turn.
    assert_eq!(server.get(path).status, 200);
}
