//! `rpfd report`: errors that are the same whenever they are measured, and what is written about them.

use super::*;
use rpfd::report::{scores::COLUMNS, svg, table::short};
use std::collections::BTreeMap;

/// A crop of a render, with its reference.
fn small() -> String {
    format!("{}={}:2e-4", data("small.tiles.zst").display(), data("small.reference.exr").display())
}

/// The methods are named, so that a new preset changes nothing here.
const METHODS: [&str; 4] = ["--preset", "lean", "--preset", "lean:boxes=11,7,bins=9"];

fn measure(folder: &Folder, csv: &str, more: &[&str]) -> (Output, String) {
    let (small, csv) = (small(), folder.path(csv));
    let args = ["report", "--data", &small, "--synth", "all@48x48", "--reference-spp", "32", "--csv", &csv];
    let output = rpfd(args.iter().chain(&METHODS).chain(more));
    assert!(output.status.success(), "{}", stderr(&output));
    (output, std::fs::read_to_string(csv).unwrap())
}

/// The cells of a line; only the methods have commas in them.
fn cells(line: &str) -> Vec<String> {
    let (mut cells, mut inside) = (vec![String::new()], false);
    for c in line.chars() {
        match c {
            '"' => inside = !inside,
            ',' if !inside => cells.push(String::new()),
            c => cells.last_mut().unwrap().push(c),
        }
    }
    cells
}

/// What a CSV has ahead of the times: data, method, and every error.
fn error_columns(csv: &str) -> String {
    let end = cells(csv.lines().next().unwrap()).iter().position(|name| name == "repeats").unwrap();
    assert_eq!(end, 20);
    csv.lines().map(|line| cells(line)[..end].join(";") + "\n").collect()
}

/// The errors are those of tests/report/small.csv to the last digit, on any machine; with RPFD_REGENERATE set that file
/// is written anew.
#[test]
fn errors_are_as_recorded_to_the_last_digit() {
    let folder = Folder::new();
    let (_, one) = measure(&folder, "one.csv", &["--spp", "1,2,4", "--crop", "8,8,24,24"]);
    let (_, two) = measure(&folder, "two.csv", &["--spp", "4,2,1", "--crop", "8,8,24,24", "--repeats", "2"]);
    assert_eq!(error_columns(&one), error_columns(&two));
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/report/small.csv");
    if std::env::var_os("RPFD_REGENERATE").is_some() {
        std::fs::write(&golden, error_columns(&one)).unwrap();
    }
    let golden = std::fs::read_to_string(golden).unwrap();
    assert_eq!(golden.lines().count(), 1 + 2 * 2 * 3 * 3);
    for (got, expected) in error_columns(&one).lines().zip(golden.lines()) {
        assert_eq!(got, expected, "to record these errors, run with RPFD_REGENERATE=1");
    }
    assert_eq!(error_columns(&one).lines().count(), golden.lines().count());
}

/// The committed report, by column.
fn shared() -> Vec<BTreeMap<String, String>> {
    let csv = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/report/shared.csv")).unwrap();
    let columns = cells(csv.lines().next().unwrap());
    csv.lines().skip(1).map(|line| columns.iter().cloned().zip(cells(line)).collect()).collect()
}

