//! The parameters of RPF, their ranges, and the presets' values.

use crate::filter::method::{ParameterError, one, wrong};

/// Most iterations.
pub const MAX_ITERATIONS: usize = 8;
/// Widest box, in pixels.
pub const MAX_BOX: u32 = 255;
/// Most rows in a neighbourhood.
pub const MAX_NEIGHBORS: u32 = 65536;
/// Most histogram bins.
pub const MAX_BINS: u32 = 31;
/// Widest spacing of the information grid, in pixels.
pub const MAX_GRID: u32 = 64;

/// The parameters of RPF; the fields are named as they are set.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// Box width of each iteration in pixels: odd, 3 to [`MAX_BOX`]; the draw's standard deviation is a quarter of it.
    pub boxes: Vec<u32>,
    /// Wanted neighbourhood of each iteration, as a fraction of all samples in its box: 0 to 4.
    pub fractions: Vec<f64>,
    /// Histogram bins for the information: odd, 3 to [`MAX_BINS`].
    pub bins: u32,
    /// Variance of the bilateral filter at 8 samples per pixel: 1e-9 to 1e6. The papers have 0.02 for noisy scenes and
    /// 0.002 for all others.
    pub sigma8_squared: f64,
    /// Weights are computed at every so many pixels in x and y, and interpolated between: 1 to [`MAX_GRID`].
    pub information_grid: u32,
    /// Whether samples far from their pixel's mean are set to it after each iteration.
    pub spikes: bool,
    /// Most rows in a neighbourhood: 1 to [`MAX_NEIGHBORS`].
    pub max_neighbors: u32,
    /// How many of the pixel's standard deviations a world position may lie from its mean: 1 to 1e6.
    pub position_threshold: f64,
    /// The same for every other feature: 1 to 1e6.
    pub feature_threshold: f64,
    /// A difference from the pixel's mean that is never too far, in the feature's own units: 0 to 1e30.
    pub threshold_floor: f64,
    /// Pixels whose own samples say that filtering can take less than this off their relMSE, at most, are passed through:
    /// 0, none, to 1. An estimate; see `settled.rs`.
    pub tolerance: f64,
}

impl Params {
    /// RPF as published.
    pub fn paper() -> Self {
        Self {
            boxes: vec![55, 35, 17, 7],
            fractions: vec![0.5; 4],
            bins: 7,
            sigma8_squared: 0.02,
            information_grid: 1,
            spikes: true,
            max_neighbors: MAX_NEIGHBORS,
            position_threshold: 30.0,
            feature_threshold: 3.0,
            threshold_floor: 0.1,
            tolerance: 0.0,
        }
    }

    /// The report's boxes with few neighbours.
    pub fn paper_fast() -> Self {
        Self { fractions: vec![0.02, 0.04, 0.3, 0.5], ..Self::paper() }
    }

    /// The best of RPF for its cost: large boxes do not pay, nor does information at every pixel.
    pub fn lean() -> Self {
        Self { boxes: vec![17, 7], fractions: vec![0.15, 0.3], information_grid: 4, ..Self::paper() }
    }

