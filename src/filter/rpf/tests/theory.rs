//! Stages against what theory says.

use crate::filter::lanes::{LANES, SimdLevel, dispatch, padded};
use crate::filter::rpf::information::{Histograms, entropy_terms, whole_words};
use crate::filter::rpf::neighborhood::{Center, Offsets, candidate, offset_probabilities, pick_sample};
use crate::filter::rpf::random::{bits, pixel_key};
use crate::filter::rpf::statistics::{center, make_safe, normalise, pad};
use crate::filter::{Rect, oracle};

const BINS: u32 = 7;

fn uniform(key: u64, n: usize) -> Vec<f32> {
    (0..n as u64).map(|i| (bits(key, i) >> 40) as f32 / 16_777_216.0).collect()
}

/// Information of two raw columns by the fast path.
fn information(x: &[f32], y: &[f32]) -> f64 {
    let n = x.len();
    let terms = entropy_terms(n);
    dispatch!(SimdLevel::default().level(), simd => {
        let mut histograms = Histograms::with_capacity(2, n, BINS, true);
        histograms.start(n);
        for (column, values) in [x, y].into_iter().enumerate() {
            let mut values = values.to_vec();
            values.resize(whole_words(n), 0.0);
            pad(&mut values, n);
            let spans = make_safe(simd, &mut [&mut values[..]]);
            let [scale] = center(simd, &mut [&mut values[..]], n, &spans);
            histograms.set(simd, column, &values, &scale);
        }
        histograms.finish(simd, &terms);
        histograms.measure(simd, 0..1, 1..2, &terms);
        histograms.information(0, &(1..2))[0]
    })
}

fn entropy(probabilities: &[f64]) -> f64 {
    probabilities.iter().map(|p| -p * p.ln()).sum()
}

/// Probability of each bin of a normalised uniform variable, which spans +-sqrt(3): five bins.
fn uniform_bins() -> [f64; 5] {
    let width = 2.0 * 3f64.sqrt();
    let (inner, outer) = (1.0 / width, (3f64.sqrt() - 1.5) / width);
    [outer, inner, inner, inner, outer]
}

/// For independent variables 2 n I follows chi-squared with (Bx-1)(By-1) degrees of freedom, to first order: its mean is
/// the bias that RPF's weights suffer from.
#[test]
fn independent_variables_have_the_known_bias() {
    let trials = 400;
    for n in [200, 1000] {
        let mean = (0..trials)
            .map(|trial| 2.0 * n as f64 * information(&uniform(2 * trial, n), &uniform(2 * trial + 1, n)))
            .sum::<f64>()
            / trials as f64;
        // 16 degrees of freedom; the mean of 400 has a standard error of sqrt(32 / 400) = 0.28. The next term of the
        // expansion is (sum 1/p_x - 1)(sum 1/p_y - 1) / (6 n) in 2 n I, 1.2 at n = 200.
        let second: f64 = (uniform_bins().iter().map(|p| 1.0 / p).sum::<f64>() - 1.0).powi(2) / (6.0 * n as f64);
        assert!((mean - 16.0 - second).abs() < 1.0, "n = {n}: 2 n I = {mean}, expected 16 + {second}");
    }
}

#[test]
fn identical_and_linear_variables_share_all_their_information() {
    let x = uniform(7, 60_000);
    let expected = entropy(&uniform_bins());
    for y in [x.clone(), x.iter().map(|v| 2.0 - 3.0 * v).collect()] {
        let information = information(&x, &y);
        assert!((information - expected).abs() < 0.01, "{information} against {expected}");
    }
}

/// Y = X^2 with X uniform: uncorrelated, yet dependent. Both are functions of |X|, whose bin edges are known.
#[test]
fn a_function_without_correlation_is_found() {
    let x: Vec<f32> = uniform(9, 60_000).into_iter().map(|v| v - 0.5).collect();
    let y: Vec<f32> = x.iter().map(|v| v * v).collect();
    let edge = |z: f64| (1.0 + z * 0.8f64.sqrt()).sqrt();
    // |X| from .. to, the bin of |X|, the bin of Y; X and -X are in different bins unless the bin is 0.
    let parts = [
        (0.0, 0.5, 0, -1),
        (0.5, edge(-0.5), 1, -1),
        (edge(-0.5), edge(0.5), 1, 0),
        (edge(0.5), 1.5, 1, 1),
        (1.5, edge(1.5), 2, 1),
        (edge(1.5), 3f64.sqrt(), 2, 2),
    ];
    let share = |(from, to, ..): &(f64, f64, i32, i32)| (to - from) / 3f64.sqrt();
    let of_y: Vec<f64> = (-1..=2).map(|bin| parts.iter().filter(|part| part.3 == bin).map(share).sum()).collect();
    let joint: Vec<f64> = parts
        .iter()
        .flat_map(|part| if part.2 == 0 { vec![share(part)] } else { vec![share(part) / 2.0; 2] })
        .collect();
    let expected = entropy(&uniform_bins()) + entropy(&of_y) - entropy(&joint);
    let information = information(&x, &y);
    assert!((information - expected).abs() < 0.01, "{information} against {expected}");
}

#[test]
fn constant_columns_have_no_information() {
    assert_eq!(information(&uniform(1, 500), &[4.2; 500]), 0.0);
    assert_eq!(information(&[1e30; 500], &[1e30; 500]), 0.0);
}

