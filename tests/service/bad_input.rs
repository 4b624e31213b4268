//! What is not right is refused with a code, and leaves nothing behind.

use super::{Server, encode, samples, tile, whole};
use rpfd::{
    filter::Rect,
    wire::{Format, Header, Message, SampleCounts, encode_header},
};
use serde_json::json;

/// A tile of a single pixel with one sample, its header changed; three constant planes.
fn changed(change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    let mut header = json!({
        "type": "tile", "version": 1, "image": [4, 4], "tile": [0, 0, 1, 1], "halo": [0, 0, 0, 0], "samples": 1,
        "format": "f32", "channels": [{"name": "color", "role": "color", "components": 3}],
    });
    change(&mut header);
    let mut bytes = rmp_serde::to_vec_named(&header).unwrap();
    bytes.extend([1, 2, 3]);
    bytes
}

#[test]
fn streams_that_cannot_be_read_have_a_code_and_a_status() {
    let server = Server::start(&[]);
    let good = whole(16);
    let cases: Vec<(&str, u16, Vec<u8>)> = vec![
        ("empty", 400, Vec::new()),
        ("truncated", 400, good[..10].to_vec()),
        ("truncated", 400, good[..good.len() - 1].to_vec()),
        ("not_a_tile", 400, b"{\"type\": \"tile\"}".to_vec()),
        ("not_a_tile", 400, zstd::encode_all(&good[..], 1).unwrap()),
        ("unknown_key", 400, changed(|h| h["hallo"] = json!(1))),
        ("missing_key", 400, changed(|h| drop(h.as_object_mut().unwrap().remove("image")))),
        ("version", 400, changed(|h| h["version"] = json!(2))),
        ("wrong_type", 400, changed(|h| h["image"] = json!("large"))),
        ("wrong_value", 400, changed(|h| h["format"] = json!("f64"))),
        ("bad_geometry", 400, changed(|h| h["tile"] = json!([3, 0, 2, 1]))),
        ("bad_geometry", 400, changed(|h| h["halo"] = json!([1, 0, 0, 0]))),
        ("bad_channels", 400, changed(|h| h["channels"] = json!([]))),
        ("too_large", 413, changed(|h| h["samples"] = json!(70_000))),
        ("header_too_large", 413, changed(|h| h["x-note"] = json!("x".repeat(70_000)))),
        (
            "over_memory",
            413,
            changed(|h| {
                (h["image"], h["tile"], h["samples"]) = (json!([9000, 9000]), json!([0, 0, 9000, 9000]), json!(4));
            }),
        ),
        ("plane_size", 400, {
            let mut bytes = changed(|_| {});
            bytes.truncate(bytes.len() - 1);
            bytes.extend([0xc4, 3, 0, 0, 0]);
            bytes
        }),
        ("wrong_type", 400, {
            let mut bytes = changed(|_| {});
            bytes.pop();
            bytes.push(0xc0);
            bytes
        }),
    ];
    server.post("/v1/images", br#"{"width": 16, "height": 16, "id": "bad"}"#);
    for (code, status, body) in &cases {
        let problem = server.post("/v1/filter", body).problem(*status, code);
        assert_eq!(problem["type"], format!("urn:rpfd:problem:{code}"));
        for accept in ["Accept: image/x-exr", "Accept: image/png"] {
            server.call("POST", "/v1/filter", &[accept], body).problem(*status, code);
        }
        let answer = server.post("/v1/images/bad/tiles", body);
        assert!([400, 413, 422].contains(&answer.status), "{answer:?}");
    }
    // Counts that do not add up to the total.
    let tile = samples([4, 4], Rect::new(0, 0, 2, 2), 0, 1);
    let counts = SampleCounts::Varying { total: 5 };
    let header = Header::new(*tile.geometry(), tile.channels().clone(), counts, Format::F32).unwrap();
    let mut bytes = encode_header(&header);
    bytes.extend([0xc4, 8, 1, 0, 1, 0, 1, 0, 1, 0]);
    server.post("/v1/filter", &bytes).problem(400, "bad_counts");
    let status = server.get("/v1/images/bad").json();
    assert_eq!((&status["tiles_done"], &status["missing"]), (&json!(0), &json!([[0, 0, 16, 16]])));
    let found = std::fs::read_dir(server.data_dir()).unwrap().map(|found| found.unwrap().file_name());
    assert!(found.into_iter().all(|name| name == "images" || name == "rpfd.lock"));
    assert_eq!(server.post("/v1/filter", &good).messages().len(), 2);
}

#[test]
fn after_the_first_tile_failures_are_messages() {
    let server = Server::start(&[]);
    let good = whole(16);
    let cut = &good[..good.len() - 5];
    for (tail, code, filtered) in [(cut, "truncated", 1), (&[0xc0], "trailing", 1)] {
        let messages = server.post("/v1/filter", &[&good[..], tail].concat()).messages();
        let Message::Error { problem, .. } = &messages[1] else { panic!("{messages:?}") };
        assert_eq!(problem.code, code);
        assert_eq!(messages.len(), 3);
        assert_eq!(messages[2], Message::End { tiles: filtered, errors: 1 });
    }
    // A picture has no place for messages.
    let accept = ["Accept: image/png"];
    server.call("POST", "/v1/filter", &accept, &[&good[..], cut].concat()).problem(400, "one_tile_only");
    server.call("POST", "/v1/filter", &accept, &[&good[..], b"x"].concat()).problem(400, "trailing");
    // A tile that is refused does not end the stream: the one after it is filtered.
    let huge =
        changed(|h| (h["image"], h["tile"], h["samples"]) = (json!([9000, 9000]), json!([0, 0, 9000, 9000]), json!(4)));
    let messages = server.post("/v1/filter", &[&good[..], &huge, &good].concat()).messages();
    let codes: Vec<_> = messages
        .iter()
        .filter_map(
            |m| if let Message::Error { problem, tile } = m { Some((problem.code.as_str(), *tile)) } else { None },
        )
        .collect();
    assert_eq!(codes, [("over_memory", Some(Rect::new(0, 0, 9000, 9000)))]);
    assert_eq!(messages.last(), Some(&Message::End { tiles: 2, errors: 1 }));
}

#[test]
fn requests_that_are_not_understood_have_a_code_and_a_status() {
    let server = Server::start(&[]);
    let good = whole(16);
    for (query, code) in [
        ("preset=leen", "unknown_preset"),
        ("box=17", "unknown_parameter"),
        ("boxes=17,8", "bad_parameter"),
        ("seed=x", "bad_parameter"),
        ("seed=1&seed=2", "duplicate_parameter"),
    ] {
        server.post(&format!("/v1/filter?{query}"), &good).problem(400, code);
    }
    server.call("POST", "/v1/filter", &["Accept: text/html"], &good).problem(406, "not_acceptable");
    server.call("POST", "/v1/filter", &["Content-Encoding: br"], &good).problem(415, "unsupported_encoding");
    server.call("POST", "/v1/filter", &["Content-Encoding: zstd"], &good).problem(400, "compression");
    for (body, code) in [
        ("{", "bad_json"),
        ("[1]", "bad_json"),
        (r#"{"width": 4}"#, "bad_parameter"),
        (r#"{"width": 4, "height": "x"}"#, "bad_parameter"),
        (r#"{"width": 4, "height": 0}"#, "bad_geometry"),
        (r#"{"width": 4, "height": 4, "preset": "leen"}"#, "unknown_preset"),
        (r#"{"width": 4, "height": 4, "colour": true}"#, "unknown_parameter"),
        (r#"{"width": 4, "height": 4, "id": "../x"}"#, "bad_parameter"),
        (r#"{"width": 4, "height": 4, "width": 4}"#, "duplicate_parameter"),
    ] {
        server.post("/v1/images", body.as_bytes()).problem(400, code);
    }
    server.post("/v1/images", &[b' '; 70_000]).problem(413, "body_too_large");
    assert_eq!(server.get("/v1/images").json(), json!({"images": []}));
    for path in ["/livez", "/readyz", "/v1/images", "/v1/images/a", "/v1/images/a/preview.png"] {
        let opened = server.post("/v1/images", br#"{"width": 4, "height": 4, "id": "a"}"#);
        assert!(opened.status <= 201, "{opened:?}");
        let problem = server.get(&format!("{path}?partiall=true")).problem(400, "unknown_parameter");
        assert!(problem["detail"].as_str().unwrap().contains("known are"), "{problem}");
    }
    server.call("DELETE", "/v1/images/a?x", &[], &[]).problem(400, "unknown_parameter");
    assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
    let problem = server.post("/v1/filter?presett=lean", &good).problem(400, "unknown_parameter");
    assert!(problem["detail"].as_str().unwrap().contains("preset, seed and leave_out"), "{problem}");
    server.get("/").problem(404, "not_found");
    server.get("/v1/images/nobody").problem(404, "unknown_image");
    server.get("/v1/images/%ff").problem(404, "unknown_image");
    server.post("/v1/images/nobody/tiles", &good).problem(404, "unknown_image");
    server.get("/v1/images/nobody/result.exr").problem(404, "unknown_image");
    server.call("DELETE", "/v1/images/nobody", &[], &[]).problem(404, "unknown_image");
    let answer = server.get("/v1/filter");
    answer.problem(405, "method_not_allowed");
    assert!(answer.header("allow").unwrap().contains("POST"));
    server.call("PUT", "/v1/images/a", &[], &[]).problem(405, "method_not_allowed");
}

#[test]
fn values_that_are_not_finite_are_replaced_and_counted() {
    let server = Server::start(&[]);
    let mut tile = encode(&samples([16, 16], Rect::new(0, 0, 16, 16), 0, 1));
    // The colour planes come right behind the two of the film, and the last 4 bytes of all are a random number.
    let end = tile.len();
    tile[end - 4..].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let messages = server.post("/v1/filter", &tile).messages();
    let Message::Result(result) = &messages[0] else { panic!("{messages:?}") };
    assert_eq!(result.report.replaced.random, 1);
}

#[test]
fn tiles_of_another_image_are_refused() {
    let server = Server::start(&[]);
    server.post("/v1/images", br#"{"width": 16, "height": 16, "id": "a"}"#);
    let other = tile([32, 16], Rect::new(0, 0, 16, 16), 0);
    server.post("/v1/images/a/tiles", &other).problem(422, "image_mismatch");
    server.post("/v1/images/a/tiles", &tile([16, 16], Rect::new(0, 0, 8, 16), 0)).lines();
    // The same image, but only colours.
    let header = json!({
        "type": "tile", "version": 1, "image": [16, 16], "tile": [8, 0, 8, 16], "halo": [0, 0, 0, 0], "samples": 1,
        "format": "f32", "channels": [{"name": "color", "role": "color", "components": 3}],
    });
    let mut colors = rmp_serde::to_vec_named(&header).unwrap();
    colors.extend([1, 1, 1]);
    let problem = server.post("/v1/images/a/tiles", &colors).problem(422, "channel_mismatch");
    assert!(problem["detail"].as_str().unwrap().contains("albedo"), "{problem}");
}
