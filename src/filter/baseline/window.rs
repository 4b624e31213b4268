//! The loop that the baselines share: every pixel becomes a weighted mean of the pixels in a square around it.
//!
//! A weight is the Gaussian over distance times exp(-d), d the sum of squared and scaled differences in whatever a method
//! compares ([`Distances`]). The means of all pixels are laid out first, in rows with a margin on both sides that does not
//! count, so that the square around a pixel is whole lanes anywhere: a pixel's place in its lane depends on nothing but
//! its offset, and sums have the same order in every tile.
//!
//! Weights over distance add up to 1, so sums of colours up to the greatest f32 do not overflow; colours below 1e-30 lose
//! precision. A result lies between the least and the greatest of the colours that counted, which makes a constant
//! image stay as it is, exactly.

use super::gaussian;
use super::mean::mean;
use crate::filter::finish::finish;
use crate::filter::lanes::{LANES, Lanes, Simd, dispatch, exp_neg, padded, prelude::*, sum};
use crate::filter::plan::{Plan, Shape};
use crate::filter::share::share_out;
use crate::filter::{
    ChannelSet, Execution, Filtered, LeftOut, LeftOutReason, Rect, Report, Role, SampleTile, Stopped, TileGeometry,
};
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

/// A method that is this loop.
pub(crate) trait Windowed: Sync {
    /// Whether it looks at features.
    const FEATURES: bool;
    /// The Gaussian over distance.
    fn space(&self) -> &gaussian::Params;
    /// What it compares in a tile, and which planes it need not look at although it could.
    fn distances(&self, tile: &SampleTile, leave_out: bool) -> (Distances, Vec<LeftOut>);
    /// Most columns that it compares.
    fn most_columns(&self, channels: &ChannelSet) -> usize;
}

/// What a method compares.
#[derive(Debug, Default)]
pub(crate) struct Distances {
    pub(super) columns: Vec<Column>,
    pub(super) groups: Vec<Group>,
}

/// One value per pixel that is compared.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Column {
    /// The plane that it is the mean of.
    pub(super) plane: usize,
    pub(super) value: Value,
}

/// What becomes of a plane's samples in a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Value {
    /// Their mean.
    Color,
    /// sign(m) ln(1 + |m|) of their mean m.
    LogColor,
    /// The mean of those that are not NaN; [`MISSING`] if all are.
    Feature,
}

/// Columns that are compared as one vector.
#[derive(Clone, Debug)]
pub(crate) struct Group {
    /// Which.
    pub(super) columns: Range<usize>,
    /// A difference's variance is sigma^2 + (deviations x the standard deviation of the pixel's own samples)^2; if that
    /// is 0 they are not compared.
    pub(super) sigma: f64,
    pub(super) deviations: f64,
}

/// Stands for the mean of a feature that no sample of a pixel has: equal to itself, and too far from all else to count.
const MISSING: f32 = f32::MAX;

/// The first planes of the means: whether a pixel counts (0 or 1), and its R, G, B. Compared columns follow.
const COUNTS: usize = 0;
const COLOR: usize = 1;
const COMPARED: usize = 4;

/// A column that counts for the pixel that is being filtered.
#[derive(Clone, Copy, Debug)]
struct Active {
    /// Index among the planes of the means.
    plane: usize,
    /// The filtered pixel's own value.
    own: f32,
    /// What a difference is scaled by.
    factor: f32,
}

/// Where the means of pixels lie: planes of rows, each row with a margin on both sides.
#[derive(Clone, Copy, Debug)]
struct Layout {
    window: Rect,
    radius: usize,
    /// Values from row to row.
    stride: usize,
    /// Values from plane to plane.
    plane: usize,
}

impl Layout {
    fn new(geometry: &TileGeometry, radius: u32) -> Self {
        let (window, radius) = (geometry.window(), radius as usize);
        // The lanes of the last pixel's square end where the row ends.
        let stride = window.width as usize - 1 + padded(2 * radius + 1);
        Self { window, radius, stride, plane: stride * window.height as usize }
    }
}

/// What has to be computed: the core, and what pixels without samples may be filled from.
fn region(geometry: &TileGeometry, space: &gaussian::Params, varying: bool) -> Rect {
    geometry.core().grown(if varying { space.radius() } else { 0 }, &geometry.window())
}

