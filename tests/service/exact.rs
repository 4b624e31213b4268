//! Tiles over HTTP give the image that filtering it whole gives, byte for byte.

use super::{Server, encode, samples, tile};
use crate::stitch::shuffle;
use rpfd::{
    filter::{Execution, Method, Rect, filter, geometry::tiling},
    stitch::{
        ExrOptions, RgbImage,
        exr::{self, provenance},
    },
};

const SIDE: u32 = 48;
const IMAGE: [u32; 2] = [SIDE, SIDE];

/// The EXR of the whole image, filtered in this process.
fn offline(method: &Method, seed: u64) -> Vec<u8> {
    let tile = samples(IMAGE, Rect::new(0, 0, SIDE, SIDE), 0, 1);
    let filtered = filter(&tile, method, &Execution { seed, ..Execution::default() }).unwrap();
    let [r, g, b] = &filtered.rgb;
    let pixels = r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect();
    let image = RgbImage { width: SIDE, height: SIDE, pixels };
    let attributes = provenance(method.preset_name(), seed, method.parameters());
    let mut bytes = std::io::Cursor::new(Vec::new());
    exr::encode(&image, &ExrOptions { attributes, ..ExrOptions::default() }, &mut bytes).unwrap();
    bytes.into_inner()
}

#[test]
fn shuffled_tiles_are_the_whole_image() {
    let server = Server::start(&[]);
    let method = Method::preset("lean").unwrap();
    let expected = offline(&method, 5);
    server.post("/v1/images", br#"{"width": 48, "height": 48, "id": "a", "seed": 5, "preset": "lean"}"#);
    let mut cores: Vec<Rect> = tiling(IMAGE, 16).collect();
    shuffle(&mut cores, 9);
    // Some in one stream, some at the same time in others.
    let (one, others) = cores.split_at(4);
    let stream: Vec<u8> = one.iter().flat_map(|&core| tile(IMAGE, core, method.reach(false))).collect();
    std::thread::scope(|scope| {
        scope.spawn(|| assert_eq!(server.post("/v1/images/a/tiles", &stream).lines().len(), one.len() + 1));
        for &core in others {
            let server = &server;
            let body = tile(IMAGE, core, method.reach(false));
            scope.spawn(move || server.post("/v1/images/a/tiles", &body).lines());
        }
    });
    let exr = server.get("/v1/images/a/result.exr");
    assert_eq!(exr.status, 200, "{}", String::from_utf8_lossy(&exr.body));
    assert!(exr.body == expected, "the stitched image differs from the whole one");
    let whole = encode(&samples(IMAGE, Rect::new(0, 0, SIDE, SIDE), 0, 1));
    let single = server.call("POST", "/v1/filter?preset=lean&seed=5", &["Accept: image/x-exr"], &whole);
    assert!(single.body == expected, "the single tile differs from the whole image");
}
