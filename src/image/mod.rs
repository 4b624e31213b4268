//! An image that is being assembled, and kept safe: what it has acknowledged is there after a kill or a power loss.
//!
//! An image is a folder: the canvas, a [store](State) of records, and, where tiles come as bare cores, their samples. A
//! tile counts once its record is committed; its pixels, or samples, are on the disk before that. So whatever happens,
//! what is recorded is there, and what is not recorded never was. [`Image::flush`] commits all that was added since the
//! last time, by whomever, at once.
//!
//! A store that fails (a full disk, say) fails the image: this [`Image`] takes nothing more, and is to be
//! [opened](Image::open) anew from what is on the disk. That is the same as after a kill, so there is one way to recover.
//!
//! Pixels are never written over in place: a tile that replaces another is written beside the canvas first.

mod announced;
pub mod description;
mod error;
mod index;
mod inner;
mod jobs;
mod neighbors;
mod record;
pub mod regions;
mod result;
mod room;

pub use announced::keeping;
pub use description::{Announced, Description, disk_bytes};
pub use error::ImageError;
pub use index::INDEX_STEP;
pub use jobs::{Job, Spent};
pub use regions::{RegionState, Regions};

use std::{
    collections::HashMap,
    convert::Infallible,
    io,
    path::Path,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard,
        atomic::{AtomicBool, Ordering},
    },
};

use crate::{
    disk::Folder,
    filter::{ChannelSet, Filtered, Rect, SampleTile, Stopped},
    stitch::{
        Added, Canvas, CanvasError, Claim, Digest, Offer, Pixels, StitchError, Stitcher, Verdict, canvas::Checksum,
        digest::digest,
    },
    store::{Change, Records, State, StateError, samples, state},
};
use description::{channels_from_json, channels_to_json};
use neighbors::Neighbors;
use record::TileRecord;

/// Tiles of an image at most: each is kept track of in memory, a few hundred bytes.
pub const MAX_TILES: usize = 1 << 17;
/// Least side of a bare core, in pixels, but at the image's edge.
pub const MIN_CORE: u32 = 16;

const CANVAS: &str = "canvas";
/// A tile on its way to the place of another, and the fact that says so.
const REPLACEMENT: &str = "replacement";
/// The image as a file, written before it was asked for again.
const RESULT: &str = "result.exr";
/// Files that an image may have; any others in its folder are remains of a kill.
pub const FILES: [&str; 6] = [state::STATE_FILE, samples::SAMPLES_FILE, CANVAS, REPLACEMENT, RESULT, TOUCHED];
/// Its age is the time since the image was last used.
pub const TOUCHED: &str = "touched";

/// What becomes of a tile that was offered.
#[derive(Debug)]
pub enum Outcome {
    /// It is there already, made from the same samples.
    Repeated,
    /// Its samples are kept, and will be filtered.
    Stored,
    /// It is to be filtered.
    Filter(Claimed),
}

/// The right to deliver a tile. Dropping it gives the tile free.
#[derive(Debug)]
pub struct Claimed {
    image: Arc<Image>,
    claim: Option<Claim>,
}

impl Drop for Claimed {
    fn drop(&mut self) {
        if let Some(claim) = self.claim.take() {
            self.image.write().stitcher.release(&claim);
        }
    }
}

/// What is kept of a stored tile beside what the stitcher does.
#[derive(Clone, Copy, Debug)]
struct Note {
    seconds: f64,
    checksum: Checksum,
}

/// An image. See the [module](self).
#[derive(Debug)]
pub struct Image {
    folder: Box<dyn Folder>,
    description: Description,
    canvas: Canvas,
    /// Taken before `inner`, if both are.
    committer: Mutex<Committer>,
    inner: RwLock<Inner>,
    /// The channels of its tiles: as announced, or those of the first that came whole. Set while `inner` is held, and
    /// read by who must not wait for the disk, as who holds that may.
    channels: OnceLock<ChannelSet>,
    failed: OnceLock<StateError>,
    /// Held, many at a time, by those who write pixels or samples; taken before the other locks.
    writing: RwLock<()>,
}

#[derive(Debug)]
struct Committer {
    /// None once it has failed.
    state: Option<State>,
    /// Changes that are durable.
    done: u64,
}

/// What is known in memory.
#[derive(Debug)]
pub struct Inner {
    stitcher: Stitcher,
    notes: HashMap<Rect, Note>,
    neighbors: Option<Neighbors>,
    finished: bool,
    /// What is to be committed, and what to do then.
    changes: Vec<Change>,
    after: Vec<After>,
    /// Changes so far, those included.
    queued: u64,
    /// How often a tile took the place of another, and the options of the result that is written down.
    replacements: u64,
    result: Option<String>,
}

