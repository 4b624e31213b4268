//! Which pixels of an image a set of rectangles covers, each pixel at most once.

use std::collections::BTreeMap;

use crate::filter::Rect;

/// Rectangles that do not overlap, each with a value, found by where they are.
///
/// They are kept in grids, one for each class of sizes (the powers of two that hold width and height), in the cell of
/// their corner. A query looks at the cells that can reach into its window: with tiles of like size, a few.
#[derive(Clone, Debug)]
pub struct Coverage<T> {
    grids: BTreeMap<(u32, u32), Grid>,
    items: Vec<(Rect, T)>,
    area: u64,
}

/// Indices of rectangles by (row, column) of the cell that holds their corner.
type Grid = BTreeMap<(u32, u32), Vec<usize>>;

impl<T> Default for Coverage<T> {
    fn default() -> Self {
        Self { grids: BTreeMap::new(), items: Vec::new(), area: 0 }
    }
}

impl<T> Coverage<T> {
    /// Adds a rectangle; if it overlaps another, nothing is added and the other returned.
    pub fn insert(&mut self, rect: Rect, value: T) -> Result<(), Rect> {
        if let Some((other, _)) = self.meeting(&rect).next() {
            return Err(*other);
        }
        let (row_bits, column_bits) = class(&rect);
        let cell = (rect.y >> row_bits, rect.x >> column_bits);
        self.grids.entry((row_bits, column_bits)).or_default().entry(cell).or_default().push(self.items.len());
        self.items.push((rect, value));
        self.area += rect.area();
        Ok(())
    }

    /// The rectangles that overlap this window, with their values, in no order that means anything.
    pub fn meeting(&self, window: &Rect) -> impl Iterator<Item = &(Rect, T)> {
        let mut found = Vec::new();
        for ((row_bits, column_bits), grid) in &self.grids {
            // A rectangle is at most as large as a cell, so it reaches no further than into the next one.
            let rows = (window.y >> row_bits).saturating_sub(1)..=(window.bottom() - 1) >> row_bits;
            let columns = (window.x >> column_bits).saturating_sub(1)..=(window.right() - 1) >> column_bits;
            let near = |items: &[usize]| {
                items.iter().copied().filter(|&i| self.items[i].0.intersection(window).is_some()).collect::<Vec<_>>()
            };
            if (rows.end() - rows.start()) as usize > grid.len() {
                found.extend(grid.values().flat_map(|items| near(items)));
                continue;
            }
            for row in rows {
                let cells = grid.range((row, *columns.start())..=(row, *columns.end()));
                found.extend(cells.flat_map(|(_, items)| near(items)));
            }
        }
        found.into_iter().map(|index| &self.items[index])
    }

    /// All rectangles in the order in which they came.
    pub fn items(&self) -> &[(Rect, T)] {
        &self.items
    }

    /// Pixels that are covered.
    pub const fn area(&self) -> u64 {
        self.area
    }

    /// The parts of a window that no rectangle covers, as rectangles that do not overlap, from the top down; empty if
    /// all of it is covered.
    pub fn missing(&self, window: &Rect) -> Vec<Rect> {
        // Between two rows where a rectangle starts or ends every row has the same gaps.
        let mut starts: BTreeMap<u32, Vec<Rect>> = BTreeMap::new();
        let mut edges = vec![window.y, window.bottom()];
        for part in self.meeting(window).filter_map(|(rect, _)| rect.intersection(window)) {
            edges.extend([part.y, part.bottom()]);
            starts.entry(part.y).or_default().push(part);
        }
        edges.sort_unstable();
        edges.dedup();
        let mut active: BTreeMap<u32, Rect> = BTreeMap::new();
        let mut gaps: Vec<Rect> = Vec::new();
        // Gaps of the band above, which grow if the next band has the same.
        let mut above: BTreeMap<(u32, u32), usize> = BTreeMap::new();
        for band in edges.windows(2) {
            let (top, bottom) = (band[0], band[1]);
            active.retain(|_, rect| rect.bottom() > top);
            active.extend(starts.get(&top).into_iter().flatten().map(|rect| (rect.x, *rect)));
            let mut here = BTreeMap::new();
            let mut x = window.x;
            let ends = active.values().map(|rect| (rect.x, rect.right()));
            for (left, right) in ends.chain([(window.right(), window.right())]) {
                if left > x {
                    let index = match above.get(&(x, left)) {
                        Some(&index) => {
                            gaps[index].height += bottom - top;
                            index
                        }
                        None => {
                            gaps.push(Rect::new(x, top, left - x, bottom - top));
                            gaps.len() - 1
                        }
                    };
                    here.insert((x, left), index);
                }
                x = right;
            }
            above = here;
        }
        gaps
    }
}

/// Powers of two that hold height and width.
const fn class(rect: &Rect) -> (u32, u32) {
    (rect.height.next_power_of_two().trailing_zeros(), rect.width.next_power_of_two().trailing_zeros())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small generator, for tests only.
    fn random(state: &mut u64, below: u32) -> u32 {
        *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((*state >> 33) % u64::from(below)) as u32
    }

    #[test]
    fn agrees_with_a_map_of_pixels() {
        const SIDE: u32 = 24;
        let mut state = 7;
        for _ in 0..200 {
            let (mut coverage, mut pixels) = (Coverage::default(), [[false; SIDE as usize]; SIDE as usize]);
            for index in 0..30 {
                let (x, y) = (random(&mut state, SIDE), random(&mut state, SIDE));
                let width = 1 + random(&mut state, (SIDE - x).min(9));
                let rect = Rect::new(x, y, width, 1 + random(&mut state, (SIDE - y).min(9)));
                let covered = |p: &[[bool; 24]; 24], r: &Rect| {
                    (r.y..r.bottom()).any(|y| (r.x..r.right()).any(|x| p[y as usize][x as usize]))
                };
                let free = !covered(&pixels, &rect);
                assert_eq!(coverage.insert(rect, index).is_ok(), free);
                if free {
                    (rect.y..rect.bottom())
                        .for_each(|y| (rect.x..rect.right()).for_each(|x| pixels[y as usize][x as usize] = true));
                }
            }
            let (x, y) = (random(&mut state, 12), random(&mut state, 12));
            let window = Rect::new(x, y, 12, 12);
            let missing = coverage.missing(&window);
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
    fn gaps_are_merged() {
        let mut coverage = Coverage::default();
        for tile in crate::filter::geometry::tiling([1000, 1000], 10) {
            if !Rect::new(100, 200, 10, 300).covers(&tile) {
                coverage.insert(tile, ()).unwrap();
            }
        }
        assert_eq!(coverage.missing(&Rect::new(0, 0, 1000, 1000)), [Rect::new(100, 200, 10, 300)]);
        assert_eq!(coverage.missing(&Rect::new(0, 0, 1100, 100)), [Rect::new(1000, 0, 100, 100)]);
        assert_eq!(coverage.area(), 1_000_000 - 3000);
    }
}
