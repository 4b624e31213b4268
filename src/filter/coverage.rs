//! Which cores of an image are known, and which pixels none of them covers.
//!
//! Cores come in any order and any sizes, and none overlaps another. They are listed in grids, one for each class of
//! sizes (the powers of two that hold width and height), in the cell of their corner: a query looks at the cells that
//! can reach into its window, with tiles of like size a few.

use super::Rect;
use std::collections::{BTreeMap, HashMap};

/// Known cores, apart from each other, with a value each.
#[derive(Clone, Debug)]
pub struct Coverage<T> {
    /// By (y, x) of the corner.
    cores: BTreeMap<(u32, u32), (Rect, T)>,
    grids: BTreeMap<(u32, u32), Cells>,
}

/// Cores by (row, column) of the cell that holds their corner.
type Cells = BTreeMap<(u32, u32), Vec<Rect>>;

impl<T> Default for Coverage<T> {
    fn default() -> Self {
        Self { cores: BTreeMap::new(), grids: BTreeMap::new() }
    }
}

impl<T> Coverage<T> {
    /// The value of a core, if exactly this core is known.
    pub fn get(&self, core: &Rect) -> Option<&T> {
        self.cores.get(&(core.y, core.x)).filter(|(known, _)| known == core).map(|(_, value)| value)
    }

    /// As [`Self::get`], to change the value.
    pub fn get_mut(&mut self, core: &Rect) -> Option<&mut T> {
        self.cores.get_mut(&(core.y, core.x)).filter(|(known, _)| known == core).map(|(_, value)| value)
    }

    /// Known cores that have a pixel in common with a window, with their values, by rows (y, then x).
    pub fn meeting(&self, window: &Rect) -> Vec<(Rect, &T)> {
        let mut found: Vec<Rect> = Vec::new();
        for ((row_bits, column_bits), grid) in &self.grids {
            // A core is at most as large as a cell, so it reaches no further than into the next one.
            let rows = (window.y >> row_bits).saturating_sub(1)..=(window.bottom() - 1) >> row_bits;
            let columns = (window.x >> column_bits).saturating_sub(1)..=(window.right() - 1) >> column_bits;
            let mut near = |cell: &Vec<Rect>| found.extend(cell.iter().filter(|c| c.intersection(window).is_some()));
            if (rows.end() - rows.start()) as usize > grid.len() {
                grid.values().for_each(near);
                continue;
            }
            for row in rows {
                grid.range((row, *columns.start())..=(row, *columns.end())).for_each(|(_, cell)| near(cell));
            }
        }
        found.sort_unstable_by_key(|core| (core.y, core.x));
        found.into_iter().filter_map(|core| Some((core, self.get(&core)?))).collect()
    }

    /// Adds a core with pixels. If it has some in common with a known one, which it may equal, nothing is added and that
    /// one returned.
    pub fn insert(&mut self, core: Rect, value: T) -> Result<(), Rect> {
        if let Some((other, _)) = self.meeting(&core).first() {
            return Err(*other);
        }
        let (class, cell) = place(&core);
        self.grids.entry(class).or_default().entry(cell).or_default().push(core);
        self.cores.insert((core.y, core.x), (core, value));
        Ok(())
    }

    /// Forgets a core.
    pub fn remove(&mut self, core: &Rect) -> Option<T> {
        self.get(core)?;
        let (class, cell) = place(core);
        if let Some(grid) = self.grids.get_mut(&class) {
            if let Some(cores) = grid.get_mut(&cell) {
                cores.retain(|other| other != core);
                if cores.is_empty() {
                    grid.remove(&cell);
                }
            }
            if grid.is_empty() {
                self.grids.remove(&class);
            }
        }
        self.cores.remove(&(core.y, core.x)).map(|(_, value)| value)
    }

    /// Number of known cores.
    pub fn len(&self) -> usize {
        self.cores.len()
    }

    /// Whether no core is known.
    pub fn is_empty(&self) -> bool {
        self.cores.is_empty()
    }

    /// All known cores, by rows: ordered by y, then by x.
    pub fn iter(&self) -> impl Iterator<Item = (Rect, &T)> {
        self.cores.values().map(|(core, value)| (*core, value))
    }

    /// The parts of a window that no core covers, as few rectangles that do not overlap, by rows (y, then x).
    pub fn missing(&self, window: &Rect) -> Vec<Rect> {
        self.missing_but(window, |_| true)
    }

    /// As [`Self::missing`], counting only cores whose value passes.
    pub fn missing_but(&self, window: &Rect, counts: impl Fn(&T) -> bool) -> Vec<Rect> {
        let counted = self.meeting(window).into_iter().filter(|(_, value)| counts(value));
        let mut parts: Vec<Rect> = counted.filter_map(|(core, _)| core.intersection(window)).collect();
        parts.sort_unstable_by_key(|part| (part.y, part.x));
        gaps(*window, parts)
    }
}

