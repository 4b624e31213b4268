//! A cross-bilateral filter of pixels: the bilateral filter of [`bilateral`] with a further Gaussian
//! over the difference of every feature.
//!
//! E. Eisemann and F. Durand, *Flash Photography Enhancement via Intrinsic Relighting*, and G. Petschnigg et al., *Digital
//! Photography with Flash and No-Flash Image Pairs*, both SIGGRAPH 2004, take the weights from a second, cleaner image;
//! here features are that image, as in the papers that RPF is compared with.
//!
//! A feature channel is one vector: the weight is exp(-|f(p)-f(q)|^2 / (2 s^2)) with the Euclidean distance of two pixels'
//! mean vectors. Channels come in units of their own, so s is relative to what the filtered pixel p itself shows, never
//! to the tile: s^2 = sigma^2 + (deviations spread_p)^2, where spread_p is the standard deviation of p's own samples (the
//! root of the summed variances of the components, with n rather than n - 1).
//!
//! | feature | sigma | deviations |
//! |---|---|---|
//! | world position | 0: no scene has a natural unit | `position_deviations` |
//! | any other (normal, albedo, ...) | `feature_sigma`, in the feature's own units | `feature_deviations` |
//!
//! A position whose spread at p is 0 (one sample per pixel, for instance) has no scale and does not count at p.
//!
//! A pixel's mean is over those of its samples that have the feature. Where no sample has it, the pixel lacks it: two
//! pixels that both lack a feature do not differ in it, and one that lacks it has weight 0 for one that has it.
//!
//! # The sweep that chose the defaults
//!
//! relMSE less the reference's own at 8 samples per pixel, on the five renders of `tests/quality`, and its geometric mean;
//! without a filter that is 0.103. The defaults are fitted to the very scenes that methods are compared on here, which
//! flatters them.
//!
//! Of the grid sigma 2, 3, 4; color_sigma 1.6, 3.2, 6.4; feature_sigma 0.025, 0.05, 0.1; feature_deviations 0.5, 1, 2;
//! position_deviations 5, 10, 30, all with color_scale = log, these are the best and what differs from it in one value:
//!
//! | sigma | color_sigma | feature_sigma | feature_deviations | position_deviations | mean | cornell_box | depth_of_field | glossy_highlights | motion_blur | textures |
//! |---|---|---|---|---|---|---|---|---|---|---|
//! | 2 | 3.2 | 0.05 | 1 | 10 | 0.0224 | 0.0033 | 0.0744 | 0.0319 | 0.0212 | 0.0341 |
//! | 3 | 1.6 | 0.05 | 1 | 10 | 0.0253 | 0.0031 | 0.1622 | 0.0323 | 0.0196 | 0.0334 |
//! | 3 | 3.2 | 0.025 | 1 | 10 | 0.0217 | 0.0029 | 0.0668 | 0.0372 | 0.0198 | 0.0338 |
//! | 3 | 3.2 | 0.05 | 0.5 | 10 | 0.0243 | 0.0036 | 0.0807 | 0.0346 | 0.0265 | 0.0324 |
//! | 3 | 3.2 | 0.05 | 1 | 5 | 0.0218 | 0.0033 | 0.0664 | 0.0324 | 0.0202 | 0.0346 |
//! | 3 | 3.2 | 0.05 | 1 | 10 | 0.0216 | 0.0030 | 0.0656 | 0.0370 | 0.0195 | 0.0335 |
//! | 3 | 3.2 | 0.05 | 1 | 30 | 0.0224 | 0.0031 | 0.0653 | 0.0434 | 0.0192 | 0.0334 |
//! | 3 | 3.2 | 0.05 | 2 | 10 | 0.0257 | 0.0039 | 0.0632 | 0.0477 | 0.0192 | 0.0501 |
//! | 3 | 3.2 | 0.1 | 1 | 10 | 0.0223 | 0.0032 | 0.0610 | 0.0438 | 0.0191 | 0.0335 |
//! | 3 | 6.4 | 0.05 | 1 | 10 | 0.0219 | 0.0030 | 0.0603 | 0.0433 | 0.0195 | 0.0336 |
//! | 4 | 3.2 | 0.05 | 1 | 10 | 0.0220 | 0.0029 | 0.0643 | 0.0425 | 0.0194 | 0.0335 |
//!
//! Printed by `RPFD_DATA=path/to/renders cargo test --release --test integration baselines_sweep -- --ignored --nocapture`.

