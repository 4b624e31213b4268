//! Regions that do not fit into the memory of a later start.

use super::{
    Server, contradicting, encode,
    exact::whole_exr,
    neighbors::{opening, wait_complete},
    samples, tile, wait_until,
};
use rpfd::filter::{Method, Rect, geometry::tiling};
use serde_json::{Value, json};

/// A tile that was filtered with what halos lent has to be filtered again as it was, however little memory there is now.
#[test]
fn a_region_that_is_too_large_keeps_no_others_waiting() {
    const SIZE: [u32; 2] = [256, 128];
    let early = Rect::new(64, 0, 64, 64);
    let method = Method::preset("lean").unwrap();
    let arguments = |memory| ["--threads", "1", "--memory", memory];
    let server = Server::start(&arguments("256MiB"));
    let opened = server.post("/v1/images", &opening("a", SIZE, "lean", ("samples", 4)));
    assert_eq!(opened.status, 201, "{}", String::from_utf8_lossy(&opened.body));
    let body = encode(&contradicting(SIZE, early, method.reach(false)));
    assert_eq!(server.post("/v1/images/a/tiles", &body).lines()[0]["state"], "stored");
    let state = |server: &Server, region: Rect| -> Value {
        let status = server.get("/v1/images/a").json();
        let regions = status["waiting"].as_array().unwrap();
        let corners = json!([region.x, region.y, region.width, region.height]);
        regions.iter().find(|waiting| waiting["region"] == corners).map_or(Value::Null, |found| found["state"].clone())
    };
    wait_until("the region to be filtered early", || state(&server, early) == "filtered");
    // The whole of a region does not fit any more, parts of it do.
    let server = Server::start_in(server.kill(), &arguments("7MiB"));
    let cores = tiling(SIZE, 32).filter(|core| core.intersection(&early).is_none());
    let body: Vec<u8> = cores.flat_map(|core| tile(SIZE, core, 0)).collect();
    let end = server.post("/v1/images/a/tiles", &body).lines().pop().unwrap();
    assert_eq!((&end["tiles"], &end["errors"]), (&json!(28), &json!(0)));
    wait_until("all others", || server.get("/v1/images/a").json()["regions_open"] == 1);
    wait_until("the trouble to show", || server.get("/v1/images/a").json()["trouble"].is_object());
    wait_until("the region to be set aside", || state(&server, early) == "too_large");
    let trouble = server.get("/v1/images/a").json()["trouble"].clone();
    assert_eq!(trouble["code"], "over_memory", "{trouble}");
    let refused = server.get("/v1/images/a/result.exr").problem(409, "image_incomplete");
    assert_eq!((&refused["missing"], &refused["trouble"]["code"]), (&json!([[64, 0, 64, 64]]), &trouble["code"]));
    // With more memory it goes on.
    let server = Server::start_in(server.kill(), &arguments("64MiB"));
    wait_complete(&server, "a");
    let whole = samples(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0, 1);
    assert!(server.get("/v1/images/a/result.exr").body == whole_exr(&whole, &method, 5));
}
