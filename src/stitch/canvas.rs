//! The image's pixels while they are put together: linear RGB, f32, in a file.
//!
//! The file holds width x height pixels row by row, R, G, B of a pixel next to each other, as little-endian f32. It is
//! sparse: pixels that were never written take no space and read as 0. Memory use is one row of whatever is accessed.

use crate::{
    disk::{Folder, Storage, is_full},
    filter::Rect,
};
use std::{
    io,
    path::{Path, PathBuf},
    sync::Arc,
};

/// Bytes of a pixel.
const PIXEL: u64 = 12;

/// A canvas that could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CanvasError {
    /// The file system refused.
    #[error("cannot {action} the canvas in {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file, or the directory of a file without a name.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The file is not a canvas of this size.
    #[error("{} has {got} bytes, but a canvas of this size has {expected}", path.display())]
    Length {
        /// The file.
        path: PathBuf,
        /// Its length in bytes.
        got: u64,
        /// What the size of the image asks for.
        expected: u64,
    },
    /// Pixels are not those that were written.
    #[error("{} is damaged: the pixels of tile {core} are not those that were stored", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The core.
        core: Rect,
    },
    /// Nobody waits for the pixels any more.
    #[error("the work was stopped")]
    Stopped,
}

impl CanvasError {
    /// A stable code: `disk-full`, `canvas-io`, `damaged`, `stopped`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Io { source, .. } if is_full(source) => "disk-full",
            Self::Io { .. } => "canvas-io",
            Self::Length { .. } | Self::Damaged { .. } => "damaged",
            Self::Stopped => "stopped",
        }
    }
}

impl From<CanvasError> for io::Error {
    fn from(error: CanvasError) -> Self {
        let kind = if let CanvasError::Io { source, .. } = &error { source.kind() } else { io::ErrorKind::Other };
        Self::new(kind, error)
    }
}

/// Something that has linear RGB pixels to be read, rectangle by rectangle.
pub trait Pixels {
    /// The image as a rectangle at (0, 0).
    fn image(&self) -> Rect;

    /// Reads the pixels of `rect`, which lies inside the image, row by row. `pixels` has [`Rect::area`] elements.
    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError>;
}

/// What pixels hash to: 16 bytes of BLAKE3 over them as they are in the file, row by row.
pub type Checksum = [u8; 16];

/// The file. A clone is another handle of the same one.
#[derive(Clone, Debug)]
pub struct Canvas {
    image: Rect,
    file: Arc<dyn Storage>,
    path: PathBuf,
}

impl Canvas {
    /// A black canvas in a file without a name in `directory`, which is gone when the canvas or the process is.
    ///
    /// Width and height are 1 to [`MAX_SIDE`](crate::filter::geometry::MAX_SIDE).
    pub fn temporary(width: u32, height: u32, directory: &Path) -> Result<Self, CanvasError> {
        let io = |source| CanvasError::Io { action: "create", path: directory.to_owned(), source };
        let file = tempfile::tempfile_in(directory).map_err(io)?;
        Self::sized(width, height, Arc::new(file), directory)
    }

    /// A black canvas in a new file of this name, which stays. An error if the file exists.
    pub fn create(width: u32, height: u32, folder: &dyn Folder, name: &str) -> Result<Self, CanvasError> {
        let path = folder.path().join(name);
        let file = folder.create(name);
        let file = file.map_err(|source| CanvasError::Io { action: "create", path: path.clone(), source })?;
        Self::sized(width, height, file, &path)
    }

    /// A canvas that was made by [`Self::create`] before.
    pub fn open(width: u32, height: u32, folder: &dyn Folder, name: &str) -> Result<Self, CanvasError> {
        let path = folder.path().join(name);
        let io = |source| CanvasError::Io { action: "open", path: path.clone(), source };
        let image = Rect::new(0, 0, width, height);
        let expected = image.area() * PIXEL;
        let file = folder.open(name).map_err(|source| match source.kind() {
            io::ErrorKind::NotFound => CanvasError::Length { path: path.clone(), got: 0, expected },
            _ => io(source),
        })?;
        let got = file.len().map_err(io)?;
        if got != expected {
            return Err(CanvasError::Length { path, got, expected });
        }
        Ok(Self { image, file, path })
    }

