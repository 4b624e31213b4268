//! The messages of a result stream, and how they are written.

use std::{
    collections::BTreeMap,
    io::{self, Write},
};

use serde::{Deserialize, Serialize};

use super::{Format, Problem, VERSION, encoder::write_values};
use crate::filter::{Filtered, Halo, Method, Rect, Report, Work, samples::Replaced};

/// Most bytes that the map of a result stream's message may have.
pub const MAX_MESSAGE: usize = 1 << 20;

/// A message of a result stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Message {
    /// A filtered tile.
    Result(Box<TileResult>),
    /// Takes a result's place.
    Error {
        /// Core of the tile, where it is known.
        tile: Option<Rect>,
        /// What is wrong.
        problem: Box<Problem>,
    },
    /// Ends the stream.
    End {
        /// Tiles that were filtered.
        tiles: u64,
        /// Tiles that were not.
        errors: u64,
    },
}

/// A filtered tile, as it comes over the wire.
#[derive(Clone, Debug, PartialEq)]
pub struct TileResult {
    /// Width and height of the image.
    pub image: [u32; 2],
    /// The core.
    pub core: Rect,
    /// What happened.
    pub report: TileReport,
    /// Planes R, G, B: linear radiance, one value per pixel of the core, row-major.
    pub rgb: [Vec<f32>; 3],
}

/// The `report` of a result: what was done and what happened. Counts are of the core, so that tiles add up, except
/// `replaced`, which is of the data window. A reader takes what is not there for zero or empty.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TileReport {
    /// The preset.
    pub preset: String,
    /// Every parameter of the method, by its name, in words.
    pub parameters: BTreeMap<String, String>,
    /// Keys every random draw.
    pub seed: u64,
    /// Time that filtering took, in seconds.
    pub seconds: f64,
    /// Samples in the core.
    pub samples: u64,
    /// Values made finite.
    pub replaced: ReplacedCounts,
    /// Colour values that the spike step set to their pixel's mean.
    pub spikes: u64,
    /// Sum of the core's pixel values over channels, before.
    pub energy_in: f64,
    /// The same sum after.
    pub energy_out: f64,
    /// Energy out over energy in; nil for a core that was black.
    pub energy_ratio: Option<f64>,
    /// Pixels without samples that got their neighbours' mean.
    pub filled: u64,
    /// Pixels without samples that stayed black.
    pub unfilled: u64,
    /// Pixels that were passed through, within the tolerance.
    pub settled: u64,
    /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
    pub settled_error: f64,
    /// The halo that the tile had: left, top, right, bottom, in pixels.
    pub halo: [u32; 4],
    /// The halo that it would need for the same bits as in the whole image.
    pub halo_needed: [u32; 4],
    /// Whether the halo was enough.
    pub exact: bool,
    /// Planes that the method did not look at, and why.
    pub left_out: Vec<LeftOutPlane>,
    /// Bytes of these planes over the data window.
    pub left_out_bytes: u64,
    /// How much work was done and left out, by estimate; nil if the method does not say.
    pub work: Option<WorkCounts>,
}

/// An estimate of work, in steps: [`Work`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct WorkCounts {
    /// Steps done.
    pub done: u64,
    /// Steps left out with whole planes.
    pub planes: u64,
    /// Steps left out for columns that are constant over a neighbourhood.
    pub columns: u64,
    /// Steps left out for differences that weigh nothing.
    pub distances: u64,
    /// The share that was left out, 0 to 1.
    pub saved: f64,
}

impl From<Work> for WorkCounts {
    fn from(work: Work) -> Self {
        let Work { done, planes, columns, distances } = work;
        Self { done, planes, columns, distances, saved: work.saved_share() }
    }
}

/// Values that were not finite and were replaced, by role.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReplacedCounts {
    /// Of colours.
    pub color: u64,
    /// Of features, infinities only.
    pub feature: u64,
    /// Of random parameters.
    pub random: u64,
    /// Of film positions.
    pub film: u64,
}

/// A plane that was left out, which changes nothing in the result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOutPlane {
    /// The plane: its channel's name, with the component's number where there are several (`P.1`).
    pub plane: String,
    /// `constant`, `missing`, `unused` or `equal`.
    pub reason: String,
}

impl TileReport {
    /// What the core reports, with how and how long it was filtered.
    pub fn new(report: &Report, method: &Method, seed: u64, seconds: f64) -> Self {
        let sides = |halo: Halo| [halo.left, halo.top, halo.right, halo.bottom];
        let Replaced { color, feature, random, film } = report.replaced;
        let left_out = report.left_out.iter();
        let ratio = report.energy_out / report.energy_in;
        Self {
            preset: method.preset_name().to_owned(),
            parameters: method.parameters().into_iter().map(|(name, value)| (name.to_owned(), value)).collect(),
            seed,
            seconds,
            samples: report.samples,
            replaced: ReplacedCounts { color, feature, random, film },
            spikes: report.spikes,
            energy_in: report.energy_in,
            energy_out: report.energy_out,
            energy_ratio: ratio.is_finite().then_some(ratio),
            filled: report.filled,
            unfilled: report.unfilled,
            settled: report.settled,
            settled_error: report.settled_error,
            halo: sides(report.halo),
            halo_needed: sides(report.halo_needed),
            exact: report.exact(),
            left_out: left_out
                .map(|l| LeftOutPlane { plane: l.plane.clone(), reason: l.reason.as_str().to_owned() })
                .collect(),
            left_out_bytes: report.left_out_bytes,
            work: report.work.map(WorkCounts::from),
        }
    }
}

#[derive(Serialize)]
struct Map<'a> {
    r#type: &'static str,
    version: u32,
    #[serde(flatten)]
    body: Body<'a>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Body<'a> {
    Result { image: [u32; 2], tile: [u32; 4], report: &'a TileReport },
    Error { tile: Option<[u32; 4]>, problem: &'a Problem },
    End { tiles: u64, errors: u64 },
}

/// Writes a `result` message: its map and three planes.
pub fn encode_result(
    image: [u32; 2],
    filtered: &Filtered,
    report: &TileReport,
    out: &mut impl Write,
) -> io::Result<()> {
    let tile = corners(filtered.core);
    write_map(out, "result", Body::Result { image, tile, report })?;
    filtered.rgb.iter().try_for_each(|plane| write_values(out, Format::F32, plane))
}

/// Writes an `error` message.
pub fn encode_error(tile: Option<Rect>, problem: &Problem, out: &mut impl Write) -> io::Result<()> {
    write_map(out, "error", Body::Error { tile: tile.map(corners), problem })
}

/// Writes the `end` message.
pub fn encode_end(tiles: u64, errors: u64, out: &mut impl Write) -> io::Result<()> {
    write_map(out, "end", Body::End { tiles, errors })
}

fn write_map(out: &mut impl Write, kind: &'static str, body: Body) -> io::Result<()> {
    let map = Map { r#type: kind, version: VERSION, body };
    rmp_serde::encode::write_named(out, &map).map_err(|error| match error {
        rmp_serde::encode::Error::InvalidValueWrite(
            rmp::encode::ValueWriteError::InvalidMarkerWrite(error)
            | rmp::encode::ValueWriteError::InvalidDataWrite(error),
        ) => error,
        other => io::Error::other(other),
    })
}

const fn corners(rect: Rect) -> [u32; 4] {
    [rect.x, rect.y, rect.width, rect.height]
}
