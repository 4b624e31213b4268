//! The whole of RPF by the oracle's steps: windows with a halo, holes, nodes without samples, missing film and features.
//!
//! Every plane is computed with, constant or not: that leaving planes out changes nothing is the fast path's claim.

use super::super::rpf::{Offsets, Params, draws, region};
use super::super::{Rect, Role, SampleTile};
use super::{
    Cluster, Color, Columns, Weights, bin, cover, deviation, filter, mean, normalise, pixel, tame_spikes, weigh,
};
use std::collections::HashMap;

/// Within this of a bin's edge, in deviations, a value may fall either way in f32.
const NEAR_BIN: f64 = 1e-5;
/// Clusters are compared in f64 by both, whose sums may run in different orders.
const NEAR_CLUSTER: f64 = 1e-9;
/// Within this of the spike limit, relative to the pixel's size, a sample may be a spike or not in f32.
const NEAR_SPIKE: f64 = 1e-5;

/// Errors of pixels are computed in f64 by both, too.
const NEAR_SETTLED: f64 = 1e-9;

/// A tile to be filtered as a whole.
pub struct Whole<'a> {
    tile: &'a SampleTile,
    params: &'a Params,
    seed: u64,
    /// Of each iteration.
    offsets: Vec<Offsets>,
    film: Vec<usize>,
    random: Vec<usize>,
    /// Planes, and how many deviations a candidate may be off.
    features: Vec<(usize, f64)>,
}

/// What one iteration made. Pixels are those of the data window; those outside the iteration's region stay as they were.
#[derive(Clone, Debug)]
pub struct Step {
    /// Colours of all samples.
    pub colors: Vec<Color>,
    /// Of each pixel: the mean of its samples' filtered absolute colours, against which rounding errors are to be
    /// measured; where no colour is negative that is the pixel itself. Plus what f32 cannot see: exp(-80) of the
    /// greatest colour around.
    pub size: Vec<Color>,
    /// Of each pixel: how many decisions were so near that f32 may have decided otherwise.
    pub near: Vec<u32>,
}

/// A pixel's neighbourhood.
struct Neighbourhood {
    rows: Vec<usize>,
    pixels: Vec<usize>,
    near: u32,
}

impl<'a> Whole<'a> {
    /// Of a tile; `seed` keys the draws, as it does those of the fast path.
    pub fn new(tile: &'a SampleTile, params: &'a Params, seed: u64) -> Self {
        let planes = |wanted: fn(&Role) -> bool| tile.channels().planes_of(wanted);
        let features = tile.channels().plane_channels().enumerate().filter_map(|(plane, (channel, _))| {
            let Role::Feature { position } = channel.role else { return None };
            Some((plane, if position { params.position_threshold } else { params.feature_threshold }))
        });
        let features = features.collect();
        let film = planes(|role| matches!(role, Role::Film));
        let random = planes(|role| matches!(role, Role::Random { .. }));
        let offsets = params.boxes.iter().map(|&width| Offsets::new(width)).collect();
        Self { tile, params, seed, offsets, film, random, features }
    }

    /// The colours before the first iteration.
    pub fn colors(&self) -> Vec<Color> {
        let planes = self.tile.channels().color_planes();
        (0..self.tile.total()).map(|s| planes.map(|plane| f64::from(self.tile.value(plane, s)))).collect()
    }

    /// What iteration `t` has to compute.
    pub fn region(&self, t: usize) -> Rect {
        region(self.tile.geometry(), self.params, self.tile.varying(), t)
    }

    /// All iterations, and the core's pixels after them.
    pub fn image(&self) -> Vec<Color> {
        let mut colors = self.colors();
        for t in 0..self.params.boxes.len() {
            colors = Self::stored(self.step(t, &colors).colors);
        }
        self.pixels(&colors)
    }

    /// As colours are kept between iterations: in f32. Without, what f32 cannot tell from a constant would be normalised
    /// to unit deviation.
    pub fn stored(mut colors: Vec<Color>) -> Vec<Color> {
        colors.iter_mut().flatten().for_each(|v| *v = f64::from(*v as f32));
        colors
    }

    fn plane(&self, plane: usize, rows: &[usize]) -> Vec<f64> {
        rows.iter().map(|&s| f64::from(self.tile.value(plane, s))).collect()
    }

