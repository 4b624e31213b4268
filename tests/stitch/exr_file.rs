//! EXR files: the same bytes for the same image, whole or not there, read back by our own reader.

use super::{put, stitched, value};
use rpfd::{
    filter::{Rect, geometry::tiling},
    stitch::{
        ExrCompression, ExrLayout, ExrOptions, ExrSamples, Pixels, RgbImage, Stitcher,
        exr::{self, provenance},
    },
};
use std::{io::Cursor, path::Path};

/// Every kind of file that can be asked for.
pub(crate) fn all_options() -> impl Iterator<Item = (String, ExrOptions)> {
    ExrSamples::NAMES.into_iter().flat_map(|(type_name, samples)| {
        ExrCompression::NAMES.into_iter().flat_map(move |(name, compression)| {
            let layouts = [ExrLayout::Scanlines, ExrLayout::Tiles(16), ExrLayout::Tiles(61)];
            layouts.into_iter().map(move |layout| {
                let attributes = provenance("lean", 42, [("boxes", "17,7".to_owned())]);
                let kind = match layout {
                    ExrLayout::Tiles(size) => format!("tiles{size}"),
                    ExrLayout::Scanlines => "scanlines".to_owned(),
                };
                (format!("{type_name}-{name}-{kind}"), ExrOptions { samples, compression, layout, attributes })
            })
        })
    })
}

pub(crate) fn bytes(stitcher: &Stitcher, options: &ExrOptions) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let summary = stitcher.encode_exr(options, false, &mut out).unwrap();
    assert_eq!(summary.bytes, out.get_ref().len() as u64);
    out.into_inner()
}

#[test]
fn same_bytes_whatever_the_order_and_tiling() {
    let directory = tempfile::tempdir().unwrap();
    for (name, options) in all_options() {
        let first = bytes(&stitched(67, 45, 16, 0, directory.path()), &options);
        for (tile, seed) in [(16, 1), (64, 2), (7, 3)] {
            assert!(first == bytes(&stitched(67, 45, tile, seed, directory.path()), &options), "{name}");
        }
        let path = directory.path().join("file.exr");
        stitched(67, 45, 31, 4, directory.path()).write_exr(&options, false, &path).unwrap();
        assert!(first == std::fs::read(&path).unwrap(), "{name}");
    }
}

#[test]
fn reads_what_it_wrote() {
    let directory = tempfile::tempdir().unwrap();
    for (width, height) in [(1, 1), (67, 45), (3, 70)] {
        let stitcher = stitched(width, height, 32, 0, directory.path());
        for (name, options) in all_options() {
            let image = exr::decode(Cursor::new(bytes(&stitcher, &options)), &name, 1 << 20).unwrap();
            assert_eq!((image.width, image.height), (width, height));
            for (i, pixel) in image.pixels.iter().enumerate() {
                let (x, y) = (i as u32 % width, i as u32 / width);
                let expected = [0, 1, 2].map(|c| match options.samples {
                    ExrSamples::Float => value(x, y, c),
                    ExrSamples::Half => half::f16::from_f32(value(x, y, c)).to_f32(),
                });
                assert_eq!(*pixel, expected, "{name} at {x}, {y}");
            }
        }
    }
}

#[test]
fn an_incomplete_image_is_written_only_if_asked_for() {
    let directory = tempfile::tempdir().unwrap();
    let mut stitcher = Stitcher::new(40, 40, directory.path()).unwrap();
    tiling([40, 40], 20).skip(1).for_each(|core| put(&mut stitcher, core));
    let path = directory.path().join("file.exr");
    let error = stitcher.write_exr(&ExrOptions::default(), false, &path).unwrap_err();
    assert_eq!(error.code(), "image-incomplete");
    assert!(error.to_string().contains("400 pixels are missing, the first of them in [0, 0, 20, 20]"), "{error}");
    assert!(!path.exists());
    stitcher.write_exr(&ExrOptions::default(), true, &path).unwrap();
    let image = exr::read(&path, 1600).unwrap();
    assert_eq!(image.pixels[0], [0.0; 3]);
    assert_eq!(image.pixels[20], [0, 1, 2].map(|c| value(20, 0, c)));
}

#[test]
fn saturated_values_are_counted() {
    let image = RgbImage { width: 2, height: 1, pixels: vec![[1e6, 1.0, -1e9], [65519.0, f32::INFINITY, 0.0]] };
    let options = ExrOptions { samples: ExrSamples::Half, ..ExrOptions::default() };
    let mut out = Cursor::new(Vec::new());
    assert_eq!(exr::encode(&image, &options, &mut out).unwrap().saturated, 3);
    out.set_position(0);
    let read = exr::decode(out, "half", 2).unwrap();
    assert_eq!(read.pixels, [[65504.0, 1.0, -65504.0], [65504.0, 65504.0, 0.0]]);
    let mut out = Cursor::new(Vec::new());
    assert_eq!(exr::encode(&image, &ExrOptions::default(), &mut out).unwrap().saturated, 0);
    out.set_position(0);
    assert_eq!(exr::decode(out, "float", 2).unwrap(), image);
}