/// The README's table is the committed report's.
#[test]
fn the_readme_says_what_the_report_measured() {
    let readme = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md")).unwrap();
    let rows = shared();
    let relmse_at = |scene: &str, method: &str, spp: &str| -> f64 {
        let of = |row: &&BTreeMap<String, String>| row["data"] == scene && row["spp"] == spp && row["method"] == method;
        rows.iter().find(of).unwrap()["relmse_less_own"].parse().unwrap()
    };
    let relmse = |scene: &str, method: &str| relmse_at(scene, method, "8");
    let scenes = ["cornell_box", "depth_of_field", "glossy_highlights", "motion_blur", "textures"];
    for scene in scenes {
        let line =
            readme.lines().find(|line| line.starts_with(&format!("| {scene}, ")) && line.contains(" x ")).unwrap();
        let said: Vec<_> = line.split('|').skip(2).map(|cell| cell.trim().replace('*', "")).collect();
        let [before, lean, fast] = ["unfiltered", "lean", "paper-fast"].map(|method| relmse(scene, method));
        let gain = |error: f64| match before / error {
            gain if gain < 1.0 => format!("{gain:.2}"),
            gain => format!("{gain:.1}"),
        };
        let [plain, lean_error, fast_error] = [before, lean, fast].map(|error| format!("{error:.4}"));
        assert_eq!(said[..5], [plain, lean_error, gain(lean), fast_error, gain(fast)], "{line}");
    }
    let means = ["lean", "paper-fast", "cross-bilateral"].map(|method| {
        let logs = scenes.map(|scene| (relmse(scene, "unfiltered") / relmse(scene, method)).ln());
        (logs.iter().sum::<f64>() / logs.len() as f64).exp()
    });
    assert!(
        readme.contains(&format!("| geometric mean | | | **{:.2}** | | **{:.2}** |", means[0], means[1])),
        "{means:?}"
    );
    assert!(readme.contains(&format!("a geometric mean of {:.1}", means[2])), "{means:?}");
    let more = ["4", "8", "32"].map(|spp| relmse_at("motion_blur", "lean", spp));
    let said = format!("from {:.4} at 4 to {:.4} at 8\nand {:.4} at 32 samples", more[0], more[1], more[2]);
    assert!(readme.contains(&said), "{said}");
}

/// The committed report is not older than the methods: its errors, to the last digit, on the renders that RPFD_DATA names.
#[test]
fn the_shared_report_is_as_committed() {
    let Some(data) = std::env::var_os("RPFD_DATA") else {
        return println!("SKIPPED: RPFD_DATA does not name a folder of renders with references");
    };
    let (folder, rows) = (Folder::new(), shared());
    let csv = folder.path("now.csv");
    let methods = ["lean", "cross-bilateral", "bilateral", "gaussian"];
    let mut args: Vec<&OsStr> = vec!["report".as_ref(), "--csv".as_ref(), csv.as_ref(), "--folder".as_ref(), &data];
    methods.iter().for_each(|method| args.extend(["--preset", *method].map(OsStr::new)));
    let output = rpfd(args);
    assert!(output.status.success(), "{}", stderr(&output));
    let now = std::fs::read_to_string(&csv).unwrap();
    let columns = cells(now.lines().next().unwrap());
    assert_eq!(now.lines().count(), 1 + 7 * 5);
    for line in now.lines().skip(1).map(cells) {
        let same = |row: &&BTreeMap<String, String>| (0..4).all(|i| row[&columns[i]] == line[i]);
        let committed = rows.iter().find(same).unwrap_or_else(|| panic!("{:?} is not in shared.csv", &line[..4]));
        let repeats = columns.iter().position(|name| name == "repeats").unwrap();
        for (name, value) in columns.iter().zip(&line).take(repeats) {
            assert_eq!(*value, committed[name], "{name} of {:?}: make tests/report again", &line[..4]);
        }
    }
}

#[test]
fn threads_change_no_error() {
    let folder = Folder::new();
    let (_, csv) = measure(&folder, "out.csv", &["--spp", "2", "--threads", "1,2"]);
    let mut rows: BTreeMap<[String; 2], Vec<Vec<String>>> = BTreeMap::new();
    for line in error_columns(&csv).lines().skip(1) {
        let mut cells: Vec<String> = line.split(';').map(str::to_owned).collect();
        cells.remove(5);
        rows.entry([cells[0].clone(), cells[3].clone()]).or_default().push(cells);
    }
    assert_eq!(rows.len(), 6);
    assert!(rows.values().all(|same| same.len() == 2 && same[0] == same[1]));
}

