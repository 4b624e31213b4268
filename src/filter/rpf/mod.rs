//! Random Parameter Filtering, one file per part of the algorithm.
//!
//! | step | file |
//! |---|---|
//! | the samples around a block of pixels | `block.rs` |
//! | 1 neighbourhood | `neighborhood.rs`, `cluster.rs` |
//! | 2 normalising | `statistics.rs` |
//! | 3 dependencies | `information.rs` |
//! | 4 weights | `weights.rs`, `grid.rs` |
//! | 5 filter | `bilateral.rs` |
//! | 6 spikes | `spikes.rs` |
//! | what is left out | `relevance.rs`, and what that saves: `work.rs` |
//! | what is passed through on request | `settled.rs` |
//! | iterations | `iteration.rs` (one pass), and this file |

mod bilateral;
mod block;
mod cluster;
mod grid;
mod information;
mod iteration;
mod neighborhood;
pub mod params;
mod random;
mod relevance;
mod settled;
mod spikes;
#[cfg(feature = "bench")]
#[doc(hidden)]
pub mod stages;
mod statistics;
mod weights;
pub(crate) mod work;

#[cfg(test)]
mod tests;

pub use neighborhood::Offsets;
pub use params::Params;

use super::finish::finish;
use super::lanes::dispatch;
use super::plan::{Plan, Shape};
use super::share::{blocks, blocks_bytes, share_out};
use super::{Execution, Filtered, Plane, Rect, Report, Role, SampleTile, Stopped, TileGeometry, Work};
use block::ColumnOrder;
use grid::Grid;
use iteration::{Pass, Room, Scratch};
use relevance::Relevant;

/// Side of the blocks of pixels that a thread takes at a time: what such a block reaches should stay in the cache, and
/// there should be blocks enough for all threads to the end.
const BLOCK: u32 = 16;

/// Side of the blocks of nodes that a thread takes at a time.
const fn node_block_side(spacing: u32) -> u32 {
    if spacing >= 32 { 1 } else { 32 / spacing }
}

/// Room for the greatest block and neighbourhood of a tile of this shape.
fn room(geometry: &TileGeometry, params: &Params, samples: u64, max_per_pixel: u32, varying: bool) -> Room {
    let window = geometry.window();
    let pixels = (0..params.boxes.len()).map(|t| {
        let (radius, region) = (params.boxes[t] / 2, region(geometry, params, varying, t));
        let nodes = match params.information_grid {
            1 => 0,
            spacing => (node_block_side(spacing) - 1) * spacing + 1,
        };
        let across = |region: u32, window: u32| (BLOCK.min(region).max(nodes) + 2 * radius).min(window) as usize;
        across(region.width, window.width) * across(region.height, window.height)
    });
    let pixels = pixels.max().unwrap_or(0);
    let samples = (pixels * max_per_pixel as usize).min(samples as usize);
    Room { pixels, samples, rows: most_rows(params, max_per_pixel as usize) }
}

/// What iteration `t` has to compute: what later ones read, inside the data window.
pub(super) fn region(geometry: &TileGeometry, params: &Params, varying: bool, t: usize) -> Rect {
    let later: u32 = (t + 1..params.boxes.len()).map(|t| params.reach_of(t)).sum();
    geometry.core().grown(later + if varying { params.fill_reach() } else { 0 }, &geometry.window())
}

/// Bytes for the method's own buffers: whole tile, and per thread.
pub(super) fn plan(shape: &Shape, params: &Params) -> Plan {
    let count = |wanted: fn(&Role) -> bool| shape.channels.planes_of(wanted).len();
    let features = count(|role| matches!(role, Role::Feature { .. }));
    // Without a film position the pixel's centre takes its place.
    let order = ColumnOrder::new(features, 2, count(|role| matches!(role, Role::Random { .. })));
    let region = region(shape.geometry, params, shape.varying, 0);
    let pixels = shape.geometry.window().area();
    let grid = match params.information_grid {
        1 => 0,
        spacing => Grid::bytes(spacing, &region, features),
    };
    let room = room(shape.geometry, params, shape.samples, shape.max_per_pixel, shape.varying);
    Plan {
        working: shape.samples * 2 * 3 * 4
            + grid
            + (room.rows as u64 + 1) * 8
            + blocks_bytes(&region)
            + settled::bytes(params, pixels),
        per_thread: Scratch::bytes(&order, &room, shape.varying, params.bins),
        ..Plan::default()
    }
}