    fn sized(width: u32, height: u32, file: Arc<dyn Storage>, path: &Path) -> Result<Self, CanvasError> {
        let canvas = Self { image: Rect::new(0, 0, width, height), file, path: path.to_owned() };
        canvas.file.set_len(canvas.image.area() * PIXEL).map_err(|source| canvas.io("create", source))?;
        Ok(canvas)
    }

    /// Writes the pixels of `core`, which lies inside the image: planes R, G, B, each one value a pixel, row by row.
    ///
    /// After an error some of the pixels may be written.
    pub fn write(&self, core: Rect, planes: [&[f32]; 3]) -> Result<Checksum, CanvasError> {
        debug_assert!(self.image.covers(&core) && planes.iter().all(|plane| plane.len() as u64 == core.area()));
        let width = core.width as usize;
        let mut bytes = Vec::with_capacity(width * PIXEL as usize);
        let mut hash = blake3::Hasher::new();
        for row in 0..core.height {
            bytes.clear();
            let start = row as usize * width;
            for i in start..start + width {
                planes.iter().for_each(|plane| bytes.extend_from_slice(&plane[i].to_le_bytes()));
            }
            hash.update(&bytes);
            let written = self.file.write(self.offset(core.x, core.y + row), &bytes);
            written.map_err(|source| self.io("write", source))?;
        }
        Ok(short(&hash))
    }

    /// Refuses pixels of `core` that are not those of which [`Self::write`] said this.
    pub fn check(&self, core: Rect, expected: &Checksum) -> Result<(), CanvasError> {
        let mut bytes = vec![0; core.width as usize * PIXEL as usize];
        let mut hash = blake3::Hasher::new();
        for y in core.y..core.bottom() {
            self.read_row(core.x, y, &mut bytes)?;
            hash.update(&bytes);
        }
        if short(&hash) == *expected { Ok(()) } else { Err(CanvasError::Damaged { path: self.path.clone(), core }) }
    }

    /// Copies all of a canvas onto this one, its corner at the core's. Both have room for it.
    pub fn paste(&self, core: Rect, from: &Self) -> Result<(), CanvasError> {
        let mut bytes = vec![0; core.width as usize * PIXEL as usize];
        for row in 0..core.height {
            from.read_row(0, row, &mut bytes)?;
            let written = self.file.write(self.offset(core.x, core.y + row), &bytes);
            written.map_err(|source| self.io("write", source))?;
        }
        Ok(())
    }

    fn read_row(&self, x: u32, y: u32, bytes: &mut [u8]) -> Result<(), CanvasError> {
        self.file.read(self.offset(x, y), bytes).map_err(|source| self.io("read", source))
    }

    /// Waits until everything written is on the disk.
    pub fn sync(&self) -> Result<(), CanvasError> {
        self.file.sync().map_err(|source| self.io("sync", source))
    }

    fn offset(&self, x: u32, y: u32) -> u64 {
        (u64::from(y) * u64::from(self.image.width) + u64::from(x)) * PIXEL
    }

    fn io(&self, action: &'static str, source: io::Error) -> CanvasError {
        CanvasError::Io { action, path: self.path.clone(), source }
    }
}

fn short(hash: &blake3::Hasher) -> Checksum {
    let mut checksum = [0; 16];
    checksum.copy_from_slice(&hash.finalize().as_bytes()[..16]);
    checksum
}

impl Pixels for Canvas {
    fn image(&self) -> Rect {
        self.image
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        debug_assert!(self.image.covers(&rect) && pixels.len() as u64 == rect.area());
        let mut bytes = vec![0; rect.width as usize * PIXEL as usize];
        for (y, pixels) in (rect.y..rect.bottom()).zip(pixels.chunks_exact_mut(rect.width as usize)) {
            self.read_row(rect.x, y, &mut bytes)?;
            for (value, bytes) in pixels.as_flattened_mut().iter_mut().zip(bytes.as_chunks::<4>().0) {
                *value = f32::from_le_bytes(*bytes);
            }
        }
        Ok(())
    }
}