use super::window::{Column, Distances, Group, Value, Windowed};
use super::{bilateral, gaussian};
use crate::filter::method::{ParameterError, one, within};
use crate::filter::{ChannelSet, LeftOut, LeftOutReason, Plane, Role, SampleTile};

/// The parameters of a cross-bilateral filter; the fields are named as they are set, and so are the bilateral filter's.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// Over distance and colour.
    pub bilateral: bilateral::Params,
    /// Standard deviation over the difference of features other than world positions, in their own units: 1e-6 to 1e30.
    pub feature_sigma: f64,
    /// How many of the pixel's own standard deviations it is widened by: 0 to 1e6.
    pub feature_deviations: f64,
    /// Standard deviation over the difference of world positions, in the pixel's own standard deviations: 0 (positions do
    /// not count) to 1e6.
    pub position_deviations: f64,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            bilateral: bilateral::Params {
                gaussian: gaussian::Params { sigma: 3.0 },
                color_sigma: 3.2,
                color_scale: bilateral::ColorScale::Log,
            },
            feature_sigma: 0.05,
            feature_deviations: 1.0,
            position_deviations: 10.0,
        }
    }
}

impl Params {
    /// Every parameter's name and value in words.
    pub fn entries(&self) -> Vec<(&'static str, String)> {
        let own = [
            ("feature_sigma", self.feature_sigma.to_string()),
            ("feature_deviations", self.feature_deviations.to_string()),
            ("position_deviations", self.position_deviations.to_string()),
        ];
        self.bilateral.entries().into_iter().chain(own).collect()
    }

    /// Sets one parameter from words; false if there is none of this name.
    pub(crate) fn set(&mut self, name: &str, value: &str) -> Result<bool, ParameterError> {
        match name {
            "feature_sigma" => self.feature_sigma = one("feature_sigma", value, "a number")?,
            "feature_deviations" => self.feature_deviations = one("feature_deviations", value, "a number")?,
            "position_deviations" => self.position_deviations = one("position_deviations", value, "a number")?,
            _ => return self.bilateral.set(name, value),
        }
        Ok(true)
    }

    /// Checks ranges.
    pub(crate) fn validate(&self) -> Result<(), ParameterError> {
        self.bilateral.validate()?;
        within("feature_sigma", self.feature_sigma, 1e-6..=1e30, "in the feature's own units")?;
        within("feature_deviations", self.feature_deviations, 0.0..=1e6, "standard deviations")?;
        within("position_deviations", self.position_deviations, 0.0..=1e6, "standard deviations")
    }
}

impl Windowed for Params {
    const FEATURES: bool = true;

    fn space(&self) -> &gaussian::Params {
        &self.bilateral.gaussian
    }

    fn distances(&self, tile: &SampleTile, leave_out: bool) -> (Distances, Vec<LeftOut>) {
        let (mut distances, mut left_out) = self.bilateral.distances(tile, leave_out);
        let mut plane = 0;
        for channel in tile.channels().channels() {
            let planes = plane..plane + channel.components as usize;
            plane = planes.end;
            let Role::Feature { position } = channel.role else { continue };
            let first = distances.columns.len();
            for plane in planes {
                // A constant plane has no differences, and no spread.
                if let (Plane::Constant(value), true) = (tile.plane(plane), leave_out) {
                    let reason = if value.is_nan() { LeftOutReason::Missing } else { LeftOutReason::Constant };
                    left_out.push(LeftOut { plane: tile.channels().plane_name(plane), reason });
                } else {
                    distances.columns.push(Column { plane, value: Value::Feature });
                }
            }
            let (sigma, deviations) = match position {
                true => (0.0, self.position_deviations),
                false => (self.feature_sigma, self.feature_deviations),
            };
            distances.groups.push(Group { columns: first..distances.columns.len(), sigma, deviations });
        }
        (distances, left_out)
    }

    fn most_columns(&self, channels: &ChannelSet) -> usize {
        let features = channels.planes_of(|role| matches!(role, Role::Feature { .. })).len();
        self.bilateral.most_columns(channels) + features
    }
}
