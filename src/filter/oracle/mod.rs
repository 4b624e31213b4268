//! A literal, slow f64 transcription of RPF, one function per step: what the fast path is tested against.
//!
//! It shares no code with the fast path. Values are plain vectors, histograms are two-dimensional arrays, a distance is
//! a loop over features. The steps are discontinuous (a candidate is in or out, a value falls into one bin or the next),
//! so each is compared on the same inputs and decisions, and says how near its decisions were to falling the other way.
//!
//! [`Whole`] runs all of it over a tile; of the fast path it takes the random draws only. [`baseline`] is the same for the
//! methods that RPF is compared with.

mod baseline;
mod whole;

pub use baseline::baseline;
pub use whole::{Step, Whole};

use super::rpf::Params;
use super::{Rect, SampleTile};

/// Colours R, G, B.
pub type Color = [f64; 3];

/// How near a decision was to its threshold, relative to the threshold's size.
pub type Margin = f64;

/// Step 1: what a candidate is tested against in one feature.
#[derive(Clone, Copy, Debug)]
pub struct Cluster {
    /// Mean of the pixel's own samples that have the feature; NaN if none has it.
    mean: f64,
    threshold: f64,
    /// Whether any own sample lacks the feature.
    lacks: bool,
}

impl Cluster {
    /// Of a pixel's own samples; NaN is a missing feature.
    pub fn of(own: &[f64], deviations: f64, floor: f64) -> Self {
        let present: Vec<f64> = own.iter().copied().filter(|v| !v.is_nan()).collect();
        let lacks = present.len() < own.len();
        if present.is_empty() {
            return Self { mean: f64::NAN, threshold: floor, lacks };
        }
        Self { mean: mean(&present), threshold: (deviations * deviation(&present)).max(floor), lacks }
    }

    /// Whether a candidate belongs, and how near that was. NaN belongs where own samples lack the feature too.
    pub fn accepts(&self, candidate: f64) -> (bool, Margin) {
        let Self { mean, threshold, lacks } = *self;
        if candidate.is_nan() || mean.is_nan() {
            return (candidate.is_nan() && lacks, f64::INFINITY);
        }
        let distance = (candidate - mean).abs();
        (distance <= threshold, (distance - threshold).abs() / threshold.max(f64::MIN_POSITIVE))
    }
}

