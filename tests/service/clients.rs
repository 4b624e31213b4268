//! Clients that share no code with ours: the Python client of `proto`, and the tools beside the data that `RPFD_DATA`
//! names.

use super::{Server, encode, samples, tile};
use crate::{
    cli::{Folder, bytes, data, json, read_exr, rpfd, stderr},
    wire::interop::{CLIENT, python, run_python},
};
use rpfd::{
    filter::{Method, Rect},
    report::errors,
    stitch::exr,
};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The values of a .npy file of f32, which are behind its header.
fn npy(path: &str, values: usize) -> Vec<f32> {
    let file = bytes(path);
    let data = &file[file.len() - 4 * values..];
    data.as_chunks::<4>().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
}

/// Two halves of an image with the halo that `lean` reads, and that image filtered by `rpfd filter`.
fn halves(folder: &Folder) -> (String, String) {
    let (input, out) = (folder.path("in.tiles"), folder.path("ours.exr"));
    let reach = Method::default().reach(false);
    let cores = [Rect::new(0, 0, 20, 24), Rect::new(20, 0, 12, 24)];
    std::fs::write(&input, cores.map(|core| tile([32, 24], core, reach)).concat()).unwrap();
    let output = rpfd(["filter", &input, "-o", &out, "--seed", "3"]);
    assert!(output.status.success(), "{}", stderr(&output));
    (input, out)
}

#[test]
fn the_python_client_posts_tiles() {
    let (server, folder) = (Server::start(&[]), Folder::new());
    let (input, ours) = halves(&folder);
    let (url, out) = (format!("http://{}/v1/filter?seed=3", server.address), folder.path("out.npy"));
    let args: [&Path; 4] = ["post".as_ref(), url.as_ref(), input.as_ref(), out.as_ref()];
    let Some(output) = python("numpy, msgpack", CLIENT, &args) else { return };
    assert!(output.status.success());
    assert!(stderr(&output).contains("768 of 768 pixels"));
    let image = read_exr(ours);
    assert!(npy(&out, 3 * 32 * 24) == image.pixels.as_flattened(), "the images differ");
    // Compressed, and refused.
    let zst = folder.path("in.tiles.zst");
    std::fs::write(&zst, zstd::encode_all(&bytes(&input)[..], 3).unwrap()).unwrap();
    let args: [&Path; 4] = ["post".as_ref(), url.as_ref(), zst.as_ref(), out.as_ref()];
    assert!(python("numpy, msgpack", CLIENT, &args).unwrap().status.success());
    let wrong = url.replace("seed", "sead");
    let args: [&Path; 4] = ["post".as_ref(), wrong.as_ref(), input.as_ref(), out.as_ref()];
    let output = python("numpy, msgpack", CLIENT, &args).unwrap();
    assert!(!output.status.success() && stderr(&output).contains("unknown_parameter"));
}

#[test]
fn the_python_client_has_an_image_stitched() {
    let (server, folder) = (Server::start(&[]), Folder::new());
    let (input, ours) = halves(&folder);
    let (url, out) = (format!("http://{}/v1/images?seed=3", server.address), folder.path("out.exr"));
    let args: [&Path; 4] = ["images".as_ref(), url.as_ref(), input.as_ref(), out.as_ref()];
    let Some(output) = python("numpy, msgpack", CLIENT, &args) else { return };
    assert!(output.status.success());
    assert!(bytes(&out) == bytes(ours), "the two EXRs differ");
    assert_eq!(server.get("/v1/images").json()["images"].as_array().unwrap().len(), 0);
    // The same from bare cores, of which one brings some halo.
    let cores = [(Rect::new(0, 0, 20, 24), 3), (Rect::new(20, 0, 12, 24), 0)];
    std::fs::write(&input, cores.map(|(core, halo)| tile([32, 24], core, halo)).concat()).unwrap();
    let (neighbors, bare) = (format!("{url}&halo=neighbors"), folder.path("bare.exr"));
    let args: [&Path; 4] = ["images".as_ref(), neighbors.as_ref(), input.as_ref(), bare.as_ref()];
    assert!(python("numpy, msgpack", CLIENT, &args).unwrap().status.success());
    assert!(bytes(&bare) == bytes(&out), "bare cores give another EXR");
    // A tile that is refused: no EXR.
    let missing = folder.path("none.exr");
    let overlap = [tile([32, 24], Rect::new(0, 0, 32, 24), 0), encode(&samples([32, 24], Rect::new(1, 1, 4, 4), 0, 1))];
    std::fs::write(&input, overlap.concat()).unwrap();
    let args: [&Path; 4] = ["images".as_ref(), url.as_ref(), input.as_ref(), missing.as_ref()];
    let output = python("numpy, msgpack", CLIENT, &args).unwrap();
    assert!(!output.status.success() && !Path::new(&missing).exists());
}

/// The independent client beside the data, if it is there and can run; `modules` is what it needs.
fn tiles_py(modules: &str) -> Option<PathBuf> {
    let tool = std::env::var_os("RPFD_DATA").map(|folder| PathBuf::from(folder).join("../tools/tiles.py"));
    let Some(tool) = tool.filter(|tool| tool.exists()) else {
        eprintln!("SKIPPED: beside the folder that RPFD_DATA names there is no tools/tiles.py");
        return None;
    };
    run_python(modules, Path::new("-V"), &[]).map(|_| tool)
}

