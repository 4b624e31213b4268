//! Tiles over HTTP give the image that filtering it whole gives, byte for byte.

use super::{Server, encode, samples, tile};
use crate::{
    cli::{rpfd, stderr},
    stitch::shuffle,
};
use rpfd::{
    filter::{Execution, Method, Rect, SampleTile, TileGeometry, filter, geometry::tiling},
    stitch::{
        ExrOptions, RgbImage,
        exr::{self, provenance},
    },
    store::Spool,
    wire::{Format, Header, encode_tile, file::TileFile},
};

const SIDE: u32 = 48;
const IMAGE: [u32; 2] = [SIDE, SIDE];

/// The EXR of a whole image, filtered in this process.
pub(crate) fn whole_exr(tile: &SampleTile, method: &Method, seed: u64) -> Vec<u8> {
    let filtered = filter(tile, method, &Execution { seed, ..Execution::default() }).unwrap();
    let [r, g, b] = &filtered.rgb;
    let pixels = r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect();
    let image = RgbImage { width: filtered.core.width, height: filtered.core.height, pixels };
    let attributes = provenance(method.preset_name(), seed, method.parameters());
    let mut bytes = std::io::Cursor::new(Vec::new());
    exr::encode(&image, &ExrOptions { attributes, ..ExrOptions::default() }, &mut bytes).unwrap();
    bytes.into_inner()
}

fn offline(method: &Method, seed: u64) -> Vec<u8> {
    whole_exr(&samples(IMAGE, Rect::new(0, 0, SIDE, SIDE), 0, 1), method, seed)
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

/// The demo's render in tiles of 64 with the preset's full halo, shuffled, over HTTP, against the whole file offline.
#[test]
fn a_real_render_over_http_is_the_offline_file() {
    let render = crate::cli::data("depth_of_field.8spp.tiles.zst");
    let folder = crate::cli::Folder::new();
    let (mut file, mut spool) = (TileFile::open(&render).unwrap(), Spool::in_memory(1 << 26));
    while let Some(event) = file.next_event().unwrap() {
        spool.push(&event).unwrap();
    }
    for preset in ["lean", "paper-fast"] {
        let reach = Method::preset(preset).unwrap().reach(false);
        let mut cores: Vec<Rect> = tiling([96, 144], 64).collect();
        shuffle(&mut cores, 3);
        let mut stream = Vec::new();
        for core in cores {
            let tile = spool.cut(TileGeometry::with_halo([96, 144], core, reach).unwrap()).unwrap();
            encode_tile(&Header::of(&tile, Format::F32).unwrap(), &tile, &mut stream).unwrap();
        }
        let mut files = Vec::new();
        for threads in ["1", "2"] {
            let out = folder.path(&format!("{preset}-{threads}.exr"));
            let output =
                rpfd(["filter", render.to_str().unwrap(), "-o", &out, "--preset", preset, "--threads", threads]);
            assert!(output.status.success(), "{}", stderr(&output));
            files.push(std::fs::read(&out).unwrap());
            let server = Server::start(&["--threads", threads]);
            let open = format!(r#"{{"width": 96, "height": 144, "id": "a", "preset": "{preset}"}}"#);
            assert_eq!(server.post("/v1/images", open.as_bytes()).status, 201);
            let lines = server.post("/v1/images/a/tiles", &stream).lines();
            assert!(lines.iter().filter(|line| line["state"] == "filtered").count() == 6, "{lines:?}");
            files.push(server.get("/v1/images/a/result.exr").body);
        }
        assert!(files.iter().all(|file| *file == files[0]), "{preset}: the four files differ");
    }
}
