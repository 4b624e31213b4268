//! Numbers that say how far an image x is from its reference r.
//!
//! Both are linear RGB; everything is computed in f64, over all values (three a pixel) unless said.
//!
//! | field | formula |
//! |---|---|
//! | `mse` | mean (x - r)^2 |
//! | `relmse` | mean (x - r)^2 / (r^2 + 0.01) |
//! | `relmse_trimmed` | the same, without the worst 0.1 % of the pixels: of the pixels' own relMSE (mean over their three values) the round(0.999 n) smallest, at least one, are averaged; round half to even |
//! | `psnr` | -10 log10 mean (t(x) - t(r))^2, t(v) = min(max(v, 0), 1)^(1/2.2); at most 200 dB |
//! | `smape` | mean abs(x - r) / (abs(x) + abs(r) + 0.01) |
//! | `energy` | mean x / mean r |
//! | `nonfinite` | values of x that are infinite or NaN |
//!
//! A NaN or infinity is never skipped: each mean over values that has one is itself NaN or infinite. Two fields can be
//! finite all the same, so look at `nonfinite` too: the tone curve of `psnr` clips infinities, and `relmse_trimmed`
//! counts NaN as worst of all, so that it may trim a few of them away.

/// Keeps relative errors of black pixels finite.
pub const RELATIVE_FLOOR: f64 = 1e-2;

/// The share of pixels that `relmse_trimmed` looks at.
const KEPT: f64 = 0.999;

/// Errors of an image; see the [module](self) for the formulas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// Mean squared error. 0 or more.
    pub mse: f64,
    /// Mean squared relative error. 0 or more.
    pub relmse: f64,
    /// `relmse` without the worst 0.1 % of the pixels.
    pub relmse_trimmed: f64,
    /// Peak signal to noise ratio after clipping and a gamma of 2.2, in dB; 200 for equal images.
    pub psnr: f64,
    /// Symmetric mean absolute percentage error, as a fraction: 0 to 1 for images without negative values.
    pub smape: f64,
    /// Energy of the image over that of the reference; 1 is right.
    pub energy: f64,
    /// Values of the image that are not finite.
    pub nonfinite: u64,
}

/// Image and reference cannot be compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "an image of {image} pixels cannot be compared with a reference of {reference}: both need the same, at least 1"
)]
pub struct SizeMismatch {
    /// Pixels of the image.
    pub image: usize,
    /// Pixels of the reference.
    pub reference: usize,
}

/// Compares an image with its reference, pixel by pixel. Takes 8 bytes a pixel of memory.
pub fn errors(image: &[[f32; 3]], reference: &[[f32; 3]]) -> Result<Errors, SizeMismatch> {
    if image.len() != reference.len() || image.is_empty() {
        return Err(SizeMismatch { image: image.len(), reference: reference.len() });
    }
    let (mut square, mut tone_square, mut relative_abs) = (0.0, 0.0, 0.0);
    let (mut energy, mut reference_energy) = (0.0, 0.0);
    let mut nonfinite = 0;
    let mut relative = Vec::with_capacity(image.len());
    for (x, r) in image.iter().zip(reference) {
        let mut pixel = 0.0;
        for (x, r) in x.iter().zip(r).map(|(&x, &r)| (f64::from(x), f64::from(r))) {
            let difference = x - r;
            square += difference * difference;
            pixel += difference * difference / (r * r + RELATIVE_FLOOR);
            tone_square += (tone(x) - tone(r)).powi(2);
            relative_abs += difference.abs() / (x.abs() + r.abs() + RELATIVE_FLOOR);
            energy += x;
            reference_energy += r;
            nonfinite += u64::from(!x.is_finite());
        }
        relative.push(pixel / 3.0);
    }
    let pixels = image.len() as f64;
    let values = 3.0 * pixels;
    let relmse = relative.iter().sum::<f64>() / pixels;
    let kept = ((pixels * KEPT).round_ties_even() as usize).max(1);
    // Errors are not negative, so abs changes no number; it gives every NaN the sign that sorts last.
    relative.sort_unstable_by(|a, b| a.abs().total_cmp(&b.abs()));
    let tone_mse = tone_square / values;
    Ok(Errors {
        mse: square / values,
        relmse,
        relmse_trimmed: relative[..kept].iter().sum::<f64>() / kept as f64,
        psnr: if tone_mse.is_nan() { f64::NAN } else { -10.0 * libm::log10(tone_mse.max(1e-20)) },
        smape: relative_abs / values,
        energy: energy / reference_energy,
        nonfinite,
    })
}

