//! The file of tiles that a command reads: looked through first, then read again or spooled.

use super::{
    failure::{Failure, list},
    progress,
};
use crate::{
    filter::{Coverage, Rect, TileGeometry, plan::Shape},
    store::spool::Spool,
    wire::{
        file::TileFile,
        scan::{Summary, TileSummary, scan},
    },
};
use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

/// A file of tiles and what is in it.
pub(crate) struct Input {
    pub(crate) path: PathBuf,
    pub(crate) summary: Summary,
    /// The tiles by where they are; of tiles that overlap the first.
    tiles: Coverage<TileSummary>,
    /// What no tile covers.
    gaps: Coverage<()>,
}

impl Input {
    /// Looks through a file.
    pub(crate) fn scan(path: &Path) -> Result<Self, Failure> {
        if std::fs::metadata(path).is_ok_and(|found| !found.is_file()) {
            let why = "it must be a regular file, since it is read twice: save the stream first";
            return Err(Failure::input("not_a_file", format!("{}: {why}", path.display())));
        }
        let spinner = progress::spinner(format!("reading {}", path.display()));
        let summary = scan(path)?;
        spinner.finish_and_clear();
        let (mut tiles, mut gaps) = (Coverage::default(), Coverage::default());
        for tile in &summary.tiles {
            // What overlaps is in the summary.
            let _ = tiles.insert(tile.geometry.core(), *tile);
        }
        for gap in &summary.missing {
            let _ = gaps.insert(*gap, ());
        }
        Ok(Self { path: path.to_owned(), summary, tiles, gaps })
    }

    /// What keeps the tiles from being an image: a stable code and a message for each fault.
    pub(crate) fn faults(&self) -> Vec<(&'static str, String)> {
        let Summary { overlap, disagreement, missing, .. } = &self.summary;
        let mut faults = Vec::new();
        if let Some((tile, what)) = disagreement {
            faults.push(("disagreement", format!("tile {tile} differs from the first tile in {what}")));
        }
        if let Some([first, second]) = overlap {
            faults.push(("overlap", format!("tile {second} overlaps tile {first}")));
        }
        // Of another image nothing can be said to be missing.
        if !missing.is_empty() && disagreement.is_none() {
            let pixels: u64 = missing.iter().map(Rect::area).sum();
            faults.push(("missing", format!("{pixels} pixels are missing: {}", list(missing))));
        }
        faults
    }

    /// Refuses tiles that are no image; with `partial` some may be missing.
    pub(crate) fn check(&self, partial: Option<bool>) -> Result<(), Failure> {
        let faults = self.faults();
        let Some((code, message)) = faults.iter().find(|(code, _)| *code != "missing" || partial != Some(true)) else {
            return Ok(());
        };
        let hint = if *code == "missing" && partial.is_some() { "; --partial leaves them black" } else { "" };
        Err(Failure::input(*code, format!("{}: {message}{hint}", self.path.display())))
    }

    /// Width and height of the image.
    pub(crate) fn image(&self) -> [u32; 2] {
        let image = self.summary.first.geometry().image();
        [image.width, image.height]
    }

    /// Whether pixels may have different numbers of samples; missing ones have none.
    pub(crate) fn varying(&self) -> bool {
        self.summary.varying || !self.summary.missing.is_empty()
    }

    /// The parts of a core that are there.
    pub(crate) fn present(&self, core: &Rect) -> Vec<Rect> {
        self.gaps.missing(core)
    }

    /// The shape of a tile that is cut from the cores; the samples are an upper bound.
    pub(crate) fn shape<'a>(&'a self, geometry: &'a TileGeometry) -> Shape<'a> {
        let window = geometry.window();
        let samples = self.tiles.meeting(&window).into_iter().map(|(core, tile)| {
            let here = core.intersection(&window).map_or(0, |part| part.area());
            tile.core_samples.min(here * u64::from(tile.max_per_pixel))
        });
        Shape {
            geometry,
            channels: self.summary.first.channels(),
            samples: samples.sum(),
            max_per_pixel: self.summary.max_per_pixel,
            varying: self.varying(),
        }
    }

    /// The shape of a tile as it is in the file.
    pub(crate) fn shape_of<'a>(&'a self, tile: &'a TileSummary) -> Shape<'a> {
        Shape {
            geometry: &tile.geometry,
            channels: self.summary.first.channels(),
            samples: tile.samples,
            max_per_pixel: tile.max_per_pixel,
            varying: tile.varying,
        }
    }

    /// Opens the file again.
    pub(crate) fn open(&self) -> Result<TileFile, Failure> {
        Ok(TileFile::open(&self.path)?)
    }

    /// Puts all cores into a spool.
    pub(crate) fn fill(&self, spool: &mut Spool, stop: &AtomicBool) -> Result<(), Failure> {
        let mut file = self.open()?;
        let bar = progress::bar("spooling ", self.summary.spool_bytes);
        while let Some(event) = file.next_event()? {
            spool.push(&event)?;
            if matches!(event, crate::wire::Event::TileEnd) {
                bar.set_position(spool.bytes());
                if stop.load(Ordering::Relaxed) {
                    return Err(crate::filter::Stopped.into());
                }
            }
        }
        bar.finish_and_clear();
        Ok(())
    }
}
