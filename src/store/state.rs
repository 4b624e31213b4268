//! Records of what an image has, in an embedded store (redb): small, in Rust, one file, checksums on every page, and what
//! a commit has said stays is there after any kill. Each image has a store of its own, so that a damaged one is damaged alone.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::Arc,
};

use redb::{Database, ReadableDatabase, ReadableTable, ReadableTableMetadata, StorageBackend, TableDefinition};

use crate::{
    disk::{Folder, Storage, is_full},
    filter::Rect,
};

/// Name of the file in its folder.
pub const STATE_FILE: &str = "state.redb";
/// Memory for pages of the file.
pub const CACHE: usize = 128 << 10;
/// Bytes of disk that a store takes at most without records, and for each record of up to 256 bytes: it writes beside
/// what is there, and grows in steps.
pub const STATE_BYTES: (u64, u64) = (4 << 20, 1 << 10);

type Key = (u32, u32, u32, u32);
const FACTS: TableDefinition<&str, &[u8]> = TableDefinition::new("facts");

/// A store that cannot be read or written.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StateError {
    /// The file system refused.
    #[error("{}: {why}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        why: String,
        /// Whether there is no space left.
        full: bool,
    },
    /// What is in the file is not what was written.
    #[error("{} is damaged: {why}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// How that shows.
        why: String,
    },
}

impl StateError {
    /// A stable code: `disk-full`, `state-io`, `damaged`.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Io { full: true, .. } => "disk-full",
            Self::Io { .. } => "state-io",
            Self::Damaged { .. } => "damaged",
        }
    }
}

/// One change of a commit.
#[derive(Clone, Debug)]
pub enum Change {
    /// A fact about the image, by name.
    Fact(&'static str, Vec<u8>),
    /// A fact is no more.
    Forget(&'static str),
    /// A record of a rectangle of pixels, in the place of the one that there may be.
    Put(Records, Rect, Vec<u8>),
    /// A record is no more, if there was one.
    Remove(Records, Rect),
}

/// Records of rectangles of pixels, by what they tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Records {
    /// Filtered tiles.
    Tiles,
    /// The samples of cores.
    Samples,
    /// Samples that a halo brought.
    Lent,
    /// Tiles, filtered from such samples, that are not final.
    Provisional,
}

impl Records {
    const ALL: [Self; 4] = [Self::Tiles, Self::Samples, Self::Lent, Self::Provisional];

    const fn table(self) -> TableDefinition<'static, Key, &'static [u8]> {
        TableDefinition::new(match self {
            Self::Tiles => "tiles",
            Self::Samples => "samples",
            Self::Lent => "lent",
            Self::Provisional => "provisional",
        })
    }
}

/// The store of one image.
#[derive(Debug)]
pub struct State {
    database: Database,
    path: PathBuf,
}

impl State {
    /// A new store in this folder, with these first records.
    pub fn create(folder: &dyn Folder, first: &[Change]) -> Result<Self, StateError> {
        let path = folder.path().join(STATE_FILE);
        let file = folder.create(STATE_FILE).map_err(|error| io_error(&path, &error))?;
        let state = Self::on(file, path)?;
        state.commit(first)?;
        Ok(state)
    }

    /// A store that was made before. All of it is checked.
    pub fn open(folder: &dyn Folder) -> Result<Self, StateError> {
        let path = folder.path().join(STATE_FILE);
        let damaged = |why: String| StateError::Damaged { path: path.clone(), why };
        let file = folder.open(STATE_FILE).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => damaged("it is missing".to_owned()),
            _ => io_error(&path, &error),
        })?;
        if file.len().map_err(|error| io_error(&path, &error))? == 0 {
            return Err(damaged("it is empty".to_owned()));
        }
        Self::on(file, path)
    }

    fn on(file: Arc<dyn Storage>, path: PathBuf) -> Result<Self, StateError> {
        let opened = guarded(&path, || {
            let mut builder = Database::builder();
            builder.set_cache_size(CACHE).set_check_integrity_on_open(true);
            Ok(builder.create_with_backend(Backend(file))?)
        });
        Ok(Self { database: opened?, path })
    }

    /// Makes changes durable, all or none. After an error the store must be opened anew.
    pub fn commit(&self, changes: &[Change]) -> Result<(), StateError> {
        let corners = |rect: &Rect| (rect.y, rect.x, rect.width, rect.height);
        guarded(&self.path, || {
            let transaction = self.database.begin_write()?;
            {
                let mut facts = transaction.open_table(FACTS)?;
                // All of them are there from the first commit on.
                for records in Records::ALL {
                    drop(transaction.open_table(records.table())?);
                }
                for change in changes {
                    match change {
                        Change::Fact(name, value) => drop(facts.insert(*name, &value[..])?),
                        Change::Forget(name) => drop(facts.remove(*name)?),
                        Change::Put(records, rect, value) => {
                            drop(transaction.open_table(records.table())?.insert(corners(rect), &value[..])?);
                        }
                        Change::Remove(records, rect) => {
                            drop(transaction.open_table(records.table())?.remove(corners(rect))?);
                        }
                    }
                }
            }
            Ok(transaction.commit()?)
        })
    }

    /// A fact by its name.
    pub fn fact(&self, name: &str) -> Result<Option<Vec<u8>>, StateError> {
        guarded(&self.path, || {
            let table = self.database.begin_read()?.open_table(FACTS)?;
            Ok(table.get(name)?.map(|value| value.value().to_vec()))
        })
    }

    /// How many of some records there are.
    pub fn count(&self, records: Records) -> Result<u64, StateError> {
        guarded(&self.path, || match self.database.begin_read()?.open_table(records.table()) {
            Err(redb::TableError::TableDoesNotExist(_)) => Ok(0),
            table => Ok(table?.len()?),
        })
    }

    /// Reads all of some records, by rows.
    pub fn each(&self, records: Records, mut take: impl FnMut(Rect, &[u8])) -> Result<(), StateError> {
        guarded(&self.path, || {
            let table = match self.database.begin_read()?.open_table(records.table()) {
                // An earlier version had fewer.
                Err(redb::TableError::TableDoesNotExist(_)) => return Ok(()),
                table => table?,
            };
            for entry in table.iter()? {
                let (key, value) = entry?;
                let (y, x, width, height) = key.value();
                if width == 0 || height == 0 || x.checked_add(width).is_none() || y.checked_add(height).is_none() {
                    return Err(redb::Error::Corrupted(format!("a record of no pixels: {:?}", key.value())));
                }
                take(Rect::new(x, y, width, height), value.value());
            }
            Ok(())
        })
    }

    /// An error of this store: a record that means nothing.
    pub fn damaged(&self, why: impl Into<String>) -> StateError {
        StateError::Damaged { path: self.path.clone(), why: why.into() }
    }
}

