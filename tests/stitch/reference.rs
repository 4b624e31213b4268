//! Our EXRs read by the reference implementation: every pixel's bits and every attribute.

use super::{exr_file::all_options, stitched, value};
use rpfd::stitch::{ExrLayout, ExrSamples, exr};
use std::{path::Path, process::Command};

/// Says that a test is skipped for want of a tool, which must not happen in CI.
fn skipped(why: &str) {
    assert!(std::env::var_os("RPFD_CI").is_none(), "{why}, and RPFD_CI is set");
    eprintln!("SKIPPED: {why}");
}

fn python(script: &str, arguments: &[&Path]) -> Option<String> {
    let present = Command::new("python3").args(["-c", "import OpenEXR, numpy"]).output();
    if !present.is_ok_and(|output| output.status.success()) {
        skipped("no python3 with OpenEXR and numpy");
        return None;
    }
    let output = Command::new("python3").args(["-c", script]).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

const CHECK: &str = r#"
import sys, pathlib, numpy as np, OpenEXR
folder = pathlib.Path(sys.argv[1])
count = 0
for path in sorted(folder.glob("*.exr")):
    size, type_, compression, layout = path.stem.split("-")
    width, height = map(int, size.split("x"))
    file = OpenEXR.File(str(path), separate_channels=True)
    header, channels = file.header(), file.channels()
    assert sorted(channels) == ["B", "G", "R"], channels
    for name in "RGB":
        pixels = channels[name].pixels
        assert pixels.shape == (height, width), pixels.shape
        assert pixels.dtype == {"float": np.float32, "half": np.float16}[type_], pixels.dtype
        bits = {"float": "<u4", "half": "<u2"}[type_]
        expected = np.fromfile(folder / f"{size}-{type_}-{name}.raw", bits).reshape(height, width)
        assert np.array_equal(np.ascontiguousarray(pixels).view(bits), expected), (path, name)
    wanted = {"none": "NO", "rle": "RLE", "zips": "ZIPS", "zip": "ZIP", "piz": "PIZ"}[compression]
    assert header["compression"].name == wanted + "_COMPRESSION", header["compression"]
    assert header["lineOrder"].name == "INCREASING_Y", header["lineOrder"]
    assert ("tiles" in header) == layout.startswith("tiles"), header
    if layout.startswith("tiles"):
        assert header["tiles"].xSize == header["tiles"].ySize == int(layout[5:]), header["tiles"]
    for key, value in {"rpfd:preset": "lean", "rpfd:seed": "42", "rpfd:boxes": "17,7"}.items():
        assert header[key] == value, header
    assert header["software"] == "rpfd " + header["rpfd:version"], header
    assert tuple(np.ravel(header["dataWindow"])) == (0, 0, width - 1, height - 1), header["dataWindow"]
    assert tuple(np.ravel(header["displayWindow"])) == (0, 0, width - 1, height - 1), header["displayWindow"]
    assert not {"capDate", "utcOffset", "owner"} & set(header), header
    count += 1
print(count)
"#;

#[test]
fn the_reference_implementation_reads_the_same_bits() {
    let directory = tempfile::tempdir().unwrap();
    let mut files = 0;
    for (width, height) in [(1, 1), (67, 45), (130, 33)] {
        let stitcher = stitched(width, height, 32, 5, directory.path());
        for (c, channel) in ["R", "G", "B"].into_iter().enumerate() {
            let pixels = (0..height).flat_map(|y| (0..width).map(move |x| value(x, y, c as u32)));
            let float: Vec<u8> = pixels.clone().flat_map(f32::to_le_bytes).collect();
            let half: Vec<u8> = pixels.flat_map(|v| half::f16::from_f32(v).to_le_bytes()).collect();
            std::fs::write(directory.path().join(format!("{width}x{height}-float-{channel}.raw")), float).unwrap();
            std::fs::write(directory.path().join(format!("{width}x{height}-half-{channel}.raw")), half).unwrap();
        }
        for (name, options) in all_options() {
            let path = directory.path().join(format!("{width}x{height}-{name}.exr"));
            assert_eq!(stitcher.write_exr(&options, false, &path).unwrap().saturated, 0);
            files += 1;
        }
    }
    if let Some(printed) = python(CHECK, &[directory.path()]) {
        assert_eq!(printed.trim(), files.to_string());
    }
}

#[test]
fn the_reference_tools_accept_the_headers() {
    let directory = tempfile::tempdir().unwrap();
    let stitcher = stitched(67, 45, 32, 5, directory.path());
    for (name, options) in all_options() {
        let path = directory.path().join(format!("{name}.exr"));
        stitcher.write_exr(&options, false, &path).unwrap();
        let Ok(info) = Command::new("exrinfo").arg("-s").arg(&path).output() else { return skipped("no exrinfo") };
        assert!(info.status.success() && info.stderr.is_empty(), "{name}: {info:?}");
        let Ok(header) = Command::new("exrheader").arg(&path).output() else { return skipped("no exrheader") };
        let text = String::from_utf8_lossy(&header.stdout);
        assert!(header.status.success() && header.stderr.is_empty(), "{name}: {header:?}");
        let bits = if options.samples == ExrSamples::Half { "16-bit floating-point" } else { "32-bit floating-point" };
        assert_eq!(text.matches(bits).count(), 3, "{text}");
        assert!(text.contains("lineOrder (type lineOrder): increasing y"), "{text}");
        assert!(text.contains("rpfd:preset (type string): \"lean\""), "{text}");
        assert_eq!(text.contains("tiles (type tiledesc)"), options.layout != ExrLayout::Scanlines, "{text}");
    }
}

const MAKE: &str = r#"
import sys, pathlib, numpy as np, OpenEXR
folder = pathlib.Path(sys.argv[1])
y, x = np.mgrid[0:37, 0:53]
base = (x + 100 * y).astype(np.float32)
tiles = OpenEXR.TileDescription()
tiles.xSize, tiles.ySize = 16, 24
def write(name, channels, **header):
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(channels)).write(str(folder / name))
for name, kind in {"half": np.float16, "float": np.float32, "uint": np.uint32}.items():
    planes = {c: (base + i).astype(kind) for i, c in enumerate("RGB")}
    write(f"{name}.exr", planes, compression=OpenEXR.ZIP_COMPRESSION)
    write(f"{name}-alpha.exr", {**planes, "A": np.ones_like(planes["R"])}, compression=OpenEXR.PIZ_COMPRESSION)
    write(f"{name}-layer.exr", {"beauty." + c: p for c, p in planes.items()} | {"Z": planes["B"] * 2},
          compression=OpenEXR.RLE_COMPRESSION)
    write(f"{name}-tiled.exr", planes, type=OpenEXR.tiledimage, compression=OpenEXR.ZIPS_COMPRESSION,
          tiles=tiles)
