//! Looks through a whole file of tiles without keeping any of its planes.

use std::path::PathBuf;

use super::{
    Event, Format, Header,
    file::{FileError, TileFile},
    value::{CountReader, ValueReader},
};
use crate::filter::{Coverage, Rect, TileGeometry};

/// What is in a file of tiles.
#[derive(Clone, Debug)]
pub struct Summary {
    /// The first tile's header; the others are compared with it.
    pub first: Header,
    /// Every tile, in the order of the file.
    pub tiles: Vec<TileSummary>,
    /// Every plane, over all tiles.
    pub planes: Vec<PlaneSummary>,
    /// Samples in all cores.
    pub samples: u64,
    /// Most samples in any pixel.
    pub max_per_pixel: u32,
    /// Whether pixels have different numbers of samples, or might: some tile says `varying`, or two tiles differ.
    pub varying: bool,
    /// Whether any tile has a halo.
    pub halos: bool,
    /// Parts of the image that no core covers.
    pub missing: Vec<Rect>,
    /// Two cores that overlap, if any do.
    pub overlap: Option<[Rect; 2]>,
    /// The first tile whose image or channels differ from the first tile's, and how.
    pub disagreement: Option<(Rect, &'static str)>,
    /// Bytes of backing that a [`Spool`](crate::store::Spool) of this file takes.
    pub spool_bytes: u64,
    /// Whether the file is compressed.
    pub compressed: bool,
    /// Bytes that the decompressor keeps while the file is read; 0 where it is not compressed.
    pub window_bytes: u64,
}

impl Summary {
    /// Whether the cores are exactly the image: each pixel once, and all tiles agree on what the image is.
    pub const fn whole(&self) -> bool {
        self.missing.is_empty() && self.overlap.is_none() && self.disagreement.is_none()
    }
}

/// One tile of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileSummary {
    /// Where it lies.
    pub geometry: TileGeometry,
    /// Samples in the data window.
    pub samples: u64,
    /// Samples in the core.
    pub core_samples: u64,
    /// Most samples in any pixel of the data window.
    pub max_per_pixel: u32,
    /// Whether its header says `varying`.
    pub varying: bool,
}

/// One plane over all tiles of a file; what lies in halos counts each time.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaneSummary {
    /// Its name ([`ChannelSet::plane_name`](crate::filter::ChannelSet::plane_name)).
    pub name: String,
    /// Its format in the first tile.
    pub format: Format,
    /// Least finite value; above `max` if there is none.
    pub min: f32,
    /// Greatest finite value.
    pub max: f32,
    /// Sum of the finite values.
    pub sum: f64,
    /// How many values are finite.
    pub finite: u64,
    /// Values that are NaN; in a feature a sample without it.
    pub nan: u64,
    /// Values that are infinite.
    pub infinite: u64,
    /// Tiles in which it is one constant.
    pub constant_tiles: u64,
    /// Of all values in their order: planes with the same values have the same, others hardly ever.
    pub digest: u64,
}

/// An odd number with its bits well mixed: what a [`PlaneSummary::digest`] is multiplied by with each value.
const DIGEST: u64 = 0x9E37_79B9_7F4A_7C15;

impl PlaneSummary {
    /// Mean of the finite values, if there are any.
    pub fn mean(&self) -> Option<f64> {
        (self.finite > 0).then(|| self.sum / self.finite as f64)
    }

    fn add(&mut self, value: f32, times: u64) {
        // digest x K^n + value x (1 + K + ... + K^(n-1)), with K^n and the sum by doubling n. 0 and -0 are the same.
        let bits = u64::from((value + 0.0).to_bits()) + 1;
        let (mut left, mut power, mut sum) = (times, DIGEST, 1_u64);
        while left > 0 {
            if left & 1 == 1 {
                self.digest = self.digest.wrapping_mul(power).wrapping_add(bits.wrapping_mul(sum));
            }
            (power, sum, left) = (power.wrapping_mul(power), sum.wrapping_mul(power.wrapping_add(1)), left >> 1);
        }
        if value.is_finite() {
            self.min = self.min.min(value);
            self.max = self.max.max(value);
            self.sum += f64::from(value) * times as f64;
            self.finite += times;
        } else if value.is_nan() {
            self.nan += times;
        } else {
            self.infinite += times;
        }
    }
}

/// Reads a file from start to end and says what is in it. Memory: a few hundred bytes a tile.
pub fn scan(path: impl Into<PathBuf>) -> Result<Summary, FileError> {
    scan_file(&mut TileFile::open(path)?)
}

