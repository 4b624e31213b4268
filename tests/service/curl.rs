//! curl is a complete client.

use super::{Server, neighbors::wait_complete, tile};
use crate::cli::{json, rpfd, stderr};
use rpfd::{filter::Rect, wire::ResultDecoder};
use std::{path::Path, process::Command};

/// Runs curl and gives the HTTP status and the body; `None` where there is no curl.
fn curl(arguments: &[&str]) -> Option<(u16, Vec<u8>)> {
    let output = Command::new("curl").args(["-sS", "-w", "%{stderr}%{http_code}"]).args(arguments).output();
    let output = match output {
        Ok(output) => output,
        Err(error) if std::env::var_os("RPFD_CI").is_none() => {
            eprintln!("skipped: curl cannot be run: {error}");
            return None;
        }
        Err(error) => panic!("curl cannot be run: {error}"),
    };
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "curl {arguments:?}: {message}");
    Some((message.trim().parse().unwrap(), output.stdout))
}

#[test]
fn curl_does_it_all() {
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let url = |path: &str| format!("http://{}{path}", server.address);
    let (left, right) = (Rect::new(0, 0, 24, 20), Rect::new(24, 0, 8, 20));
    let one = tile([32, 20], left, 17);
    let both = [&one[..], &tile([32, 20], right, 17)].concat();
    let write = |name: &str, bytes: &[u8]| std::fs::write(Path::new(&at(name)), bytes).unwrap();
    write("one.tiles", &one);
    write("both.tiles", &both);
    write("both.tiles.zst", &zstd::encode_all(&both[..], 3).unwrap());
    let (file, data) = (at("one.tiles"), format!("@{}", at("one.tiles")));

    // Streamed, at once, and asked to wait for the service's word.
    let Some((status, streamed)) = curl(&["-T", &file, &url("/v1/filter")]) else { return };
    assert_eq!(status, 200);
    let messages = {
        let (mut decoder, mut input, mut count) = (ResultDecoder::new(), &streamed[..], 0);
        while decoder.next(&mut input).unwrap().is_some() {
            count += 1;
        }
        count
    };
    assert_eq!(messages, 2);
    let expect = ["-H", "Expect: 100-continue", "-T", &file];
    assert_eq!(curl(&[&expect[..], &[&url("/v1/filter")]].concat()).unwrap().0, 200);
    assert_eq!(curl(&["--data-binary", &data, &url("/v1/filter?preset=unfiltered&seed=2")]).unwrap().0, 200);
    // Chunked, from a pipe.
    let piped = ["-H", "Transfer-Encoding: chunked", "--data-binary", &data, &url("/v1/filter")];
    assert_eq!(curl(&piped).unwrap().0, 200);

    let picture = |kind: &str| curl(&["-H", kind, "--data-binary", &data, &url("/v1/filter")]).unwrap();
    let (status, exr) = picture("Accept: image/x-exr");
    assert_eq!((status, &exr[..4]), (200, &[0x76, 0x2f, 0x31, 0x01][..]));
    let (status, png) = picture("Accept: image/png");
    assert_eq!((status, &png[1..4]), (200, &b"PNG"[..]));
    let (status, problem) = curl(&["--data-binary", "nonsense", &url("/v1/filter")]).unwrap();
    assert_eq!(status, 400);
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&problem).unwrap()["code"], "not_a_tile");

    let open = r#"{"width": 32, "height": 20, "id": "shot", "preset": "lean"}"#;
    assert_eq!(curl(&["-d", open, &url("/v1/images")]).unwrap().0, 201);
    assert_eq!(curl(&["-d", open, &url("/v1/images")]).unwrap().0, 200);
    assert_eq!(curl(&[&url("/v1/images/shot/result.exr")]).unwrap().0, 409);
    let zst = format!("@{}", at("both.tiles.zst"));
    let sent = ["-H", "Content-Encoding: zstd", "--data-binary", &zst, &url("/v1/images/shot/tiles")];
    let (status, lines) = curl(&sent).unwrap();
    assert_eq!(status, 200);
    let lines = String::from_utf8(lines).unwrap();
    assert_eq!(lines.matches(r#""state":"filtered""#).count(), 2, "{lines}");
    if Command::new("gzip").args(["-k", &at("both.tiles")]).status().is_ok_and(|s| s.success()) {
        let gz = format!("@{}", at("both.tiles.gz"));
        let sent = ["-H", "Content-Encoding: gzip", "--data-binary", &gz, &url("/v1/images/shot/tiles")];
        let lines = String::from_utf8(curl(&sent).unwrap().1).unwrap();
        assert_eq!(lines.matches(r#""state":"repeated""#).count(), 2, "{lines}");
    }
    let (status, lines) = curl(&["-T", &at("one.tiles"), &url("/v1/images/shot/tiles")]).unwrap();
    assert!(status == 200 && String::from_utf8(lines).unwrap().contains("repeated"));
    let (status, image) = curl(&[&url("/v1/images/shot")]).unwrap();
    let image: serde_json::Value = serde_json::from_slice(&image).unwrap();
    assert_eq!((status, &image["complete"]), (200, &serde_json::json!(true)));
    assert_eq!(curl(&[&url("/v1/images")]).unwrap().0, 200);
    let (out, preview) = (at("out.exr"), at("out.png"));
    assert_eq!(curl(&["-o", &out, &url("/v1/images/shot/result.exr")]).unwrap().0, 200);
    assert_eq!(curl(&["-o", &preview, &url("/v1/images/shot/preview.png")]).unwrap().0, 200);
    let read = rpfd::stitch::exr::read(Path::new(&out), 1 << 20);
    assert_eq!(read.map(|image| (image.width, image.height)).unwrap(), (32, 20));
    assert_eq!(curl(&["-X", "DELETE", &url("/v1/images/shot")]).unwrap().0, 204);
    assert_eq!(curl(&[&url("/v1/images/shot")]).unwrap().0, 404);
    assert_eq!(curl(&[&url("/livez")]).unwrap().0, 200);
    assert_eq!(curl(&[&url("/readyz")]).unwrap().0, 200);
}

/// As in the README: what a file holds is what opens an image of its bare cores.
#[test]
fn curl_sends_bare_cores() {
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let url = |path: &str| format!("http://{}{path}", server.address);
    let cores = at("cores.tiles");
    let made = rpfd(["synth", "--size", "48x32", "--spp", "2", "--tile", "16", "-o", &cores]);
    assert!(made.status.success(), "{}", stderr(&made));
    let found = json(["inspect", &cores]);
    let open = serde_json::json!({
        "id": "shot", "width": found["image"][0], "height": found["image"][1], "halo": "neighbors",
        "samples": found["samples"]["per_pixel"], "channels": found["channels"],
    });
    std::fs::write(at("open.json"), open.to_string()).unwrap();
    let Some((status, opened)) = curl(&["--json", &format!("@{}", at("open.json")), &url("/v1/images")]) else {
        return;
    };
    assert_eq!(status, 201, "{}", String::from_utf8_lossy(&opened));
    let data = format!("@{cores}");
    let (status, lines) = curl(&["--data-binary", &data, &url("/v1/images/shot/tiles")]).unwrap();
    let lines = String::from_utf8(lines).unwrap();
    assert_eq!((status, lines.matches(r#""state":"stored""#).count()), (200, 6), "{lines}");
    wait_complete(&server, "shot");
    let (image, offline) = (at("image.exr"), at("offline.exr"));
    assert_eq!(curl(&["-o", &image, &url("/v1/images/shot/result.exr")]).unwrap().0, 200);
    let filtered = rpfd(["filter", &cores, "-o", &offline]);
    assert!(filtered.status.success(), "{}", stderr(&filtered));
    assert!(std::fs::read(&image).unwrap() == std::fs::read(&offline).unwrap());
}
