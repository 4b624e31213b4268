//! RPF as one would write it first: one thread, one value at a time, no bit masks, nothing left out. The fast path's
//! speed is measured against it (`tests/bench`), in the same run and with the same compiler flags.
//!
//! It draws the same neighbourhoods (with the fast path's random numbers) and computes the same thing, but for rounding:
//! columns are `f32`, sums `f64`, and `exp` and `ln` the platform's. Buffers are reused from pixel to pixel, so that it is
//! the arithmetic that is compared and not the allocator. The [oracle](super::oracle) is what results are tested against.

use super::finish::finish;
use super::rpf::{Offsets, Params, draws, params::MAX_BINS, region};
use super::{Execution, Filtered, Report, Role, SampleTile, Stopped};
use std::collections::BTreeMap;

/// Where the values of a column come from.
#[derive(Clone, Copy)]
enum Source {
    Plane(usize),
    /// The centre of the pixel, where there is no film position.
    CenterX,
    CenterY,
    Color(usize),
}

/// Columns of one role.
type Columns = std::ops::Range<usize>;

/// alpha, beta and (1 - W_c^r)^2.
#[derive(Clone, Debug, Default)]
pub struct Weights {
    color: [f64; 3],
    features: Vec<f64>,
    confidence: f64,
}

/// A tile, and what one thread needs to work through it. The steps are called in their order, for one pixel after another.
pub struct Scalar<'a> {
    tile: &'a SampleTile,
    params: &'a Params,
    seed: u64,
    sources: Vec<Source>,
    positions: Columns,
    random: Columns,
    features: Columns,
    colors: Columns,
    /// Of each feature: how many deviations a candidate may be off.
    deviations: Vec<f64>,
    /// The neighbourhood: samples, and their pixels.
    rows: Vec<usize>,
    pixels: Vec<usize>,
    raw: Vec<Vec<f32>>,
    normal: Vec<Vec<f32>>,
    bins: Vec<Vec<u8>>,
    joint: Vec<u32>,
}

impl<'a> Scalar<'a> {
    /// For a tile; `seed` keys the draws.
    pub fn new(tile: &'a SampleTile, params: &'a Params, seed: u64) -> Self {
        let planes = |wanted: fn(&Role) -> bool| tile.channels().planes_of(wanted).into_iter().map(Source::Plane);
        let mut sources: Vec<Source> = planes(|role| *role == Role::Film).collect();
        if sources.is_empty() {
            sources.extend([Source::CenterX, Source::CenterY]);
        }
        let random = sources.len();
        sources.extend(planes(|role| matches!(role, Role::Random { .. })));
        let features = sources.len();
        sources.extend(planes(|role| matches!(role, Role::Feature { .. })));
        let colors = sources.len();
        sources.extend([0, 1, 2].map(Source::Color));
        let all = sources.len();
        let deviations = tile.channels().plane_channels().filter_map(|(channel, _)| match channel.role {
            Role::Feature { position: true } => Some(params.position_threshold),
            Role::Feature { position: false } => Some(params.feature_threshold),
            _ => None,
        });
        Self {
            tile,
            params,
            seed,
            positions: 0..random,
            random: random..features,
            features: features..colors,
            colors: colors..all,
            deviations: deviations.collect(),
            rows: Vec::new(),
            pixels: Vec::new(),
            raw: vec![Vec::new(); all],
            normal: vec![Vec::new(); all],
            bins: vec![Vec::new(); all],
            joint: vec![0; (params.bins * params.bins) as usize],
            sources,
        }
    }

    /// The colours of all samples before the first iteration.
    pub fn initial(&self) -> Vec<[f32; 3]> {
        let planes = self.tile.channels().color_planes();
        (0..self.tile.total()).map(|sample| planes.map(|plane| self.tile.value(plane, sample))).collect()
    }

