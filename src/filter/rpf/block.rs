//! The samples around a block of pixels, record by record: what a row of a neighbourhood needs lies together.
//!
//! A tile keeps planes, one after another; a neighbourhood reads single samples of all of them, from all over its box.
//! So a thread copies what a block of pixels can reach into records of whole cache lines, small enough to stay in the
//! cache while the block is worked on: a candidate is tested, and a row gathered, from one or two lines of memory.

use super::relevance::{Relevant, Source};
use crate::filter::lanes::{HALF, LANES, QUARTER, Quarter, Simd, prelude::*, transpose};
use crate::filter::samples::SampleLayout;
use crate::filter::{Plane, Rect, SampleTile};

/// One cache line of a record: a value of each of 16 columns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(align(64))]
pub(crate) struct Line(pub(crate) [f32; LANES]);

/// Half a cache line of a record.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(align(32))]
struct HalfLine([f32; HALF]);

/// A part of a record: a value of each of some columns, whole halves of vectors.
trait Part {
    const COLUMNS: usize;
    fn values(&self) -> &[f32];
    fn values_mut(&mut self) -> &mut [f32];
}

macro_rules! parts {
    ($($part:ty: $columns:expr),*) => {$(
        impl Part for $part {
            const COLUMNS: usize = $columns;

            #[inline(always)]
            fn values(&self) -> &[f32] {
                &self.0
            }

            #[inline(always)]
            fn values_mut(&mut self) -> &mut [f32] {
                &mut self.0
            }
        }
    )*};
}

// Two types, since an alignment cannot be a parameter of one.
parts!(Line: LANES, HalfLine: HALF);

/// Columns of a neighbourhood, by role. Features fill whole lines, since they are tested line by line; positions and
/// random parameters together fill whole halves of lines.
#[derive(Clone, Debug)]
pub(crate) struct ColumnOrder {
    pub(super) features: std::ops::Range<usize>,
    pub(super) positions: std::ops::Range<usize>,
    pub(super) random: std::ops::Range<usize>,
    pub(super) colors: std::ops::Range<usize>,
}

impl ColumnOrder {
    pub(super) fn of(relevant: &Relevant) -> Self {
        Self::new(relevant.features().len(), relevant.positions().len(), relevant.random().len())
    }

    /// The order of so many columns of each role.
    pub(super) const fn new(features: usize, positions: usize, random: usize) -> Self {
        let first = features.next_multiple_of(LANES);
        let second = first + positions;
        let colors = (second + random).next_multiple_of(HALF);
        Self {
            features: 0..features,
            positions: first..second,
            random: second..second + random,
            colors: colors..colors + 3,
        }
    }

    /// Lines of the features of one sample.
    pub(super) const fn feature_lines(&self) -> usize {
        self.positions.start / LANES
    }

    /// Halves of lines of the positions and random parameters of one sample.
    pub(super) const fn other_halves(&self) -> usize {
        (self.colors.start - self.positions.start) / HALF
    }

    /// Columns in all, those between included that only fill lines.
    pub(super) const fn columns(&self) -> usize {
        self.colors.end
    }
}

/// The samples of a rectangle of pixels.
#[derive(Debug)]
pub(crate) struct Block {
    /// The pixels, in image coordinates.
    window: Rect,
    layout: SampleLayout,
    feature_lines: usize,
    other_halves: usize,
    /// Of each sample, its features.
    features: Vec<Line>,
    /// Of each sample, positions and random parameters.
    others: Vec<HalfLine>,
    /// Of each sample R, G, B, and a 0.
    colors: Vec<[f32; 4]>,
}

impl Block {
    /// Room for so many pixels with so many samples of a tile.
    pub(crate) fn with_capacity(pixels: usize, samples: usize, tile: &SampleTile, order: &ColumnOrder) -> Self {
        let (feature_lines, other_halves) = (order.feature_lines(), order.other_halves());
        Self {
            window: Rect::new(0, 0, 0, 0),
            layout: tile.layout().with_capacity(pixels),
            feature_lines,
            other_halves,
            features: Vec::with_capacity(samples * feature_lines),
            others: Vec::with_capacity(samples * other_halves),
            colors: Vec::with_capacity(samples),
        }
    }

