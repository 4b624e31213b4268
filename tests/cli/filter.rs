//! `rpfd filter`: the same EXR whatever the tiling and the memory, and what it reports.

use super::*;
use rpfd::report::errors;

#[test]
fn the_default_preset_denoises() {
    let folder = Folder::new();
    let (input, out, png) = (data("small.tiles.zst"), folder.path("out.exr"), folder.path("out.png"));
    let input = input.to_str().unwrap();
    let report = json(["filter", input, "-o", &out, "--png", &png]);
    assert_eq!((&report["preset"], &report["seed"]), (&"lean".into(), &0.into()));
    assert_eq!((&report["samples"], &report["missing_pixels"]), (&(48 * 48 * 4).into(), &0.into()));
    assert_eq!(report["short_of_halo"], 0);
    assert_eq!(report["parameters"]["boxes"], "17,7");
    assert_eq!(report["files"][0]["bytes"], bytes(&out).len());
    let left_out: Vec<_> =
        report["left_out"].as_array().unwrap().iter().map(|l| l["plane"].as_str().unwrap()).collect();
    assert_eq!(left_out, ["lens.0", "lens.1"]);
    assert_eq!(report["left_out_bytes"], 2 * 48 * 48 * 4 * 4);
    let work = |report: &Value, of: &[&str]| of.iter().map(|of| report["work"][of].as_u64().unwrap()).sum::<u64>();
    let all_of_it = work(&report, &["done", "planes", "columns", "distances"]);
    let share = work(&report, &["planes", "columns", "distances"]) as f64 / all_of_it as f64;
    assert!(share > 0.05 && report["work"]["saved"].as_f64().unwrap() == share, "{}", report["work"]);
    let all = folder.path("all.exr");
    let report = json(["filter", input, "-o", &all, "--leave-out", "off"]);
    assert_eq!((&report["leave_out"], &report["left_out"]), (&false.into(), &Value::Array(Vec::new())));
    assert_eq!((&report["left_out_bytes"], work(&report, &["done"])), (&0.into(), all_of_it));
    assert!(bytes(&all) == bytes(&out));
    let said = String::from_utf8(rpfd(["filter", input, "-o", &all]).stdout).unwrap();
    assert!(said.contains("constant: lens.0, lens.1") && said.contains("% of the work"), "{said}");
    assert!(bytes(&png).starts_with(b"\x89PNG"));

    let rough = folder.path("rough.exr");
    let report = json(["filter", input, "-o", &rough, "--tolerance", "0.1"]);
    assert_eq!(report["parameters"]["tolerance"], "0.1");
    let settled = report["settled"].as_u64().unwrap();
    assert!(settled > 0 && report["settled_error"].as_f64().unwrap() < 0.1 * settled as f64, "{report}");
    assert!(bytes(&rough) != bytes(&out));
    let said = String::from_utf8(rpfd(["filter", input, "-o", &rough, "--tolerance", "0.1"]).stdout).unwrap();
    assert!(said.contains(&format!("{settled} pixels")), "{said}");
    assert_eq!(fails(2, ["filter", input, "-o", &rough, "--tolerance", "2"]).0, "parameter");
    assert_eq!(fails(2, ["filter", input, "-o", &rough, "--preset", "gaussian", "--tolerance", "0.1"]).0, "parameter");

    let plain = folder.path("plain.exr");
    json(["filter", input, "-o", &plain, "--preset", "unfiltered"]);
    let reference = read_exr(data("small.reference.exr"));
    let error = |path: &str| errors(&read_exr(path).pixels, &reference.pixels).unwrap().relmse;
    assert!(error(&rough) < error(&out) + 0.1);
    assert!(error(&out) < 0.5 * error(&plain), "{} against {}", error(&out), error(&plain));
    assert_eq!(folder.names(), ["all.exr", "out.exr", "out.png", "plain.exr", "rough.exr"]);
}

