//! Long answers, pictures mostly: written to a file without a name first, so that their length and their success are
//! known.

use std::{
    fs::File,
    io::{BufWriter, Seek, Write},
    path::Path,
};

use super::problem::Refusal;
use crate::{
    filter::{Filtered, Rect},
    picture::write_png,
    stitch::{CanvasError, Pixels},
};

/// Writes an answer to a file without a name in this folder. Blocks.
pub(super) fn write_file(
    folder: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), Refusal>,
) -> Result<File, Refusal> {
    let mut out = BufWriter::with_capacity(256 << 10, tempfile::tempfile_in(folder)?);
    write(&mut out)?;
    Ok(out.into_inner().map_err(std::io::IntoInnerError::into_error)?)
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
