//! One measurement: a method on the samples of an image.

use super::{
    machine::{cpu_seconds, peak_resident, reset_peak},
    scores::{Scores, number},
};
use crate::{
    filter::{
        Execution, Method, Report, SampleTile, Stopped, filter,
        plan::{Shape, plan},
    },
    picture::{PictureError, write_png},
};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::time::Instant;

/// Side of the part of an image that a report shows, in pixels, at most.
const SHOWN: usize = 64;

/// What was measured.
#[derive(Clone, Debug)]
pub struct Measurement {
    /// How far the image is from the reference.
    pub scores: Scores,
    /// Processor time of the filter, all threads, user and system, in seconds.
    pub cpu: f64,
    /// Time of the filter by the clock, in seconds.
    pub wall: f64,
    /// Bytes that the filter said it would need, samples included.
    pub planned: u64,
    /// What was left out and passed through.
    pub spared: Spared,
    /// Greatest resident size of the whole process while it filtered, in bytes, where the system tells.
    pub peak: Option<u64>,
    /// What it looks like, as PNGs in base64: the middle of the image, and its difference from the reference.
    pub pictures: Option<[String; 2]>,
}

/// What the filter did not do, as its report says.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Spared {
    /// Planes left out, and why.
    pub planes: Vec<(String, String)>,
    /// Bytes of these planes.
    pub bytes: u64,
    /// Share of the work that was left out, by estimate, 0 to 1; none if the method does not tell.
    pub work: Option<f64>,
    /// Share of pixels that were passed through, within the tolerance, 0 to 1.
    pub settled: f64,
    /// What that adds to relMSE at most, on average, by estimate.
    pub settled_error: f64,
}

impl Spared {
    fn of(report: &Report, pixels: u64) -> Self {
        let planes = report.left_out.iter().map(|l| (l.plane.clone(), l.reason.as_str().to_owned()));
        Self {
            planes: planes.collect(),
            bytes: report.left_out_bytes,
            work: report.work.map(|work| work.saved_share()),
            settled: report.settled as f64 / pixels as f64,
            settled_error: report.settled_error / pixels as f64,
        }
    }
}

/// A measurement that was not made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeasureError {
    /// Stopped before its end.
    #[error(transparent)]
    Stopped(#[from] Stopped),
    /// The reference is of another size.
    #[error(transparent)]
    Size(#[from] super::SizeMismatch),
    /// A picture could not be made.
    #[error(transparent)]
    Picture(#[from] PictureError),
}

/// Filters a tile, of which the core is compared with a reference of the same size.
pub fn measure(
    tile: &SampleTile,
    reference: &[[f32; 3]],
    method: &Method,
    execution: &Execution,
) -> Result<Measurement, MeasureError> {
    let core = tile.geometry().core();
    let shape = Shape {
        geometry: tile.geometry(),
        channels: tile.channels(),
        samples: tile.total() as u64,
        max_per_pixel: tile.max_per_pixel(),
        varying: tile.varying(),
    };
    let planned = plan(&shape, method).total(execution.pool.map_or(1, rayon::ThreadPool::current_num_threads));
    let can_reset = reset_peak();
    let (cpu, wall) = (cpu_seconds(), Instant::now());
    let filtered = filter(tile, method, execution)?;
    let (cpu, wall) = (cpu_seconds() - cpu, wall.elapsed().as_secs_f64());
    let peak = peak_resident().filter(|_| can_reset);
    let [r, g, b] = &filtered.rgb;
    let pixels: Vec<[f32; 3]> = r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect();
    let width = core.width as usize;
    let scores = Scores::new(&pixels, reference, width)?;
    let difference: Vec<_> =
        pixels.iter().zip(reference).map(|(x, r)| [0, 1, 2].map(|c| (x[c] - r[c]).abs())).collect();
    let pictures = Some([middle(&pixels, width)?, middle(&difference, width)?]);
    let spared = Spared::of(&filtered.report, core.area());
    Ok(Measurement { scores, cpu, wall, planned, spared, peak, pictures })
}

/// The middle of an image of linear RGB, at most 64 x 64 pixels, as a PNG in base64.
pub fn middle(pixels: &[[f32; 3]], width: usize) -> Result<String, PictureError> {
    let height = pixels.len() / width.max(1);
    let (across, down) = (width.min(SHOWN), height.min(SHOWN));
    let (left, top) = ((width - across) / 2, (height - down) / 2);
    let mut png = Vec::new();
    write_png(&mut png, across as u32, down as u32, |y, row| {
        let start = (top + y as usize) * width + left;
        row.copy_from_slice(&pixels[start..start + across]);
        Ok(())
    })?;
    Ok(base64(&png))
}

/// RFC 4648, section 4.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let bits = (0..3).fold(0, |bits, k| bits << 8 | usize::from(chunk.get(k).copied().unwrap_or(0)));
        for k in 0..4 {
            let digit = char::from(DIGITS[bits >> (18 - 6 * k) & 63]);
            text.push(if k <= chunk.len() { digit } else { '=' });
        }
    }
    text
}

impl Measurement {
    /// For the state file.
    pub fn to_json(&self) -> Value {
        json!({
            "scores": self.scores.to_json(), "cpu_seconds": number(self.cpu), "wall_seconds": number(self.wall),
            "planned_bytes": self.planned, "spared": self.spared, "peak_resident_bytes": self.peak, "pictures": self.pictures,
        })
    }

    /// Reads what [`Measurement::to_json`] has written.
    pub fn from_json(value: &Value) -> Option<Self> {
        let picture = |k: usize| Some(value["pictures"][k].as_str()?.to_owned());
        Some(Self {
            scores: Scores::from_json(&value["scores"])?,
            cpu: value["cpu_seconds"].as_f64()?,
            wall: value["wall_seconds"].as_f64()?,
            planned: value["planned_bytes"].as_u64()?,
            spared: Spared::deserialize(&value["spared"]).ok()?,
            peak: value["peak_resident_bytes"].as_u64(),
            pictures: picture(0).zip(picture(1)).map(|(a, b)| [a, b]),
        })
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn base64_is_that_of_rfc_4648() {
        let known =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("fooba", "Zm9vYmE=")];
        for (text, expected) in known {
            assert_eq!(super::base64(text.as_bytes()), expected);
        }
    }
}
