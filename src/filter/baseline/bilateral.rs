//! A bilateral filter of pixels (eq. 3, 4): b(p) = sum_q f(q) D(p-q) R(f(p)-f(q)) / sum_q D(p-q) R(f(p)-f(q)).
//!
//! C. Tomasi and R. Manduchi, *Bilateral Filtering for Gray and Color Images*, ICCV 1998. D is the Gaussian of
//! [`gaussian`](super::gaussian), cut off in the same way, and R(d) = exp(-|d|^2 / (2 color_sigma^2)). The thesis paper
//! prints a *sum* of squares in R where Tomasi and Manduchi have the difference; the difference it is.
//!
//! d is the Euclidean distance of two pixels' means in linear R, G, B. (Tomasi and Manduchi measure in CIE-Lab, which is
//! made for displays; radiance has no white.) A fixed `color_sigma` means little over the range that radiance has, so
//! that `color_scale` can be `log`: the distance is then measured after c -> sign(c) ln(1 + |c|), which is c itself for
//! dark colours and a ratio for bright ones. What is averaged is linear radiance in both cases.
//!
//! # The sweep that chose the defaults
//!
//! SWEEP

use super::gaussian;
use super::window::{Column, Distances, Group, Value, Windowed};
use crate::filter::method::{ParameterError, one, within, wrong};
use crate::filter::{ChannelSet, LeftOut, SampleTile};

/// On what scale colours are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColorScale {
    /// Linear radiance.
    Linear,
    /// sign(c) ln(1 + |c|).
    Log,
}

impl ColorScale {
    const NAMES: [(&str, Self); 2] = [("linear", Self::Linear), ("log", Self::Log)];

    fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(_, scale)| *scale == self).map_or("", |(name, _)| name)
    }
}

/// The parameters of a bilateral filter; the fields are named as they are set, and `sigma` is the Gaussian's.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// Over distance.
    pub gaussian: gaussian::Params,
    /// Standard deviation over the difference in colour, on the scale of `color_scale`: 1e-6 to 1e30.
    pub color_sigma: f64,
    /// On what scale colours are compared: `linear` or `log`.
    pub color_scale: ColorScale,
}

impl Default for Params {
    fn default() -> Self {
        Self { gaussian: gaussian::Params { sigma: 2.0 }, color_sigma: 0.5, color_scale: ColorScale::Log }
    }
}

impl Params {
    /// Every parameter's name and value in words.
    pub fn entries(&self) -> Vec<(&'static str, String)> {
        let own = [("color_sigma", self.color_sigma.to_string()), ("color_scale", self.color_scale.name().to_owned())];
        self.gaussian.entries().into_iter().chain(own).collect()
    }

    /// Sets one parameter from words; false if there is none of this name.
    pub(crate) fn set(&mut self, name: &str, value: &str) -> Result<bool, ParameterError> {
        match name {
            "color_sigma" => self.color_sigma = one("color_sigma", value, "a number")?,
            "color_scale" => {
                let known = ColorScale::NAMES.iter().find(|(name, _)| *name == value);
                self.color_scale = known.ok_or_else(|| wrong("color_scale", value, "must be linear or log"))?.1;
            }
            _ => return self.gaussian.set(name, value),
        }
        Ok(true)
    }

    /// Checks ranges.
    pub(crate) fn validate(&self) -> Result<(), ParameterError> {
        self.gaussian.validate()?;
        within("color_sigma", self.color_sigma, 1e-6..=1e30, "on the colour scale")
    }
}

impl Windowed for Params {
    const FEATURES: bool = false;

    fn space(&self) -> &gaussian::Params {
        &self.gaussian
    }

    fn distances(&self, tile: &SampleTile, _: bool) -> (Distances, Vec<LeftOut>) {
        let value = match self.color_scale {
            ColorScale::Linear => Value::Color,
            ColorScale::Log => Value::LogColor,
        };
        let columns = tile.channels().color_planes().map(|plane| Column { plane, value }).to_vec();
        let groups = vec![Group { columns: 0..columns.len(), sigma: self.color_sigma, deviations: 0.0 }];
        (Distances { columns, groups }, Vec::new())
    }

    fn most_columns(&self, _: &ChannelSet) -> usize {
        3
    }
}