/// Rows of the greatest neighbourhood.
fn most_rows(params: &Params, max_per_pixel: usize) -> usize {
    (0..params.boxes.len()).map(|t| params.neighbors(t, max_per_pixel)).max().unwrap_or(0)
}

/// The samples, and their pixels in the data window, that the draws around a pixel end at, before any is rejected;
/// `offsets` are those of iteration `t`.
pub(super) fn draws(
    offsets: &Offsets,
    tile: &SampleTile,
    params: &Params,
    seed: u64,
    t: usize,
    x: u32,
    y: u32,
) -> impl Iterator<Item = (usize, usize)> {
    let (image, window) = (tile.geometry().image(), tile.geometry().window());
    let own = tile.samples_of(window.index(x, y)).len();
    let center = neighborhood::Center { x, y, key: random::pixel_key(seed, x, y, t), wanted: params.neighbors(t, own) };
    (0..(center.wanted - own) as u64).filter_map(move |draw| {
        let (pixel, bits) = neighborhood::candidate(&image, &window, offsets, &center, draw)?;
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
    let room = room(tile.geometry(), params, tile.total() as u64, tile.max_per_pixel(), tile.varying());
    let terms = information::entropy_terms(room.rows);
    let mut scratches = Vec::with_capacity(execution.threads());
    scratches.resize_with(execution.threads(), || Scratch::new(tile, &relevant, params, &room, execution.leave_out));
    let settled = settled::settled(tile, params);
    let mut colors = interleaved_colors(tile);
    let mut next = vec![0.0; colors.len()];
    let iterations = params.boxes.len();
    for t in 0..iterations {
        let region = region(tile.geometry(), params, tile.varying(), t);
        let offsets = Offsets::new(params.boxes[t]);
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
    let Pass { tile, params, execution, .. } = *pass;
    let level = execution.simd.level();
    let window = tile.geometry().window();
    let spacing = params.information_grid;
    let grid = (spacing > 1).then(|| {
        let mut grid = Grid::new(spacing, tile.geometry().image(), region, pass.relevant.features().len());
        let (places, nodes, values) = (grid.places(), grid.nodes(), grid.values());
        let end = |x: u32, y: u32| (y as usize * nodes.width as usize + x as usize) * values;
        let blocks = blocks(nodes, node_block_side(spacing), grid.all(), end);
        share_out(execution, scratches, blocks, |scratch, (nodes, rows)| {
            dispatch!(level, simd => places.weigh(simd, pass, scratch, &nodes, rows));
        });
        grid
    });
    // Where the values of the pixels left of x end.
    let end = |x: u32, y: u32| match x == window.x {
        true => 3 * tile.samples_of(window.index(x, y)).start,
        false => 3 * tile.samples_of(window.index(x - 1, y)).end,
    };
    let blocks = blocks(*region, BLOCK, next, end);
    share_out(execution, scratches, blocks, |scratch, (pixels, rows)| {
        dispatch!(level, simd => pass.block(simd, scratch, grid.as_ref(), &pixels, rows));
    });
}

/// Mean of a pixel's filtered samples; none if it has no samples.
fn pixel_mean(tile: &SampleTile, colors: &[f32], x: u32, y: u32) -> Option<[f64; 3]> {
    let samples = tile.samples_of(tile.geometry().window().index(x, y));
    let count = samples.len() as f64;
    (count > 0.0)
        .then(|| std::array::from_fn(|k| samples.clone().map(|s| f64::from(colors[3 * s + k])).sum::<f64>() / count))
}
