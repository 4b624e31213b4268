//! `rpfd stability`: the table, the JSON and the exit code.

use super::*;
use rpfd::filter::method::PRESETS;

#[test]
fn json_has_every_figure_and_bound() {
    let report = json(["stability", "--case", "not-finite-color", "--case", "image-1x1", "--preset", "lean"]);
    let cases = report["cases"].as_array().unwrap();
    let names: Vec<_> = cases.iter().map(|case| case["case"].as_str().unwrap()).collect();
    assert_eq!(names, ["not-finite-color", "image-1x1"]);
    assert_eq!((&report["ok"], &report["known"], &report["failed"]), (&2.into(), &0.into(), &0.into()));
    let case = &cases[0];
    assert_eq!((&case["verdict"], &case["preset"], &case["finite"]), (&"ok".into(), &"lean".into(), &true.into()));
    assert_eq!(case["beyond"], serde_json::json!([]));
    assert!(case["replaced"].as_u64().unwrap() > 0);
    for (figure, bound) in [("greatest", "step"), ("rms", "step_rms")] {
        assert!(case["steps"][figure].as_f64().unwrap() <= case["bounds"][bound].as_f64().unwrap(), "{figure}");
    }
    for measured in ["whole", "clean", "oracle_clean"] {
        assert!(["median", "rms", "greatest"].iter().all(|field| case[measured][field].is_f64()), "{measured}");
    }
    assert!(case["energy"].is_f64() && case["bounds"]["reason"].is_string());
    assert!(cases[1]["clean"].is_null());
}

/// Every preset, as when none is named: also those that have not what a case sets.
#[test]
fn every_preset_runs() {
    let report = json(["stability", "--case", "spp-1024"]);
    let cases = report["cases"].as_array().unwrap();
    assert_eq!((cases.len(), &report["ok"]), (PRESETS.len(), &PRESETS.len().into()));
    for (case, (preset, _)) in cases.iter().zip(PRESETS) {
        let neighbors = matches!(*preset, "lean" | "paper-fast" | "paper").then_some("2048");
        assert_eq!((&case["preset"], case["parameters"]["max_neighbors"].as_str()), (&(*preset).into(), neighbors));
    }
}

#[test]
fn the_table_names_the_cause_of_known_failures() {
    let output = rpfd(["stability", "--case", "units-alone-1e-3", "--preset", "paper-fast", "--preset", "unfiltered"]);
    let table = String::from_utf8(output.stdout.clone()).unwrap();
    assert!(output.status.success(), "{table}{}", stderr(&output));
    let verdicts: Vec<_> =
        table.lines().filter(|line| line.starts_with("units-alone")).filter_map(|l| l.split(' ').next_back()).collect();
    assert_eq!(verdicts, ["known", "ok"]);
    assert!(table.contains("0.1 is never too far"), "{table}");
}

/// With --strict what the published algorithm misses is a failure like any other: the exit code is 1, and what was found
/// is printed all the same.
#[test]
fn what_is_beyond_a_bound_exits_with_1() {
    let args = ["stability", "--case", "units-alone-1e-3", "--preset", "paper-fast", "--strict"];
    let (code, message) = fails(1, args);
    assert_eq!(code, "unstable");
    assert!(message.contains("1 of 1"), "{message}");
    let output = rpfd(args.iter().chain(&["--json"]));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&report["known"], &report["failed"]), (&1.into(), &0.into()));
    assert!(rpfd(["stability", "--case", "image-1x1", "--preset", "lean", "--strict"]).status.success());
}

/// What overflows in half precision is infinite when it arrives, and replaced; the film is always in single.
#[test]
fn f16_overflows_on_the_wire() {
    let report = json(["stability", "--case", "f16-overflow", "--preset", "lean"]);
    let case = &report["cases"][0];
    // Every 50th of 1024 values from the 11th on, in 3 planes.
    assert_eq!((&case["replaced"], &case["verdict"]), (&(3 * 21).into(), &"ok".into()));
}

#[test]
fn unknown_cases_are_refused_with_what_there_is() {
    let (code, message) = fails(2, ["stability", "--case", "no such"]);
    assert_eq!(code, "no_case");
    assert!(message.contains("no such") && message.contains("firefly-max"), "{message}");
}