write("no-rgb.exr", {"Z": base}, compression=OpenEXR.NO_COMPRESSION)
"#;

#[test]
fn files_of_the_reference_implementation_are_read() {
    let directory = tempfile::tempdir().unwrap();
    if python(MAKE, &[directory.path()]).is_none() {
        return;
    }
    let mut read = 0;
    for kind in ["half", "float", "uint"] {
        for variant in ["", "-alpha", "-layer", "-tiled"] {
            let image = exr::read(&directory.path().join(format!("{kind}{variant}.exr")), 53 * 37).unwrap();
            assert_eq!((image.width, image.height), (53, 37));
            for (i, pixel) in image.pixels.iter().enumerate() {
                let base = (i % 53 + 100 * (i / 53)) as f32;
                let expected = [0.0, 1.0, 2.0].map(|c| match kind {
                    "half" => half::f16::from_f32(base + c).to_f32(),
                    _ => base + c,
                });
                assert_eq!(*pixel, expected, "{kind}{variant} pixel {i}");
            }
            read += 1;
        }
    }
    assert_eq!(read, 12);
    let error = exr::read(&directory.path().join("no-rgb.exr"), 1 << 20).unwrap_err();
    assert_eq!(error.code(), "exr-invalid");
    assert!(error.to_string().ends_with("it has no channels R, G and B"), "{error}");
}