/// What follows a commit.
#[derive(Clone, Copy, Debug)]
enum After {
    Arrived(Rect),
    Lent(Rect),
    /// A region, and whether for good.
    Filtered(u32, bool),
    Finished,
}

impl Image {
    /// Makes the files of a new image in an empty folder, and waits until they are on the disk.
    pub fn create(folder: &dyn Folder, description: &Description) -> Result<(), ImageError> {
        let [width, height] = description.size;
        Canvas::create(width, height, folder, CANVAS)?.sync()?;
        if let Some(known) = &description.neighbors {
            crate::store::SampleFile::create(folder, known.channels.clone())?.sync()?;
        }
        State::create(folder, &[Change::Fact("image", description.encode())])?;
        Ok(folder.sync()?)
    }

    /// Opens an image that is in a folder, as it was when it was last heard of. What was not committed is given up.
    pub fn open(folder: Box<dyn Folder>) -> Result<Self, ImageError> {
        Ok(Self::open_within(folder, |_| Ok::<_, Infallible>(()))?.unwrap_or_else(|never| match never {}))
    }

    /// As [`Self::open`], if so many bytes of memory may be taken.
    pub fn open_within<E>(
        folder: Box<dyn Folder>,
        admit: impl FnOnce(u64) -> Result<(), E>,
    ) -> Result<Result<Self, E>, ImageError> {
        let state = State::open(&*folder)?;
        let description = index::described(&state)?;
        if let Err(refused) = admit(index::stored_bytes(&state, &description)?) {
            return Ok(Err(refused));
        }
        let [width, height] = description.size;
        let canvas = Canvas::open(width, height, &*folder, CANVAS)?;
        if let Some(bytes) = state.fact(REPLACEMENT)? {
            let side = |i: usize| Some(u32::from_le_bytes(*bytes.get(4 * i..)?.first_chunk()?));
            let core = || Some(Rect::new(side(0)?, side(1)?, side(2)?, side(3)?));
            let core = core().filter(|core| canvas.image().covers(core));
            let core = core.ok_or_else(|| state.damaged("a replacement lies outside the image"))?;
            canvas.paste(core, &Canvas::open(core.width, core.height, &*folder, REPLACEMENT)?)?;
            canvas.sync()?;
            state.commit(&[Change::Forget(REPLACEMENT)])?;
        }
        folder.remove(REPLACEMENT)?;
        folder.remove(RESULT)?;
        let channels = match (&description.neighbors, state.fact("channels")?) {
            (Some(known), _) => Some(known.channels.clone()),
            (None, None) => None,
            (None, Some(bytes)) => {
                let value = serde_json::from_slice(&bytes).unwrap_or_default();
                Some(channels_from_json(&value).map_err(|error| state.damaged(error))?)
            }
        };
        let (mut stitcher, mut notes) = (Stitcher::on(canvas.clone()), HashMap::new());
        let mut wrong = None;
        state.each(Records::Tiles, |core, bytes| {
            let record = channels.as_ref().and_then(|channels| TileRecord::decode(bytes, channels));
            let Some(TileRecord { digest, checksum, seconds, report }) = record else {
                wrong.get_or_insert(format!("the record of tile {core} cannot be read"));
                return;
            };
            match stitcher.restore(core, digest, report) {
                Ok(()) => drop(notes.insert(core, Note { seconds, checksum })),
                Err(error) => drop(wrong.get_or_insert(error.to_string())),
            }
        })?;
        if let Some(why) = wrong {
            return Err(state.damaged(why).into());
        }
        let finished = state.fact("finished")?.is_some();
        let neighbors = match &description.neighbors {
            Some(known) => Some(Neighbors::open(&*folder, &state, &description, known, &stitcher, finished)?),
            None => None,
        };
        let inner = Inner {
            stitcher,
            notes,
            neighbors,
            finished,
            changes: Vec::new(),
            after: Vec::new(),
            queued: 0,
            replacements: 0,
            result: None,
        };
        Ok(Ok(Self {
            folder,
            description,
            canvas,
            committer: Mutex::new(Committer { state: Some(state), done: 0 }),
            inner: RwLock::new(inner),
            channels: channels.map_or_else(OnceLock::new, OnceLock::from),
            failed: OnceLock::new(),
            writing: RwLock::new(()),
        }))
    }

    /// How it was opened.
    pub const fn description(&self) -> &Description {
        &self.description
    }

    /// The channels of its tiles: as announced, or those of the first that came whole. Waits for nobody.
    pub fn channels(&self) -> Option<&ChannelSet> {
        self.channels.get()
    }

