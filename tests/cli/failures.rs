//! Exit codes, and that nothing is left behind.

use super::*;

/// Input that cannot be used, with its stable code: exit 3 from each command that reads it, and no output.
#[test]
fn bad_input_exits_with_3() {
    let folder = Folder::new();
    let good = folder.synth("good.tiles", &["--size", "40x30", "--spp", "1", "--tile", "16"]);
    let zst = folder.synth("good.tiles.zst", &["--size", "40x30", "--spp", "1", "--tile", "16"]);
    let (plain, packed) = (bytes(&good), bytes(&zst));
    // The sum over all of it is in the last bytes.
    let mut corrupt = packed.clone();
    *corrupt.last_mut().unwrap() ^= 0x5a;
    let trailing = [&plain[..], &[7]].concat();
    for (code, content) in [
        ("truncated", &plain[..plain.len() - 1]),
        ("truncated", &packed[..packed.len() - 9]),
        ("compression", &corrupt[..]),
        ("empty", &[]),
        ("not_a_tile", b"P6 40 30 255 "),
        ("trailing", &trailing),
    ] {
        let (bad, out) = (folder.path("bad.tiles"), folder.path("out.exr"));
        std::fs::write(&bad, content).unwrap();
        for args in [
            &["inspect", &bad][..],
            &["filter", &bad, "-o", &out],
            &["post", &bad, "--to", "http://127.0.0.1:1", "-o", &out],
        ] {
            let (got, message) = fails(3, args);
            assert!(got == code && message.contains("bad.tiles"), "{args:?}: {got}, not {code}: {message}");
        }
        assert_eq!(folder.names(), ["bad.tiles", "good.tiles", "good.tiles.zst"]);
    }
    let (missing, out) = (folder.path("nowhere.tiles"), folder.path("out.exr"));
    assert_eq!(fails(3, ["filter", &missing, "-o", &out]).0, "not_found");
    assert_eq!(fails(3, ["inspect", &missing]).0, "not_found");
    assert_eq!(fails(3, ["inspect", &folder.path("")]).0, "not_a_file");
    assert_eq!(folder.names(), ["bad.tiles", "good.tiles", "good.tiles.zst"]);
}

#[test]
fn output_that_cannot_be_written_exits_with_1_before_the_work() {
    let folder = Folder::new();
    // The input is not there either, but that is not looked at yet.
    let (missing, nowhere) = (folder.path("nowhere.tiles"), folder.path("nowhere/out"));
    let out = folder.path("out.exr");
    for args in [
        &["filter", &missing, "-o", &nowhere][..],
        &["filter", &missing, "-o", &out, "--png", &nowhere],
        &["filter", &missing, "-o", "/dev/null"],
        &["post", &missing, "--to", "http://127.0.0.1:1", "-o", &nowhere],
    ] {
        let (code, message) = fails(1, args);
        assert_eq!(code, "output_io", "{message}");
    }
    let synth = ["synth", "--size", "8x8", "--spp", "1", "-o"];
    fails(1, synth.iter().chain([&&*nowhere]));
    fails(1, synth.iter().chain([&&*out, &"--reference", &&*nowhere]));
    // A disk that is full.
    let (code, message) = fails(1, synth.iter().chain([&"/dev/full"]));
    assert!(message.contains("/dev/full"), "{code}: {message}");
    assert_eq!(folder.names(), [""; 0]);
}

