//! Log-log charts as SVG: small panels in a grid with one legend. Plain text and shapes, readable on light and dark;
//! the fonts are the reader's.

use std::fmt::Write;

/// Points of one kind.
#[derive(Clone, Debug)]
pub struct Series {
    /// Name in the legend; series of one name, in any panel, have one entry.
    pub name: String,
    /// Number of the colour: 0 to 9, then from the start again.
    pub color: usize,
    /// x and y, each above 0; others are left out.
    pub points: Vec<(f64, f64)>,
    /// How they are drawn.
    pub mark: Mark,
}

/// How points are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// A dot each.
    Dots,
    /// A thin dashed line through them, in their order.
    Line,
}

/// One chart.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// What x is, with its unit.
    pub x: String,
    /// What y is, with its unit.
    pub y: String,
    /// What is in it.
    pub series: Vec<Series>,
}

const COLORS: [&str; 10] =
    ["#8a8f98", "#2f81d6", "#e0702c", "#2e9e5b", "#b565c9", "#c9a227", "#d64562", "#2aa7a7", "#8c6d4f", "#6a74e0"];
const SIZE: [f64; 2] = [330.0, 250.0];
/// Left, top, right, bottom: what is around the axes.
const MARGIN: [f64; 4] = [58.0, 28.0, 12.0, 42.0];
const LEGEND_ROW: f64 = 20.0;

/// Escapes text for XML and HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Draws panels, so many side by side. The result stands alone as a file and inside a page.
pub fn draw(panels: &[Panel], across: usize) -> String {
    let columns = across.clamp(1, panels.len().max(1));
    let width = SIZE[0] * columns as f64;
    let height = SIZE[1] * panels.len().div_ceil(columns) as f64;
    // Above, so that it is seen before the first panel, however many there are.
    let (legend, legend_height) = legend(panels, width);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {all}\" width=\"{width}\" height=\"{all}\" role=\"img\" \
         font-family=\"sans-serif\" font-size=\"11\">\n<style>.t{{fill:#333}}.g{{stroke:#888;stroke-opacity:.3}}\
         @media(prefers-color-scheme:dark){{.t{{fill:#ddd}}}}</style>\n",
        all = height + legend_height
    );
    out += &legend;
    for (index, panel) in panels.iter().enumerate() {
        let (x, y) = ((index % columns) as f64 * SIZE[0], legend_height + (index / columns) as f64 * SIZE[1]);
        let _ = writeln!(out, "<g transform=\"translate({x} {y})\">");
        draw_panel(&mut out, panel);
        out += "</g>\n";
    }
    out += "</svg>\n";
    out
}

/// The legend, and its height: dots first, then lines.
fn legend(panels: &[Panel], width: f64) -> (String, f64) {
    let mut seen = Vec::new();
    let (mut out, mut x, mut y) = (String::new(), 12.0, 14.0);
    let of = |mark: Mark| panels.iter().flat_map(|panel| &panel.series).filter(move |series| series.mark == mark);
    for series in of(Mark::Dots).chain(of(Mark::Line)) {
        if series.name.is_empty() || seen.contains(&&series.name) {
            continue;
        }
        let room = 24.0 + 6.6 * series.name.chars().count() as f64;
        if x > 12.0 && x + room > width {
            (x, y) = (12.0, y + LEGEND_ROW);
        }
        let color = COLORS[series.color % COLORS.len()];
        let _ = match series.mark {
            Mark::Dots => write!(out, "<circle cx=\"{}\" cy=\"{}\" r=\"4\" fill=\"{color}\"/>", x + 5.0, y - 4.0),
            Mark::Line => write!(
                out,
                "<path d=\"M{} {}h14\" stroke=\"{color}\" stroke-dasharray=\"4 3\" fill=\"none\"/>",
                x - 2.0,
                y - 4.0
            ),
        };
        let _ = writeln!(out, "<text class=\"t\" x=\"{}\" y=\"{y}\">{}</text>", x + 15.0, escape(&series.name));
        x += room;
        seen.push(&series.name);
    }
    (out, y + 8.0)
}

/// A logarithmic axis from `low` to `high` on pixels `start` to `end`.
struct Axis {
    low: f64,
    high: f64,
    start: f64,
    end: f64,
}

impl Axis {
    /// Wide enough for these values, with a little room.
    fn over(values: impl Iterator<Item = f64> + Clone, start: f64, end: f64) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(0.0, f64::max);
        let (low, high) = if low <= high { (low / 1.3, high * 1.3) } else { (0.1, 10.0) };
        // At least a factor of 4, so that there are ticks.
        let stretch = (4.0 / (high / low)).max(1.0).sqrt();
        Self { low: low / stretch, high: high * stretch, start, end }
    }

    fn at(&self, value: f64) -> f64 {
        self.start + (self.end - self.start) * (value / self.low).ln() / (self.high / self.low).ln()
    }

    /// Powers of ten, with others between them if these are few.
    fn ticks(&self) -> Vec<f64> {
        let steps: [&[f64]; 4] = [&[1.0], &[1.0, 3.0], &[1.0, 2.0, 5.0], &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0]];
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        let ticks = |steps: &'static [f64]| -> Vec<f64> {
            let all = decades.clone().flat_map(|decade| steps.iter().map(move |step| step * 10f64.powi(decade)));
            all.filter(|tick| (self.low..=self.high).contains(tick)).collect()
        };
        let enough = |ticks: &Vec<f64>| ticks.len() > 2;
        steps.into_iter().map(ticks).find(enough).unwrap_or_else(|| ticks(steps[3]))
    }
}

