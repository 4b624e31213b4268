//! The baselines as their formulas stand (eq. 2 to 4, and the documentation of each): every pixel is a weighted mean of the
//! pixels' means in the square around it.

use super::super::baseline::{bilateral, bilateral::ColorScale, cross_bilateral};
use super::super::method::Algorithm;
use super::super::{Role, SampleTile};
use super::{Color, cover, deviation, mean};

/// Planes that are compared as one vector.
struct Group {
    planes: Vec<usize>,
    scale: fn(f64) -> f64,
    /// A difference's variance is sigma^2 + (deviations x the standard deviation of the pixel's own samples)^2.
    sigma: f64,
    deviations: f64,
}

/// Of one pixel and group: the mean of each plane on its scale, none where no sample has it, and the variance.
struct Own {
    means: Vec<Option<f64>>,
    variance: f64,
}

/// The core's pixels, filtered by a baseline or unfiltered; none for RPF, which is [`Whole`](super::Whole)'s.
pub fn baseline(tile: &SampleTile, algorithm: &Algorithm) -> Option<Vec<Color>> {
    let (sigma, groups) = match algorithm {
        Algorithm::Unfiltered => (0.0, Vec::new()),
        Algorithm::Gaussian(params) => (params.sigma, Vec::new()),
        Algorithm::Bilateral(params) => (params.gaussian.sigma, vec![colors(tile, params)]),
        Algorithm::CrossBilateral(params) => {
            let groups = features(tile, params).chain([colors(tile, &params.bilateral)]).collect();
            (params.bilateral.gaussian.sigma, groups)
        }
        Algorithm::Rpf(_) => return None,
    };
    let window = tile.geometry().window();
    let pixels = window.area() as usize;
    let own: Vec<Vec<Own>> = (0..pixels).map(|p| groups.iter().map(|group| group.own(tile, p)).collect()).collect();
    let planes = tile.channels().color_planes();
    let color = |p| {
        let [r, g, b] = planes.map(|plane| present(tile, plane, p));
        Some([mean(&r?), mean(&g?), mean(&b?)])
    };
    let color: Vec<Option<Color>> = (0..pixels).map(color).collect();
    let radius = (3.0 * sigma).ceil() as u32;
    let filtered = (0..pixels).map(|p| {
        color[p]?;
        let (x, y) = (window.x + p as u32 % window.width, window.y + p as u32 / window.width);
        let around = super::Rect::new(x, y, 1, 1).grown(radius, &window);
        let (mut total, mut sums) = (0.0, [0.0; 3]);
        for (x2, y2) in (around.y..around.bottom()).flat_map(|y| (around.x..around.right()).map(move |x| (x, y))) {
            let q = window.index(x2, y2);
            let Some(color) = color[q] else { continue };
            let distance = f64::from(x.abs_diff(x2).pow(2) + y.abs_diff(y2).pow(2));
            let space = if q == p { 0.0 } else { distance / (2.0 * sigma * sigma) };
            let compared = groups.iter().zip(&own[p]).zip(&own[q]);
            let difference: f64 = compared.map(|((group, p), q)| group.difference(p, q)).sum();
            let weight = (-space - difference).exp();
            total += weight;
            sums = [0, 1, 2].map(|k| sums[k] + weight * color[k]);
        }
        Some(sums.map(|sum| sum / total))
    });
    let filtered: Vec<Option<Color>> = filtered.collect();
    Some(cover(tile, radius, |index| filtered[index]))
}

/// The values of a pixel that are not NaN, if there are any.
fn present(tile: &SampleTile, plane: usize, pixel: usize) -> Option<Vec<f64>> {
    let values = tile.samples_of(pixel).map(|sample| f64::from(tile.value(plane, sample)));
    let present: Vec<f64> = values.filter(|v| !v.is_nan()).collect();
    (!present.is_empty()).then_some(present)
}

fn colors(tile: &SampleTile, params: &bilateral::Params) -> Group {
    let scale = match params.color_scale {
        ColorScale::Linear => |c| c,
        ColorScale::Log => |c: f64| c.signum() * c.abs().ln_1p(),
    };
    Group { planes: tile.channels().color_planes().to_vec(), scale, sigma: params.color_sigma, deviations: 0.0 }
}

fn features<'a>(tile: &'a SampleTile, params: &'a cross_bilateral::Params) -> impl Iterator<Item = Group> + 'a {
    let mut plane = 0;
    tile.channels().channels().iter().filter_map(move |channel| {
        let planes: Vec<usize> = (plane..plane + channel.components as usize).collect();
        plane += planes.len();
        let (sigma, deviations) = match channel.role {
            Role::Feature { position: true } => (0.0, params.position_deviations),
            Role::Feature { position: false } => (params.feature_sigma, params.feature_deviations),
            _ => return None,
        };
        Some(Group { planes, scale: |v| v, sigma, deviations })
    })
}

impl Group {
    fn own(&self, tile: &SampleTile, pixel: usize) -> Own {
        let of = |&plane: &usize| present(tile, plane, pixel);
        let spread: f64 = self.planes.iter().filter_map(of).map(|values| deviation(&values).powi(2)).sum();
        Own {
            means: self.planes.iter().map(|plane| of(plane).map(|values| (self.scale)(mean(&values)))).collect(),
            variance: self.sigma.powi(2) + self.deviations.powi(2) * spread,
        }
    }

    /// What pixel q's weight for pixel p has in its exponent.
    fn difference(&self, p: &Own, q: &Own) -> f64 {
        if self.sigma + self.deviations == 0.0 {
            return 0.0;
        }
        let one = |(p_mean, q_mean): (&Option<f64>, &Option<f64>)| match (p_mean, q_mean) {
            (None, None) => 0.0,
            (Some(_), _) if p.variance == 0.0 => 0.0,
            (Some(a), Some(b)) => (a - b).powi(2) / (2.0 * p.variance),
            _ => f64::INFINITY,
        };
        p.means.iter().zip(&q.means).map(one).sum()
    }
}