    fn neighbourhood(&self, t: usize, x: u32, y: u32) -> Neighbourhood {
        let pixel = self.tile.geometry().window().index(x, y);
        let own: Vec<usize> = self.tile.samples_of(pixel).collect();
        let clusters = self.features.iter().map(|&(plane, deviations)| {
            (plane, Cluster::of(&self.plane(plane, &own), deviations, self.params.threshold_floor))
        });
        let clusters: Vec<_> = clusters.collect();
        let mut found = Neighbourhood { pixels: vec![pixel; own.len()], rows: own, near: 0 };
        for (pixel, sample) in draws(&self.offsets[t], self.tile, self.params, self.seed, t, x, y) {
            let mut accepted = true;
            for (plane, cluster) in &clusters {
                let (inside, margin) = cluster.accepts(f64::from(self.tile.value(*plane, sample)));
                accepted &= inside;
                found.near += u32::from(margin < NEAR_CLUSTER);
            }
            if accepted {
                found.rows.push(sample);
                found.pixels.push(pixel);
            }
        }
        found
    }

    fn columns(&self, around: &Neighbourhood, colors: &[Color]) -> Columns {
        let window = self.tile.geometry().window();
        let planes = |planes: &[usize]| planes.iter().map(|&p| self.plane(p, &around.rows)).collect();
        let centers = |at: &dyn Fn(u32) -> u32| -> Vec<f64> {
            around.pixels.iter().map(|&pixel| f64::from(at(pixel as u32)) + 0.5).collect()
        };
        Columns {
            positions: if self.film.is_empty() {
                vec![centers(&|i| window.x + i % window.width), centers(&|i| window.y + i / window.width)]
            } else {
                planes(&self.film)
            },
            random: planes(&self.random),
            features: self.features.iter().map(|&(plane, _)| self.plane(plane, &around.rows)).collect(),
            colors: (0..3).map(|k| around.rows.iter().map(|&s| colors[s][k]).collect()).collect(),
        }
    }

    /// Weights at a pixel, and near decisions; none without samples.
    fn weights_at(&self, t: usize, x: u32, y: u32, colors: &[Color]) -> Option<(Weights, u32)> {
        let window = self.tile.geometry().window();
        if !window.contains(x, y) || self.tile.samples_of(window.index(x, y)).is_empty() {
            return None;
        }
        let around = self.neighbourhood(t, x, y);
        let columns = self.columns(&around, colors).normalised();
        let all = columns.positions.iter().chain(&columns.random).chain(&columns.features).chain(&columns.colors);
        let varying = all.filter(|column| column.iter().any(|&v| v != 0.0));
        let near = varying.flatten().filter(|&&v| bin(v, self.params.bins).1 < NEAR_BIN).count();
        Some((weigh(&columns, self.params.bins, t), around.near + near as u32))
    }

    /// Weights at a pixel, interpolated between the nodes of the information grid that have any.
    fn weights(&self, t: usize, x: u32, y: u32, colors: &[Color], nodes: &mut Nodes) -> Option<(Weights, u32)> {
        let spacing = self.params.information_grid;
        if spacing == 1 {
            return self.weights_at(t, x, y, colors);
        }
        let image = self.tile.geometry().image();
        let axis = |pixel: u32, size: u32| {
            let low = pixel / spacing * spacing;
            let high = (low + spacing).min(size - 1);
            let share = if high > low { f64::from(pixel - low) / f64::from(high - low) } else { 0.0 };
            [(low, 1.0 - share), (high, share)]
        };
        let (mut total, mut confidence, mut near) = (0.0, 0.0, 0);
        let (mut alpha, mut beta) = (vec![0.0; 3], vec![0.0; self.features.len()]);
        for (node_y, share_y) in axis(y, image.height) {
            for (node_x, share_x) in axis(x, image.width) {
                let share = share_x * share_y;
                if share == 0.0 {
                    continue;
                }
                let node = nodes.entry((node_x, node_y)).or_insert_with(|| self.weights_at(t, node_x, node_y, colors));
                let Some((weights, node_near)) = node else { continue };
                total += share;
                alpha.iter_mut().zip(&weights.alpha).for_each(|(sum, a)| *sum += share * a);
                beta.iter_mut().zip(&weights.beta).for_each(|(sum, b)| *sum += share * b);
                confidence += share * (1.0 - weights.color_on_random).powi(2);
                near += *node_near;
            }
        }
        if total == 0.0 {
            return self.weights_at(t, x, y, colors);
        }
        alpha.iter_mut().chain(&mut beta).for_each(|weight| *weight /= total);
        Some((Weights { alpha, beta, color_on_random: 1.0 - (confidence / total).sqrt() }, near))
    }