/// Zero mean and unit deviation whatever the size, offset or count; equal to the oracle.
#[test]
fn normalising_holds_for_every_size() {
    for n in [2, 3, 15, 16, 17, 484, 5000] {
        for (scale, offset) in
            [(1.0, 0.0), (1e-38, 0.0), (1e-20, 0.0), (3e38, 0.0), (1e18, 0.0), (0.01, 1e4), (1.0, -1e6)]
        {
            let raw: Vec<f32> = uniform(n as u64, n).into_iter().map(|v| (v * scale) + offset).collect();
            let expected = oracle::normalise(&raw.iter().map(|&v| f64::from(v)).collect::<Vec<_>>());
            for (level, simd) in SimdLevel::available() {
                let mut values = raw.clone();
                values.resize(padded(n), 0.0);
                pad(&mut values, n);
                dispatch!(simd.level(), simd => {
                    let spans = make_safe(simd, &mut [&mut values[..]]);
                    normalise(simd, &mut [&mut values[..]], n, &spans, &[1.0]);
                });
                for (value, expected) in values[..n].iter().zip(&expected) {
                    let difference = (f64::from(*value) - expected).abs();
                    assert!(difference < 2e-5, "{level}, n = {n}, {scale:e} + {offset:e}: {difference:e}");
                }
            }
        }
    }
}

/// Chi-squared of counts against expected ones, in standard deviations from its mean.
fn chi_squared_deviation(counts: &[u32], expected: &[f64]) -> f64 {
    let terms = counts.iter().zip(expected).filter(|(_, e)| **e > 0.0);
    let degrees = terms.clone().count() as f64 - 1.0;
    let chi: f64 = terms.map(|(&n, e)| (f64::from(n) - e).powi(2) / e).sum();
    (chi - degrees) / (2.0 * degrees).sqrt()
}

/// Offsets follow the rounded Gaussian inside the box, without the pixel itself, cut off at the image's border; what
/// fails 8 times is dropped; every sample of a pixel is equally likely.
#[test]
fn draws_follow_their_distribution() {
    const SAMPLES: usize = 5;
    let image = Rect::new(0, 0, 200, 150);
    for width in [3, 7, 17, 55] {
        let offsets = Offsets::new(width);
        let radius = (width / 2) as i32;
        let axis = offset_probabilities(width);
        for (x, y) in [(100, 70), (0, 70), (199, 149), (2, 0)] {
            let draws = 200_000u64;
            let center = Center { x, y, key: pixel_key(11, x, y, 0), wanted: 0 };
            let side = width as usize;
            let (mut counts, mut picked, mut dropped) = (vec![0; side * side], [0; SAMPLES], 0);
            for draw in 0..draws {
                let Some((pixel, bits)) = candidate(&image, &image, &offsets, &center, draw) else {
                    dropped += 1;
                    continue;
                };
                let (px, py) = (pixel as i32 % 200, pixel as i32 / 200);
                counts[((py - y as i32 + radius) * width as i32 + px - x as i32 + radius) as usize] += 1;
                picked[pick_sample(bits, &(0..SAMPLES)) as usize] += 1;
            }
            let inside = |dx: i32, dy: i32| {
                let (px, py) = (x as i32 + dx, y as i32 + dy);
                (dx, dy) != (0, 0) && px >= 0 && py >= 0 && image.contains(px as u32, py as u32)
            };
            let probability: Vec<f64> = (-radius..=radius)
                .flat_map(|dy| (-radius..=radius).map(move |dx| (dx, dy)))
                .map(|(dx, dy)| {
                    let p = axis[(dx + radius) as usize] * axis[(dy + radius) as usize];
                    if inside(dx, dy) { p } else { 0.0 }
                })
                .collect();
            let success: f64 = probability.iter().sum();
            let kept = (draws - dropped) as f64;
            let expected: Vec<f64> = probability.iter().map(|p| p / success * kept).collect();
            let outside = counts.iter().zip(&expected).filter(|(_, e)| **e == 0.0).map(|(n, _)| n).sum::<u32>();
            assert_eq!(outside, 0, "width {width} at ({x}, {y})");
            let deviation = chi_squared_deviation(&counts, &expected);
            assert!(deviation.abs() < 5.0, "width {width} at ({x}, {y}): {deviation} deviations");
            assert!(chi_squared_deviation(&picked, &[kept / SAMPLES as f64; SAMPLES]).abs() < 5.0);
            let expected = draws as f64 * (1.0 - success).powi(8);
            assert!((dropped as f64 - expected).abs() < 5.0 * expected.sqrt() + 5.0, "{dropped} against {expected}");
        }
    }
}

/// Below full lanes the padding has no say.
#[test]
fn padding_does_not_count() {
    for n in 1..40 {
        let mut values = uniform(3, n);
        values.resize(padded(n) + LANES, 99.0);
        pad(&mut values[..padded(n)], n);
        let [span] = dispatch!(SimdLevel::default().level(), simd => make_safe(simd, &mut [&mut values[..padded(n)]]));
        let least = values[..n].iter().copied().fold(f32::MAX, f32::min);
        let greatest = values[..n].iter().copied().fold(f32::MIN, f32::max);
        assert_eq!((span.min, span.max), (least, greatest));
    }
}
