//! `kill -9` of the real binary while tiles are on their way to it, again and again until the image is whole.

use super::{Random, rounds};
use crate::{
    service::{Server, contradicting, encode, exact::whole_exr, head, neighbors, samples, tile},
    stitch::shuffle,
};
use rpfd::filter::{Method, Rect, geometry::tiling};
use std::{
    collections::HashSet,
    io::{BufRead, BufReader, Write},
    net::TcpStream,
    sync::Mutex,
    time::Duration,
};

/// Sends tiles over a connection of their own, and notes what was acknowledged, until an end or a kill.
fn send(mut stream: TcpStream, body: &[u8], acknowledged: &Mutex<HashSet<Rect>>) -> Option<()> {
    let mut writer = stream.try_clone().ok()?;
    let head = head("POST", "/v1/images/a/tiles", &[], body.len());
    std::thread::scope(|scope| {
        scope.spawn(move || writer.write_all(head.as_bytes()).and_then(|()| writer.write_all(body)));
        for line in BufReader::new(&mut stream).lines() {
            // The sizes of chunks are no objects.
            let Ok(line) = serde_json::from_str::<serde_json::Value>(&line.ok()?) else { continue };
            let Some(state) = line["state"].as_str() else { continue };
            if ["filtered", "stored", "repeated"].contains(&state) {
                let [x, y, w, h] = [0, 1, 2, 3].map(|i| line["tile"][i].as_u64().unwrap() as u32);
                acknowledged.lock().unwrap().insert(Rect::new(x, y, w, h));
            } else if state == "error" {
                // Of the kill's making: the disk under a service that is gone does not answer.
                panic!("{line}");
            }
        }
        Some(())
    })
}

/// One image under fire. Says how many kills it took.
fn round(seed: u64, side: u32, opening: &[u8], tiles: &[(Rect, Vec<u8>)], expected: &[u8]) -> u32 {
    let mut random = Random::new(seed);
    let acknowledged: Mutex<HashSet<Rect>> = Mutex::new(HashSet::new());
    let mut server = Server::start(&["--memory", "64MiB", "--threads", "2"]);
    let mut kills = 0;
    loop {
        let status = server.post("/v1/images", opening).status;
        assert!(status == 200 || status == 201);
        let known = server.get("/v1/images/a").json();
        let done: HashSet<Vec<u64>> = known["tiles"]
            .as_array()
            .unwrap()
            .iter()
            .map(|tile| tile["tile"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap()).collect())
            .collect();
        let sent = acknowledged.lock().unwrap().clone();
        if known["halo"] == "client" {
            for core in &sent {
                let corners = [core.x, core.y, core.width, core.height].map(u64::from).to_vec();
                assert!(done.contains(&corners), "seed {seed}: {core} was acknowledged and is lost");
            }
        } else {
            let pixels: u64 = sent.iter().map(Rect::area).sum();
            assert!(known["pixels_stored"].as_u64().unwrap() >= pixels, "seed {seed}: acknowledged cores are lost");
        }
        let missing: Vec<usize> = (0..tiles.len()).filter(|&i| !sent.contains(&tiles[i].0)).collect();
        if missing.is_empty() && known["complete"] == true {
            break;
        }
        // A quarter of what is missing at a time, on two connections; the kill comes whenever it comes.
        let mut part = missing;
        shuffle(&mut part, random.below(1 << 30));
        part.truncate(tiles.len().div_ceil(4));
        let halves = part.split_at(part.len() / 2);
        // It lives longer and longer, so that some time even the slowest machine comes to an end.
        let pause = Duration::from_micros(200 + random.below(250_000 + 50_000 * u64::from(kills)));
        let folder = std::thread::scope(|scope| {
            for half in [halves.0, halves.1] {
                let acknowledged = &acknowledged;
                let body: Vec<u8> = half.iter().flat_map(|&i| tiles[i].1.clone()).collect();
                if !body.is_empty() {
                    // From here: once it is killed its port may be somebody else's.
                    let stream = server.connect();
                    scope.spawn(move || send(stream, &body, acknowledged));
                }
            }
            std::thread::sleep(pause);
            server.kill()
        });
        kills += 1;
        assert!(kills < 400, "seed {seed}: it comes to no end");
        server = Server::start_in(folder, &["--memory", "64MiB", "--threads", "2"]);
    }
    let exr = server.get("/v1/images/a/result.exr");
    assert_eq!(exr.status, 200, "seed {seed}: {}", String::from_utf8_lossy(&exr.body));
    assert!(exr.body == expected, "seed {seed}: another image of {side} x {side}");
    kills
}

/// Width and height of the image: `RPFD_SIDE`.
fn side() -> u32 {
    std::env::var("RPFD_SIDE").map_or(120, |side| side.parse().unwrap())
}

#[test]
fn killed_at_random_points_the_image_is_the_same() {
    let side = side();
    let size = [side, side];
    let method = Method::preset("lean").unwrap();
    let expected = whole_exr(&samples(size, Rect::new(0, 0, side, side), 0, 1), &method, 5);
    let client = format!(r#"{{"width": {side}, "height": {side}, "id": "a", "seed": 5, "preset": "lean"}}"#);
    let neighbors = neighbors::opening("a", size, "lean", ("samples", 4));
    // Of large images larger ones, whose halos together are less than the image itself.
    let cores: Vec<Rect> = tiling(size, (side / 16).max(40)).collect();
    let with_halo = |halo: u32| cores.iter().map(|&core| (core, tile(size, core, halo))).collect::<Vec<_>>();
    let (bare, full) = (with_halo(0), with_halo(17));
    // A third without a halo, a third with one, a third with one of other samples than the cores bring.
    let mixed = cores.iter().enumerate().map(|(i, &core)| match i % 3 {
        0 => bare[i].clone(),
        1 => full[i].clone(),
        _ => (core, encode(&contradicting(size, core, 17))),
    });
    let mixed: Vec<_> = mixed.collect();
    let mut kills = 0;
    for seed in rounds(3) {
        let (by, n) = match seed % 3 {
            0 => ("client halos", round(seed, side, client.as_bytes(), &full, &expected)),
            1 => ("neighbours", round(seed, side, &neighbors, &bare, &expected)),
            _ => ("both", round(seed, side, &neighbors, &mixed, &expected)),
        };
        println!("seed {seed}, {by}: {n} kills");
        kills += n;
    }
    println!("{kills} kills");
    assert!(kills > 0);
}
