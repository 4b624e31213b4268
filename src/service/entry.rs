//! An image by its id: in memory while it is used, and who is at work on it.

use std::{
    hash::{BuildHasher, RandomState},
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use axum::{
    extract::{FromRequestParts, Path as UrlPath},
    http::{StatusCode, request::Parts},
};
use serde_json::Value;

use super::{known::Memory, problem::Refusal, regions};
use crate::image::Image;

/// Most bytes of an id.
const MAX_ID: usize = 128;

/// The id of an image, from the path of a request.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Id(pub(super) String);

impl<S: Send + Sync> FromRequestParts<S> for Id {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Refusal> {
        // What is not even text is no image's id.
        let id = UrlPath::<String>::from_request_parts(parts, state).await;
        id.map(|UrlPath(id)| Self(id)).map_err(|error| no_image(&error.body_text()))
    }
}

impl Id {
    /// An id that a client has chosen, if it can be one.
    pub(super) fn chosen(id: &str) -> Option<Self> {
        let fine = |b: u8| b.is_ascii_alphanumeric() || b"._-".contains(&b);
        let fine = (1..=MAX_ID).contains(&id.len()) && id.bytes().all(fine) && !id.starts_with('.');
        fine.then(|| Self(id.to_owned()))
    }

    /// An id that nobody has.
    pub(super) fn new() -> Self {
        let random = || RandomState::new().hash_one("image");
        Self(format!("{:016x}{:016x}", random(), random()))
    }
}

pub(super) fn no_image(id: &str) -> Refusal {
    let detail = format!("there is no image {id:?}: it was never opened, or is forgotten");
    Refusal::new(StatusCode::NOT_FOUND, "unknown_image", "There is no such image", detail)
}

/// An image by its id.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) id: Id,
    /// The name of the token with which it was opened.
    pub(super) owner: Option<String>,
    /// Bytes of disk that are set aside for it.
    pub(super) disk: u64,
    /// Seconds since 1970 at which it was last used, and at which that was written down.
    pub(super) touched: AtomicU64,
    pub(super) written: AtomicU64,
    pub(super) slot: Mutex<Slot>,
    /// One result at a time is made.
    pub(super) encoding: tokio::sync::Mutex<()>,
    /// Answers on their way that read the result which the image keeps.
    readers: AtomicU64,
    /// Where its disk counts once it is forgotten, until nobody is at work on it or reads of it any more.
    pub(super) left: OnceLock<Arc<AtomicU64>>,
    pub(super) runner: regions::Runner,
}

#[derive(Debug)]
pub(super) enum Slot {
    /// On the disk only; its summary as it was last.
    Closed(Value),
    Open(Arc<Image>, Memory),
    /// Its files are not what was written.
    Damaged(String),
    Gone,
}

impl Slot {
    /// Whether a request, or the work on its regions, has it.
    fn is_used(&self) -> bool {
        matches!(self, Self::Open(image, _) if Arc::strong_count(image) > 1)
    }
}

/// An image in memory.
#[derive(Clone, Debug)]
pub(super) struct Opened {
    pub(super) entry: Arc<Entry>,
    pub(super) image: Arc<Image>,
    pub(super) memory: Memory,
}

impl Entry {
    pub(super) fn new(id: Id, owner: Option<String>, disk: u64, touched: u64, slot: Slot) -> Self {
        Self {
            id,
            owner,
            disk,
            touched: touched.into(),
            written: touched.into(),
            slot: Mutex::new(slot),
            encoding: tokio::sync::Mutex::new(()),
            readers: AtomicU64::new(0),
            left: OnceLock::new(),
            runner: regions::Runner::default(),
        }
    }

    pub(super) fn slot(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether somebody is at work on it, or reads its result. Who tries in vain is not at work.
    pub(super) fn is_used(&self, slot: &Slot) -> bool {
        self.is_read() || self.runner.told().is_none() && slot.is_used()
    }

    /// Whether somebody reads the result that the image keeps, or kept.
    pub(super) fn is_read(&self) -> bool {
        self.readers.load(Ordering::Relaxed) > 0
    }

    /// Seconds since 1970 at which it was last used.
    pub(super) fn touched(&self) -> u64 {
        self.touched.load(Ordering::Relaxed)
    }

    /// Closes the image if nobody uses it; `at_once` if nobody holds its slot either, who may himself wait for another's.
    pub(super) fn close(&self, at_once: bool) {
        let slot = if at_once { self.slot.try_lock().ok() } else { Some(self.slot()) };
        let Some(mut slot) = slot else { return };
        let Slot::Open(image, _) = &*slot else { return };
        // Nobody else can get hold of it meanwhile.
        if slot.is_used() || image.failed().is_some() || !image.read().idle() {
            return;
        }
        let summary = super::images::summary(&self.id, image);
        image.close();
        *slot = Slot::Closed(summary);
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        if let Some(leaving) = self.left.get() {
            leaving.fetch_sub(self.disk, Ordering::Relaxed);
        }
    }
}

/// Somebody reads the result that an image keeps.
#[derive(Debug)]
pub(super) struct Reading(Arc<Entry>);

impl Reading {
    pub(super) fn new(entry: &Arc<Entry>) -> Self {
        entry.readers.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(entry))
    }
}

impl Drop for Reading {
    fn drop(&mut self) {
        self.0.readers.fetch_sub(1, Ordering::Relaxed);
    }
}
