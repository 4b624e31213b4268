//! Work shared out among the threads that were given.

use super::{Execution, Rect};
use std::sync::Mutex;

/// Works through the items, each thread with its own scratch, each taking the next item when it is done with one.
pub(crate) fn share_out<S: Send, T: Send>(
    execution: &Execution,
    scratches: &mut [S],
    items: impl Iterator<Item = T> + Send,
    work: impl Fn(&mut S, T) + Sync,
) {
    match execution.pool {
        Some(pool) => {
            let items = Mutex::new(items);
            let next = || items.lock().ok().and_then(|mut items| items.next());
            pool.scope(|scope| {
                for scratch in scratches {
                    scope.spawn(|_| {
                        while let Some(item) = next() {
                            work(scratch, item);
                        }
                    });
                }
            });
        }
        None => {
            if let Some(scratch) = scratches.first_mut() {
                items.for_each(|item| work(scratch, item));
            }
        }
    }
}

/// The blocks of a region, row by row, each with its rows' parts of `data`. `end(x, y)` is where, in `data`, what belongs
/// to the pixels left of x in row y ends, x being at most the region's right edge; rows follow one another.
pub(crate) fn blocks<'a, T>(
    region: Rect,
    side: u32,
    data: &'a mut [T],
    end: impl Fn(u32, u32) -> usize,
) -> impl Iterator<Item = (Rect, Vec<&'a mut [T]>)> {
    let bands = (region.y..region.bottom()).step_by(side as usize).scan((data, 0), move |(rest, done), top| {
        let height = side.min(region.bottom() - top);
        let mut blocks: Vec<(Rect, Vec<&'a mut [T]>)> = (region.x..region.right())
            .step_by(side as usize)
            .map(|x| (Rect::new(x, top, side.min(region.right() - x), height), Vec::with_capacity(height as usize)))
            .collect();
        for y in top..top + height {
            let mut take = |until: usize| {
                let (taken, after) = std::mem::take(rest).split_at_mut(until - *done);
                (*rest, *done) = (after, until);
                taken
            };
            take(end(region.x, y));
            for (block, rows) in &mut blocks {
                rows.push(take(end(block.right(), y)));
            }
        }
        Some(blocks)
    });
    bands.flatten()
}

/// Bytes that [`blocks`] allocates at most, at any time, for the blocks of a region.
pub(crate) const fn blocks_bytes(region: &Rect) -> u64 {
    region.width as u64 * 24 + 4096
}
