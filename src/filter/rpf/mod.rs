//! Random Parameter Filtering, one file per part of the algorithm.
//!
//! | step | file |
//! |---|---|
//! | 1 neighbourhood | `neighborhood.rs` |
//! | 2 normalising | `statistics.rs` |
//! | 3 dependencies | `information.rs` |
//! | 4 weights | `weights.rs`, `grid.rs` |
//! | 5 filter | `bilateral.rs` |
//! | 6 spikes | `spikes.rs` |
//! | what is left out | `relevance.rs`, and what that saves: `work.rs` |
//! | what is passed through on request | `settled.rs` |
//! | iterations | `iteration.rs` (one pass), and this file |

mod bilateral;
mod grid;
mod information;
mod iteration;
mod neighborhood;
pub mod params;
mod random;
mod relevance;
mod settled;
mod spikes;
mod statistics;
mod weights;
pub(crate) mod work;

#[cfg(test)]
mod tests;

pub use params::Params;

use super::finish::finish;
use super::lanes::dispatch;
use super::plan::{Plan, Shape};
use super::share::share_out;
use super::{Execution, Filtered, Plane, Rect, Report, SampleTile, Stopped, TileGeometry, Work};
use grid::Grid;
use iteration::{Pass, Scratch};
use relevance::Relevant;

/// Rows of pixels that a thread takes at a time.
const BAND: u32 = 8;

/// What iteration `t` has to compute: what later ones read, inside the data window.
pub(super) fn region(geometry: &TileGeometry, params: &Params, varying: bool, t: usize) -> Rect {
    let later: u32 = (t + 1..params.boxes.len()).map(|t| params.reach_of(t)).sum();
    geometry.core().grown(later + if varying { params.fill_reach() } else { 0 }, &geometry.window())
}

/// Bytes for the method's own buffers: whole tile, and per thread.
pub(super) fn plan(shape: &Shape, params: &Params) -> Plan {
    let features = shape.channels.planes_of(|role| matches!(role, super::Role::Feature { .. })).len();
    // Without a film position the pixel's centre takes its place.
    let film = shape.channels.planes_of(|role| matches!(role, super::Role::Film)).len();
    let columns = shape.channels.planes() + 2 - film;
    let rows = most_rows(params, shape.max_per_pixel as usize);
    let pixels = shape.geometry.window().area();
    let grid = match params.information_grid {
        1 => 0,
        spacing => Grid::bytes(spacing, &region(shape.geometry, params, shape.varying, 0), features),
    };
    Plan {
        working: shape.samples * 2 * 3 * 4 + grid + (rows as u64 + 1) * 8 + settled::bytes(params, pixels),
        per_thread: Scratch::bytes(columns, features, rows, params.bins),
        ..Plan::default()
    }
}

/// Rows of the greatest neighbourhood.
fn most_rows(params: &Params, max_per_pixel: usize) -> usize {
    (0..params.boxes.len()).map(|t| params.neighbors(t, max_per_pixel)).max().unwrap_or(0)
}

/// The samples, and their pixels in the data window, that the draws around a pixel end at, before any is rejected.
pub(super) fn draws(
    tile: &SampleTile,
    params: &Params,
    seed: u64,
    t: usize,
    x: u32,
    y: u32,
) -> impl Iterator<Item = (usize, usize)> {
    let (image, window) = (tile.geometry().image(), tile.geometry().window());
    let own = tile.samples_of(window.index(x, y)).len();
    let offsets = neighborhood::Offsets::new(params.boxes[t]);
    let center = neighborhood::Center { x, y, key: random::pixel_key(seed, x, y, t), wanted: params.neighbors(t, own) };
    (0..(center.wanted - own) as u64).filter_map(move |draw| {
        let (pixel, bits) = neighborhood::candidate(&image, &window, &offsets, &center, draw)?;
        let samples = tile.samples_of(pixel);
        (!samples.is_empty()).then(|| (pixel, neighborhood::pick_sample(bits, &samples) as usize))
    })
}

/// Filters a tile.
pub(super) fn filter(tile: &SampleTile, params: &Params, execution: &Execution) -> Result<Filtered, Stopped> {
    let (colors, report) = iterate(tile, params, execution, |_| {})?;
    finish(tile, |x, y| pixel_mean(tile, &colors, x, y), params.fill_reach(), report, execution)
}

/// Filters a tile, and keeps the colours of all samples (R, G, B next to each other) after each iteration; outside what
/// an iteration has to compute they mean nothing. For comparison with the [oracle](super::oracle).
pub fn trace(tile: &SampleTile, params: &Params, execution: &Execution) -> Result<Vec<Vec<f32>>, Stopped> {
    let mut trace = Vec::with_capacity(params.boxes.len());
    iterate(tile, params, execution, |colors| trace.push(colors.to_vec()))?;
    Ok(trace)
}