fn io_error(path: &std::path::Path, error: &io::Error) -> StateError {
    StateError::Io { path: path.to_owned(), why: error.to_string(), full: is_full(error) }
}

/// Does something with a store. redb checks what it reads, but a damaged page may make it panic.
fn guarded<T>(path: &std::path::Path, work: impl FnOnce() -> Result<T, redb::Error>) -> Result<T, StateError> {
    let damaged = |why: String| StateError::Damaged { path: path.to_owned(), why };
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(redb::Error::Io(error)))
            if matches!(error.kind(), io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof) =>
        {
            Err(damaged(error.to_string()))
        }
        Ok(Err(redb::Error::Io(error))) => Err(io_error(path, &error)),
        Ok(Err(error @ (redb::Error::PreviousIo | redb::Error::DatabaseClosed))) => {
            Err(StateError::Io { path: path.to_owned(), why: error.to_string(), full: false })
        }
        Ok(Err(error)) => Err(damaged(error.to_string())),
        Err(_) => Err(damaged("its pages contradict each other".to_owned())),
    }
}

/// A file as redb wants it.
#[derive(Debug)]
struct Backend(Arc<dyn Storage>);

impl StorageBackend for Backend {
    fn len(&self) -> io::Result<u64> {
        self.0.len()
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.0.read(offset, out)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.0.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        self.0.sync()
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.0.write(offset, data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::disk::Directory;

    fn tile(x: u32) -> Change {
        Change::Put(Records::Tiles, Rect::new(x, 7, 16, 16), vec![x as u8; 100])
    }

    fn read(state: &State) -> Vec<(u32, Vec<u8>)> {
        let mut all = Vec::new();
        state.each(Records::Tiles, |rect, value| all.push((rect.x, value.to_vec()))).unwrap();
        all
    }

    #[test]
    fn what_was_committed_is_there_again() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Directory::new(directory.path());
        let state = State::create(&folder, &[Change::Fact("a", vec![1, 2]), Change::Fact("b", vec![])]).unwrap();
        state.commit(&[tile(32), tile(0), tile(16), Change::Forget("b")]).unwrap();
        // Like a kill: nothing is closed.
        std::mem::forget(state);
        let state = State::open(&folder).unwrap();
        assert_eq!((state.fact("a").unwrap(), state.fact("b").unwrap()), (Some(vec![1, 2]), None));
        assert_eq!(read(&state), [0, 16, 32].map(|x| (x, vec![x as u8; 100])));
    }

    #[test]
    fn damage_is_found_and_names_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Directory::new(directory.path());
        let state = State::create(&folder, &[]).unwrap();
        state.commit(&(0..300).map(|i| tile(i * 16)).collect::<Vec<_>>()).unwrap();
        drop(state);
        let path = directory.path().join(STATE_FILE);
        let whole = std::fs::read(&path).unwrap();
        let mut refused = 0;
        let mut state = 5u64;
        for case in 0..60 {
            let mut bytes = whole.clone();
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let at = (state >> 20) as usize % whole.len();
            if case % 4 == 0 {
                bytes.truncate(at)
            } else {
                bytes[at] ^= 1 << (state % 8)
            }
            std::fs::write(&path, &bytes).unwrap();
            match State::open(&folder) {
                Err(error) => {
                    assert!(error.to_string().contains("state.redb"), "{error}");
                    assert_eq!(error.code(), "damaged", "{error}");
                    refused += 1;
                }
                // It was no page that is in use.
                Ok(state) => assert_eq!(read(&state).len(), 300, "case {case}: byte {at}"),
            }
        }
        assert!(refused >= 10, "{refused}");
        std::fs::write(&path, b"").unwrap();
        assert_eq!(State::open(&folder).unwrap_err().code(), "damaged");
        std::fs::remove_file(&path).unwrap();
        assert_eq!(State::open(&folder).unwrap_err().code(), "damaged");
    }
}