/// Bare cores, tiles with halo, one huge tile, shuffled tiles, memory that is plenty or scarce, one thread or two.
fn same_bits(extra: &[&str], preset: &[&str]) {
    let folder = Folder::new();
    let common = ["--size", "150x81", "--spp", "2", "--scene", "all"];
    let synth = |name: &str, args: &[&str]| folder.synth(name, &[&common, extra, args].concat());
    let bare = synth("bare.tiles", &["--tile", "32"]);
    let haloed = synth("haloed.tiles.zst", &["--tile", "64", "--halo", "60"]);
    let huge = synth("huge.tiles", &["--tile", "1000"]);
    let shuffled = folder.path("shuffled.tiles");
    copy_tiles(&bare, &shuffled, 5, |_| 1);
    let out = folder.path("out.exr");
    let mut expected = None;
    let mut check = |input: &str, args: &[&str]| {
        let report = json([&["filter", input, "-o", &out], preset, args].concat());
        assert_eq!(report["short_of_halo"], 0);
        let exr = bytes(&out);
        assert_eq!(&exr, expected.get_or_insert_with(|| exr.clone()), "{input} {args:?}");
        report
    };
    let plenty = check(&bare, &["--threads", "2"]);
    assert_eq!(plenty["spool"]["in"], "memory");
    assert_eq!(plenty["tiling"]["cut"], 512);
    for (input, threads) in [(&haloed, "2"), (&huge, "1")] {
        let report = check(input, &["--threads", threads]);
        assert_eq!((&report["tiling"], &report["spool"]), (&"as they come".into(), &Value::Null));
    }
    check(&shuffled, &["--threads", "1"]);

    // One byte less than all of it takes, and the spool goes to disk; less still, and tiles get smaller.
    let memory = (plenty["memory"]["planned"].as_u64().unwrap() - 1).to_string();
    let report = check(&bare, &["--threads", "2", "--memory", &memory]);
    assert_eq!(report["spool"]["in"], "disk");
    let (code, message) =
        fails(2, [&["filter", &huge, "-o", &out, "--memory", "1MiB", "--threads", "2"], preset].concat());
    assert_eq!(code, "memory");
    let least = message.rsplit("at least ").next().unwrap();
    let report = check(&huge, &["--memory", least, "--threads", "2"]);
    assert_eq!(report["spool"]["in"], "disk");
    assert!(report["tiles"].as_u64() > Some(1) && report["tiling"]["cut"].as_u64() < Some(128), "{report}");
    assert_eq!(folder.names(), ["bare.tiles", "haloed.tiles.zst", "huge.tiles", "out.exr", "shuffled.tiles"]);
}

#[test]
fn same_bits_whatever_the_tiling_and_the_memory() {
    same_bits(&[], &[]);
}

#[test]
fn same_bits_where_counts_vary() {
    same_bits(&["--varying"], &["--seed", "3"]);
}

#[test]
fn same_bits_with_a_wide_reach() {
    same_bits(&[], &["--preset", "paper-fast", "--set", "boxes=41,9", "--set", "fractions=0.02,0.1"]);
}

#[test]
fn less_halo_than_the_preset_reads_is_made_up_for() {
    let folder = Folder::new();
    let common = ["--size", "70x40", "--spp", "2"];
    let narrow = folder.synth("narrow.tiles", &[&common[..], &["--tile", "16", "--halo", "3"]].concat());
    let huge = folder.synth("huge.tiles", &[&common[..], &["--tile", "100"]].concat());
    let (a, b) = (folder.path("a.exr"), folder.path("b.exr"));
    let report = json(["filter", &narrow, "-o", &a]);
    assert_eq!(report["short_of_halo"], 0);
    json(["filter", &huge, "-o", &b]);
    assert!(bytes(a) == bytes(b));
}

/// All SIMD levels, asked for by the flag or by the environment, give one file; a level that there is not is refused.
#[test]
fn same_bits_at_every_simd_level() {
    let folder = Folder::new();
    let (tiles, out) =
        (folder.synth("in.tiles", &["--size", "40x30", "--spp", "3", "--tile", "64"]), folder.path("out"));
    let levels = rpfd::filter::SimdLevel::names();
    let best = *levels.last().unwrap();
    for preset in ["lean", "paper-fast", "cross-bilateral"] {
        let filter = ["filter", &tiles, "-o", &out, "--preset", preset];
        assert_eq!(json(filter)["simd"], best);
        let expected = bytes(&out);
        for level in &levels {
            assert_eq!(json(filter.iter().chain(&["--simd", level]))["simd"], *level);
            assert!(bytes(&out) == expected, "{preset} at {level}");
            let mut command = Command::new(env!("CARGO_BIN_EXE_rpfd"));
            let output = command.args(filter).arg("--json").env("RPFD_SIMD", level).output().unwrap();
            let report: Value = serde_json::from_slice(&output.stdout).unwrap();
            assert_eq!(report["simd"], *level);
            assert!(bytes(&out) == expected, "{preset} at {level}");
        }
    }
    let folder = folder.path("served");
    for command in [
        &["filter", &tiles, "-o", &out][..],
        &["serve", "--listen", "127.0.0.1:0", "--data-dir", &folder],
        &["report", "--synth", "all@8x8"],
        &["cost"],
        &["stability"],
        &["demo", "--out", &folder],
    ] {
        let output = rpfd(command.iter().chain(&["--simd", "avx1024"]));
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("\"avx1024\"") && said.contains(&levels.join(", ")) && said.contains("auto"), "{said}");
    }
}

