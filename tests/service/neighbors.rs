//! Images whose tiles come as bare cores, and lend each other their halos.

use super::{Server, contradicting, encode, exact::whole_exr, samples, tile, wait_until};
use crate::stitch::shuffle;
use rpfd::{
    disk::Directory,
    filter::{Execution, Method, Rect, SampleTile, TileGeometry, filter, geometry::tiling},
    image::{Announced, Description, Image, ImageError, description::channels_to_json},
    stitch::exr,
    store::Spool,
    synth::Scene,
    wire::{Decoder, Event},
};
use serde_json::{Value, json};
use std::{
    os::unix::fs::MetadataExt,
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    sync::{Arc, atomic::AtomicBool},
};

/// What opens an image of this scene's tiles.
pub(crate) fn opening(id: &str, size: [u32; 2], preset: &str, samples: (&str, u32)) -> Vec<u8> {
    let tile = super::samples([16, 16], Rect::new(0, 0, 16, 16), 0, 1);
    let mut opening = json!({
        "id": id, "width": size[0], "height": size[1], "preset": preset, "seed": 5,
        "halo": "neighbors", "channels": channels_to_json(tile.channels()),
    });
    opening[samples.0] = samples.1.into();
    opening.to_string().into_bytes()
}

fn open(server: &Server, size: [u32; 2], preset: &str) {
    let answer = server.post("/v1/images", &opening("a", size, preset, ("samples", 4)));
    assert_eq!(answer.status, 201, "{}", String::from_utf8_lossy(&answer.body));
}

pub(crate) fn wait_complete(server: &Server, id: &str) {
    wait_until("an image to be complete", || server.get(&format!("/v1/images/{id}")).json()["complete"] == true);
}

/// Waits until hardly any samples are left on the disk.
fn wait_dropped(server: &Server) {
    let samples = server.data_dir().join("images/a/samples");
    wait_until("all samples to be dropped", || std::fs::metadata(&samples).unwrap().blocks() * 512 <= 8192);
}

fn states(lines: &[Value]) -> Vec<&str> {
    lines.iter().map(|line| line["state"].as_str().unwrap()).collect()
}

#[test]
fn bare_cores_in_any_order_are_the_whole_image() {
    const SIZE: [u32; 2] = [150, 130];
    let whole = samples(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0, 1);
    for (preset, side) in [("lean", 33), ("cross-bilateral", 16), ("unfiltered", 150)] {
        let server = Server::start(&["--memory", "64MiB"]);
        open(&server, SIZE, preset);
        let mut cores: Vec<Rect> = tiling(SIZE, side).collect();
        shuffle(&mut cores, u64::from(side));
        // Some bring a halo.
        let halo = |i: usize| if i.is_multiple_of(3) { 3 } else { 0 };
        let bodies: Vec<Vec<u8>> = cores.iter().enumerate().map(|(i, &core)| tile(SIZE, core, halo(i))).collect();
        let (one, others) = bodies.split_at(bodies.len() / 2);
        std::thread::scope(|scope| {
            for part in [one, others].into_iter().filter(|part| !part.is_empty()) {
                let server = &server;
                scope.spawn(move || {
                    let lines = server.post("/v1/images/a/tiles", &part.concat()).lines();
                    assert!(lines[..part.len()].iter().all(|line| line["state"] == "stored"), "{lines:?}");
                });
            }
        });
        wait_complete(&server, "a");
        let status = server.get("/v1/images/a").json();
        assert_eq!((&status["halo"], &status["tiles_stored"]), (&json!("neighbors"), &json!(cores.len())));
        assert_eq!((&status["regions_open"], &status["waiting"]), (&json!(0), &json!([])));
        assert_eq!(status["totals"]["short_of_halo"], 0);
        assert_eq!(status["totals"]["samples"], 4 * SIZE[0] * SIZE[1]);
        let exr = server.get("/v1/images/a/result.exr").body;
        assert!(exr == whole_exr(&whole, &Method::preset(preset).unwrap(), 5), "{preset}: another image");
        // A second time it need not be written anew, and is the same.
        assert!(server.get("/v1/images/a/result.exr").body == exr);
        // All samples are dropped, and known all the same.
        let lines = server.post("/v1/images/a/tiles", &bodies[0]).lines();
        assert_eq!(states(&lines), ["repeated", "end"]);
        wait_dropped(&server);
    }
}

