//! What an image takes in memory: what is known of its tiles, cores and regions, so that it can be reserved. At worst, by
//! the sizes of the entries and of the lists and trees that they are in, which have empty places.

use super::{Description, Image, ImageError, Inner};
use crate::{
    disk::Folder,
    store::{Records, State, state},
};

/// The image without any, its store included.
const IMAGE: u64 = state::CACHE as u64 + (64 << 10);
/// A tile that is stored, or being made.
const TILE: u64 = 768;
/// A core whose samples are kept, or a part of a halo.
const CORE: u64 = 384;
const REGION: u64 = 128;
/// More than what comes with one tile.
pub const INDEX_STEP: u64 = 16 << 10;

/// A region's tile is counted before it is there: it has to find room whatever comes first.
fn bytes(tiles: u64, cores: u64, regions: u64) -> u64 {
    IMAGE + tiles.max(regions) * TILE + cores * CORE + regions * REGION
}

impl Description {
    fn regions(&self) -> u64 {
        let count = |region: u32| self.size.map(|side| u64::from(side.div_ceil(region))).into_iter().product();
        self.neighbors.as_ref().map_or(0, |known| count(known.region))
    }

    /// Bytes of memory that such an image takes before any tile has come.
    pub fn index_bytes(&self) -> u64 {
        bytes(0, 0, self.regions())
    }
}

impl Inner {
    /// Bytes of memory that are taken at most.
    pub fn index_bytes(&self) -> u64 {
        let (cores, regions) =
            self.neighbors.as_ref().map_or((0, 0), |known| (known.entries(), known.regions().count()));
        bytes(self.stitcher.known() as u64, cores as u64, regions.into())
    }
}

impl Image {
    /// How an image that is in a folder was opened.
    pub fn describe(folder: &dyn Folder) -> Result<Description, ImageError> {
        described(&State::open(folder)?)
    }
}

pub(super) fn described(state: &State) -> Result<Description, ImageError> {
    let description = state.fact("image")?.and_then(|bytes| Description::decode(&bytes));
    Ok(description.ok_or_else(|| state.damaged("it does not say how the image was opened"))?)
}

/// Bytes of memory that an image takes at most as it is on the disk.
pub(super) fn stored_bytes(state: &State, description: &Description) -> Result<u64, ImageError> {
    let cores = state.count(Records::Samples)?.saturating_add(state.count(Records::Lent)?);
    Ok(bytes(state.count(Records::Tiles)?.min(1 << 40), cores.min(1 << 40), description.regions()))
}
