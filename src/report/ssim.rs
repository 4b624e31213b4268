//! Structural similarity: Wang, Bovik, Sheikh, Simoncelli, *Image Quality Assessment: From Error Visibility to
//! Structural Similarity*, IEEE TIP 13(4), 2004, equation 13 with the constants of section III-C.
//!
//! The variant: images are clipped to 0..1 and sRGB-encoded ([`srgb`](super::display::srgb)); luminance of the encoded
//! values is Y = 0.2126 R + 0.7152 G + 0.0722 B; windows are 11 x 11 pixels, weighted by a Gaussian of standard deviation
//! 1.5 pixels whose weights sum to 1; K1 = 0.01, K2 = 0.03, L = 1; variances are the weighted ones, without Bessel's
//! correction; the mean is over the windows that lie inside the image. No downsampling.

use super::display::convolve;

/// Side of the window in pixels.
pub const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Mean SSIM of two sRGB images (values in 0 to 1), at most 1, which is for equal images; NaN where an image has no
/// window: a side under 11 pixels.
pub fn ssim(image: &[[f64; 3]], reference: &[[f64; 3]], width: usize) -> f64 {
    let height = image.len() / width.max(1);
    if width < WINDOW || height < WINDOW || image.len() != reference.len() {
        return f64::NAN;
    }
    let gauss: [f64; WINDOW] = std::array::from_fn(|k| {
        let d = k as f64 - (WINDOW / 2) as f64;
        libm::exp(-d * d / (2.0 * SIGMA * SIGMA))
    });
    let sum: f64 = gauss.iter().sum();
    let gauss = gauss.map(|weight| weight / sum);
    let blur = |plane: Vec<f64>| convolve(&convolve(&plane, width, true, &gauss), width, false, &gauss);
    let (x, y) = (luminance(image), luminance(reference));
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>();
    let (xx, yy, xy) = (blur(product(&x, &x)), blur(product(&y, &y)), blur(product(&x, &y)));
    let (x, y) = (blur(x), blur(y));
    let margin = WINDOW / 2;
    let (mut total, mut windows) = (0.0, 0.0);
    for row in margin..height - margin {
        for i in row * width + margin..(row + 1) * width - margin {
            let (mx, my) = (x[i], y[i]);
            let (vx, vy, cov) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
            total += (2.0 * mx * my + C1) * (2.0 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2));
            windows += 1.0;
        }
    }
    total / windows
}

fn luminance(image: &[[f64; 3]]) -> Vec<f64> {
    image.iter().map(|[r, g, b]| 0.2126 * r + 0.7152 * g + 0.0722 * b).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, window by window, with the deviations themselves squared.
    fn directly(image: &[[f64; 3]], reference: &[[f64; 3]], width: usize) -> f64 {
        let (a, b) = (luminance(image), luminance(reference));
        let height = image.len() / width;
        let weight = |i: usize, j: usize| {
            let d = |k: usize| (k as f64 - 5.0).powi(2);
            (-(d(i) + d(j)) / 4.5).exp()
        };
        let all: f64 = (0..121).map(|k| weight(k / 11, k % 11)).sum();
        let mut values = Vec::new();
        for top in 0..=height - 11 {
            for left in 0..=width - 11 {
                let sum = |of: &dyn Fn(usize) -> f64| {
                    (0..121)
                        .map(|k| weight(k / 11, k % 11) / all * of((top + k / 11) * width + left + k % 11))
                        .sum::<f64>()
                };
                let (ma, mb) = (sum(&|i| a[i]), sum(&|i| b[i]));
                let (va, vb) = (sum(&|i| (a[i] - ma).powi(2)), sum(&|i| (b[i] - mb).powi(2)));
                let cov = sum(&|i| (a[i] - ma) * (b[i] - mb));
                values.push(
                    (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4)),
                );
            }
        }
        values.iter().sum::<f64>() / values.len() as f64
    }

    fn image(width: usize, height: usize, m: usize) -> Vec<[f64; 3]> {
        (0..width * height).map(|i| [0, 1, 2].map(|c| ((i * m + c * 61) % 257) as f64 / 257.0)).collect()
    }

    #[test]
    fn equal_images_have_1() {
        let image = image(20, 14, 37);
        assert!((ssim(&image, &image, 20) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn as_directly_computed() {
        for (width, height, m, n) in [(11, 11, 3, 4), (23, 17, 5, 91), (40, 12, 53, 53)] {
            let (a, b) = (image(width, height, m), image(width, height, n));
            let (got, expected) = (ssim(&a, &b, width), directly(&a, &b, width));
            assert!((got - expected).abs() < 1e-10, "{got} is not {expected}");
        }
    }

    /// scikit-image 0.26, `structural_similarity` of the luminances with gaussian_weights=True, sigma=1.5,
    /// use_sample_covariance=False, data_range=1.
    #[test]
    fn as_scikit_image() {
        let (a, b) = (image(23, 17, 5), image(23, 17, 91));
        let got = ssim(&a, &b, 23);
        assert!((got - 0.058_365_405_539_560_4).abs() < 1e-10, "{got}");
    }

    /// Two flat images: only the luminance term is left.
    #[test]
    fn flat_images_have_a_closed_form() {
        let (a, b) = (vec![[0.5; 3]; 400], vec![[0.25; 3]; 400]);
        let expected = (2.0 * 0.125 + 1e-4) / (0.25 + 0.0625 + 1e-4);
        assert!((ssim(&a, &b, 20) - expected).abs() < 1e-10);
    }

    #[test]
    fn an_image_smaller_than_the_window_has_none() {
        let image = image(10, 30, 3);
        assert!(ssim(&image, &image, 10).is_nan());
    }
}
