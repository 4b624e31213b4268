//! LDR-FLIP: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, *FLIP: A Difference Evaluator for
//! Alternating Images*, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020; section numbers below are the paper's.
//! Constants are those of the authors' implementation 1.7, whose figures the test compares with.
//!
//! The images are as on a display ([`srgb`](super::display::srgb)), seen at 67.02 pixels per degree: 0.7 m from a
//! monitor of 3840 pixels on 0.7 m.

use super::display::convolve;
use std::f64::consts::PI;

const PIXELS_PER_DEGREE: f64 = 0.7 * (3840.0 / 0.7) * (PI / 180.0);

/// Contrast sensitivity (4.1.1): a sum of Gaussians (a, b) for each of Y, Cx and Cz.
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];

/// Mean FLIP error, 0 for equal images to 1, of two sRGB images with values in 0 to 1. NaN for images without pixels.
pub fn flip(image: &[[f64; 3]], reference: &[[f64; 3]], width: usize) -> f64 {
    let map = flip_map(image, reference, width);
    map.iter().sum::<f64>() / map.len() as f64
}

/// The error of each pixel.
fn flip_map(image: &[[f64; 3]], reference: &[[f64; 3]], width: usize) -> Vec<f64> {
    let [image, reference] = [image, reference].map(|pixels| Seen::new(pixels, width));
    let greatest = libm::pow(hyab(&hunt_lab([0.0, 1.0, 0.0]), &hunt_lab([0.0, 0.0, 1.0])), 0.7);
    let pixels = image.color.iter().zip(&reference.color).enumerate();
    let of = |(i, (a, b)): (usize, (&[f64; 3], &[f64; 3]))| {
        // 4.1.3: large differences are compressed into the last 5 %.
        let difference = libm::pow(hyab(a, b), 0.7);
        let knee = 0.4 * greatest;
        let color = if difference < knee {
            0.95 / knee * difference
        } else {
            0.95 + (difference - knee) / (greatest - knee) * 0.05
        };
        // 4.2: the greater of the differences in edges and in points.
        let edge = (image.edges[i] - reference.edges[i]).abs();
        let point = (image.points[i] - reference.points[i]).abs();
        let feature = libm::sqrt((edge.max(point) / std::f64::consts::SQRT_2).min(1.0));
        libm::pow(color, 1.0 - feature)
    };
    pixels.map(of).collect()
}

/// An image as an eye sees it.
struct Seen {
    /// Hunt-adjusted L*a*b* of what contrast sensitivity lets through.
    color: Vec<[f64; 3]>,
    /// Strength of edges and points in luminance.
    edges: Vec<f64>,
    points: Vec<f64>,
}

impl Seen {
    fn new(pixels: &[[f64; 3]], width: usize) -> Self {
        let opponent: Vec<[f64; 3]> = pixels.iter().map(|pixel| opponent(xyz(pixel.map(decode)))).collect();
        let plane = |c: usize| opponent.iter().map(|pixel| pixel[c]).collect::<Vec<f64>>();
        let [y, x, z] = [0, 1, 2].map(|c| filter(&plane(c), width, SENSITIVITY[c]));
        let seen =
            y.iter().zip(&x).zip(&z).map(|((&y, &x), &z)| hunt_lab(linear([y, x, z]).map(|v| v.clamp(0.0, 1.0))));
        // Achromatic, 0 to 1.
        let gray: Vec<f64> = opponent.iter().map(|pixel| (pixel[0] + 16.0) / 116.0).collect();
        let [smooth, first, second] = derivatives();
        let strength = |kernel: &[f64]| {
            let horizontal = convolve(&convolve(&gray, width, true, kernel), width, false, &smooth);
            let vertical = convolve(&convolve(&gray, width, true, &smooth), width, false, kernel);
            horizontal.iter().zip(&vertical).map(|(h, v)| libm::sqrt(h * h + v * v)).collect()
        };
        Self { color: seen.collect(), edges: strength(&first), points: strength(&second) }
    }
}

/// What is seen of one opponent channel (4.1.1): each Gaussian is separable, and together they sum to 1.
fn filter(plane: &[f64], width: usize, gaussians: &[(f64, f64)]) -> Vec<f64> {
    let widest = SENSITIVITY.iter().flat_map(|of| of.iter()).fold(0.0_f64, |most, &(_, b)| most.max(b));
    let radius = (3.0 * libm::sqrt(widest / (2.0 * PI * PI)) * PIXELS_PER_DEGREE).ceil() as i32;
    let kernels = gaussians.iter().map(|&(a, b)| {
        let at = |k: i32| {
            let degrees = f64::from(k) / PIXELS_PER_DEGREE;
            libm::exp(-PI * PI * degrees * degrees / b)
        };
        let row: Vec<f64> = (-radius..=radius).map(at).collect();
        let sum: f64 = row.iter().sum();
        let weight = a * libm::sqrt(PI / b) * sum * sum;
        (weight, row.iter().map(|value| value / sum).collect::<Vec<_>>())
    });
    let kernels: Vec<(f64, Vec<f64>)> = kernels.collect();
    let total: f64 = kernels.iter().map(|(weight, _)| weight).sum();
    let mut out = vec![0.0; plane.len()];
    for (weight, row) in &kernels {
        let blurred = convolve(&convolve(plane, width, true, row), width, false, row);
        out.iter_mut().zip(blurred).for_each(|(out, value)| *out += weight / total * value);
    }
    out
}