/// The class of a core's size, as powers of two that hold height and width, and its cell in the grid of that class.
const fn place(core: &Rect) -> ((u32, u32), (u32, u32)) {
    let class = (core.height.next_power_of_two().trailing_zeros(), core.width.next_power_of_two().trailing_zeros());
    (class, (core.y >> class.0, core.x >> class.1))
}

/// The pixels of a rectangle that no core covers, as few rectangles that do not overlap, by rows (y, then x).
///
/// `cores` are inside the image, apart from each other, and ordered by (y, x). A line sweeps downwards and keeps the free runs of the current row with the
/// row that each began at: O(n log n) for n cores.
fn gaps(image: Rect, cores: impl IntoIterator<Item = Rect>) -> Vec<Rect> {
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

    fn random(state: &mut u64, below: u32) -> u32 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((*state >> 33) % u64::from(below)) as u32
    }

    fn shuffled(mut cores: Vec<Rect>, mut state: u64) -> Vec<Rect> {
        for i in (1..cores.len()).rev() {
            cores.swap(i, random(&mut state, i as u32 + 1) as usize);
        }
        cores
    }

    #[test]
    fn agrees_with_a_map_of_pixels() {
        const SIDE: u32 = 24;
        let mut state = 7;
        for _ in 0..300 {
            let (mut coverage, mut pixels) = (Coverage::default(), [[false; SIDE as usize]; SIDE as usize]);
            for _ in 0..30 {
                let (x, y) = (random(&mut state, SIDE), random(&mut state, SIDE));
                let width = 1 + random(&mut state, (SIDE - x).min(9));
                let rect = Rect::new(x, y, width, 1 + random(&mut state, (SIDE - y).min(9)));
                let inside =
                    |rect: Rect| (rect.y..rect.bottom()).flat_map(move |y| (rect.x..rect.right()).map(move |x| (x, y)));
                let free = inside(rect).all(|(x, y)| !pixels[y as usize][x as usize]);
                assert_eq!(coverage.insert(rect, ()).is_ok(), free);
                if free {
                    inside(rect).for_each(|(x, y)| pixels[y as usize][x as usize] = true);
                }
            }
            let (x, y) = (random(&mut state, 12), random(&mut state, 12));
            let window = Rect::new(x, y, 12, 12);
            let missing = coverage.missing(&window);
            assert!(missing.is_sorted_by_key(|gap| (gap.y, gap.x)));
            for y in 0..SIDE {
                for x in 0..SIDE {
                    let times = missing.iter().filter(|r| r.contains(x, y)).count();
                    let wanted = window.contains(x, y) && !pixels[y as usize][x as usize];
                    assert_eq!(times, usize::from(wanted), "({x}, {y})");
                }
            }
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
    fn cores_are_found_forgotten_and_counted_by_value() {
        let mut coverage = Coverage::default();
        coverage.insert(Rect::new(10, 0, 10, 10), 1).unwrap();
        coverage.insert(Rect::new(20, 0, 500, 10), 2).unwrap();
        assert_eq!(coverage.insert(Rect::new(10, 0, 10, 10), 3), Err(Rect::new(10, 0, 10, 10)));
        assert_eq!(coverage.meeting(&Rect::new(0, 0, 10, 10)), []);
        let found = coverage.meeting(&Rect::new(10, 0, 11, 10));
        assert_eq!(found, [(Rect::new(10, 0, 10, 10), &1), (Rect::new(20, 0, 500, 10), &2)]);
        assert_eq!(coverage.get(&Rect::new(10, 0, 10, 9)), None);
        let window = Rect::new(0, 0, 520, 10);
        assert_eq!(coverage.missing(&window), [Rect::new(0, 0, 10, 10)]);
        assert_eq!(coverage.missing_but(&window, |&value| value == 2), [Rect::new(0, 0, 20, 10)]);
        assert_eq!(coverage.remove(&Rect::new(10, 0, 10, 10)), Some(1));
        assert_eq!(coverage.missing(&window), [Rect::new(0, 0, 20, 10)]);
    }

    /// Many tiles, and tall thin ones that all overlap in y, are no quadratic trap: this test would take minutes.
    #[test]
    fn many_cores_are_quick() {
        let cores = shuffled(tiling([64 * 142, 64 * 142], 64).collect(), 3);
        let mut coverage = Coverage::default();
        cores[..20_000].iter().for_each(|core| coverage.insert(*core, ()).unwrap());
        assert!(coverage.missing(&Rect::new(0, 0, 64 * 142, 64 * 142)).len() <= cores.len() - 20_000);
        let mut coverage = Coverage::default();
        (0..20_000).for_each(|x| coverage.insert(Rect::new(x, x * 7 % 19_000, 1, 20_000), ()).unwrap());
        assert!(coverage.missing(&Rect::new(0, 0, 20_000, 40_000)).len() > 20_000);
    }
}