#[test]
fn bad_usage_exits_with_2_and_says_what_would_be_right() {
    let folder = Folder::new();
    let (input, out) = (data("small.tiles.zst"), folder.path("out.exr"));
    let filter = ["filter", input.to_str().unwrap(), "-o", &out];
    for (args, hint) in [
        (&["--preset", "leen"][..], "lean"),
        (&["--set", "boxs=3"], "boxes"),
        (&["--set", "bins=8"], "odd"),
        (&["--preset", "unfiltered", "--set", "bins=9"], "none"),
        (&["--memory", "1kB"], "at least"),
        (&["--png", &out], "same file"),
    ] {
        let (_, message) = fails(2, filter.iter().chain(args));
        assert!(message.contains(hint), "{args:?}: {message}");
    }
    for args in [
        &["--set", "boxes"][..],
        &["--memory", "lots"],
        &["--seed", "x"],
        &["--threads", "0"],
        &["--exr-tiles", "8"],
        &["--compression", "jpeg"],
        &["--half", "--float"],
        &["--frobnicate"],
    ] {
        let output = rpfd(filter.iter().chain(args));
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(stderr(&output).contains(args[0]), "{}", stderr(&output));
    }
    for size in ["64", "0x5", "5x", "64*64", "2000000x1"] {
        let output = rpfd(["synth", "--size", size, "--spp", "1", "-o", &out]);
        assert_eq!(output.status.code(), Some(2), "{size}");
    }
    assert_eq!(fails(2, ["synth", "--size", "8x8", "--spp", "70000", "-o", &out]).0, "too_large");
    let (code, _) = fails(2, ["post", input.to_str().unwrap(), "--to", "localhost:80", "-o", &out]);
    assert_eq!(code, "bad_url");
    assert_eq!(rpfd(["inspect"]).status.code(), Some(2));
    assert_eq!(rpfd([""; 0]).status.code(), Some(2));
    assert_eq!(folder.names(), [""; 0]);
}

#[test]
fn help_and_version_exit_with_0() {
    for command in ["demo", "filter", "inspect", "post", "report", "synth"] {
        let output = rpfd([command, "--help"]);
        assert_eq!(output.status.code(), Some(0));
        let help = String::from_utf8(output.stdout).unwrap();
        assert!(help.contains("Examples:") && help.contains(&format!("rpfd {command} ")), "{help}");
    }
    assert!(String::from_utf8(rpfd(["filter", "--help"]).stdout).unwrap().contains("paper-fast"));
    assert_eq!(rpfd(["--version"]).stdout, format!("rpfd {}\n", env!("CARGO_PKG_VERSION")).into_bytes());
}

#[test]
fn an_interrupt_leaves_nothing_behind() {
    let folder = Folder::new();
    let args = ["synth", "--size", "4000x4000", "--spp", "16", "--json", "-o"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_rpfd"));
    let child = child.args(args).arg(folder.path("out.tiles")).stderr(std::process::Stdio::piped()).spawn().unwrap();
    while folder.names().is_empty() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(stderr(&output).contains("interrupted"));
    assert_eq!(folder.names(), [""; 0]);
}

/// As in `rpfd inspect FILE | head -n 1`.
#[test]
fn a_reader_that_goes_is_no_failure() {
    let command = format!("'{}' inspect '{}' | true", env!("CARGO_BIN_EXE_rpfd"), data("small.tiles.zst").display());
    let output = Command::new("sh").args(["-c", &command]).output().unwrap();
    assert!(output.status.success());
    assert_eq!(stderr(&output), "");
}

/// Whoever reads standard output may have seen enough, like `head`: that is no failure.
#[test]
fn nobody_has_to_read_to_the_end() {
    let small = format!("{}={}", data("small.tiles.zst").display(), data("small.reference.exr").display());
    let tiles = data("small.tiles.zst").display().to_string();
    for args in [
        &["stability", "--case", "image-1x1", "--preset", "lean"][..],
        &["stability", "--case", "image-1x1", "--preset", "lean", "--json"],
        &["report", "--data", &small, "--preset", "unfiltered"],
        &["report", "--data", &small, "--preset", "unfiltered", "--json"],
        &["inspect", &tiles],
    ] {
        let piped = std::process::Stdio::piped;
        let mut child = Command::new(env!("CARGO_BIN_EXE_rpfd"));
        let mut child = child.args(args).stdout(piped()).stderr(piped()).spawn().unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{args:?}: {}", stderr(&output));
    }
}
