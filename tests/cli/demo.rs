//! `rpfd demo` and `rpfd post` with the real service.

use super::*;
use crate::service::Server;

#[test]
fn the_demo_denoises_and_is_what_filter_makes_offline() {
    let folder = Folder::new();
    let report = json(["demo", "--out", &folder.path("demo")]);
    let error = |which: &str| report[which]["relmse"].as_f64().unwrap();
    assert!(error("after") < 0.25 * error("before"), "{report}");
    assert!(report["after"]["psnr"].as_f64() > report["before"]["psnr"].as_f64());
    let offline = folder.path("offline.exr");
    let input = data("depth_of_field.8spp.tiles.zst").into_os_string().into_string().unwrap();
    json(["filter", &input, "-o", &offline]);
    assert!(bytes(offline) == bytes(folder.path("demo/after.exr")));
    assert!(bytes(folder.path("demo/comparison.png")).starts_with(b"\x89PNG"));
    let mut names: Vec<_> = std::fs::read_dir(folder.path("demo")).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["after.exr", "before.exr", "comparison.png"]);
}

#[test]
fn post_gives_the_exr_that_filter_gives() {
    let (folder, server) = (Folder::new(), Server::start(&[]));
    let url = format!("http://{}", server.address);
    let plain = folder.synth("plain.tiles", &["--size", "90x70", "--spp", "2", "--tile", "50"]);
    let varying = folder.synth("varying.tiles", &["--size", "90x70", "--spp", "3", "--tile", "33", "--varying"]);
    let half = folder.synth("half.tiles.zst", &["--size", "60x40", "--spp", "3", "--format", "f16", "--halo", "5"]);
    let (posted, filtered) = (folder.path("posted.exr"), folder.path("filtered.exr"));
    for (input, options) in [
        (&plain, &["--seed", "5", "--set", "bins=9"][..]),
        (&varying, &["--half", "--compression", "piz"]),
        (&half, &["--preset", "paper-fast", "--set", "boxes=21,7", "--set", "fractions=0.1,0.2", "--exr-tiles", "32"]),
    ] {
        json(["post", input, "--to", &url, "-o", &posted, "--tile", "32"].iter().chain(options));
        json(["filter", input, "-o", &filtered].iter().chain(options));
        assert!(bytes(&posted) == bytes(&filtered), "{input}");
    }
    // Nothing stays at the service that nobody could name.
    let images: Value = serde_json::from_slice(&server.get("/v1/images").body).unwrap();
    assert!(!images.to_string().contains("width"), "{images}");
}

#[test]
fn a_named_image_is_kept_and_its_tiles_are_not_filtered_twice() {
    let (folder, server) = (Folder::new(), Server::start(&[]));
    let url = format!("http://{}", server.address);
    let input = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let (first, second) = (folder.path("first.exr"), folder.path("second.exr"));
    let post =
        |out: &str| ["post", &input, "--to", &url, "-o", out, "--tile", "16", "--id", "frame"].map(str::to_owned);
    assert_eq!(json(post(&first))["repeated"], 0);
    assert_eq!(json(post(&second))["repeated"], 9);
    assert!(bytes(first) == bytes(&second));
    let other = post(&second).into_iter().chain(["--seed".to_owned(), "1".to_owned()]);
    let (code, message) = fails(4, other);
    assert!(code.contains("conflict") || code.contains("image"), "{code}: {message}");
}

#[test]
fn a_tile_that_the_service_has_no_memory_for_exits_with_4() {
    let (folder, server) = (Folder::new(), Server::start(&["--memory", "4MiB", "--threads", "8"]));
    let url = format!("http://{}", server.address);
    let input = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let (code, message) = fails(4, ["post", &input, "--to", &url, "-o", &folder.path("out.exr")]);
    assert!(code == "over_memory" && message.contains("[0, 0, 48, 48]"), "{code}: {message}");
    assert_eq!(folder.names(), [""; 0]);
}
