//! Planes of tiles that are done, kept for tiles to come: to have the system clear fresh pages, and take them back, would
//! cost more than all else that is done to read a tile.
//!
//! What is kept lies within what is free of the budget, and nobody waits for it: whoever has reserved some of the budget
//! has room made before he allocates any of it.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::{
    admission::{Budget, Permit},
    filter::{Plane, SampleTile},
};

/// Smaller blocks come from where the allocator keeps what is freed anyway (`cli/allocator.rs`).
const LEAST: u64 = 128 << 10;
/// Planes at most, so that they are soon looked through: those of some twenty tiles.
const MOST: usize = 512;

/// The planes that are kept.
#[derive(Debug)]
pub(super) struct Spare {
    budget: Budget,
    kept: Mutex<Kept>,
}

#[derive(Debug, Default)]
struct Kept {
    /// Without values; those that were kept last are last.
    planes: Vec<Vec<f32>>,
    bytes: u64,
    /// Whether any was taken since it was last asked.
    used: bool,
}

const fn bytes(plane: &Vec<f32>) -> u64 {
    4 * plane.capacity() as u64
}

impl Kept {
    fn remove(&mut self, index: usize) -> Vec<f32> {
        let plane = self.planes.remove(index);
        self.bytes -= bytes(&plane);
        plane
    }
}

impl Spare {
    /// None yet, and none ever but within what is free of this budget.
    pub(super) fn new(budget: Budget) -> Self {
        Self { budget, kept: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets go of what lies within bytes that are not free any more, the oldest first. To be called with every permit,
    /// before what it is for is allocated.
    pub(super) fn make_room(&self) {
        let mut kept = self.lock();
        let free = self.budget.free();
        while kept.bytes > free {
            drop(kept.remove(0));
        }
    }

    /// At most so many planes with room for exactly so many values. The caller has a permit for them.
    pub(super) fn take(&self, planes: usize, values: u64) -> Vec<Vec<f32>> {
        let mut kept = self.lock();
        kept.used = true;
        let mut taken = Vec::new();
        for index in (0..kept.planes.len()).rev() {
            if taken.len() < planes && kept.planes[index].capacity() as u64 == values {
                taken.push(kept.remove(index));
            }
        }
        taken
    }

    /// Keeps a tile's planes, as far as there is room, and gives all but `left` bytes of the tile's permit back.
    pub(super) fn keep(&self, tile: SampleTile, permit: &mut Permit, left: u64) {
        let mut kept = self.lock();
        // Whoever is given these bytes waits for the lock to make room.
        permit.shrink_to(left);
        let free = self.budget.free();
        for plane in tile.into_planes() {
            let Plane::Values(mut values) = plane else { continue };
            let bytes = bytes(&values);
            if bytes >= LEAST && kept.bytes + bytes <= free && kept.planes.len() < MOST {
                values.clear();
                kept.bytes += bytes;
                kept.planes.push(values);
            }
        }
    }

    /// Lets go of all, unless some were taken since this was last called.
    pub(super) fn tidy(&self) {
        let mut kept = self.lock();
        if !std::mem::take(&mut kept.used) {
            *kept = Kept::default();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, ChannelSet, Counts, Rect, Role, TileGeometry};
    use std::time::Duration;

    const MIB: u64 = 1 << 20;

    /// A tile of three planes of a MiB and one that is constant.
    fn tile() -> SampleTile {
        let channels =
            vec![Channel::new("color", Role::Color, 3), Channel::new("x", Role::Random { uniform: true }, 1)];
        let geometry = TileGeometry::with_halo([512, 512], Rect::new(0, 0, 512, 512), 0).unwrap();
        let plane = || Plane::Values((0..512 * 512).map(|i| i as f32).collect());
        let planes = vec![plane(), plane(), plane(), Plane::Constant(0.5)];
        SampleTile::new(geometry, ChannelSet::new(channels).unwrap(), Counts::Uniform(1), planes).unwrap()
    }

    #[test]
    fn what_is_kept_is_free_and_makes_room() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let budget = Budget::new(5 * MIB, 1);
            let reserve = async |mib: u64| budget.reserve(mib * MIB, Duration::from_secs(5)).await.unwrap();
            let spare = Spare::new(budget.clone());
            let kept = || {
                let kept = spare.lock();
                (kept.planes.len(), kept.bytes / MIB)
            };
            let mut permit = reserve(5).await;
            spare.keep(tile(), &mut permit, MIB);
            assert_eq!((budget.free() / MIB, kept()), (4, (3, 3)));
            // Another tile's, for which there is a single MiB left.
            spare.keep(tile(), &mut permit, MIB);
            assert_eq!((budget.free() / MIB, kept()), (4, (4, 4)));
            let other = reserve(2).await;
            spare.make_room();
            assert_eq!(kept(), (2, 2));
            drop((permit, other));
            assert_eq!(spare.take(3, MIB / 4 - 1), Vec::<Vec<f32>>::new());
            let taken = spare.take(1, MIB / 4);
            assert!(taken.len() == 1 && taken[0].is_empty() && taken[0].capacity() as u64 == MIB / 4);
            // What was used just now stays for a while.
            spare.tidy();
            assert_eq!(kept(), (1, 1));
            spare.tidy();
            assert_eq!(kept(), (0, 0));
            // Nothing is kept that is not free.
            let mut all = reserve(5).await;
            spare.keep(tile(), &mut all, 5 * MIB);
            assert_eq!(kept(), (0, 0));
        });
    }
}
