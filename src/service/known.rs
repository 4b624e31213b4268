//! The memory for what is known of images, as long as they are in memory.

use std::{
    path::Path,
    sync::{Arc, Mutex, PoisonError},
};

use super::{entry::Opened, problem::Refusal, registry::Images};
use crate::{
    admission::{AdmissionError, Permit},
    disk::Directory,
    image::{INDEX_STEP, Image, ImageError},
};

/// What was reserved for what is known of an image, as long as that is there.
#[derive(Clone, Debug)]
pub(super) struct Memory(Arc<Mutex<Permit>>);

impl Memory {
    pub(super) fn new(permit: Permit) -> Self {
        Self(Arc::new(Mutex::new(permit)))
    }
}

/// There is no memory for what is known of an image.
pub(super) fn no_memory(error: AdmissionError) -> Refusal {
    let mut refusal = Refusal::from(error);
    let advice = match error {
        AdmissionError::TooLarge { .. } => "send larger tiles, or start the service with more memory",
        _ => "others' images have it",
    };
    refusal.0.title = "There is no memory for more of this image".to_owned();
    refusal.0.detail = format!("of what is known of an image's tiles, {}: {advice}", refusal.0.detail);
    refusal
}

impl Images {
    /// Reads the image that is in a folder, if there is memory for it.
    pub(super) fn read(&self, path: &Path) -> Result<Result<(Arc<Image>, Memory), AdmissionError>, ImageError> {
        let (mut permit, total) = (self.memory.none(), self.memory.total());
        let opened = Image::open_within(Box::new(Directory::new(path)), |bytes| {
            // Of tiles that came at once each found room for itself.
            let few = bytes.saturating_sub(total) <= total / 8;
            self.reserve(&mut permit, if few { bytes.min(total) } else { bytes })
        })?;
        Ok(opened.map(|image| (Arc::new(image), Memory::new(permit))))
    }

    /// Takes memory for what is known of an image; images that nobody uses make room.
    pub(super) fn reserve(&self, permit: &mut Permit, needed: u64) -> Result<(), AdmissionError> {
        if needed <= permit.bytes() {
            return Ok(());
        }
        // More at a time, if there is more.
        let mut grow = || permit.grow_to(needed + 4 * INDEX_STEP).or_else(|_| permit.grow_to(needed));
        match grow() {
            Err(AdmissionError::Busy { .. }) => {
                self.entries().iter().for_each(|entry| entry.close(true));
                grow()
            }
            done => done,
        }
    }

    /// Makes room for what will be known of a tile; refused if there is none. Blocks.
    pub(super) fn make_room(&self, opened: &Opened) -> Result<(), Refusal> {
        let bytes = opened.image.read().index_bytes() + INDEX_STEP;
        let mut permit = opened.memory.0.lock().unwrap_or_else(PoisonError::into_inner);
        self.reserve(&mut permit, bytes).map_err(no_memory)
    }
}