    /// Whether a pixel is passed through: its mean, and those of the pixels around it, are good enough by themselves. And
    /// how many of these decisions were near.
    fn settled(&self, x: u32, y: u32) -> (bool, u32) {
        let tolerance = self.params.tolerance;
        if tolerance == 0.0 {
            return (false, 0);
        }
        let window = self.tile.geometry().window();
        let (mut settled, mut near) = (true, 0);
        for y in y.saturating_sub(1)..=y + 1 {
            for x in x.saturating_sub(1)..=x + 1 {
                let own = if window.contains(x, y) { self.tile.samples_of(window.index(x, y)) } else { 0..0 };
                let error = match own.len() {
                    0 => 0.0,
                    1 => f64::INFINITY,
                    n => {
                        let of = |plane: &usize| {
                            let values = self.plane(*plane, &own.clone().collect::<Vec<_>>());
                            // The variance with n - 1, of the mean, relative.
                            deviation(&values).powi(2) / (n as f64 - 1.0) / (mean(&values).powi(2) + 0.01)
                        };
                        mean(&self.tile.channels().color_planes().iter().map(of).collect::<Vec<_>>())
                    }
                };
                settled &= error < tolerance;
                near += u32::from((error - tolerance).abs() < NEAR_SETTLED * tolerance);
            }
        }
        (settled, near)
    }

    /// Iteration `t` from these colours.
    pub fn step(&self, t: usize, colors: &[Color]) -> Step {
        let (window, region) = (self.tile.geometry().window(), self.region(t));
        let pixels = window.area() as usize;
        let mut step = Step { colors: colors.to_vec(), size: vec![[0.0; 3]; pixels], near: vec![0; pixels] };
        let mut nodes = Nodes::new();
        for y in region.y..region.bottom() {
            for x in region.x..region.right() {
                let at = window.index(x, y);
                let own = self.tile.samples_of(at);
                let (settled, near_settled) = self.settled(x, y);
                if settled {
                    let absolute = |k: usize| own.clone().map(|s| colors[s][k].abs()).collect::<Vec<_>>();
                    step.size[at] = [0, 1, 2].map(|k| if own.is_empty() { 0.0 } else { mean(&absolute(k)) });
                    step.near[at] = near_settled;
                    continue;
                }
                let Some((weights, near)) = self.weights(t, x, y, colors, &mut nodes) else { continue };
                if own.is_empty() {
                    continue;
                }
                let around = self.neighbourhood(t, x, y);
                let columns = self.columns(&around, colors);
                let normalised = Columns {
                    features: columns.features.iter().map(|c| normalise(c)).collect(),
                    colors: columns.colors.iter().map(|c| normalise(c)).collect(),
                    ..Columns::default()
                };
                let mut out = filter(&normalised, &columns.colors, &weights, own.len(), self.params);
                let absolute: Vec<Vec<f64>> =
                    columns.colors.iter().map(|c| c.iter().map(|v| v.abs()).collect()).collect();
                let negative = columns.colors.iter().flatten().any(|&c| c < 0.0);
                let size = if negative {
                    filter(&normalised, &absolute, &weights, own.len(), self.params)
                } else {
                    out.clone()
                };
                step.near[at] = near + around.near + near_settled;
                step.size[at] = std::array::from_fn(|k| {
                    let greatest = absolute[k].iter().copied().fold(0.0, f64::max);
                    mean(&size.iter().map(|c| c[k]).collect::<Vec<_>>()) + (-80.0_f64).exp() * greatest
                });
                if self.params.spikes {
                    for k in 0..3 {
                        let channel: Vec<f64> = out.iter().map(|c| c[k]).collect();
                        let (tamed, margin) = tame_spikes(&channel);
                        // Filtered samples are rounded to f32 before.
                        let error = (NEAR_SPIKE * step.size[at][k]).max(f64::from(f32::from_bits(2)));
                        let near = margin * deviation(&channel) < error;
                        step.near[at] += u32::from(near && tamed != channel);
                        out.iter_mut().zip(tamed).for_each(|(c, tamed)| c[k] = tamed);
                    }
                }
                step.colors[own].copy_from_slice(&out);
            }
        }
        step
    }

    /// The mean of a pixel's samples; none without samples.
    pub fn pixel(&self, index: usize, colors: &[Color]) -> Option<Color> {
        let own = self.tile.samples_of(index);
        (!own.is_empty()).then(|| pixel(&colors[own]))
    }

    /// The core's pixels; those without samples are filled from those around them.
    pub fn pixels(&self, colors: &[Color]) -> Vec<Color> {
        let reach = self.params.boxes.last().map_or(0, |b| b / 2);
        cover(self.tile, reach, |index| self.pixel(index, colors))
    }
}

/// Weights of the information grid's nodes, computed when first asked for.
type Nodes = HashMap<(u32, u32), Option<(Weights, u32)>>;
