//! Cuts tiles of any geometry from stored rectangles of pixels.

use std::{io, ops::Range};

use super::SpoolError;
use crate::filter::{
    ChannelSet, Counts, Plane, Rect, SampleTile, TileGeometry,
    samples::{SampleError, sample_total},
};

/// The samples of a stored rectangle. Pixels are counted by its rows.
pub(super) trait Part {
    /// Samples of each pixel, if all have as many.
    fn uniform(&self) -> Option<u32>;

    /// Samples of the pixels from this one on, where they vary.
    fn counts(&self, pixel: u64, into: &mut [u16]) -> io::Result<()>;

    /// The samples ahead of those of a row, where they vary.
    fn row_start(&self, row: u32) -> io::Result<u64>;

    /// The value of a plane that has only one.
    fn constant(&self, plane: usize) -> Option<f32>;

    /// The values of a plane from this sample on.
    fn values(&self, plane: usize, sample: u64, into: &mut [f32]) -> io::Result<()>;
}

/// A stored rectangle, and the part of it that is meant.
pub(super) struct Piece<P> {
    pub(super) stored: Rect,
    pub(super) used: Rect,
    pub(super) part: P,
}

/// A tile of this geometry from pieces, the used parts of which do not overlap; pixels of none of them are pixels without
/// samples. Memory: the tile, 4 bytes a pixel, and a row of samples.
pub(super) fn cut<P: Part>(
    geometry: TileGeometry,
    channels: &ChannelSet,
    pieces: &[Piece<P>],
) -> Result<SampleTile, SpoolError> {
    let window = geometry.window();
    let layout = Layout::new(&window, pieces)?;
    let planes = (0..channels.planes()).map(|plane| cut_plane(&window, pieces, &layout, plane));
    let planes = planes.collect::<io::Result<Vec<_>>>()?;
    Ok(SampleTile::new(geometry, channels.clone(), layout.counts, planes)?)
}

fn cut_plane<P: Part>(window: &Rect, pieces: &[Piece<P>], layout: &Layout, plane: usize) -> io::Result<Plane> {
    if let Some(value) = pieces.first().and_then(|piece| piece.part.constant(plane)) {
        let same = |other: f32| other == value || (other.is_nan() && value.is_nan());
        if pieces.iter().all(|piece| piece.part.constant(plane).is_some_and(same)) {
            return Ok(Plane::Constant(value));
        }
    }
    let mut values = vec![0.0; layout.total];
    let mut counts = Vec::new();
    for Piece { stored, used, part } in pieces {
        let Some(here) = used.intersection(window) else { continue };
        for y in here.y..here.bottom() {
            let into = layout.range(window, here.x, here.right(), y);
            let into = &mut values[into];
            if let Some(value) = part.constant(plane) {
                into.fill(value);
                continue;
            }
            let from = match part.uniform() {
                Some(n) => stored.index(here.x, y) as u64 * u64::from(n),
                None => {
                    counts.resize((here.x - stored.x) as usize, 0);
                    part.counts(stored.index(stored.x, y) as u64, &mut counts)?;
                    part.row_start(y - stored.y)? + sum(&counts) as u64
                }
            };
            part.values(plane, from, into)?;
        }
    }
    Ok(Plane::Values(values))
}

/// Where the samples of a data window go.
struct Layout {
    counts: Counts,
    /// With varying samples the position at which each row of the window starts, and their end.
    rows: Vec<usize>,
    total: usize,
}

impl Layout {
    fn new<P: Part>(window: &Rect, pieces: &[Piece<P>]) -> Result<Self, SpoolError> {
        let first = pieces.first().and_then(|piece| piece.part.uniform());
        let counts = match first {
            Some(n) if pieces.iter().all(|piece| piece.part.uniform() == first) && covered(window, pieces) => {
                Counts::Uniform(n)
            }
            _ => {
                let mut counts = vec![0; window.area() as usize];
                for Piece { stored, used, part } in pieces {
                    let Some(here) = used.intersection(window) else { continue };
                    for y in here.y..here.bottom() {
                        let at = window.index(here.x, y);
                        let row = &mut counts[at..at + here.width as usize];
                        match part.uniform() {
                            Some(n) => row.fill(n as u16),
                            None => part.counts(stored.index(here.x, y) as u64, row)?,
                        }
                    }
                }
                Counts::Varying(counts)
            }
        };
        let total = sample_total(window.area(), &counts)?;
        let total = usize::try_from(total).map_err(|_| SampleError::TooMany(total))?;
        let mut rows = Vec::with_capacity(window.height as usize + 1);
        if let Counts::Varying(counts) = &counts {
            let mut at = 0;
            rows.push(0);
            rows.extend(counts.chunks(window.width as usize).map(|row| {
                at += sum(row);
                at
            }));
        }
        Ok(Self { counts, rows, total })
    }

    /// The samples of the pixels `left..right` of a row.
    fn range(&self, window: &Rect, left: u32, right: u32, y: u32) -> Range<usize> {
        let first = window.index(left, y);
        let pixels = first..first + (right - left) as usize;
        match &self.counts {
            Counts::Uniform(n) => pixels.start * *n as usize..pixels.end * *n as usize,
            Counts::Varying(counts) => {
                let start = self.rows[(y - window.y) as usize] + sum(&counts[window.index(window.x, y)..pixels.start]);
                start..start + sum(&counts[pixels])
            }
        }
    }
}

/// Whether these pieces cover all of a window.
fn covered<P>(window: &Rect, pieces: &[Piece<P>]) -> bool {
    let areas = pieces.iter().filter_map(|piece| piece.used.intersection(window));
    areas.map(|part| part.area()).sum::<u64>() == window.area()
}

fn sum(counts: &[u16]) -> usize {
    counts.iter().map(|&n| usize::from(n)).sum()
}
