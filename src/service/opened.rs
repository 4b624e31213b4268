//! An image that a request is at work on.

use std::sync::Arc;

use axum::http::StatusCode;

use super::{Shared, problem::Refusal, regions, registry::Opened};
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

    /// Refuses tiles of other images.
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
        let inner = self.image.read();
        if let Some(known) = inner.channels()
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
    pub(super) fn offer(&self, tile: &SampleTile, replace: bool) -> Result<Outcome, Refusal> {
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
