//! Of the whole: against theory, against itself, and against what the module's documentation says.
//!
//! Random numbers are fixed by their seeds, so every statistical test either holds or not; a bound of four standard
//! errors says how surprising a failure would have been before the seed was chosen.

use super::camera::Camera;
use super::material::Material;
use super::shape::Shape;
use super::texture::Texture;
use super::vector::{Vec3, vec3};
use super::*;
use crate::filter::samples::{MAX_SAMPLES_PER_PIXEL, SampleError};
use crate::filter::{Execution, Halo, Plane, Rect, SampleTile, TileGeometry};
use std::f64::consts::PI;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

fn seeded(seed: u64) -> Execution<'static> {
    Execution { seed, ..Execution::default() }
}

fn whole(width: u32, height: u32) -> TileGeometry {
    TileGeometry::new([width, height], Rect::new(0, 0, width, height), Halo::default()).unwrap()
}

fn scene(name: &str) -> Scene {
    Scene::by_name(name).unwrap()
}

fn matte(reflectance: f64) -> Material {
    Material::matte(Texture::Solid(Vec3::ONE * reflectance))
}

fn floor() -> Shape {
    Shape::rectangle(vec3(-1e3, 0.0, -1e3), vec3(0.0, 0.0, 2e3), vec3(2e3, 0.0, 0.0))
}

/// Planes of a channel, by name.
fn planes(tile: &SampleTile, name: &str) -> Vec<usize> {
    let all = tile.channels().plane_channels().enumerate();
    all.filter(|(_, (channel, _))| channel.name == name).map(|(plane, _)| plane).collect()
}

fn bits(tile: &SampleTile, pixel: usize) -> Vec<u32> {
    let planes = 0..tile.channels().planes();
    planes.flat_map(|p| tile.samples_of(pixel).map(move |i| tile.value(p, i).to_bits())).collect()
}

/// Mean of the green channel over an image, and its standard error, from 1024 times `samples`.
fn mean_of_image(scene: &Scene, samples: u32) -> (f64, f64) {
    let tile = scene.tile(whole(32, 32), samples, &seeded(11)).unwrap();
    let [_, green, _] = tile.channels().color_planes();
    let values = || (0..tile.total()).map(|i| f64::from(tile.value(green, i)));
    let n = tile.total() as f64;
    let mean = values().sum::<f64>() / n;
    (mean, (values().map(|v| (v - mean) * (v - mean)).sum::<f64>() / (n * (n - 1.0))).sqrt())
}

/// Sees practically one point.
fn stare(from: Vec3, at: Vec3) -> Camera {
    Camera::new(from, at, 1e-4)
}

#[test]
fn same_bits_in_any_tile_and_on_any_threads() {
    let size = [40, 24];
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    for name in ["all", "plain"] {
        let scene = scene(name);
        let on_pool = Execution { pool: Some(&pool), ..seeded(5) };
        let full = whole(size[0], size[1]);
        let (even, mixed) = (scene.tile(full, 3, &on_pool).unwrap(), scene.tile_varying(full, 3, &on_pool).unwrap());
        for core in crate::filter::geometry::tiling(size, 16) {
            let geometry = TileGeometry::with_halo(size, core, 5).unwrap();
            let window = geometry.window();
            let parts = [scene.tile(geometry, 3, &seeded(5)), scene.tile_varying(geometry, 3, &seeded(5))];
            for (part, image) in parts.into_iter().zip([&even, &mixed]) {
                let part = part.unwrap();
                for y in window.y..window.bottom() {
                    for x in window.x..window.right() {
                        assert_eq!(bits(&part, window.index(x, y)), bits(image, full.image().index(x, y)), "{x} {y}");
                    }
                }
            }
        }
        let other = scene.tile(full, 3, &seeded(6)).unwrap();
        assert_ne!(bits(&even, 0), bits(&other, 0), "the seed matters");
        let [alone, together] =
            [seeded(5), on_pool].map(|execution| scene.reference(size, Rect::new(3, 4, 9, 5), 16, &execution).unwrap());
        assert_eq!(alone, together);
    }
}

