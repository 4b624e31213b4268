//! Images as they are found on the disk: records of any bytes in a store that is whole, and stores that are damaged.

use super::{ALLOCATIONS, alone, fuzz, mutate::Random, mutate::mutate};
use rpfd::{
    disk::{Folder, Storage},
    filter::{
        Channel, ChannelSet, Counts, Execution, Method, Plane, Rect, Role, SampleTile, TileGeometry, filter,
        geometry::tiling,
    },
    image::{Announced, Description, Image, Outcome, disk_bytes},
    store::{Change, Records, State, samples::SAMPLES_FILE, state::STATE_FILE},
};
use std::{
    collections::BTreeMap,
    io,
    panic::{catch_unwind, set_hook, take_hook},
    path::Path,
    sync::{
        Arc, Mutex, MutexGuard, Once, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

/// Bytes that a file here may have; a canvas may be longer, and reads as black beyond them.
const MOST: u64 = 4 << 20;
/// Memory that filtering a region may take.
const MEMORY: u64 = 8 << 20;
const CANVAS: &str = "canvas";
const SIZE: [u32; 2] = [40, 24];

#[derive(Debug, Default)]
struct Bytes {
    bytes: Vec<u8>,
    len: u64,
}

#[derive(Debug, Default)]
struct File(Mutex<Bytes>);

impl File {
    fn of(bytes: Vec<u8>) -> Arc<Self> {
        let len = bytes.len() as u64;
        Arc::new(Self(Bytes { bytes, len }.into()))
    }

    fn lock(&self) -> MutexGuard<'_, Bytes> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Storage for File {
    fn read(&self, offset: u64, into: &mut [u8]) -> io::Result<()> {
        let file = self.lock();
        if offset.checked_add(into.len() as u64).is_none_or(|end| end > file.len) {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        into.fill(0);
        let there = file.bytes.get(offset as usize..).unwrap_or_default();
        let n = there.len().min(into.len());
        into[..n].copy_from_slice(&there[..n]);
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let (mut file, end) = (self.lock(), offset.saturating_add(data.len() as u64));
        if end > MOST {
            return Err(io::ErrorKind::StorageFull.into());
        }
        if file.bytes.len() < end as usize {
            file.bytes.resize(end as usize, 0);
        }
        file.bytes[offset as usize..end as usize].copy_from_slice(data);
        file.len = file.len.max(end);
        Ok(())
    }

    fn len(&self) -> io::Result<u64> {
        Ok(self.lock().len)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut file = self.lock();
        file.bytes.truncate(usize::try_from(len).unwrap_or(usize::MAX));
        file.len = len;
        Ok(())
    }

    fn sync(&self) -> io::Result<()> {
        Ok(())
    }

    fn release(&self, _: u64, _: u64) {}
}

/// A folder in memory.
#[derive(Clone, Debug, Default)]
struct Memory(Arc<Mutex<BTreeMap<String, Arc<File>>>>);

impl Memory {
    fn files(&self) -> MutexGuard<'_, BTreeMap<String, Arc<File>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        self.files().get(name).map_or_else(Vec::new, |file| file.lock().bytes.clone())
    }

    fn put(&self, name: &str, bytes: Vec<u8>) {
        self.files().insert(name.to_owned(), File::of(bytes));
    }
}

impl Folder for Memory {
    fn path(&self) -> &Path {
        Path::new("/memory")
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        let file = Arc::new(File::default());
        match self.files().insert(name.to_owned(), Arc::clone(&file)) {
            None => Ok(file),
            Some(_) => Err(io::ErrorKind::AlreadyExists.into()),
        }
    }

    fn open(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        self.files().get(name).cloned().map(|file| file as _).ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        self.files().remove(name);
        Ok(())
    }

    fn sync(&self) -> io::Result<()> {
        Ok(())
    }
}

fn channels() -> ChannelSet {
    let channels = vec![Channel::new("color", Role::Color, 3), Channel::new("w", Role::Feature { position: false }, 1)];
    ChannelSet::new(channels).unwrap()
}

/// A tile of a pattern; with `wrong` another one around the core.
fn tile(core: Rect, halo: u32, wrong: bool, varying: bool) -> SampleTile {
    let geometry = TileGeometry::with_halo(SIZE, core, halo).unwrap();
    let window = geometry.window();
    let pixels = || (window.y..window.bottom()).flat_map(|y| (window.x..window.right()).map(move |x| (x, y)));
    let count = |(x, y): (u32, u32)| if varying { (x + y) % 3 } else { 2 };
    let value = |(x, y): (u32, u32), plane: u32, sample: u32| {
        let odd = u32::from(wrong && !core.contains(x, y));
        ((x * 7 + y * 13 + plane * 5 + sample * 3 + odd) % 17) as f32 / 8.0
    };
    let plane = |plane: u32| {
        let pixel = |at| (0..count(at)).map(move |sample| value(at, plane, sample));
        Plane::Values(pixels().flat_map(pixel).collect())
    };
    let counts =
        if varying { Counts::Varying(pixels().map(|at| count(at) as u16).collect()) } else { Counts::Uniform(2) };
    SampleTile::new(geometry, channels(), counts, (0..4).map(plane).collect()).unwrap()
}

fn pool() -> &'static rayon::ThreadPool {
    static POOL: std::sync::OnceLock<rayon::ThreadPool> = std::sync::OnceLock::new();
    POOL.get_or_init(|| rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap())
}

fn execution() -> Execution<'static> {
    Execution { pool: Some(pool()), ..Execution::default() }
}