    /// Step 1: the neighbourhood of a pixel in iteration `t`, with that iteration's offsets; false if it has no samples.
    pub fn select(&mut self, offsets: &Offsets, t: usize, x: u32, y: u32) -> bool {
        let Self { tile, params, .. } = *self;
        let pixel = tile.geometry().window().index(x, y);
        let own = tile.samples_of(pixel);
        if own.is_empty() {
            return false;
        }
        self.rows.clear();
        self.rows.extend(own.clone());
        self.pixels.clear();
        self.pixels.resize(own.len(), pixel);
        let planes = self.sources[self.features.clone()].iter().zip(&self.deviations);
        let clusters = planes.filter_map(|(source, deviations)| {
            let Source::Plane(plane) = *source else { return None };
            let present = own.clone().map(|s| f64::from(tile.value(plane, s))).filter(|v| !v.is_nan());
            let count = present.clone().count();
            let mean = present.clone().sum::<f64>() / count as f64;
            let variance = present.map(|v| (v - mean) * (v - mean)).sum::<f64>() / count as f64;
            Some((plane, mean, (deviations * variance.sqrt()).max(params.threshold_floor), count < own.len()))
        });
        let clusters: Vec<(usize, f64, f64, bool)> = clusters.collect();
        for (pixel, sample) in draws(offsets, tile, params, self.seed, t, x, y) {
            let belongs = clusters.iter().all(|&(plane, mean, threshold, lacks)| {
                let value = f64::from(tile.value(plane, sample));
                (value - mean).abs() <= threshold || (lacks && value.is_nan())
            });
            if belongs {
                self.rows.push(sample);
                self.pixels.push(pixel);
            }
        }
        true
    }

    /// The first column that the filter reads: random parameters and film positions only weigh.
    fn filtered(&self) -> usize {
        self.features.start
    }

    /// Copies the neighbourhood's values together, column by column, from column `first` on.
    pub fn gather(&mut self, first: usize, colors: &[[f32; 3]]) {
        let window = self.tile.geometry().window();
        for (column, source) in self.raw.iter_mut().zip(&self.sources).skip(first) {
            column.clear();
            let pixels = self.pixels.iter().map(|&pixel| pixel as u32);
            match *source {
                Source::Plane(plane) => column.extend(self.rows.iter().map(|&s| self.tile.value(plane, s))),
                Source::CenterX => column.extend(pixels.map(|i| (window.x + i % window.width) as f32 + 0.5)),
                Source::CenterY => column.extend(pixels.map(|i| (window.y + i / window.width) as f32 + 0.5)),
                Source::Color(channel) => column.extend(self.rows.iter().map(|&s| colors[s][channel])),
            }
        }
    }

    /// Step 2: zero mean and unit deviation; missing values stand at the mean, equal values become 0. From
    /// column `first` on.
    pub fn normalise(&mut self, first: usize) {
        for (normal, raw) in self.normal.iter_mut().zip(&self.raw).skip(first) {
            normal.clear();
            let (mut sum, mut count) = (0.0, 0.0);
            let (mut least, mut greatest) = (f32::INFINITY, f32::NEG_INFINITY);
            for &value in raw.iter().filter(|v| !v.is_nan()) {
                sum += f64::from(value);
                count += 1.0;
                least = least.min(value);
                greatest = greatest.max(value);
            }
            if least >= greatest {
                normal.resize(raw.len(), 0.0);
                continue;
            }
            let mean = sum / count;
            let mut squares = 0.0;
            for &value in raw.iter().filter(|v| !v.is_nan()) {
                squares += (f64::from(value) - mean) * (f64::from(value) - mean);
            }
            let deviation = (squares / raw.len() as f64).sqrt();
            for &value in raw {
                normal.push(if value.is_nan() { 0.0 } else { ((f64::from(value) - mean) / deviation) as f32 });
            }
        }
    }

    /// Step 3, its first part: the histogram bin of each value.
    pub fn histogram(&mut self) {
        let half = (self.params.bins / 2) as f32;
        for (bins, normal) in self.bins.iter_mut().zip(&self.normal) {
            bins.clear();
            bins.extend(normal.iter().map(|v| (v.round_ties_even().max(-half).min(half) + half) as u8));
        }
    }

