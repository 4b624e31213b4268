//! All images of the service, by id: in memory while they are used, else on the disk only.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use axum::http::StatusCode;
use serde_json::{Value, json};

use super::{
    entry::{Entry, Id, Opened, Slot, no_image},
    known::{Memory, no_memory},
    problem::Refusal,
};
use crate::{
    admission::Budget,
    config::Config,
    disk::{Directory, make_folders},
    image::{self, Description, INDEX_STEP, Image, ImageError},
    wire::Problem,
};

/// Folder of the images in the data folder, and the file that one service at a time holds.
const IMAGES: &str = "images";
const LOCK: &str = "rpfd.lock";
/// How often the time of the last use is written down.
const TOUCH: Duration = Duration::from_secs(60);

/// All of them.
#[derive(Debug)]
pub(super) struct Images {
    all: Mutex<BTreeMap<Id, Arc<Entry>>>,
    folder: PathBuf,
    limit: usize,
    /// Bytes of disk for all images, and those of images that are forgotten and not quite gone.
    disk: u64,
    leaving: Arc<AtomicU64>,
    /// How long an image is kept that nobody uses.
    ttl: Duration,
    /// How long it stays in memory.
    idle: Duration,
    /// Memory for what is known of those that are in memory.
    pub(super) memory: Budget,
    /// Held as long as this lives.
    _lock: File,
}

/// Why there are no images.
#[derive(Debug)]
pub(super) enum StartError {
    /// Another service has the folder.
    InUse,
    Io(io::Error),
}

impl From<io::Error> for StartError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs())
}

impl Images {
    /// Takes the data folder, and says what is in it, which is to be [recovered](Self::recover).
    pub(super) fn start(config: &Config, memory: Budget) -> Result<(Self, Vec<PathBuf>), StartError> {
        let lock =
            File::options().read(true).write(true).create(true).truncate(false).open(config.data_dir.join(LOCK))?;
        match lock.try_lock() {
            Err(fs::TryLockError::WouldBlock) => return Err(StartError::InUse),
            Err(fs::TryLockError::Error(error)) => return Err(error.into()),
            Ok(()) => {}
        }
        let folder = config.data_dir.join(IMAGES);
        make_folders(&folder)?;
        let found = fs::read_dir(&folder)?.map(|found| Ok(found?.path())).collect::<io::Result<_>>()?;
        let images = Self {
            all: Mutex::default(),
            folder,
            limit: config.images,
            disk: config.disk.0,
            leaving: Arc::default(),
            ttl: config.image_ttl,
            idle: config.image_idle,
            memory,
            _lock: lock,
        };
        Ok((images, found))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, BTreeMap<Id, Arc<Entry>>> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.lock().len()
    }

    /// How many of them are in memory.
    pub(super) fn in_memory(&self) -> usize {
        // One that is just being opened is as good as open.
        let open = |entry: &&Arc<Entry>| entry.slot.try_lock().map_or(true, |slot| matches!(*slot, Slot::Open(..)));
        self.entries().iter().filter(open).count()
    }

    pub(super) fn entries(&self) -> Vec<Arc<Entry>> {
        self.lock().values().cloned().collect()
    }

    /// Seconds since 1970 at which an image will be forgotten, if nobody uses it.
    pub(super) fn expires(&self, entry: &Entry) -> u64 {
        entry.touched().saturating_add(self.ttl.as_secs())
    }

    /// The image of this id, in memory. Blocks.
    pub(super) fn find(&self, id: &Id) -> Result<Opened, Refusal> {
        let entry = self.lock().get(id).cloned().ok_or_else(|| no_image(&id.0))?;
        let opened = self.load(&entry)?.ok_or_else(|| no_image(&id.0))?;
        self.touch(&entry);
        Ok(opened)
    }

    /// An entry's image, from the disk if it is not in memory or has failed; none if it is gone.
    fn load(&self, entry: &Arc<Entry>) -> Result<Option<Opened>, Refusal> {
        let mut slot = entry.slot();
        let opened = |image: &Arc<Image>, memory: &Memory| {
            Some(Opened { entry: Arc::clone(entry), image: Arc::clone(image), memory: memory.clone() })
        };
        match &*slot {
            Slot::Open(image, memory) if image.failed().is_none() => return Ok(opened(image, memory)),
            // It makes room for what it was before.
            Slot::Open(image, _) => {
                let summary = super::images::summary(&entry.id, image);
                image.close();
                *slot = Slot::Closed(summary);
            }
            Slot::Closed(_) => {}
            Slot::Damaged(why) => return Err(super::problem::storage("damaged", why).into()),
            Slot::Gone => return Ok(None),
        }
        match self.read(&self.folder.join(&entry.id.0)) {
            Ok(Ok((image, memory))) => {
                let found = opened(&image, &memory);
                *slot = Slot::Open(image, memory);
                Ok(found)
            }
            Ok(Err(error)) => Err(no_memory(error)),
            Err(error) => {
                if error.is_damage() {
                    *slot = Slot::Damaged(error.to_string());
                }
                Err(error.into())
            }
        }
    }