/// A Gaussian and its first two derivatives (4.2), for features 0.082 degrees wide: the Gaussian sums to 1, the
/// positive weights of the others to 1 and their negative ones to -1.
fn derivatives() -> [Vec<f64>; 3] {
    let deviation = 0.5 * 0.082 * PIXELS_PER_DEGREE;
    let radius = (3.0 * deviation).ceil() as i32;
    let gauss = |x: f64| libm::exp(-x * x / (2.0 * deviation * deviation));
    let row = |of: &dyn Fn(f64) -> f64| (-radius..=radius).map(|k| of(f64::from(k))).collect::<Vec<f64>>();
    let balanced = |row: Vec<f64>| {
        let positive: f64 = row.iter().filter(|v| **v > 0.0).sum();
        let negative: f64 = row.iter().filter(|v| **v < 0.0).sum::<f64>().abs().max(f64::MIN_POSITIVE);
        row.iter().map(|&v| if v > 0.0 { v / positive } else { v / negative }).collect()
    };
    [
        balanced(row(&gauss)),
        balanced(row(&|x| -x * gauss(x))),
        balanced(row(&|x| (x * x / (deviation * deviation) - 1.0) * gauss(x))),
    ]
}

fn decode(srgb: f64) -> f64 {
    if srgb <= 0.04045 { srgb / 12.92 } else { libm::pow((srgb + 0.055) / 1.055, 2.4) }
}

const WHITE: [f64; 3] = [0.950_428_545, 1.0, 1.088_900_371];

/// CIE XYZ over that of the white D65.
fn xyz([r, g, b]: [f64; 3]) -> [f64; 3] {
    let x = (10_135_552.0 * r + 8_788_810.0 * g + 4_435_075.0 * b) / 24_577_794.0;
    let y = (2_613_072.0 * r + 8_788_810.0 * g + 887_015.0 * b) / 12_288_897.0;
    let z = (1_425_312.0 * r + 8_788_810.0 * g + 70_074_185.0 * b) / 73_733_382.0;
    [x / WHITE[0], y / WHITE[1], z / WHITE[2]]
}

/// The linear space YCxCz (4.1).
fn opponent([x, y, z]: [f64; 3]) -> [f64; 3] {
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Linear RGB of a colour in YCxCz.
fn linear([y, cx, cz]: [f64; 3]) -> [f64; 3] {
    let y = (y + 16.0) / 116.0;
    let (x, z) = ((cx / 500.0 + y) * WHITE[0], (y - cz / 200.0) * WHITE[2]);
    [
        3.241_003_275 * x - 1.537_398_934 * y - 0.498_615_861 * z,
        -0.969_224_334 * x + 1.875_930_071 * y + 0.041_554_224 * z,
        0.055_639_423 * x - 0.204_011_202 * y + 1.057_148_933 * z,
    ]
}

/// L*a*b* of linear RGB, with chroma that fades with lightness (Hunt effect, 4.1.2).
fn hunt_lab(rgb: [f64; 3]) -> [f64; 3] {
    let delta: f64 = 6.0 / 29.0;
    let f = |t: f64| if t > delta.powi(3) { libm::cbrt(t) } else { t / (3.0 * delta * delta) + 4.0 / 29.0 };
    let [x, y, z] = xyz(rgb).map(f);
    let lightness = 116.0 * y - 16.0;
    let hunt = 0.01 * lightness;
    [lightness, hunt * 500.0 * (x - y), hunt * 200.0 * (y - z)]
}

/// Distance of two colours (4.1.2).
fn hyab(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    (a[0] - b[0]).abs() + libm::hypot(a[1] - b[1], a[2] - b[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize, [m, n]: [usize; 2]) -> Vec<[f64; 3]> {
        let value = |x: usize, y: usize, c: usize| ((x * m + y * n + c * 61) % 257) as f64 / 256.0;
        (0..width * height).map(|i| [0, 1, 2].map(|c| value(i % width, i / width, c))).collect()
    }

    /// The reference first, then the image; mean, and the errors of the first, middle and last pixel, by flip-evaluator
    /// 1.7 from PyPI (single precision) on the same values: `evaluate(reference, image, "LDR", True, False, True)`.
    type Golden = (usize, usize, [usize; 2], [usize; 2], f64, [f64; 3]);

    const GOLDEN: [Golden; 4] = [
        (40, 30, [3, 5], [4, 5], 0.5687127709388733, [0.03303482010960579, 0.8526607751846313, 0.6273615956306458]),
        (33, 47, [1, 2], [97, 31], 0.7020220160484314, [0.7410001754760742, 0.6726287007331848, 0.7934085130691528]),
        (
            64,
            64,
            [53, 37],
            [71, 29],
            0.29674917459487915,
            [0.14026014506816864, 0.40664172172546387, 0.683501124382019],
        ),
        (12, 9, [0, 0], [64, 64], 0.9595643281936646, [0.7795290946960449, 0.9547939896583557, 0.9788332581520081]),
    ];

    #[test]
    fn as_the_reference_implementation() {
        for (width, height, reference, test, mean, pixels) in GOLDEN {
            let (reference, test) = (image(width, height, reference), image(width, height, test));
            let map = flip_map(&test, &reference, width);
            let got = flip(&test, &reference, width);
            assert!((got - mean).abs() < 2e-5, "{width} x {height}: {got} is not {mean}");
            let places = [0, height / 2 * width + width / 2, width * height - 1];
            for (place, expected) in places.into_iter().zip(pixels) {
                assert!((map[place] - expected).abs() < 2e-4, "{width} x {height}: {} is not {expected}", map[place]);
            }
        }
        let (black, white) = (vec![[0.0; 3]; 400], vec![[1.0; 3]; 400]);
        assert!((flip(&white, &black, 20) - 0.9673861861228943).abs() < 1e-5);
    }

    #[test]
    fn equal_images_have_0() {
        let image = image(40, 30, [3, 5]);
        assert_eq!(flip(&image, &image, 40), 0.0);
    }
}