#[test]
fn missing_tiles_are_refused_unless_partial() {
    let folder = Folder::new();
    let all = folder.synth("all.tiles", &["--size", "64x48", "--spp", "2", "--tile", "16"]);
    let some = folder.path("some.tiles");
    copy_tiles(&all, &some, 0, |tile| usize::from(tile != 5));
    let out = folder.path("out.exr");
    let (code, message) = fails(3, ["filter", &some, "-o", &out]);
    assert_eq!(code, "missing");
    assert!(message.contains("[16, 16, 16, 16]") && message.contains("--partial"), "{message}");
    assert_eq!(folder.names(), ["all.tiles", "some.tiles"]);

    let report = json(["filter", &some, "-o", &out, "--partial"]);
    assert_eq!(report["missing_pixels"], 256);
    let image = read_exr(&out);
    let black = |x: u32, y: u32| image.pixels[(y * 64 + x) as usize] == [0.0; 3];
    assert!((16..32).all(|y| (16..32).all(|x| black(x, y))) && !black(8, 8) && !black(40, 24));

    // What is there does not depend on the tiles that it is cut into.
    let (shuffled, again) = (folder.path("shuffled.tiles"), folder.path("again.exr"));
    copy_tiles(&some, &shuffled, 9, |_| 1);
    let least = fails(2, ["filter", &some, "-o", &again, "--partial", "--memory", "1MiB"]).1;
    json(["filter", &shuffled, "-o", &again, "--partial", "--memory", least.rsplit("at least ").next().unwrap()]);
    assert!(bytes(out) == bytes(again));
}

/// A halo may bring samples of tiles that are missing: what there is of the image must not depend on the memory.
#[test]
fn a_partial_image_does_not_depend_on_the_memory() {
    let folder = Folder::new();
    let (all, some) = (folder.path("all.tiles"), folder.path("some.tiles"));
    json(["synth", "--size", "64x64", "--spp", "4", "--tile", "32", "--halo", "20", "-o", &all]);
    let (mut file, mut out) = (TileFile::open(&all).unwrap(), TileWriter::create(&some).unwrap());
    for _ in 0..3 {
        let (header, tile) = file.next_tile().unwrap().unwrap();
        out.write_tile(&header, &tile).unwrap();
    }
    out.finish().unwrap();
    let run = |memory: &str| {
        let out = folder.path(&format!("{memory}.exr"));
        json(["filter", &some, "-o", &out, "--partial", "--threads", "1", "--memory", memory]);
        std::fs::read(out).unwrap()
    };
    assert!(run("1GiB") == run("8MiB"));
}

#[test]
fn the_exr_is_as_asked_for() {
    let folder = Folder::new();
    let input = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let base = ["filter", &input, "--preset", "unfiltered", "-o"];
    let float = folder.path("float.exr");
    json(base.into_iter().chain([&*float]));
    let expected = read_exr(&float);
    for options in
        [&["--half"][..], &["--exr-samples", "half", "--compression", "piz"], &["--exr-tiles", "16", "--float"]]
    {
        let out = folder.path("out.exr");
        json(base.iter().chain([&&*out]).chain(options));
        assert_ne!(bytes(&out), bytes(&float));
        let half = !options.contains(&"--float");
        for (got, expected) in read_exr(&out).pixels.as_flattened().iter().zip(expected.pixels.as_flattened()) {
            let tolerance = if half { 1e-3 * expected + 1e-7 } else { 0.0 };
            assert!((got - expected).abs() <= tolerance, "{got} is not {expected}");
        }
    }
}
