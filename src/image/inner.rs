//! What is known of an image in memory.

use super::{After, ImageError, Inner, MAX_TILES, RESULT, Regions, neighbors::Neighbors};
use crate::{
    disk::Folder,
    filter::{Rect, samples::Replaced},
    stitch::{Digest, Offer, Stitcher},
    store::Change,
};

impl Inner {
    pub(super) fn queue(&mut self, changes: impl IntoIterator<Item = Change>, after: impl IntoIterator<Item = After>) {
        self.changes.extend(changes);
        self.after.extend(after);
        self.queued += 1;
    }

    pub(super) fn offer(&mut self, core: Rect, digest: Digest, replace: bool) -> Result<Offer, ImageError> {
        if self.finished && self.neighbors.is_none() {
            return match self.stitcher.peek(&core) {
                Some(known) if known == digest => Ok(Offer::Repeated),
                _ => Err(ImageError::Finished),
            };
        }
        if self.stitcher.known() >= MAX_TILES {
            return Err(ImageError::TooManyTiles);
        }
        Ok(self.stitcher.offer(core, digest, replace)?)
    }

    pub(super) fn committed(&mut self, after: After) {
        let Some(neighbors) = &mut self.neighbors else { return };
        match after {
            After::Arrived(core) => neighbors.arrived(&core),
            After::Lent(part) => neighbors.lent(&part),
            After::Filtered(region, last) => neighbors.filtered(region, last),
            After::Finished => neighbors.finish(),
        }
    }

    pub(super) fn forget_result(&mut self, folder: &dyn Folder) {
        if self.result.take().is_some() {
            let _ = folder.remove(RESULT);
        }
    }

    /// The pixels, and what is known of them.
    pub const fn stitcher(&self) -> &Stitcher {
        &self.stitcher
    }

    /// Time that filtering a stored tile took.
    pub fn seconds(&self, core: &Rect) -> f64 {
        self.notes.get(core).map_or(0.0, |note| note.seconds)
    }

    /// Whether it takes no more tiles.
    pub const fn finished(&self) -> bool {
        self.finished
    }

    /// Whether every pixel is filtered for good.
    pub fn complete(&self) -> bool {
        self.stitcher.is_complete() && self.open_regions() == 0
    }

    /// Whether nothing more will come, and all that can be filtered is.
    pub fn settled(&self) -> bool {
        (self.stitcher.is_complete() || self.finished) && self.open_regions() == 0
    }

    fn open_regions(&self) -> usize {
        self.neighbors.as_ref().map_or(0, |neighbors| neighbors.regions().open())
    }

    /// How often a tile took the place of another since it was opened.
    pub const fn replacements(&self) -> u64 {
        self.replacements
    }

    /// Whether it does not have to be kept in memory.
    pub fn idle(&self) -> bool {
        self.changes.is_empty() && self.neighbors.as_ref().is_none_or(Neighbors::idle)
    }

    /// The regions, if its tiles come as bare cores.
    pub fn regions(&self) -> Option<&Regions> {
        self.neighbors.as_ref().map(Neighbors::regions)
    }

    /// Cores that have arrived as bare ones, and their pixels.
    pub fn arrived(&self) -> (usize, u64) {
        self.neighbors.as_ref().map_or((0, 0), Neighbors::count)
    }

    /// The parts of a window that no bare core has brought.
    pub fn absent(&self, window: &Rect) -> Vec<Rect> {
        self.neighbors.as_ref().map_or_else(Vec::new, |neighbors| neighbors.absent(window))
    }

    /// What a region waits for: pixels that have not come, or, if it is filtered, not in cores.
    pub fn awaited(&self, region: u32) -> Vec<Rect> {
        self.neighbors.as_ref().map_or_else(Vec::new, |neighbors| neighbors.awaited(region))
    }

    /// Values that were replaced in bare cores. The regions' own reports know nothing of them.
    pub fn replaced(&self) -> Replaced {
        self.neighbors.as_ref().map_or_else(Replaced::default, Neighbors::replaced)
    }
}
