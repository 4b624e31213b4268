//! One pass over the tile: each pixel's neighbourhood gathered once, weighed, and its samples filtered.

use super::bilateral::{self, Distances};
use super::block::{Block, ColumnOrder};
use super::cluster::Cluster;
use super::information::{Histograms, whole_words};
use super::neighborhood::{Around, Center, Offsets, draw, room_for};
use super::params::Params;
use super::relevance::Relevant;
use super::statistics::{Scale, Span, center, impute, make_safe, multiply};
use super::weights::{Dependencies, Weights, steepness};
use super::{grid::Grid, random, spikes, work::Columns};
use crate::filter::lanes::{Simd, padded};
use crate::filter::{Execution, Rect, SampleTile, Work};

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

/// The greatest of what one thread works on at a time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Room {
    /// Pixels of a block, with all around it that its neighbourhoods reach.
    pub(crate) pixels: usize,
    /// Samples of these.
    pub(crate) samples: usize,
    /// Rows of a neighbourhood.
    pub(crate) rows: usize,
}

/// What one thread works in; allocated once per tile, with [`Scratch::bytes`].
pub(crate) struct Scratch {
    /// The samples around the pixels that are worked on.
    pub(super) block: Block,
    cluster: Cluster,
    /// The neighbourhood: the first `count` are records of the block, the rest fills up whole lanes.
    rows: Vec<u32>,
    /// Draws that take more than one try.
    unfinished: Vec<u32>,
    pub(super) count: usize,
    order: ColumnOrder,
    /// Columns of the neighbourhood, `stride` values apart: whole words of bit masks.
    columns: Vec<f32>,
    radiance: Vec<f32>,
    stride: usize,
    /// What normalises each column.
    scales: Vec<Scale>,
    histograms: Histograms,
    pub(super) dependencies: Dependencies,
    pub(crate) weights: Weights,
    /// The columns that weigh anything, and their factors; of those that are filtered by, only the ones that vary.
    pub(super) active: Vec<usize>,
    factors: Vec<f32>,
    /// How many columns weigh anything, each counted once.
    pub(super) loaded: usize,
    /// What was done and left out in core pixels.
    pub(super) work: Work,
    /// Values that the spike step replaced in core pixels.
    pub(crate) spikes: u64,
}

impl Scratch {
    /// Room for one thread.
    pub(crate) fn new(tile: &SampleTile, relevant: &Relevant, params: &Params, room: &Room, leave_out: bool) -> Self {
        let order = ColumnOrder::of(relevant);
        let (stride, columns, features) = (whole_words(room.rows), order.columns(), relevant.features());
        Self {
            block: Block::with_capacity(room.pixels, room.samples, tile, &order),
            cluster: Cluster::new(features, params),
            rows: vec![0; room_for(stride)],
            unfinished: Vec::with_capacity(room.rows),
            count: 0,
            columns: vec![0.0; columns * stride],
            radiance: vec![0.0; 3 * stride],
            stride,
            scales: vec![Scale::default(); columns],
            histograms: Histograms::with_capacity(columns, stride, params.bins, leave_out),
            dependencies: Dependencies::new(features.len()),
            weights: Weights::new(features.len()),
            active: Vec::with_capacity(features.len() + 3),
            factors: Vec::with_capacity(features.len() + 3),
            loaded: 0,
            work: Work::default(),
            spikes: 0,
            order,
        }
    }

    /// Bytes that [`Scratch::new`] allocates.
    pub(crate) fn bytes(order: &ColumnOrder, room: &Room, varying: bool, bins: u32) -> u64 {
        let (stride, columns, features) = (whole_words(room.rows), order.columns(), order.features.len());
        let values = (room_for(stride) + room.rows) * size_of::<u32>() + (columns + 3) * stride * size_of::<f32>();
        let small = columns * size_of::<Scale>()
            + features * (6 * size_of::<f64>() + size_of::<f32>())
            + (features + 3) * (size_of::<usize>() + size_of::<f32>());
        (values + small) as u64
            + Histograms::bytes(columns, stride, bins)
            + Block::bytes(room.pixels, room.samples, varying, order)
            + Cluster::bytes(features)
    }