/// Bytes for a method's own buffers: whole tile, and per thread.
pub(crate) fn plan(shape: &Shape, method: &impl Windowed) -> Plan {
    let space = method.space();
    let layout = Layout::new(shape.geometry, space.radius());
    let columns = method.most_columns(shape.channels);
    let means = (layout.plane * (COMPARED + columns) * size_of::<f32>()) as u64;
    let filtered = region(shape.geometry, space, shape.varying).area() * 3 * size_of::<f32>() as u64;
    let per_thread = (columns * size_of::<Active>()) as u64;
    Plan { working: means + filtered, per_thread, ..Plan::default() }
}

/// Filters a tile.
pub(crate) fn filter<W: Windowed>(tile: &SampleTile, method: &W, execution: &Execution) -> Result<Filtered, Stopped> {
    let space = method.space();
    let (distances, mut left_out) = method.distances(tile, execution.leave_out);
    left_out.extend(unused(tile, W::FEATURES));
    let layout = Layout::new(tile.geometry(), space.radius());
    let mut scratches = Vec::with_capacity(execution.threads());
    scratches.resize_with(execution.threads(), || Vec::with_capacity(distances.columns.len()));
    let mut means = vec![0.0; layout.plane * (COMPARED + distances.columns.len())];
    share_out(execution, &mut scratches, means.chunks_exact_mut(layout.plane).enumerate(), |_, (plane, means)| {
        let column = match plane {
            COUNTS => None,
            COLOR..COMPARED => {
                Some(Column { plane: tile.channels().color_planes()[plane - COLOR], value: Value::Color })
            }
            _ => Some(distances.columns[plane - COMPARED]),
        };
        average(tile, column, &layout, means, execution);
    });
    let weights = space.weights();
    let filter = Filter { tile, distances: &distances, layout, means: &means, weights: &weights };
    let region = region(tile.geometry(), space, tile.varying());
    let mut filtered = vec![0.0; 3 * region.area() as usize];
    let rows = filtered.chunks_exact_mut(3 * region.width as usize).zip(region.y..);
    let (level, done) = (execution.simd.level(), AtomicUsize::new(0));
    share_out(execution, &mut scratches, rows, |active, (out, y)| {
        if !execution.stopped() {
            dispatch!(level, simd => filter.row(simd, active, region.x, y, out));
        }
        if let Some(progress) = execution.progress {
            progress((done.fetch_add(1, Ordering::Relaxed) + 1) as f32 / region.height as f32);
        }
    });
    if execution.stopped() {
        return Err(Stopped);
    }
    let report = Report {
        replaced: tile.replaced(),
        halo: tile.geometry().halo(),
        halo_needed: tile.geometry().halo_for(space.reach(tile.varying())),
        ..Report::default()
    };
    let report = report.leaving_out(left_out, tile);
    let pixel = |x, y| {
        let counts = !tile.samples_of(layout.window.index(x, y)).is_empty();
        counts.then(|| std::array::from_fn(|k| f64::from(filtered[3 * region.index(x, y) + k])))
    };
    finish(tile, pixel, space.radius(), report, execution)
}

/// The planes of roles that a method, which looks at features or not, does not look at.
fn unused(tile: &SampleTile, features: bool) -> impl Iterator<Item = LeftOut> {
    let unused = move |role: &Role| match role {
        Role::Color => false,
        Role::Feature { .. } => !features,
        Role::Film | Role::Random { .. } => true,
    };
    let channels = tile.channels();
    let planes = channels.planes_of(unused).into_iter();
    planes.map(|plane| LeftOut { plane: channels.plane_name(plane), reason: LeftOutReason::Unused })
}

/// Fills one plane of the means; without a column, with 1 for every pixel that has samples. Pixels that have none, and
/// the margins, stay 0.
fn average(tile: &SampleTile, column: Option<Column>, layout: &Layout, means: &mut [f32], execution: &Execution) {
    let width = layout.window.width as usize;
    for (row, means) in means.chunks_exact_mut(layout.stride).enumerate() {
        if execution.stopped() {
            return;
        }
        for (x, out) in means[layout.radius..][..width].iter_mut().enumerate() {
            let samples = tile.samples_of(row * width + x);
            if samples.is_empty() {
                continue;
            }
            *out = match column {
                None => 1.0,
                Some(Column { plane, value }) => {
                    let values = samples.map(|sample| tile.value(plane, sample));
                    match value {
                        Value::Color => mean(values) as f32,
                        Value::LogColor => {
                            let mean = mean(values);
                            libm::copysign(libm::log1p(mean.abs()), mean) as f32
                        }
                        Value::Feature => moments(values).map_or(MISSING, |(mean, _)| mean as f32),
                    }
                }
            };
        }
    }
}

