//! Long answers, pictures mostly: written to a file without a name first, so that their length and their success are
//! known. Their room on the disk is that of results which nobody has read yet.

use std::{
    fs::File,
    io::{self, BufWriter, Seek, SeekFrom, Write},
    path::Path,
};

use axum::http::StatusCode;

use super::problem::Refusal;
use crate::{
    admission::Permit,
    filter::{Filtered, Rect},
    picture::write_png,
    stitch::{CanvasError, Pixels},
};

/// Bytes that are reserved at a time.
const STEP: u64 = 1 << 20;

/// A file whose bytes are reserved before they are written.
#[derive(Debug)]
pub(super) struct Charged {
    file: File,
    at: u64,
    permit: Permit,
    refused: bool,
}

impl Write for Charged {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let end = self.at + bytes.len() as u64;
        if end > self.permit.bytes() {
            let grown = self.permit.grow_to(end + STEP).or_else(|_| self.permit.grow_to(end));
            grown.map_err(|error| {
                self.refused = true;
                io::Error::new(io::ErrorKind::StorageFull, error)
            })?;
        }
        let written = self.file.write(bytes)?;
        self.at += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Charged {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.at = self.file.seek(to)?;
        Ok(self.at)
    }
}

/// Writes an answer to a file without a name in this folder. Its bytes are those of the permit, and as many more as it
/// needs: to be kept as long as the file is. Blocks.
pub(super) fn write_file(
    folder: &Path,
    permit: Permit,
    write: impl FnOnce(&mut BufWriter<Charged>) -> Result<(), Refusal>,
) -> Result<(File, Permit), Refusal> {
    let file = tempfile::tempfile_in(folder)?;
    let mut out = BufWriter::with_capacity(256 << 10, Charged { file, at: 0, permit, refused: false });
    let written = write(&mut out).and_then(|()| Ok(out.flush()?));
    let (Charged { file, mut permit, refused, .. }, _) = out.into_parts();
    if refused {
        let detail = "the answer does not fit into the disk that is left for results that nobody has read: ask again \
                      when others have read theirs";
        return Err(Refusal::new(
            StatusCode::INSUFFICIENT_STORAGE,
            "results_unread",
            "Too many results wait to be read",
            detail,
        ));
    }
    written?;
    permit.shrink_to(file.metadata()?.len());
    Ok((file, permit))
}

/// Writes pixels as a PNG, row by row.
pub(super) fn encode_png(pixels: &impl Pixels, out: &mut (impl Write + Seek)) -> Result<(), Refusal> {
    let Rect { width, height, .. } = pixels.image();
    let row = |y, row: &mut [[f32; 3]]| Ok(pixels.read(Rect::new(0, y, width, 1), row)?);
    Ok(write_png(out, width, height, row)?)
}

/// A filtered core as an image of its own.
pub(super) struct CorePixels<'a>(pub(super) &'a Filtered);

impl Pixels for CorePixels<'_> {
    fn image(&self) -> Rect {
        Rect::new(0, 0, self.0.core.width, self.0.core.height)
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        let (width, [r, g, b]) = (self.0.core.width as usize, &self.0.rgb);
        for (y, row) in (rect.y as usize..).zip(pixels.chunks_exact_mut(rect.width as usize)) {
            let start = y * width + rect.x as usize;
            (start..).zip(row).for_each(|(i, pixel)| *pixel = [r[i], g[i], b[i]]);
        }
        Ok(())
    }
}