    /// Bytes that [`Block::with_capacity`] allocates.
    pub(crate) const fn bytes(pixels: usize, samples: usize, varying: bool, order: &ColumnOrder) -> u64 {
        let lines = order.feature_lines() * size_of::<Line>() + order.other_halves() * size_of::<HalfLine>();
        let starts = if varying { (pixels + 1) * size_of::<u32>() } else { 0 };
        (samples * (lines + size_of::<[f32; 4]>()) + starts) as u64
    }

    /// The pixels whose samples are here.
    pub(crate) const fn window(&self) -> &Rect {
        &self.window
    }

    /// The records of a pixel's samples.
    #[inline(always)]
    pub(crate) fn samples_of(&self, x: u32, y: u32) -> std::ops::Range<usize> {
        self.layout.of(self.window.index(x, y))
    }

    /// Where each pixel's records lie, by its row-major index in the window.
    #[inline(always)]
    pub(crate) const fn layout(&self) -> &SampleLayout {
        &self.layout
    }

    /// The features of all samples, [`Block::feature_lines`] each.
    #[inline(always)]
    pub(crate) fn features(&self) -> &[Line] {
        &self.features
    }

    /// Lines of features per sample.
    #[inline(always)]
    pub(crate) const fn feature_lines(&self) -> usize {
        self.feature_lines
    }

    /// Copies the samples of `window`, a part of the tile's data window; positions and random parameters only if they
    /// are wanted. `colors` are those of the tile's samples, R, G, B next to each other.
    #[inline(always)]
    pub(crate) fn load<S: Simd>(
        &mut self,
        simd: S,
        tile: &SampleTile,
        relevant: &Relevant,
        colors: &[f32],
        window: Rect,
        others: bool,
    ) {
        self.window = window;
        tile.set_layout_of(&window, &mut self.layout);
        let total = self.layout.total();
        self.features.resize(total * self.feature_lines, Line::default());
        self.colors.resize(total, [0.0; 4]);
        let others_wanted = if others { total * self.other_halves } else { 0 };
        self.others.resize(others_wanted, HalfLine::default());
        let whole = tile.geometry().window();
        for y in window.y..window.bottom() {
            let at = |x: u32| tile.samples_of(whole.index(x, y));
            let (from, to) = (at(window.x).start, at(window.right() - 1).end);
            let first = self.samples_of(window.x, y).start;
            let samples = from..to;
            for (place, color) in
                self.colors[first..][..samples.len()].iter_mut().zip(colors[3 * from..3 * to].chunks_exact(3))
            {
                place[..3].copy_from_slice(color);
            }
            let features = relevant.features().iter().map(|f| Source::Plane(f.plane));
            copy_row(simd, tile, features, samples.clone(), self.feature_lines, &mut self.features, first);
            if others {
                let random = relevant.random().iter().map(|&plane| Source::Plane(plane));
                let sources = relevant.positions().iter().copied().chain(random);
                copy_row(simd, tile, sources, samples, self.other_halves, &mut self.others, first);
                self.centers(relevant, y);
            }
        }
    }

    /// Sets the positions of a row of pixels to the pixels' centres, where no film positions were sent.
    fn centers(&mut self, relevant: &Relevant, y: u32) {
        for (lane, source) in relevant.positions().iter().enumerate() {
            if matches!(source, Source::Plane(_)) {
                continue;
            }
            for x in self.window.x..self.window.right() {
                let center = if *source == Source::CenterX { x } else { y } as f32 + 0.5;
                for sample in self.samples_of(x, y) {
                    self.others[sample * self.other_halves].0[lane] = center;
                }
            }
        }
    }

    /// R, G and B of some samples, as columns. The number of rows is a whole number of lanes.
    #[inline(always)]
    pub(crate) fn gather_colors<S: Simd>(&self, simd: S, rows: &[u32], channels: [&mut [f32]; 3]) {
        let [red, green, blue] = channels.map(|channel| channel.as_chunks_mut::<HALF>().0);
        for (((rows, red), green), blue) in rows.as_chunks::<HALF>().0.iter().zip(red).zip(green).zip(blue) {
            let mut colors = [Quarter::splat(simd, 0.0); HALF];
            for (color, &row) in colors.iter_mut().zip(rows) {
                *color = Quarter::from_slice(simd, &self.colors[row as usize]);
            }
            let [r, g, b, _] = transpose(colors);
            r.store_slice(red);
            g.store_slice(green);
            b.store_slice(blue);
        }
    }

