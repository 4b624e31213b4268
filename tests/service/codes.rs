//! The codes that `proto/http.md` lists are those that the service has: no more, no fewer, each with its status.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
    sync::LazyLock,
};

fn read(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

/// The table of problems: the status of each code.
static DOCUMENTED: LazyLock<BTreeMap<String, u16>> = LazyLock::new(|| {
    let mut table = BTreeMap::new();
    for line in read("proto/http.md").lines() {
        let cells: Vec<_> = line.split('|').map(str::trim).collect();
        if let [_, code, status, _, ..] = cells[..]
            && let (Some(code), Ok(status)) = (code.strip_prefix('`').and_then(|c| c.strip_suffix('`')), status.parse())
        {
            assert!(table.insert(code.to_owned(), status).is_none(), "{code} is listed twice");
        }
    }
    table
});

/// Checks that a problem that the service has sent is in the table.
#[track_caller]
pub(crate) fn check_documented(code: &str, status: u16) {
    assert_eq!(DOCUMENTED.get(code), Some(&status), "{code} with status {status} is not what proto/http.md lists");
}

/// The text in quotes at the start of `source`, if it is a code.
fn literal(source: &str) -> Option<String> {
    let word = source.trim_start().strip_prefix('"')?.split('"').next()?;
    let fine = !word.is_empty() && word.bytes().all(|b| b.is_ascii_lowercase() || b"_-".contains(&b));
    fine.then(|| word.replace('-', "_"))
}

/// Codes behind every occurrence of a text in a source.
fn behind<'a>(source: &'a str, text: &'a str) -> impl Iterator<Item = String> {
    source.match_indices(text).filter_map(move |(at, _)| literal(&source[at + text.len()..]))
}

/// Reads the sources, where each code is written out beside its status or in a `code()` of an error.
#[test]
fn the_table_is_what_the_sources_say() {
    let mut codes: BTreeMap<String, Option<u16>> = BTreeMap::new();
    let files = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/service")).unwrap();
    let mut files: BTreeSet<String> =
        files.map(|file| format!("src/service/{}", file.unwrap().file_name().into_string().unwrap())).collect();
    // Its errors are those of starting, not of answering.
    assert!(files.remove("src/service/mod.rs"));
    for file in &files {
        let source = read(file);
        let source = source.split("#[cfg(test)]").next().unwrap();
        for (name, status) in [
            ("BAD_REQUEST", 400),
            ("UNAUTHORIZED", 401),
            ("FORBIDDEN", 403),
            ("NOT_FOUND", 404),
            ("METHOD_NOT_ALLOWED", 405),
            ("NOT_ACCEPTABLE", 406),
            ("REQUEST_TIMEOUT", 408),
            ("CONFLICT", 409),
            ("PAYLOAD_TOO_LARGE", 413),
            ("UNSUPPORTED_MEDIA_TYPE", 415),
            ("UNPROCESSABLE_ENTITY", 422),
            ("INTERNAL_SERVER_ERROR", 500),
            ("SERVICE_UNAVAILABLE", 503),
            ("INSUFFICIENT_STORAGE", 507),
        ] {
            codes.extend(behind(source, &format!("StatusCode::{name},")).map(|code| (code, Some(status))));
        }
        // `Problem::new(404, "code", ...)`, on one line or several.
        for (at, new) in source.match_indices("new(") {
            let Some((status, rest)) = source[at + new.len()..].split_once(',') else { continue };
            if let (Ok(status), Some(code)) = (status.trim().parse(), literal(rest)) {
                codes.insert(code, Some(status));
            }
        }
        for short in ["refuse(", "bad("] {
            for code in behind(source, short) {
                codes.entry(code).or_insert(None);
            }
        }
    }
    for file in ["src/wire/error.rs", "src/admission/mod.rs", "src/stitch/mod.rs", "src/service/problem.rs"] {
        let source = read(file);
        let source = source.split("#[cfg(test)]").next().unwrap();
        for code in behind(source, "=> ") {
            codes.entry(code).or_insert(None);
        }
    }
    // The stitcher's own name for what the service calls `bad_geometry`.
    assert!(codes.remove("invalid_geometry").is_some());
    let (known, listed): (BTreeSet<_>, BTreeSet<_>) = (codes.keys().collect(), DOCUMENTED.keys().collect());
    assert_eq!(known, listed, "left: in the sources; right: in proto/http.md");
    for (code, status) in &codes {
        assert!(status.is_none_or(|status| DOCUMENTED[code] == status), "{code} has the status {status:?}");
    }
}

/// What a reader of tiles calls its faults, the service calls them too.
#[test]
fn the_codes_of_the_format_are_codes_of_the_service() {
    let text = read("proto/tile.md");
    let table = text.split("## Codes").nth(1).unwrap();
    let words = table.lines().filter_map(|line| line.strip_prefix("| `")?.split('|').next());
    let codes: Vec<_> =
        words.flat_map(|cell| cell.split('`')).filter(|w| literal(&format!("\"{w}\"")).is_some()).collect();
    assert_eq!(codes.len(), 17, "{codes:?}");
    for code in codes {
        assert!(DOCUMENTED.contains_key(code), "{code}");
    }
}
