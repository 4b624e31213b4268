//! The fast path stage by stage, for `tests/bench`: what [`Pass`] does with one pixel, so that each part can be timed.
//!
//! A stage reads what those before it have left in [`Stages`], in the order of [`STAGES`].

use super::bilateral::{self, Distances};
use super::information::{Histograms, entropy_terms};
use super::iteration::{ColumnOrder, Pass, Scratch};
use super::relevance::{Relevant, Source};
use super::statistics::{Span, impute, normalise, pad, span};
use super::weights::steepness;
use super::{Offsets, Params, interleaved_colors, most_rows, spikes};
use crate::filter::lanes::{Simd, dispatch, padded};
use crate::filter::{Execution, SampleTile};

/// A part of what is done with a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Step 1: candidates are drawn, and rejected or not.
    Select,
    /// The columns are copied together and normalised.
    Load,
    /// Step 2 alone, of columns that lie there already.
    Normalise,
    /// A bit mask for each bin of each column.
    Histograms,
    /// Step 3: the information of all pairs.
    Information,
    /// Step 5.
    Bilateral,
    /// Step 6.
    Spikes,
}

/// All of them in order, with their names.
pub const STAGES: [(Stage, &str); 7] = [
    (Stage::Select, "select"),
    (Stage::Load, "gather and normalise"),
    (Stage::Normalise, "normalise"),
    (Stage::Histograms, "histograms"),
    (Stage::Information, "information"),
    (Stage::Bilateral, "bilateral"),
    (Stage::Spikes, "spikes"),
];

/// One thread at work on one pixel after another.
pub struct Stages<'a> {
    pass: &'a Pass<'a>,
    order: ColumnOrder,
    scratch: Scratch,
    histograms: Histograms,
    /// Whether each column is constant.
    constant: Vec<bool>,
    spans: Option<[Span; 3]>,
    raw: Vec<f32>,
    out: Vec<f32>,
}

/// Prepares iteration `t`, and hands it to `work`.
pub fn with_stages<T>(
    tile: &SampleTile,
    params: &Params,
    t: usize,
    execution: &Execution,
    work: impl FnOnce(&mut Stages) -> T,
) -> T {
    let relevant = Relevant::of(tile, execution.leave_out);
    let rows = most_rows(params, tile.max_per_pixel() as usize);
    let (terms, colors) = (entropy_terms(rows), interleaved_colors(tile));
    let offsets = Offsets::new(params.boxes[t]);
    let pass = Pass { tile, relevant: &relevant, params, t, execution, offsets, terms: &terms, colors: &colors };
    let order = ColumnOrder::of(&relevant);
    work(&mut Stages {
        pass: &pass,
        scratch: Scratch::new(&relevant, rows, params.bins, execution.leave_out),
        histograms: Histograms::with_capacity(order.end, padded(rows), params.bins, execution.leave_out),
        constant: vec![false; order.end],
        spans: None,
        raw: Vec::new(),
        out: Vec::new(),
        order,
    })
}