    /// The features of some samples as columns: lane `l` of line `i` becomes column `16 i + l`, `stride` values apart.
    /// The number of rows is a whole number of lanes.
    #[inline(always)]
    pub(crate) fn gather_features<S: Simd>(&self, simd: S, rows: &[u32], columns: &mut [f32], stride: usize) {
        gather_columns(simd, &self.features, self.feature_lines, rows, columns, stride);
    }

    /// The same of positions and random parameters.
    #[inline(always)]
    pub(crate) fn gather_others<S: Simd>(&self, simd: S, rows: &[u32], columns: &mut [f32], stride: usize) {
        gather_columns(simd, &self.others, self.other_halves, rows, columns, stride);
    }
}

/// Copies what `sources` have of a run of samples into records, from the record `first` on.
#[inline(always)]
fn copy_row<S: Simd, P: Part>(
    simd: S,
    tile: &SampleTile,
    sources: impl Iterator<Item = Source>,
    samples: std::ops::Range<usize>,
    parts: usize,
    records: &mut [P],
    first: usize,
) {
    let mut sources = sources.map(|source| match source {
        Source::Plane(plane) => tile.plane(plane),
        Source::CenterX | Source::CenterY => &Plane::Constant(0.0),
    });
    let total = samples.len();
    let records = &mut records[first * parts..(first + total) * parts];
    for part in 0..parts {
        for column in (0..P::COLUMNS).step_by(HALF) {
            let planes = [(); HALF].map(|()| sources.next().unwrap_or(&Plane::Constant(0.0)));
            // Eight samples of each plane at a time; what is left at the end, and what is constant, is in copies.
            let (mut copies, whole) = ([[0.0; HALF]; HALF], total - total % HALF);
            let mut runs = [&[][..]; HALF];
            for k in 0..HALF {
                match planes[k] {
                    Plane::Values(values) => {
                        runs[k] = values[samples.start..samples.start + whole].as_chunks().0;
                        copies[k][..total - whole].copy_from_slice(&values[samples.start + whole..samples.end]);
                    }
                    Plane::Constant(value) => copies[k] = [*value; HALF],
                }
            }
            let groups = records.chunks_mut(HALF * parts);
            for (group, records) in groups.enumerate() {
                let mut values = [[Quarter::splat(simd, 0.0); HALF]; 2];
                for k in 0..HALF {
                    let run = runs[k].get(group).unwrap_or(&copies[k]);
                    values[0][k] = Quarter::from_slice(simd, &run[..QUARTER]);
                    values[1][k] = Quarter::from_slice(simd, &run[QUARTER..]);
                }
                let values = [transpose(values[0]), transpose(values[1])];
                for (record, value) in records[part..].iter_mut().step_by(parts).zip(values.as_flattened()) {
                    value.store_slice(&mut record.values_mut()[column..column + HALF]);
                }
            }
        }
    }
}

/// Records as columns, 8 rows by 4 columns at a time.
#[inline(always)]
fn gather_columns<S: Simd, P: Part>(
    simd: S,
    records: &[P],
    parts: usize,
    rows: &[u32],
    columns: &mut [f32],
    stride: usize,
) {
    let (rows, _) = rows.as_chunks::<HALF>();
    for part in 0..parts {
        for column in (0..P::COLUMNS).step_by(HALF) {
            let first = (part * P::COLUMNS + column) * stride;
            let mut columns = columns[first..first + HALF * stride].chunks_exact_mut(stride);
            let mut next = || columns.next().map(|column| &mut column.as_chunks_mut::<HALF>().0[..rows.len()]);
            let places = [(); HALF].map(|()| next().unwrap_or_default());
            let [a, b, c, d, e, f, g, h] = places;
            let places = a.iter_mut().zip(b).zip(c).zip(d).zip(e).zip(f).zip(g).zip(h);
            for (rows, (((((((a, b), c), d), e), f), g), h)) in rows.iter().zip(places) {
                let mut values = [[Quarter::splat(simd, 0.0); HALF]; 2];
                for (i, &row) in rows.iter().enumerate() {
                    let record = &records[row as usize * parts + part].values()[column..column + HALF];
                    values[0][i] = Quarter::from_slice(simd, &record[..QUARTER]);
                    values[1][i] = Quarter::from_slice(simd, &record[QUARTER..]);
                }
                for (values, places) in values.into_iter().zip([[a, b, c, d], [e, f, g, h]]) {
                    for (value, place) in transpose(values).into_iter().zip(places) {
                        value.store_slice(place);
                    }
                }
            }
        }
    }
}
