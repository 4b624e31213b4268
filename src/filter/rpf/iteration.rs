//! One pass over the tile: each pixel's neighbourhood gathered once, weighed, and its samples filtered.

use super::bilateral::{self, Distances};
use super::information::Histograms;
use super::neighborhood::{Center, Clustering, Offsets, Rows, gather_rows};
use super::params::Params;
use super::relevance::{Relevant, Source};
use super::statistics::{Span, impute, normalise, pad, span};
use super::weights::{Dependencies, Weights, steepness};
use super::{grid::Grid, random, spikes, work::Columns};
use crate::filter::lanes::{Simd, padded};
use crate::filter::{Execution, Plane, Rect, SampleTile, Work};

/// All that a pass reads.
pub(crate) struct Pass<'a> {
    pub(crate) tile: &'a SampleTile,
    pub(crate) relevant: &'a Relevant,
    pub(crate) params: &'a Params,
    /// Which iteration, from 0.
    pub(crate) t: usize,
    pub(crate) execution: &'a Execution<'a>,
    /// Offsets of this iteration's box.
    pub(crate) offsets: Offsets,
    /// n ln n.
    pub(crate) terms: &'a [f64],
    /// Of each pixel of the data window whether it is passed through; may be empty.
    pub(crate) settled: &'a [bool],
    /// Colours after the iteration before: R, G, B of each sample next to each other.
    pub(crate) colors: &'a [f32],
}

/// What one thread works in; allocated once per tile, with [`Scratch::bytes`].
pub(crate) struct Scratch {
    pub(super) rows: Rows,
    /// Columns of the neighbourhood, `stride` apart: positions, random parameters, features, colours.
    pub(super) columns: Vec<f32>,
    pub(super) radiance: Vec<f32>,
    pub(super) stride: usize,
    histograms: Histograms,
    pub(super) dependencies: Dependencies,
    pub(crate) weights: Weights,
    pub(super) active: Vec<usize>,
    /// Columns of the neighbourhood that were weighed, and are not constant there.
    pub(super) varying: Columns,
    /// What was done and left out in core pixels.
    pub(super) work: Work,
    /// Values that the spike step replaced in core pixels.
    pub(crate) spikes: u64,
}

/// Where the columns of a role start, in [`Scratch::columns`].
pub(super) struct ColumnOrder {
    pub(super) random: usize,
    pub(super) features: usize,
    pub(super) colors: usize,
    pub(super) end: usize,
}

impl ColumnOrder {
    pub(super) fn of(relevant: &Relevant) -> Self {
        let random = relevant.positions().len();
        let features = random + relevant.random().len();
        let colors = features + relevant.features().len();
        Self { random, features, colors, end: colors + 3 }
    }
}

impl Scratch {
    /// Room for neighbourhoods of so many rows.
    pub(crate) fn new(relevant: &Relevant, rows: usize, bins: u32, leave_out: bool) -> Self {
        let columns = ColumnOrder::of(relevant).end;
        let stride = padded(rows);
        Self {
            rows: Rows::with_capacity(rows),
            columns: vec![0.0; columns * stride],
            radiance: vec![0.0; 3 * stride],
            stride,
            histograms: Histograms::with_capacity(columns, stride, bins, leave_out),
            dependencies: Dependencies::new(relevant.features().len()),
            weights: Weights::new(relevant.features().len()),
            active: Vec::with_capacity(columns),
            varying: Columns::default(),
            work: Work::default(),
            spikes: 0,
        }
    }

    /// Bytes that [`Scratch::new`] allocates for so many columns, features among them, and rows.
    pub(crate) const fn bytes(columns: usize, features: usize, rows: usize, bins: u32) -> u64 {
        let stride = padded(rows);
        let values = rows * 2 * size_of::<u32>() + (columns + 3) * stride * size_of::<f32>();
        let small = features * (3 * size_of::<f64>() + size_of::<f32>()) + columns * size_of::<usize>();
        (values + small) as u64 + Histograms::bytes(columns, stride, bins)
    }

