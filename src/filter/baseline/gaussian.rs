//! A Gaussian blur of pixels (eq. 2): g(x, y) = exp(-(x^2 + y^2) / (2 sigma^2)) / (2 pi sigma^2).
//!
//! The Gaussian is cut off at a square of 3 sigma, rounded up to whole pixels, and normalised over the pixels that are
//! in the image and have samples, so that nothing darkens at the edges.
//!
//! # The sweep that chose the default
//!
//! relMSE less the reference's own at 8 samples per pixel, on the five renders of `tests/quality`, and its geometric mean;
//! without a filter that is 0.103. The defaults are fitted to the very scenes that methods are compared on here, which
//! flatters them.
//!
//! | sigma | mean | cornell_box | depth_of_field | glossy_highlights | motion_blur | textures |
//! |---|---|---|---|---|---|---|
//! | 0.3 | 0.0999 | 0.0293 | 0.3868 | 0.1344 | 0.0965 | 0.0678 |
//! | 0.4 | 0.0849 | 0.0388 | 0.2884 | 0.1012 | 0.0720 | 0.0539 |
//! | 0.5 | 0.0789 | 0.1337 | 0.1704 | 0.0646 | 0.0423 | 0.0491 |
//! | 0.6 | 0.0777 | 0.3087 | 0.1101 | 0.0503 | 0.0269 | 0.0616 |
//! | 0.75 | 0.0822 | 0.5973 | 0.0760 | 0.0522 | 0.0181 | 0.0874 |
//! | 1 | 0.0976 | 1.0424 | 0.0566 | 0.0882 | 0.0136 | 0.1249 |
//! | 1.5 | 0.1402 | 1.8368 | 0.0501 | 0.2516 | 0.0130 | 0.1795 |
//! | 2 | 0.1908 | 2.5389 | 0.0647 | 0.4689 | 0.0152 | 0.2156 |
//!
//! Printed by `RPFD_DATA=path/to/renders cargo test --release --test integration baselines_sweep -- --ignored --nocapture`.

use super::window::{Distances, Windowed};
use crate::filter::lanes::padded;
use crate::filter::method::{ParameterError, one, within};
use crate::filter::{ChannelSet, LeftOut, SampleTile};

/// Widest blur, in pixels.
pub const MAX_SIGMA: f64 = 20.0;

/// The parameter of a Gaussian blur; the field is named as it is set.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// Standard deviation in pixels: 0.1 to [`MAX_SIGMA`].
    pub sigma: f64,
}

impl Default for Params {
    fn default() -> Self {
        Self { sigma: 0.6 }
    }
}

impl Params {
    /// The parameter's name and value in words.
    pub fn entries(&self) -> Vec<(&'static str, String)> {
        vec![("sigma", self.sigma.to_string())]
    }

    /// Sets one parameter from words; false if there is none of this name.
    pub(crate) fn set(&mut self, name: &str, value: &str) -> Result<bool, ParameterError> {
        match name {
            "sigma" => self.sigma = one("sigma", value, "a number")?,
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Checks ranges.
    pub(crate) fn validate(&self) -> Result<(), ParameterError> {
        within("sigma", self.sigma, 0.1..=MAX_SIGMA, "pixels")
    }

    /// Pixels to each side that count: 3 sigma, rounded up.
    pub(crate) const fn radius(&self) -> u32 {
        (3.0 * self.sigma).ceil() as u32
    }

    /// Pixels of halo for the same bits as in the whole image; where pixels may lack samples they are filled from as far
    /// again.
    pub(crate) const fn reach(&self, varying: bool) -> u32 {
        self.radius() * if varying { 2 } else { 1 }
    }

    /// The weights along one axis, from -radius to radius, of sum 1: so a weighted sum of colours is never greater than
    /// the greatest of them. Zeros fill it up to whole lanes.
    pub(super) fn weights(&self) -> Vec<f32> {
        let radius = f64::from(self.radius());
        let count = 2 * self.radius() as usize + 1;
        let weight = |i: usize| {
            let x = i as f64 - radius;
            libm::exp(-x * x / (2.0 * self.sigma * self.sigma))
        };
        let all: f64 = (0..count).map(weight).sum();
        let mut weights = vec![0.0; padded(count)];
        weights.iter_mut().take(count).enumerate().for_each(|(i, w)| *w = (weight(i) / all) as f32);
        weights
    }
}

impl Windowed for Params {
    const FEATURES: bool = false;

    fn space(&self) -> &Params {
        self
    }

    fn distances(&self, _: &SampleTile, _: bool) -> (Distances, Vec<LeftOut>) {
        Default::default()
    }

    fn most_columns(&self, _: &ChannelSet) -> usize {
        0
    }
}
