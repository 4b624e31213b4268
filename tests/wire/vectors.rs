//! The example messages of `proto/vectors`, which an independent writer made.

use super::*;
use rpfd::wire::{Message, ResultDecoder};
use serde_json::Value;

fn folder() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/vectors")
}

fn vectors(kind: &str) -> Vec<(Value, Vec<u8>)> {
    let manifest: Value = serde_json::from_slice(&std::fs::read(folder().join("vectors.json")).unwrap()).unwrap();
    let entries = manifest["vectors"].as_array().unwrap().iter().filter(|entry| entry["kind"] == kind);
    entries.map(|e| (e.clone(), std::fs::read(folder().join(e["file"].as_str().unwrap())).unwrap())).collect()
}

fn number(value: &Value) -> f32 {
    match value.as_str() {
        Some("inf") => f32::INFINITY,
        Some("-inf") => f32::NEG_INFINITY,
        Some(_) => f32::NAN,
        None => value.as_f64().unwrap() as f32,
    }
}

#[test]
fn tile_streams_are_read_or_refused_as_the_manifest_says() {
    let vectors = vectors("tile");
    assert!(vectors.len() > 80);
    for (entry, bytes) in vectors {
        let name = &entry["file"];
        for piece in [usize::MAX, 1, 7] {
            let result = read_raw(&bytes, || piece);
            if let Some(code) = entry["code"].as_str() {
                let error = result.expect_err(&format!("{name} must be refused"));
                assert_eq!(error.code(), code, "{name}: {error}");
                continue;
            }
            let tiles = result.unwrap_or_else(|error| panic!("{name}: {error}"));
            let expected = entry["tiles"].as_array().unwrap();
            assert_eq!(tiles.len(), expected.len(), "{name}");
            for (tile, expected) in tiles.iter().zip(expected) {
                let header = tile.header.as_ref().unwrap();
                let core = header.geometry().core();
                assert_eq!(expected["tile"], serde_json::json!([core.x, core.y, core.width, core.height]));
                assert_eq!(expected["samples"], header.total(), "{name}");
                let counts: Vec<_> = expected["counts"].as_array().into_iter().flatten().collect();
                assert!(counts.iter().zip(&tile.counts).all(|(a, b)| a.as_u64() == Some(u64::from(*b))), "{name}");
                for (plane, expected) in tile.planes.iter().zip(expected["planes"].as_array().unwrap()) {
                    let expected: Vec<f32> = expected.as_array().unwrap().iter().map(number).collect();
                    let same = |a: &f32, b: &f32| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
                    let all = plane.len() == expected.len() && plane.iter().zip(&expected).all(|(a, b)| same(a, b));
                    assert!(all, "{name}: {plane:?}, {expected:?}");
                }
            }
        }
    }
}

#[test]
fn result_streams_are_read_or_refused_as_the_manifest_says() {
    for (entry, bytes) in vectors("result") {
        let (mut decoder, mut input, mut messages) = (ResultDecoder::new(), &bytes[..], Vec::new());
        let result = loop {
            match decoder.next(&mut input) {
                Ok(Some(message)) => messages.push(message),
                Ok(None) => break decoder.finish(),
                Err(error) => break Err(error),
            }
        };
        let code = result.as_ref().err().map(WireError::code);
        assert_eq!(code, entry["code"].as_str(), "{}: {result:?}", entry["file"]);
        if code.is_none() && entry["file"] != "result_error_without_tile.msgpack" {
            let [
                Message::Result(result),
                Message::Error { tile: Some(tile), problem },
                Message::End { tiles: 1, errors: 1 },
            ] = &messages[..]
            else {
                panic!("{messages:?}")
            };
            assert_eq!(result.rgb, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]);
            assert_eq!((result.core, *tile), (Rect::new(0, 0, 2, 1), Rect::new(2, 2, 2, 1)));
            assert_eq!((result.report.preset.as_str(), result.report.seconds, result.report.samples), ("lean", 0.5, 4));
            assert_eq!((problem.code.as_str(), problem.status), ("too_large", 413));
            assert_eq!(problem.more["limit"], 5);
        }
    }
}