#[test]
fn numbers_of_samples_may_vary_up_to_what_was_announced() {
    const SIZE: [u32; 2] = [80, 64];
    let scene = Scene::by_name("all").unwrap();
    let cut = |core| {
        let geometry = TileGeometry::with_halo(SIZE, core, 0).unwrap();
        scene.tile_varying(geometry, 6, &Execution { seed: 1, ..Execution::default() }).unwrap()
    };
    let whole = cut(Rect::new(0, 0, SIZE[0], SIZE[1]));
    let most = whole.max_per_pixel();
    let server = Server::start(&["--memory", "64MiB"]);
    server.post("/v1/images", &opening("a", SIZE, "lean", ("max_samples", most)));
    let bodies: Vec<Vec<u8>> = tiling(SIZE, 24).map(|core| encode(&cut(core))).collect();
    let lines = server.post("/v1/images/a/tiles", &bodies.concat()).lines();
    assert!(lines[..bodies.len()].iter().all(|line| line["state"] == "stored"), "{lines:?}");
    wait_complete(&server, "a");
    let exr = server.get("/v1/images/a/result.exr").body;
    assert!(exr == whole_exr(&whole, &Method::preset("lean").unwrap(), 5));
    // One more than was announced.
    server.post("/v1/images", &opening("b", SIZE, "lean", ("max_samples", most - 1)));
    let lines = server.post("/v1/images/b/tiles", &bodies.concat()).lines();
    let refused = lines.iter().filter(|line| line["problem"]["code"] == "samples_mismatch").count();
    assert!(refused > 0, "{lines:?}");
    server.post("/v1/images", &opening("c", SIZE, "lean", ("samples", most)));
    server.post("/v1/images/c/tiles", &bodies[0]).problem(422, "samples_mismatch");
}

#[test]
fn an_image_says_which_regions_wait_for_what() {
    const SIZE: [u32; 2] = [256, 64];
    let server = Server::start(&[]);
    open(&server, SIZE, "lean");
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(0, 0, 64, 64), 0)).lines();
    let status = server.get("/v1/images/a").json();
    assert_eq!((&status["pixels_stored"], &status["regions"]), (&json!(64 * 64), &json!(4)));
    let waiting = &status["waiting"];
    assert_eq!(
        waiting[0],
        json!({"region": [0, 0, 64, 64], "state": "waiting", "for": [[64, 0, 17, 64]], "for_regions": 1})
    );
    assert_eq!(waiting[3]["for"], json!([[175, 0, 81, 64]]));
    server.get("/v1/images/a/result.exr").problem(409, "image_incomplete");
    // With its neighbour the first can be filtered, the second not.
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(64, 0, 64, 64), 0)).lines();
    wait_until("the first region", || server.get("/v1/images/a").json()["tiles_done"] == 1);
    let status = server.get("/v1/images/a").json();
    assert_eq!(status["tiles"][0]["tile"], json!([0, 0, 64, 64]));
    assert_eq!(status["tiles"][0]["report"]["exact"], true);
    assert_eq!(status["waiting"].as_array().unwrap().len(), 3);
}

