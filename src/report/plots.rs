//! The report's charts: error against time, and error against samples.

use super::{
    rows::{BASE, Row, fit},
    svg::{Mark, Panel, Series},
};

const ERROR: &str = "relMSE";

/// Values of the rows, each once, in their order.
fn each<T: PartialEq>(rows: &[Row], of: impl Fn(&Row) -> T) -> Vec<T> {
    let mut values = Vec::new();
    for value in rows.iter().map(of) {
        if !values.contains(&value) {
            values.push(value);
        }
    }
    values
}

fn methods(rows: &[Row]) -> Vec<String> {
    each(rows, |row| row.label.clone())
}

/// relMSE against CPU seconds per megapixel: a panel for each data set and sample count, after one of the geometric
/// means over them where there are several. Rows on one thread where there are such: more change neither error nor,
/// much, CPU time.
pub fn error_time(rows: &[Row]) -> Vec<Panel> {
    let fewest = rows.iter().map(|row| row.key.threads).min().unwrap_or(1);
    let rows: Vec<Row> = rows.iter().filter(|row| row.key.threads == fewest).cloned().collect();
    let methods = methods(&rows);
    let mut panels = Vec::new();
    for part in [false, true] {
        let rows: Vec<Row> = rows.iter().filter(|row| row.key.part == part).cloned().collect();
        time_panels(&mut panels, &rows, &methods, if part { "crops" } else { "renders" });
    }
    panels
}

fn time_panels(panels: &mut Vec<Panel>, rows: &[Row], methods: &[String], what: &str) {
    let sets = each(rows, |row| (row.key.data.clone(), row.key.crop, row.key.spp));
    let of = |set: &(String, [u32; 4], u32)| {
        let set = set.clone();
        rows.iter().filter(move |row| (&row.key.data, row.key.crop, row.key.spp) == (&set.0, set.1, set.2))
    };
    if sets.len() > 1 {
        panels.extend(mean_panel(rows, methods, sets.len(), what));
    }
    for set in &sets {
        let dots = of(set).map(|row| (row.label.clone(), (row.cpu.median, row.relmse())));
        panels.push(time_panel(format!("{}, {} spp", set.0, set.2), ERROR, dots.collect(), methods));
    }
}

/// Geometric means of relMSE over that of the base, over all data sets: only methods that ran on each of them.
fn mean_panel(rows: &[Row], methods: &[String], sets: usize, what: &str) -> Option<Panel> {
    let ratio = |row: &Row| {
        let (a, base) = (&row.key, rows.iter().filter(|base| base.label == BASE));
        let base = base.map(|base| (&base.key, base.relmse()));
        let same = base.filter(|(b, _)| (&a.data, a.crop, a.spp) == (&b.data, b.crop, b.spp));
        same.map(|(_, error)| row.relmse() / error).next().filter(|ratio| *ratio > 0.0)
    };
    let mut dots = Vec::new();
    for method in methods {
        let of = rows.iter().filter(|row| row.label == *method);
        let points: Vec<(f64, f64)> = of.filter_map(|row| Some((row.cpu.median.ln(), ratio(row)?.ln()))).collect();
        if points.len() == sets {
            let mean = |of: fn(&(f64, f64)) -> f64| (points.iter().map(of).sum::<f64>() / sets as f64).exp();
            dots.push((method.clone(), (mean(|p| p.0), mean(|p| p.1))));
        }
    }
    let title = format!("geometric mean of {sets} {what}");
    (!dots.is_empty()).then(|| time_panel(title, "relMSE / unfiltered", dots, methods))
}

fn time_panel(title: String, y: &str, dots: Vec<(String, (f64, f64))>, methods: &[String]) -> Panel {
    let beaten = |(x, y): (f64, f64)| dots.iter().any(|(_, (a, b))| (*a, *b) != (x, y) && *a <= x && *b <= y);
    let mut front: Vec<(f64, f64)> = dots.iter().map(|(_, point)| *point).filter(|point| !beaten(*point)).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    let front = Series { name: "Pareto front".into(), color: 0, points: front, mark: Mark::Line };
    let dots = dots.into_iter().map(|(name, point)| Series {
        color: methods.iter().position(|method| *method == name).unwrap_or(0),
        name,
        points: vec![point],
        mark: Mark::Dots,
    });
    Panel { title, x: "CPU seconds per megapixel".into(), y: y.into(), series: dots.chain([front]).collect() }
}

/// relMSE against samples per pixel, with the line that fits best and its slope: a panel for each data set that was
/// measured at several sample counts.
pub fn error_samples(rows: &[Row]) -> Vec<Panel> {
    let methods = methods(rows);
    let mut panels = Vec::new();
    for (data, crop) in each(rows, |row| (row.key.data.clone(), row.key.crop)) {
        let here: Vec<&Row> = rows.iter().filter(|row| (&row.key.data, row.key.crop) == (&data, crop)).collect();
        let mut series = Vec::new();
        for (color, method) in methods.iter().enumerate() {
            let mut points = Vec::new();
            for row in here.iter().filter(|row| row.label == *method) {
                let point = (f64::from(row.key.spp), row.relmse());
                if !points.contains(&point) {
                    points.push(point);
                }
            }
            let Some(slope) = fit(&points) else { continue };
            let middle = |of: fn(&(f64, f64)) -> f64| {
                (points.iter().map(|p| of(p).ln()).sum::<f64>() / points.len() as f64).exp()
            };
            let (x, y) = (middle(|p| p.0), middle(|p| p.1));
            let ends = [f64::min, f64::max].map(|end| points.iter().map(|p| p.0).reduce(end).unwrap_or(x));
            let line = ends.map(|end| (end, y * (end / x).powf(slope))).to_vec();
            let name = format!("{method}: slope {slope:.2}");
            series.push(Series { name, color, points, mark: Mark::Dots });
            series.push(Series { name: String::new(), color, points: line, mark: Mark::Line });
        }
        if !series.is_empty() {
            let (x, y) = ("samples per pixel".into(), ERROR.into());
            panels.push(Panel { title: data, x, y, series });
        }
    }
    panels
}