    /// The neighbourhood, as records of the block.
    #[cfg(test)]
    pub(super) fn rows(&self) -> &[u32] {
        &self.rows[..self.count]
    }

    /// Some columns of the neighbourhood, filled up to whole lanes.
    #[inline(always)]
    pub(super) fn columns<const N: usize>(&mut self, columns: [usize; N]) -> [&mut [f32]; N] {
        let (stride, rows) = (self.stride, padded(self.count));
        match self.columns.get_disjoint_mut(columns.map(|column| column * stride..column * stride + rows)) {
            Ok(columns) => columns,
            Err(_) => unreachable!("columns do not overlap"),
        }
    }

    /// Brings some gathered columns to zero mean, and finds what normalises them.
    #[inline(always)]
    fn center<S: Simd, const N: usize>(&mut self, simd: S, columns: [usize; N]) {
        let count = self.count;
        for column in columns {
            if self.order.features.contains(&column) && self.cluster.missing(column) {
                let [values] = self.columns([column]);
                impute(simd, values, count);
            }
        }
        let mut places = self.columns(columns);
        let spans = make_safe(simd, &mut places);
        let scales = center(simd, &mut places, count, &spans);
        for (column, scale) in columns.into_iter().zip(scales) {
            self.scales[column] = scale;
        }
    }

    /// The columns of the colour channels, from the radiance, at zero mean; of a grey scene only the first.
    #[inline(always)]
    fn center_colors<S: Simd>(&mut self, simd: S, twins: &[usize; 3], spans: &[Span; 3]) {
        let (rows, first, count) = (padded(self.count), self.order.colors.start, self.count);
        let places = self.columns[first * self.stride..].chunks_exact_mut(self.stride);
        for (place, radiance) in places.zip(self.radiance.chunks_exact(self.stride)) {
            place[..rows].copy_from_slice(&radiance[..rows]);
        }
        match twins {
            [0, 0, 0] => {
                let [scale] = center(simd, &mut self.columns([first]), count, &[spans[0]]);
                self.scales[first] = scale;
            }
            _ => {
                let scales = center(simd, &mut self.columns([first, first + 1, first + 2]), count, spans);
                self.scales[first..].copy_from_slice(&scales);
            }
        }
    }

    /// Scales a column of zero mean: normalises it, times a factor.
    #[inline(always)]
    pub(super) fn multiply<S: Simd>(&mut self, simd: S, column: usize, factor: f32) {
        let scale = self.scales[column];
        let [values] = self.columns([column]);
        multiply(simd, values, &scale, factor);
    }

    /// Columns of the neighbourhood that are not constant there; of equal colours one.
    pub(super) fn varying(&self, twins: &[usize; 3]) -> Columns {
        let count = |mut columns: std::ops::Range<usize>| {
            let varying = columns.by_ref().filter(|&column| !self.scales[column].constant()).count();
            varying as u64
        };
        let ColumnOrder { features, positions, random, colors } = self.order.clone();
        let own = colors.clone().zip(twins.iter().enumerate()).filter(|(_, (channel, twin))| channel == *twin);
        Columns {
            positions: count(positions),
            random: count(random),
            features: count(features),
            colors: own.filter(|(column, _)| !self.scales[*column].constant()).count() as u64,
        }
    }
}

/// Columns that are normalised at a time: AVX2 has registers for no more.
const BATCH: usize = 2;