impl Stages<'_> {
    /// Does one stage of a pixel, which must have samples.
    pub fn run(&mut self, stage: Stage, x: u32, y: u32) {
        if stage == Stage::Select {
            self.pass.gather(&mut self.scratch, x, y);
            return;
        }
        dispatch!(self.pass.execution.simd.level(), simd => self.stage(simd, stage));
    }

    /// What a stage needs that no stage before it has made; not timed.
    pub fn prepare(&mut self, stage: Stage, x: u32, y: u32) {
        let rows = self.scratch.rows.samples.len();
        match stage {
            Stage::Normalise => {
                let value = |source, row: usize| match source {
                    Source::Plane(plane) => self.pass.tile.value(plane, self.scratch.rows.samples[row] as usize),
                    Source::CenterX | Source::CenterY => self.scratch.rows.pixels[row] as f32,
                };
                self.raw.clear();
                for (source, _) in sources(self.pass.relevant) {
                    self.raw.extend((0..padded(rows)).map(|row| value(source, row.min(rows - 1))));
                }
            }
            Stage::Bilateral => {
                let window = self.pass.tile.geometry().window();
                self.out = vec![0.0; 3 * self.pass.tile.samples_of(window.index(x, y)).len()];
                self.scale();
            }
            _ => {}
        }
    }

    /// Puts the weights' factors into the columns, as the filter wants them.
    fn scale(&mut self) {
        let rows = padded(self.scratch.rows.samples.len());
        let weights = self.scratch.weights.clone();
        let steepness = steepness(weights.confidence, self.pass.params.sigma8_squared, self.out.len() / 3);
        let (stride, first) = (self.scratch.stride, self.order.features);
        for (index, weight) in weights.features.iter().chain(&weights.color).enumerate() {
            let factor = (0.5 * steepness * f64::from(*weight)).sqrt() as f32;
            self.scratch.columns[(first + index) * stride..][..rows].iter_mut().for_each(|v| *v *= factor);
        }
    }

    #[inline(always)]
    fn stage<S: Simd>(&mut self, simd: S, stage: Stage) {
        let rows = self.scratch.rows.samples.len();
        let stride = self.scratch.stride;
        let (pass, order) = (self.pass, &self.order);
        match stage {
            Stage::Select => {}
            Stage::Load => {
                let spans = pass.load_radiance(simd, &mut self.scratch);
                for (column, (source, missing)) in sources(pass.relevant).enumerate() {
                    self.constant[column] = pass.load(simd, &mut self.scratch, column, source, missing).constant();
                }
                for (channel, span) in spans.iter().enumerate() {
                    pass.load_color(simd, &mut self.scratch, order.colors + channel, channel, span);
                    self.constant[order.colors + channel] = span.constant();
                }
                self.spans = Some(spans);
            }
            Stage::Normalise => {
                for ((_, missing), values) in sources(pass.relevant).zip(self.raw.chunks_exact_mut(padded(rows))) {
                    if missing {
                        impute(&mut values[..rows]);
                    }
                    pad(values, rows);
                    let span = span(simd, values);
                    normalise(simd, values, rows, &span);
                }
            }
            Stage::Histograms => {
                self.histograms.start(rows);
                for (column, &constant) in self.constant.iter().enumerate() {
                    let values = &self.scratch.columns[column * stride..][..padded(rows)];
                    self.histograms.set(simd, column, values, constant, pass.terms);
                }
            }
            Stage::Information => {
                let of = |x: usize, y: usize| self.histograms.information(x, y, pass.terms);
                let dependencies = &mut self.scratch.dependencies;
                for (channel, column) in (order.colors..order.end).enumerate() {
                    dependencies.color_position[channel] = (0..order.random).map(|p| of(column, p)).sum();
                    dependencies.color_random[channel] = (order.random..order.features).map(|r| of(column, r)).sum();
                }
                for (feature, column) in (order.features..order.colors).enumerate() {
                    dependencies.feature_position[feature] = (0..order.random).map(|p| of(column, p)).sum();
                    dependencies.feature_random[feature] = (order.random..order.features).map(|r| of(column, r)).sum();
                    dependencies.color_feature[feature] = (order.colors..order.end).map(|c| of(c, column)).sum();
                }
                self.scratch.weights.set(&self.scratch.dependencies, pass.t);
            }
            Stage::Bilateral => {
                let Some(spans) = &self.spans else { unreachable!("stages run in their order") };
                let counted = |column: &usize| match column.checked_sub(order.colors) {
                    Some(channel) => self.scratch.weights.color[channel] > 0.0,
                    None => self.scratch.weights.features[*column - order.features] > 0.0,
                };
                let active: Vec<usize> = (order.features..order.end).filter(counted).collect();
                let distances = Distances {
                    columns: &self.scratch.columns,
                    stride,
                    active: &active,
                    radiance: &self.scratch.radiance,
                    spans,
                    rows,
                };
                bilateral::filter(simd, &distances, &mut self.out);
            }
            Stage::Spikes => {
                spikes::tame(&mut self.out);
            }
        }
    }
}

/// The columns but colours, in their order, and whether values may be missing.
fn sources(relevant: &Relevant) -> impl Iterator<Item = (Source, bool)> {
    let positions = relevant.positions().iter().map(|&source| (source, false));
    let random = relevant.random().iter().map(|&plane| (Source::Plane(plane), false));
    positions.chain(random).chain(relevant.features().iter().map(|f| (Source::Plane(f.plane), f.missing)))
}
