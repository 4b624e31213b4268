//! Pictures side by side, with a label above each.

use super::{PictureError, font, to_srgb8, write_rows};
use std::io::Write;

/// Width of the line between two panels, in pixels of the picture.
const SEPARATOR: usize = 2;
const SEPARATOR_COLOR: [u8; 3] = [255, 255, 255];
const LABEL_BACKGROUND: [u8; 3] = [24, 24, 24];
const LABEL_COLOR: [u8; 3] = [235, 235, 235];

/// One of the images that are compared.
#[derive(Clone, Copy, Debug)]
pub struct Panel<'a> {
    /// Drawn above the image in capitals, as far as it fits; what the font lacks is left blank.
    pub label: &'a str,
    /// Linear RGB, row by row.
    pub pixels: &'a [[f32; 3]],
}

/// Writes a PNG of images of equal size, side by side from left to right, with a thin line between them.
///
/// Each pixel becomes a square of `zoom` x `zoom` (0 means 1). If all labels are empty there is no band for them.
pub fn write_comparison(
    out: impl Write,
    width: u32,
    height: u32,
    panels: &[Panel<'_>],
    zoom: u32,
) -> Result<(), PictureError> {
    let expected = u64::from(width) * u64::from(height);
    if let Some(panel) = panels.iter().find(|panel| panel.pixels.len() as u64 != expected) {
        return Err(PictureError::Panel { label: panel.label.to_owned(), got: panel.pixels.len(), expected });
    }
    let zoom = zoom.max(1);
    let (across, down) = (u64::from(width) * u64::from(zoom), u64::from(height) * u64::from(zoom));
    let label = Labels::new(panels, across);
    let band = u64::from(label.height());
    let total = (across + SEPARATOR as u64) * panels.len() as u64;
    write_rows(out, total.saturating_sub(SEPARATOR as u64), down + band, |y, bytes| {
        let (row, _) = bytes.as_chunks_mut::<3>();
        let panel_rows = row.chunks_mut(across as usize + SEPARATOR);
        for (panel, row) in panels.iter().zip(panel_rows) {
            let (row, line) = row.split_at_mut(across as usize);
            line.fill(SEPARATOR_COLOR);
            if y < label.height() {
                label.draw(panel.label, y, row);
                continue;
            }
            let start = ((y - label.height()) / zoom) as usize * width as usize;
            let pixels = &panel.pixels[start..start + width as usize];
            for (square, pixel) in row.chunks_exact_mut(zoom as usize).zip(pixels) {
                square.fill(pixel.map(to_srgb8));
            }
        }
        Ok(())
    })
}

/// The band of labels.
struct Labels {
    /// Size of a dot of the font, in pixels; 0 without labels.
    dot: u32,
}

impl Labels {
    /// Dots as large as 3 pixels, if the longest label fits its panel.
    fn new(panels: &[Panel<'_>], across: u64) -> Self {
        let longest = panels.iter().map(|panel| panel.label.chars().count()).max().unwrap_or(0) as u64;
        let fits = across.checked_div((longest + 1) * u64::from(font::ADVANCE));
        Self { dot: if longest == 0 { 0 } else { fits.map_or(1, |dot| dot.clamp(1, 3)) as u32 } }
    }

    /// Four dots of air, split between above and below.
    const fn height(&self) -> u32 {
        (font::HEIGHT + 4) * self.dot
    }

    fn draw(&self, label: &str, y: u32, row: &mut [[u8; 3]]) {
        row.fill(LABEL_BACKGROUND);
        let Some(line) = (y / self.dot).checked_sub(2).filter(|&line| line < font::HEIGHT) else { return };
        let dots = label.chars().flat_map(|c| font::dots(c, line));
        let margin = (font::ADVANCE / 2 * self.dot) as usize;
        let squares = row.chunks_exact_mut(self.dot as usize).skip(margin / self.dot as usize);
        squares.zip(dots).filter(|(_, set)| *set).for_each(|(square, _)| square.fill(LABEL_COLOR));
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::decode;
    use super::*;

    #[test]
    fn panels_lie_side_by_side() {
        let (dark, bright) = ([[0.0f32; 3]; 6], [[1.0f32; 3]; 6]);
        let panels = [Panel { label: "", pixels: &dark }, Panel { label: "", pixels: &bright }];
        let mut png = Vec::new();
        write_comparison(&mut png, 3, 2, &panels, 2).unwrap();
        let (width, height, bytes) = decode(&png);
        assert_eq!((width, height), (2 * 6 + 2, 4));
        for row in bytes.chunks(14 * 3) {
            assert!(row[..18].iter().all(|&b| b == 0) && row[18..].iter().all(|&b| b == 255));
        }
    }

    #[test]
    fn labels_are_drawn_above() {
        let gray = vec![[0.18f32; 3]; 40 * 10];
        let panels = [Panel { label: "Before 8 spp", pixels: &gray }, Panel { label: "", pixels: &gray }];
        let mut png = Vec::new();
        write_comparison(&mut png, 40, 10, &panels, 2).unwrap();
        let (width, height, bytes) = decode(&png);
        assert_eq!((width, height), (162, 20 + 11));
        let band = &bytes[..162 * 3 * 11];
        let lit = |pixels: &[u8]| pixels.chunks(3).filter(|p| *p == LABEL_COLOR).count();
        let (left, right): (Vec<_>, Vec<_>) = band.chunks(162 * 3).map(|row| row.split_at(80 * 3)).unzip();
        assert!(left.iter().map(|row| lit(row)).sum::<usize>() > 50);
        assert_eq!(right.iter().map(|row| lit(row)).sum::<usize>(), 0);
        assert!(bytes[162 * 3 * 11..].chunks(3).all(|p| p == [118; 3] || p == SEPARATOR_COLOR));
    }

    #[test]
    fn sizes_must_agree() {
        let panels = [Panel { label: "a", pixels: &[[0.0; 3]; 5] }];
        assert_eq!(write_comparison(std::io::sink(), 3, 2, &panels, 1).unwrap_err().code(), "picture-size");
        assert_eq!(write_comparison(std::io::sink(), 3, 2, &[], 1).unwrap_err().code(), "picture-size");
    }
}