#[test]
fn what_cannot_be_is_refused() {
    const SIZE: [u32; 2] = [70, 64];
    let server = Server::start(&[]);
    open(&server, SIZE, "lean");
    let send = |body: &[u8]| server.post("/v1/images/a/tiles", body);
    let code = |body: &[u8]| send(body).lines()[0]["problem"]["code"].as_str().unwrap().to_owned();
    send(&tile(SIZE, Rect::new(16, 16, 15, 16), 0)).problem(422, "tile_too_small");
    let core = Rect::new(0, 0, 32, 32);
    assert_eq!(states(&send(&tile(SIZE, core, 0)).lines()), ["stored", "end"]);
    assert_eq!(states(&send(&tile(SIZE, core, 7)).lines()), ["repeated", "end"]);
    let other = encode(&samples(SIZE, core, 0, 2));
    assert_eq!(code(&other), "tile_conflict");
    let replace = server.post("/v1/images/a/tiles?replace=true", &other).lines();
    assert_eq!(replace[0]["problem"]["code"], "tile_conflict");
    assert_eq!(code(&tile(SIZE, Rect::new(16, 16, 32, 32), 0)), "tile_overlap");
    // Only at the edge.
    assert_eq!(states(&send(&tile(SIZE, Rect::new(64, 0, 6, 64), 0)).lines()), ["stored", "end"]);
    // Opened differently, and wrongly.
    let with = |change: &dyn Fn(&mut Value)| {
        let mut opening: Value = serde_json::from_slice(&opening("a", SIZE, "lean", ("samples", 4))).unwrap();
        change(&mut opening);
        server.post("/v1/images", opening.to_string().as_bytes())
    };
    assert_eq!(with(&|_| {}).status, 200);
    with(&|o| o["samples"] = json!(5)).problem(409, "image_conflict");
    with(&|o| o["channels"].as_array_mut().unwrap().truncate(2)).problem(409, "image_conflict");
    with(&|o| o["max_samples"] = json!(5)).problem(400, "bad_parameter");
    with(&|o| o["samples"] = json!(0)).problem(400, "bad_parameter");
    with(&|o| o["channels"] = json!([])).problem(400, "bad_parameter");
    with(&|o| o["channels"] = json!("film")).problem(400, "bad_parameter");
    with(&|o| o["halo"] = json!("nobody")).problem(400, "bad_parameter");
    with(&|o| o["halo"] = json!("client")).problem(400, "bad_parameter");
}

/// The file that `rpfd filter --partial` would write of these tiles, if it had samples of some pixels more.
fn partial(size: [u32; 2], tiles: &[SampleTile], around: &[SampleTile], method: &Method) -> Vec<u8> {
    let mut spool = Spool::in_memory(1 << 26);
    for tile in tiles.iter().chain(around) {
        let (bytes, mut decoder) = (encode(tile), Decoder::new());
        let mut input = &bytes[..];
        while let Some(event) = decoder.next(&mut input).unwrap() {
            spool.push(&event).unwrap();
            if matches!(event, Event::TileEnd) {
                break;
            }
        }
    }
    let mut stitcher = rpfd::stitch::Stitcher::new(size[0], size[1], &std::env::temp_dir()).unwrap();
    for tile in tiles {
        let core = tile.geometry().core();
        let geometry = TileGeometry::with_halo(size, core, method.reach(true)).unwrap();
        let filtered =
            filter(&spool.cut_partial(geometry).unwrap(), method, &Execution { seed: 5, ..Execution::default() })
                .unwrap();
        let rpfd::stitch::Offer::Filter(claim) = stitcher.offer(core, [0; 32], false).unwrap() else { panic!() };
        stitcher.add(claim, &filtered).unwrap();
    }
    let attributes = exr::provenance(method.preset_name(), 5, method.parameters());
    let options = rpfd::stitch::ExrOptions { attributes, ..Default::default() };
    let mut out = std::io::Cursor::new(Vec::new());
    stitcher.encode_exr(&options, true, &mut out).unwrap();
    out.into_inner()
}