/// Mean.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Standard deviation, with n.
pub fn deviation(values: &[f64]) -> f64 {
    let mean = mean(values);
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// Step 2: zero mean and unit deviation; missing values (NaN) stand at the mean, equal values become 0.
pub fn normalise(column: &[f64]) -> Vec<f64> {
    let present: Vec<f64> = column.iter().copied().filter(|v| !v.is_nan()).collect();
    if present.is_empty() || present.iter().all(|&v| v == present[0]) {
        return vec![0.0; column.len()];
    }
    let middle = mean(&present);
    let filled: Vec<f64> = column.iter().map(|&v| if v.is_nan() { middle } else { v }).collect();
    // Scaled first, so that squares of very large or very small values stay in range.
    let size = filled.iter().fold(0.0, |size: f64, v| size.max((v - middle).abs()));
    let shifted: Vec<f64> = filled.iter().map(|v| (v - middle) / size).collect();
    let (mean, deviation) = (mean(&shifted), deviation(&shifted));
    shifted.iter().map(|v| (v - mean) / deviation).collect()
}

/// The histogram bin of a normalised value, and how near it is to the next.
pub fn bin(value: f64, bins: u32) -> (usize, Margin) {
    let half = f64::from(bins / 2);
    let rounded = value.round_ties_even();
    let margin = if value.abs() > half + 0.5 { f64::INFINITY } else { 0.5 - (value - rounded).abs() };
    ((rounded.clamp(-half, half) + half) as usize, margin)
}

/// Step 3: mutual information of two normalised columns in nats; 0 if either is constant.
pub fn information(x: &[f64], y: &[f64], bins: u32) -> f64 {
    Histogram::of(x, bins).information(&Histogram::of(y, bins))
}

/// The bin of each of a column's values.
struct Histogram {
    bins: usize,
    constant: bool,
    of: Vec<usize>,
}

impl Histogram {
    fn of(column: &[f64], bins: u32) -> Self {
        let constant = column.iter().all(|&v| v == column[0]);
        Self { bins: bins as usize, constant, of: column.iter().map(|&v| bin(v, bins).0).collect() }
    }

    fn information(&self, other: &Self) -> f64 {
        if self.constant || other.constant {
            return 0.0;
        }
        let n = self.bins;
        let mut joint = vec![vec![0.0; n]; n];
        for (&a, &b) in self.of.iter().zip(&other.of) {
            joint[a][b] += 1.0 / self.of.len() as f64;
        }
        let of_x: Vec<f64> = joint.iter().map(|row| row.iter().sum()).collect();
        let of_y: Vec<f64> = (0..n).map(|j| joint.iter().map(|row| row[j]).sum()).collect();
        let mut information = 0.0;
        for i in 0..n {
            for j in 0..n {
                if joint[i][j] > 0.0 {
                    information += joint[i][j] * (joint[i][j] / (of_x[i] * of_y[j])).ln();
                }
            }
        }
        information.max(0.0)
    }
}

/// A neighbourhood's columns by role, each with one value per row.
#[derive(Clone, Debug, Default)]
pub struct Columns {
    /// Film x and y.
    pub positions: Vec<Vec<f64>>,
    /// Random parameters.
    pub random: Vec<Vec<f64>>,
    /// Features.
    pub features: Vec<Vec<f64>>,
    /// R, G, B.
    pub colors: Vec<Vec<f64>>,
}

impl Columns {
    /// Step 2 for every column.
    pub fn normalised(&self) -> Self {
        let all = |columns: &[Vec<f64>]| columns.iter().map(|c| normalise(c)).collect();
        Self {
            positions: all(&self.positions),
            random: all(&self.random),
            features: all(&self.features),
            colors: all(&self.colors),
        }
    }
}

/// alpha, beta and W_c^r.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    /// alpha of each colour channel.
    pub alpha: Vec<f64>,
    /// beta of each feature.
    pub beta: Vec<f64>,
    /// W_c^r.
    pub color_on_random: f64,
}

/// Steps 3 and 4 of normalised columns in iteration `t` (eq. 5).
pub fn weigh(columns: &Columns, bins: u32, t: usize) -> Weights {
    let histograms = |columns: &[Vec<f64>]| columns.iter().map(|c| Histogram::of(c, bins)).collect::<Vec<_>>();
    let sum = |one: &Histogram, others: &[Histogram]| -> f64 { others.iter().map(|o| one.information(o)).sum() };
    let quotient = |a: f64, b: f64| if b == 0.0 { 0.0 } else { a / b };
    let growth = 1.0 + 0.1 * t as f64;
    let (positions, random) = (histograms(&columns.positions), histograms(&columns.random));
    let (features, colors) = (histograms(&columns.features), histograms(&columns.colors));
    let d_c_r: Vec<f64> = colors.iter().map(|c| sum(c, &random)).collect();
    let d_c_p: Vec<f64> = colors.iter().map(|c| sum(c, &positions)).collect();
    let d_c_f: Vec<f64> = features.iter().map(|f| sum(f, &colors)).collect();
    let w_c_r: Vec<f64> = d_c_r.iter().zip(&d_c_p).map(|(&r, &p)| quotient(r, r + p)).collect();
    let whole = d_c_r.iter().sum::<f64>() + d_c_p.iter().sum::<f64>() + d_c_f.iter().sum::<f64>();
    let beta = features.iter().zip(&d_c_f).map(|(feature, &d)| {
        let (r, p) = (sum(feature, &random), sum(feature, &positions));
        quotient(d, whole) * (1.0 - growth * quotient(r, r + p)).max(0.0)
    });
    Weights {
        alpha: w_c_r.iter().map(|w| (1.0 - 2.0 * growth * w).max(0.0)).collect(),
        beta: beta.collect(),
        color_on_random: mean(&w_c_r),
    }
}