/// Images at work: one to which clients bring halos, and some that keep samples.
fn examples() -> Vec<Memory> {
    let method = Method::with("gaussian", [("sigma", "1")]).unwrap();
    let mut all = Vec::new();
    for kind in 0..4 {
        let varying = kind == 3;
        let announced = Announced { channels: channels(), samples: 2, varying, region: 16 };
        let neighbors = (kind > 0).then_some(announced);
        let description = Description {
            size: SIZE,
            method: method.clone(),
            seed: 1,
            leave_out: true,
            neighbors,
            owner: None,
            disk: 0,
        };
        let description = Description { disk: disk_bytes(&description), ..description };
        let folder = Memory::default();
        Image::create(&folder, &description).unwrap();
        let image = Arc::new(Image::open(Box::new(folder.clone())).unwrap());
        for (i, core) in tiling(SIZE, 16).enumerate().filter(|(i, _)| [0, 1, 3, 5].contains(i)) {
            let tile = tile(core, [4, 0, 16, 2][(i + kind) % 4], i % 2 == 1, varying);
            if let Outcome::Filter(claim) = image.offer(&tile, false).unwrap() {
                image.add(claim, &filter(&tile, &method, &Execution::default()).unwrap(), 0.5).unwrap();
            }
        }
        image.flush().unwrap();
        if kind == 2 {
            image.finish().unwrap();
        } else {
            while let Some(job) = image.next_job(1, MEMORY, u64::MAX).unwrap() {
                image.run(&job, &execution()).unwrap();
            }
        }
        drop(image);
        all.push(folder);
    }
    all
}

/// What an input says: records of these kinds, and the file of samples.
type Script = Vec<(u8, Vec<u8>)>;

const FACTS: [&str; 4] = ["image", "channels", "finished", "replacement"];
const RECORDS: [Records; 4] = [Records::Tiles, Records::Samples, Records::Lent, Records::Provisional];
const SAMPLES: u8 = 8;

fn script(folder: &Memory) -> Script {
    let mut script = Script::new();
    let samples = folder.bytes(SAMPLES_FILE);
    let state = State::open(folder).unwrap();
    for (kind, name) in FACTS.iter().enumerate() {
        script.extend(state.fact(name).unwrap().map(|bytes| (kind as u8, bytes)));
    }
    for (kind, records) in RECORDS.into_iter().enumerate() {
        let put = |rect: Rect, value: &[u8]| {
            let corner = [rect.x, rect.y, rect.width, rect.height].into_iter().flat_map(u32::to_le_bytes);
            script.push((kind as u8 + 4, corner.chain(value.iter().copied()).collect()));
        };
        state.each(records, put).unwrap();
    }
    script.push((SAMPLES, samples));
    script
}