#[test]
fn an_image_is_finished_with_what_there_is() {
    const SIZE: [u32; 2] = [128, 128];
    let there = [Rect::new(0, 0, 40, 128), Rect::new(40, 0, 88, 30), Rect::new(100, 60, 20, 20)];
    let tiles = there.map(|core| samples(SIZE, core, 0, 1));
    let server = Server::start(&[]);
    open(&server, SIZE, "lean");
    let body: Vec<u8> = tiles.iter().flat_map(encode).collect();
    server.post("/v1/images/a/tiles", &body).lines();
    let answer = server.post("/v1/images/a/finish", &[]);
    assert!([200, 202].contains(&answer.status) && answer.json()["finished"] == true, "{answer:?}");
    wait_until("the regions", || server.get("/v1/images/a").json()["regions_open"] == 0);
    let status = server.get("/v1/images/a").json();
    let pixels: u64 = there.iter().map(Rect::area).sum();
    assert_eq!((&status["complete"], &status["pixels_done"]), (&json!(false), &json!(pixels)));
    assert!(status["totals"]["short_of_halo"].as_u64().unwrap() > 0);
    assert!(status["tiles"].as_array().unwrap().iter().any(|tile| tile["report"]["exact"] == false));
    assert!(!status["missing"].as_array().unwrap().is_empty());
    let exr = server.get("/v1/images/a/result.exr");
    assert!(
        exr.body == partial(SIZE, &tiles, &[], &Method::preset("lean").unwrap()),
        "not what filter --partial gives"
    );
    // It takes no more, but knows what it has.
    let lines = server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(60, 60, 20, 20), 0)).lines();
    assert_eq!(lines[0]["problem"]["code"], "image_finished");
    assert_eq!(states(&server.post("/v1/images/a/tiles", &encode(&tiles[2])).lines()), ["repeated", "end"]);
    assert_eq!(server.post("/v1/images/a/finish", &[]).status, 200);
    // The same with tiles that bring their halos.
    server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "b"}"#);
    let left = tile([32, 16], Rect::new(0, 0, 16, 16), 17);
    server.post("/v1/images/b/tiles", &left).lines();
    server.get("/v1/images/b/result.exr").problem(409, "image_incomplete");
    assert_eq!(server.post("/v1/images/b/finish", &[]).status, 200);
    assert_eq!(server.get("/v1/images/b/result.exr").status, 200);
    assert_eq!(states(&server.post("/v1/images/b/tiles", &left).lines()), ["repeated", "end"]);
    let lines = server.post("/v1/images/b/tiles", &tile([32, 16], Rect::new(16, 0, 16, 16), 0)).lines();
    assert_eq!(lines[0]["problem"]["code"], "image_finished");
    server.post("/v1/images/c/finish", &[]).problem(404, "unknown_image");
}

/// A tile that brings the halo that its core needs waits for nobody; what it lends counts for others.
#[test]
fn halos_stand_for_cores_that_have_not_come() {
    const SIZE: [u32; 2] = [256, 64];
    let expected = whole_exr(&samples(SIZE, Rect::new(0, 0, 256, 64), 0, 1), &Method::preset("lean").unwrap(), 5);
    let server = Server::start(&[]);
    open(&server, SIZE, "lean");
    let second = contradicting(SIZE, Rect::new(64, 0, 64, 64), 17);
    server.post("/v1/images/a/tiles", &encode(&second)).lines();
    let filtered = |server: &Server, tiles: u64| {
        wait_until("regions", || server.get("/v1/images/a").json()["tiles_done"] == tiles);
        server.get("/v1/images/a").json()["waiting"].clone()
    };
    let waiting = json!([
        {"region": [0, 0, 64, 64], "state": "waiting", "for": [[0, 0, 64, 64]], "for_regions": 1},
        {"region": [64, 0, 64, 64], "state": "filtered", "for": [[47, 0, 17, 64], [128, 0, 17, 64]], "for_regions": 2},
        {"region": [128, 0, 64, 64], "state": "waiting", "for": [[128, 0, 81, 64]], "for_regions": 1},
        {"region": [192, 0, 64, 64], "state": "waiting", "for": [[175, 0, 81, 64]], "for_regions": 1},
    ]);
    assert_eq!(filtered(&server, 1), waiting);
    let server = Server::start_in(server.kill(), &[]);
    assert_eq!(filtered(&server, 1), waiting);
    // What its neighbour lends, a bare core uses.
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(192, 0, 64, 64), 17)).lines();
    let waiting = filtered(&server, 2);
    assert_eq!(waiting[2]["for"], json!([[128, 0, 64, 64]]));
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(128, 0, 64, 64), 0)).lines();
    // The last of these is final: all that it reads came in cores.
    wait_until("regions", || server.get("/v1/images/a").json()["regions_open"] == 2);
    assert_eq!(filtered(&server, 3)[1]["for"], json!([[47, 0, 17, 64]]));
    // What was lent was not what the cores bring.
    server.get("/v1/images/a/result.exr").problem(409, "image_incomplete");
    let server = Server::start_in(server.kill(), &[]);
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(0, 0, 64, 64), 0)).lines();
    wait_complete(&server, "a");
    assert!(server.get("/v1/images/a/result.exr").body == expected, "not the image of the cores");
    assert_eq!(server.get("/v1/images/a").json()["totals"]["short_of_halo"], 0);
}

