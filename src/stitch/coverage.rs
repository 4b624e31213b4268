//! Which cores of an image are known, and which pixels none of them covers.
//!
//! Cores come in any order and any sizes; two of them are either equal or apart. A coarse grid over the image lists the
//! cores that touch each of its cells, so that a new core is compared with its neighbours only.

use crate::filter::Rect;
use std::collections::{BTreeMap, HashMap};

/// Cells of the grid along each side of the image. Bounds the work and the memory of one huge core, and keeps the lists
/// short: 20 000 equal tiles are about 5 a cell.
const CELLS: u32 = 64;

/// Known cores with a value each.
#[derive(Debug)]
pub struct Coverage<V> {
    image: Rect,
    cores: BTreeMap<(u32, u32), (Rect, V)>,
    cell: [u32; 2],
    grid: Vec<Vec<Rect>>,
}

impl<V> Coverage<V> {
    /// No core yet, of an image at (0, 0).
    pub fn new(width: u32, height: u32) -> Self {
        let cell = [width.div_ceil(CELLS).max(1), height.div_ceil(CELLS).max(1)];
        let grid = std::iter::repeat_with(Vec::new).take((CELLS * CELLS) as usize).collect();
        Self { image: Rect::new(0, 0, width, height), cores: BTreeMap::new(), cell, grid }
    }

    /// The image as a rectangle at (0, 0).
    pub const fn image(&self) -> Rect {
        self.image
    }

    /// The value of a core, if exactly this core is known.
    pub fn get(&self, core: &Rect) -> Option<&V> {
        self.cores.get(&(core.y, core.x)).filter(|(known, _)| known == core).map(|(_, value)| value)
    }

    /// As [`Self::get`], to change the value.
    pub fn get_mut(&mut self, core: &Rect) -> Option<&mut V> {
        self.cores.get_mut(&(core.y, core.x)).filter(|(known, _)| known == core).map(|(_, value)| value)
    }

    /// Known cores that have a pixel in common with `core` but are not equal to it, in no particular order.
    pub fn overlapping(&self, core: &Rect) -> Vec<Rect> {
        let mut found: Vec<Rect> = (self.cells(core).flat_map(|cell| &self.grid[cell]))
            .filter(|other| *other != core && core.intersection(other).is_some())
            .copied()
            .collect();
        found.sort_unstable_by_key(|other| (other.y, other.x));
        found.dedup();
        found
    }

    /// Adds a core, or changes the value of a known one.
    ///
    /// The core has pixels, lies inside the image and overlaps no other one ([`Self::overlapping`] is empty).
    pub fn insert(&mut self, core: Rect, value: V) {
        debug_assert!(self.image.covers(&core) && core.area() > 0 && self.overlapping(&core).is_empty());
        if self.cores.insert((core.y, core.x), (core, value)).is_none() {
            for cell in self.cells(&core) {
                self.grid[cell].push(core);
            }
        }
    }

    /// Forgets a core.
    pub fn remove(&mut self, core: &Rect) -> Option<V> {
        self.get(core)?;
        for cell in self.cells(core) {
            self.grid[cell].retain(|other| other != core);
        }
        self.cores.remove(&(core.y, core.x)).map(|(_, value)| value)
    }

    /// All known cores, by rows: ordered by y, then by x.
    pub fn iter(&self) -> impl Iterator<Item = (Rect, &V)> {
        self.cores.values().map(|(core, value)| (*core, value))
    }

    fn cells(&self, core: &Rect) -> impl Iterator<Item = usize> + use<V> {
        let [width, height] = self.cell;
        let columns = core.x / width..=(core.right() - 1) / width;
        let rows = core.y / height..=(core.bottom() - 1) / height;
        rows.flat_map(move |row| columns.clone().map(move |column| (row * CELLS + column) as usize))
    }
}

