//! Files of tiles, and the samples that are kept of them.

use super::{alone, decoder, fuzz, mutate::Random, mutate::mutate, vectors};
use rpfd::{
    filter::{Rect, TileGeometry},
    store::Spool,
    wire::{file::TileFile, scan::scan_file},
};

#[test]
fn files_and_spools() {
    let alone = alone();
    let examples = vectors();
    let make = |random: &mut Random| {
        let mut bytes = if random.one_in(2) { random.pick(&examples).clone() } else { decoder::tile(random) };
        if random.one_in(8) {
            bytes.extend(decoder::tile(random));
        }
        if random.one_in(2) {
            mutate(&mut bytes, random, &examples, decoder::WORDS);
        }
        if random.one_in(4) {
            bytes = zstd::encode_all(&bytes[..], 1).unwrap();
            if random.one_in(2) {
                mutate(&mut bytes, random, &examples, decoder::WORDS);
            }
        }
        bytes
    };
    let reached = fuzz(&alone, "store", 20, make, |bytes, random| {
        let open = || TileFile::from_reader("input", std::io::Cursor::new(bytes.to_vec())).unwrap();
        let scanned = scan_file(&mut open());
        let (mut file, mut spool) = (open(), Spool::in_memory(1 << 16));
        let mut spooled = true;
        let ended = loop {
            match file.next_event() {
                Ok(Some(event)) => spooled &= spool.push(&event).is_ok(),
                Ok(None) => break true,
                Err(error) => {
                    // Both say the same.
                    assert_eq!(scanned.as_ref().unwrap_err().to_string(), error.to_string());
                    break false;
                }
            }
        };
        spool.discard();
        let Ok(summary) = scanned else { return "no file" };
        assert!(ended);
        if !spooled {
            return "a file that is no image";
        }
        assert!(spool.bytes() <= summary.spool_bytes, "{} of {}", spool.bytes(), summary.spool_bytes);
        assert_eq!(spool.tiles().count(), summary.tiles.len());
        // Any part of the image can be cut out, if it is there.
        let image = summary.first.geometry().image();
        let mut part = |length: u32| {
            let from = random.below(length.min(64) as usize) as u32;
            (from, 1 + random.below((length - from).min(8) as usize) as u32)
        };
        let ((x, width), (y, height)) = (part(image.width), part(image.height));
        let core = Rect::new(x, y, width, height);
        let geometry = TileGeometry::with_halo([image.width, image.height], core, 0).unwrap();
        let missing = spool.missing(&core);
        match spool.cut(geometry) {
            Ok(tile) => assert!(missing.is_empty() && tile.geometry().core() == core),
            Err(error) => assert!(!missing.is_empty() || error.code() == "too_large", "{error}"),
        }
        "an image"
    });
    assert_eq!(reached.len(), 3, "{reached:?}");
}
