//! How far one small image is from another, relative to the size of the image around.

/// Pixels R, G, B, row by row.
pub(super) type Image = Vec<[f64; 3]>;

/// Deviations of an image, as shares of the local size of the one it is compared with: the greatest absolute value of
/// the channel in the 3 x 3 pixels around, but never less than a thousandth of the channel's median.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Deviation {
    /// Of the pixels' values.
    pub median: f64,
    /// Root of the mean square.
    pub rms: f64,
    /// Of any value.
    pub greatest: f64,
}

impl Deviation {
    /// Of `image` from `from`, both of `width` pixels a row. NaN counts as infinitely far.
    pub(super) fn of(image: &Image, from: &Image, width: usize) -> Self {
        let mut deviations = Vec::with_capacity(3 * from.len());
        for channel in 0..3 {
            let values: Vec<f64> = from.iter().map(|pixel| pixel[channel].abs()).collect();
            let floor = (1e-3 * median(values.clone())).max(f64::MIN_POSITIVE);
            for (at, (got, expected)) in image.iter().zip(from).enumerate() {
                let difference = (got[channel] - expected[channel]).abs();
                // Equal is equal, however small or black.
                let deviation = if difference == 0.0 { 0.0 } else { difference / local(&values, width, at).max(floor) };
                deviations.push(if deviation.is_nan() { f64::INFINITY } else { deviation });
            }
        }
        let squares: f64 = deviations.iter().map(|d| d * d).sum();
        Self {
            rms: (squares / deviations.len() as f64).sqrt(),
            greatest: deviations.iter().copied().fold(0.0, f64::max),
            median: median(deviations),
        }
    }
}

/// Greatest value of the 3 x 3 around.
fn local(values: &[f64], width: usize, at: usize) -> f64 {
    let (x, y, height) = (at % width, at / width, values.len() / width);
    let rows = y.saturating_sub(1)..(y + 2).min(height);
    let around = rows.flat_map(|y| (x.saturating_sub(1)..(x + 2).min(width)).map(move |x| y * width + x));
    around.map(|at| values[at]).fold(0.0, f64::max)
}

pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_to_what_is_around() {
        let image = |at: usize, value: f64| {
            let mut image = vec![[1.0; 3]; 12];
            image[at] = [value; 3];
            image
        };
        // Beside a 10 an error of 0.5 is a twentieth; far from it, a half.
        let near = Deviation::of(
            &{
                let mut i = image(5, 10.0);
                i[4][0] = 1.5;
                i
            },
            &image(5, 10.0),
            4,
        );
        let far = Deviation::of(
            &{
                let mut i = image(0, 10.0);
                i[11][0] = 1.5;
                i
            },
            &image(0, 10.0),
            4,
        );
        assert_eq!((near.greatest, far.greatest, far.median), (0.05, 0.5, 0.0));
        assert_eq!(Deviation::of(&image(3, f64::NAN), &image(3, 1.0), 4).greatest, f64::INFINITY);
        assert_eq!(Deviation::of(&vec![[0.0; 3]; 4], &vec![[0.0; 3]; 4], 2).greatest, 0.0);
    }
}