/// The pixels of an image that no core covers, as few rectangles that do not overlap, by rows (y, then x).
///
/// `cores` are inside the image, apart from each other, and ordered by (y, x). The result depends on the set of covered
/// pixels' cores only, not on when they came. A line sweeps downwards and keeps the free runs of the current row with the
/// row that each began at: O(n log n) for n cores.
pub fn gaps(image: Rect, cores: impl IntoIterator<Item = Rect>) -> Vec<Rect> {
    let opening: Vec<Rect> = cores.into_iter().collect();
    let mut closing = opening.clone();
    closing.sort_unstable_by_key(|core| (core.bottom(), core.x));
    let mut free = FreeRuns { runs: BTreeMap::from([(image.x, (image.right(), image.y))]), found: Vec::new() };
    let mut closing = closing.into_iter().peekable();
    for core in opening {
        // Everything that ends above this core's first row, or right there, is free again before the core takes its run.
        while let Some(ended) = closing.next_if(|other| other.bottom() <= core.y) {
            free.release(ended);
        }
        free.take(core);
    }
    for ended in closing {
        free.release(ended);
    }
    free.finish(image.bottom())
}

struct FreeRuns {
    /// Left end of each free run of the current row -> its right end, and the row that it began at.
    runs: BTreeMap<u32, (u32, u32)>,
    found: Vec<Rect>,
}

impl FreeRuns {
    fn emit(&mut self, left: u32, right: u32, top: u32, bottom: u32) {
        if right > left && bottom > top {
            self.found.push(Rect::new(left, top, right - left, bottom - top));
        }
    }

    fn take(&mut self, core: Rect) {
        let Some((&left, &(right, top))) = self.runs.range(..=core.x).next_back() else { return };
        self.runs.remove(&left);
        self.emit(left, right, top, core.y);
        if left < core.x {
            self.runs.insert(left, (core.x, core.y));
        }
        if core.right() < right {
            self.runs.insert(core.right(), (right, core.y));
        }
    }

    fn release(&mut self, core: Rect) {
        let (mut left, mut right, y) = (core.x, core.right(), core.bottom());
        if let Some((&start, &(end, top))) = self.runs.range(..left).next_back()
            && end == left
        {
            self.runs.remove(&start);
            self.emit(start, end, top, y);
            left = start;
        }
        if let Some((end, top)) = self.runs.remove(&right) {
            self.emit(right, end, top, y);
            right = end;
        }
        self.runs.insert(left, (right, y));
    }