/// All iterations; `after` sees the colours after each.
fn iterate(
    tile: &SampleTile,
    params: &Params,
    execution: &Execution,
    mut after: impl FnMut(&[f32]),
) -> Result<(Vec<f32>, Report), Stopped> {
    let relevant = Relevant::of(tile, execution.leave_out);
    let rows = most_rows(params, tile.max_per_pixel() as usize);
    let terms = information::entropy_terms(rows);
    let threads = execution.threads();
    let mut scratches = Vec::with_capacity(threads);
    scratches.resize_with(threads, || Scratch::new(&relevant, rows, params.bins, execution.leave_out));
    let settled = settled::settled(tile, params);
    let mut colors = interleaved_colors(tile);
    let mut next = vec![0.0; colors.len()];
    let iterations = params.boxes.len();
    for t in 0..iterations {
        let region = region(tile.geometry(), params, tile.varying(), t);
        let offsets = neighborhood::Offsets::new(params.boxes[t]);
        let (relevant, terms, settled) = (&relevant, &terms, &settled);
        let pass = Pass { tile, relevant, params, t, execution, offsets, terms, settled, colors: &colors };
        run(&pass, &region, &mut scratches, &mut next);
        if execution.stopped() {
            return Err(Stopped);
        }
        std::mem::swap(&mut colors, &mut next);
        after(&colors);
        if let Some(progress) = execution.progress {
            progress((t + 1) as f32 / iterations as f32);
        }
    }
    let spikes = scratches.iter().map(|scratch| scratch.spikes).sum();
    let mut work = Work::default();
    scratches.iter().for_each(|scratch| work += scratch.work);
    drop((scratches, next));
    let (core, window) = (tile.geometry().core(), tile.geometry().window());
    let inside = (core.y..core.bottom()).flat_map(|y| (core.x..core.right()).map(move |x| window.index(x, y)));
    let settled = inside.filter(|&pixel| settled.get(pixel) == Some(&true) && !tile.samples_of(pixel).is_empty());
    let report = Report {
        replaced: tile.replaced(),
        settled: settled.clone().count() as u64,
        settled_error: settled.fold(0.0, |sum, pixel| sum + settled::error(tile, pixel)),
        spikes,
        halo: tile.geometry().halo(),
        halo_needed: tile.geometry().halo_for(params.reach(tile.varying())),
        work: Some(work),
        ..Report::default()
    };
    let report = report.leaving_out(relevant.left_out, tile);
    Ok((colors, report))
}

/// The colours of all samples, R, G, B next to each other.
fn interleaved_colors(tile: &SampleTile) -> Vec<f32> {
    let mut colors = vec![0.0; 3 * tile.total()];
    for (channel, plane) in tile.channels().color_planes().into_iter().enumerate() {
        let place = colors.iter_mut().skip(channel).step_by(3);
        match tile.plane(plane) {
            Plane::Constant(value) => place.for_each(|c| *c = *value),
            Plane::Values(values) => place.zip(values).for_each(|(c, value)| *c = *value),
        }
    }
    colors
}

/// One iteration over a region, from `pass.colors` to `next`.
fn run(pass: &Pass, region: &Rect, scratches: &mut [Scratch], next: &mut [f32]) {
    let execution = pass.execution;
    let level = execution.simd.level();
    let window = pass.tile.geometry().window();
    let spacing = pass.params.information_grid;
    let grid = (spacing > 1).then(|| {
        let image = pass.tile.geometry().image();
        let mut grid = Grid::new(spacing, image, region, pass.relevant.features().len());
        let (rows, nodes) = grid.rows();
        share_out(execution, scratches, nodes, |scratch, (row, nodes)| {
            dispatch!(level, simd => rows.weigh(simd, pass, scratch, row, nodes));
        });
        grid
    });
    let bands = (region.y..region.bottom()).step_by(BAND as usize).scan((next, 0), |(rest, done), y| {
        let band = Rect::new(region.x, y, region.width, BAND.min(region.bottom() - y));
        let first = 3 * pass.tile.samples_of(window.index(window.x, band.y)).start;
        let end = 3 * pass.tile.samples_of(window.index(window.right() - 1, band.bottom() - 1)).end;
        let (out, after) = std::mem::take(rest)[first - *done..].split_at_mut(end - first);
        (*rest, *done) = (after, end);
        Some((band, out))
    });
    share_out(execution, scratches, bands, |scratch, (band, out)| {
        dispatch!(level, simd => pass.band(simd, scratch, grid.as_ref(), &band, out));
    });
}

/// Mean of a pixel's filtered samples; none if it has no samples.
fn pixel_mean(tile: &SampleTile, colors: &[f32], x: u32, y: u32) -> Option<[f64; 3]> {
    let samples = tile.samples_of(tile.geometry().window().index(x, y));
    let count = samples.len() as f64;
    (count > 0.0)
        .then(|| std::array::from_fn(|k| samples.clone().map(|s| f64::from(colors[3 * s + k])).sum::<f64>() / count))
}
