//! `rpfd inspect`: what it finds.

use super::*;
use rpfd::filter::{Counts, SampleTile};

fn inspect(path: &str) -> Value {
    json(["inspect", path])
}

#[test]
fn the_real_render() {
    let report = inspect(data("small.tiles.zst").to_str().unwrap());
    assert_eq!((&report["image"], &report["tiles"]), (&Value::from([48, 48]), &4.into()));
    assert_eq!((&report["compressed"], &report["covered_pixels"]), (&true.into(), &(48 * 48).into()));
    assert_eq!((&report["samples"]["total"], &report["samples"]["per_pixel"]), (&(48 * 48 * 4).into(), &4.into()));
    assert_eq!(report["planes"].as_array().unwrap().len(), 27);
    assert_eq!(report["channels"][1]["role"], "color");
    assert_eq!(report["faults"], Value::Array(Vec::new()));
    let lens = report["planes"].as_array().unwrap().iter().find(|p| p["name"] == "lens.1").unwrap();
    assert_eq!((&lens["left_out"], &lens["max"]), (&"constant".into(), &0.0.into()));
    let film = &report["planes"][0];
    let mean = film["mean"].as_f64().unwrap();
    assert!(film["min"].as_f64() >= Some(0.0) && film["max"].as_f64() <= Some(48.0) && (23.0..25.0).contains(&mean));
    let halo = report["halo_needed"].as_array().unwrap().iter().find(|h| h["preset"] == "lean").unwrap();
    assert_eq!((&halo["needed"], &halo["tiles_with_enough"]), (&17.into(), &0.into()));
    assert_eq!(report["halo"]["most"], Value::from([0, 0, 0, 0]));
    let spool = report["memory"]["spool"].as_u64().unwrap();
    assert!((48 * 48 * 4 * 4 * 20..=48 * 48 * 4 * 4 * 27).contains(&spool), "{spool}");
    assert!(report["memory"]["largest_tile"].as_u64().unwrap() > 32 * 32 * 4 * 4 * 20);
    let text = String::from_utf8(rpfd(["inspect", data("small.tiles.zst").to_str().unwrap()]).stdout).unwrap();
    assert!(text.contains("lens.0") && text.contains("left out: constant") && text.contains("paper-fast"), "{text}");
}

#[test]
fn missing_features_halos_and_counts() {
    let folder = Folder::new();
    let args = ["--size", "40x30", "--spp", "4", "--tile", "16", "--halo", "20", "--scene", "plain", "--varying"];
    let report = inspect(&folder.synth("a.tiles", &args));
    let find = |name: &str| report["planes"].as_array().unwrap().iter().find(|p| p["name"] == name).unwrap().clone();
    assert_eq!((&find("P2.0")["left_out"], &find("time")["left_out"]), (&"missing".into(), &"constant".into()));
    assert!(find("P.0")["nan"].as_u64() > Some(0));
    assert_eq!((&report["samples"]["per_pixel"], &report["samples"]["most"]), (&Value::Null, &4.into()));
    let lean = report["halo_needed"].as_array().unwrap().iter().find(|h| h["preset"] == "lean").unwrap();
    assert_eq!((&lean["needed"], &lean["tiles_with_enough"]), (&20.into(), &6.into()));
}

/// What `inspect` says will be left out, and what that saves, is what `filter` reports.
#[test]
fn a_grey_scene_needs_one_channel() {
    let folder = Folder::new();
    let color = folder.synth("color.tiles", &["--size", "40x30", "--spp", "3", "--tile", "32", "--scene", "plain"]);
    let grey = folder.path("grey.tiles");
    let (mut file, mut writer) = (TileFile::open(&color).unwrap(), TileWriter::create(&grey).unwrap());
    while let Some((header, tile)) = file.next_tile().unwrap() {
        let colors = tile.channels().color_planes();
        let plane = |plane: usize| tile.plane(if colors.contains(&plane) { colors[0] } else { plane }).clone();
        let planes = (0..tile.channels().planes()).map(plane).collect();
        let tile = SampleTile::new(*tile.geometry(), tile.channels().clone(), Counts::Uniform(3), planes).unwrap();
        writer.write_tile(&header, &tile).unwrap();
    }
    writer.finish().unwrap();
    let saved = |path: &str, preset: &str| {
        let inspected = json(["inspect", path, "--preset", preset]);
        let of = |value: &Value, plane: &str, reason: &str| {
            (value[plane].as_str().map(str::to_owned), value[reason].as_str().map(str::to_owned))
        };
        let planes = inspected["planes"].as_array().unwrap().iter().filter(|plane| !plane["left_out"].is_null());
        let mut planes: Vec<_> = planes.map(|plane| of(plane, "name", "left_out")).collect();
        let filtered = json(["filter", path, "-o", &folder.path("out.exr"), "--preset", preset]);
        let left_out = filtered["left_out"].as_array().unwrap().iter();
        planes.sort();
        assert_eq!(planes, left_out.map(|l| of(l, "plane", "reason")).collect::<Vec<_>>());
        assert_eq!(inspected["left_out"]["planes"], planes.len());
        assert_eq!(inspected["left_out"]["bytes"], planes.len() * 40 * 30 * 3 * 4);
        (planes.len(), inspected["left_out"]["saved"].as_f64())
    };
    for preset in ["lean", "paper-fast"] {
        let ((all, some), (grey, more)) = (saved(&color, preset), saved(&grey, preset));
        assert!(grey == all + 2 && more > some, "{preset}: {some:?} {more:?}");
    }
    assert_eq!(saved(&grey, "gaussian"), (saved(&color, "gaussian").0, None));
    let off = json(["inspect", &grey, "--leave-out", "off"]);
    assert_eq!(off["left_out"], serde_json::json!({ "planes": 0, "bytes": 0, "saved": 0.0 }));
    let text = String::from_utf8(rpfd(["inspect", &grey]).stdout).unwrap();
    assert!(text.contains("left out: equal") && text.contains("% of the work of lean"), "{text}");
}

#[test]
fn what_is_wrong_is_said_and_exits_with_3() {
    let folder = Folder::new();
    let good = folder.synth("good.tiles", &["--size", "64x48", "--spp", "1", "--tile", "32"]);
    let bad = folder.path("bad.tiles");
    for (code, times) in [("missing", [0, 1, 1, 1]), ("overlap", [1, 2, 1, 1])] {
        copy_tiles(&good, &bad, 0, |tile| times[tile]);
        assert_eq!(fails(3, ["inspect", &bad]).0, code);
        let output = rpfd(["inspect", &bad, "--json"]);
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(report["faults"][0]["code"], code);
    }
    let other = folder.synth("other.tiles", &["--size", "65x48", "--spp", "1", "--tile", "32"]);
    std::fs::write(&bad, [bytes(&good), bytes(other)].concat()).unwrap();
    assert_eq!(fails(3, ["inspect", &bad]).0, "disagreement");
}
