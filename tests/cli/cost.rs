//! `rpfd cost`: every axis is measured, growth is that of the numbers, and the report's page takes it over. What things
//! cost is not asserted.

use super::*;

/// Little work, so that it is soon done.
const QUICK: [&str; 7] = ["cost", "--preset", "lean:boxes=3,fractions=0.5", "--side", "8", "--repeats", "1"];

#[test]
fn every_axis_is_measured() {
    let folder = Folder::new();
    let [costs, svg, html] = ["cost.json", "cost.svg", "report.html"].map(|name| folder.path(name));
    let small = data("small.tiles.zst").into_os_string().into_string().unwrap();
    let axes = ["--axis", "samples,features,random,simd", "--data", &small, "--json", &costs, "--svg", &svg];
    let output = rpfd(QUICK.iter().chain(&axes));
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).is_empty());
    let numbers: Value = serde_json::from_slice(&bytes(&costs)).unwrap();
    let rows = numbers["costs"].as_array().unwrap();
    let levels = rpfd::filter::SimdLevel::names();
    let values = |axis: &str, of: &str| -> Vec<Value> {
        rows.iter().filter(|row| row["axis"] == axis && row["input"] == "image").map(|row| row[of].clone()).collect()
    };
    assert_eq!(values("samples", "samples"), [1, 2, 4, 8, 16, 32, 64]);
    assert_eq!(values("features", "features"), [3, 6, 9, 12, 15, 18]);
    assert_eq!(values("random", "random"), [0, 1, 2, 4, 6, 8]);
    assert_eq!(values("simd", "simd"), levels);
    assert_eq!(rows.len(), 7 + 6 + 6 + 2 * levels.len());
    let file = rows.iter().find(|row| row["input"] == "small.tiles.zst").unwrap();
    assert_eq!((&file["samples"], &file["size"]), (&4.into(), &vec![48, 48].into()));
    assert!(rows.iter().all(|row| row["cpu"]["median"].as_f64() > Some(0.0) && row["repeats"] == 1));

    // Growth is a quotient of rows.
    let growth = numbers["growth"].as_array().unwrap();
    let cpu = |samples: u32| {
        let row = rows.iter().find(|row| row["axis"] == "samples" && row["samples"] == samples).unwrap();
        row["cpu"]["median"].as_f64().unwrap()
    };
    let from_8_to_32 = growth.iter().find(|found| found["from"] == 8.0 && found["to"] == 32.0).unwrap();
    assert_eq!(from_8_to_32["ratio"], cpu(32) / cpu(8));

    let memory = &numbers["memory"][0];
    assert_eq!((&memory["planes"], &memory["planned_samples"]), (&27.into(), &(256 * 256 * 8 * 27 * 4).into()));
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.contains("8 to 32 samples per pixel: ") && table.contains("27 planes"), "{table}");
    assert_eq!(String::from_utf8(bytes(&svg)).unwrap().matches("font-weight=\"bold\"").count(), 4);

    let synth = ["report", "--synth", "plain@8x8", "--reference-spp", "2", "--preset", "lean", "--spp", "1"];
    let output = rpfd(synth.iter().chain(&["--html", &html, "--cost", &costs]));
    assert!(output.status.success(), "{}", stderr(&output));
    let page = String::from_utf8(bytes(&html)).unwrap();
    assert!(page.contains("8 to 32 samples per pixel: ") && page.contains("small.tiles.zst") && page.contains("avx"));
    let (code, message) = fails(3, synth.iter().chain(&["--html", &html, "--cost", &svg]));
    assert!(code == "bad_json" && message.contains("cost.svg") && message.contains("rpfd cost --json"), "{message}");
}

#[test]
fn threads_and_tiles_are_measured() {
    let numbers = json(QUICK.iter().chain(&["--axis", "tile,threads"]));
    let rows = numbers["costs"].as_array().unwrap();
    let of = |axis: &str| rows.iter().filter(|row| row["axis"] == axis).collect::<Vec<_>>();
    let sides: Vec<_> = of("tile").iter().map(|row| row["size"][0].clone()).collect();
    assert_eq!(sides, [32, 64, 128, 256]);
    let threads: Vec<_> = of("threads").iter().map(|row| (row["input"].clone(), row["threads"].clone())).collect();
    let shapes = ["image of 256 x 256", "tile of 256 x 256", "tile of 64 x 64"];
    let expected = shapes.iter().flat_map(|shape| [1, 2].map(|threads| ((*shape).into(), threads.into())));
    assert_eq!(threads, expected.collect::<Vec<(Value, Value)>>());
}

#[test]
fn what_cannot_be_measured_is_refused() {
    assert_eq!(fails(2, ["cost", "--preset", "leen"]).0, "parameter");
    assert_eq!(rpfd(["cost", "--axis", "time"]).status.code(), Some(2));
    assert_eq!(fails(3, ["cost", "--data", "/nowhere.tiles"]).0, "not_found");
}