    fn column(&mut self, column: usize, rows: usize) -> &mut [f32] {
        &mut self.columns[column * self.stride..][..padded(rows)]
    }
}

impl Pass<'_> {
    /// Whether a pixel is passed through.
    pub(super) fn settled(&self, x: u32, y: u32) -> bool {
        self.settled.get(self.tile.geometry().window().index(x, y)) == Some(&true)
    }

    /// Draws the neighbourhood of a pixel; false if it has no samples.
    pub(super) fn gather(&self, scratch: &mut Scratch, x: u32, y: u32) -> bool {
        let own = self.tile.samples_of(self.tile.geometry().window().index(x, y)).len();
        if own == 0 {
            return false;
        }
        let clustering = Clustering {
            position: self.params.position_threshold,
            feature: self.params.feature_threshold,
            floor: self.params.threshold_floor,
        };
        let key = random::pixel_key(self.execution.seed, x, y, self.t);
        let center = Center { x, y, key, wanted: self.params.neighbors(self.t, own) };
        gather_rows(&mut scratch.rows, self.tile, self.relevant, &self.offsets, &clustering, &center);
        true
    }

    /// Copies a column's values into place and normalises them; says what they span.
    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, scratch: &mut Scratch, column: usize, source: Source, missing: bool) -> Span {
        let rows = scratch.rows.samples.len();
        let stride = scratch.stride;
        let values = &mut scratch.columns[column * stride..][..padded(rows)];
        let window = self.tile.geometry().window();
        match source {
            Source::Plane(plane) => match self.tile.plane(plane) {
                Plane::Values(plane) => {
                    for (value, &sample) in values.iter_mut().zip(&scratch.rows.samples) {
                        *value = plane[sample as usize];
                    }
                }
                Plane::Constant(constant) => values.fill(*constant),
            },
            Source::CenterX => {
                for (value, &pixel) in values.iter_mut().zip(&scratch.rows.pixels) {
                    *value = (window.x + pixel % window.width) as f32 + 0.5;
                }
            }
            Source::CenterY => {
                for (value, &pixel) in values.iter_mut().zip(&scratch.rows.pixels) {
                    *value = (window.y + pixel / window.width) as f32 + 0.5;
                }
            }
        }
        if missing {
            impute(&mut values[..rows]);
        }
        pad(values, rows);
        let span = span(simd, values);
        normalise(simd, values, rows, &span);
        span
    }

    /// Copies the colours into place, scaled to a safe size, and says what they span.
    #[inline(always)]
    pub(super) fn load_radiance<S: Simd>(&self, simd: S, scratch: &mut Scratch) -> [Span; 3] {
        let rows = scratch.rows.samples.len();
        let mut channels = scratch.radiance.chunks_exact_mut(scratch.stride);
        let (Some(red), Some(green), Some(blue)) = (channels.next(), channels.next(), channels.next()) else {
            unreachable!("there are three channels")
        };
        for (row, &sample) in scratch.rows.samples.iter().enumerate() {
            let color = &self.colors[3 * sample as usize..][..3];
            (red[row], green[row], blue[row]) = (color[0], color[1], color[2]);
        }
        let mut spans = [Span::default(); 3];
        for (channel, values) in [red, green, blue].into_iter().enumerate() {
            let twin = self.relevant.twins()[channel];
            if twin < channel {
                spans[channel] = spans[twin];
                continue;
            }
            let values = &mut values[..padded(rows)];
            pad(values, rows);
            spans[channel] = span(simd, values);
            let scale = spans[channel].scale;
            if scale != 1.0 {
                values.iter_mut().for_each(|v| *v *= scale);
            }
        }
        spans
    }

    /// A colour channel's normalised column, from the scaled radiance.
    #[inline(always)]
    fn load_color<S: Simd>(&self, simd: S, scratch: &mut Scratch, column: usize, channel: usize, span: &Span) {
        let rows = scratch.rows.samples.len();
        let stride = scratch.stride;
        let values = &mut scratch.columns[column * stride..][..padded(rows)];
        values.copy_from_slice(&scratch.radiance[channel * stride..][..padded(rows)]);
        normalise(simd, values, rows, &Span { min: span.min, max: span.max, scale: 1.0 });
    }

    /// Steps 1 to 4 at one pixel, into `scratch.weights`; false if it has no samples.
    #[inline(always)]
    pub(crate) fn weigh<S: Simd>(&self, simd: S, scratch: &mut Scratch, x: u32, y: u32) -> bool {
        self.gather(scratch, x, y) && {
            let spans = self.load_radiance(simd, scratch);
            self.weigh_gathered(simd, scratch, &spans);
            self.count_weighing(scratch, &spans, x, y);
            true
        }
    }

    /// Steps 2 to 4 of a gathered neighbourhood: loads every column, and sets `scratch.weights`.
    #[inline(always)]
    pub(super) fn weigh_gathered<S: Simd>(&self, simd: S, scratch: &mut Scratch, spans: &[Span; 3]) {
        let order = ColumnOrder::of(self.relevant);
        let twins = self.relevant.twins();
        let rows = scratch.rows.samples.len();
        scratch.histograms.start(rows);
        let mut varying = Columns::default();
        simd.vectorize(
            #[inline(always)]
            || {
                let positions = self.relevant.positions().iter().map(|&source| (source, false));
                let random = self.relevant.random().iter().map(|&plane| (Source::Plane(plane), false));
                let features = self.relevant.features().iter().map(|f| (Source::Plane(f.plane), f.missing));
                for (column, (source, missing)) in positions.chain(random).chain(features).enumerate() {
                    let constant = self.load(simd, scratch, column, source, missing).constant();
                    let values = &scratch.columns[column * scratch.stride..][..padded(rows)];
                    scratch.histograms.set(simd, column, values, constant, self.terms);
                    *match column {
                        _ if column < order.random => &mut varying.positions,
                        _ if column < order.features => &mut varying.random,
                        _ => &mut varying.features,
                    } += u64::from(!constant);
                }
                for (channel, span) in spans.iter().enumerate().filter(|(channel, _)| twins[*channel] == *channel) {
                    let column = order.colors + channel;
                    self.load_color(simd, scratch, column, channel, span);
                    let values = &scratch.columns[column * scratch.stride..][..padded(rows)];
                    scratch.histograms.set(simd, column, values, span.constant(), self.terms);
                    varying.colors += u64::from(!span.constant());
                }
            },
        );
        scratch.varying = varying;
        simd.vectorize(
            #[inline(always)]
            || {
                let Scratch { histograms, dependencies, .. } = scratch;
                let of = |x: usize, y: usize| histograms.information(x, y, self.terms);
                for (channel, column) in (order.colors..order.end).enumerate() {
                    let twin = twins[channel];
                    if twin < channel {
                        dependencies.color_position[channel] = dependencies.color_position[twin];
                        dependencies.color_random[channel] = dependencies.color_random[twin];
                        continue;
                    }
                    dependencies.color_position[channel] = (0..order.random).map(|p| of(column, p)).sum();
                    dependencies.color_random[channel] = (order.random..order.features).map(|r| of(column, r)).sum();
                }
                for (feature, column) in (order.features..order.colors).enumerate() {
                    dependencies.feature_position[feature] = (0..order.random).map(|p| of(column, p)).sum();
                    dependencies.feature_random[feature] = (order.random..order.features).map(|r| of(column, r)).sum();
                    let mut on_colors = [0.0; 3];
                    for channel in 0..3 {
                        let twin = twins[channel];
                        on_colors[channel] =
                            if twin < channel { on_colors[twin] } else { of(order.colors + channel, column) };
                    }
                    dependencies.color_feature[feature] = on_colors.iter().sum();
                }
            },
        );
        scratch.weights.set(&scratch.dependencies, self.t);
    }

    /// Filters the samples of one pixel into `out`; with a grid, the weights are interpolated from its nodes.
    #[inline(always)]
    pub(super) fn pixel<S: Simd>(
        &self,
        simd: S,
        scratch: &mut Scratch,
        grid: Option<&Grid>,
        x: u32,
        y: u32,
        out: &mut [f32],
    ) {
        if !self.gather(scratch, x, y) {
            return;
        }
        let order = ColumnOrder::of(self.relevant);
        let spans = self.load_radiance(simd, scratch);
        // Without weights around, the pixel's own: they load every column; else only those that count are loaded below.
        let interpolated = grid.is_some_and(|grid| grid.interpolate(x, y, &mut scratch.weights));
        if !interpolated {
            self.weigh_gathered(simd, scratch, &spans);
            self.count_weighing(scratch, &spans, x, y);
        }
        let rows = scratch.rows.samples.len();
        let steepness = steepness(scratch.weights.confidence, self.params.sigma8_squared, out.len() / 3);
        let factor = |weight: f32| (0.5 * steepness * f64::from(weight)).sqrt() as f32;
        // A difference that weighs nothing adds 0.
        let counts = |factor: f32| factor > 0.0 || !self.execution.leave_out;
        scratch.active.clear();
        for feature in 0..self.relevant.features().len() {
            let factor = factor(scratch.weights.features[feature]);
            if counts(factor) {
                let column = order.features + feature;
                if interpolated {
                    let feature = self.relevant.features()[feature];
                    self.load(simd, scratch, column, Source::Plane(feature.plane), feature.missing);
                }
                scratch.column(column, rows).iter_mut().for_each(|v| *v *= factor);
                scratch.active.push(column);
            }
        }
        let twins = self.relevant.twins();
        for (channel, span) in spans.iter().enumerate() {
            let factor = factor(scratch.weights.color[channel]);
            if counts(factor) && twins[channel] < channel {
                scratch.active.push(order.colors + twins[channel]);
            } else if counts(factor) {
                let column = order.colors + channel;
                if interpolated {
                    self.load_color(simd, scratch, column, channel, span);
                }
                scratch.column(column, rows).iter_mut().for_each(|v| *v *= factor);
                scratch.active.push(column);
            }
        }
        let distances = Distances {
            columns: &scratch.columns,
            stride: scratch.stride,
            active: &scratch.active,
            radiance: &scratch.radiance,
            spans: &spans,
            twins,
            rows,
        };
        simd.vectorize(
            #[inline(always)]
            || bilateral::filter(simd, &distances, out),
        );
        self.count_filtering(scratch, interpolated, x, y);
    }

    /// Filters the pixels of `band`. `out` holds the colours of its rows, from the data window's left edge to its right.
    #[inline(always)]
    pub(crate) fn band<S: Simd>(
        &self,
        simd: S,
        scratch: &mut Scratch,
        grid: Option<&Grid>,
        band: &Rect,
        out: &mut [f32],
    ) {
        let window = self.tile.geometry().window();
        let start = self.tile.samples_of(window.index(window.x, band.y)).start;
        // Column by column, so that what one neighbourhood has brought into the cache serves the next.
        for x in band.x..band.right() {
            for y in band.y..band.bottom() {
                if self.execution.stopped() {
                    return;
                }
                let samples = self.tile.samples_of(window.index(x, y));
                let out = &mut out[3 * (samples.start - start)..3 * (samples.end - start)];
                if self.settled(x, y) {
                    out.copy_from_slice(&self.colors[3 * samples.start..3 * samples.end]);
                    continue;
                }
                self.pixel(simd, scratch, grid, x, y, out);
                if self.params.spikes {
                    let spikes = spikes::tame(out);
                    if self.tile.geometry().core().contains(x, y) {
                        scratch.spikes += spikes;
                    }
                }
            }
        }
    }
}