/// A tick's label: 0.01, 5, 200, 1e-5.
fn label(value: f64) -> String {
    if (0.9e-3..2e4).contains(&value) {
        let text = format!("{value:.4}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{value:.0e}")
    }
}

fn usable(series: &Series) -> impl Iterator<Item = (f64, f64)> + Clone + '_ {
    series.points.iter().copied().filter(|(x, y)| *x > 0.0 && *y > 0.0 && x.is_finite() && y.is_finite())
}

fn draw_panel(out: &mut String, panel: &Panel) {
    let [left, top, right, bottom] = MARGIN;
    let (right, bottom) = (SIZE[0] - right, SIZE[1] - bottom);
    let points = panel.series.iter().flat_map(usable);
    let across = Axis::over(points.clone().map(|p| p.0), left, right);
    let up = Axis::over(points.map(|p| p.1), bottom, top);
    let mut text = |x: f64, y: f64, anchor: &str, more: &str, text: &str| {
        let text = escape(text);
        let _ =
            writeln!(out, "<text class=\"t\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\"{more}>{text}</text>");
    };
    text(0.5 * (left + right), top - 10.0, "middle", " font-weight=\"bold\"", &panel.title);
    text(0.5 * (left + right), SIZE[1] - 8.0, "middle", "", &panel.x);
    let middle = 0.5 * (top + bottom);
    text(12.0, middle, "middle", &format!(" transform=\"rotate(-90 12 {middle})\""), &panel.y);
    for tick in across.ticks() {
        text(across.at(tick), bottom + 15.0, "middle", "", &label(tick));
    }
    for tick in up.ticks() {
        text(left - 5.0, up.at(tick) + 4.0, "end", "", &label(tick));
    }
    let mut grid = String::new();
    for x in across.ticks().into_iter().map(|tick| across.at(tick)) {
        let _ = write!(grid, "M{x:.1} {top}V{bottom}");
    }
    for y in up.ticks().into_iter().map(|tick| up.at(tick)) {
        let _ = write!(grid, "M{left} {y:.1}H{right}");
    }
    let _ = writeln!(out, "<path class=\"g\" fill=\"none\" d=\"{grid}M{left} {top}H{right}V{bottom}H{left}Z\"/>");
    for series in &panel.series {
        let color = COLORS[series.color % COLORS.len()];
        let places = usable(series).map(|(x, y)| (across.at(x), up.at(y), x, y));
        if series.mark == Mark::Line {
            let path: Vec<String> = places.map(|(x, y, ..)| format!("{x:.1} {y:.1}")).collect();
            if path.len() > 1 {
                let path = path.join("L");
                let _ =
                    writeln!(out, "<path d=\"M{path}\" stroke=\"{color}\" stroke-dasharray=\"4 3\" fill=\"none\"/>");
            }
            continue;
        }
        for (x, y, real_x, real_y) in places {
            let name = escape(&series.name);
            let _ = writeln!(
                out,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{color}\"><title>{name}: {}, {}</title></circle>",
                super::table::short(real_x),
                super::table::short(real_y)
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_lie_where_they_should() {
        let axis = Axis { low: 0.1, high: 100.0, start: 0.0, end: 300.0 };
        assert!((axis.at(1.0) - 100.0).abs() < 1e-9 && (axis.at(10.0) - 200.0).abs() < 1e-9);
        assert_eq!(axis.ticks().iter().map(|v| label(*v)).collect::<Vec<_>>(), ["0.1", "1", "10", "100"]);
        let narrow = Axis::over([3.1, 3.1].into_iter(), 0.0, 1.0);
        assert_eq!(narrow.ticks(), [2.0, 3.0, 4.0, 5.0]);
        assert_eq!([0.001, 0.05, 2000.0, 1e5, 1e-5].map(label), ["0.001", "0.05", "2000", "1e5", "1e-5"]);
    }

    #[test]
    fn text_is_escaped_and_nothing_unusable_is_drawn() {
        let points = vec![(1.0, 2.0), (0.0, 1.0), (1.0, -1.0), (f64::NAN, 1.0), (f64::INFINITY, 1.0)];
        let series = Series { name: "a<b".into(), color: 13, points, mark: Mark::Dots };
        let svg = draw(&[Panel { title: "t&u".into(), x: "x".into(), y: "y".into(), series: vec![series] }], 3);
        assert_eq!(svg.matches("<title>").count(), 1);
        assert!(svg.contains("a&lt;b") && svg.contains("t&amp;u") && !svg.contains("NaN"));
        assert!(draw(&[], 3).ends_with("</svg>\n"));
    }
}