    /// Where its files are.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// What is known of it now.
    pub fn read(&self) -> RwLockReadGuard<'_, Inner> {
        self.inner.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Inner> {
        self.inner.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn committer(&self) -> MutexGuard<'_, Committer> {
        self.committer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Why it takes nothing more and must be opened anew, if so.
    pub fn failed(&self) -> Option<&StateError> {
        self.failed.get()
    }

    fn check(&self) -> Result<(), ImageError> {
        self.failed().map_or(Ok(()), |error| Err(error.clone().into()))
    }

    /// The right to write to the files. Once the image is closed nobody has it: they may be another one's by then.
    fn writer(&self) -> Result<RwLockReadGuard<'_, ()>, ImageError> {
        let writer = self.writing.read().unwrap_or_else(PoisonError::into_inner);
        self.check()?;
        Ok(writer)
    }

    /// Asks whether a tile is wanted, and keeps its samples if they are to be filtered later. What it says, but for
    /// [`Outcome::Filter`], holds once [`Self::flush`] has said so.
    pub fn offer(self: &Arc<Self>, tile: &SampleTile, replace: bool) -> Result<Outcome, ImageError> {
        self.check()?;
        let digest = digest(tile);
        if self.description.neighbors.is_some() {
            return self.keep(tile, digest);
        }
        let mut inner = self.write();
        match self.channels() {
            // Of two first tiles at once, one may have been quicker.
            Some(known) if known != tile.channels() => return Err(ImageError::Channels),
            Some(_) => {}
            None => {
                let channels = channels_to_json(tile.channels()).to_string().into_bytes();
                inner.queue([Change::Fact("channels", channels)], None);
                let _ = self.channels.set(tile.channels().clone());
            }
        }
        match inner.offer(tile.geometry().core(), digest, replace)? {
            Offer::Repeated => Ok(Outcome::Repeated),
            Offer::Filter(claim) => Ok(Outcome::Filter(Claimed { image: Arc::clone(self), claim: Some(claim) })),
        }
    }

    /// Puts a filtered tile on the canvas, and says what became of it. That holds once [`Self::flush`] has said so.
    pub fn add(&self, mut claimed: Claimed, filtered: &Filtered, seconds: f64) -> Result<Added, ImageError> {
        let _writer = self.writer()?;
        let Some(claim) = claimed.claim.take() else { return Err(StitchError::Mismatch(filtered.core).into()) };
        let mut inner = self.write();
        if inner.finished && inner.neighbors.is_none() {
            inner.stitcher.release(&claim);
            return Err(ImageError::Finished);
        }
        if inner.stitcher.judge(&claim)? != Verdict::Replaces {
            return self.put(&mut inner, claim, filtered, seconds);
        }
        drop(inner);
        let mut committer = self.committer();
        self.commit(&mut committer)?;
        let mut inner = self.write();
        // Others may have been quicker.
        if inner.stitcher.judge(&claim)? != Verdict::Replaces {
            return self.put(&mut inner, claim, filtered, seconds);
        }
        let [r, g, b] = &filtered.rgb;
        let core = filtered.core;
        self.folder.remove(REPLACEMENT)?;
        let beside = Canvas::create(core.width, core.height, &*self.folder, REPLACEMENT)?;
        let checksum = beside.write(Rect::new(0, 0, core.width, core.height), [r, g, b])?;
        beside.sync()?;
        self.folder.sync()?;
        let place = [core.x, core.y, core.width, core.height].iter().flat_map(|n| n.to_le_bytes()).collect();
        let record = self.record(claim.digest(), checksum, filtered, seconds);
        self.commit_now(&mut committer, &[record, Change::Fact(REPLACEMENT, place)])?;
        // From here on it is stored, and a new start would do what follows.
        inner.forget_result(&*self.folder);
        inner.replacements += 1;
        let canvas = &self.canvas;
        let added = inner.stitcher.add_with(claim, &filtered.report, || canvas.paste(core, &beside));
        let finish = added.map_err(ImageError::from).and_then(|added| Ok((added, self.canvas.sync()?)));
        let (added, ()) =
            finish.inspect_err(|error| self.fail(&mut committer, &io::Error::other(error.to_string())))?;
        inner.notes.insert(core, Note { seconds, checksum });
        self.commit_now(&mut committer, &[Change::Forget(REPLACEMENT)])?;
        self.folder.remove(REPLACEMENT)?;
        Ok(added)
    }