fn encode(script: &Script) -> Vec<u8> {
    let part = |(kind, bytes): &(u8, Vec<u8>)| [&[*kind][..], &(bytes.len() as u32).to_le_bytes(), bytes].concat();
    script.iter().flat_map(part).collect()
}

fn decode(mut bytes: &[u8]) -> Script {
    let mut script = Script::new();
    while let Some(([kind, length @ ..], rest)) = bytes.split_first_chunk::<5>() {
        let (part, rest) = rest.split_at(rest.len().min(u32::from_le_bytes(*length) as usize));
        script.push((*kind, part.to_vec()));
        bytes = rest;
    }
    script
}

/// The folder that a script describes. A head of samples that is there is one that was written: its hash is right.
fn folder(script: &Script) -> Memory {
    let folder = Memory::default();
    let samples = script.iter().rfind(|(kind, _)| *kind == SAMPLES).map_or_else(Vec::new, |(_, bytes)| bytes.clone());
    let mut changes = Vec::new();
    let mut canvas = 0;
    for (kind, bytes) in script {
        let kind = usize::from(*kind);
        if let Some(name) = FACTS.get(kind) {
            if kind == 0 {
                let value: serde_json::Value = serde_json::from_slice(bytes).unwrap_or_default();
                let side = |i: usize| value["size"][i].as_u64().unwrap_or_default();
                canvas = side(0).saturating_mul(side(1)).saturating_mul(12);
            }
            changes.push(Change::Fact(name, bytes.clone()));
        } else if let (Some(records), Some((corner, value))) = (RECORDS.get(kind - 4), bytes.split_first_chunk::<16>())
        {
            let [x, y, width, height] = [0, 4, 8, 12].map(|i| u32::from_le_bytes([0, 1, 2, 3].map(|k| corner[i + k])));
            let mut value = value.to_vec();
            let at = if *records == Records::Samples { 32 } else { 0 };
            if (5..7).contains(&kind) && value.len() >= at + 36 {
                let number = |from: usize| u64::from_le_bytes(value[from..from + 8].try_into().unwrap());
                let head = u32::from_le_bytes(value[at + 16..at + 20].try_into().unwrap());
                let (from, to) = (number(at), number(at).saturating_add(head.into()));
                if let Some(head) = samples.get(from as usize..to as usize) {
                    value[at + 20..at + 36].copy_from_slice(&blake3::hash(head).as_bytes()[..16]);
                }
            }
            changes.push(Change::Put(*records, Rect::new(x, y, width, height), value));
        }
    }
    State::create(&folder, &changes).unwrap();
    folder.put(SAMPLES_FILE, samples);
    folder.put(CANVAS, Vec::new());
    folder.files()[CANVAS].set_len(canvas).unwrap();
    folder
}

/// Panics that were caught on the way; they are counted, and not printed, while somebody looks.
static PANICS: AtomicU64 = AtomicU64::new(0);
static QUIET: AtomicBool = AtomicBool::new(false);
static LAST: Mutex<String> = Mutex::new(String::new());

fn last_panic() -> String {
    LAST.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

fn count_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = take_hook();
        set_hook(Box::new(move |panic| {
            if QUIET.load(Ordering::SeqCst) {
                PANICS.fetch_add(1, Ordering::SeqCst);
                *LAST.lock().unwrap_or_else(PoisonError::into_inner) = panic.to_string();
            } else {
                before(panic);
            }
        }));
    });
}

