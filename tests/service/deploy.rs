//! What `deploy/` names is there, and its files are what their own tools want.

use super::{Server, has, whole};
use crate::{
    cli::{rpfd, stderr},
    wire::interop::run_python,
};
use rpfd::config::{ByteSize, Config};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    process::Command,
};

fn deploy() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy")
}

/// All files of a folder and those in it, with their texts.
fn files(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut all = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(files(&path))
        } else {
            all.push((path.clone(), std::fs::read_to_string(path).unwrap()))
        }
    }
    all
}

/// The words of a text that start so and go on in these characters.
fn words<'a>(text: &'a str, start: &str, more: fn(char) -> bool) -> BTreeSet<&'a str> {
    let ends = |at: usize| text[at + start.len()..].find(|c| !more(c)).map_or(text.len(), |len| at + start.len() + len);
    let begins = |at: &usize| !text[..*at].ends_with(|c: char| c.is_ascii_alphanumeric() || "_-/.".contains(c));
    text.match_indices(start)
        .map(|(at, _)| at)
        .filter(begins)
        .map(|at| text[at..ends(at)].trim_end_matches('_'))
        .collect()
}

#[test]
fn flags_variables_and_keys_exist() {
    let known = String::from_utf8(rpfd(["serve", "--print-config"]).stdout).unwrap();
    let upper = |c: char| c.is_ascii_uppercase() || c == '_';
    let variables = words(&known, "RPFD_", upper);
    assert!(variables.len() > 15);
    let mut seen = 0;
    for (path, text) in files(&deploy()) {
        for variable in words(&text, "RPFD_", upper) {
            assert!(variables.contains(variable), "{}: {variable}", path.display());
            seen += 1;
        }
        // As far as a command goes.
        for command in text.split("rpfd serve").skip(1).map(|rest| rest.split(['\n', '`', ';']).next().unwrap()) {
            for flag in words(command, "--", |c| c.is_ascii_lowercase() || c == '-') {
                assert!(
                    known.contains(&format!("{flag},")) || ["--config", "--print-config"].contains(&flag),
                    "{}: {flag}",
                    path.display()
                );
                seen += 1;
            }
        }
    }
    assert!(seen > 15, "{seen}");
    let file = deploy().join("rpfd.toml");
    let output = rpfd(["serve", "--print-config", "--config", file.to_str().unwrap()]);
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn metrics_exist() {
    let server = Server::start(&["--metrics-listen", "127.0.0.1:0"]);
    server.post("/v1/filter", &whole(16)).messages();
    server.get("/nowhere");
    let metrics = server.metrics();
    let lower = |c: char| c.is_ascii_lowercase() || c == '_';
    let there: BTreeSet<_> = metrics
        .lines()
        .filter(|line| !line.starts_with('#'))
        .filter_map(|line| line.split(['{', ' ']).next())
        .collect();
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/http.md");
    let documented = std::fs::read_to_string(&docs).unwrap();
    let told = documented.split("## Metrics").nth(1).unwrap().split("\n## ").next().unwrap().to_owned();
    let mut texts = files(&deploy().join("prometheus"));
    texts.push((docs, told.clone()));
    for (path, text) in texts {
        for name in words(&text, "rpfd_", lower) {
            let fine = there.contains(name)
                || ["_bucket", "_count"].iter().any(|end| there.contains(format!("{name}{end}").as_str()));
            assert!(fine, "{}: {name}", path.display());
        }
    }
    // And all that there are are told of.
    for name in there {
        let base = ["_bucket", "_count", "_sum"].iter().fold(name, |name, end| name.strip_suffix(end).unwrap_or(name));
        assert!(told.contains(&format!("`{base}")), "{base} is not in proto/http.md");
    }
}

/// Runs a tool in a folder of `deploy`, which must be content.
fn content(tool: &str, folder: &str, arguments: &[&str]) {
    let output = Command::new(tool).args(arguments).current_dir(deploy().join(folder)).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned() + &stderr(&output);
    assert!(output.status.success(), "{tool} {arguments:?}: {said}");
}

#[test]
fn alerts_go_off_when_they_should() {
    if has("promtool", "--version") {
        content("promtool", "prometheus", &["check", "config", "prometheus.yml"]);
        content("promtool", "prometheus", &["test", "rules", "alerts.test.yml"]);
    }
}

#[test]
fn the_dockerfile_is_as_hadolint_wants_it() {
    if has("hadolint", "--version") {
        content("hadolint", "", &["Dockerfile"]);
    }
}

#[test]
fn the_manifests_fit_their_schemas() {
    if has("kubernetes-validate", "--version") {
        content("kubernetes-validate", "kubernetes", &["--strict", "rpfd.yaml"]);
    }
    let script = "import sys, yaml\nprint(len([list(yaml.safe_load_all(open(path))) for path in sys.argv[1:]]))";
    let paths: Vec<_> = files(&deploy())
        .into_iter()
        .map(|(path, _)| path)
        .filter(|path| path.extension().is_some_and(|e| e == "yaml" || e == "yml"))
        .collect();
    let arguments: Vec<&Path> = std::iter::once(script.as_ref()).chain(paths.iter().map(PathBuf::as_path)).collect();
    if let Some(output) = run_python("yaml", "-c".as_ref(), &arguments) {
        assert!(output.status.success() && String::from_utf8(output.stdout).unwrap().trim() == paths.len().to_string());
    }
}

/// The value of a setting where it is put like this.
fn value(path: &str, before: &str) -> ByteSize {
    let text = std::fs::read_to_string(deploy().join(path)).unwrap();
    let rest = text.split(before).nth(1).unwrap_or_else(|| panic!("{path}: no {before}"));
    let word = rest.trim_start().split(['"', '}', '\n']).next().unwrap().trim();
    // Kubernetes, Docker and systemd write units like this.
    let unit = word.trim_start_matches(|c: char| c.is_ascii_digit()).to_uppercase();
    let unit = if ["M", "G", "MI", "GI"].contains(&&*unit) { format!("{}iB", &unit[..1]) } else { String::new() };
    let number = word.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    if unit.is_empty() { word.parse().unwrap() } else { format!("{number}{unit}").parse().unwrap() }
}

#[test]
fn there_is_as_much_memory_and_disk_as_the_service_is_told() {
    for (memory, limit) in [
        (value("kubernetes/rpfd.yaml", "RPFD_MEMORY, value:"), value("kubernetes/rpfd.yaml", "limits: {memory:")),
        (value("compose.yaml", "RPFD_MEMORY:"), value("compose.yaml", "mem_limit:")),
        (value("rpfd.toml", "memory = \""), value("systemd/rpfd.service", "MemoryMax=")),
    ] {
        assert!(memory.0 + (64 << 20) < limit.0, "{memory} {limit}");
    }
    let default = Config::default();
    let beside = default.unread_results.0 + default.disk_reserve.0;
    let (disk, volume) =
        (value("kubernetes/rpfd.yaml", "RPFD_DISK, value:"), value("kubernetes/rpfd.yaml", "requests: {storage:"));
    // A file system keeps a twentieth.
    assert!(disk.0 + beside < volume.0 / 20 * 19, "{disk} {volume}");
    // And most of the volume is of use.
    assert!(disk.0 > volume.0 / 5 * 4, "{disk} {volume}");
    let told = |name: &str| value("rpfd.toml", &format!("\n{name} = \""));
    assert_eq!((told("unread_results"), told("disk_reserve")), (default.unread_results, default.disk_reserve));
    assert_eq!((told("disk"), value("compose.yaml", "RPFD_DISK:")), (default.disk, default.disk));
}

#[test]
fn the_unit_is_hardened() {
    if !has("systemd-analyze", "--version") {
        return;
    }
    content("systemd-analyze", "systemd", &["security", "--offline=true", "--threshold=20", "rpfd.service"]);
    // With what this machine lacks, the user and the program, replaced.
    let folder = tempfile::tempdir().unwrap();
    let unit = folder.path().join("rpfd.service");
    let text = std::fs::read_to_string(deploy().join("systemd/rpfd.service")).unwrap();
    assert!(text.contains("ExecStart=/usr/local/bin/rpfd "));
    std::fs::write(&unit, text.replace("/usr/local/bin/rpfd", "/bin/true")).unwrap();
    content("systemd-analyze", "systemd", &["verify", unit.to_str().unwrap()]);
}