    /// Mutual information of two columns, in nats.
    fn mutual(&mut self, a: usize, b: usize) -> f64 {
        let constant = |column: &[f32]| column.iter().all(|&v| v == 0.0);
        if constant(&self.normal[a]) || constant(&self.normal[b]) {
            return 0.0;
        }
        let n = self.params.bins as usize;
        self.joint.fill(0);
        for (&i, &j) in self.bins[a].iter().zip(&self.bins[b]) {
            self.joint[usize::from(i) * n + usize::from(j)] += 1;
        }
        let (mut of_a, mut of_b) = ([0; MAX_BINS as usize], [0; MAX_BINS as usize]);
        for (i, row) in self.joint.chunks_exact(n).enumerate() {
            for (j, both) in row.iter().enumerate() {
                of_a[i] += both;
                of_b[j] += both;
            }
        }
        let rows = self.rows.len() as f64;
        let mut information = 0.0;
        for (i, row) in self.joint.chunks_exact(n).enumerate() {
            for (j, &both) in row.iter().enumerate().filter(|(_, both)| **both > 0) {
                let ratio = f64::from(both) * rows / (f64::from(of_a[i]) * f64::from(of_b[j]));
                information += f64::from(both) / rows * ratio.ln();
            }
        }
        information.max(0.0)
    }

    /// Step 3, its second part: the information of every pair that counts; and step 4: the weights of iteration `t`.
    pub fn weigh(&mut self, t: usize) -> Weights {
        let (positions, random) = (self.positions.clone(), self.random.clone());
        let (features, colors) = (self.features.clone(), self.colors.clone());
        let mut sum = |one: usize, others: &Columns| others.clone().map(|other| self.mutual(one, other)).sum::<f64>();
        let share = |part: f64, whole: f64| if whole == 0.0 { 0.0 } else { part / whole };
        let growth = 1.0 + 0.1 * t as f64;
        let (mut whole, mut on_random) = (0.0, [0.0; 3]);
        for (color, on_random) in colors.clone().zip(&mut on_random) {
            let (r, p) = (sum(color, &random), sum(color, &positions));
            whole += r + p;
            *on_random = share(r, r + p);
        }
        let of_colors: Vec<f64> = features.clone().map(|feature| sum(feature, &colors)).collect();
        whole += of_colors.iter().sum::<f64>();
        let weight = |(feature, of_colors): (usize, &f64)| {
            let (r, p) = (sum(feature, &random), sum(feature, &positions));
            share(*of_colors, whole) * (1.0 - growth * share(r, r + p)).max(0.0)
        };
        let weights = features.zip(&of_colors).map(weight).collect();
        let mean = on_random.iter().sum::<f64>() / 3.0;
        Weights {
            color: on_random.map(|share| (1.0 - 2.0 * growth * share).max(0.0)),
            features: weights,
            confidence: (1.0 - mean) * (1.0 - mean),
        }
    }

    /// Step 5: the filtered colours of the pixel's own samples, which are the first of the neighbourhood.
    pub fn bilateral(&self, weights: &Weights, out: &mut [[f32; 3]]) {
        let steepness = weights.confidence * out.len() as f64 / (8.0 * self.params.sigma8_squared);
        let factors = weights.features.iter().chain(&weights.color).map(|weight| (0.5 * steepness * weight) as f32);
        let columns = self.normal[self.features.start..self.colors.end].iter();
        let counted: Vec<(f32, &Vec<f32>)> = factors.zip(columns).filter(|(factor, _)| *factor > 0.0).collect();
        let colors = &self.raw[self.colors.clone()];
        for (i, out) in out.iter_mut().enumerate() {
            let (mut total, mut sums) = (0.0, [0.0; 3]);
            for j in 0..self.rows.len() {
                let mut distance = 0.0;
                for (factor, column) in &counted {
                    let difference = column[i] - column[j];
                    distance += factor * difference * difference;
                }
                let weight = f64::from((-distance).exp());
                total += weight;
                for (sum, color) in sums.iter_mut().zip(colors) {
                    *sum += weight * f64::from(color[j]);
                }
            }
            *out = sums.map(|sum| (sum / total) as f32);
        }
    }

    /// Step 6: spikes of one pixel's samples.
    pub fn spikes(samples: &mut [[f32; 3]]) {
        let count = samples.len() as f64;
        if samples.len() < 3 {
            return;
        }
        for channel in 0..3 {
            let values = || samples.iter().map(|color| f64::from(color[channel]));
            let mean = values().sum::<f64>() / count;
            let variance = values().map(|v| (v - mean) * (v - mean)).sum::<f64>() / count;
            let limit = (1.0 + 1e-4) * variance.sqrt();
            let lost = values().map(|v| v - mean).filter(|off| off.abs() > limit).sum::<f64>() / count;
            for color in samples.iter_mut() {
                let value = f64::from(color[channel]);
                let kept = if (value - mean).abs() > limit { mean } else { value };
                color[channel] = (kept + lost) as f32;
            }
        }
    }