    /// The image of this id, if it is still there; nobody has asked for it. Blocks.
    pub(super) fn again(&self, id: &Id) -> Result<Option<Opened>, Refusal> {
        let Some(entry) = self.lock().get(id).cloned() else { return Ok(None) };
        self.load(&entry)
    }

    fn touch(&self, entry: &Entry) {
        let now = now();
        entry.touched.store(now, Ordering::Relaxed);
        if now.saturating_sub(entry.written.load(Ordering::Relaxed)) >= TOUCH.as_secs() {
            entry.written.store(now, Ordering::Relaxed);
            self.write_touched(entry);
        }
    }

    fn write_touched(&self, entry: &Entry) {
        let path = self.folder.join(&entry.id.0).join(image::TOUCHED);
        let file = File::options().write(true).create(true).truncate(true).open(path);
        // If that is not possible the image expires too early, after a new start: nothing to refuse a request for.
        let _ = file.and_then(|file| file.set_modified(UNIX_EPOCH + Duration::from_secs(entry.touched())));
    }

    /// Opens an image, of which its owner may have so many, unless there is one with its id: says whether it is new, and
    /// gives the one that is there now. Blocks.
    pub(super) fn open(&self, id: Id, description: Description, limit: usize) -> Result<(bool, Opened), Refusal> {
        let (owner, disk) = (description.owner.clone(), description.disk);
        let entry = Arc::new(Entry::new(id.clone(), owner, disk, now(), Slot::Gone));
        // Whoever finds the entry waits until the image is there.
        let mut slot = entry.slot();
        loop {
            let known = self.lock().contains_key(&id);
            if known {
                match self.find(&id) {
                    Ok(opened) if opened.image.description().same(&description) => return Ok((false, opened)),
                    Ok(_) => {
                        return Err(Refusal::new(
                            StatusCode::CONFLICT,
                            "image_conflict",
                            "The image is there, opened differently",
                            format!(
                                "image {:?} was opened with another size, preset, seed, parameters, halo, samples or \
                                 channels",
                                id.0
                            ),
                        ));
                    }
                    // It has gone just now.
                    Err(refusal) if refusal.0.code == "unknown_image" => continue,
                    Err(refusal) => return Err(refusal),
                }
            }
            let mut all = self.lock();
            if all.contains_key(&id) {
                continue;
            }
            self.admit(&all, &description, limit)?;
            all.insert(id.clone(), Arc::clone(&entry));
            break;
        }
        let mut permit = self.memory.none();
        let room = self.reserve(&mut permit, description.index_bytes() + INDEX_STEP).map_err(no_memory);
        match room.and_then(|()| Ok(self.create(&id, &description)?)) {
            Ok(image) => {
                let (image, memory) = (Arc::new(image), Memory::new(permit));
                *slot = Slot::Open(Arc::clone(&image), memory.clone());
                drop(slot);
                Ok((true, Opened { entry, image, memory }))
            }
            Err(refusal) => {
                drop(slot);
                self.lock().remove(&id);
                Err(refusal)
            }
        }
    }

    /// Refuses one image more than there may be, in all or of its owner, or one that takes more disk than is left.
    fn admit(&self, all: &BTreeMap<Id, Arc<Entry>>, description: &Description, limit: usize) -> Result<(), Refusal> {
        let (owner, needed) = (&description.owner, description.disk);
        if owner.is_some() && all.values().filter(|entry| entry.owner == *owner).count() >= limit {
            let detail = format!("{limit} images opened with this token are open; delete some that are done");
            return Err(Problem::new(429, "image_quota", "Too many images of this token are open", detail)
                .with("retry_after", 60)
                .into());
        }
        if all.len() >= self.limit {
            return Err(Problem::new(
                503,
                "too_many_images",
                "Too many images are open",
                format!("{} images are open; delete some that are done", self.limit),
            )
            .with("retry_after", 60)
            .into());
        }
        let free = self.disk.saturating_sub(self.taken(all));
        if needed > free {
            let detail = format!(
                "the image may take {needed} bytes of disk, and of the {} bytes for all images {free} are free",
                self.disk
            );
            return Err(Problem::new(507, "disk_quota", "The disk quota is used up", detail)
                .with("needed", needed)
                .with("free", free)
                .with("quota", self.disk)
                .into());
        }
        Ok(())
    }