/// Mean and variance (with n, not n - 1) of the values that are not NaN, if there are any; two-pass in f64, so that equal
/// values have exactly no variance, however far from 0.
fn moments(values: impl Iterator<Item = f32> + Clone) -> Option<(f64, f64)> {
    let present = values.filter(|v| !v.is_nan()).map(f64::from);
    let count = present.clone().count() as f64;
    (count > 0.0).then(|| {
        let mean = present.clone().sum::<f64>() / count;
        (mean, present.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count)
    })
}

/// All that filtering reads.
struct Filter<'a> {
    tile: &'a SampleTile,
    distances: &'a Distances,
    layout: Layout,
    means: &'a [f32],
    /// Along one axis, padded.
    weights: &'a [f32],
}

impl Filter<'_> {
    /// Filters the pixels of image row `y` from `x` on into `out`, R, G, B next to each other.
    #[inline(always)]
    fn row<S: Simd>(&self, simd: S, active: &mut Vec<Active>, x: u32, y: u32, out: &mut [f32]) {
        let window = self.layout.window;
        let (x, y) = ((x - window.x) as usize, (y - window.y) as usize);
        for (x, out) in (x..).zip(out.chunks_exact_mut(3)) {
            let samples = self.tile.samples_of(y * window.width as usize + x);
            if !samples.is_empty() {
                self.compare(active, x, y, &samples);
                out.copy_from_slice(&self.pixel(simd, active, x, y));
            }
        }
    }

    /// Sets what counts as a difference from a pixel (in coordinates of the data window).
    fn compare(&self, active: &mut Vec<Active>, x: usize, y: usize, samples: &Range<usize>) {
        active.clear();
        let own =
            |plane: usize| self.means[plane * self.layout.plane + y * self.layout.stride + self.layout.radius + x];
        for Group { columns, sigma, deviations } in &self.distances.groups {
            if sigma + deviations == 0.0 {
                continue;
            }
            let mut variance = sigma * sigma;
            for column in columns.clone().filter(|_| *deviations > 0.0) {
                let plane = self.distances.columns[column].plane;
                let own = moments(samples.clone().map(|sample| self.tile.value(plane, sample)));
                variance += deviations * deviations * own.map_or(0.0, |(_, variance)| variance);
            }
            let factor = (variance > 0.0).then(|| (0.5 / variance).sqrt().min(1e30) as f32);
            for plane in columns.clone().map(|column| COMPARED + column) {
                let own = own(plane);
                // A pixel that lacks a feature has no scale for it, and needs none: all else is too far.
                if let Some(factor) = factor.or((own == MISSING).then_some(1.0)) {
                    active.push(Active { plane, own, factor });
                }
            }
        }
    }

    /// One filtered pixel (in coordinates of the data window).
    #[inline(always)]
    fn pixel<S: Simd>(&self, simd: S, active: &[Active], x: usize, y: usize) -> [f32; 3] {
        let Layout { window, radius, stride, plane } = self.layout;
        let splat = |v: f32| Lanes::splat(simd, v);
        let zero = splat(0.0);
        let (mut total, mut sums) = (zero, [zero; 3]);
        let (mut least, mut greatest) = ([splat(f32::INFINITY); 3], [splat(f32::NEG_INFINITY); 3]);
        for row in y.saturating_sub(radius)..(y + radius + 1).min(window.height as usize) {
            let vertical = splat(self.weights[row + radius - y]);
            for (chunk, horizontal) in self.weights.chunks_exact(LANES).enumerate() {
                let start = row * stride + x + chunk * LANES;
                let load = |index: usize| Lanes::from_slice(simd, &self.means[index * plane + start..][..LANES]);
                let mut weight = Lanes::from_slice(simd, horizontal) * vertical * load(COUNTS);
                if !active.is_empty() {
                    let mut distance = zero;
                    for column in active {
                        let difference = (load(column.plane) - splat(column.own)) * splat(column.factor);
                        distance += difference * difference;
                    }
                    weight *= exp_neg(simd, distance);
                }
                let counts = weight.simd_gt(zero);
                total += weight;
                for k in 0..3 {
                    let color = load(COLOR + k);
                    sums[k] += weight * color;
                    least[k] = least[k].min(counts.select(color, least[k]));
                    greatest[k] = greatest[k].max(counts.select(color, greatest[k]));
                }
            }
        }
        let total = sum(total);
        std::array::from_fn(|k| {
            let least = least[k].to_array().into_iter().fold(f32::INFINITY, f32::min);
            let greatest = greatest[k].to_array().into_iter().fold(f32::NEG_INFINITY, f32::max);
            (sum(sums[k]) / total).max(least).min(greatest)
        })
    }
}