#[test]
fn what_is_measured_is_not_measured_again() {
    let folder = Folder::new();
    let state = folder.path("report.state");
    let (_, one) = measure(&folder, "one.csv", &["--spp", "2", "--state", &state]);
    let lines = |text: &str| text.lines().count();
    let kept = String::from_utf8(bytes(&state)).unwrap();
    assert_eq!(lines(&kept), 6);
    // The times are the same as well: nothing was measured.
    let (_, two) = measure(&folder, "two.csv", &["--spp", "2", "--state", &state]);
    assert_eq!(one, two);
    assert_eq!(String::from_utf8(bytes(&state)).unwrap(), kept);
    // The last line was cut short: it is measured again, and only it.
    std::fs::write(&state, &kept[..kept.len() - 20]).unwrap();
    let (_, three) = measure(&folder, "three.csv", &["--spp", "2", "--state", &state]);
    assert_eq!(error_columns(&one), error_columns(&three));
    let again = String::from_utf8(bytes(&state)).unwrap();
    assert_eq!(lines(&again), 6);
    assert!(again.lines().zip(kept.lines()).take(5).all(|(a, b)| a == b));
    // What else is asked for is added; another seed is another measurement.
    measure(&folder, "four.csv", &["--spp", "2,4", "--state", &state, "--repeats", "2"]);
    assert_eq!(lines(&String::from_utf8(bytes(&state)).unwrap()), 24);
    measure(&folder, "five.csv", &["--spp", "2", "--state", &state, "--seed", "1"]);
    assert_eq!(lines(&String::from_utf8(bytes(&state)).unwrap()), 30);
}

/// What was finished when the process was killed stays, and the rest is measured.
#[test]
fn a_killed_report_goes_on() {
    let folder = Folder::new();
    let (small, state) = (small(), folder.path("report.state"));
    let args = ["report", "--data", &small, "--preset", "lean", "--spp", "1,2,4", "--repeats", "3", "--state", &state];
    let mut report = Command::new(env!("CARGO_BIN_EXE_rpfd")).args(args).stdout(std::process::Stdio::null()).spawn();
    let report = report.as_mut().unwrap();
    let kept = || std::fs::read_to_string(&state).unwrap_or_default();
    while !kept().contains('\n') && report.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    report.kill().unwrap();
    report.wait().unwrap();
    let before = kept();
    let whole = &before[..before.rfind('\n').unwrap() + 1];
    let rows = json(args)["rows"].as_array().unwrap().clone();
    let after = kept();
    assert!(after.starts_with(whole) && after.lines().count() == 3 * 2 * 3, "{}", after.lines().count());
    assert!(rows.len() == 3 * 2 && rows.iter().all(|row| row["repeats"] == 3 && row["repeatable"] == true));
}

#[test]
fn a_file_that_is_no_state_is_left_alone() {
    let folder = Folder::new();
    let (small, notes) = (small(), folder.path("notes.txt"));
    for text in ["remember the milk", "remember\nthe milk\n", "{}\n", "{\"key\": 1, \"measurement\": 2}\n"] {
        std::fs::write(&notes, text).unwrap();
        let (code, message) = fails(3, ["report", "--data", &small, "--state", &notes]);
        assert!(code == "bad_state" && message.contains("notes.txt"), "{message}");
        assert_eq!(bytes(&notes), text.as_bytes());
    }
}

/// Columns of the CSV, and where the JSON has them.
const SHARED: [(&str, &[&str]); 18] = [
    ("relmse_less_own", &["relmse_less_own"]),
    ("mse_less_own", &["mse_less_own"]),
    ("own_relmse", &["own_relmse"]),
    ("own_mse", &["own_mse"]),
    ("repeats", &["repeats"]),
    ("cpu_s_per_mpx", &["cpu_seconds_per_megapixel", "median"]),
    ("wall_s_per_mpx", &["wall_seconds_per_megapixel", "median"]),
    ("planned_bytes", &["planned_bytes"]),
    ("peak_resident_bytes", &["peak_resident_bytes"]),
    ("unfiltered_slope", &["unfiltered_slope", "value"]),
    ("equal_spp", &["equal_spp"]),
    ("total_s_per_mpx", &["total_seconds_per_megapixel"]),
    ("plain_s_per_mpx", &["plain_seconds_per_megapixel"]),
    ("plain_relmse_at_total", &["plain_relmse_at_total"]),
    ("left_out_bytes", &["left_out_bytes"]),
    ("work_saved", &["work_saved"]),
    ("settled", &["settled"]),
    ("settled_error", &["settled_error"]),
];

