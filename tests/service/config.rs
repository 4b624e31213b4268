//! The configuration: file, environment and flags of the real binary.

use crate::cli::{Folder, stderr};
use std::process::{Command, Output};

fn serve(arguments: &[&str], environment: &[(&str, &str)]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rpfd"))
        .arg("serve")
        .args(arguments)
        .envs(environment.iter().copied())
        .output()
        .unwrap()
}

fn printed(arguments: &[&str], environment: &[(&str, &str)]) -> String {
    let output = serve(&[arguments, &["--print-config"]].concat(), environment);
    assert!(output.status.success(), "{}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// The settings, without comments.
fn settings(printed: &str) -> Vec<&str> {
    printed.lines().filter(|line| !line.starts_with('#') && !line.is_empty()).collect()
}

#[test]
fn what_is_printed_is_in_force_and_is_read_again() {
    let folder = Folder::new();
    let (file, again) = (folder.path("rpfd.toml"), folder.path("again.toml"));
    std::fs::write(&file, "memory = \"3GiB\"\nthreads = 3\nimages = 4\n").unwrap();
    let first = printed(
        &["--config", &file, "--images", "6", "--insecure-no-auth"],
        &[("RPFD_THREADS", "5"), ("RPFD_IMAGES", "5")],
    );
    for line in ["memory = \"3GiB\"", "threads = 5", "images = 6", "insecure_no_auth = true", "idle_deadline = \"30s\""]
    {
        assert!(first.lines().any(|l| l == line), "{line}: {first}");
    }
    assert!(first.contains("set by environment RPFD_THREADS") && first.contains("line 1"), "{first}");
    std::fs::write(&again, &first).unwrap();
    assert_eq!(settings(&printed(&["--config", &again], &[])), settings(&first));
    // The environment may name the file.
    assert_eq!(settings(&printed(&[], &[("RPFD_CONFIG", &again)])), settings(&first));
}

#[test]
fn secrets_are_not_printed() {
    let text =
        printed(&["--token-file", "/etc/rpfd/tokens.toml"], &[("RPFD_TOKEN", "correct-horse-battery-staple-1234")]);
    assert!(text.contains("token_file = \"/etc/rpfd/tokens.toml\"") && !text.contains("correct-horse"), "{text}");
}

#[test]
fn all_that_is_wrong_is_told_at_once() {
    let folder = Folder::new();
    let file = folder.path("rpfd.toml");
    std::fs::write(&file, "memroy = 1\nthreads = 0\nqueue_deadline = \"soon\"\n").unwrap();
    let output = serve(&["--config", &file, "--listen", "0.0.0.0:0", "--images", "many"], &[("RPFD_CONECTIONS", "1")]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    for part in [
        "line 1: there is no setting \"memroy\": memory is meant?",
        "line 2: threads = 0: must be 1 to 1024",
        "line 3: queue_deadline: \"soon\" is no time",
        "flag --images: images: \"many\": must be a whole number",
        "environment RPFD_CONECTIONS: there is no setting \"conections\": connections is meant?",
        "flag --listen: listen = \"0.0.0.0:0\": whoever reaches this address",
        "(bad_config)",
    ] {
        assert!(said.contains(part), "{part}\n{said}");
    }
    assert_eq!(said.trim().lines().count(), 6, "{said}");
    let missing = folder.path("missing.toml");
    assert_eq!(serve(&["--config", &missing], &[]).status.code(), Some(2));
}

#[test]
fn what_kubernetes_sets_for_a_service_is_no_mistake() {
    printed(
        &[],
        &[("RPFD_SERVICE_HOST", "10.0.0.1"), ("RPFD_PORT", "tcp://10.0.0.1:80"), ("RPFD_PORT_80_TCP_ADDR", "10.0.0.1")],
    );
}