    /// Every parameter's name and value in words.
    pub fn entries(&self) -> [(&'static str, String); 11] {
        fn list<T: ToString>(values: &[T]) -> String {
            values.iter().map(T::to_string).collect::<Vec<_>>().join(",")
        }
        [
            ("boxes", list(&self.boxes)),
            ("fractions", list(&self.fractions)),
            ("bins", self.bins.to_string()),
            ("sigma8_squared", self.sigma8_squared.to_string()),
            ("information_grid", self.information_grid.to_string()),
            ("spikes", if self.spikes { "on" } else { "off" }.to_owned()),
            ("max_neighbors", self.max_neighbors.to_string()),
            ("position_threshold", self.position_threshold.to_string()),
            ("feature_threshold", self.feature_threshold.to_string()),
            ("threshold_floor", self.threshold_floor.to_string()),
            ("tolerance", self.tolerance.to_string()),
        ]
    }

    /// Sets one parameter from words; false if there is none of this name.
    pub(crate) fn set(&mut self, name: &str, value: &str) -> Result<bool, ParameterError> {
        match name {
            "boxes" => self.boxes = list("boxes", value, "whole numbers with commas between")?,
            "fractions" => self.fractions = list("fractions", value, "numbers with commas between")?,
            "bins" => self.bins = one("bins", value, "a whole number")?,
            "sigma8_squared" => self.sigma8_squared = one("sigma8_squared", value, "a number")?,
            "information_grid" => self.information_grid = one("information_grid", value, "a whole number")?,
            "spikes" => {
                self.spikes = match value {
                    "on" | "true" => true,
                    "off" | "false" => false,
                    _ => return Err(wrong("spikes", value, "must be on or off")),
                }
            }
            "max_neighbors" => self.max_neighbors = one("max_neighbors", value, "a whole number")?,
            "position_threshold" => self.position_threshold = one("position_threshold", value, "a number")?,
            "feature_threshold" => self.feature_threshold = one("feature_threshold", value, "a number")?,
            "threshold_floor" => self.threshold_floor = one("threshold_floor", value, "a number")?,
            "tolerance" => self.tolerance = one("tolerance", value, "a number")?,
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Checks ranges, and that every iteration has a box and a fraction.
    pub(crate) fn validate(&self) -> Result<(), ParameterError> {
        let odd = |v: u32| v % 2 == 1;
        let rules = [
            (
                (1..=MAX_ITERATIONS).contains(&self.boxes.len())
                    && self.boxes.iter().all(|&b| odd(b) && (3..=MAX_BOX).contains(&b)),
                format!("must be 1 to {MAX_ITERATIONS} odd widths of 3 to {MAX_BOX} pixels"),
            ),
            (
                self.fractions.len() == self.boxes.len() && self.fractions.iter().all(|f| (0.0..=4.0).contains(f)),
                format!("must be one number of 0 to 4 for each of the {} boxes", self.boxes.len()),
            ),
            (odd(self.bins) && (3..=MAX_BINS).contains(&self.bins), format!("must be odd, 3 to {MAX_BINS}")),
            ((1e-9..=1e6).contains(&self.sigma8_squared), "must be 1e-9 to 1e6".to_owned()),
            ((1..=MAX_GRID).contains(&self.information_grid), format!("must be 1 to {MAX_GRID} pixels")),
            (true, String::new()),
            ((1..=MAX_NEIGHBORS).contains(&self.max_neighbors), format!("must be 1 to {MAX_NEIGHBORS}")),
            ((1.0..=1e6).contains(&self.position_threshold), "must be 1 to 1e6".to_owned()),
            ((1.0..=1e6).contains(&self.feature_threshold), "must be 1 to 1e6".to_owned()),
            ((0.0..=1e30).contains(&self.threshold_floor), "must be 0 to 1e30".to_owned()),
            ((0.0..=1.0).contains(&self.tolerance), "must be 0 to 1".to_owned()),
        ];
        for ((name, value), (right, rule)) in self.entries().into_iter().zip(rules) {
            if !right {
                return Err(wrong(name, &value, &rule));
            }
        }
        Ok(())
    }

    /// Pixels that iteration `t` reads around each pixel it computes.
    pub(crate) fn reach_of(&self, t: usize) -> u32 {
        self.boxes[t] / 2 + (self.information_grid - 1)
    }

    /// Pixels around a pixel without samples that it may be filled from.
    pub(crate) fn fill_reach(&self) -> u32 {
        self.boxes.last().map_or(0, |b| b / 2)
    }

    /// Pixels of halo for the same bits as in the whole image.
    pub(crate) fn reach(&self, varying: bool) -> u32 {
        (0..self.boxes.len()).map(|t| self.reach_of(t)).sum::<u32>() + if varying { self.fill_reach() } else { 0 }
    }

    /// Wanted rows of a neighbourhood in iteration `t` around a pixel with so many samples, its own included.
    pub(crate) fn neighbors(&self, t: usize, samples: usize) -> usize {
        let area = f64::from(self.boxes[t]) * f64::from(self.boxes[t]);
        let wanted = (self.fractions[t] * area * samples as f64).min(f64::from(self.max_neighbors));
        (wanted as usize).max(samples)
    }
}

fn list<T: std::str::FromStr>(name: &'static str, value: &str, kind: &str) -> Result<Vec<T>, ParameterError> {
    value.split(',').map(|v| v.trim().parse().map_err(|_| wrong(name, value, &format!("must be {kind}")))).collect()
}

#[cfg(test)]
mod tests {
    use crate::filter::Method;

    #[test]
    fn presets_reach_as_far_as_their_boxes() {
        let reach = |preset| Method::preset(preset).unwrap().reach(false);
        assert_eq!((reach("paper"), reach("paper-fast"), reach("lean")), (55, 55, 17));
        assert_eq!(Method::preset("lean").unwrap().reach(true), 20);
    }

    #[test]
    fn every_parameter_reads_what_it_prints() {
        for (preset, _) in crate::filter::method::PRESETS {
            let method = Method::preset(preset).unwrap();
            assert_eq!(Method::with(preset, method.parameters()).unwrap(), method);
        }
    }

    #[test]
    fn limits_are_exact_and_say_what_is_right() {
        let with = |name: &str, value: &str| Method::with("lean", [(name, value)]);
        for (name, good, bad) in [
            ("boxes", "255,3", "257,3"),
            ("boxes", "3,3", "1,3"),
            ("boxes", "9,5", "8,5"),
            ("fractions", "0,4", "0,4.1"),
            ("fractions", "0.1,0.1", "0.1"),
            ("bins", "3", "2"),
            ("bins", "31", "33"),
            ("sigma8_squared", "1e-9", "0"),
            ("sigma8_squared", "1e6", "inf"),
            ("information_grid", "64", "65"),
            ("information_grid", "1", "0"),
            ("spikes", "off", "maybe"),
            ("max_neighbors", "65536", "65537"),
            ("max_neighbors", "1", "0"),
            ("position_threshold", "1", "0.5"),
            ("feature_threshold", "1e6", "nan"),
            ("threshold_floor", "0", "-1"),
            ("tolerance", "1", "1.1"),
            ("tolerance", "0", "-1e-9"),
        ] {
            assert!(with(name, good).is_ok(), "{name}={good}");
            let message = with(name, bad).unwrap_err().to_string();
            assert!(message.starts_with(name) && message.contains("must be"), "{message}");
        }
        let message = with("boxs", "3").unwrap_err().to_string();
        assert!(message.contains("boxs") && message.contains("boxes"), "{message}");
        assert!(Method::preset("leen").unwrap_err().to_string().contains("lean"));
    }
}
