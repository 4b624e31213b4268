//! The information grid: weights at every G-th pixel of the image, interpolated bilinearly between.
//!
//! Nodes lie at image pixels whose x and y are multiples of G, the last one held inside the image. A node without
//! samples, or outside the data window, has no weights; its share goes to the others.

use super::iteration::{Pass, Scratch};
use super::weights::Weights;
use crate::filter::Rect;
use crate::filter::lanes::Simd;

/// Nodes that cover a region of the image.
#[derive(Debug)]
pub(crate) struct Grid {
    spacing: u32,
    image: Rect,
    /// First node, and number of nodes, in x and y.
    first: [u32; 2],
    size: [usize; 2],
    features: usize,
    /// Of each node, row by row: colour weights, confidence, feature weights; the confidence is NaN where there are none.
    nodes: Vec<f32>,
}

/// Values per node beside the features' weights.
const FIXED: usize = 4;

impl Grid {
    /// The nodes around the pixels of a region, without weights yet.
    pub(crate) fn new(spacing: u32, image: Rect, region: &Rect, features: usize) -> Self {
        let first = [region.x / spacing, region.y / spacing];
        let size = Self::nodes_of(spacing, region);
        Self { spacing, image, first, size, features, nodes: vec![f32::NAN; size[0] * size[1] * (FIXED + features)] }
    }

    /// Nodes in x and y around the pixels of a region.
    fn nodes_of(spacing: u32, region: &Rect) -> [usize; 2] {
        let count = |start: u32, end: u32| ((end - 1).div_ceil(spacing) + 1 - start / spacing) as usize;
        [count(region.x, region.right()), count(region.y, region.bottom())]
    }

    /// Bytes that [`Grid::new`] allocates.
    pub(crate) fn bytes(spacing: u32, region: &Rect, features: usize) -> u64 {
        let [columns, rows] = Self::nodes_of(spacing, region);
        (columns * rows * (FIXED + features) * size_of::<f32>()) as u64
    }

    /// The nodes' numbers in x and y from the first.
    pub(crate) const fn nodes(&self) -> Rect {
        Rect::new(0, 0, self.size[0] as u32, self.size[1] as u32)
    }

    /// Values per node.
    pub(crate) const fn values(&self) -> usize {
        FIXED + self.features
    }

    /// All nodes, to be computed: [`Grid::values`] of each, row by row.
    pub(crate) fn all(&mut self) -> &mut [f32] {
        &mut self.nodes
    }

    /// Where nodes lie, without being computed yet.
    pub(crate) const fn places(&self) -> Places {
        Places { spacing: self.spacing, image: self.image, first: self.first }
    }

    /// Whether all nodes around the pixels of a part of the region have weights.
    pub(crate) fn complete(&self, pixels: &Rect) -> bool {
        let last = |end: u32| (end - 1).div_ceil(self.spacing);
        let columns =
            (pixels.x / self.spacing - self.first[0]) as usize..=(last(pixels.right()) - self.first[0]) as usize;
        (pixels.y / self.spacing..=last(pixels.bottom())).all(|y| {
            let row = (y - self.first[1]) as usize * self.size[0];
            columns.clone().all(|x| !self.nodes[(row + x) * self.values() + 3].is_nan())
        })
    }

    /// Weights at a pixel of the region; false if none of the nodes around it has any.
    pub(crate) fn interpolate(&self, x: u32, y: u32, weights: &mut Weights) -> bool {
        let axis = |pixel: u32, size: u32| {
            let node = pixel / self.spacing;
            let (low, high) = (position(self.spacing, node, size), position(self.spacing, node + 1, size));
            let high_share = if high == low { 0.0 } else { (pixel - low) as f32 / (high - low) as f32 };
            [(node, 1.0 - high_share), (node + 1, high_share)]
        };
        let width = self.values();
        let mut total = 0.0;
        weights.color = [0.0; 3];
        weights.confidence = 0.0;
        weights.features.fill(0.0);
        for (node_y, share_y) in axis(y, self.image.height) {
            for (node_x, share_x) in axis(x, self.image.width) {
                let share = share_x * share_y;
                if share == 0.0 {
                    continue;
                }
                let (column, row) = ((node_x - self.first[0]) as usize, (node_y - self.first[1]) as usize);
                let node = &self.nodes[(row * self.size[0] + column) * width..][..width];
                if node[3].is_nan() {
                    continue;
                }
                total += share;
                for (weight, value) in weights.color.iter_mut().zip(&node[..3]) {
                    *weight += share * value;
                }
                weights.confidence += share * node[3];
                for (weight, value) in weights.features.iter_mut().zip(&node[FIXED..]) {
                    *weight += share * value;
                }
            }
        }
        if total == 0.0 {
            return false;
        }
        let rest = weights.features.iter_mut().chain(&mut weights.color).chain([&mut weights.confidence]);
        rest.for_each(|weight| *weight /= total);
        true
    }
}

/// Where the nodes of a grid lie.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Places {
    spacing: u32,
    image: Rect,
    first: [u32; 2],
}

impl Places {
    /// Image position of a node, by its number from the first.
    fn of(&self, column: u32, row: u32) -> (u32, u32) {
        let at = |node, size| position(self.spacing, node, size);
        (at(self.first[0] + column, self.image.width), at(self.first[1] + row, self.image.height))
    }

    /// Whether any pixel that the weights of a node are interpolated for is filtered at all.
    fn needed(&self, pass: &Pass, x: u32, y: u32) -> bool {
        let around = Rect::new(x, y, 1, 1).grown(self.spacing - 1, &pass.tile.geometry().window());
        let mut rows = around.y..around.bottom();
        pass.settled.is_empty() || rows.any(|y| (around.x..around.right()).any(|x| !pass.settled(x, y)))
    }

    /// Computes the weights of a block of nodes, numbered from the first; `rows` holds the values of each of its rows.
    #[inline(always)]
    pub(crate) fn weigh<S: Simd>(
        &self,
        simd: S,
        pass: &Pass,
        scratch: &mut Scratch,
        nodes: &Rect,
        rows: Vec<&mut [f32]>,
    ) {
        let window = pass.tile.geometry().window();
        let (x, y) = self.of(nodes.x, nodes.y);
        let (right, bottom) = self.of(nodes.right() - 1, nodes.bottom() - 1);
        let Some(pixels) = Rect::new(x, y, right - x + 1, bottom - y + 1).intersection(&window) else { return };
        pass.load(simd, scratch, &pixels, true);
        for (row, values) in (nodes.y..).zip(rows) {
            let length = values.len() / nodes.width as usize;
            for (column, node) in (nodes.x..).zip(values.chunks_exact_mut(length)) {
                let (x, y) = self.of(column, row);
                let here = !pass.execution.stopped() && pixels.contains(x, y) && self.needed(pass, x, y);
                if here && pass.weigh(simd, scratch, x, y) {
                    let Weights { color, features, confidence } = &scratch.weights;
                    node[..3].copy_from_slice(color);
                    node[3] = *confidence;
                    node[FIXED..].copy_from_slice(features);
                }
            }
        }
    }
}

/// Image position of a node, along one axis of an image of this size.
const fn position(spacing: u32, node: u32, size: u32) -> u32 {
    let position = node as u64 * spacing as u64;
    if position >= size as u64 { size - 1 } else { position as u32 }
}
