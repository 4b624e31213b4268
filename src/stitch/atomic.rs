//! Files that are either complete or not there.

use std::{
    fs::{File, Permissions},
    io::{self, BufWriter},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
};
use tempfile::TempPath;

/// A file that appears under its name only when it is committed; dropped before that it leaves nothing behind.
///
/// It is written under another name in the same directory. Making it early finds out early whether the target can be
/// written.
#[derive(Debug)]
pub struct AtomicFile {
    out: BufWriter<File>,
    temporary: TempPath,
    directory: PathBuf,
    target: PathBuf,
    given: PathBuf,
}

/// A file could not be written; what was there before is untouched.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {source}", path.display())]
pub struct AtomicError {
    /// What was tried.
    pub action: &'static str,
    /// The target.
    pub path: PathBuf,
    /// Why not.
    pub source: io::Error,
}

impl AtomicError {
    /// A stable code: `disk-full` or `output-io`.
    pub fn code(&self) -> &'static str {
        if crate::disk::is_full(&self.source) { "disk-full" } else { "output-io" }
    }
}

impl AtomicFile {
    /// Begins to write a file, new or instead of a regular one; a symbolic link to one is followed.
    ///
    /// It is made with the permissions that the process's umask leaves.
    pub fn create(path: &Path) -> Result<Self, AtomicError> {
        let fail = |action, source| AtomicError { action, path: path.to_owned(), source };
        // Renaming replaces whatever has the name: never a device, a pipe or a link.
        let target = match std::fs::metadata(path) {
            Ok(found) if !found.is_file() => {
                return Err(fail("write", io::Error::other("it exists and is no regular file")));
            }
            Ok(_) => path.canonicalize().map_err(|e| fail("write", e))?,
            Err(e) if e.kind() == io::ErrorKind::NotFound => path.to_owned(),
            Err(e) => return Err(fail("write", e)),
        };
        if target.file_name().is_none() {
            return Err(fail("write", io::Error::from(io::ErrorKind::InvalidFilename)));
        }
        let directory = match target.parent() {
            Some(parent) if parent != Path::new("") => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        let file = tempfile::Builder::new()
            .prefix(".rpfd-")
            .suffix(".tmp")
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(&directory)
            .map_err(|e| fail("write", without_name(e)))?;
        let (file, temporary) = file.into_parts();
        Ok(Self { out: BufWriter::with_capacity(1 << 18, file), temporary, directory, target, given: path.to_owned() })
    }

    /// Where to write the content.
    pub fn out(&mut self) -> &mut (impl io::Write + io::Seek) {
        &mut self.out
    }

    /// Makes the content durable and gives it its name.
    pub fn commit(self) -> Result<(), AtomicError> {
        let Self { out, temporary, directory, target, given } = self;
        let fail = |action, source| AtomicError { action, path: given, source };
        let file = match out.into_inner() {
            Ok(file) => file,
            Err(e) => return Err(fail("write", e.into_error())),
        };
        let committed = (file.sync_all())
            .and_then(|()| temporary.persist(&target).map_err(|e| without_name(e.error)))
            .and_then(|()| File::open(&directory)?.sync_all());
        committed.map_err(|source| fail("finish", source))
    }

    /// An error of this file, for one that occurred while its content was written.
    pub fn error(&self, source: io::Error) -> AtomicError {
        AtomicError { action: "write", path: self.given.clone(), source }
    }
}

/// An error as the system gave it, without the temporary name, which means nothing to anybody.
fn without_name(error: io::Error) -> io::Error {
    match error.to_string().split_once(" at path ") {
        Some((reason, _)) => io::Error::new(error.kind(), reason),
        None => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn names(directory: &Path) -> Vec<String> {
        let names = std::fs::read_dir(directory).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        names.collect()
    }

    #[test]
    fn appears_only_when_committed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a");
        std::fs::write(&path, "old").unwrap();
        let mut file = AtomicFile::create(&path).unwrap();
        file.out().write_all(b"half").unwrap();
        drop(file);
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(names(directory.path()), ["a"]);
        let mut file = AtomicFile::create(&path).unwrap();
        file.out().write_all(b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        file.commit().unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(names(directory.path()), ["a"]);
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        std::fs::write(directory.path().join("b"), "").unwrap();
        let usual = std::fs::metadata(directory.path().join("b")).unwrap().permissions().mode();
        assert_eq!(mode, usual);
    }

    #[test]
    fn replaces_no_device_directory_or_link() {
        let directory = tempfile::tempdir().unwrap();
        for path in [Path::new("/dev/null"), directory.path(), Path::new(".."), Path::new("")] {
            let error = AtomicFile::create(path).unwrap_err();
            assert_eq!(error.code(), "output-io");
        }
        let (real, link) = (directory.path().join("real"), directory.path().join("link"));
        std::fs::write(&real, "old").unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        AtomicFile::create(&link).unwrap().commit().unwrap();
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read(&real).unwrap(), b"");
    }

    #[test]
    fn a_missing_directory_is_named() {
        let error = AtomicFile::create(Path::new("/nowhere/at/all/x.exr")).unwrap_err();
        assert_eq!(error.to_string(), "cannot write /nowhere/at/all/x.exr: No such file or directory (os error 2)");
    }
}