#[test]
fn failures_leave_nothing_behind() {
    let directory = tempfile::tempdir().unwrap();
    let image = RgbImage { width: 4, height: 4, pixels: vec![[1.0; 3]; 16] };
    let options = ExrOptions::default();
    let nowhere = directory.path().join("missing/file.exr");
    let error = exr::write(&image, &options, &nowhere).unwrap_err();
    assert_eq!(error.code(), "output-io");
    assert!(error.to_string().contains("missing/file.exr"), "{error}");
    assert_eq!(exr::write(&image, &options, directory.path()).unwrap_err().code(), "output-io");
    assert_eq!(exr::write(&image, &options, Path::new("/proc/file.exr")).unwrap_err().code(), "output-io");

    // The pixels fail half way: what had the name before keeps it.
    struct Broken;
    impl Pixels for Broken {
        fn image(&self) -> Rect {
            Rect::new(0, 0, 64, 64)
        }
        fn read(&self, rect: Rect, _: &mut [[f32; 3]]) -> Result<(), rpfd::stitch::CanvasError> {
            if rect.y < 32 {
                return Ok(());
            }
            let (action, path) = ("read", "/the/canvas".into());
            Err(rpfd::stitch::CanvasError::Io { action, path, source: std::io::Error::other("gone") })
        }
    }
    let path = directory.path().join("file.exr");
    std::fs::write(&path, "old").unwrap();
    let error = exr::write(&Broken, &options, &path).unwrap_err();
    assert_eq!(error.to_string(), "cannot read the canvas in /the/canvas: gone");
    assert_eq!(std::fs::read(&path).unwrap(), b"old");
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 1);

    // A sink that is full.
    let mut full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    assert_eq!(exr::encode(&image, &options, &mut full).unwrap_err().code(), "disk-full");
}

#[test]
fn files_that_cannot_be_used_say_why() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("file.exr");
    let code = |path: &Path, limit| exr::read(path, limit).unwrap_err().code();
    assert_eq!(code(&path, 16), "input-io");
    assert_eq!(code(directory.path(), 16), "input-io");
    for bad in [&b""[..], b"no exr at all", &rpfd_magic()] {
        std::fs::write(&path, bad).unwrap();
        assert_eq!(code(&path, 16), "exr-invalid");
    }
    let image = RgbImage { width: 4, height: 4, pixels: vec![[1.0; 3]; 16] };
    exr::write(&image, &ExrOptions::default(), &path).unwrap();
    assert_eq!(exr::read(&path, 16).unwrap(), image);
    assert_eq!(code(&path, 15), "exr-too-large");
    let whole = std::fs::read(&path).unwrap();
    for length in 0..whole.len() {
        let error = exr::decode(Cursor::new(&whole[..length]), "cut", 16).unwrap_err();
        assert_eq!(error.code(), "exr-invalid", "{length} bytes of {}: {error}", whole.len());
    }
}

fn rpfd_magic() -> Vec<u8> {
    [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0].to_vec()
}

/// The writer asks for one block of pixels after another, so memory does not grow with the image's height, nor, in
/// tiles, with its width.
#[test]
fn only_one_block_is_in_memory() {
    struct Gray(std::cell::Cell<u64>);
    impl Pixels for Gray {
        fn image(&self) -> Rect {
            Rect::new(0, 0, 2048, 2048)
        }
        fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), rpfd::stitch::CanvasError> {
            self.0.set(self.0.get().max(rect.area()));
            pixels.fill([0.5; 3]);
            Ok(())
        }
    }
    for (compression, layout, most) in [
        (ExrCompression::Zip, ExrLayout::Scanlines, 16 * 2048),
        (ExrCompression::Zips, ExrLayout::Scanlines, 2048),
        (ExrCompression::Zip, ExrLayout::Tiles(64), 64 * 64),
    ] {
        let gray = Gray(0.into());
        let options = ExrOptions { samples: ExrSamples::Half, compression, layout, ..ExrOptions::default() };
        let mut out = Cursor::new(Vec::new());
        exr::encode(&gray, &options, &mut out).unwrap();
        assert_eq!(gray.0.get(), most);
    }
}

#[test]
fn damaged_files_are_errors_or_images_but_no_panics() {
    let directory = tempfile::tempdir().unwrap();
    let stitcher = stitched(19, 21, 32, 0, directory.path());
    for (name, options) in all_options().step_by(4) {
        let good = bytes(&stitcher, &options);
        for i in 0..good.len().min(800) {
            for value in [0, 1, 0x7f, 0x80, 0xff] {
                let mut bad = good.clone();
                bad[i] = value;
                // A flipped size may say anything, but never more pixels than allowed.
                if let Ok(image) = exr::decode(Cursor::new(&bad), &name, 4096) {
                    assert!(image.pixels.len() <= 4096);
                }
            }
        }
    }
}