/// Bare cores, tiles with some halo or all of it, and some whose halo is not what the cores bring, in any order and
/// through kills.
#[test]
fn any_mixture_is_the_whole_image() {
    const SIZE: [u32; 2] = [150, 130];
    let whole = samples(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0, 1);
    for (preset, side, seed) in [("lean", 33, 1), ("lean", 64, 2), ("cross-bilateral", 16, 3), ("lean", 75, 4)] {
        let mut server = Server::start(&["--memory", "64MiB"]);
        open(&server, SIZE, preset);
        let mut cores: Vec<Rect> = tiling(SIZE, side).collect();
        shuffle(&mut cores, seed);
        let bodies = cores.iter().enumerate().map(|(i, &core)| match i % 4 {
            0 => tile(SIZE, core, 0),
            1 => tile(SIZE, core, 5),
            2 => tile(SIZE, core, 17 + (i as u32 % 3) * 8),
            _ => encode(&contradicting(SIZE, core, 20)),
        });
        let bodies: Vec<Vec<u8>> = bodies.collect();
        for part in bodies.chunks(bodies.len().div_ceil(3)) {
            let lines = server.post("/v1/images/a/tiles", &part.concat()).lines();
            assert!(lines[..part.len()].iter().all(|line| line["state"] == "stored"), "{lines:?}");
            server = Server::start_in(server.kill(), &["--memory", "64MiB"]);
        }
        wait_complete(&server, "a");
        let exr = server.get("/v1/images/a/result.exr").body;
        assert!(exr == whole_exr(&whole, &Method::preset(preset).unwrap(), 5), "{preset}, {side}: another image");
        wait_dropped(&server);
    }
}

#[test]
fn halos_that_vary_in_their_numbers_of_samples_are_used() {
    const SIZE: [u32; 2] = [80, 64];
    let scene = Scene::by_name("all").unwrap();
    let cut = |core, halo| {
        let geometry = TileGeometry::with_halo(SIZE, core, halo).unwrap();
        scene.tile_varying(geometry, 6, &Execution { seed: 1, ..Execution::default() }).unwrap()
    };
    let whole = cut(Rect::new(0, 0, SIZE[0], SIZE[1]), 0);
    let method = Method::preset("lean").unwrap();
    let server = Server::start(&["--memory", "64MiB"]);
    server.post("/v1/images", &opening("a", SIZE, "lean", ("max_samples", whole.max_per_pixel())));
    let mut cores: Vec<Rect> = tiling(SIZE, 24).collect();
    shuffle(&mut cores, 2);
    for (i, &core) in cores.iter().enumerate() {
        server.post("/v1/images/a/tiles", &encode(&cut(core, [0, 6, method.reach(true)][i % 3]))).lines();
    }
    wait_complete(&server, "a");
    assert!(server.get("/v1/images/a/result.exr").body == whole_exr(&whole, &method, 5));
}

#[test]
fn an_image_is_finished_with_what_halos_brought() {
    const SIZE: [u32; 2] = [128, 128];
    let (core, method) = (Rect::new(32, 40, 64, 50), Method::preset("lean").unwrap());
    let strips: Vec<SampleTile> =
        core.grown(5, &Rect::new(0, 0, 128, 128)).without(&core).map(|strip| samples(SIZE, strip, 0, 1)).collect();
    let server = Server::start(&[]);
    open(&server, SIZE, "lean");
    server.post("/v1/images/a/tiles", &tile(SIZE, core, 5)).lines();
    server.post("/v1/images/a/finish", &[]);
    wait_until("the regions", || server.get("/v1/images/a").json()["regions_open"] == 0);
    let status = server.get("/v1/images/a").json();
    assert_eq!((&status["pixels_done"], &status["pixels_stored"]), (&json!(core.area()), &json!(core.area())));
    let exr = server.get("/v1/images/a/result.exr").body;
    let tiles = [samples(SIZE, core, 0, 1)];
    assert!(exr == partial(SIZE, &tiles, &strips, &method), "the halo was not used");
    assert!(exr != partial(SIZE, &tiles, &[], &method), "the halo makes no difference");
}