    fn put(&self, inner: &mut Inner, claim: Claim, filtered: &Filtered, seconds: f64) -> Result<Added, ImageError> {
        let (core, digest, mut checksum) = (filtered.core, claim.digest(), [0; 16]);
        if claim.core() != core || filtered.rgb.iter().any(|plane| plane.len() as u64 != core.area()) {
            return Err(StitchError::Mismatch(core).into());
        }
        let [r, g, b] = &filtered.rgb;
        let canvas = &self.canvas;
        let added = inner.stitcher.add_with(claim, &filtered.report, || {
            checksum = canvas.write(core, [r, g, b])?;
            Ok(())
        })?;
        if added == Added::Stored {
            let record = self.record(digest, checksum, filtered, seconds);
            inner.notes.insert(core, Note { seconds, checksum });
            inner.queue([record], None);
        }
        Ok(added)
    }

    fn record(&self, digest: Digest, checksum: Checksum, filtered: &Filtered, seconds: f64) -> Change {
        let record = TileRecord { digest, checksum, seconds, report: filtered.report.clone() };
        let record = self.channels().map_or_else(Vec::new, |channels| record.encode(channels));
        Change::Put(Records::Tiles, filtered.core, record)
    }

    /// Takes no more tiles; what waits for tiles is filtered with what there is. Durable when it returns.
    pub fn finish(&self) -> Result<(), ImageError> {
        self.check()?;
        let mut inner = self.write();
        if !inner.finished {
            inner.finished = true;
            inner.queue([Change::Fact("finished", Vec::new())], Some(After::Finished));
        }
        drop(inner);
        self.flush()
    }

    /// Waits until all that was added before is durable.
    pub fn flush(&self) -> Result<(), ImageError> {
        let wanted = self.read().queued;
        let mut committer = self.committer();
        if committer.done >= wanted { Ok(()) } else { self.commit(&mut committer) }
    }

    /// Makes all that is queued durable.
    fn commit(&self, committer: &mut Committer) -> Result<(), ImageError> {
        self.check()?;
        let (changes, after, queued, samples) = {
            let mut inner = self.write();
            let samples = inner.neighbors.as_ref().map(Neighbors::file);
            let mut changes = std::mem::take(&mut inner.changes);
            changes.extend(inner.neighbors.iter_mut().flat_map(Neighbors::forget));
            (changes, std::mem::take(&mut inner.after), inner.queued, samples)
        };
        let any = |wanted: &[Records]| {
            changes.iter().any(|change| matches!(change, Change::Put(records, ..) if wanted.contains(records)))
        };
        let sync = || {
            if any(&[Records::Tiles]) {
                self.canvas.sync()?;
            }
            if let (Some(samples), true) = (samples, any(&[Records::Samples, Records::Lent])) {
                samples.sync()?;
            }
            Ok::<_, io::Error>(())
        };
        if let Err(error) = sync() {
            self.fail(committer, &error);
            self.check()?;
        }
        if !changes.is_empty() {
            self.commit_now(committer, &changes)?;
        }
        committer.done = queued;
        if !after.is_empty() {
            let mut inner = self.write();
            after.into_iter().for_each(|after| inner.committed(after));
        }
        Ok(())
    }

    fn commit_now(&self, committer: &mut Committer, changes: &[Change]) -> Result<(), ImageError> {
        let Some(state) = &committer.state else { return self.check() };
        if let Err(error) = state.commit(changes) {
            let _ = self.failed.set(error);
            committer.state = None;
        }
        self.check()
    }

    /// Takes nothing more.
    fn fail(&self, committer: &mut Committer, error: &io::Error) {
        let (path, full) = (self.folder.path().to_owned(), crate::disk::is_full(error));
        let _ = self.failed.set(StateError::Io { path, why: error.to_string(), full });
        committer.state = None;
    }

    /// Closes the files, so that the image can be opened anew; whoever still has this one gets errors. Waits for those
    /// who are just writing.
    pub fn close(&self) {
        let mut committer = self.committer();
        if committer.state.is_some() {
            self.fail(&mut committer, &io::Error::other("the image was closed"));
        }
        drop(committer);
        drop(self.writing.write().unwrap_or_else(PoisonError::into_inner));
    }

    /// Refuses if a stored tile's pixels are not those that were stored. `stop` ends it early.
    pub fn verify(&self, stop: &AtomicBool) -> Result<(), ImageError> {
        let notes: Vec<_> = self.read().notes.iter().map(|(core, note)| (*core, note.checksum)).collect();
        for (core, checksum) in notes {
            if stop.load(Ordering::Relaxed) {
                return Err(Stopped.into());
            }
            // A tile that was just replaced has another checksum by now.
            match self.canvas.check(core, &checksum) {
                Err(error @ CanvasError::Damaged { .. }) => {
                    let inner = self.read();
                    if inner.notes.get(&core).is_some_and(|note| note.checksum == checksum) {
                        return Err(error.into());
                    }
                }
                other => other?,
            }
        }
        Ok(())
    }
}