#[test]
fn varying_tiles_hold_the_first_samples_of_each_pixel() {
    let (even, mixed) = (
        scene("all").tile(whole(32, 32), 4, &seeded(5)).unwrap(),
        scene("all").tile_varying(whole(32, 32), 4, &seeded(5)).unwrap(),
    );
    let mut pixels = [0; 5];
    for pixel in 0..1024 {
        let (all, some) = (even.samples_of(pixel), mixed.samples_of(pixel));
        pixels[some.len()] += 1;
        for (i, j) in some.zip(all) {
            assert!((0..27).all(|p| mixed.value(p, i).to_bits() == even.value(p, j).to_bits()));
        }
    }
    assert!(pixels.iter().all(|&n| (150..260).contains(&n)), "205 of each expected: {pixels:?}");
}

/// The same bits on every machine: a checksum (FNV-1a) of a small tile, taken once.
#[test]
fn same_bits_on_every_machine() {
    let tile = scene("all").tile(whole(16, 16), 2, &seeded(1)).unwrap();
    let all = (0..256).flat_map(|pixel| bits(&tile, pixel)).flat_map(u32::to_le_bytes);
    let sum = all.fold(0xcbf2_9ce4_8422_2325_u64, |sum, byte| (sum ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
    assert_eq!(sum, 0xe3dc_1915_25c6_9696, "{sum:#x}");
}

#[test]
fn planes_vary_as_documented() {
    let names = ["film", "color", "P", "N", "albedo", "P2", "N2", "lens", "time", "light", "bsdf"];
    let documented: [(&str, &[&str], usize); 7] = [
        ("lens", &["time"], 26),
        ("motion", &["lens"], 25),
        ("area-light", &["lens", "time"], 24),
        ("glossy", &["lens", "time"], 24),
        ("textures", &["lens", "time"], 24),
        ("all", &[], 27),
        ("plain", &["lens", "time", "P2", "N2"], 18),
    ];
    assert_eq!(documented.map(|(name, ..)| name).to_vec(), scenes().iter().map(|(name, _)| *name).collect::<Vec<_>>());
    assert!(Scene::by_name("nothing").is_none());
    for (name, constant, live) in documented {
        let tile = scene(name).tile(whole(48, 32), 2, &seeded(1)).unwrap();
        assert_eq!(tile.channels().channels().iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), names);
        let varies = |plane| matches!(tile.plane(plane), Plane::Values(_));
        assert_eq!((0..27).filter(|&p| varies(p)).count(), live, "{name}");
        for channel in names {
            for plane in planes(&tile, channel) {
                assert_eq!(varies(plane), !constant.contains(&channel), "{name} {channel}");
                if let Plane::Constant(value) = *tile.plane(plane) {
                    assert!(if channel.ends_with('2') { value.is_nan() } else { value == 0.0 }, "{name} {channel}");
                }
            }
        }
        assert_eq!(tile.replaced().total(), 0, "{name}: colours and numbers are finite");
        assert!(tile.channels().color_planes().iter().all(|&p| (0..tile.total()).all(|i| tile.value(p, i) >= 0.0)));
    }
}

#[test]
fn missing_features_are_nan() {
    let scene = scene("all");
    let tile = scene.tile(whole(48, 48), 4, &seeded(2)).unwrap();
    let nan = |name: &str, i| {
        let missing: Vec<bool> = planes(&tile, name).iter().map(|&p| tile.value(p, i).is_nan()).collect();
        assert!(missing.iter().all(|&m| m == missing[0]), "{name} {i}");
        missing[0]
    };
    let [mut first, mut second] = [0; 2];
    for i in 0..tile.total() {
        assert!(nan("P", i) == nan("N", i) && nan("P", i) == nan("albedo", i) && nan("P2", i) == nan("N2", i));
        if nan("P", i) {
            first += 1;
            assert!(nan("P2", i), "no second hit without a first");
            let color = tile.channels().color_planes().map(|p| tile.value(p, i));
            assert_eq!(color, scene.sky.to_f32());
        }
        second += usize::from(nan("P2", i));
    }
    assert!(first > tile.total() / 20 && second > first + tile.total() / 20 && second < tile.total());
}

/// Uniform numbers in [0, 1): chi-square over 32 cells (31 degrees of freedom; below 78 but for one case in 10^5).
#[test]
fn recorded_random_parameters_are_uniform() {
    let tile = scene("all").tile(whole(128, 64), 8, &seeded(3)).unwrap();
    for plane in ["lens", "time", "light", "bsdf"].iter().flat_map(|name| planes(&tile, name)) {
        let mut cells = [0; 32];
        for i in 0..tile.total() {
            let value = tile.value(plane, i);
            assert!((0.0..1.0).contains(&value));
            cells[(value * 32.0) as usize] += 1;
        }
        let expected = tile.total() as f64 / 32.0;
        let chi: f64 = cells.iter().map(|&n| (f64::from(n) - expected).powi(2) / expected).sum();
        assert!(chi < 78.0, "plane {plane}: {chi}");
    }
    for pixel in 0..128 * 64 {
        let (x, y) = ((pixel % 128) as f32, (pixel / 128) as f32);
        for i in tile.samples_of(pixel) {
            assert!((0.0..=1.0).contains(&(tile.value(0, i) - x)) && (0.0..=1.0).contains(&(tile.value(1, i) - y)));
        }
    }
}

/// Under an even sky, a convex matte thing shows its reflectance and a white world vanishes: in every single sample.
#[test]
fn white_furnace() {
    let camera = Camera::new(vec3(0.0, 2.0, 5.0), vec3(0.0, 1.0, 0.0), 30.0);
    let ball = Shape::Sphere { center: vec3(0.0, 1.0, 0.0), radius: 1.0 };
    let alone = Scene::new(stare(vec3(0.0, 2.0, 5.0), vec3(0.0, 1.0, 0.0)), Vec3::ONE, 4).with(ball, matte(0.6));
    let white = Scene::new(camera, Vec3::ONE, 1000)
        .with(floor(), matte(1.0))
        .with(ball, matte(1.0))
        .with(Shape::Block { low: vec3(1.0, 0.0, 0.0), high: vec3(2.0, 1.0, 1.0) }, matte(1.0));
    for (scene, expected) in [(alone, 0.6), (white, 1.0)] {
        let tile = scene.tile(whole(16, 16), 16, &seeded(1)).unwrap();
        for plane in tile.channels().color_planes() {
            assert!((0..tile.total()).all(|i| (tile.value(plane, i) - expected).abs() < 1e-6));
        }
    }
    // A white rough metal scatters only once and may lose light, but never makes any.
    let metal = Scene::new(camera, Vec3::ONE, 100).with(ball, Material::metal(Vec3::ONE, 0.4));
    let reference = metal.reference([16, 16], Rect::new(0, 0, 16, 16), 64, &seeded(1)).unwrap();
    assert!(reference.rgb[0].iter().all(|&v| v > 0.5 && v < 1.0 + 1e-6));
}

/// Light from a rectangle and from a sphere above a matte floor against their closed forms, within four standard errors:
/// the form factor of a rectangle seen from under its centre (four times that of a quarter seen from its corner; Howell,
/// *Catalog of Radiation Heat Transfer Configuration Factors*, B-3), and (r/d)^2 cos for a whole sphere.
#[test]
fn irradiance_of_lights_is_analytic() {
    let base = Scene::new(stare(vec3(3.0, 2.0, 0.0), Vec3::ZERO), Vec3::ZERO, 3).with(floor(), matte(0.5));
    let (a, b) = (1.5 / 2.0, 0.8 / 2.0);
    let half = |a: f64, b: f64| a / (1.0 + a * a).sqrt() * libm::atan(b / (1.0 + a * a).sqrt());
    let form_factor = 4.0 * (half(a, b) + half(b, a)) / (2.0 * PI);
    let rectangle = Shape::rectangle(vec3(-1.5, 2.0, -0.8), vec3(3.0, 0.0, 0.0), vec3(0.0, 0.0, 1.6));
    let sphere = Shape::Sphere { center: vec3(-1.0, 2.0, 1.0), radius: 0.5 };
    let of_sphere = 0.25 / 6.0 * (2.0 / 6.0_f64.sqrt());
    for (light, factor) in [(rectangle, form_factor), (sphere, of_sphere)] {
        let lit = base.clone().with(light, Material::light(Vec3::ONE * 10.0));
        let (mean, error) = mean_of_image(&lit, 100);
        let expected = 0.5 * 10.0 * factor;
        assert!(error < 0.01 * expected && (mean - expected).abs() < 4.0 * error, "{mean} +- {error}: {expected}");
    }
}

/// A light that points are drawn on and one that is only found by chance (a box, which cannot be drawn on) light a
/// glossy floor alike: no light is counted twice or lost by the weights.
#[test]
fn light_is_counted_once() {
    let gray = Texture::Solid(Vec3::ONE * 0.5);
    let glossy = Material { gloss: 0.5, roughness: 0.3, specular: Vec3::ONE * 0.8, ..Material::matte(gray) };
    let emit = Material::light(Vec3::ONE * 5.0);
    let base = Scene::new(stare(vec3(2.5, 2.0, 0.0), Vec3::ZERO), Vec3::ONE * 0.1, 3).with(floor(), glossy);
    let sphere = Shape::Sphere { center: vec3(1.0, 3.0, 1.0), radius: 0.3 };
    let drawn = Shape::rectangle(vec3(-3.0, 2.0, -1.0), vec3(2.0, 0.0, 0.0), vec3(0.0, 0.0, 2.0));
    let found = Shape::Block { low: vec3(-3.0, 2.0, -1.0), high: vec3(-1.0, 2.0 + 1e-6, 1.0) };
    let [one, other] = [drawn, found].map(|light| {
        let lit = base.clone().with(sphere, emit).with(light, emit);
        mean_of_image(&lit, 200)
    });
    let error = (one.1 * one.1 + other.1 * other.1).sqrt();
    assert!(one.1 < other.1 && error < 0.01 * one.0, "drawing points is the better way: {one:?} {other:?}");
    assert!((one.0 - other.0).abs() < 4.0 * error, "{one:?} {other:?}");
}

/// Samples tend to the reference: the image's mean agrees within four standard errors; from 4 to 64 samples the relMSE
/// falls to about a sixteenth (a tenth to a 25th, since in out-of-focus lights it hangs on single bright samples, of
/// the reference too); and two references differ by as much as they say together, within a half.
#[test]
fn samples_tend_to_the_reference() {
    let (size, rect) = ([16, 16], Rect::new(0, 0, 16, 16));
    let relative = |value: f64, truth: f64| (value - truth) * (value - truth) / (truth * truth + 0.01);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    for (name, _) in scenes() {
        let scene = scene(name);
        let [one, other] = [1, 2].map(|seed| scene.reference(size, rect, 2048, &seeded(seed)).unwrap());
        assert_eq!((one.samples, one.rect), (2048, rect));
        let [truths, others] =
            [&one, &other].map(|r| r.rgb.iter().flatten().map(|&v| f64::from(v)).collect::<Vec<_>>());
        let apart = truths.iter().zip(&others).map(|(&a, &b)| relative(a, b)).sum::<f64>() / 768.0;
        let honest = (one.relmse + other.relmse) / apart;
        assert!((0.67..1.5).contains(&honest), "{name}: {} and {}, but {apart} apart", one.relmse, other.relmse);

        let tile = scene.tile(whole(16, 16), 512, &seeded(1)).unwrap();
        let colors = tile.channels().color_planes().into_iter();
        let places = colors.flat_map(|plane| (0..256).map(move |pixel| (plane, pixel)));
        let (mut errors, mut bias, mut variance) = (Vec::new(), 0.0, 3.0 * one.mse * 768.0);
        for ((plane, pixel), &truth) in places.zip(&truths) {
            let samples: Vec<f64> = tile.samples_of(pixel).map(|i| f64::from(tile.value(plane, i))).collect();
            // Over all disjoint groups of n samples.
            let error = |n: usize| mean(&samples.chunks(n).map(|g| relative(mean(g), truth)).collect::<Vec<_>>());
            errors.push([error(4), error(64)]);
            let all = mean(&samples);
            bias += all - truth;
            // The three channels of a pixel vary together: at most thrice the sum of their variances.
            variance += 3.0 * samples.iter().map(|v| (v - all) * (v - all)).sum::<f64>() / (512.0 * 511.0);
        }
        assert!(bias.abs() < 4.0 * variance.sqrt(), "{name}: {bias} +- {}", variance.sqrt());
        let [few, many] = [0, 1].map(|k| mean(&errors.iter().map(|e| e[k]).collect::<Vec<_>>()));
        assert!((10.0..25.0).contains(&(few / many)), "{name}: {few} / {many}");
    }
}

/// In one small pixel where things are out of focus or in motion, samples meet surfaces far apart, but not with the lens
/// closed or the motion frozen.
#[test]
fn blur_is_in_the_samples() {
    let spread = |scene: &Scene, x, y| -> f32 {
        let geometry = TileGeometry::new([4096, 4096], Rect::new(x, y, 1, 1), Halo::default()).unwrap();
        let tile = scene.tile(geometry, 256, &seeded(1)).unwrap();
        let range = planes(&tile, "P").into_iter().map(|plane| {
            let values = || (0..256).map(|i| tile.value(plane, i));
            values().fold(f32::MIN, f32::max) - values().fold(f32::MAX, f32::min)
        });
        range.fold(0.0, f32::max)
    };
    let lens = scene("lens");
    let closed = Scene { camera: lens.camera.with_lens(0.0, 1.0), ..lens.clone() };
    // On the near blue sphere.
    assert!(spread(&lens, 3450, 3450) > 0.1 && spread(&closed, 3450, 3450) < 0.01);
    let motion = scene("motion");
    let mut frozen = motion.clone();
    frozen.objects.iter_mut().for_each(|object| object.velocity = Vec3::ZERO);
    // Where the striped sphere passes.
    assert!(spread(&motion, 1000, 2000) > 0.3 && spread(&frozen, 1000, 2000) < 0.01);
}

#[test]
fn limits_stops_and_progress() {
    let scene = scene("plain");
    let over = MAX_SAMPLES_PER_PIXEL + 1;
    let refused = SynthError::Samples(SampleError::PerPixel(over));
    assert_eq!(scene.tile(whole(1, 1), over, &seeded(1)).unwrap_err(), refused);
    assert_eq!(scene.tile_varying(whole(1, 1), over, &seeded(1)).unwrap_err(), refused);
    assert_eq!(scene.tile(whole(1, 1), MAX_SAMPLES_PER_PIXEL, &seeded(1)).unwrap().total(), over as usize - 1);
    let huge = scene.tile(whole(1 << 20, 1 << 20), 1, &seeded(1)).unwrap_err();
    assert!(matches!(huge, SynthError::Samples(SampleError::TooMany(_))));
    assert_eq!(scene.tile(whole(3, 2), 0, &seeded(1)).unwrap().total(), 0);

    let seen = Mutex::new(Vec::new());
    let note = |share| seen.lock().unwrap().push(share);
    let stop = AtomicBool::new(false);
    let execution = Execution { progress: Some(&note), stop: Some(&stop), ..seeded(1) };
    scene.tile(whole(3, 4), 1, &execution).unwrap();
    assert_eq!(*seen.lock().unwrap(), [0.25, 0.5, 0.75, 1.0]);
    stop.store(true, Ordering::Relaxed);
    assert_eq!(scene.tile(whole(3, 4), 1, &execution).unwrap_err(), SynthError::Stopped);
    let rect = Rect::new(0, 0, 3, 4);
    assert_eq!(scene.reference([3, 4], rect, 2, &execution).unwrap_err(), SynthError::Stopped);
}