    /// Weights at a pixel; none without samples.
    fn weights_at(&mut self, offsets: &Offsets, t: usize, at: [u32; 2], colors: &[[f32; 3]]) -> Option<Weights> {
        let inside = self.tile.geometry().window().contains(at[0], at[1]);
        (inside && self.select(offsets, t, at[0], at[1])).then(|| {
            self.gather(0, colors);
            self.normalise(0);
            self.histogram();
            self.weigh(t)
        })
    }

    /// Weights between the nodes of the information grid; none if no node around has any.
    fn interpolated(
        &mut self,
        offsets: &Offsets,
        t: usize,
        at: [u32; 2],
        colors: &[[f32; 3]],
        nodes: &mut BTreeMap<[u32; 2], Option<Weights>>,
    ) -> Option<Weights> {
        let (spacing, image) = (self.params.information_grid, self.tile.geometry().image());
        let axis = |pixel: u32, size: u32| {
            let low = pixel / spacing * spacing;
            let high = (low + spacing).min(size - 1);
            let share = if high > low { f64::from(pixel - low) / f64::from(high - low) } else { 0.0 };
            [(low, 1.0 - share), (high, share)]
        };
        let mut sum = Weights { features: vec![0.0; self.features.len()], ..Weights::default() };
        let mut total = 0.0;
        for (y, share_y) in axis(at[1], image.height) {
            for (x, share_x) in axis(at[0], image.width) {
                let share = share_x * share_y;
                if share == 0.0 {
                    continue;
                }
                let node = nodes.entry([x, y]).or_insert_with(|| self.weights_at(offsets, t, [x, y], colors));
                let Some(node) = node else { continue };
                total += share;
                sum.confidence += share * node.confidence;
                sum.color.iter_mut().zip(node.color).for_each(|(sum, weight)| *sum += share * weight);
                sum.features.iter_mut().zip(&node.features).for_each(|(sum, weight)| *sum += share * weight);
            }
        }
        let all = sum.features.iter_mut().chain(&mut sum.color).chain([&mut sum.confidence]);
        all.for_each(|weight| *weight /= total);
        (total > 0.0).then_some(sum)
    }

    /// Iteration `t`.
    pub fn step(&mut self, t: usize, colors: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let (window, offsets) = (self.tile.geometry().window(), Offsets::new(self.params.boxes[t]));
        let region = region(self.tile.geometry(), self.params, self.tile.varying(), t);
        let (mut next, mut nodes) = (colors.to_vec(), BTreeMap::new());
        for y in region.y..region.bottom() {
            for x in region.x..region.right() {
                let interpolated = match self.params.information_grid {
                    1 => None,
                    _ => self.interpolated(&offsets, t, [x, y], colors, &mut nodes),
                };
                if !self.select(&offsets, t, x, y) {
                    continue;
                }
                let first = if interpolated.is_some() { self.filtered() } else { 0 };
                self.gather(first, colors);
                self.normalise(first);
                let weights = interpolated.unwrap_or_else(|| {
                    self.histogram();
                    self.weigh(t)
                });
                let out = &mut next[self.tile.samples_of(window.index(x, y))];
                self.bilateral(&weights, out);
                if self.params.spikes {
                    Self::spikes(out);
                }
            }
        }
        next
    }
}

/// Filters a tile.
pub fn filter(tile: &SampleTile, params: &Params, seed: u64) -> Result<Filtered, Stopped> {
    let mut scalar = Scalar::new(tile, params, seed);
    let mut colors = scalar.initial();
    for t in 0..params.boxes.len() {
        colors = scalar.step(t, &colors);
    }
    let mean = |x: u32, y: u32| {
        let samples = &colors[tile.samples_of(tile.geometry().window().index(x, y))];
        let of = |channel: usize| samples.iter().map(|c| f64::from(c[channel])).sum::<f64>() / samples.len() as f64;
        (!samples.is_empty()).then(|| [0, 1, 2].map(of))
    };
    finish(tile, mean, params.fill_reach(), Report::default(), &Execution::default())
}