/// Linear RGB pixels in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// width x height pixels, row by row.
    pub pixels: Vec<[f32; 3]>,
}

impl Pixels for RgbImage {
    fn image(&self) -> Rect {
        Rect::new(0, 0, self.width, self.height)
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        for (y, row) in (rect.y..rect.bottom()).zip(pixels.chunks_exact_mut(rect.width as usize)) {
            let start = self.image().index(rect.x, y);
            row.copy_from_slice(&self.pixels[start..start + row.len()]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::disk::Directory;

    #[test]
    fn keeps_what_was_written_and_is_black_elsewhere() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Directory::new(directory.path());
        let canvas = Canvas::create(7, 5, &folder, "canvas").unwrap();
        let core = Rect::new(2, 1, 3, 2);
        let plane = |c: u32| (0..6).map(|i| (i * 10 + c) as f32).collect::<Vec<_>>();
        let (r, g, b) = (plane(1), plane(2), plane(3));
        let checksum = canvas.write(core, [&r, &g, &b]).unwrap();
        canvas.sync().unwrap();
        drop(canvas);
        let canvas = Canvas::open(7, 5, &folder, "canvas").unwrap();
        canvas.check(core, &checksum).unwrap();
        let mut pixels = vec![[9.0; 3]; 35];
        canvas.read(canvas.image(), &mut pixels).unwrap();
        for y in 0..5 {
            for x in 0..7 {
                let expected = match core.contains(x, y) {
                    true => [1, 2, 3].map(|c| (core.index(x, y) * 10 + c) as f32),
                    false => [0.0; 3],
                };
                assert_eq!(pixels[(y * 7 + x) as usize], expected);
            }
        }
        let mut part = vec![[9.0; 3]; 4];
        canvas.read(Rect::new(4, 2, 2, 2), &mut part).unwrap();
        assert_eq!(part, [[51.0, 52.0, 53.0], [0.0; 3], [0.0; 3], [0.0; 3]]);
        // A single bit in it, and one beside it.
        canvas.write(Rect::new(5, 1, 1, 1), [&[1.0], &[2.0], &[3.0]]).unwrap();
        canvas.check(core, &checksum).unwrap();
        canvas.write(Rect::new(4, 2, 1, 1), [&[51.0], &[52.0], &[f32::from_bits(53.0f32.to_bits() ^ 1)]]).unwrap();
        let error = canvas.check(core, &checksum).unwrap_err();
        assert_eq!(error.code(), "damaged");
        assert!(error.to_string().contains("canvas is damaged: the pixels of tile [2, 1, 3, 2]"), "{error}");
    }

    #[test]
    fn a_temporary_canvas_leaves_no_file() {
        let directory = tempfile::tempdir().unwrap();
        let canvas = Canvas::temporary(10, 10, directory.path()).unwrap();
        canvas.write(Rect::new(0, 0, 1, 1), [&[1.0], &[2.0], &[3.0]]).unwrap();
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0);
    }

    #[test]
    fn errors_name_the_path() {
        let directory = tempfile::tempdir().unwrap();
        let missing = directory.path().join("missing");
        let error = Canvas::temporary(1, 1, &missing).unwrap_err();
        assert_eq!(error.code(), "canvas-io");
        assert!(error.to_string().contains(missing.to_str().unwrap()), "{error}");
        let folder = Directory::new(directory.path());
        drop(Canvas::create(2, 2, &folder, "canvas").unwrap());
        let error = Canvas::create(2, 2, &folder, "canvas").unwrap_err();
        assert!(error.code() == "canvas-io" && error.to_string().contains("/canvas"), "{error}");
        assert_eq!(Canvas::open(2, 3, &folder, "canvas").unwrap_err().code(), "damaged");
        // /dev/full takes no byte.
        let file = std::fs::File::options().read(true).write(true).open("/dev/full").unwrap();
        let full = Canvas { image: Rect::new(0, 0, 1, 1), file: Arc::new(file), path: "/dev/full".into() };
        assert_eq!(full.write(Rect::new(0, 0, 1, 1), [&[1.0], &[2.0], &[3.0]]).unwrap_err().code(), "disk-full");
    }
}
