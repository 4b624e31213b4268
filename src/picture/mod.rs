//! PNG pictures of linear images, to look at: exposure 0, sRGB transfer, clipped to 0..1, 8 bits.
//!
//! Rows are asked for one at a time, so an image of any size takes the memory of a row. The same pixels give the same
//! bytes. What cannot be shown is shown as the nearest that can: negative values and NaN black, infinity white.

mod compare;
mod font;

pub use compare::{Panel, write_comparison};

use std::{
    io::{self, Write},
    sync::LazyLock,
};

/// A picture that could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PictureError {
    /// The picture would be empty, or larger than PNG allows.
    #[error("a picture of {0} x {1} pixels: width and height must be 1 to {max}", max = i32::MAX)]
    Size(u64, u64),
    /// A panel has not the pixels that the comparison's size says.
    #[error("panel {label:?} has {got} pixels, the comparison wants {expected}")]
    Panel {
        /// The panel's label.
        label: String,
        /// Pixels given.
        got: usize,
        /// Pixels wanted.
        expected: u64,
    },
    /// Reading the pixels or writing the picture failed.
    #[error("cannot write the picture: {0}")]
    Io(#[from] io::Error),
    /// The PNG library refused, which it should not.
    #[error("the PNG could not be encoded: {0}")]
    Encode(String),
}

impl PictureError {
    /// A stable code.
    pub fn code(&self) -> &'static str {
        use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
        match self {
            Self::Size(..) | Self::Panel { .. } => "picture-size",
            Self::Io(error) if matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge) => "disk-full",
            Self::Io(_) => "output-io",
            Self::Encode(_) => "internal",
        }
    }
}

impl From<png::EncodingError> for PictureError {
    fn from(error: png::EncodingError) -> Self {
        match error {
            png::EncodingError::IoError(error) => Self::Io(error),
            error => Self::Encode(error.to_string()),
        }
    }
}

/// Writes a PNG of width x height pixels. `row(y, pixels)` fills in the linear RGB pixels of row y, from 0 downwards.
pub fn write_png(
    out: impl Write,
    width: u32,
    height: u32,
    mut row: impl FnMut(u32, &mut [[f32; 3]]) -> io::Result<()>,
) -> Result<(), PictureError> {
    let mut pixels = Vec::new();
    write_rows(out, width.into(), height.into(), |y, bytes| {
        pixels.resize(width as usize, [0.0; 3]);
        row(y, &mut pixels)?;
        for (byte, value) in bytes.iter_mut().zip(pixels.as_flattened()) {
            *byte = to_srgb8(*value);
        }
        Ok(())
    })
}

/// Writes an 8-bit RGB PNG whose rows `row(y, bytes)` fills in.
fn write_rows(
    out: impl Write,
    width: u64,
    height: u64,
    mut row: impl FnMut(u32, &mut [u8]) -> io::Result<()>,
) -> Result<(), PictureError> {
    let side = |n: u64| i32::try_from(n).ok().filter(|&n| n > 0).map(i32::unsigned_abs);
    let (Some(columns), Some(rows)) = (side(width), side(height)) else {
        return Err(PictureError::Size(width, height));
    };
    let mut encoder = png::Encoder::new(out, columns, rows);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let mut writer = encoder.write_header()?;
    let mut stream = writer.stream_writer()?;
    let mut bytes = vec![0; columns as usize * 3];
    for y in 0..rows {
        row(y, &mut bytes)?;
        stream.write_all(&bytes)?;
    }
    stream.finish()?;
    Ok(writer.finish()?)
}

/// The byte that shows a linear value.
fn to_srgb8(value: f32) -> u8 {
    /// Where the byte steps from k to k + 1: the linear value that is encoded as (k + 0.5) / 255.
    static STEPS: LazyLock<[f32; 255]> = LazyLock::new(|| {
        std::array::from_fn(|k| {
            let encoded = (k as f64 + 0.5) / 255.0;
            let linear = if encoded <= 0.04045 { encoded / 12.92 } else { libm::pow((encoded + 0.055) / 1.055, 2.4) };
            linear as f32
        })
    });
    // NaN is below every step: black.
    STEPS.partition_point(|&step| step <= value) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn decode(png: &[u8]) -> (u32, u32, Vec<u8>) {
        let mut reader = png::Decoder::new(io::Cursor::new(png)).read_info().unwrap();
        assert!(reader.info().srgb.is_some());
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
        (info.width, info.height, bytes)
    }

    #[test]
    fn transfer_is_srgb() {
        let known = [(0.0, 0), (1.0, 255), (0.5, 188), (0.18, 118), (0.002, 7), (0.0031308, 10), (0.21404114, 128)];
        for (value, byte) in known {
            assert_eq!(to_srgb8(value), byte, "{value}");
        }
        let odd = [(-1.0, 0), (7.0, 255), (f32::NAN, 0), (-f32::NAN, 0), (f32::INFINITY, 255), (f32::NEG_INFINITY, 0)];
        for (value, byte) in odd {
            assert_eq!(to_srgb8(value), byte, "{value}");
        }
        // Every byte comes back from its own linear value.
        for byte in 0..=255u8 {
            let encoded = f64::from(byte) / 255.0;
            let linear = if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
            assert_eq!(to_srgb8(linear as f32), byte);
        }
    }

    #[test]
    fn rows_come_out_as_they_went_in() {
        let mut png = Vec::new();
        write_png(&mut png, 3, 2, |y, row| {
            row.copy_from_slice(&[[y as f32, 0.5, 0.0], [1.0; 3], [f32::NAN, f32::INFINITY, -1.0]]);
            Ok(())
        })
        .unwrap();
        let (width, height, bytes) = decode(&png);
        assert_eq!((width, height), (3, 2));
        assert_eq!(bytes[..9], [0, 188, 0, 255, 255, 255, 0, 255, 0]);
        assert_eq!(bytes[9..12], [255, 188, 0]);
    }

    #[test]
    fn errors_are_told_apart() {
        let fine = |_: u32, _: &mut [[f32; 3]]| Ok(());
        assert_eq!(write_png(io::sink(), 0, 2, fine).unwrap_err().code(), "picture-size");
        let failing = |_: u32, _: &mut [[f32; 3]]| Err(io::Error::other("no pixels"));
        assert_eq!(write_png(io::sink(), 2, 2, failing).unwrap_err().code(), "output-io");
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        assert_eq!(write_png(full, 2, 2, fine).unwrap_err().code(), "disk-full");
    }
}
