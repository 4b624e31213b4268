//! How to get through a file of tiles within a budget of memory: as they come, or cut anew from a spool.
//!
//! Tiles of a whole image that bring the halo that the method reads, and fit, are filtered as they come. All others are cut from the cores
//! by the least work that fits: in memory if large tiles fit beside the spool, else from a temporary file. The pixels
//! are the same either way.

use super::{failure::Failure, input::Input};
use crate::{
    config::ByteSize,
    filter::{
        Method, Rect, TileGeometry,
        geometry::tiling,
        plan::{Shape, plan},
    },
};

/// Sizes of cut tiles, in pixels. Larger ones have less halo to compute twice, but beyond the first that is little.
const SIZES: [u32; 12] = [512, 448, 384, 320, 256, 192, 128, 96, 64, 48, 32, 16];

/// A spool in memory must leave room for tiles of this size, or as large as with one on disk.
const WORTHWHILE: u32 = 256;

/// Bytes for each tile of the file, and each that is cut, beside its planes: where it is, and what became of it.
const PER_TILE: u64 = 1 << 10;
/// The same for each of its planes.
const PER_PLANE: u64 = 32;
/// Buffers of files.
const BUFFERS: u64 = 4 << 20;

/// How to get through a file of tiles.
pub(crate) struct Schedule {
    pub(crate) way: Way,
    /// Bytes that this needs at most, all in all.
    pub(crate) bytes: u64,
}

/// Where the tiles come from that are filtered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// The file's own, one after the other.
    AsTheyCome,
    /// Cores of at most `size` x `size` pixels, cut from a spool.
    Cut { size: u32, on_disk: bool },
}

impl Schedule {
    /// The best way that takes at most `memory` bytes, on so many threads.
    pub(crate) fn new(input: &Input, method: &Method, threads: usize, memory: ByteSize) -> Result<Self, Failure> {
        let cost = |shape: &Shape| plan(shape, method).total(threads);
        let summary = &input.summary;
        let planes = summary.first.channels().planes() as u64;
        let records = |tiles: u64| tiles * (PER_TILE + PER_PLANE * planes) + BUFFERS;
        // A halo may hold samples of missing tiles, which a spool of cores has not: the image must not depend on the way.
        let ready = summary.missing.is_empty()
            && summary.tiles.iter().all(|tile| {
                let needed = tile.geometry.halo_for(method.reach(tile.varying));
                tile.geometry.halo().covers(&needed)
            });
        if ready {
            let largest = summary.tiles.iter().map(|tile| cost(&input.shape_of(tile))).max().unwrap_or(0);
            let bytes = largest + records(summary.tiles.len() as u64) + summary.window_bytes;
            if bytes <= memory.0 {
                return Ok(Self { way: Way::AsTheyCome, bytes });
            }
        }
        let rows: u64 =
            summary.tiles.iter().filter(|t| t.varying).map(|t| u64::from(t.geometry.core().height) + 1).sum();
        let mut least = u64::MAX;
        let mut on_disk = None;
        for size in SIZES {
            let mut cores = 0;
            let mut largest = 0;
            for geometry in cut_tiles(input, method, size) {
                largest = largest.max(cost(&input.shape(&geometry)));
                cores += 1;
            }
            // While the file is read no tile is there yet.
            let largest = largest.max(summary.window_bytes);
            let bytes = largest + records(cores + summary.tiles.len() as u64) + 8 * rows;
            least = least.min(bytes);
            if bytes > memory.0 {
                continue;
            }
            let (found, _) = *on_disk.get_or_insert((size, bytes));
            let beside = bytes + summary.spool_bytes;
            if beside <= memory.0 && (size == found || size >= WORTHWHILE) {
                return Ok(Self { way: Way::Cut { size, on_disk: false }, bytes: beside });
            }
            if size < WORTHWHILE {
                break;
            }
        }
        match on_disk {
            Some((size, bytes)) => Ok(Self { way: Way::Cut { size, on_disk: true }, bytes }),
            None => {
                // Rounded up, so that what is asked for is enough.
                let least = ByteSize(least.div_ceil(1 << 20) << 20);
                let why =
                    format!("--memory {memory} is not enough for this file on {threads} threads: at least {least}");
                Err(Failure::usage("memory", why))
            }
        }
    }
}

/// The tiles to be cut, row by row: cores of `size` x `size` pixels, only the parts of them that are there, with the halo
/// that the method reads.
pub(crate) fn cut_tiles(input: &Input, method: &Method, size: u32) -> impl Iterator<Item = TileGeometry> {
    let (image, reach) = (input.image(), method.reach(input.varying()));
    let cores = tiling(image, size).flat_map(move |core: Rect| input.present(&core));
    cores.filter_map(move |core| TileGeometry::with_halo(image, core, reach).ok())
}
