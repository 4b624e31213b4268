//! An image as a display shows it: what SSIM and FLIP look at.

/// sRGB values in 0 to 1 of linear ones (IEC 61966-2-1, exposure 0): what is below 0 or NaN is 0, what is above 1 is 1.
pub fn srgb(image: &[[f32; 3]]) -> Vec<[f64; 3]> {
    image.iter().map(|pixel| pixel.map(encode)).collect()
}

fn encode(linear: f32) -> f64 {
    // NaN is not above 0 either.
    let linear = if linear > 0.0 { f64::from(linear.min(1.0)) } else { 0.0 };
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * libm::pow(linear, 1.0 / 2.4) - 0.055 }
}

/// A convolution with one row of weights: the middle of `weights`, whose number is odd, lies on the pixel. Beyond the
/// image its outermost pixels go on. `step` is 1 along rows and `width` along columns.
pub(super) fn convolve(plane: &[f64], width: usize, along_rows: bool, weights: &[f64]) -> Vec<f64> {
    let height = plane.len() / width.max(1);
    let radius = weights.len() / 2;
    let mut out = Vec::with_capacity(plane.len());
    for y in 0..height {
        for x in 0..width {
            let (at, end) = if along_rows { (x, width) } else { (y, height) };
            let value = |k: usize| {
                let there = (at + k).saturating_sub(radius).min(end - 1);
                if along_rows { plane[y * width + there] } else { plane[there * width + x] }
            };
            out.push(weights.iter().enumerate().map(|(k, weight)| weight * value(k)).sum());
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_shown_is_clipped() {
        let odd = srgb(&[[f32::NAN, -1.0, f32::NEG_INFINITY], [f32::INFINITY, 2.0, 1.0]]);
        assert_eq!(odd[0], [0.0; 3]);
        assert!(odd[1].iter().all(|v| (v - 1.0).abs() < 1e-12));
        assert!((srgb(&[[0.214_041_14; 3]])[0][0] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn edges_go_on() {
        let plane = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0];
        assert_eq!(convolve(&plane, 3, true, &[1.0, 0.0, 0.0]), [1.0, 1.0, 2.0, 8.0, 8.0, 16.0]);
        assert_eq!(convolve(&plane, 3, false, &[0.0, 0.0, 1.0]), [8.0, 16.0, 32.0, 8.0, 16.0, 32.0]);
        assert_eq!(convolve(&plane, 3, true, &[1.0]), plane);
    }
}
