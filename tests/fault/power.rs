//! Power losses: a file system that forgets what was not synced, in any order and in parts.

use super::{Random, rounds};
use crate::service::{contradicting, samples};
use rpfd::{
    disk::{Folder, Storage},
    filter::{Execution, Method, Rect, SampleTile, filter, geometry::tiling},
    image::{Announced, Description, Image, Outcome, RegionState, disk_bytes},
    stitch::Pixels,
};
use std::{
    collections::{BTreeMap, HashMap},
    io,
    path::Path,
    sync::{Arc, Mutex, atomic::AtomicBool},
};

/// Disks write sectors whole.
const SECTOR: usize = 512;

/// What was asked of a file since the last sync.
#[derive(Clone, Debug)]
enum Op {
    Write(u64, Vec<u8>),
    SetLen(u64),
}

impl Op {
    fn apply(&self, bytes: &mut Vec<u8>) {
        match self {
            Self::Write(offset, data) => {
                let (start, end) = (*offset as usize, *offset as usize + data.len());
                if bytes.len() < end {
                    bytes.resize(end, 0);
                }
                bytes[start..end].copy_from_slice(data);
            }
            Self::SetLen(len) => bytes.resize(*len as usize, 0),
        }
    }
}

#[derive(Clone, Debug, Default)]
struct Content {
    now: Vec<u8>,
    durable: Vec<u8>,
    unsynced: Vec<Op>,
}

#[derive(Debug, Default)]
struct Memory {
    files: Vec<Content>,
    /// Files by name, as they are and as they would be after a power loss.
    now: BTreeMap<String, usize>,
    durable: BTreeMap<String, usize>,
    /// Calls until the power fails.
    left: Option<u64>,
}

/// A folder in memory.
#[derive(Clone, Debug, Default)]
struct Lossy(Arc<Mutex<Memory>>);

#[derive(Debug)]
struct LossyFile {
    memory: Lossy,
    index: usize,
}

impl Lossy {
    /// Does something, unless the power has failed.
    fn with<T>(&self, work: impl FnOnce(&mut Memory) -> io::Result<T>) -> io::Result<T> {
        let mut memory = self.0.lock().unwrap();
        match &mut memory.left {
            Some(0) => return Err(io::Error::other("the power has failed")),
            Some(left) => *left -= 1,
            None => {}
        }
        work(&mut memory)
    }

    /// The power fails after so many calls.
    fn fail_after(&self, calls: u64) {
        self.0.lock().unwrap().left = Some(calls);
    }

    /// It has not failed, and will not.
    fn spare(&self) {
        self.0.lock().unwrap().left = None;
    }

    fn failed(&self) -> bool {
        self.0.lock().unwrap().left == Some(0)
    }

    /// What is there after the power loss: of what was not synced, any sectors of any writes.
    fn after(&self, random: &mut Random) -> Self {
        let memory = self.0.lock().unwrap();
        let mut after = Memory::default();
        // Names that were not synced may be there, or not.
        let mut names = memory.durable.clone();
        for (name, index) in &memory.now {
            if random.below(2) == 0 {
                names.insert(name.clone(), *index);
            }
        }
        names.retain(|name, _| memory.now.contains_key(name) || random.below(2) == 0);
        for (name, index) in names {
            let file = &memory.files[index];
            let mut bytes = file.durable.clone();
            for op in &file.unsynced {
                match op {
                    Op::Write(offset, data) => {
                        let mut at = 0;
                        while at < data.len() {
                            let next = (SECTOR - (*offset as usize + at) % SECTOR).min(data.len() - at);
                            if random.below(2) == 0 {
                                Op::Write(offset + at as u64, data[at..at + next].to_vec()).apply(&mut bytes);
                            }
                            at += next;
                        }
                    }
                    Op::SetLen(_) if random.below(2) == 0 => op.apply(&mut bytes),
                    Op::SetLen(_) => {}
                }
            }
            let index = after.files.len();
            after.files.push(Content { now: bytes.clone(), durable: bytes, unsynced: Vec::new() });
            after.now.insert(name.clone(), index);
            after.durable.insert(name, index);
        }
        Self(Arc::new(Mutex::new(after)))
    }
}