/// Opens an image, and does with it what a service does: it is as good as any, or refused with a reason.
fn open(folder: &Memory) -> &'static str {
    let image = match Image::open(Box::new(folder.clone())) {
        Ok(image) => Arc::new(image),
        Err(error) => {
            assert!(error.is_damage(), "{error}");
            return "refused";
        }
    };
    let inner = image.read();
    let (missing, totals) = (inner.stitcher().missing(), inner.stitcher().totals());
    let pixels: u64 = missing.iter().map(Rect::area).sum();
    assert_eq!(pixels + totals.pixels, inner.stitcher().image().area());
    if let Some(regions) = inner.regions() {
        (0..regions.count().min(64)).for_each(|region| drop(inner.awaited(region)));
    }
    drop(inner);
    // Its canvas may be too large to be read here.
    if pixels + totals.pixels < 1 << 16
        && let Err(error) = image.verify(&AtomicBool::new(false))
    {
        assert!(error.is_damage(), "{error}");
    }
    for _ in 0..16 {
        match image.next_job(1, MEMORY, u64::MAX) {
            Ok(Some(job)) => {
                assert!(job.bytes <= MEMORY);
                if let Err(error) = image.run(&job, &execution()) {
                    assert!(!error.to_string().is_empty());
                    return "an image with damaged samples";
                }
            }
            Ok(None) => break,
            Err(error) => {
                assert!(!error.to_string().is_empty());
                return "an image too large to filter";
            }
        }
    }
    let open = image.read().regions().map_or(0, |regions| regions.open());
    image.flush().unwrap();
    drop(image);
    // As it is it can be opened again, and nothing of it is lost.
    let image = Image::open(Box::new(folder.clone())).unwrap();
    assert!(image.read().regions().map_or(0, |regions| regions.open()) <= open);
    "an image"
}

/// What redb may ask for, and not write to, before it refuses a store whose header says so: a page as large as pages get.
const LARGEST_PAGE: u64 = 4 << 30;

/// The same, and what it takes; so much more, if it is refused.
fn measured(folder: &Memory, input: usize, refused: u64) -> &'static str {
    let before = ALLOCATIONS.current_usage() as u64;
    ALLOCATIONS.reset_peak_usage();
    let reached = open(folder);
    let peak = (ALLOCATIONS.peak_usage() as u64).saturating_sub(before);
    // Files are in memory here; an image has so many regions at most, some bytes each.
    let most = 3 * MOST + MEMORY + (64 << 17) + 64 * input as u64 + if reached == "refused" { refused } else { 0 };
    assert!(peak <= most, "{peak} bytes for an input of {input}");
    reached
}

/// The same, and how many panics were caught on the way.
fn watched(folder: &Memory, input: usize, refused: u64) -> (&'static str, u64) {
    let before = PANICS.load(Ordering::SeqCst);
    QUIET.store(true, Ordering::SeqCst);
    // On the pool's own thread nothing waits for it.
    let reached = catch_unwind(|| pool().install(|| measured(folder, input, refused)));
    QUIET.store(false, Ordering::SeqCst);
    (reached.unwrap_or_else(|_| panic!("{}", last_panic())), PANICS.load(Ordering::SeqCst) - before)
}

const WORDS: &[&[u8]] = &[
    b"1048576",
    b"4294967295",
    b"18446744073709551615",
    b"-1",
    b"0",
    b"1",
    b"null",
    b"true",
    b"\"",
    b"\"lean\"",
    b"\"region\":1",
    b"{",
    b"[]",
    b"\"gaussian\"",
    b"\0\0\0\0",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\x10\0\0\0\0\0\0",
];

