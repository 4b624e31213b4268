//! Filters the regions of an image whose tiles lend each other their halos.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use super::{After, Claimed, Description, Image, ImageError, neighbors::Neighbors};
use crate::{
    filter::{Execution, Rect, TileGeometry, filter},
    stitch::{Offer, StitchError, Stitcher, window_digest},
    store::{Change, Records, Source},
};

/// A region that can be filtered.
#[derive(Debug)]
pub struct Job {
    region: u32,
    parts: Vec<Part>,
    /// Whether what it reads does not change any more.
    last: bool,
    /// Bytes of memory that this needs at most.
    pub bytes: u64,
    /// Pixels of the largest part.
    pub pixels: u64,
    /// Whether a part is done.
    progress: AtomicBool,
}

impl Job {
    /// Whether a part of it was filtered, and will not be again.
    pub fn has_progress(&self) -> bool {
        self.progress.load(Ordering::Relaxed)
    }
}

/// Where the time went in which a region was filtered.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spent {
    /// Reading its samples.
    pub read: Duration,
    /// Filtering.
    pub filter: Duration,
    /// Putting it on the canvas, and waiting until it is durable.
    pub write: Duration,
}

/// What of a region is to be filtered, and the samples for it.
#[derive(Debug)]
struct Part {
    geometry: TileGeometry,
    sources: Vec<Source>,
    /// Whether it is on the canvas, filtered from what may have been other samples.
    again: bool,
}

/// The parts of a region whose cores have arrived and that are not on the canvas.
pub(super) fn unfiltered(neighbors: &Neighbors, stitcher: &Stitcher, region: u32) -> Vec<Rect> {
    let present = neighbors.present(&neighbors.regions().core(region));
    present.iter().flat_map(|part| stitcher.missing_in(part)).collect()
}

impl Image {
    /// The next region that can be filtered, in tiles that take at most `most` bytes, and have at most so many pixels,
    /// each; but those that are filtered again are what they were. After [`ImageError::TooLarge`] there may be others: a
    /// region of which not even a pixel fits, or such a tile, is set aside until it is [tried again](Self::retry).
    pub fn next_job(&self, threads: usize, most: u64, pixels: u64) -> Result<Option<Job>, ImageError> {
        self.check()?;
        let mut inner = self.write();
        let inner = &mut *inner;
        let (Some(neighbors), Some(announced)) = (&mut inner.neighbors, &self.description.neighbors) else {
            return Ok(None);
        };
        // Records of tiles are set aside for eight parts of a region.
        let pixels = pixels.max(u64::from(announced.region) * u64::from(announced.region) / 8);
        while let Some(region) = neighbors.start_next() {
            let last = neighbors.regions().last(region);
            let mut job = Job { region, parts: Vec::new(), last, bytes: 0, pixels: 0, progress: false.into() };
            let mut rects: Vec<_> =
                unfiltered(neighbors, &inner.stitcher, region).into_iter().map(|rect| (rect, false)).collect();
            if last {
                let stored = neighbors.provisional(region).filter(|tile| inner.stitcher.peek(tile).is_some());
                rects.extend(stored.map(|tile| (tile, true)));
            }
            while let Some((core, again)) = rects.pop() {
                let reach = self.description.method.reach(announced.varying);
                let geometry =
                    TileGeometry::with_halo(self.description.size, core, reach).map_err(StitchError::from)?;
                let window = geometry.window();
                let sources = neighbors.sources(&window);
                // Pixels that are not there are pixels without samples.
                let there = sources.iter().filter_map(|from| from.used.intersection(&window));
                let varying = announced.varying || there.map(|part| part.area()).sum::<u64>() < window.area();
                let bytes = announced.cost(&geometry, &self.description.method, threads, varying)
                    + neighbors.file().cut_bytes(&sources);
                let whole = again || core.area() == 1;
                if bytes <= most && (core.area() <= pixels || whole) {
                    job.bytes = job.bytes.max(bytes);
                    job.pixels = job.pixels.max(core.area());
                    job.parts.push(Part { geometry, sources, again });
                } else if !whole {
                    rects.extend(halves(core).map(|half| (half, false)));
                } else {
                    neighbors.set_aside(region);
                    return Err(ImageError::TooLarge { core, needed: bytes, most });
                }
            }
            if !job.parts.is_empty() {
                neighbors.running += 1;
                return Ok(Some(job));
            }
            // It was filtered when the service ended.
            neighbors.filtered(region, last);
        }
        Ok(None)
    }

    /// Filters a region, and puts it on the canvas; durable when it returns. Parts of it that were done before it was
    /// stopped are kept. The seed is the image's, whatever the execution says, and so is what is left out.
    pub fn run(self: &Arc<Self>, job: &Job, execution: &Execution) -> Result<Spent, ImageError> {
        let mut spent = Spent::default();
        let unfinished = Unfinished { image: self, job };
        job.parts.iter().try_for_each(|part| self.filter_part(part, job, execution, &mut spent))?;
        std::mem::forget(unfinished);
        let mut inner = self.write();
        let mut final_ones = Vec::new();
        if let Some(neighbors) = &mut inner.neighbors {
            neighbors.running -= 1;
            if job.last {
                final_ones = neighbors.settle(job.region);
            }
        }
        let changes = final_ones.into_iter().map(|tile| Change::Remove(Records::Provisional, tile));
        inner.queue(changes, [After::Filtered(job.region, job.last)]);
        drop(inner);
        let began = Instant::now();
        self.flush()?;
        spent.write += began.elapsed();
        Ok(spent)
    }

