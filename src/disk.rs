//! Files that must survive: what is written to them is there after a power loss once [`Storage::sync`] has returned, and
//! what is made, renamed or removed in a folder once [`Folder::sync`] has.
//!
//! Traits, so that a test can put in files that lose what was not synced.

use std::{
    fmt::Debug,
    fs::{self, File, OpenOptions},
    io,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    sync::Arc,
};

/// A file.
pub trait Storage: Debug + Send + Sync {
    /// Reads exactly so many bytes.
    fn read(&self, offset: u64, into: &mut [u8]) -> io::Result<()>;
    /// Writes all of the bytes.
    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()>;
    /// Its length in bytes.
    fn len(&self) -> io::Result<u64>;
    /// Whether it has not one byte.
    fn is_empty(&self) -> io::Result<bool> {
        Ok(self.len()? == 0)
    }
    /// Cuts it off, or makes it longer: what is new reads as 0 and takes no space.
    fn set_len(&self, len: u64) -> io::Result<()>;
    /// Waits until all that was written is on the disk.
    fn sync(&self) -> io::Result<()>;
    /// Gives the space of a range back, whose bytes mean nothing from now on. Where the file system cannot, it stays taken.
    fn release(&self, offset: u64, len: u64);
}

/// A folder of files.
pub trait Folder: Debug + Send + Sync {
    /// Where it is.
    fn path(&self) -> &Path;
    /// Makes a file. An error if there is one of this name.
    fn create(&self, name: &str) -> io::Result<Arc<dyn Storage>>;
    /// Opens a file that is there.
    fn open(&self, name: &str) -> io::Result<Arc<dyn Storage>>;
    /// Removes a file, if it is there.
    fn remove(&self, name: &str) -> io::Result<()>;
    /// Waits until what was made and removed in it is on the disk.
    fn sync(&self) -> io::Result<()>;
}

impl Storage for File {
    fn read(&self, offset: u64, into: &mut [u8]) -> io::Result<()> {
        self.read_exact_at(into, offset)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        self.write_all_at(bytes, offset)
    }

    fn len(&self) -> io::Result<u64> {
        Ok(self.metadata()?.len())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        File::set_len(self, len)
    }

    fn sync(&self) -> io::Result<()> {
        self.sync_data()
    }

    fn release(&self, offset: u64, len: u64) {
        use rustix::fs::{FallocateFlags, fallocate};
        // Whatever it answers, the bytes are of no use any more.
        let _ = fallocate(self, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, offset, len);
    }
}

/// A folder of the file system.
#[derive(Debug)]
pub struct Directory(PathBuf);

impl Directory {
    /// The folder at this path.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }
}

impl Folder for Directory {
    fn path(&self) -> &Path {
        &self.0
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(self.0.join(name))?;
        Ok(Arc::new(file))
    }

    fn open(&self, name: &str) -> io::Result<Arc<dyn Storage>> {
        let file = OpenOptions::new().read(true).write(true).open(self.0.join(name))?;
        Ok(Arc::new(file))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        match fs::remove_file(self.0.join(name)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    fn sync(&self) -> io::Result<()> {
        File::open(&self.0)?.sync_all()
    }
}

/// Makes a folder, and those above it that are not there, and waits until their names are on the disk.
pub fn make_folders(path: &Path) -> io::Result<()> {
    let missing: Vec<_> = path.ancestors().take_while(|path| !path.as_os_str().is_empty() && !path.is_dir()).collect();
    fs::create_dir_all(path)?;
    missing.into_iter().try_for_each(|made| {
        let above = made.parent().filter(|above| !above.as_os_str().is_empty());
        File::open(above.unwrap_or(Path::new(".")))?.sync_all()
    })
}

/// Whether an I/O error says that the disk, the quota or the allowed file size is used up.
pub fn is_full(error: &io::Error) -> bool {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}