#[test]
fn the_page_needs_nothing_else_and_has_every_row() {
    let folder = Folder::new();
    let [html, svg, json] = ["report.html", "plot.svg", "report.json"].map(|name| folder.path(name));
    let outputs = ["--html", &html, "--svg", &svg, "--json", &json, "--spp", "1,4", "--seconds-per-sample", "3"];
    let (output, csv) = measure(&folder, "out.csv", &outputs);
    assert!(stderr(&output).is_empty(), "a bar where nobody is looking: {}", stderr(&output));
    let [page, plot, numbers] = [&html, &svg, &json].map(|path| String::from_utf8(bytes(path)).unwrap());
    for text in [&page, &plot] {
        let links = text.replace("http://www.w3.org/2000/svg", "");
        for outside in ["http:", "https:", "//cdn", "<script", "<link", "@import", "url(", "file:", "src=\"/"] {
            assert!(!links.contains(outside), "{outside}");
        }
    }
    let main = page.split("<h2>").find(|part| part.starts_with("Numbers")).unwrap();
    assert_eq!(main.matches("<tr class=").count() + main.matches("<tr><td>").count(), 12);
    // What was left out is there with its reason, also in the table and the CSV.
    let left_out = page.split("<h2>").find(|part| part.starts_with("Left out")).unwrap();
    for text in [left_out, &String::from_utf8(output.stdout.clone()).unwrap(), &csv] {
        assert!(text.contains("lens.0") && text.contains("constant"), "{text}");
    }
    let numbers: Value = serde_json::from_str(&numbers).unwrap();
    let rows = numbers["rows"].as_array().unwrap();
    assert_eq!((rows.len(), csv.lines().count()), (12, 13));
    let table = String::from_utf8(output.stdout).unwrap();
    let columns = cells(csv.lines().next().unwrap());
    for (row, line) in rows.iter().zip(csv.lines().skip(1)) {
        let cells = cells(line);
        assert_eq!((&row["data"], &row["method"]), (&cells[0].as_str().into(), &cells[3].as_str().into()));
        let csv = |name: &str| cells[columns.iter().position(|column| column == name).unwrap()].as_str();
        for (name, value) in row["errors"].as_object().unwrap() {
            assert_eq!(value.as_f64(), csv(name).parse().ok(), "{name}");
        }
        for (name, field) in SHARED {
            let value = field.iter().fold(row, |value, key| &value[key]);
            assert_eq!(value.as_f64(), csv(name).parse().ok(), "{name}");
        }
        assert_eq!(row["pareto"].to_string(), csv("pareto"));
        let spp = row["spp"].as_u64().unwrap();
        let start = format!("<td>{}</td><td>{spp}</td><td>{}</td>", cells[0], cells[3]);
        let shown = page.split("<tr").find(|line| line.contains(&start)).unwrap_or_else(|| panic!("{start}"));
        let spp_text = spp.to_string();
        let spp_and_method = [spp_text.as_str(), cells[3].as_str()];
        let line = table.lines().find(|line| {
            let after = line.strip_prefix(cells[0].as_str()).unwrap_or_default();
            after.split_whitespace().take(2).eq(spp_and_method)
        });
        for name in ["relmse_less_own", "mse_less_own", "smape", "cpu_s_per_mpx", "total_s_per_mpx", "plain_s_per_mpx"]
        {
            let short = short(csv(name).parse().unwrap());
            assert!(shown.contains(&format!("<td>{short}</td>")) && line.unwrap().contains(&short), "{name}: {short}");
        }
        // Samples and filter, and the plain samples of the same error.
        let cpu = row["cpu_seconds_per_megapixel"]["median"].as_f64().unwrap();
        assert_eq!(row["total_seconds_per_megapixel"].as_f64().unwrap(), 3.0 * spp as f64 + cpu);
        assert_eq!(row["unfiltered_slope"]["is"], "fitted");
        if row["preset"] == "unfiltered" {
            assert!((row["equal_spp"].as_f64().unwrap() - spp as f64).abs() < 1e-9);
        }
    }
    for column in COLUMNS {
        assert!(table.contains(&format!("{}: {}\n", column.title, column.formula)));
        assert!(page.contains(&svg::escape(column.formula)));
        assert_eq!(numbers["formulas"][column.name], column.formula);
    }
    for part in
        ["ε = 0.01", "prefers-color-scheme", "data:image/png;base64,", "reference", "difference", "SIMD", "slope"]
    {
        assert!(page.contains(part), "{part}");
    }
    assert_eq!(numbers["machine"]["version"], format!("rpfd {}", env!("CARGO_PKG_VERSION")));
}

