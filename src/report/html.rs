//! The report as one page that needs nothing else: no scripts, no fonts, no files beside it.

use super::{
    cost::{self, Costs},
    machine::Machine,
    plots,
    rows::{BASE, Row},
    scores::COLUMNS,
    svg::{draw, escape},
    table,
};
use std::{collections::BTreeMap, fmt::Write};

/// What a page is made from.
#[derive(Clone, Debug)]
pub struct Page<'a> {
    /// The rows.
    pub rows: &'a [Row],
    /// Of each data set the middle of the reference, as a PNG in base64.
    pub references: &'a BTreeMap<String, String>,
    /// Where it was made.
    pub machine: &'a Machine,
    /// Seconds per megapixel that rendering one sample per pixel takes, if that was said.
    pub seconds_per_sample: Option<f64>,
    /// What filtering costs, if that was measured.
    pub cost: Option<&'a Costs>,
}

const STYLE: &str = "\
:root{color-scheme:light dark}
body{font:15px/1.5 sans-serif;margin:2rem auto;max-width:1080px;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.2rem;margin-top:2.2rem}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:12px;white-space:nowrap;font-variant-numeric:tabular-nums}
th,td{padding:.15rem .5rem;text-align:right;border-bottom:1px solid #8884}
.formulas td,.formulas th{white-space:normal;text-align:left;vertical-align:top}
.words.words{white-space:normal;text-align:left;min-width:24rem}
td:nth-child(1),td:nth-child(3),th:nth-child(1),th:nth-child(3){text-align:left}
tr.base td{opacity:.65}tr.front td:nth-child(3){font-weight:bold}
figure{display:inline-block;margin:0 .4rem .8rem 0;font-size:12px}
figure img{display:block;width:128px;image-rendering:pixelated}
svg{max-width:100%;height:auto}
small,.note{opacity:.75}
";

/// Writes the page.
pub fn page(page: &Page) -> String {
    let Machine { cpu, cores, simd, os, version } = page.machine;
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width\">\n<title>Error against run time</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<h1>Error against run time</h1>\n\
         <p>Made by {} on {}, {cores} processors, SIMD {}, {}. Errors are the same on any machine; times are this one's.</p>\n",
        escape(version),
        escape(cpu),
        escape(simd),
        escape(os)
    );
    out += "<h2>Error against time</h2>\n<p class=\"note\">Down and left is better; both axes are logarithmic. relMSE is less the \
            reference's own where that is known.</p>\n";
    out += &draw(&plots::error_time(page.rows), 3);
    let samples = plots::error_samples(page.rows);
    if !samples.is_empty() {
        out += "<h2>Error against samples</h2>\n<p class=\"note\">The slope of the line through the logarithms: -1 is what \
                independent samples give.</p>\n";
        samples.iter().for_each(|panel| out += &draw(std::slice::from_ref(panel), 2));
    }
    if let Some(costs) = page.cost {
        cost::show::section(&mut out, costs);
    }
    out += "<h2>Numbers</h2>\n";
    numbers(&mut out, page);
    for (title, (headings, cells), note) in table::others(page.rows) {
        let _ = writeln!(out, "<h2>{title}</h2>\n<p class=\"note\">{}</p>", escape(note));
        let rows: Vec<_> = cells.iter().map(|cells| ("", &cells[..])).collect();
        lay_out(&mut out, &headings, &rows);
    }
    out += "<h2>Pictures</h2>\n<p class=\"note\">The middle of each image at its most samples, at most 64 x 64 pixels, each \
            drawn twice as large: sRGB, exposure 0, clipped. A difference is |x - r|, shown the same way.</p>\n";
    pictures(&mut out, page);
    let _ = writeln!(
        out,
        "<h2>Formulas</h2>\n<p>{}</p>\n<div class=\"wide\"><table class=\"formulas\">",
        escape(table::FORMULAS_NOTE)
    );
    for column in COLUMNS {
        let _ = writeln!(out, "<tr><th>{}</th><td>{}</td></tr>", escape(column.title), escape(column.formula));
    }
    out += "</table></div>\n<h2>Methods</h2>\n<div class=\"wide\"><table class=\"formulas\">\n";
    let mut seen = Vec::new();
    for row in page.rows {
        if !seen.contains(&&row.label) {
            seen.push(&row.label);
            let parameters = row.key.parameters.join(", ");
            let _ = writeln!(
                out,
                "<tr><th>{}</th><td>seed {}{}{}</td></tr>",
                escape(&row.label),
                row.key.seed,
                if parameters.is_empty() { "" } else { "; " },
                escape(&parameters)
            );
        }
    }
    out += "</table></div>\n</body>\n</html>\n";
    out
}