impl Storage for LossyFile {
    fn read(&self, offset: u64, into: &mut [u8]) -> io::Result<()> {
        self.memory.with(|memory| {
            let from = memory.files[self.index].now.get(offset as usize..offset as usize + into.len());
            into.copy_from_slice(from.ok_or(io::ErrorKind::UnexpectedEof)?);
            Ok(())
        })
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        self.change(Op::Write(offset, bytes.to_vec()))
    }

    fn len(&self) -> io::Result<u64> {
        self.memory.with(|memory| Ok(memory.files[self.index].now.len() as u64))
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.change(Op::SetLen(len))
    }

    fn sync(&self) -> io::Result<()> {
        self.memory.with(|memory| {
            let file = &mut memory.files[self.index];
            file.durable.clone_from(&file.now);
            file.unsynced.clear();
            Ok(())
        })
    }

    /// Worse than nothing: the bytes are lost at once, for good.
    fn release(&self, offset: u64, len: u64) {
        let _ = self.memory.with(|memory| {
            let Content { now, durable, .. } = &mut memory.files[self.index];
            for bytes in [now, durable] {
                let range = (offset as usize).min(bytes.len())..((offset + len) as usize).min(bytes.len());
                bytes[range].fill(0xa5);
            }
            Ok(())
        });
    }
}

impl LossyFile {
    fn change(&self, op: Op) -> io::Result<()> {
        self.memory.with(|memory| {
            let file = &mut memory.files[self.index];
            op.apply(&mut file.now);
            file.unsynced.push(op);
            Ok(())
        })
    }
}

impl Folder for Lossy {
    fn path(&self) -> &Path {
        Path::new("/memory")
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        let index = self.with(|memory| {
            if memory.now.contains_key(name) {
                return Err(io::ErrorKind::AlreadyExists.into());
            }
            memory.files.push(Content::default());
            memory.now.insert(name.to_owned(), memory.files.len() - 1);
            Ok(memory.files.len() - 1)
        })?;
        Ok(Arc::new(LossyFile { memory: self.clone(), index }))
    }

    fn open(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        let index = self.with(|memory| Ok(*memory.now.get(name).ok_or(io::ErrorKind::NotFound)?))?;
        Ok(Arc::new(LossyFile { memory: self.clone(), index }))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.with(|memory| {
            memory.now.remove(name);
            Ok(())
        })
    }

    fn sync(&self) -> io::Result<()> {
        self.with(|memory| {
            memory.durable = memory.now.clone();
            Ok(())
        })
    }
}

const SIZE: [u32; 2] = [48, 40];

fn description(method: &Method, neighbors: Option<Announced>) -> Description {
    let description =
        Description { size: SIZE, method: method.clone(), seed: 5, leave_out: true, neighbors, owner: None, disk: 0 };
    Description { disk: disk_bytes(&description), ..description }
}

fn filtered(tile: &SampleTile, method: &Method) -> rpfd::filter::Filtered {
    filter(tile, method, &Execution { seed: 5, ..Execution::default() }).unwrap()
}

fn pixels(image: &Image, rect: Rect) -> Vec<[f32; 3]> {
    let mut pixels = vec![[0.0; 3]; rect.area() as usize];
    image.read().stitcher().pixels().read(rect, &mut pixels).unwrap();
    pixels
}

fn rgb(filtered: &rpfd::filter::Filtered) -> Vec<[f32; 3]> {
    let [r, g, b] = &filtered.rgb;
    r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect()
}