#[test]
fn a_region_that_takes_too_long_is_stopped() {
    // A minute of work on one thread.
    const SIZE: [u32; 2] = [48, 48];
    let server = Server::start(&["--metrics-listen", "127.0.0.1:0", "--work-deadline", "50ms"]);
    let mut opening: Value = serde_json::from_slice(&opening("a", SIZE, "paper", ("samples", 4))).unwrap();
    opening["boxes"] = json!([55, 55, 55, 55]);
    opening["fractions"] = json!([4, 4, 4, 4]);
    assert_eq!(server.post("/v1/images", opening.to_string().as_bytes()).status, 201);
    server.post("/v1/images/a/tiles", &tile(SIZE, Rect::new(0, 0, 48, 48), 0)).lines();
    let mut trouble = Value::Null;
    wait_until("the time to be up", || {
        trouble = server.get("/v1/images/a").json()["trouble"].clone();
        trouble["code"] == "work_timeout"
    });
    assert!(trouble["detail"].as_str().unwrap().contains("smaller parts"), "{trouble}");
    // What is known of the image stays; filtering takes many times as much.
    wait_until("its memory to be free", || server.metric("rpfd_memory_used_bytes") < Some(1e6));
    assert!(server.metric("rpfd_regions_total{outcome=\"failed\"}") >= Some(1.0));
    // It is tried again, until the image is forgotten.
    wait_until("another attempt", || server.metric("rpfd_regions_total{outcome=\"failed\"}") >= Some(2.0));
    assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
    wait_until("the work to end", || server.metric("rpfd_images_disk_bytes") == Some(0.0));
}

/// Makes an image of bare cores with regions of this side, which is to become that of these samples.
fn create(folder: &Path, whole: &SampleTile, method: &Method, region: u32) {
    let announced = Announced { channels: whole.channels().clone(), samples: 4, varying: false, region };
    let (size, neighbors) = (whole.geometry().image(), Some(announced));
    let (size, method) = ([size.width, size.height], method.clone());
    let description = Description { size, method, seed: 5, leave_out: true, neighbors, owner: None, disk: 0 };
    Image::create(&Directory::new(folder), &description).unwrap();
}

fn reopen(folder: &Path) -> Arc<Image> {
    Arc::new(Image::open(Box::new(Directory::new(folder))).unwrap())
}

fn exr_of(image: &Image, method: &Method) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let attributes = exr::provenance(method.preset_name(), 5, method.parameters());
    let options = rpfd::stitch::ExrOptions { attributes, ..Default::default() };
    image.read().stitcher().encode_exr(&options, false, &mut out).unwrap();
    out.into_inner()
}

/// An image of one region, all of whose samples have come.
fn one_region(method: &Method) -> (tempfile::TempDir, SampleTile, Arc<Image>) {
    let folder = tempfile::tempdir().unwrap();
    let whole = samples([64, 48], Rect::new(0, 0, 64, 48), 0, 1);
    create(folder.path(), &whole, method, 64);
    let image = reopen(folder.path());
    image.offer(&whole, false).unwrap();
    image.flush().unwrap();
    (folder, whole, image)
}

#[test]
fn a_region_that_was_stopped_is_filtered_in_parts() {
    let method = Method::preset("lean").unwrap();
    let (_folder, whole, image) = one_region(&method);
    let stop = AtomicBool::new(true);
    let stopped = Execution { stop: Some(&stop), ..Execution::default() };
    let job = image.next_job(1, u64::MAX, u64::MAX).unwrap().unwrap();
    assert!(matches!(image.run(&job, &stopped), Err(ImageError::Stopped(_))));
    assert_eq!(job.pixels, 64 * 48);
    let part = image.next_job(1, u64::MAX, job.pixels / 3).unwrap().unwrap();
    assert_eq!(part.pixels, 32 * 24);
    let spent = image.run(&part, &Execution::default()).unwrap();
    assert!(!spent.filter.is_zero() && !spent.read.is_zero() && !spent.write.is_zero());
    let tiles = image.read().stitcher().tiles().count();
    assert!(tiles == 4 && image.read().stitcher().is_complete());
    assert!(exr_of(&image, &method) == whole_exr(&whole, &method, 5));
}