/// Step 5: the filtered colours of the first `own` rows (eq. 6, 7). `colors` are not normalised.
/// Of absolute colours the result is the size that rounding errors are to be measured against.
pub fn filter(
    normalised: &Columns,
    colors: &[Vec<f64>],
    weights: &Weights,
    own: usize,
    params: &Params,
) -> Vec<[f64; 3]> {
    let sigma_squared = 8.0 * params.sigma8_squared / own as f64;
    let g = (1.0 - weights.color_on_random).powi(2) / sigma_squared;
    let rows = colors[0].len();
    let distance = |columns: &[Vec<f64>], factors: &[f64], i: usize, j: usize| -> f64 {
        columns.iter().zip(factors).map(|(z, factor)| factor * (z[i] - z[j]).powi(2)).sum()
    };
    (0..own)
        .map(|i| {
            let (mut total, mut sums) = (0.0, [0.0; 3]);
            for j in 0..rows {
                let w = (-g / 2.0
                    * (distance(&normalised.colors, &weights.alpha, i, j)
                        + distance(&normalised.features, &weights.beta, i, j)))
                .exp();
                total += w;
                for (sum, color) in sums.iter_mut().zip(colors) {
                    *sum += w * color[j];
                }
            }
            std::array::from_fn(|k| {
                let constant = colors[k].iter().all(|&c| c == colors[k][0]);
                if constant { colors[k][i] } else { sums[k] / total }
            })
        })
        .collect()
}

/// Step 6 for one channel of one pixel: the samples after it, and how near any was to being a spike or not.
pub fn tame_spikes(samples: &[f64]) -> (Vec<f64>, Margin) {
    if samples.len() < 3 {
        return (samples.to_vec(), f64::INFINITY);
    }
    let (before, deviation) = (mean(samples), deviation(samples));
    let limit = (1.0 + 1e-4) * deviation;
    let tamed: Vec<f64> = samples.iter().map(|&c| if (c - before).abs() > limit { before } else { c }).collect();
    let lost = before - mean(&tamed);
    let margin = samples.iter().map(|c| ((c - before).abs() - limit).abs() / deviation).fold(f64::INFINITY, f64::min);
    (tamed.iter().map(|c| c + lost).collect(), margin)
}

/// A pixel's value after the last iteration.
pub fn pixel(samples: &[[f64; 3]]) -> [f64; 3] {
    std::array::from_fn(|k| mean(&samples.iter().map(|c| c[k]).collect::<Vec<_>>()))
}

/// The core's pixels, of filtered ones by their index in the data window: one without samples becomes the mean of those in
/// the smallest window around it that has any, up to `reach` pixels away; if none has, it is black.
fn cover(tile: &SampleTile, reach: u32, filtered: impl Fn(usize) -> Option<Color>) -> Vec<Color> {
    let (core, window) = (tile.geometry().core(), tile.geometry().window());
    let at = |x: u32, y: u32| {
        let around = |radius: u32| {
            let around = Rect::new(x, y, 1, 1).grown(radius, &window);
            let rows = around.y..around.bottom();
            let all = rows.flat_map(|y| (around.x..around.right()).map(move |x| window.index(x, y)));
            let found: Vec<Color> = all.filter_map(&filtered).collect();
            (!found.is_empty()).then(|| pixel(&found))
        };
        (0..=reach).find_map(around).unwrap_or([0.0; 3])
    };
    (core.y..core.bottom()).flat_map(|y| (core.x..core.right()).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect()
}
