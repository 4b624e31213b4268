//! Pixels that are passed through as they came, for the sake of time (the parameter `tolerance`, 0 by default: none).
//!
//! The samples of a pixel tell how noisy their mean m is: with s of them and their variance v (n - 1), the mean's own
//! variance is v / s, and against a reference r its relMSE is, on average, (v / s) / (r^2 + 0.01). Filtering can at most
//! take that away. With m for r and the mean over the three channels that is the pixel's *error* here. A pixel whose
//! error, and that of each of the 8 pixels around it, is below the tolerance is settled: every iteration gives its samples
//! back as they are. An image's relMSE is its pixels' mean, so on average it rises by less than the tolerance.
//!
//! What this does not say. It is an estimate from few samples: a rare event that no sample of 9 pixels has seen, like a
//! caustic, leaves them settled; that they must agree all nine is what there is against it. A pixel of one sample says
//! nothing of its noise and is filtered. Others draw from settled pixels what was not filtered, so theirs can rise a
//! little too. And it is what filtering *can* take away: where it does less, or harm, the loss is less, or a gain.
//!
//! It depends on samples within 1 pixel, which every iteration reads: tiles, threads and order do not matter.

use super::params::Params;
use crate::filter::{Rect, SampleTile};

/// That of relMSE.
const EPSILON: f64 = 0.01;

/// Bytes that [`settled`] keeps, and takes meanwhile, for so many pixels.
pub(crate) fn bytes(params: &Params, pixels: u64) -> u64 {
    if params.tolerance > 0.0 { 2 * pixels } else { 0 }
}

/// Of each pixel of the data window whether it is settled; empty if none can be.
pub(crate) fn settled(tile: &SampleTile, params: &Params) -> Vec<bool> {
    if params.tolerance <= 0.0 {
        return Vec::new();
    }
    let window = tile.geometry().window();
    let mut quiet = Vec::with_capacity(window.area() as usize);
    quiet.extend((0..window.area() as usize).map(|pixel| error(tile, pixel) < params.tolerance));
    let mut settled = Vec::with_capacity(quiet.len());
    for y in window.y..window.bottom() {
        for x in window.x..window.right() {
            let around = Rect::new(x, y, 1, 1).grown(1, &window);
            let mut rows = around.y..around.bottom();
            settled.push(rows.all(|y| (around.x..around.right()).all(|x| quiet[window.index(x, y)])));
        }
    }
    settled
}

/// The error that a pixel's mean has on average, as relMSE, by its own samples; 0 without any, infinite of one.
pub(crate) fn error(tile: &SampleTile, pixel: usize) -> f64 {
    let samples = tile.samples_of(pixel);
    let count = samples.len() as f64;
    match samples.len() {
        0 => return 0.0,
        1 => return f64::INFINITY,
        _ => {}
    }
    let errors = tile.channels().color_planes().map(|plane| {
        let values = samples.clone().map(|sample| f64::from(tile.value(plane, sample)));
        let mean = values.clone().sum::<f64>() / count;
        let variance = values.map(|v| (v - mean) * (v - mean)).sum::<f64>() / (count - 1.0);
        variance / count / (mean * mean + EPSILON)
    });
    errors.iter().sum::<f64>() / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, ChannelSet, Counts, Plane, Role, TileGeometry};

    /// On average the error is the relMSE of the mean: here against the truth, over pixels of independent samples.
    #[test]
    fn the_error_is_the_relmse_of_the_mean() {
        let (side, per_pixel) = (100, 6);
        let geometry = TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).unwrap();
        let total = (side * side * per_pixel) as u64;
        let uniform = |i: u64| (super::super::random::mix(i) >> 40) as f32 / (1 << 24) as f32;
        // Uniform in 0.9 to 1.1, -0.1 to 0.5, and 0 to 40: the truth is the middle.
        let ranges = [(0.9, 1.1), (-0.1, 0.5), (0.0, 40.0)];
        let planes = ranges.iter().enumerate().map(|(k, (low, high))| {
            Plane::Values((0..total).map(|i| low + (high - low) * uniform(i * 3 + k as u64)).collect())
        });
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let tile = SampleTile::new(geometry, channels, Counts::Uniform(per_pixel), planes.collect()).unwrap();
        let (mut estimated, mut true_error) = (0.0, 0.0);
        for pixel in 0..(side * side) as usize {
            estimated += error(&tile, pixel);
            for (k, (low, high)) in ranges.iter().enumerate() {
                let values = tile.samples_of(pixel).map(|s| f64::from(tile.value(k, s)));
                let (mean, truth) = (values.sum::<f64>() / f64::from(per_pixel), f64::from(low + high) / 2.0);
                true_error += (mean - truth).powi(2) / (truth * truth + EPSILON) / 3.0;
            }
        }
        // The mean in the denominator is as noisy as the pixel: darker than the truth counts more.
        let ratio = estimated / true_error;
        assert!((0.9..1.5).contains(&ratio), "{ratio}");
    }
}