/// The same of a file that is open and at its start.
pub fn scan_file(file: &mut TileFile) -> Result<Summary, FileError> {
    let (compressed, window_bytes) = (file.compressed(), file.window_bytes());
    let mut cores = Coverage::default();
    let mut summary: Option<Summary> = None;
    let mut values = ValueReader::new(Format::F32);
    let mut counts = CountReader::default();
    let (mut pixel, mut agrees, mut reading, mut formats) = (0_u64, true, None, Vec::new());
    while let Some(event) = file.next_event()? {
        let header = match event {
            Event::Header(header) => header,
            event => {
                let Some(summary) = &mut summary else { continue };
                let Some(tile) = summary.tiles.last_mut() else { continue };
                match event {
                    Event::Counts(bytes) => counts.push(bytes, |count| {
                        tile.max_per_pixel = tile.max_per_pixel.max(u32::from(count));
                        let window = tile.geometry.window();
                        let (x, y) = (pixel % u64::from(window.width), pixel / u64::from(window.width));
                        if tile.geometry.core().contains(window.x + x as u32, window.y + y as u32) {
                            tile.core_samples += u64::from(count);
                        }
                        pixel += 1;
                    }),
                    Event::Constant { plane, value } if agrees => {
                        summary.planes[plane].add(value, tile.samples);
                        summary.planes[plane].constant_tiles += 1;
                    }
                    Event::Values { plane, bytes } if agrees => {
                        if reading != Some(plane) {
                            values = ValueReader::new(formats[plane]);
                            reading = Some(plane);
                        }
                        let plane = &mut summary.planes[plane];
                        values.push(bytes, |piece| piece.iter().for_each(|&value| plane.add(value, 1)));
                    }
                    Event::PlaneEnd { plane } => {
                        summary.spool_bytes += tile.core_samples * Format::bytes(formats[plane]);
                        reading = None;
                    }
                    Event::TileEnd => {
                        summary.samples += tile.core_samples;
                        summary.max_per_pixel = summary.max_per_pixel.max(tile.max_per_pixel);
                        summary.varying |= tile.varying;
                    }
                    _ => {}
                }
                continue;
            }
        };
        let geometry = *header.geometry();
        let core = geometry.core();
        let uniform = !header.varying();
        let per_pixel = if uniform { header.max_per_pixel() } else { 0 };
        let tile = TileSummary {
            geometry,
            samples: header.total(),
            core_samples: core.area() * u64::from(per_pixel),
            max_per_pixel: per_pixel,
            varying: header.varying(),
        };
        pixel = 0;
        formats = (0..header.channels().planes()).map(|plane| header.plane_format(plane)).collect();
        let summary =
            summary.get_or_insert_with(|| Summary { window_bytes, ..Summary::new(header.clone(), compressed) });
        summary.varying |= uniform && !summary.first.varying() && per_pixel != summary.first.max_per_pixel();
        summary.halos |= geometry.core() != geometry.window();
        if header.varying() {
            summary.spool_bytes += 2 * core.area();
        }
        agrees = header.channels() == summary.first.channels();
        if summary.disagreement.is_none() {
            if geometry.image() != summary.first.geometry().image() {
                summary.disagreement = Some((core, "the size of the image"));
            } else if !agrees {
                summary.disagreement = Some((core, "the channels"));
            }
        }
        if let Err(other) = cores.insert(core, ()) {
            summary.overlap.get_or_insert([other, core]);
        }
        summary.tiles.push(tile);
    }
    // A stream without a tile is an error of the decoder, so there is a summary.
    let mut summary = summary.ok_or_else(|| file.empty())?;
    summary.missing = cores.missing(&summary.first.geometry().image());
    Ok(summary)
}

impl Summary {
    fn new(first: Header, compressed: bool) -> Self {
        let plane = |plane: usize| PlaneSummary {
            name: first.channels().plane_name(plane),
            format: first.plane_format(plane),
            min: f32::INFINITY,
            max: f32::NEG_INFINITY,
            sum: 0.0,
            finite: 0,
            nan: 0,
            infinite: 0,
            constant_tiles: 0,
            digest: 0,
        };
        Self {
            planes: (0..first.channels().planes()).map(plane).collect(),
            first,
            tiles: Vec::new(),
            samples: 0,
            max_per_pixel: 0,
            varying: false,
            halos: false,
            missing: Vec::new(),
            overlap: None,
            disagreement: None,
            spool_bytes: 0,
            compressed,
            window_bytes: 0,
        }
    }
}
