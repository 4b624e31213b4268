//! The rows as text, CSV and JSON. Units are in the headings: seconds per megapixel of the image, MiB, dB.

use super::{
    machine::Machine,
    rows::{Row, Slope, Spread},
    scores::{COLUMNS, number},
};
use serde_json::{Value, json};
use std::fmt::Write;

/// Significant digits enough to compare by eye.
pub fn short(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if !value.is_finite() => value.to_string(),
        0.0 => "0".to_owned(),
        1e6.. => format!("{value:.2e}"),
        100.0.. => format!("{value:.0}"),
        10.0.. => format!("{value:.1}"),
        1.0.. => format!("{value:.2}"),
        1e-4.. => format!("{value:.*}", (2 - size.log10().floor() as i32).clamp(0, 9) as usize),
        _ => format!("{value:.2e}"),
    }
}

/// Median, and the least and greatest where it was measured several times.
pub fn spread(spread: &Spread, repeats: usize) -> String {
    let Spread { median, min, max } = spread;
    match repeats {
        1 => short(*median),
        _ => format!("{} ({}-{})", short(*median), short(*min), short(*max)),
    }
}

fn mebibytes(bytes: u64) -> String {
    short(bytes as f64 / f64::from(1 << 20))
}

/// Headings, and rows of as many cells.
pub type Table = (Vec<&'static str>, Vec<Vec<String>>);

/// The headings and cells to read; `seconds_per_sample` is what a sample per pixel takes to render, per megapixel.
pub fn cells(rows: &[Row], seconds_per_sample: Option<f64>) -> Table {
    let mut headings = vec![
        "data set",
        "spp",
        "method",
        "threads",
        "relMSE",
        "trimmed",
        "MSE",
        "PSNR dB",
        "SMAPE",
        "SSIM",
        "FLIP",
        "energy",
        "non-finite",
        "CPU s/Mpx",
        "wall s/Mpx",
        "plan MiB",
        "peak MiB",
        "front",
        "equal spp",
    ];
    if seconds_per_sample.is_some() {
        headings.extend(["total s/Mpx", "plain s/Mpx", "plain relMSE"]);
    }
    let cells = rows.iter().map(|row| {
        let score = |name| short(row.scores.get(name));
        let mut cells = vec![
            row.key.data.clone(),
            row.key.spp.to_string(),
            row.label.clone(),
            row.key.threads.to_string(),
            short(row.relmse()),
            score("relmse_trimmed"),
            short(row.mse()),
            format!("{:.2}", row.scores.get("psnr")),
            score("smape"),
            format!("{:.4}", row.scores.get("ssim")),
            format!("{:.4}", row.scores.get("flip")),
            format!("{:.4}", row.scores.get("energy")),
            row.scores.get("nonfinite").to_string(),
            spread(&row.cpu, row.repeats),
            spread(&row.wall, row.repeats),
            mebibytes(row.planned),
            row.peak.map_or_else(|| "-".to_owned(), mebibytes),
            if row.pareto { "yes" } else { "" }.to_owned(),
            row.equal_spp.map_or_else(|| "-".to_owned(), short),
        ];
        if let Some(seconds) = seconds_per_sample {
            cells.push(short(row.cost(seconds)));
            cells.push(row.equal_spp.map_or_else(|| "-".to_owned(), |spp| short(spp * seconds)));
            cells.push(row.plain_relmse(seconds).map_or_else(|| "-".to_owned(), short));
        }
        cells
    });
    (headings, cells.collect())
}

/// A table of fixed-width text.
pub fn text((headings, cells): &Table) -> String {
    let width = |column: usize| {
        let widths = cells.iter().map(|row| row[column].chars().count());
        widths.chain([headings[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..headings.len()).map(width).collect();
    let mut out = String::new();
    let mut line = |cells: &[&str]| {
        let padded = cells.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| match column {
            _ if matches!(headings[column], "data set" | "method" | "planes") => format!("{cell:<width$}"),
            _ => format!("{cell:>width$}"),
        });
        let _ = writeln!(out, "{}", padded.collect::<Vec<_>>().join("  ").trim_end());
    };
    line(headings);
    cells.iter().for_each(|row| line(&row.iter().map(String::as_str).collect::<Vec<_>>()));
    out
}

/// What a tolerance gains and costs: headings, and a row of cells for each method that was measured with and without.
fn tolerances(rows: &[Row]) -> Table {
    let headings = vec![
        "data set",
        "spp",
        "method",
        "threads",
        "relMSE",
        "without",
        "change",
        "estimated",
        "CPU s/Mpx",
        "without",
        "time",
        "settled",
    ];
    let cells = rows.iter().filter_map(|row| {
        let without = row.without_tolerance(rows)?;
        Some(vec![
            row.key.data.clone(),
            row.key.spp.to_string(),
            row.label.clone(),
            row.key.threads.to_string(),
            short(row.relmse()),
            short(without.relmse()),
            format!("{:+.2e}", row.relmse() - without.relmse()),
            format!("{:+.2e}", row.spared.settled_error),
            spread(&row.cpu, row.repeats),
            spread(&without.cpu, without.repeats),
            format!("{:.2} x", row.cpu.median / without.cpu.median),
            format!("{:.1} %", 100.0 * row.spared.settled),
        ])
    });
    (headings, cells.collect())
}

/// Names of planes; components that follow each other as `P.0-2`.
fn runs(planes: &[&str]) -> String {
    let mut runs: Vec<(&str, &str, &str)> = Vec::new();
    for plane in planes {
        let (channel, component) = plane.rsplit_once('.').unwrap_or((plane, ""));
        let follows = |last: &str| last.parse::<u32>().ok().map(|last| last + 1) == component.parse().ok();
        match runs.last_mut() {
            Some((known, _, last)) if *known == channel && !component.is_empty() && follows(last) => *last = component,
            _ => runs.push((channel, component, component)),
        }
    }
    let names = runs.into_iter().map(|(channel, first, last)| match () {
        () if first.is_empty() => channel.to_owned(),
        () if first == last => format!("{channel}.{first}"),
        () => format!("{channel}.{first}-{last}"),
    });
    names.collect::<Vec<_>>().join(", ")
}

/// What was left out: headings, and a row of cells for each data set and method that left out anything.
fn left_out(rows: &[Row]) -> Table {
    let mut cells: Vec<Vec<String>> = Vec::new();
    for row in rows.iter().filter(|row| !row.spared.planes.is_empty()) {
        let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
        for (plane, reason) in &row.spared.planes {
            match reasons.iter_mut().find(|(known, _)| known == reason) {
                Some((_, planes)) => planes.push(plane),
                None => reasons.push((reason, vec![plane])),
            }
        }
        let told: Vec<_> = reasons.iter().map(|(reason, planes)| format!("{reason}: {}", runs(planes))).collect();
        let one = vec![
            row.key.data.clone(),
            row.key.spp.to_string(),
            row.label.clone(),
            row.spared.work.map_or_else(|| "-".to_owned(), |share| format!("{:.1} %", 100.0 * share)),
            mebibytes(row.spared.bytes),
            told.join("; "),
        ];
        // Threads change nothing here.
        if !cells.contains(&one) {
            cells.push(one);
        }
    }
    (vec!["data set", "spp", "method", "work saved", "planes MiB", "planes"], cells)
}

/// What stands beside the main table, where there is any of it: a title, the table, and what its headings mean.
pub fn others(rows: &[Row]) -> impl Iterator<Item = (&'static str, Table, &'static str)> {
    let all = [
        ("With and without a tolerance", tolerances(rows), TOLERANCE_NOTE),
        ("Left out", left_out(rows), LEFT_OUT_NOTE),
    ];
    all.into_iter().filter(|(_, (_, cells), _)| !cells.is_empty())
}

/// What the headings of [`cells`] mean, and what is to be said of these rows.
pub fn notes(rows: &[Row], seconds_per_sample: Option<f64>) -> Vec<String> {
    let mut notes = NOTES.map(str::to_owned).to_vec();
    if let Some(seconds) = seconds_per_sample {
        notes.push(format!(
            "{TOTAL_NOTE} To render one sample per pixel is taken to cost {seconds} CPU s per megapixel: given, not measured."
        ));
    }
    let unlike = rows.iter().filter(|row| !row.repeatable);
    notes.extend(
        unlike.map(|row| {
            format!("NOT REPEATABLE: the errors of {} on {} differ between repeats", row.label, row.key.data)
        }),
    );
    notes
}

const NOTES: [&str; 5] = [
    "relMSE and MSE are less the reference's own error where that is known; the trimmed relMSE is not.",
    "CPU and wall: seconds of the filter alone per megapixel (10^6 pixels), over all threads and by the clock; the median of \
     the repeats (least-greatest).",
    "plan: what the filter said it would need, samples included; peak: greatest resident size of the whole process meanwhile; \
     both in MiB (2^20 bytes), for the image as one tile.",
    "front: no other method on the same data set, samples and threads has as little relMSE in as little CPU time, and less \
     of one.",
    "equal spp: plain samples per pixel whose mean would have the same relMSE, from the unfiltered error's slope: measured \
     where there are several sample counts, else -1.",
];

const TOTAL_NOTE: &str = "total, plain: CPU seconds per megapixel to render the samples and filter them, and to render the plain samples of equal \
     error; plain relMSE: that of as many plain samples as could be rendered in the total time.";

/// What the headings of [`tolerances`] mean.
const TOLERANCE_NOTE: &str = "settled: pixels that were passed through, since their own samples and those around them say \
     that filtering can take less than the tolerance off their relMSE; estimated: what that adds to the image's relMSE at \
     most, on average; change: what it did add, with what other pixels draw from those that were passed through.";

/// What the headings of [`left_out`] mean.
const LEFT_OUT_NOTE: &str = "No bit of a result depends on it. work saved: of the filter's steps, by estimate; columns that are \
     constant over a neighbourhood only, and differences that weigh nothing, are counted as well. constant: equal in every \
     sample; missing: no sample has it; unused: the method does not look at it; equal: as an earlier colour plane.";

/// What the errors are.
pub fn formulas() -> String {
    let lines = COLUMNS.iter().map(|column| format!("{}: {}\n", column.title, column.formula));
    format!("{FORMULAS_NOTE}\n{}", lines.collect::<String>())
}

/// What the formulas are of.
pub const FORMULAS_NOTE: &str =
    "x is the filtered image, r the reference, both linear RGB; means are over pixels and channels.";

/// All numbers with all their digits, one row on a line (RFC 4180). Empty is unknown.
pub fn csv(rows: &[Row], seconds_per_sample: Option<f64>) -> String {
    let columns = COLUMNS.iter().map(|column| column.name);
    let mut out = ["data", "crop", "spp", "method", "parameters", "threads", "seed"]
        .into_iter()
        .chain(columns)
        .collect::<Vec<_>>()
        .join(",");
    out += ",relmse_less_own,mse_less_own,own_relmse,own_mse,repeats,cpu_s_per_mpx,cpu_s_per_mpx_min,cpu_s_per_mpx_max,\
            wall_s_per_mpx,wall_s_per_mpx_min,wall_s_per_mpx_max,planned_bytes,peak_resident_bytes,pareto,\
            unfiltered_slope,slope_is,equal_spp,total_s_per_mpx,plain_s_per_mpx,plain_relmse_at_total,\
            left_out,left_out_bytes,work_saved,settled,settled_error\n";
    for row in rows {
        let known = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
        let mut cells = vec![
            quoted(&row.key.data),
            row.key.crop.map(|v| v.to_string()).join(" "),
            row.key.spp.to_string(),
            quoted(&row.label),
            quoted(&row.key.parameters.join(" ")),
            row.key.threads.to_string(),
            row.key.seed.to_string(),
        ];
        cells.extend(row.scores.0.iter().map(f64::to_string));
        cells.extend([row.relmse(), row.mse()].map(|v| v.to_string()));
        cells.extend([known(row.own.relmse), known(row.own.mse), row.repeats.to_string()]);
        for Spread { median, min, max } in [row.cpu, row.wall] {
            cells.extend([median, min, max].map(|v| v.to_string()));
        }
        cells.push(row.planned.to_string());
        cells.push(row.peak.map(|peak| peak.to_string()).unwrap_or_default());
        cells.push(row.pareto.to_string());
        cells.push(row.slope.value().to_string());
        cells.push(slope_is(row.slope).to_owned());
        cells.push(known(row.equal_spp));
        cells.push(known(seconds_per_sample.map(|seconds| row.cost(seconds))));
        cells.push(known(seconds_per_sample.and_then(|seconds| Some(seconds * row.equal_spp?))));
        cells.push(known(seconds_per_sample.and_then(|seconds| row.plain_relmse(seconds))));
        let spared = &row.spared;
        let planes: Vec<_> = spared.planes.iter().map(|(plane, reason)| format!("{plane} {reason}")).collect();
        cells.extend([quoted(&planes.join("; ")), spared.bytes.to_string(), known(spared.work)]);
        cells.extend([spared.settled, spared.settled_error].map(|v| v.to_string()));
        out += &cells.join(",");
        out += "\n";
    }
    out
}

const fn slope_is(slope: Slope) -> &'static str {
    match slope {
        Slope::Fitted(_) => "fitted",
        Slope::Assumed => "assumed",
    }
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\r', '\n']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// All numbers as JSON; what JSON has no numbers for is in words, and what is unknown `null`.
pub fn json(rows: &[Row], seconds_per_sample: Option<f64>, machine: &Machine) -> Value {
    let spread = |Spread { median, min, max }: Spread| json!({ "median": median, "min": min, "max": max });
    let one = |row: &Row| {
        json!({
            "data": row.key.data,
            "crop": row.key.crop,
            "spp": row.key.spp,
            "method": row.label,
            "preset": row.key.preset,
            "parameters": row.key.parameters,
            "threads": row.key.threads,
            "seed": row.key.seed,
            "errors": row.scores.to_json(),
            "relmse_less_own": number(row.relmse()),
            "mse_less_own": number(row.mse()),
            "own_relmse": row.own.relmse,
            "own_mse": row.own.mse,
            "repeats": row.repeats,
            "repeatable": row.repeatable,
            "cpu_seconds_per_megapixel": spread(row.cpu),
            "wall_seconds_per_megapixel": spread(row.wall),
            "planned_bytes": row.planned,
            "left_out": row.spared.planes.iter().map(|(plane, reason)| json!({ "plane": plane, "reason": reason })).collect::<Vec<_>>(),
            "left_out_bytes": row.spared.bytes,
            "work_saved": row.spared.work,
            "settled": row.spared.settled,
            "settled_error": row.spared.settled_error,
            "peak_resident_bytes": row.peak,
            "pareto": row.pareto,
            "unfiltered_slope": { "value": row.slope.value(), "is": slope_is(row.slope) },
            "equal_spp": row.equal_spp,
            "total_seconds_per_megapixel": seconds_per_sample.map(|seconds| row.cost(seconds)),
            "plain_seconds_per_megapixel": seconds_per_sample.and_then(|seconds| Some(seconds * row.equal_spp?)),
            "plain_relmse_at_total": seconds_per_sample.and_then(|seconds| row.plain_relmse(seconds)),
        })
    };
    let formulas = COLUMNS.iter().map(|c| (c.name.to_owned(), c.formula.into())).collect::<serde_json::Map<_, _>>();
    json!({
        "machine": machine,
        "formulas": formulas,
        "seconds_per_sample_per_megapixel": seconds_per_sample,
        "rows": rows.iter().map(one).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let known =
            [(0.0, "0"), (0.012345, "0.0123"), (0.5, "0.500"), (3.1234, "3.12"), (31.4159, "31.4"), (31415.9, "31416")];
        for (value, expected) in known.into_iter().chain([(1e-7, "1.00e-7"), (f64::NAN, "NaN"), (-0.0123, "-0.0123")]) {
            assert_eq!(short(value), expected);
        }
    }

    #[test]
    fn components_that_follow_each_other_are_told_together() {
        let planes = ["film.0", "film.1", "P.0", "P.2", "time", "a.b", "N.0", "N.1", "N.2"];
        assert_eq!(runs(&planes), "film.0-1, P.0, P.2, time, a.b, N.0-2");
        assert_eq!(runs(&[]), "");
    }

    #[test]
    fn csv_quotes_what_needs_it() {
        assert_eq!(quoted("a b"), "a b");
        assert_eq!(quoted("a,\"b\""), "\"a,\"\"b\"\"\"");
    }
}
