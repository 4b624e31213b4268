//! The image's pixels while they are put together: linear RGB, f32, in a file.
//!
//! The file holds width x height pixels row by row, R, G, B of a pixel next to each other, as little-endian f32. It is
//! sparse: pixels that were never written take no space and read as 0. Memory use is one row of whatever is accessed.

use crate::filter::Rect;
use std::{
    fs::{File, OpenOptions},
    io,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
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
}

impl CanvasError {
    /// A stable code: `disk-full`, `canvas-io`, `canvas-length`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Io { source, .. } if is_full(source) => "disk-full",
            Self::Io { .. } => "canvas-io",
            Self::Length { .. } => "canvas-length",
        }
    }
}

impl From<CanvasError> for io::Error {
    fn from(error: CanvasError) -> Self {
        Self::other(error)
    }
}

/// Whether an I/O error says that the disk, the quota or the allowed file size is used up.
pub(crate) fn is_full(error: &io::Error) -> bool {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}

/// Something that has linear RGB pixels to be read, rectangle by rectangle.
pub trait Pixels {
    /// The image as a rectangle at (0, 0).
    fn image(&self) -> Rect;

    /// Reads the pixels of `rect`, which lies inside the image, row by row. `pixels` has [`Rect::area`] elements.
    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError>;
}

/// The file.
#[derive(Debug)]
pub struct Canvas {
    image: Rect,
    file: File,
    path: PathBuf,
}

impl Canvas {
    /// A black canvas in a file without a name in `directory`, which is gone when the canvas or the process is.
    ///
    /// Width and height are 1 to [`MAX_SIDE`](crate::filter::geometry::MAX_SIDE).
    pub fn temporary(width: u32, height: u32, directory: &Path) -> Result<Self, CanvasError> {
        let file = tempfile::tempfile_in(directory);
        Self::sized(width, height, file, directory)
    }

    /// A black canvas in a new file, which stays. An error if the file exists.
    pub fn create(width: u32, height: u32, path: &Path) -> Result<Self, CanvasError> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(path);
        Self::sized(width, height, file, path)
    }

    /// A canvas that was made by [`Self::create`] before.
    pub fn open(width: u32, height: u32, path: &Path) -> Result<Self, CanvasError> {
        let io = |source| CanvasError::Io { action: "open", path: path.to_owned(), source };
        let file = OpenOptions::new().read(true).write(true).open(path).map_err(io)?;
        let (got, image) = (file.metadata().map_err(io)?.len(), Rect::new(0, 0, width, height));
        let expected = image.area() * PIXEL;
        if got != expected {
            return Err(CanvasError::Length { path: path.to_owned(), got, expected });
        }
        Ok(Self { image, file, path: path.to_owned() })
    }

    fn sized(width: u32, height: u32, file: io::Result<File>, path: &Path) -> Result<Self, CanvasError> {
        let io = |source| CanvasError::Io { action: "create", path: path.to_owned(), source };
        let canvas = Self { image: Rect::new(0, 0, width, height), file: file.map_err(io)?, path: path.to_owned() };
        canvas.file.set_len(canvas.image.area() * PIXEL).map_err(io)?;
        Ok(canvas)
    }

    /// Writes the pixels of `core`, which lies inside the image: planes R, G, B, each one value a pixel, row by row.
    ///
    /// After an error some of the pixels may be written.
    pub fn write(&self, core: Rect, planes: [&[f32]; 3]) -> Result<(), CanvasError> {
        debug_assert!(self.image.covers(&core) && planes.iter().all(|plane| plane.len() as u64 == core.area()));
        let width = core.width as usize;
        let mut bytes = Vec::with_capacity(width * PIXEL as usize);
        for row in 0..core.height {
            bytes.clear();
            let start = row as usize * width;
            for i in start..start + width {
                planes.iter().for_each(|plane| bytes.extend_from_slice(&plane[i].to_le_bytes()));
            }
            let written = self.file.write_all_at(&bytes, self.offset(core.x, core.y + row));
            written.map_err(|source| self.io("write", source))?;
        }
        Ok(())
    }

    /// Waits until everything written is on the disk.
    pub fn sync(&self) -> Result<(), CanvasError> {
        self.file.sync_data().map_err(|source| self.io("sync", source))
    }

    fn offset(&self, x: u32, y: u32) -> u64 {
        (u64::from(y) * u64::from(self.image.width) + u64::from(x)) * PIXEL
    }

    fn io(&self, action: &'static str, source: io::Error) -> CanvasError {
        CanvasError::Io { action, path: self.path.clone(), source }
    }
}

impl Pixels for Canvas {
    fn image(&self) -> Rect {
        self.image
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        debug_assert!(self.image.covers(&rect) && pixels.len() as u64 == rect.area());
        let mut bytes = vec![0; rect.width as usize * PIXEL as usize];
        for (y, pixels) in (rect.y..rect.bottom()).zip(pixels.chunks_exact_mut(rect.width as usize)) {
            let read = self.file.read_exact_at(&mut bytes, self.offset(rect.x, y));
            read.map_err(|source| self.io("read", source))?;
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

    #[test]
    fn keeps_what_was_written_and_is_black_elsewhere() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("canvas");
        let canvas = Canvas::create(7, 5, &path).unwrap();
        let core = Rect::new(2, 1, 3, 2);
        let plane = |c: u32| (0..6).map(|i| (i * 10 + c) as f32).collect::<Vec<_>>();
        let (r, g, b) = (plane(1), plane(2), plane(3));
        canvas.write(core, [&r, &g, &b]).unwrap();
        canvas.sync().unwrap();
        drop(canvas);
        let canvas = Canvas::open(7, 5, &path).unwrap();
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
        let path = directory.path().join("canvas");
        drop(Canvas::create(2, 2, &path).unwrap());
        assert_eq!(Canvas::create(2, 2, &path).unwrap_err().code(), "canvas-io");
        assert_eq!(Canvas::open(2, 3, &path).unwrap_err().code(), "canvas-length");
        // /dev/full takes no byte.
        let full = Canvas {
            image: Rect::new(0, 0, 1, 1),
            file: File::options().read(true).write(true).open("/dev/full").unwrap(),
            path,
        };
        assert_eq!(full.write(Rect::new(0, 0, 1, 1), [&[1.0], &[2.0], &[3.0]]).unwrap_err().code(), "disk-full");
    }
}