#[test]
fn records() {
    let alone = alone();
    count_panics();
    let examples: Vec<Script> = examples().iter().map(script).collect();
    let others: Vec<Vec<u8>> = examples.iter().flatten().map(|(_, bytes)| bytes.clone()).collect();
    let make = |random: &mut Random| {
        let mut script = random.pick(&examples).clone();
        for _ in 0..[1, 1, 2, 4][random.below(4)] {
            let at = random.below(script.len());
            match random.below(8) {
                0 => drop(script.remove(at)),
                1 => script.push((random.below(10) as u8, random.pick(&others).clone())),
                2 => {
                    let (place, other) = (random.below(16), random.pick(&others).clone());
                    // What stands in another's place, or one's own with another corner.
                    let bytes = &mut script[at].1;
                    let n = bytes.len().min(other.len()).min(place + 1);
                    bytes[..n].copy_from_slice(&other[..n]);
                }
                _ => mutate(&mut script[at].1, random, &others, WORDS),
            }
            if script.is_empty() {
                break;
            }
        }
        encode(&script)
    };
    let reached = fuzz(&alone, "records", 20, make, |bytes, _| {
        let (reached, panics) = watched(&folder(&decode(bytes)), bytes.len(), 0);
        // Not one that the store has caught either: its file is whole.
        assert_eq!(panics, 0, "{}", last_panic());
        reached
    });
    assert!(reached["an image"] > 0 && reached["refused"] > 0, "{reached:?}");
}

/// An input is an example, and changes of its store: what, where, and with which bytes.
#[test]
fn stores() {
    let alone = alone();
    count_panics();
    let examples = examples();
    let files: Vec<(Vec<u8>, Vec<usize>)> = examples
        .iter()
        .map(|folder| {
            let bytes = folder.bytes(STATE_FILE);
            let blocks = (0..bytes.len() / 64).filter(|i| bytes[64 * i..64 * (i + 1)].iter().any(|&byte| byte != 0));
            let blocks = blocks.collect();
            (bytes, blocks)
        })
        .collect();
    let make = |random: &mut Random| {
        let changes = [1, 1, 2, 4, 16][random.below(5)];
        let example = random.next() as u8;
        let bytes = (0..changes).flat_map(|_| {
            let mut change = random.next().to_le_bytes();
            // The first pages say where all others are.
            if random.one_in(3) {
                change[1..4].copy_from_slice(&[random.below(8) as u8, 0, 0]);
            }
            change
        });
        [example].into_iter().chain(bytes).collect()
    };
    let reached = fuzz(&alone, "state", 40, make, |bytes, _| {
        let Some((&example, changes)) = bytes.split_first() else { return "no input" };
        let example = usize::from(example) % examples.len();
        let (mut state, blocks) = files[example].clone();
        for &[what, a, b, c, within, value, more, size] in changes.as_chunks::<8>().0 {
            let block = blocks[u32::from_le_bytes([a, b, c, 0]) as usize % blocks.len()];
            let at = (64 * block + usize::from(within % 64)).min(state.len().saturating_sub(1));
            if state.is_empty() {
                break;
            }
            match what % 8 {
                0 => state.truncate(at),
                1 => {
                    state.resize((state.len() + 997 * usize::from(value) * usize::from(more)).min(MOST as usize), more)
                }
                2 => {
                    let end = (at + usize::from(size)).min(state.len());
                    state[at..end].fill(more);
                }
                3 => {
                    // Another page in its place.
                    let from = blocks[usize::from(value) % blocks.len()] / 64 * 4096;
                    let (from, to) = (from.min(state.len()), (at / 4096 * 4096).min(state.len()));
                    let n = 4096.min(state.len() - from).min(state.len() - to);
                    state.copy_within(from..from + n, to);
                }
                4 => state[at] = value,
                _ => state[at] ^= 1 << (value % 8),
            }
        }
        let folder = Memory::default();
        let source = &examples[example];
        folder.put(SAMPLES_FILE, source.bytes(SAMPLES_FILE));
        folder.put(CANVAS, source.bytes(CANVAS));
        folder.files()[CANVAS].set_len(12 * u64::from(SIZE[0] * SIZE[1])).unwrap();
        let same = state == files[example].0;
        folder.put(STATE_FILE, state);
        let (reached, _) = watched(&folder, 1 << 16, LARGEST_PAGE);
        assert!(!same || reached == "an image");
        reached
    });
    assert!(reached["an image"] > 0 && reached["refused"] > 0, "{reached:?}");
}