/// What a tolerance saves and costs stands beside what it is without.
#[test]
fn tolerances_are_compared_with_none() {
    let folder = Folder::new();
    let (small, html) = (small(), folder.path("report.html"));
    let args = ["report", "--data", &small, "--preset", "lean", "--preset", "lean:bins=9", "--preset", "gaussian"];
    let more = ["--tolerance", "0.001,0.1", "--html", &html];
    let report = json(args.iter().chain(&more));
    let rows = report["rows"].as_array().unwrap();
    let labels: Vec<_> = rows.iter().map(|row| row["method"].as_str().unwrap()).collect();
    let lean = ["lean", "lean:tolerance=0.001", "lean:tolerance=0.1"];
    let nine = ["lean:bins=9", "lean:bins=9,tolerance=0.001", "lean:bins=9,tolerance=0.1"];
    assert_eq!(labels, [&["unfiltered"][..], &lean, &nine, &["gaussian"]].concat());
    let number = |row: usize, key: &str| rows[row][key].as_f64().unwrap();
    for (without, with) in [(1, 3), (4, 6)] {
        assert_eq!((number(without, "settled"), number(without, "settled_error")), (0.0, 0.0));
        assert!(number(with, "settled") > 0.0 && number(with, "settled") < 1.0, "{}", number(with, "settled"));
        // The estimate is of the mean: it holds here with much to spare.
        let rise = number(with, "relmse_less_own") - number(without, "relmse_less_own");
        assert!(number(with, "settled_error") < 0.1 * number(with, "settled") && rise < 0.1, "{rise}");
        assert_ne!(rows[without]["errors"], rows[with]["errors"]);
        assert!(number(with, "work_saved") > 0.0);
    }
    let page = String::from_utf8(bytes(&html)).unwrap();
    let table = page.split("<h2>").find(|part| part.starts_with("With and without a tolerance")).unwrap();
    assert_eq!(table.matches("<tr>").count(), 1 + 4);
    let text = String::from_utf8(rpfd(args.iter().chain(&["--tolerance", "0.1"])).stdout).unwrap();
    assert!(text.contains("settled: pixels") && text.contains("lean:bins=9,tolerance=0.1"), "{text}");
}

