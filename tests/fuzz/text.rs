//! What people write: sizes and parameters.

use super::{alone, fuzz, mutate::Random, mutate::mutate};
use rpfd::{
    config::ByteSize,
    filter::{Method, method::PRESETS},
};

/// Texts, changed at random; still texts.
pub(super) fn make(random: &mut Random, examples: &[&str], words: &[&str]) -> Vec<u8> {
    let others: Vec<Vec<u8>> = examples.iter().map(|example| example.as_bytes().to_vec()).collect();
    let words: Vec<&[u8]> = words.iter().map(|word| word.as_bytes()).collect();
    let mut bytes = random.pick(&others).clone();
    mutate(&mut bytes, random, &others, &words);
    String::from_utf8_lossy(&bytes).into_owned().into_bytes()
}

#[test]
fn sizes() {
    let alone = alone();
    let examples =
        ["0", "1048576", "512MiB", "2 GiB", "1.5GiB", "0.1KiB", "64kB", "16777215TiB", "18446744073709551615B"];
    let words = [".", "9", "TiB", "e", "-", " ", "99999999999999999999"];
    let reached = fuzz(
        &alone,
        "size",
        10,
        |random| make(random, &examples, &words),
        |bytes, _| {
            let text = std::str::from_utf8(bytes).unwrap();
            match text.parse::<ByteSize>() {
                // What it says of itself is itself.
                Ok(size) => {
                    assert_eq!(size.to_string().parse(), Ok(size));
                    "a size"
                }
                Err(error) => {
                    assert!(error.to_string().contains("512MiB"));
                    "no size"
                }
            }
        },
    );
    assert_eq!(reached.len(), 2);
}

#[test]
fn parameters() {
    let alone = alone();
    let mut examples: Vec<String> = Vec::new();
    for (preset, _) in PRESETS {
        let parameters = Method::preset(preset).unwrap().parameters();
        let settings: Vec<_> = parameters.iter().map(|(name, value)| format!("&{name}={value}")).collect();
        examples.push(format!("{preset}{}", settings.concat()));
        examples.extend(settings.iter().map(|setting| format!("{preset}{setting}")));
    }
    let examples: Vec<&str> = examples.iter().map(String::as_str).collect();
    let words = ["&", "=", ",", "17", "0", "-1", "1e9", "nan", "inf", "on", "off", "4294967297", "0.5", "55"];
    let reached = fuzz(
        &alone,
        "method",
        10,
        |random| make(random, &examples, &words),
        |bytes, _| {
            let text = std::str::from_utf8(bytes).unwrap();
            let mut parts = text.split('&');
            let preset = parts.next().unwrap();
            match Method::with(preset, parts.map(|part| part.split_once('=').unwrap_or((part, "")))) {
                // What it says of itself is itself, and how far it reaches has a bound.
                Ok(method) => {
                    assert_eq!(Method::with(preset, method.parameters()).as_ref(), Ok(&method));
                    assert!(method.reach(true) < 1 << 16);
                    "a method"
                }
                Err(error) => {
                    assert!(!error.to_string().is_empty());
                    "no method"
                }
            }
        },
    );
    assert_eq!(reached.len(), 2);
}
