//! Images: opened, filled with tiles, looked at, fetched, deleted.

use super::{Server, encode, samples, tile};
use rpfd::filter::Rect;
use serde_json::{Value, json};

const SIZE: [u32; 2] = [32, 16];
const LEFT: Rect = Rect::new(0, 0, 16, 16);
const RIGHT: Rect = Rect::new(16, 0, 16, 16);

fn open(server: &Server) {
    assert_eq!(server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "a"}"#).status, 201);
}

fn states(lines: &[Value]) -> Vec<&str> {
    lines.iter().map(|line| line["state"].as_str().unwrap()).collect()
}

#[test]
fn an_id_stands_for_one_image() {
    let server = Server::start(&[]);
    let body = br#"{"width": 32, "height": 16, "id": "shot-7_b.1", "preset": "lean", "boxes": [9, 5], "seed": 3}"#;
    let answer = server.post("/v1/images", body);
    assert_eq!((answer.status, answer.header("location")), (201, Some("/v1/images/shot-7_b.1")));
    let image = answer.json();
    assert_eq!((&image["id"], &image["seed"]), (&json!("shot-7_b.1"), &json!(3)));
    assert_eq!(image["parameters"]["boxes"], "9,5");
    assert_eq!(server.post("/v1/images", body).status, 200);
    let other = String::from_utf8(body.to_vec()).unwrap().replace("3}", "4}");
    server.post("/v1/images", other.as_bytes()).problem(409, "image_conflict");
    let made = server.post("/v1/images", br#"{"width": 1, "height": 1}"#).json();
    let id = made["id"].as_str().unwrap();
    assert_eq!(id.len(), 32);
    assert_eq!(server.get("/v1/images").json()["images"].as_array().unwrap().len(), 2);
    assert_eq!(server.call("DELETE", &format!("/v1/images/{id}"), &[], &[]).status, 204);
    server.get(&format!("/v1/images/{id}")).problem(404, "unknown_image");
    let huge = server.post("/v1/images", br#"{"width": 1048576, "height": 1025}"#);
    huge.problem(413, "image_too_large");
}

#[test]
fn an_image_says_what_is_missing_until_nothing_is() {
    let server = Server::start(&[]);
    open(&server);
    let lines = server.post("/v1/images/a/tiles", &tile(SIZE, LEFT, 17)).lines();
    assert_eq!(lines[0], json!({"tile": [0, 0, 16, 16], "state": "filtered"}));
    assert_eq!(lines[1], json!({"state": "end", "tiles": 1, "errors": 0}));
    for path in ["result.exr", "preview.png"] {
        let problem = server.get(&format!("/v1/images/a/{path}")).problem(409, "image_incomplete");
        assert_eq!(problem["missing"], json!([[16, 0, 16, 16]]));
        let partial = server.get(&format!("/v1/images/a/{path}?partial=true"));
        assert_eq!(partial.status, 200);
        server.get(&format!("/v1/images/a/{path}?partial=perhaps")).problem(400, "bad_parameter");
        server.get(&format!("/v1/images/a/{path}?full=true")).problem(400, "unknown_parameter");
    }
    let status = server.get("/v1/images/a").json();
    assert_eq!(status["missing"], json!([[16, 0, 16, 16]]));
    assert_eq!((&status["complete"], &status["pixels_done"]), (&json!(false), &json!(256)));
    server.post("/v1/images/a/tiles", &tile(SIZE, RIGHT, 3)).lines();
    let status = server.get("/v1/images/a").json();
    assert_eq!((&status["complete"], &status["missing"]), (&json!(true), &json!([])));
    assert_eq!(status["tiles"][0]["tile"], json!([0, 0, 16, 16]));
    assert_eq!(status["tiles"][0]["report"]["halo"], json!([0, 0, 16, 0]));
    assert_eq!(status["tiles"][1]["report"]["exact"], json!(false));
    assert!(status["tiles"][0]["report"]["seconds"].as_f64().unwrap() > 0.0);
    assert_eq!((&status["totals"]["tiles"], &status["totals"]["short_of_halo"]), (&json!(2), &json!(1)));
    let sum =
        |key: &str| -> u64 { [0, 1].map(|i| status["tiles"][i]["report"]["work"][key].as_u64().unwrap()).iter().sum() };
    for key in ["done", "planes", "columns", "distances"] {
        assert_eq!(status["totals"]["work"][key], sum(key), "{key}");
    }
    assert!(sum("done") > 0);
    let exr = server.get("/v1/images/a/result.exr?samples=half&compression=piz&layout=tiles&tile=16");
    assert_eq!((exr.status, exr.header("content-type")), (200, Some("image/x-exr")));
    assert_eq!(exr.header("content-length").unwrap(), exr.body.len().to_string());
    assert_eq!(exr.body[..4], [0x76, 0x2f, 0x31, 0x01]);
    server.get("/v1/images/a/result.exr?tile=15").problem(400, "bad_parameter");
    server.get("/v1/images/a/result.exr?compression=lossy").problem(400, "bad_parameter");
    let png = server.get("/v1/images/a/preview.png");
    assert_eq!((png.header("content-type"), &png.body[1..4]), (Some("image/png"), &b"PNG"[..]));
}

#[test]
fn tiles_may_be_repeated_and_replaced() {
    let server = Server::start(&[]);
    open(&server);
    let first = tile(SIZE, LEFT, 4);
    let send = |path: &str, body: &[u8]| server.post(path, body).lines();
    assert_eq!(states(&send("/v1/images/a/tiles", &first)), ["filtered", "end"]);
    let before = server.get("/v1/images/a/result.exr?partial=true").body;
    assert_eq!(states(&send("/v1/images/a/tiles", &first)), ["repeated", "end"]);
    // The halo is not what makes a tile another one.
    assert_eq!(states(&send("/v1/images/a/tiles", &tile(SIZE, LEFT, 0))), ["repeated", "end"]);
    assert_eq!(server.get("/v1/images/a/result.exr?partial=true").body, before);
    let other = encode(&samples(SIZE, LEFT, 4, 2));
    let lines = send("/v1/images/a/tiles", &other);
    assert_eq!(states(&lines), ["error", "end"]);
    assert_eq!((&lines[0]["problem"]["code"], &lines[0]["problem"]["status"]), (&json!("tile_conflict"), &json!(409)));
    assert_eq!((&lines[0]["tile"], &lines[1]["errors"]), (&json!([0, 0, 16, 16]), &json!(1)));
    let overlap = tile(SIZE, Rect::new(8, 0, 16, 16), 0);
    // One that is refused among others that are not.
    let lines = send("/v1/images/a/tiles", &[&overlap[..], &tile(SIZE, RIGHT, 4)].concat());
    let mut all = states(&lines);
    all.sort_unstable();
    assert!(all.contains(&"end") && all.contains(&"error"), "{lines:?}");
    assert_eq!(states(&send("/v1/images/a/tiles?replace=true", &other)), ["filtered", "end"]);
    assert_ne!(server.get("/v1/images/a/result.exr?partial=true").body, before);
    server.post("/v1/images/a/tiles?replac=true", &other).problem(400, "unknown_parameter");
}
