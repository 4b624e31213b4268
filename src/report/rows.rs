//! What the measurements say together: a row for each data set, sample count, method and number of threads.

use super::{
    measure::{Measurement, Spared},
    plan::Key,
    scores::Scores,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The preset that the others are compared with.
pub const BASE: &str = "unfiltered";

/// The reference's own error, where it is known. It is noise of zero mean and independent of the image, so that on
/// average error against the reference = error against the truth + own error.
#[derive(Clone, Copy, Debug, Default)]
pub struct Own {
    /// relMSE, 0 or more.
    pub relmse: Option<f64>,
    /// MSE, 0 or more.
    pub mse: Option<f64>,
}

/// The median of what was measured several times, and how far it went.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Spread {
    /// Of an even number the mean of the two in the middle.
    pub median: f64,
    /// Least.
    pub min: f64,
    /// Greatest.
    pub max: f64,
}

impl Spread {
    /// Of at least one number.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_unstable_by(f64::total_cmp);
        let (n, at) = (values.len(), |i: usize| values.get(i).copied().unwrap_or(f64::NAN));
        Self { median: 0.5 * (at(n.saturating_sub(1) / 2) + at(n / 2)), min: at(0), max: at(n.saturating_sub(1)) }
    }
}

/// A row of the report.
#[derive(Clone, Debug)]
pub struct Row {
    /// What was measured.
    pub key: Key,
    /// The method in words: the preset, and what was set.
    pub label: String,
    /// Errors.
    pub scores: Scores,
    /// Whether every repeat had the same errors, bit for bit, as it should.
    pub repeatable: bool,
    /// The reference's own error.
    pub own: Own,
    /// Processor seconds per megapixel.
    pub cpu: Spread,
    /// Seconds by the clock per megapixel.
    pub wall: Spread,
    /// How often it was measured.
    pub repeats: usize,
    /// Bytes that the filter said it would need.
    pub planned: u64,
    /// What was left out and passed through.
    pub spared: Spared,
    /// Greatest resident size of the process, in bytes; of the repeats the median.
    pub peak: Option<u64>,
    /// No other row of the same data set, samples and threads has both less error and less processor time.
    pub pareto: bool,
    /// Samples per pixel at which the plain mean would have the same error.
    pub equal_spp: Option<f64>,
    /// The base's slope that [`Row::equal_spp`] was reckoned with.
    pub slope: Slope,
    /// What it looks like: the middle of the image, and its difference from the reference.
    pub pictures: Option<[String; 2]>,
}

impl Row {
    /// relMSE, less the reference's own where that is known.
    pub fn relmse(&self) -> f64 {
        self.scores.get("relmse") - self.own.relmse.unwrap_or(0.0)
    }

    /// MSE, less the reference's own where that is known.
    pub fn mse(&self) -> f64 {
        self.scores.get("mse") - self.own.mse.unwrap_or(0.0)
    }

    /// Seconds per megapixel to render the samples and filter them, where a sample per pixel takes so many.
    pub fn cost(&self, seconds_per_sample: f64) -> f64 {
        f64::from(self.key.spp) * seconds_per_sample + self.cpu.median
    }

    /// relMSE of as many plain samples as could be rendered in the time of [`Row::cost`].
    pub fn plain_relmse(&self, seconds_per_sample: f64) -> Option<f64> {
        let samples = self.cost(seconds_per_sample) / seconds_per_sample;
        self.equal_spp.map(|equal| self.relmse() * libm::pow(samples / equal, self.slope.value()))
    }

    /// The row of the same method without a tolerance, if this one has any.
    pub fn without_tolerance<'a>(&self, rows: &'a [Self]) -> Option<&'a Self> {
        let has = |row: &Self| row.key.parameters.iter().any(|p| p.starts_with("tolerance=") && p != "tolerance=0");
        let others = |row: &Self| -> Vec<String> {
            row.key.parameters.iter().filter(|p| !p.starts_with("tolerance=")).cloned().collect()
        };
        let same = |row: &&Self| row.key.preset == self.key.preset && others(row) == others(self);
        has(self).then(|| rows.iter().filter(|row| self.peers(row) && !has(row)).find(same)).flatten()
    }

    fn peers(&self, other: &Self) -> bool {
        let of = |key: &Key| (key.data.clone(), key.crop, key.spp, key.threads);
        of(&self.key) == of(&other.key)
    }
}