#[test]
fn a_region_whose_filtering_panics_is_filtered_again() {
    let method = Method::preset("lean").unwrap();
    let (_folder, whole, image) = one_region(&method);
    let job = image.next_job(1, u64::MAX, u64::MAX).unwrap().unwrap();
    assert!(image.next_job(1, u64::MAX, u64::MAX).unwrap().is_none() && !image.read().idle());
    let panics = |_: f32| panic!("on purpose");
    let execution = Execution { progress: Some(&panics), ..Execution::default() };
    assert!(catch_unwind(AssertUnwindSafe(|| image.run(&job, &execution))).is_err());
    assert!(image.read().idle(), "it is still at work");
    let again = image.next_job(1, u64::MAX, u64::MAX).unwrap().expect("the region is given back");
    image.run(&again, &Execution::default()).unwrap();
    assert!(image.read().idle() && image.read().complete());
    assert!(exr_of(&image, &method) == whole_exr(&whole, &method, 5));
}

/// What was dropped stays on record; where it was, there may be others' samples after the image was opened again.
#[test]
fn what_is_not_needed_any_more_takes_nothing_else_with_it() {
    const SIZE: [u32; 2] = [128, 16];
    let (folder, method) = (tempfile::tempdir().unwrap(), Method::preset("gaussian").unwrap());
    let whole = samples(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0, 1);
    create(folder.path(), &whole, &method, 16);
    // The last core that came is the first that is dropped; then others come into its place, after some new starts, since
    // each leaves room behind it.
    for cores in [&[2, 1, 0][..], &[5], &[7], &[3], &[4, 6], &[]] {
        let image = reopen(folder.path());
        for &core in cores {
            image.offer(&samples(SIZE, Rect::new(16 * core, 0, 16, 16), 0, 1), false).unwrap();
            image.flush().unwrap();
        }
        while let Some(job) = image.next_job(1, u64::MAX, u64::MAX).unwrap() {
            image.run(&job, &Execution::default()).unwrap();
        }
        image.close();
    }
    let image = reopen(folder.path());
    assert_eq!(image.read().regions().unwrap().open(), 0);
    assert!(exr_of(&image, &method) == whole_exr(&whole, &method, 5));
}

#[test]
fn regions_take_no_places_of_tiles_in_the_queue() {
    const SIZE: [u32; 2] = [256, 192];
    let metrics = ["--metrics-listen", "127.0.0.1:0", "--threads", "2"];
    let server = Server::start(&[&metrics[..], &["--memory", "32MiB", "--queue", "1"]].concat());
    open(&server, SIZE, "gaussian");
    // One tile after another waits, and so do regions at the same time.
    let body: Vec<u8> = tiling(SIZE, 32).flat_map(|core| tile(SIZE, core, 0)).collect();
    let lines = server.post("/v1/images/a/tiles", &body).lines();
    assert_eq!(lines.last().unwrap(), &json!({ "state": "end", "tiles": 48, "errors": 0 }));
    wait_complete(&server, "a");
    assert_eq!(server.metric("rpfd_problems_total{code=\"busy\"}"), None);
    assert_eq!(server.metric("rpfd_regions_total{outcome=\"failed\"}"), Some(0.0));
}

#[test]
fn post_sends_bare_cores() {
    let render = crate::cli::data("depth_of_field.8spp.tiles.zst");
    let folder = crate::cli::Folder::new();
    let (offline, posted) = (folder.path("offline.exr"), folder.path("posted.exr"));
    let render = render.to_str().unwrap();
    assert!(crate::cli::rpfd(["filter", render, "-o", &offline]).status.success());
    let server = Server::start(&[]);
    let url = format!("http://{}", server.address);
    let output = crate::cli::rpfd(["post", render, "--to", &url, "-o", &posted, "--halo", "neighbors", "--tile", "32"]);
    assert!(output.status.success(), "{}", crate::cli::stderr(&output));
    assert!(std::fs::read(offline).unwrap() == std::fs::read(posted).unwrap());
}