impl Pass<'_> {
    /// Whether a pixel is passed through.
    pub(super) fn settled(&self, x: u32, y: u32) -> bool {
        self.settled.get(self.tile.geometry().window().index(x, y)) == Some(&true)
    }

    /// Takes up the samples around a rectangle of pixels; positions and random parameters if they will be wanted.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, scratch: &mut Scratch, pixels: &Rect, others: bool) {
        let window = pixels.grown(self.params.boxes[self.t] / 2, &self.tile.geometry().window());
        scratch.block.load(simd, self.tile, self.relevant, self.colors, window, others);
    }

    /// Draws the neighbourhood of a pixel; false if it has no samples.
    #[inline(always)]
    pub(super) fn gather<S: Simd>(&self, simd: S, scratch: &mut Scratch, x: u32, y: u32) -> bool {
        let Scratch { block, cluster, rows, unfinished, count, .. } = scratch;
        let own = block.samples_of(x, y);
        if own.is_empty() {
            return false;
        }
        let key = random::pixel_key(self.execution.seed, x, y, self.t);
        let center = Center { x, y, key, wanted: self.params.neighbors(self.t, own.len()) };
        cluster.set(simd, block, own.clone());
        let (first, drawn) = rows.split_at_mut(own.len());
        for (row, sample) in first.iter_mut().zip(own) {
            *row = sample as u32;
        }
        let image = self.tile.geometry().image();
        let around = Around { image: &image, block, offsets: &self.offsets, center: &center };
        let candidates = draw(simd, &around, center.wanted.saturating_sub(first.len()), drawn, unfinished);
        *count = first.len() + cluster.keep(simd, block, &mut drawn[..candidates]);
        let first = rows[0];
        rows[*count..padded(*count)].fill(first);
        true
    }

    /// Copies the colours into place, scaled to a safe size, and says what they span.
    #[inline(always)]
    pub(super) fn load_radiance<S: Simd>(&self, simd: S, scratch: &mut Scratch) -> [Span; 3] {
        let Scratch { block, rows, count, radiance, stride, .. } = scratch;
        let rows = &rows[..padded(*count)];
        let (red, rest) = radiance.split_at_mut(*stride);
        let (green, blue) = rest.split_at_mut(*stride);
        let [red, green, blue] = [red, green, blue].map(|channel| &mut channel[..rows.len()]);
        block.gather_colors(simd, rows, [&mut *red, &mut *green, &mut *blue]);
        make_safe(simd, &mut [red, green, blue])
    }

    /// Steps 1 to 4 at one pixel, into `scratch.weights`; false if it has no samples.
    #[inline(always)]
    pub(crate) fn weigh<S: Simd>(&self, simd: S, scratch: &mut Scratch, x: u32, y: u32) -> bool {
        self.gather(simd, scratch, x, y) && {
            let spans = self.load_radiance(simd, scratch);
            self.weigh_gathered(simd, scratch, &spans);
            self.count_weighing(scratch, &spans, x, y);
            true
        }
    }

    /// Steps 2 to 4 of a gathered neighbourhood: loads every column, and sets `scratch.weights`.
    #[inline(always)]
    fn weigh_gathered<S: Simd>(&self, simd: S, scratch: &mut Scratch, spans: &[Span; 3]) {
        simd.vectorize(
            #[inline(always)]
            || self.load_columns(simd, scratch),
        );
        simd.vectorize(
            #[inline(always)]
            || self.center_columns(simd, scratch, spans),
        );
        simd.vectorize(
            #[inline(always)]
            || self.count_bins(simd, scratch),
        );
        simd.vectorize(
            #[inline(always)]
            || self.measure_dependencies(simd, scratch),
        );
    }

    /// Copies every column but the colours' into place.
    #[inline(always)]
    pub(super) fn load_columns<S: Simd>(&self, simd: S, scratch: &mut Scratch) {
        let Scratch { block, columns, rows, count, stride, order, .. } = scratch;
        let (rows, others) = (&rows[..padded(*count)], order.positions.start * *stride);
        block.gather_features(simd, rows, columns, *stride);
        block.gather_others(simd, rows, &mut columns[others..], *stride);
    }

    /// Step 2: brings every column to zero mean, and finds what normalises it.
    #[inline(always)]
    pub(super) fn center_columns<S: Simd>(&self, simd: S, scratch: &mut Scratch, spans: &[Span; 3]) {
        let ColumnOrder { features, positions, random, .. } = scratch.order.clone();
        for part in [features, positions.start..random.end] {
            let whole = part.end - part.len() % BATCH;
            for first in (part.start..whole).step_by(BATCH) {
                scratch.center(simd, [first, first + 1]);
            }
            for column in whole..part.end {
                scratch.center(simd, [column]);
            }
        }
        scratch.center_colors(simd, self.relevant.twins(), spans);
    }

    /// The histograms of all columns, normalised.
    #[inline(always)]
    pub(super) fn count_bins<S: Simd>(&self, simd: S, scratch: &mut Scratch) {
        let Scratch { histograms, columns, scales, order, count, stride, .. } = scratch;
        let ColumnOrder { features, positions, random, colors } = order.clone();
        histograms.start(*count);
        let twins = self.relevant.twins().iter().enumerate();
        let colors = colors.zip(twins).filter(|(_, (channel, twin))| channel == *twin).map(|(column, _)| column);
        for column in features.chain(positions.start..random.end).chain(colors) {
            let values = &columns[column * *stride..][..whole_words(*count)];
            histograms.set(simd, column, values, &scales[column]);
        }
        histograms.finish(simd, self.terms);
    }

    /// Steps 3 and 4, from the histograms.
    #[inline(always)]
    pub(super) fn measure_dependencies<S: Simd>(&self, simd: S, scratch: &mut Scratch) {
        let Scratch { histograms, dependencies, order, .. } = &mut *scratch;
        let ColumnOrder { features, positions, random, colors } = order.clone();
        histograms.measure(simd, colors.clone(), features.start..random.end, self.terms);
        histograms.measure(simd, features.clone(), positions.start..random.end, self.terms);
        for (channel, &twin) in self.relevant.twins().iter().enumerate() {
            let column = colors.start + twin;
            dependencies.color_position[channel] = histograms.information(column, &positions).iter().sum();
            dependencies.color_random[channel] = histograms.information(column, &random).iter().sum();
            dependencies.color_features[channel].copy_from_slice(histograms.information(column, &features));
        }
        dependencies.add_colors();
        for (feature, column) in features.enumerate() {
            dependencies.feature_position[feature] = histograms.information(column, &positions).iter().sum();
            dependencies.feature_random[feature] = histograms.information(column, &random).iter().sum();
        }
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
        let gathered = simd.vectorize(
            #[inline(always)]
            || self.gather(simd, scratch, x, y),
        );
        if !gathered {
            return;
        }
        let spans = simd.vectorize(
            #[inline(always)]
            || self.load_radiance(simd, scratch),
        );
        // Without weights around, the pixel's own: they load every column; else only those that count are normalised.
        let interpolated = grid.is_some_and(|grid| grid.interpolate(x, y, &mut scratch.weights));
        if !interpolated {
            self.weigh_gathered(simd, scratch, &spans);
            self.count_weighing(scratch, &spans, x, y);
        }
        simd.vectorize(
            #[inline(always)]
            || self.scale_columns(simd, scratch, &spans, interpolated, out.len() / 3),
        );
        simd.vectorize(
            #[inline(always)]
            || self.filter_samples(simd, scratch, &spans, out),
        );
        self.count_filtering(scratch, interpolated, x, y);
    }

    /// Step 5, with scaled columns.
    #[inline(always)]
    pub(super) fn filter_samples<S: Simd>(&self, simd: S, scratch: &Scratch, spans: &[Span; 3], out: &mut [f32]) {
        let Scratch { columns, stride, active, radiance, count, .. } = scratch;
        let distances =
            Distances { columns, stride: *stride, active, radiance, spans, twins: self.relevant.twins(), rows: *count };
        bilateral::filter(simd, &distances, out);
    }

    /// Scales the columns that weigh anything by their factors, and lists them; they are normalised first, if `fresh`.
    #[inline(always)]
    pub(super) fn scale_columns<S: Simd>(
        &self,
        simd: S,
        scratch: &mut Scratch,
        spans: &[Span; 3],
        fresh: bool,
        own: usize,
    ) {
        let steepness = steepness(scratch.weights.confidence, self.params.sigma8_squared, own);
        let factor = |weight: f32| (0.5 * steepness * f64::from(weight)).sqrt() as f32;
        // A difference that weighs nothing adds 0.
        let counts = |factor: f32| factor > 0.0 || !self.execution.leave_out;
        if fresh && scratch.weights.features.iter().any(|&weight| counts(factor(weight))) {
            let Scratch { block, columns, rows, count, stride, .. } = &mut *scratch;
            block.gather_features(simd, &rows[..padded(*count)], columns, *stride);
        }
        let Scratch { active, factors, weights, order, .. } = &mut *scratch;
        active.clear();
        factors.clear();
        // A colour that equals another counts as that one once more.
        let colors = self.relevant.twins().map(|twin| order.colors.start + twin);
        let columns = order.features.clone().chain(colors);
        for (column, &weight) in columns.zip(weights.features.iter().chain(&weights.color)) {
            let factor = factor(weight);
            if counts(factor) {
                active.push(column);
                factors.push(factor);
            }
        }
        let (mut active, factors) = (std::mem::take(active), std::mem::take(factors));
        if fresh {
            let features = active.partition_point(|&column| column < scratch.order.features.end);
            let (batches, rest) = active[..features].as_chunks::<BATCH>();
            for batch in batches {
                scratch.center(simd, *batch);
            }
            for column in rest {
                scratch.center(simd, [*column]);
            }
            if features < active.len() {
                scratch.center_colors(simd, self.relevant.twins(), spans);
            }
        }
        for (index, (column, factor)) in active.iter().zip(&factors).enumerate() {
            if !active[..index].contains(column) {
                scratch.multiply(simd, *column, *factor);
            }
        }
        scratch.loaded = active.iter().enumerate().filter(|(i, column)| !active[..*i].contains(column)).count();
        // Nor do the differences in a column that is constant here add anything.
        if self.execution.leave_out {
            active.retain(|&column| !scratch.scales[column].constant());
        }
        (scratch.active, scratch.factors) = (active, factors);
    }

    /// Filters a block of pixels. `rows` holds the colours of each of its rows.
    #[inline(always)]
    pub(crate) fn block<S: Simd>(
        &self,
        simd: S,
        scratch: &mut Scratch,
        grid: Option<&Grid>,
        pixels: &Rect,
        rows: Vec<&mut [f32]>,
    ) {
        let core = self.tile.geometry().core();
        simd.vectorize(
            #[inline(always)]
            || self.load(simd, scratch, pixels, grid.is_none_or(|grid| !grid.complete(pixels))),
        );
        for (y, mut row) in (pixels.y..).zip(rows) {
            for x in pixels.x..pixels.right() {
                if self.execution.stopped() {
                    return;
                }
                let samples = scratch.block.samples_of(x, y).len();
                let (out, rest) = row.split_at_mut(3 * samples);
                row = rest;
                if self.settled(x, y) {
                    let samples = self.tile.samples_of(self.tile.geometry().window().index(x, y));
                    out.copy_from_slice(&self.colors[3 * samples.start..3 * samples.end]);
                    continue;
                }
                self.pixel(simd, scratch, grid, x, y, out);
                if self.params.spikes {
                    let spikes = spikes::tame(out);
                    if core.contains(x, y) {
                        scratch.spikes += spikes;
                    }
                }
            }
        }
    }
}
