//! Costs as tables and plots.

use super::super::{
    svg::{Mark, Panel, Series, draw, escape},
    table::{short, spread},
};
use super::{Axis, Cost, Costs, Growth, Memory, growth};
use serde_json::{Value, json};
use std::fmt::Write;

/// Cost against each axis that was measured, both logarithmic: a panel each, a colour for each preset and input.
pub fn panels(costs: &[Cost]) -> Vec<Panel> {
    let mut lines: Vec<(&str, &str)> = Vec::new();
    for cost in costs {
        let line = (&*cost.point.preset, &*cost.point.input);
        if !lines.contains(&line) {
            lines.push(line);
        }
    }
    let panel = |(axis, name, unit): (Axis, &str, &str)| {
        let here: Vec<&Cost> = costs.iter().filter(|cost| cost.point.axis == axis).collect();
        let mut series = Vec::new();
        for (color, (preset, input)) in lines.iter().enumerate() {
            let of = here.iter().filter(|cost| (&*cost.point.preset, &*cost.point.input) == (*preset, *input));
            let points: Vec<(f64, f64)> = of.map(|cost| (cost.point.x(), cost.seconds())).collect();
            if !points.is_empty() {
                let name = format!("{preset}, {input}");
                series.push(Series { name, color: color + 1, points: points.clone(), mark: Mark::Dots });
                series.push(Series { name: String::new(), color: color + 1, points, mark: Mark::Line });
            }
        }
        let (x, clock) = match axis {
            Axis::Simd => ("1 sse2, 2 sse4.2, 3 avx2, 4 avx512".to_owned(), "CPU"),
            Axis::Threads => (unit.to_owned(), "wall"),
            _ => (unit.to_owned(), "CPU"),
        };
        (!series.is_empty()).then(|| Panel {
            title: name.to_owned(),
            x,
            y: format!("{clock} seconds per megapixel"),
            series,
        })
    };
    Axis::ALL.into_iter().filter_map(panel).collect()
}

/// The plots alone.
pub fn svg(costs: &[Cost]) -> String {
    draw(&panels(costs), 3)
}

/// In words: `8 to 32 samples per pixel: 5.41 times (exponent 1.22)`.
fn words(growth: &Growth) -> String {
    let Growth { axis, from, to, ratio, exponent, .. } = growth;
    match axis {
        Axis::Threads => format!("{to} threads are {} times as fast as {from}", short(1.0 / ratio)),
        Axis::Simd => format!("the best SIMD level is {} times as fast as the lowest", short(1.0 / ratio)),
        _ => {
            let exponent = exponent.map_or_else(String::new, |e| format!(", as its power {e:.2}"));
            format!("{from} to {to} {}: {} times{exponent}", axis.unit(), short(*ratio))
        }
    }
}

/// In words, with the parts in bytes per sample.
fn memory_words(memory: &Memory) -> String {
    let Memory { preset, planes, size, samples, threads, .. } = memory;
    let mib = |bytes: u64| short(bytes as f64 / f64::from(1 << 20));
    let (all, threads_all) = (memory.planned_samples as f64, memory.planned_per_thread * u64::from(*threads));
    let planned = memory.planned_samples + memory.planned_working + memory.planned_output + threads_all;
    let resident = memory.resident.map_or_else(|| "not known".to_owned(), |bytes| format!("{} MiB", mib(bytes)));
    format!(
        "{preset}, {} x {} pixels, {samples} spp, {planes} planes: samples {} MiB, for the whole tile {} MiB more ({:.0} %), \
         for what comes out {} MiB, {} KiB on each of {threads} threads; {} MiB in all, resident {resident}",
        size[0],
        size[1],
        mib(memory.planned_samples),
        mib(memory.planned_working),
        100.0 * memory.planned_working as f64 / all,
        mib(memory.planned_output),
        memory.planned_per_thread >> 10,
        mib(planned),
    )
}

