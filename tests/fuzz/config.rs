//! Configuration files.

use super::{alone, fuzz, text::make};
use rpfd::config::{Config, load::load};
use std::path::Path;

#[test]
fn configurations() {
    let alone = alone();
    let printed = load([], [], None).unwrap().to_toml();
    let mut examples: Vec<&str> = printed.split_inclusive('\n').filter(|line| !line.starts_with('#')).collect();
    examples.push(&printed);
    examples.push("listen = \"0.0.0.0:80\"\ntoken_file = 'tokens'\nmetrics_listen = \"[::1]:0\"\n");
    examples.push("memory = \"1.5GiB\"\nidle_deadline = 0.5\nimages = 0x10\nlog = \"\"\"\nwarn\"\"\"\n");
    let words =
        ["=", "\"", "\n", "[x]", "{", "true", "0x", "-1", "1e9", "inf", "1979-05-27", "\\u0000", "'''", "#", "."];
    let file = tempfile::NamedTempFile::new().unwrap();
    let read = |path: &Path| load([], [], Some(path));
    let reached = fuzz(
        &alone,
        "config",
        10,
        |random| make(random, &examples, &words),
        |bytes, _| {
            std::fs::write(file.path(), bytes).unwrap();
            match read(file.path()) {
                // What it prints of itself is itself.
                Ok(loaded) => {
                    assert_eq!(loaded.config.validate(), Ok(()));
                    std::fs::write(file.path(), loaded.to_toml()).unwrap();
                    let again = read(file.path()).unwrap();
                    assert_eq!(again.config, loaded.config);
                    if loaded.config == Config::default() { "the defaults" } else { "a configuration" }
                }
                Err(error) => {
                    assert!(!error.0.is_empty() && error.0.iter().all(|line| !line.is_empty()));
                    "no configuration"
                }
            }
        },
    );
    assert_eq!(reached.len(), 3);
}
