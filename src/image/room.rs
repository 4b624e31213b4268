//! Room on the disk for samples: what halos bring may have what is beside all cores that may still come.

use super::{
    Announced, Description,
    description::{most_cores, sample_bytes},
};
use crate::{filter::Rect, store::Extent};

/// Disk for samples.
#[derive(Debug)]
pub(super) struct Room {
    /// Bytes that were set aside.
    all: u64,
    /// Bytes that are taken.
    pub(super) taken: u64,
    announced: Announced,
    /// Cores that may come in all, and pixels.
    pub(super) cores: u64,
    pixels: u64,
}

impl Room {
    pub(super) fn new(description: &Description, announced: &Announced) -> Self {
        let [width, height] = description.size.map(u64::from);
        Self {
            all: sample_bytes(description),
            taken: 0,
            announced: announced.clone(),
            cores: most_cores(description.size),
            pixels: width * height,
        }
    }

    /// Takes room for some pixels that a halo brings, if there is any beside what is owed to the cores that are still to
    /// come, after so many with so many pixels.
    pub(super) fn lend(&mut self, part: &Rect, cores: usize, pixels: u64) -> bool {
        let owed = self.announced.room(self.cores.saturating_sub(cores as u64), self.pixels.saturating_sub(pixels));
        let wanted = self.announced.room(1, part.area());
        let fits =
            self.taken.checked_add(wanted).and_then(|sum| sum.checked_add(owed)).is_some_and(|sum| sum <= self.all);
        self.taken += if fits { wanted } else { 0 };
        fits
    }

    /// Gives back what was taken for pixels that are not kept, or takes less, now that it is known.
    pub(super) fn settle(&mut self, part: &Rect, extent: Option<&Extent>) {
        self.taken -= self.announced.room(1, part.area());
        self.taken += extent.map_or(0, Extent::room);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        disk::Directory,
        filter::{Channel, ChannelSet, Counts, Method, Plane, Role, SampleTile, TileGeometry},
        image::disk_bytes,
        store::SampleFile,
    };

    /// Whatever halos take, all cores that may still come have room, at their worst; and a quarter of the pixels is lent.
    #[test]
    fn halos_leave_room_for_all_cores() {
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let announced = Announced { channels, samples: 3, varying: true, region: 64 };
        let method = Method::preset("lean").unwrap();
        let neighbors = Some(announced.clone());
        let description = Description { neighbors, ..Description::plain([1024, 768], method) };
        let description = Description { disk: disk_bytes(&description), ..description };
        let mut room = Room::new(&description, &announced);
        let (most, pixels) = (most_cores(description.size), 1024 * 768);
        assert_eq!((room.cores, room.pixels), (most, pixels));
        // What the noisiest core of 16 x 16 takes: planes of random bits.
        let mut state = 1u64;
        let mut value = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            f32::from_bits((state >> 32) as u32 & 0xFF7F_FFFF)
        };
        let geometry = TileGeometry::with_halo(description.size, Rect::new(0, 0, 16, 16), 0).unwrap();
        let planes = (0..3).map(|_| Plane::Values((0..768).map(|_| value()).collect())).collect();
        let tile =
            SampleTile::new(geometry, announced.channels.clone(), Counts::Varying(vec![3; 256]), planes).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let file = SampleFile::create(&Directory::new(folder.path()), announced.channels.clone()).unwrap();
        let core = file.append(&tile, &geometry.core()).unwrap().room();
        assert!((9216..=announced.room(1, 256)).contains(&core), "{core}");
        let (mut cores, mut brought, mut lent) = (0, 0, 0);
        while brought < pixels {
            // Strips as wide as a tile, until there is no room; then a core of 16 x 16.
            let strip = Rect::new(0, 0, 64, 17);
            while room.lend(&strip, cores, brought) {
                lent += strip.area();
            }
            assert!(lent >= pixels / 4, "{lent}");
            assert!(room.taken + announced.room(most - cores as u64, pixels - brought) <= room.all);
            room.taken += core;
            (cores, brought) = (cores + 1, brought + 256);
        }
        assert!(room.taken <= room.all);
        // What is not kept is free again.
        let (before, part) = (room.taken, Rect::new(0, 0, 1, 1));
        room.all += 1 << 20;
        assert!(room.lend(&part, cores, brought));
        room.settle(&part, None);
        assert_eq!(room.taken, before);
        assert!(!Room { all: 0, ..room }.lend(&part, 0, 0));
    }
}