    fn create(&self, id: &Id, description: &Description) -> Result<Image, ImageError> {
        let (new, path) = (self.folder.join(format!(".new-{}", id.0)), self.folder.join(&id.0));
        remove(&new)?;
        fs::create_dir(&new)?;
        // What cannot be removed here is at the next start.
        if let Err(error) =
            Image::create(&Directory::new(&new), description).and_then(|()| Ok(fs::rename(&new, &path)?))
        {
            let _ = remove(&new);
            return Err(error);
        }
        let opened = File::open(&self.folder).and_then(|folder| folder.sync_all()).map_err(ImageError::from);
        let opened = opened.and_then(|()| Image::open(Box::new(Directory::new(&path))));
        if opened.is_err() {
            let _ = remove(&path);
        }
        opened
    }

    /// Forgets an image. Says whether there was one. Blocks.
    pub(super) fn delete(&self, id: &Id) -> Result<bool, Refusal> {
        self.forget(id, |_| true)
    }

    /// Forgets an image if it is to be forgotten as it is; meanwhile nobody can get hold of it.
    fn forget(&self, id: &Id, wanted: impl FnOnce(&Slot) -> bool) -> Result<bool, Refusal> {
        let Some(entry) = self.lock().get(id).cloned() else { return Ok(false) };
        let mut slot = entry.slot();
        if matches!(*slot, Slot::Gone) || !wanted(&slot) {
            return Ok(false);
        }
        let gone = self.folder.join(format!(".gone-{}", Id::new().0));
        fs::rename(self.folder.join(&id.0), &gone)?;
        *slot = Slot::Gone;
        entry.runner.stop.cancel();
        self.leaving.fetch_add(entry.disk, Ordering::Relaxed);
        let _ = entry.left.set(Arc::clone(&self.leaving));
        self.lock().remove(id);
        drop(slot);
        File::open(&self.folder).and_then(|folder| folder.sync_all()).and_then(|()| remove(&gone))?;
        Ok(true)
    }

    /// Forgets images that nobody has used for long, and closes those that nobody uses. Blocks.
    pub(super) fn tidy(&self) {
        let now = now();
        for entry in self.entries() {
            let used = entry.is_used(&entry.slot());
            if used {
                self.touch(&entry);
            } else if now >= self.expires(&entry) {
                // Somebody may have come just now.
                match self.forget(&entry.id, |slot| now >= self.expires(&entry) && !entry.is_used(slot)) {
                    Ok(true) => tracing::info!(id = entry.id.0, "image expired"),
                    Ok(false) => {}
                    Err(refusal) => {
                        tracing::warn!(id = entry.id.0, problem = refusal.0.detail, "cannot forget an image")
                    }
                }
            } else if now.saturating_sub(entry.touched()) >= self.idle.as_secs() {
                entry.close(false);
            }
        }
    }

    /// Stops the work on all images.
    pub(super) fn stop(&self) {
        self.entries().iter().for_each(|entry| entry.runner.stop.cancel());
    }

    /// Bytes of disk that are set aside for images, and all that there are for them.
    pub(super) fn disk(&self) -> [u64; 2] {
        [self.taken(&self.lock()), self.disk]
    }

    fn taken(&self, all: &BTreeMap<Id, Arc<Entry>>) -> u64 {
        all.values().map(|entry| entry.disk).sum::<u64>() + self.leaving.load(Ordering::Relaxed)
    }

    /// The summaries of all images. Blocks.
    pub(super) fn list(&self) -> Vec<Value> {
        let one = |entry: &Arc<Entry>| {
            let mut summary = match &*entry.slot() {
                Slot::Open(image, _) => super::images::summary(&entry.id, image),
                Slot::Closed(summary) if summary.is_object() => summary.clone(),
                Slot::Closed(_) => json!({ "id": entry.id.0 }),
                Slot::Damaged(why) => json!({ "id": entry.id.0, "damaged": why }),
                Slot::Gone => return None,
            };
            summary["expires"] = self.expires(entry).into();
            Some(summary)
        };
        self.entries().iter().filter_map(one).collect()
    }
}

pub(super) fn remove(path: &Path) -> io::Result<()> {
    let removed = match fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