/// Tiles come, are repeated and replaced; the power fails; what was acknowledged is there, and all else is whole or not
/// there.
#[test]
fn tiles_and_replacements_survive_a_power_loss() {
    let method = Method::preset("unfiltered").unwrap();
    let cores: Vec<Rect> = tiling(SIZE, 16).collect();
    let versions: Vec<Vec<SampleTile>> =
        [1, 2, 3].map(|seed| cores.iter().map(|&core| samples(SIZE, core, 0, seed)).collect()).into();
    let results: Vec<Vec<_>> =
        versions.iter().map(|tiles| tiles.iter().map(|tile| filtered(tile, &method)).collect()).collect();
    let (mut losses, mut replacements) = (0, 0);
    for seed in rounds(60) {
        let mut random = Random::new(seed);
        let mut disk = Lossy::default();
        Image::create(&disk, &description(&method, None)).unwrap();
        // By core: the version that was acknowledged, and those that came later, one of which may be there instead.
        let mut known: HashMap<Rect, (usize, Vec<usize>)> = HashMap::new();
        for _ in 0..6 {
            disk.fail_after(random.below(300));
            let image = match Image::open(Box::new(disk.clone())) {
                Ok(image) => Arc::new(image),
                Err(error) => {
                    assert!(disk.failed(), "seed {seed}: {error}");
                    disk = disk.after(&mut random);
                    continue;
                }
            };
            while !disk.failed() {
                let (i, version) = (random.below(cores.len() as u64) as usize, random.below(3) as usize);
                let replace = random.below(3) == 0;
                let (tile, core) = (&versions[version][i], cores[i]);
                let before = known.get(&core).map(|entry| entry.0);
                let Ok(offered) = image.offer(tile, replace) else { continue };
                if let Outcome::Filter(claim) = offered {
                    known.entry(core).or_insert((usize::MAX, Vec::new())).1.push(version);
                    let Ok(_) = image.add(claim, &results[version][i], 0.1) else { break };
                }
                // Several at a time, as they would come over several connections.
                if random.below(3) > 0 && image.flush().is_ok() {
                    let now = image.read().stitcher().tiles().map(|(core, _)| core).collect::<Vec<_>>();
                    for core in now {
                        let entry = known.get_mut(&core).unwrap();
                        if let Some(version) = entry.1.pop() {
                            *entry = (version, Vec::new());
                        }
                    }
                    replacements += u64::from(before.is_some_and(|before| before < 3 && before != version) && replace);
                }
            }
            losses += 1;
            drop(image);
            disk = disk.after(&mut random);
            let image = Image::open(Box::new(disk.clone())).unwrap_or_else(|error| panic!("seed {seed}: {error}"));
            image.verify(&AtomicBool::new(false)).unwrap();
            for (i, core) in cores.iter().enumerate() {
                let there = image.read().stitcher().missing_in(core).is_empty();
                let Some((acknowledged, others)) = known.get(core).cloned() else {
                    assert!(!there, "seed {seed}: {core} never came");
                    continue;
                };
                if !there {
                    assert_eq!(acknowledged, usize::MAX, "seed {seed}: {core} was acknowledged and is lost");
                    known.remove(core);
                    continue;
                }
                let got = pixels(&image, *core);
                let is = |version: usize| version < 3 && got == rgb(&results[version][i]);
                let found = others.into_iter().chain([acknowledged]).find(|&version| is(version));
                let found = found.unwrap_or_else(|| panic!("seed {seed}: {core} is neither of what it can be"));
                known.insert(*core, (found, Vec::new()));
            }
        }
    }
    println!("{losses} power losses, {replacements} replacements");
    assert!(losses > 0);
}

/// Bare cores come, regions are filtered, samples dropped; the power fails; in the end it is the whole image.
#[test]
fn samples_survive_a_power_loss() {
    let bare = |core| vec![samples(SIZE, core, 0, 1)];
    assert_eq!(lose_samples(40, bare), 0);
}