/// A render in a folder serves its own number of samples, and fewer; what it has not is left out, and said.
#[test]
fn a_folder_of_renders() {
    let folder = Folder::new();
    for (name, spp) in [("a.2spp.tiles", "2"), ("a.6spp.tiles.zst", "6")] {
        let reference = folder.path("a.reference.exr");
        let args =
            ["--size", "20x16", "--spp", spp, "--reference", &reference, "--reference-spp", "16", "--scene", "plain"];
        folder.synth(name, &args);
    }
    std::fs::write(folder.path("reference-noise.json"), r#"{"a": {"relmse": 0.001, "mse": 0.002}}"#).unwrap();
    let here = folder.path("");
    let said = |more: &[&str]| {
        let report = json(["report", "--folder", &here, "--preset", "unfiltered"].iter().chain(more));
        let rows = report["rows"].as_array().unwrap().clone();
        rows.iter().map(|r| (r["spp"].as_u64().unwrap(), r["errors"]["relmse"].as_f64().unwrap())).collect::<Vec<_>>()
    };
    let own = said(&[]);
    assert_eq!(own.iter().map(|row| row.0).collect::<Vec<_>>(), [2, 6]);
    // The samples of synth are the same whatever their number, so it does not matter which file serves.
    let all = said(&["--spp", "1,2,4,6"]);
    assert_eq!(all.iter().map(|row| row.0).collect::<Vec<_>>(), [1, 2, 4, 6]);
    assert_eq!([all[1], all[3]], [own[0], own[1]]);
    let output = rpfd(["report", "--folder", &here, "--preset", "unfiltered", "--spp", "2,64"]);
    assert!(output.status.success() && stderr(&output).contains("fewer than 64"));
    let row = &json(["report", "--folder", &here, "--spp", "2", "--preset", "unfiltered"])["rows"][0];
    assert_eq!((&row["own_relmse"], &row["own_mse"]), (&0.001.into(), &0.002.into()));
    assert_eq!(row["relmse_less_own"].as_f64().unwrap(), row["errors"]["relmse"].as_f64().unwrap() - 0.001);
    // SSIM has no window here.
    assert_eq!(fails(2, ["report", "--folder", &here, "--spp", "64"]).0, "no_data");
}

#[test]
fn an_image_without_an_ssim_window_has_none() {
    let row = &json(["report", "--synth", "plain@8x8", "--reference-spp", "4", "--preset", "unfiltered"])["rows"][0];
    assert_eq!(row["errors"]["ssim"], "NaN");
    assert!(row["errors"]["flip"].as_f64().unwrap() > 0.0);
}

#[test]
fn bad_usage_and_bad_input_are_told_apart() {
    let folder = Folder::new();
    let (small, here) = (small(), folder.path(""));
    for (args, code) in [
        (&["report"][..], "no_data"),
        (&["report", "--data", &small, "--preset", "leen"], "parameter"),
        (&["report", "--data", &small, "--preset", "lean:boxs=3"], "parameter"),
        (&["report", "--data", &small, "--preset", "lean:7"], "parameter"),
        (&["report", "--data", &small, "--crop", "40,40,9,9"], "crop"),
        (&["report", "--data", &small, "--spp", "5"], "no_data"),
        (&["report", "--data", &small, "--data", &small], "data"),
    ] {
        let (got, message) = fails(2, args);
        assert_eq!(got, code, "{args:?}: {message}");
    }
    for args in [
        &["--data", "a.tiles"][..],
        &["--data", "a.tiles=b.exr:lots"],
        &["--synth", "all"],
        &["--synth", "nothing@8x8"],
        &["--spp", "0"],
        &["--spp", "4,x"],
        &["--threads", "0"],
        &["--repeats", "0"],
        &["--crop", "1,2,3"],
        &["--crop", "1,2,0,3"],
        &["--seconds-per-sample", "0"],
    ] {
        let output = rpfd(["report"].iter().chain(args));
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(stderr(&output).contains(args[0]), "{}", stderr(&output));
    }
    let (tiles, reference) = (data("small.tiles.zst"), data("depth_of_field.reference.exr"));
    let wrong = format!("{}={}", tiles.display(), reference.display());
    assert_eq!(fails(3, ["report", "--data", &wrong]).0, "picture_size");
    assert_eq!(fails(3, ["report", "--data", "nowhere.tiles=nowhere.exr"]).0, "not_found");
    assert_eq!(fails(3, ["report", "--folder", &here]).0, "io");
    // Before the work, and without a trace.
    let nowhere = folder.path("nowhere/out");
    for output in ["--csv", "--html", "--svg", "--state"] {
        assert_eq!(fails(1, ["report", "--data", &small, output, &nowhere]).0, "output_io");
    }
    assert_eq!(folder.names(), [""; 0]);
}