    /// Regions that were set aside are among the next.
    pub fn retry(&self) {
        if let Some(neighbors) = &mut self.write().neighbors {
            neighbors.retry();
        }
    }

    /// A region that will not be filtered now.
    pub fn give_back(&self, job: &Job) {
        if let Some(neighbors) = &mut self.write().neighbors {
            neighbors.running -= 1;
            neighbors.give_back(job.region);
        }
    }

    fn filter_part(
        self: &Arc<Self>,
        part: &Part,
        job: &Job,
        execution: &Execution,
        spent: &mut Spent,
    ) -> Result<(), ImageError> {
        if execution.stopped() {
            return Err(crate::filter::Stopped.into());
        }
        let Some(file) = self.read().neighbors.as_ref().map(Neighbors::file) else { return Ok(()) };
        let (started, core) = (Instant::now(), part.geometry.core());
        let tile = file.cut(part.geometry, &part.sources)?;
        spent.read += started.elapsed();
        // What is filtered for good, and for the first time, is never compared with anything.
        let digest = if job.last && !part.again { [0; 32] } else { window_digest(&tile) };
        let claim = {
            let mut inner = self.write();
            match inner.stitcher.offer(core, digest, part.again)? {
                // What halos lent was what the cores brought, or another one was quicker.
                Offer::Repeated => return Ok(()),
                Offer::Filter(claim) => {
                    if !job.last {
                        // This is known at the latest when the tile is.
                        inner.queue([Change::Put(Records::Provisional, core, Vec::new())], []);
                        inner.neighbors.iter_mut().for_each(|neighbors| neighbors.doubt(job.region, core));
                    }
                    Claimed { image: Arc::clone(self), claim: Some(claim) }
                }
            }
        };
        let Description { seed, leave_out, .. } = self.description;
        let began = Instant::now();
        let filtered = filter(&tile, &self.description.method, &Execution { seed, leave_out, ..*execution })?;
        drop(tile);
        spent.filter += began.elapsed();
        let began = Instant::now();
        self.add(claim, &filtered, started.elapsed().as_secs_f64())?;
        spent.write += began.elapsed();
        job.progress.store(true, Ordering::Relaxed);
        Ok(())
    }
}

/// Gives a region back that is not filtered to the end, also if that panics.
struct Unfinished<'a> {
    image: &'a Image,
    job: &'a Job,
}

impl Drop for Unfinished<'_> {
    fn drop(&mut self) {
        self.image.give_back(self.job);
    }
}

/// A rectangle of more than one pixel in two, across its longer side.
fn halves(rect: Rect) -> [Rect; 2] {
    let Rect { x, y, width, height } = rect;
    if width >= height {
        let left = width / 2;
        [Rect::new(x, y, left, height), Rect::new(x + left, y, width - left, height)]
    } else {
        let top = height / 2;
        [Rect::new(x, y, width, top), Rect::new(x, y + top, width, height - top)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        disk::Directory,
        filter::{Channel, ChannelSet, Counts, Method, Plane, Role, SampleTile},
        image::{Announced, disk_bytes},
    };

    const SIZE: [u32; 2] = [32, 16];

    /// How often a region took the place of what was filtered from a halo that brought this for its neighbour's pixels.
    fn replaced(around: f32) -> u64 {
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let tile = |core: Rect, halo| {
            let geometry = TileGeometry::with_halo(SIZE, core, halo).unwrap();
            let window = geometry.window();
            let pixels = (window.y..window.bottom()).flat_map(|y| (window.x..window.right()).map(move |x| (x, y)));
            let values: Vec<f32> = pixels.map(|(x, y)| if core.contains(x, y) { 0.5 } else { around }).collect();
            let planes = vec![Plane::Values(values); 3];
            SampleTile::new(geometry, channels.clone(), Counts::Uniform(1), planes).unwrap()
        };
        let method = Method::preset("gaussian").unwrap();
        let neighbors = Some(Announced { channels: channels.clone(), samples: 1, varying: false, region: 16 });
        let mut description = Description { neighbors, ..Description::plain(SIZE, method) };
        description.disk = disk_bytes(&description);
        let folder = tempfile::tempdir().unwrap();
        Image::create(&Directory::new(folder.path()), &description).unwrap();
        let image = Arc::new(Image::open(Box::new(Directory::new(folder.path()))).unwrap());
        let mut filtered = Vec::new();
        for (core, halo) in [(Rect::new(0, 0, 16, 16), 2), (Rect::new(16, 0, 16, 16), 0)] {
            image.offer(&tile(core, halo), false).unwrap();
            image.flush().unwrap();
            while let Some(job) = image.next_job(1, u64::MAX, u64::MAX).unwrap() {
                image.run(&job, &Execution::default()).unwrap();
                filtered.push(job.region);
            }
        }
        assert_eq!((&filtered[..], image.read().complete()), (&[0, 0, 1][..], true));
        image.read().replacements()
    }

    #[test]
    fn what_halos_lent_is_filtered_again_only_if_the_cores_differ() {
        assert_eq!((replaced(0.5), replaced(0.25)), (0, 1));
    }
}