/// How the plain mean's error falls with the samples: error ~ samples^slope.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Slope {
    /// Fitted to measurements at several sample counts.
    Fitted(f64),
    /// -1, as independent samples have it: there are too few sample counts for a fit.
    Assumed,
}

impl Slope {
    /// The number.
    pub const fn value(self) -> f64 {
        match self {
            Self::Fitted(slope) => slope,
            Self::Assumed => -1.0,
        }
    }
}

/// The slope of the line through (ln x, ln y) by least squares; `None` without two different x, of the points above 0.
pub fn fit(points: &[(f64, f64)]) -> Option<f64> {
    let usable = points.iter().filter(|(x, y)| *x > 0.0 && *y > 0.0 && x.is_finite() && y.is_finite());
    let logs: Vec<(f64, f64)> = usable.map(|&(x, y)| (libm::log(x), libm::log(y))).collect();
    let n = logs.len() as f64;
    let (mx, my) = (logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n);
    let xx: f64 = logs.iter().map(|p| (p.0 - mx) * (p.0 - mx)).sum();
    let xy: f64 = logs.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum();
    (xx > 1e-12).then(|| xy / xx)
}

/// Rows of the measurements, in their order, with what the data sets' references have of error.
pub fn rows(measured: &[(Key, String, Measurement)], own: &BTreeMap<String, Own>) -> Vec<Row> {
    let mut groups: Vec<(Key, &str, Vec<&Measurement>)> = Vec::new();
    for (key, label, measurement) in measured {
        let key = Key { repeat: 0, ..key.clone() };
        match groups.iter_mut().find(|(known, ..)| *known == key) {
            Some((.., group)) => group.push(measurement),
            None => groups.push((key, label, vec![measurement])),
        }
    }
    let mut rows: Vec<Row> = groups.into_iter().map(|(key, label, group)| row(key, label, &group, own)).collect();
    let compared: Vec<(bool, Slope, Option<f64>)> = rows.iter().map(|row| compare(row, &rows)).collect();
    for (row, (pareto, slope, equal_spp)) in rows.iter_mut().zip(compared) {
        (row.pareto, row.slope, row.equal_spp) = (pareto, slope, equal_spp);
    }
    rows
}

fn row(key: Key, label: &str, group: &[&Measurement], own: &BTreeMap<String, Own>) -> Row {
    let megapixels = f64::from(key.crop[2]) * f64::from(key.crop[3]) * 1e-6;
    let spread = |of: fn(&Measurement) -> f64| Spread::of(group.iter().map(|m| of(m) / megapixels));
    let peaks: Vec<f64> = group.iter().filter_map(|m| m.peak).map(|peak| peak as f64).collect();
    let first = group[0];
    Row {
        label: label.to_owned(),
        scores: first.scores,
        repeatable: group.iter().all(|m| m.scores.0.map(f64::to_bits) == first.scores.0.map(f64::to_bits)),
        own: own.get(&key.data).copied().unwrap_or_default(),
        cpu: spread(|m| m.cpu),
        wall: spread(|m| m.wall),
        repeats: group.len(),
        planned: first.planned,
        spared: first.spared.clone(),
        peak: (!peaks.is_empty()).then(|| Spread::of(peaks).median as u64),
        pareto: false,
        equal_spp: None,
        slope: Slope::Assumed,
        pictures: first.pictures.clone(),
        key,
    }
}

