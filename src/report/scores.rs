//! All numbers that say how far an image is from its reference, by name.

use super::{SizeMismatch, display::srgb, errors, flip::flip, ssim::ssim};
use serde_json::{Map, Value};

/// A column of errors.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// Name in CSV, JSON and state files.
    pub name: &'static str,
    /// Name to read, with the unit where it has one.
    pub title: &'static str,
    /// What it is.
    pub formula: &'static str,
}

/// The columns, in order. x is the image, r the reference, both linear RGB; means are over pixels and channels.
pub const COLUMNS: [Column; 9] = [
    Column { name: "mse", title: "MSE", formula: "mean (x - r)²" },
    Column { name: "relmse", title: "relMSE", formula: "mean (x - r)² / (r² + ε), ε = 0.01" },
    Column {
        name: "relmse_trimmed",
        title: "relMSE, worst 0.1 % of the pixels off",
        formula: "relMSE over the pixels but the 0.1 % with the greatest relMSE of their own",
    },
    Column {
        name: "psnr",
        title: "PSNR [dB]",
        formula: "-10 log10 mean (t(x) - t(r))², t(v) = min(max(v, 0), 1)^(1/2.2); at most 200",
    },
    Column { name: "smape", title: "SMAPE", formula: "mean |x - r| / (|x| + |r| + 0.01), a fraction" },
    Column {
        name: "ssim",
        title: "SSIM",
        formula: "mean structural similarity (Wang et al. 2004) of Y = 0.2126 R + 0.7152 G + 0.0722 B of the images clipped to \
                  0..1 and sRGB-encoded; windows of 11 x 11 pixels inside the image, Gaussian of standard deviation 1.5, \
                  K1 = 0.01, K2 = 0.03; 1 is equal",
    },
    Column {
        name: "flip",
        title: "FLIP",
        formula: "mean LDR-FLIP (Andersson et al. 2020) of the images clipped to 0..1 and sRGB-encoded, 67.02 pixels per \
                  degree; 0 is equal, 1 the greatest",
    },
    Column { name: "energy", title: "energy ratio", formula: "mean x / mean r; 1 is right" },
    Column { name: "nonfinite", title: "non-finite values", formula: "values of x that are infinite or NaN" },
];

/// One image's numbers, in the order of [`COLUMNS`].
#[derive(Clone, Copy, Debug)]
pub struct Scores(pub [f64; COLUMNS.len()]);

impl Scores {
    /// Compares an image with its reference; `width` in pixels.
    pub fn new(image: &[[f32; 3]], reference: &[[f32; 3]], width: usize) -> Result<Self, SizeMismatch> {
        let e = errors(image, reference)?;
        let (x, r) = (srgb(image), srgb(reference));
        let (ssim, flip) = (ssim(&x, &r, width), flip(&x, &r, width));
        Ok(Self([e.mse, e.relmse, e.relmse_trimmed, e.psnr, e.smape, ssim, flip, e.energy, e.nonfinite as f64]))
    }

    /// The number of this column; NaN if there is no such column.
    pub fn get(&self, name: &str) -> f64 {
        COLUMNS.iter().zip(self.0).find(|(column, _)| column.name == name).map_or(f64::NAN, |(_, value)| value)
    }

    /// As an object of numbers, or of words for what JSON has no numbers for.
    pub fn to_json(&self) -> Value {
        let fields = COLUMNS.iter().zip(self.0).map(|(column, value)| (column.name.to_owned(), number(value)));
        fields.collect::<Map<_, _>>().into()
    }

    /// Reads what [`Scores::to_json`] has written.
    pub fn from_json(value: &Value) -> Option<Self> {
        let mut scores = [0.0; COLUMNS.len()];
        for (score, column) in scores.iter_mut().zip(&COLUMNS) {
            *score = read_number(value.get(column.name)?)?;
        }
        Some(Self(scores))
    }
}

/// A number, or `"NaN"`, `"inf"` or `"-inf"`.
pub fn number(value: f64) -> Value {
    if value.is_finite() { value.into() } else { value.to_string().into() }
}

fn read_number(value: &Value) -> Option<f64> {
    value.as_f64().or_else(|| value.as_str()?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_keeps_every_bit() {
        let mut scores = [0.1, 1.0 / 3.0, f64::MIN_POSITIVE, 1e300, -0.7, 2.0, 3.0, f64::INFINITY, f64::NAN];
        for _ in 0..100 {
            let text = Scores(scores).to_json().to_string();
            let back = Scores::from_json(&serde_json::from_str(&text).unwrap()).unwrap();
            assert_eq!(back.0.map(f64::to_bits)[..8], scores.map(f64::to_bits)[..8]);
            assert!(back.get("nonfinite").is_nan());
            scores[..7].iter_mut().for_each(|v| *v *= 1.000_000_007);
        }
    }
}