/// The same with tiles some of which bring a halo, some of these with other samples than the cores that they lie in.
#[test]
fn halos_survive_a_power_loss_and_cores_have_the_last_word() {
    let reach = Method::preset("gaussian").unwrap().reach(false);
    let all_kinds = |core| {
        let right = [0, 3, reach, 16].map(|halo| samples(SIZE, core, halo, 1));
        right.into_iter().chain([reach, 16].map(|halo| contradicting(SIZE, core, halo))).collect()
    };
    assert!(lose_samples(40, all_kinds) > 0);
}

/// Says how often a region was seen that was filtered with lent pixels.
fn lose_samples(few: u64, kinds: impl Fn(Rect) -> Vec<SampleTile>) -> usize {
    let method = Method::preset("gaussian").unwrap();
    let whole = samples(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0, 1);
    let expected = rgb(&filtered(&whole, &method));
    let cores: Vec<Rect> = tiling(SIZE, 16).collect();
    let tiles: Vec<Vec<SampleTile>> = cores.iter().map(|&core| kinds(core)).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let execution = Execution { pool: Some(&pool), ..Execution::default() };
    let (mut losses, mut provisional) = (0, 0);
    for seed in rounds(few) {
        let mut random = Random::new(seed);
        let mut disk = Lossy::default();
        let announced = Announced { channels: whole.channels().clone(), samples: 4, varying: false, region: 16 };
        Image::create(&disk, &description(&method, Some(announced))).unwrap();
        let mut acknowledged = vec![false; cores.len()];
        for attempt in 0.. {
            assert!(attempt < 500, "seed {seed}: it comes to no end");
            disk.fail_after(random.below(1500));
            let Ok(image) = Image::open(Box::new(disk.clone())).map(Arc::new) else {
                assert!(disk.failed(), "seed {seed}");
                disk = disk.after(&mut random);
                continue;
            };
            let absent = image.read().absent(&Rect::new(0, 0, SIZE[0], SIZE[1]));
            for (core, acknowledged) in cores.iter().zip(&acknowledged) {
                let lost = absent.iter().any(|gap| gap.intersection(core).is_some());
                assert!(!acknowledged || !lost, "seed {seed}: {core} was acknowledged and is lost");
            }
            let mut order: Vec<usize> = (0..cores.len()).collect();
            crate::stitch::shuffle(&mut order, random.below(1 << 30));
            let mut waiting = Vec::new();
            for i in order {
                let tile = &tiles[i][random.below(tiles[i].len() as u64) as usize];
                let Ok(outcome) = image.offer(tile, false) else { break };
                assert!(!matches!(outcome, Outcome::Filter(_)));
                waiting.push(i);
                if random.below(2) == 0 && image.flush().is_ok() {
                    waiting.drain(..).for_each(|i| acknowledged[i] = true);
                }
                while let Ok(Some(job)) = image.next_job(1, u64::MAX, u64::MAX) {
                    if image.run(&job, &execution).is_err() {
                        break;
                    }
                }
                let inner = image.read();
                let regions = inner.regions().unwrap();
                let lent = |&index: &u32| regions.state(index) == RegionState::Filtered;
                provisional += (0..regions.count()).filter(lent).count();
            }
            if image.flush().is_ok() {
                while let Ok(Some(job)) = image.next_job(1, u64::MAX, u64::MAX) {
                    let _ = image.run(&job, &execution);
                    if disk.failed() {
                        break;
                    }
                }
            }
            if !disk.failed() && image.read().complete() {
                disk.spare();
                assert_eq!(pixels(&image, Rect::new(0, 0, SIZE[0], SIZE[1])), expected, "seed {seed}");
                image.verify(&AtomicBool::new(false)).unwrap();
                break;
            }
            losses += 1;
            drop(image);
            disk = disk.after(&mut random);
        }
    }
    println!("{losses} power losses, {provisional} regions seen that were filtered with lent pixels");
    assert!(losses > 0);
    provisional
}
