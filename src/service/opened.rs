//! An image that a request is at work on.

use std::sync::Arc;

use axum::http::StatusCode;

use super::{Shared, entry::Opened, problem::Refusal, regions};
use crate::{
    filter::{ChannelSet, Filtered, Method, SampleTile},
    image::{self, Outcome},
    stitch::Added,
    wire::Header,
};

impl Opened {
    /// How its tiles are filtered, the seed, and whether what has no effect is left out.
    pub(super) fn method(&self) -> (Arc<Method>, u64, bool) {
        let description = self.image.description();
        (Arc::new(description.method.clone()), description.seed, description.leave_out)
    }

    /// Whether tiles are bare cores, to be filtered later.
    pub(super) fn keeps_samples(&self) -> bool {
        self.image.description().neighbors.is_some()
    }

    /// Refuses tiles of other images. Waits for nobody.
    pub(super) fn check(&self, header: &Header) -> Result<(), Refusal> {
        let refuse = |code, detail| {
            let title = "The tile is not of this image";
            Err(Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, code, title, detail))
        };
        let (image, [width, height]) = (header.geometry().image(), self.image.description().size);
        if [image.width, image.height] != [width, height] {
            let detail = format!(
                "the tile is of an image of {} x {} pixels, this one has {width} x {height}",
                image.width, image.height
            );
            return refuse("image_mismatch", detail);
        }
        if let Some(known) = self.image.channels()
            && known != header.channels()
        {
            let names = |set: &ChannelSet| set.channels().iter().map(|c| c.name.clone()).collect::<Vec<_>>().join(", ");
            let detail = format!(
                "the tile's channels ({}) are not those of the image ({}): names, order, roles and components \
                 must be the same in all tiles of an image",
                names(header.channels()),
                names(known)
            );
            return refuse("channel_mismatch", detail);
        }
        let announced = &self.image.description().neighbors;
        Ok(announced.as_ref().map_or(Ok(()), |announced| announced.check(header))?)
    }

    /// Asks whether a tile is wanted. Blocks.
    pub(super) fn offer(&self, tile: &SampleTile, replace: bool, service: &Shared) -> Result<Outcome, Refusal> {
        service.images.make_room(self)?;
        Ok(self.image.offer(tile, replace)?)
    }

    /// Puts a filtered tile on the canvas and says what became of it. Blocks.
    pub(super) fn add(
        &self,
        claim: image::Claimed,
        filtered: &Filtered,
        seconds: f64,
    ) -> Result<&'static str, Refusal> {
        Ok(match self.image.add(claim, filtered, seconds)? {
            Added::Repeated => "repeated",
            Added::Stored => "filtered",
        })
    }

    /// Waits until all that was offered and added is durable, and sees to what can be filtered now. Blocks.
    pub(super) fn flush(&self, service: &Shared) -> Result<(), Refusal> {
        self.image.flush()?;
        regions::kick(service, self);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        admission::Budget,
        disk::Directory,
        filter::{Channel, Method, Rect, Role, TileGeometry},
        image::{Description, Image},
        service::{
            entry::{Entry, Id, Slot},
            known::Memory,
        },
        wire::{Format, SampleCounts},
    };
    use std::{sync::mpsc, thread, time::Duration};

    /// Who is at work on an image, with the disk too, keeps no thread that serves connections.
    #[test]
    fn a_header_is_judged_while_others_hold_the_image() {
        let folder = tempfile::tempdir().unwrap();
        let description = Description::plain([64, 64], Method::default());
        Image::create(&Directory::new(folder.path()), &description).unwrap();
        let image = Arc::new(Image::open(Box::new(Directory::new(folder.path()))).unwrap());
        let entry = Arc::new(Entry::new(Id::new(), None, 0, 0, Slot::Gone));
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let geometry = TileGeometry::with_halo([64, 64], Rect::new(0, 0, 16, 16), 0).unwrap();
        let header = Header::new(geometry, channels, SampleCounts::Uniform(1), Format::F32).unwrap();
        let memory = Memory::new(Budget::new(0, 0).none());
        let opened = Opened { entry, image: Arc::clone(&image), memory };
        thread::scope(|scope| {
            let held = image.read();
            // It waits to change the image, and everybody who wants to look at it waits behind it.
            scope.spawn(|| image.finish().unwrap());
            let (done, seen) = mpsc::channel();
            thread::spawn(move || {
                for _ in 0..100 {
                    opened.check(&header).unwrap();
                    thread::sleep(Duration::from_millis(2));
                }
                done.send(()).unwrap();
            });
            let seen = seen.recv_timeout(Duration::from_secs(60));
            drop(held);
            seen.expect("it waits");
        });
    }
}