    fn finish(mut self, bottom: u32) -> Vec<Rect> {
        for (left, (right, top)) in std::mem::take(&mut self.runs) {
            self.emit(left, right, top, bottom);
        }
        // A run that only looked interrupted, because its neighbour changed, is put together again.
        self.found.sort_unstable_by_key(|gap| (gap.y, gap.x));
        let mut merged: Vec<Rect> = Vec::new();
        let mut ending_at: HashMap<[u32; 3], usize> = HashMap::new();
        for gap in self.found {
            let index = match ending_at.remove(&[gap.x, gap.width, gap.y]) {
                Some(above) => {
                    merged[above].height += gap.height;
                    above
                }
                None => {
                    merged.push(gap);
                    merged.len() - 1
                }
            };
            ending_at.insert([gap.x, gap.width, gap.bottom()], index);
        }
        merged
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::geometry::tiling;

    fn shuffled(mut cores: Vec<Rect>, mut state: u64) -> Vec<Rect> {
        for i in (1..cores.len()).rev() {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            cores.swap(i, (state >> 33) as usize % (i + 1));
        }
        cores
    }

    /// Cuts a rectangle into irregular pieces.
    fn pieces(rect: Rect, state: &mut u64, out: &mut Vec<Rect>) {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let random = (*state >> 33) as u32;
        let Rect { x, y, width, height } = rect;
        if random.is_multiple_of(5) || (width < 2 && height < 2) {
            out.push(rect);
        } else if (random.is_multiple_of(2) && width > 1) || height < 2 {
            let cut = 1 + (random >> 4) % (width - 1);
            pieces(Rect::new(x, y, cut, height), state, out);
            pieces(Rect::new(x + cut, y, width - cut, height), state, out);
        } else {
            let cut = 1 + (random >> 4) % (height - 1);
            pieces(Rect::new(x, y, width, cut), state, out);
            pieces(Rect::new(x, y + cut, width, height - cut), state, out);
        }
    }

    #[test]
    fn gaps_are_exactly_the_pixels_not_covered() {
        for seed in 0..300 {
            let image = Rect::new(0, 0, 23, 17);
            let mut cores = Vec::new();
            let mut state = seed;
            pieces(image, &mut state, &mut cores);
            let mut cores = shuffled(cores, seed);
            cores.truncate(cores.len() / 2 + seed as usize % 3);
            let mut coverage = Coverage::new(23, 17);
            for &core in &cores {
                assert!(coverage.overlapping(&core).is_empty());
                coverage.insert(core, ());
            }
            let missing = gaps(image, coverage.iter().map(|(core, ())| core));
            let mut count = [0; 23 * 17];
            for rect in cores.iter().chain(&missing) {
                for y in rect.y..rect.bottom() {
                    for x in rect.x..rect.right() {
                        count[(y * 23 + x) as usize] += 1;
                    }
                }
            }
            assert!(count.iter().all(|&n| n == 1), "seed {seed}: {cores:?} {missing:?}");
            assert!(missing.is_sorted_by_key(|gap| (gap.y, gap.x)));
        }
    }

    #[test]
    fn gaps_are_few() {
        let image = Rect::new(0, 0, 64, 64);
        assert_eq!(gaps(image, []), [image]);
        assert_eq!(gaps(image, [image]), []);
        let hole = Rect::new(16, 16, 16, 32);
        let cores = tiling([64, 64], 16).filter(|core| !hole.covers(core));
        assert_eq!(gaps(image, cores), [hole]);
        let cores = tiling([64, 64], 16).filter(|core| core.y != 32);
        assert_eq!(gaps(image, cores), [Rect::new(0, 32, 64, 16)]);
    }

    #[test]
    fn overlaps_are_found_and_equals_are_not_overlaps() {
        let mut coverage = Coverage::new(1000, 10);
        coverage.insert(Rect::new(10, 0, 10, 10), 1);
        coverage.insert(Rect::new(20, 0, 500, 10), 2);
        assert_eq!(coverage.overlapping(&Rect::new(10, 0, 10, 10)), []);
        assert_eq!(coverage.overlapping(&Rect::new(0, 0, 10, 10)), []);
        assert_eq!(coverage.overlapping(&Rect::new(0, 0, 11, 1)), [Rect::new(10, 0, 10, 10)]);
        assert_eq!(
            coverage.overlapping(&Rect::new(10, 0, 11, 10)),
            [Rect::new(10, 0, 10, 10), Rect::new(20, 0, 500, 10)]
        );
        assert_eq!(coverage.get(&Rect::new(10, 0, 10, 9)), None);
        assert_eq!(coverage.remove(&Rect::new(10, 0, 10, 10)), Some(1));
        assert_eq!(coverage.overlapping(&Rect::new(0, 0, 11, 1)), []);
    }

    #[test]
    fn twenty_thousand_tiles_are_quick() {
        let cores = shuffled(tiling([64 * 142, 64 * 142], 64).collect(), 3);
        let start = std::time::Instant::now();
        let mut coverage = Coverage::new(64 * 142, 64 * 142);
        for &core in &cores[..20_000] {
            assert!(coverage.overlapping(&core).is_empty());
            coverage.insert(core, ());
        }
        let missing = gaps(coverage.image(), coverage.iter().map(|(core, ())| core));
        assert!(missing.len() <= cores.len() - 20_000);
        assert!(start.elapsed().as_secs_f64() < 5.0, "took {:?}", start.elapsed());
    }

    #[test]
    fn staggered_columns_are_no_quadratic_trap() {
        let columns = (0..20_000).map(|x| Rect::new(x, x * 7 % 19_000, 1, 20_000));
        let start = std::time::Instant::now();
        let mut coverage = Coverage::new(20_000, 40_000);
        columns.for_each(|core| {
            assert!(coverage.overlapping(&core).is_empty());
            coverage.insert(core, ());
        });
        assert!(gaps(coverage.image(), coverage.iter().map(|(core, ())| core)).len() > 20_000);
        assert!(start.elapsed().as_secs_f64() < 10.0, "took {:?}", start.elapsed());
    }
}
