//! The document for programs says what the service does.

use super::{Server, samples, tile};
use crate::wire::interop::run_python;
use rpfd::filter::Rect;
use serde_json::Value;
use std::path::Path;

fn document() -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/openapi.json");
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn it_is_served_as_it_is_in_proto() {
    let server = Server::start(&[]);
    let answer = server.get("/openapi.json");
    assert_eq!((answer.status, answer.header("content-type")), (200, Some("application/json")));
    assert!(answer.json() == document(), "RPFD_REGENERATE=1 cargo test --lib openapi writes it anew");
}

#[test]
fn it_has_the_calls_that_there_are() {
    let server = Server::start(&[]);
    let document = document();
    let paths = document["paths"].as_object().unwrap();
    for (path, item) in paths {
        let concrete = path.replace("{id}", "none");
        for method in ["get", "put", "post", "delete", "patch", "options", "trace"] {
            let answer = server.call(&method.to_uppercase(), &concrete, &[], &[]);
            let told = item.get(method).is_some();
            assert_eq!(told, answer.status != 405, "{method} {path}: {}", answer.status);
            if answer.status == 404 {
                answer.problem(404, "unknown_image");
            }
        }
    }
    // And proto/http.md has no other.
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/http.md")).unwrap();
    let calls = text.lines().take_while(|line| !line.starts_with("## ")).filter(|line| line.starts_with("| `"));
    let listed: Vec<_> = calls
        .flat_map(|line| line.split('|').nth(1).unwrap().split('`'))
        .filter_map(|call| call.split_once(' '))
        .filter(|(method, _)| method.bytes().all(|b| b.is_ascii_uppercase()) && !method.is_empty())
        .collect();
    for (method, path) in &listed {
        assert!(paths.get(*path).is_some_and(|item| item.get(method.to_lowercase()).is_some()), "{method} {path}");
    }
    assert!(paths.keys().all(|path| listed.iter().any(|(_, listed)| listed == path)), "{listed:?}");
}

/// Checks a value against a schema; keys that the schema does not name are errors too.
fn check(value: &Value, schema: &Value, document: &Value, at: &str) {
    if let Some(reference) = schema["$ref"].as_str() {
        let pointer = reference.strip_prefix('#').unwrap();
        return check(value, document.pointer(pointer).expect("a schema"), document, at);
    }
    if let Some(choices) = schema["oneOf"].as_array() {
        let null = choices.iter().any(|choice| choice["type"] == "null");
        if null && value.is_null() {
            return;
        }
        return check(value, choices.iter().find(|choice| choice["type"] != "null").unwrap(), document, at);
    }
    let kind = match value {
        Value::Null => "null",
        Value::Bool(_) => "boolean",
        Value::Number(number) if number.is_f64() => "number",
        Value::Number(_) => "integer",
        Value::String(_) => "string",
        Value::Array(_) => "array",
        Value::Object(_) => "object",
    };
    let fits = |wanted: &Value| wanted == kind || (wanted == "number" && kind == "integer");
    let fine = schema["type"].as_array().map_or_else(|| fits(&schema["type"]), |all| all.iter().any(fits));
    assert!(fine, "{at} is {kind}, not {}", schema["type"]);
    match value {
        Value::Array(items) => items
            .iter()
            .enumerate()
            .for_each(|(i, item)| check(item, &schema["items"], document, &format!("{at}[{i}]"))),
        Value::Object(members) => {
            for required in schema["required"].as_array().into_iter().flatten() {
                assert!(members.contains_key(required.as_str().unwrap()), "{at} lacks {required}");
            }
            for (name, member) in members {
                let known = schema["properties"]
                    .get(name)
                    .or_else(|| schema.get("additionalProperties").filter(|more| more.is_object()));
                check(
                    member,
                    known.unwrap_or_else(|| panic!("{at} has {name:?}, of which nothing is said")),
                    document,
                    &format!("{at}.{name}"),
                );
            }
        }
        _ => {}
    }
}

#[test]
fn its_schemas_are_those_of_real_answers() {
    let server = Server::start(&[]);
    let document = document();
    let fits =
        |value: &Value, schema: &str| check(value, &document["components"]["schemas"][schema], &document, schema);
    let opened = server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "x", "preset": "lean", "seed": 3}"#);
    fits(&opened.json(), "Image");
    let one = tile([32, 16], Rect::new(0, 0, 16, 16), 0);
    let other = super::encode(&samples([32, 16], Rect::new(0, 0, 16, 16), 0, 9));
    for line in server.post("/v1/images/x/tiles", &[&one[..], &one].concat()).lines() {
        fits(&line, "TileLine");
    }
    let lines = server.post("/v1/images/x/tiles", &[&other[..], b"x"].concat()).lines();
    assert_eq!(lines.iter().filter(|line| line["state"] == "error").count(), 2, "{lines:?}");
    for line in &lines {
        let mut line = line.clone();
        // Members by code are not in the schema.
        if let Some(problem) = line.get_mut("problem") {
            problem.as_object_mut().unwrap().retain(|name, _| !["offset", "index", "other"].contains(&name.as_str()));
        }
        fits(&line, "TileLine");
    }
    fits(&server.get("/v1/images").json(), "Images");
    let status = server.get("/v1/images/x").json();
    fits(&status, "ImageStatus");
    // A method that does not look at features leaves them out.
    assert_eq!(
        server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "z", "preset": "gaussian"}"#).status,
        201
    );
    assert_eq!(server.post("/v1/images/z/tiles", &one).lines().len(), 2);
    let status = server.get("/v1/images/z").json();
    assert!(status["totals"]["left_out"].as_array().is_some_and(|all| !all.is_empty()), "{status}");
    fits(&status, "ImageStatus");
    // Bare cores: one has come, others are waited for, and then not any more.
    let opening = super::neighbors::opening("n", [64, 64], "lean", ("samples", 4));
    fits(&serde_json::from_slice(&opening).unwrap(), "OpenImage");
    fits(&server.post("/v1/images", &opening).json(), "Image");
    for line in server.post("/v1/images/n/tiles", &tile([64, 64], Rect::new(0, 0, 16, 16), 0)).lines() {
        fits(&line, "TileLine");
    }
    let status = server.get("/v1/images/n").json();
    assert!(status["waiting"].as_array().is_some_and(|all| !all.is_empty()), "{status}");
    fits(&status, "ImageStatus");
    fits(&server.get("/v1/images").json(), "Images");
    fits(&server.post("/v1/images/n/finish", b"").json(), "Image");
    fits(&server.get("/v1/images/y").json(), "Problem");
}

#[test]
fn it_is_openapi() {
    let script =
        "import json, sys\nfrom openapi_spec_validator import validate\nvalidate(json.load(open(sys.argv[1])))\n";
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/openapi.json");
    let Some(output) = run_python("openapi_spec_validator", "-c".as_ref(), &[script.as_ref(), path.as_ref()]) else {
        return;
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