/// A table; each row with its attributes.
fn lay_out(out: &mut String, headings: &[&str], rows: &[(&str, &[String])]) {
    *out += "<div class=\"wide\"><table>\n<thead><tr>";
    for heading in headings {
        let class = if *heading == "planes" { " class=\"words\"" } else { "" };
        let _ = write!(out, "<th{class}>{}</th>", escape(heading));
    }
    *out += "</tr></thead>\n<tbody>\n";
    for (attributes, cells) in rows {
        let _ = write!(out, "<tr{attributes}>");
        for (cell, heading) in cells.iter().zip(headings) {
            let class = if *heading == "planes" { " class=\"words\"" } else { "" };
            let _ = write!(out, "<td{class}>{}</td>", escape(cell));
        }
        *out += "</tr>\n";
    }
    *out += "</tbody></table></div>\n";
}

fn numbers(out: &mut String, page: &Page) {
    let (headings, cells) = table::cells(page.rows, page.seconds_per_sample);
    let class = |row: &Row| match (row.key.preset == BASE, row.pareto) {
        (true, _) => " class=\"base\"",
        (_, true) => " class=\"front\"",
        _ => "",
    };
    let rows: Vec<_> = page.rows.iter().zip(&cells).map(|(row, cells)| (class(row), &cells[..])).collect();
    lay_out(out, &headings, &rows);
    *out += "<ul class=\"note\">\n";
    let notes = table::notes(page.rows, page.seconds_per_sample);
    notes.iter().for_each(|note| *out += &format!("<li>{}</li>\n", escape(note)));
    let mut seen = Vec::new();
    for row in page.rows {
        let data = &row.key.data;
        if seen.contains(&data) {
            continue;
        }
        seen.push(data);
        let own = match row.own.relmse {
            Some(relmse) => format!("the reference's own relMSE is {}", table::short(relmse)),
            None => "the reference's own error is not known, and not subtracted".to_owned(),
        };
        let [x, y, width, height] = row.key.crop;
        let _ = writeln!(
            out,
            "<li>{}: {width} x {height} pixels from ({x}, {y}); {own}; unfiltered slope {:.3}</li>",
            escape(data),
            row.slope.value()
        );
    }
    *out += "</ul>\n";
}

fn pictures(out: &mut String, page: &Page) {
    let mut sets: Vec<(&str, u32)> = Vec::new();
    for row in page.rows {
        match sets.iter_mut().find(|(data, _)| *data == row.key.data) {
            Some((_, spp)) => *spp = row.key.spp.max(*spp),
            None => sets.push((&row.key.data, row.key.spp)),
        }
    }
    for (data, spp) in sets {
        let _ = writeln!(out, "<h3>{}, {spp} spp</h3>\n<div>", escape(data));
        let mut figure = |caption: &str, png: &str| {
            let caption = escape(caption);
            let _ = writeln!(
                out,
                "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{png}\"><figcaption>{caption}</figcaption></figure>"
            );
        };
        if let Some(png) = page.references.get(data) {
            figure("reference", png);
        }
        let mut seen = Vec::new();
        for row in page.rows.iter().filter(|row| row.key.data == data && row.key.spp == spp) {
            if let Some([after, difference]) = row.pictures.as_ref().filter(|_| !seen.contains(&&row.label)) {
                seen.push(&row.label);
                figure(&if row.key.preset == BASE { "before".to_owned() } else { row.label.clone() }, after);
                figure(&format!("{}, difference", row.label), difference);
            }
        }
        *out += "</div>\n";
    }
}