/// NaN stays NaN.
fn tone(value: f64) -> f64 {
    libm::pow(value.clamp(0.0, 1.0), 1.0 / 2.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small numbers that are the same in f32 anywhere: value i of an image of `pixels`.
    fn images(pixels: usize) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let value = |i: usize, c: usize, m: usize| ((i * 3 + c) * m % 1009) as f32 / 256.0;
        let image = (0..pixels).map(|i| [0, 1, 2].map(|c| value(i, c, 37) - 0.125)).collect();
        let reference = (0..pixels).map(|i| [0, 1, 2].map(|c| value(i, c, 53))).collect();
        (image, reference)
    }

    fn close(got: f64, expected: f64) {
        assert!((got - expected).abs() <= 1e-9 * expected.abs(), "{got:?} is not {expected:?}");
    }

    /// Figures of an independent implementation in NumPy, on the same images.
    #[test]
    fn same_figures_as_the_independent_implementation() {
        for (pixels, expected) in EXPECTED {
            let (image, reference) = images(pixels);
            let got = errors(&image, &reference).unwrap();
            let got = [got.mse, got.relmse, got.relmse_trimmed, got.psnr, got.smape, got.energy];
            got.into_iter().zip(expected).for_each(|(got, expected)| close(got, expected));
        }
    }

    #[test]
    fn equal_images() {
        let (image, _) = images(10);
        let e = errors(&image, &image).unwrap();
        assert_eq!((e.mse, e.relmse, e.relmse_trimmed, e.smape, e.energy, e.nonfinite), (0.0, 0.0, 0.0, 0.0, 1.0, 0));
        close(e.psnr, 200.0);
    }

    #[test]
    fn nothing_that_is_not_finite_is_hidden() {
        let (mut image, reference) = images(3000);
        image[7][1] = -f32::NAN;
        let e = errors(&image, &reference).unwrap();
        assert_eq!(e.nonfinite, 1);
        assert!([e.mse, e.relmse, e.psnr, e.smape, e.energy].iter().all(|v| v.is_nan()));
        assert!(e.relmse_trimmed.is_finite(), "one NaN of 3000 pixels is among the worst 0.1 %");
        image[7][1] = f32::INFINITY;
        let e = errors(&image, &reference).unwrap();
        assert_eq!((e.nonfinite, e.mse, e.relmse, e.energy), (1, f64::INFINITY, f64::INFINITY, f64::INFINITY));
        (image[8][0], image[9][0], image[10][0]) = (f32::NAN, f32::NAN, f32::NAN);
        let e = errors(&image, &reference).unwrap();
        assert_eq!(e.nonfinite, 4);
        assert!(e.relmse_trimmed.is_nan() || e.relmse_trimmed.is_infinite());
    }

    #[test]
    fn sizes_must_agree() {
        assert!(errors(&[], &[]).is_err());
        assert!(errors(&[[0.0; 3]], &[[0.0; 3]; 2]).is_err());
    }

    const EXPECTED: [(usize, [f64; 6]); 4] = [
        (
            1,
            [
                0.037760416666666664,
                0.8573365579792037,
                0.8573365579792037,
                12.82937355606249,
                0.7145360020590892,
                0.09433962264150944,
            ],
        ),
        (
            500,
            [
                2.573398122151693,
                14.900265009632824,
                14.900265009632825,
                10.584815917282276,
                0.40401769069876803,
                0.9383177644414284,
            ],
        ),
        (
            1500,
            [
                2.578086259629991,
                14.943249479432712,
                14.372265919737725,
                10.555762273950736,
                0.40340730330559116,
                0.9372106752132378,
            ],
        ),
        (
            4096,
            [
                2.581408982475599,
                14.843592839608654,
                14.416570277472212,
                10.53417762942999,
                0.40401770943273574,
                0.9359472527302195,
            ],
        ),
    ];
}