/// Whether a row is on the Pareto front, the base's slope, and the samples of equal error.
fn compare(row: &Row, rows: &[Row]) -> (bool, Slope, Option<f64>) {
    let mut peers = rows.iter().filter(|other| row.peers(other));
    let beaten = |other: &Row| {
        let (error, time) = (other.relmse(), other.cpu.median);
        error <= row.relmse() && time <= row.cpu.median && (error < row.relmse() || time < row.cpu.median)
    };
    let pareto = row.relmse().is_finite() && !peers.clone().any(beaten);
    let base = |other: &Row| {
        let (a, b) = (&row.key, &other.key);
        other.key.preset == BASE && (&a.data, a.crop, a.threads) == (&b.data, b.crop, b.threads)
    };
    let points: Vec<_> = rows.iter().filter(|r| base(r)).map(|r| (f64::from(r.key.spp), r.relmse())).collect();
    let slope = fit(&points).filter(|slope| *slope < -0.1).map_or(Slope::Assumed, Slope::Fitted);
    let equal = peers.find(|peer| peer.key.preset == BASE).and_then(|peer| {
        let ratio = row.relmse() / peer.relmse();
        (ratio > 0.0 && ratio.is_finite()).then(|| f64::from(row.key.spp) * libm::pow(ratio, 1.0 / slope.value()))
    });
    (pareto, slope, equal)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(preset: &str, spp: u32, repeat: u32, relmse: f64, cpu: f64) -> (Key, String, Measurement) {
        let key = Key {
            data: "d".into(),
            content: "c".into(),
            crop: [0, 0, 1000, 500],
            part: false,
            spp,
            preset: preset.into(),
            parameters: Vec::new(),
            threads: 1,
            simd: "any".into(),
            cpu: "any".into(),
            seed: 0,
            repeat,
            version: "0".into(),
        };
        let mut scores = Scores([0.0; 9]);
        scores.0[1] = relmse;
        let measurement = Measurement {
            scores,
            cpu,
            wall: 2.0 * cpu,
            planned: 7,
            spared: Spared::default(),
            peak: None,
            pictures: None,
        };
        (key, preset.to_owned(), measurement)
    }

    #[test]
    fn medians_front_and_equal_samples() {
        let measured = [
            one(BASE, 4, 0, 0.81, 0.1),
            one(BASE, 16, 0, 0.21, 0.1),
            one("good", 4, 0, 0.11, 3.0),
            one("good", 4, 1, 0.11, 1.0),
            one("good", 4, 2, 0.11, 2.0),
            one("bad", 4, 0, 0.5, 2.5),
        ];
        let own = [("d".to_owned(), Own { relmse: Some(0.01), mse: None })].into();
        let rows = rows(&measured, &own);
        assert_eq!(rows.len(), 4);
        let good = &rows[2];
        assert_eq!((good.repeats, good.cpu.median, good.cpu.min, good.cpu.max), (3, 4.0, 2.0, 6.0));
        assert_eq!(good.wall.median, 8.0);
        assert_eq!(rows.iter().map(|row| row.pareto).collect::<Vec<_>>(), [true, true, true, false]);
        // 0.8 at 4 and 0.2 at 16 samples: the error is 3.2 / n, and 0.1 takes 32.
        assert!((good.slope.value() + 1.0).abs() < 1e-12);
        assert!((good.equal_spp.unwrap() - 32.0).abs() < 1e-9);
        assert!((good.cost(0.5) - 6.0).abs() < 1e-12);
        // 12 samples take as long.
        assert!((good.plain_relmse(0.5).unwrap() - 3.2 / 12.0).abs() < 1e-12);
        assert!(rows.iter().all(|row| row.repeatable));
    }

    #[test]
    fn a_slope_needs_two_sample_counts() {
        assert_eq!(fit(&[(4.0, 0.1)]), None);
        assert_eq!(fit(&[(4.0, 0.1), (8.0, -0.1)]), None);
        assert!((fit(&[(1.0, 1.0), (10.0, 0.01), (100.0, 0.0001)]).unwrap() + 2.0).abs() < 1e-12);
    }
}