/// Runs it, which must work, and gives what it says.
fn says(tool: &Path, args: &[&str]) -> String {
    let args: Vec<&Path> = args.iter().map(Path::new).collect();
    let output = run_python("numpy", tool, &args).unwrap();
    assert!(output.status.success(), "{args:?}");
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn tiles_cut_by_another_client_are_the_image_uncut() {
    let Some(tool) = tiles_py("numpy, msgpack, zstandard") else { return };
    let folder = Folder::new();
    let original = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let filter = |input: &str, name: &str, preset: &str| {
        let out = folder.path(name);
        let output = rpfd(["filter", input, "-o", &out, "--preset", preset]);
        assert!(output.status.success(), "{}", stderr(&output));
        bytes(out)
    };
    for preset in ["lean", "paper-fast"] {
        let reach = Method::preset(preset).unwrap().reach(false).to_string();
        let cut = folder.path(&format!("{preset}.tiles"));
        says(&tool, &["retile", &original, &cut, "--tile", "16", "--halo", &reach]);
        let summary = rpfd::wire::scan::scan(Path::new(&cut)).unwrap();
        assert!(summary.whole() && summary.halos && summary.tiles.len() > 1);
        assert!(filter(&cut, "cut.exr", preset) == filter(&original, "whole.exr", preset), "{preset}: the EXRs differ");
    }
}

#[test]
fn another_client_reads_what_we_write_and_agrees() {
    let Some(tool) = tiles_py("numpy, msgpack, zstandard") else { return };
    let folder = Folder::new();
    let input = folder.synth("ours.tiles.zst", &["--size", "40x30", "--spp", "4", "--tile", "16", "--halo", "5"]);
    let headers = says(&tool, &["info", &input]).replace("NaN", "null");
    let headers: Vec<Value> = headers.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(headers.len(), 6);
    assert_eq!((&headers[1]["tile"], &headers[1]["halo"]), (&[16, 0, 16, 16].into(), &[5, 0, 5, 5].into()));
    let (mean, unfiltered) = (folder.path("mean.npy"), folder.path("unfiltered.exr"));
    says(&tool, &["mean", &input, &mean]);
    json(["filter", &input, "-o", &unfiltered, "--preset", "unfiltered"]);
    let (theirs, ours) = (npy(&mean, 3 * 40 * 30), read_exr(unfiltered));
    // Both add in f64 and round once; their order is their own.
    let same = |(a, b): (&f32, &f32)| (a - b).abs() <= f32::EPSILON * b.abs();
    assert!(theirs.iter().zip(ours.pixels.as_flattened()).all(same), "the means differ");
}

#[test]
fn another_client_reads_our_answers() {
    let Some(tool) = tiles_py("numpy, msgpack, zstandard") else { return };
    let (server, folder) = (Server::start(&[]), Folder::new());
    let original = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let (input, reach) = (folder.path("haloed.tiles.zst"), Method::default().reach(false).to_string());
    says(&tool, &["retile", &original, &input, "--tile", "16", "--halo", &reach]);
    let answer = server.call("POST", "/v1/filter?preset=lean", &["Content-Encoding: zstd"], &bytes(&input));
    assert!(answer.messages().len() > 2);
    let (results, image, exr) = (folder.path("results.msgpack"), folder.path("image.npy"), folder.path("ours.exr"));
    std::fs::write(&results, &answer.body).unwrap();
    assert!(says(&tool, &["image", &results, &image]).contains("missing pixels: 0"));
    json(["filter", &original, "-o", &exr, "--preset", "lean"]);
    let ours = read_exr(exr);
    assert!(npy(&image, 3 * ours.pixels.len()) == ours.pixels.as_flattened(), "the images differ");
}

#[test]
fn another_client_measures_the_same_error() {
    let Some(tool) = tiles_py("numpy, msgpack, zstandard, OpenEXR") else { return };
    let folder = Folder::new();
    let (input, reference) = (data("small.tiles.zst"), data("small.reference.exr"));
    let reference = reference.to_str().unwrap();
    for samples in ["float", "half"] {
        let out = folder.path(&format!("{samples}.exr"));
        json(["filter", input.to_str().unwrap(), "-o", &out, "--exr-samples", samples]);
        let theirs: Value = serde_json::from_str(&says(&tool, &["error", &out, reference])).unwrap();
        let of = |path: &str| exr::read(Path::new(path), 1 << 20).unwrap().pixels;
        let ours = errors(&of(&out), &of(reference)).unwrap();
        for (name, ours) in [
            ("mse", ours.mse),
            ("relmse", ours.relmse),
            ("relmse_trimmed", ours.relmse_trimmed),
            ("psnr", ours.psnr),
            ("smape", ours.smape),
            ("energy", ours.energy),
        ] {
            let theirs = theirs[name].as_f64().unwrap();
            // OpenEXR gives both f32 values exactly; numpy's powers and sums are its own.
            assert!((theirs - ours).abs() <= 1e-6 * ours.abs(), "{samples}: {name} is {theirs} there and {ours} here");
        }
        assert_eq!(theirs["nonfinite"].as_f64(), Some(ours.nonfinite as f64));
    }
}