/// The headings and cells of the table.
fn cells(costs: &[Cost]) -> ([&'static str; 11], Vec<[String; 11]>) {
    let headings =
        ["axis", "preset", "input", "size", "spp", "features", "random", "threads", "SIMD", "CPU s/Mpx", "wall s/Mpx"];
    let row = |cost: &Cost| {
        let (point, [width, height]) = (&cost.point, cost.point.size);
        let axis = Axis::ALL.iter().find(|axis| axis.0 == point.axis).map_or("", |axis| axis.1);
        [
            axis.to_owned(),
            point.preset.clone(),
            point.input.clone(),
            format!("{width}x{height}"),
            point.samples.to_string(),
            point.features.to_string(),
            point.random.to_string(),
            point.threads.to_string(),
            point.simd.clone(),
            spread(&cost.cpu, cost.repeats),
            spread(&cost.wall, cost.repeats),
        ]
    };
    (headings, costs.iter().map(row).collect())
}

/// Tables of fixed-width text.
pub fn text(costs: &Costs) -> String {
    let (headings, rows) = cells(&costs.costs);
    let width = |column: usize| rows.iter().map(|row| row[column].len()).chain([headings[column].len()]).max();
    let widths: Vec<usize> = (0..headings.len()).filter_map(width).collect();
    let mut out = String::new();
    let mut line = |cells: [&str; 11]| {
        let padded = cells.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| match column {
            0..3 => format!("{cell:<width$}"),
            _ => format!("{cell:>width$}"),
        });
        let _ = writeln!(out, "{}", padded.collect::<Vec<_>>().join("  ").trim_end());
    };
    line(headings);
    rows.iter().for_each(|row| line(row.each_ref().map(String::as_str)));
    out += "\n";
    for found in growth(&costs.costs) {
        let _ = writeln!(out, "{}, {}: {}", found.preset, found.input, words(&found));
    }
    for memory in &costs.memory {
        let _ = writeln!(out, "{}", memory_words(memory));
    }
    out
}

/// Everything, growth included, which is not read again.
pub fn json(costs: &Costs) -> Value {
    json!({
        "machine": costs.machine, "costs": costs.costs, "memory": costs.memory, "growth": growth(&costs.costs),
    })
}

/// Reads what [`json()`] has made.
pub fn from_json(text: &str) -> Result<Costs, serde_json::Error> {
    serde_json::from_str(text)
}

/// A section of the report's page.
pub fn section(out: &mut String, costs: &Costs) {
    let machine = &costs.machine;
    let _ = writeln!(
        out,
        "<h2>What it costs, and how that grows</h2>\n<p class=\"note\">The synthetic scene in which everything varies, 8 spp \
         with 15 features and 7 random parameters (27 planes) on one thread, but for what is varied; both axes are \
         logarithmic. Tiles are filtered with the halo that they need, and what that costs is theirs. Measured on {}, SIMD \
         {}.</p>",
        escape(&machine.cpu),
        escape(&machine.simd)
    );
    *out += &svg(&costs.costs);
    *out += "<ul>\n";
    for found in growth(&costs.costs) {
        let _ = writeln!(out, "<li>{}, {}: {}</li>", escape(&found.preset), escape(&found.input), words(&found));
    }
    costs.memory.iter().for_each(|memory| *out += &format!("<li>{}</li>\n", escape(&memory_words(memory))));
    let (headings, rows) = cells(&costs.costs);
    *out += "</ul>\n<details><summary>All costs</summary>\n<div class=\"wide\"><table>\n<tr>";
    headings.iter().for_each(|heading| *out += &format!("<th>{heading}</th>"));
    *out += "</tr>\n";
    for row in rows {
        *out += "<tr>";
        row.iter().for_each(|cell| *out += &format!("<td>{}</td>", escape(cell)));
        *out += "</tr>\n";
    }
    *out += "</table></div></details>\n";
}
