//! An image that is much larger than the memory, as bare cores that are made while they are sent.
//!
//! `RPFD_SIDE=16384` is 268 megapixels through 512 MiB, in some ten minutes of CPU time; by default it is 1 megapixel
//! through 32 MiB.

use std::{
    io::{BufRead, BufReader, Write},
    os::unix::fs::MetadataExt,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use super::{MIB, process::Process};
use crate::service::Server;
use rpfd::{
    client::Client,
    filter::{Execution, Method, Rect, SampleTile, TileGeometry, filter, geometry::tiling},
    image::description::channels_to_json,
    stitch::exr,
    synth::Scene,
    wire::{Assembler, Decoder, Event, Format, Header, encode_tile},
};
use serde_json::{Value, json};

const CORE: u32 = 128;

/// Samples of the scene that has everything, one in each pixel, as they are sent in half precision.
fn encoded(scene: &Scene, geometry: TileGeometry) -> (Header, Vec<u8>) {
    let tile = scene.tile(geometry, 1, &Execution::default()).unwrap();
    let header = Header::of(&tile, Format::F16).unwrap();
    let mut bytes = Vec::new();
    encode_tile(&header, &tile, &mut bytes).unwrap();
    (header, bytes)
}

/// The same, as whoever reads it has it.
fn decoded(scene: &Scene, geometry: TileGeometry) -> SampleTile {
    let (header, bytes) = encoded(scene, geometry);
    let (mut decoder, mut input, mut assembler) = (Decoder::new(), &bytes[..], Assembler::new(&header));
    while let Some(event) = decoder.next(&mut input).unwrap() {
        if !matches!(event, Event::Header(_)) {
            assembler.push(&event);
        }
    }
    assembler.finish().unwrap()
}

/// Sends all cores by rows in one endless request; says how many bytes that were, and how many of samples were on the
/// disk at once.
fn send(server: &Server, scene: &Scene, size: [u32; 2]) -> (u64, u64) {
    let stream = std::net::TcpStream::connect(&server.address).unwrap();
    let mut writer = stream.try_clone().unwrap();
    let kept = || std::fs::metadata(server.data_dir().join("images/a/samples")).unwrap().blocks() * 512;
    std::thread::scope(|scope| {
        let sending = scope.spawn(move || {
            let head = "POST /v1/images/a/tiles HTTP/1.1\r\nHost: test\r\nConnection: close\r\n";
            write!(writer, "{head}Transfer-Encoding: chunked\r\n\r\n").unwrap();
            let mut sent = 0;
            for core in tiling(size, CORE) {
                let (_, bytes) = encoded(scene, TileGeometry::with_halo(size, core, 0).unwrap());
                write!(writer, "{:x}\r\n", bytes.len()).unwrap();
                writer.write_all(&bytes).and_then(|()| writer.write_all(b"\r\n")).unwrap();
                sent += bytes.len() as u64;
            }
            writer.write_all(b"0\r\n\r\n").unwrap();
            sent
        });
        let (mut stored, mut most) = (0, 0);
        // The sizes of chunks, and the head of the answer, are no objects.
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            let Ok(Value::Object(line)) = serde_json::from_str(&line) else { continue };
            match line["state"].as_str() {
                Some("stored") => stored += 1,
                Some("end") => assert_eq!(line["errors"], 0),
                _ => panic!("{line:?}"),
            }
            most = most.max(kept());
        }
        assert_eq!(stored, tiling(size, CORE).count());
        (sending.join().unwrap(), most)
    })
}

/// Waits until all regions are filtered, as long as it goes on.
fn wait(server: &Server) {
    let (mut open, mut since) = (u64::MAX, Instant::now());
    while open > 0 {
        let now = server.get("/v1/images/a").json()["regions_open"].as_u64().unwrap();
        if now < open {
            (open, since) = (now, Instant::now());
        }
        assert!(since.elapsed() < Duration::from_secs(600), "{open} regions are open, and none of them is filtered");
        std::thread::sleep(Duration::from_millis(200));
    }
}

#[test]
fn an_image_larger_than_the_memory_passes_through_it() {
    let side: u32 = std::env::var("RPFD_SIDE").map_or(1024, |side| side.parse().unwrap());
    let (size, memory, scene) = ([side; 2], u64::from(side / 32) * MIB, Scene::by_name("all").unwrap());
    let method = Method::preset("lean").unwrap();
    // However slow the machine, the cores wait for their turn.
    let patient = ["--queue-deadline", "3600", "--idle-deadline", "3600"];
    let server = Server::start(&[&["--memory", &memory.to_string(), "--threads", "2"], &patient[..]].concat());
    let process = Process::of(server.pid());
    let first = decoded(&scene, TileGeometry::with_halo(size, Rect::new(0, 0, 16, 16), 0).unwrap());
    let opening = json!({
        "id": "a", "width": side, "height": side, "preset": "lean", "halo": "neighbors", "samples": 1,
        "channels": channels_to_json(first.channels()),
    });
    let opened = server.post("/v1/images", opening.to_string().as_bytes());
    assert_eq!(opened.status, 201, "{}", String::from_utf8_lossy(&opened.body));
    let started = Instant::now();
    let (sent, kept) = send(&server, &scene, size);
    let sending = started.elapsed();
    wait(&server);
    let filtering = started.elapsed();
    let (client, file) = (
        Client::new(&format!("http://{}", server.address), 1, Arc::new(AtomicBool::new(false))).unwrap(),
        tempfile::NamedTempFile::new().unwrap(),
    );
    client.fetch_exr("a", &[], || Ok(file.as_file()), |file, bytes| file.write_all(bytes)).unwrap();
    let peak = process.peak_memory();
    println!(
        "{side} x {side}, --memory {} MiB: {} MiB of samples sent in {:.0} s, at most {} MiB of them on the disk; filtered after \
         {:.0} s, fetched after {:.0} s; CPU {:.1} s, outside of the filter's threads {:.1} s; peak {:.1} MiB",
        memory / MIB,
        sent / MIB,
        sending.as_secs_f64(),
        kept / MIB,
        filtering.as_secs_f64(),
        started.elapsed().as_secs_f64(),
        process.cpu_seconds(),
        process.cpu_seconds() - process.filter_seconds(),
        peak as f64 / MIB as f64,
    );
    assert!(peak <= memory + 64 * MIB, "{peak} bytes at the peak, with --memory {memory}");
    // Here and there: the corners, the middles of the edges, the centre, across cores and regions.
    let image = exr::read(file.path(), u64::MAX).unwrap();
    let at = [0, side / 2 - CORE / 2, side - CORE];
    for (x, y) in at.into_iter().flat_map(|y| at.map(|x| (x, y))) {
        let geometry = TileGeometry::with_halo(size, Rect::new(x, y, CORE, CORE), method.reach(false)).unwrap();
        let [r, g, b] = filter(&decoded(&scene, geometry), &method, &Execution::default()).unwrap().rgb;
        for i in 0..r.len() {
            let (column, row) = (x as usize + i % CORE as usize, y as usize + i / CORE as usize);
            assert_eq!(image.pixels[row * side as usize + column], [r[i], g[i], b[i]], "({column}, {row})");
        }
    }
}
