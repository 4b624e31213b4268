//! What the core promises of the whole: same bits, exact constants, less halo, holes.

use super::{method, part, scene};
use crate::filter::geometry::tiling;
use crate::filter::method::{Algorithm, PRESETS};
use crate::filter::{
    Channel, ChannelSet, Counts, Execution, Filtered, Halo, LeftOut, LeftOutReason, Method, Plane, Rect, Report, Role,
    SampleTile, SimdLevel, Stopped, TileGeometry, Work, filter,
};
use crate::synth::Scene;
use std::sync::atomic::AtomicBool;

fn run(tile: &SampleTile, method: &Method) -> Filtered {
    filter(tile, method, &Execution { seed: 5, ..Execution::default() }).unwrap()
}

/// The methods that tiling and threads are tried with: presets as they are where their reach fits a small image, else
/// with smaller boxes; and the baselines.
fn methods() -> [Method; 8] {
    let small = [("boxes", "15,9,7,5"), ("fractions", "0.05,0.1,0.3,0.5")];
    [
        method("lean", &[]),
        method("paper-fast", &small),
        method("paper-fast", &[small[0], small[1], ("spikes", "off"), ("information_grid", "3")]),
        method("lean", &[("tolerance", "0.02")]),
        method("gaussian", &[("sigma", "2.5")]),
        method("bilateral", &[("sigma", "3"), ("color_scale", "linear")]),
        method("bilateral", &[("color_scale", "log"), ("color_sigma", "0.3")]),
        method("cross-bilateral", &[("sigma", "2"), ("position_deviations", "20")]),
    ]
}

/// Assembles an image from tiles of some size, last tile first.
fn tiled(
    image: [u32; 2],
    size: u32,
    halo: u32,
    method: &Method,
    tile: impl Fn(TileGeometry) -> SampleTile,
) -> Vec<f32> {
    let mut out = vec![f32::NAN; (image[0] * image[1] * 3) as usize];
    let mut cores: Vec<Rect> = tiling(image, size).collect();
    cores.reverse();
    for core in cores {
        let filtered = run(&tile(TileGeometry::with_halo(image, core, halo).unwrap()), method);
        for (k, plane) in filtered.rgb.iter().enumerate() {
            for (i, value) in plane.iter().enumerate() {
                let (x, y) = (core.x + i as u32 % core.width, core.y + i as u32 / core.width);
                out[((y * image[0] + x) * 3) as usize + k] = *value;
            }
        }
    }
    out
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn tiles_with_enough_halo_give_the_whole_images_bits() {
    let image = [76, 52];
    for method in methods() {
        let whole = tiled(image, 100, 0, &method, |geometry| part("all", geometry, 3));
        assert!(whole.iter().all(|v| v.is_finite()));
        for size in [76, 31, 16] {
            let tiles = tiled(image, size, method.reach(false), &method, |geometry| part("all", geometry, 3));
            assert!(bits(&tiles) == bits(&whole), "{method:?}, tiles of {size}");
        }
        // The test can fail: too little halo changes bits.
        let tiles = tiled(image, 16, method.reach(false) / 2, &method, |geometry| part("all", geometry, 3));
        assert!(bits(&tiles) != bits(&whole), "{method:?}");
    }
}

#[test]
fn varying_counts_and_holes_give_the_whole_images_bits() {
    let image = [60, 44];
    let tile = |geometry| Scene::by_name("all").unwrap().tile_varying(geometry, 3, &Execution::default()).unwrap();
    for method in methods() {
        let whole = tiled(image, 100, 0, &method, tile);
        assert!(whole.iter().all(|v| v.is_finite()));
        let tiles = tiled(image, 16, method.reach(true), &method, tile);
        assert!(bits(&tiles) == bits(&whole), "{method:?}");
        let geometry = TileGeometry::with_halo(image, Rect::new(0, 0, 60, 44), 0).unwrap();
        let report = run(&tile(geometry), &method).report;
        assert!(report.filled > 0, "{report:?}");
    }
}

#[test]
fn threads_and_simd_levels_do_not_matter() {
    let tile = scene("all", [40, 33], 4);
    for method in methods() {
        let expected = run(&tile, &method);
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let execution = Execution { seed: 5, pool: Some(&pool), ..Execution::default() };
            assert_eq!(filter(&tile, &method, &execution).unwrap(), expected, "{threads} threads");
        }
        for (name, simd) in SimdLevel::available() {
            let execution = Execution { seed: 5, simd, ..Execution::default() };
            assert_eq!(filter(&tile, &method, &execution).unwrap(), expected, "{name}");
        }
    }
    let other = filter(&tile, &methods()[0], &Execution { seed: 6, ..Execution::default() }).unwrap();
    assert_ne!(other.rgb, run(&tile, &methods()[0]).rgb, "the seed matters");
}

/// Every preset as it is, at every level there is, with holes, and with and without what could be left out.
#[test]
fn simd_levels_do_not_matter_to_any_preset() {
    let geometry = TileGeometry::with_halo([40, 30], Rect::new(8, 4, 12, 9), 6).unwrap();
    let tile = Scene::by_name("all").unwrap().tile_varying(geometry, 5, &Execution::default()).unwrap();
    let levels = SimdLevel::available();
    println!("levels of this CPU: {}", SimdLevel::names().join(", "));
    for (preset, _) in PRESETS {
        for leave_out in [true, false] {
            let at = |simd| {
                let execution = Execution { seed: 5, simd, leave_out, ..Execution::default() };
                filter(&tile, &method(preset, &[]), &execution).unwrap()
            };
            let expected = at(levels[0].1);
            for (name, level) in &levels[1..] {
                let filtered = at(*level);
                for (plane, expected) in filtered.rgb.iter().zip(&expected.rgb) {
                    assert!(bits(plane) == bits(expected), "{preset} at {name}, leaving out: {leave_out}");
                }
                assert_eq!(filtered.report, expected.report, "{preset} at {name}");
            }
        }
    }
}

#[test]
fn constant_colour_stays_exactly() {
    for (preset, _) in PRESETS {
        let settings: &[(&str, &str)] =
            if *preset == "paper" { &[("boxes", "15,7"), ("fractions", "0.5,0.5")] } else { &[] };
        for value in [0.0, 0.1, 1.0 / 3.0, 1e-40, 7.7e37] {
            let noisy = scene("all", [20, 20], 3);
            let color = noisy.channels().color_planes();
            let planes = (0..noisy.channels().planes())
                .map(|plane| if color.contains(&plane) { Plane::Constant(value) } else { noisy.plane(plane).clone() })
                .collect();
            let tile =
                SampleTile::new(*noisy.geometry(), noisy.channels().clone(), Counts::Uniform(3), planes).unwrap();
            let filtered = run(&tile, &method(preset, settings));
            assert!(filtered.rgb.iter().flatten().all(|&v| v == value), "{preset} {value}");
        }
    }
}

#[test]
fn too_little_halo_is_filtered_and_said() {
    let geometry = TileGeometry::with_halo([90, 90], Rect::new(40, 40, 10, 10), 4).unwrap();
    let filtered = run(&part("all", geometry, 2), &method("lean", &[]));
    assert!(!filtered.report.exact());
    assert_eq!(filtered.report.halo_needed, Halo { left: 17, top: 17, right: 17, bottom: 17 });
    assert!(filtered.rgb.iter().flatten().all(|v| v.is_finite()));
}

/// Adds or removes planes that cannot have an effect: constant ones and missing ones of every role.
#[test]
fn planes_without_effect_change_no_bit() {
    let tile = scene("lens", [24, 24], 3);
    let planes = |tile: &SampleTile| (0..tile.channels().planes()).map(|p| tile.plane(p).clone()).collect::<Vec<_>>();
    let with = |extra: &[(Channel, Plane)]| {
        let mut channels = tile.channels().channels().to_vec();
        let mut planes = planes(&tile);
        for (channel, plane) in extra {
            channels.push(channel.clone());
            planes.push(plane.clone());
        }
        SampleTile::new(*tile.geometry(), ChannelSet::new(channels).unwrap(), Counts::Uniform(3), planes).unwrap()
    };
    let feature = |name: &str, position| Channel::new(name, Role::Feature { position }, 1);
    let random = |name: &str| Channel::new(name, Role::Random { uniform: true }, 1);
    let extended = with(&[
        (feature("depth", false), Plane::Constant(1e30)),
        (feature("P3", true), Plane::Constant(f32::NAN)),
        (random("wavelength"), Plane::Values(vec![0.25; tile.total()])),
    ]);
    for method in methods() {
        let (plain, extended) = (run(&tile, &method), run(&extended, &method));
        assert_eq!(plain.rgb, extended.rgb);
        for (plane, role, reason) in [
            ("depth", Role::Feature { position: false }, LeftOutReason::Constant),
            ("P3", Role::Feature { position: true }, LeftOutReason::Missing),
            ("wavelength", Role::Random { uniform: true }, LeftOutReason::Constant),
            ("time", Role::Random { uniform: true }, LeftOutReason::Constant),
        ] {
            let said = extended.report.left_out.iter().find(|l| l.plane == plane).map(|l| l.reason);
            assert_eq!(said, Some(if method.reads(&role) { reason } else { LeftOutReason::Unused }), "{plane}");
        }
    }
}

/// What was done and what was left out is together what there is to do, which is done without leaving out.
fn check_work(on: &Report, off: &Report, samples: usize) {
    assert_eq!(on.left_out_bytes as usize, on.left_out.len() * samples * 4);
    let (Some(on), Some(off)) = (on.work, off.work) else {
        return assert_eq!((on.work, off.work), (None, None));
    };
    assert_eq!((off.saved(), off.saved_share()), (0, 0.0));
    assert_eq!(on.done + on.saved(), off.done);
    assert!(on.saved() > 0 && on.done > 0 && (0.0..1.0).contains(&on.saved_share()), "{on:?}");
}

/// Each cause of leaving out saves its own, and the work of tiles adds up to that of the whole image.
#[test]
fn work_is_told_by_cause_and_adds_up() {
    let image = [40, 30];
    let geometry = |core, halo| TileGeometry::with_halo(image, core, halo).unwrap();
    let whole = Rect::new(0, 0, 40, 30);
    for settings in [&[][..], &[("information_grid", "1")]] {
        let method = method("lean", settings);
        let work = |core: Rect, plane: &dyn Fn(usize, &SampleTile) -> Plane| {
            let full = part("all", geometry(core, method.reach(false)), 3);
            let planes = (0..full.channels().planes()).map(|k| plane(k, &full)).collect();
            let tile = SampleTile::new(*full.geometry(), full.channels().clone(), Counts::Uniform(3), planes).unwrap();
            run(&tile, &method).report.work.unwrap()
        };
        let as_it_is = |k: usize, tile: &SampleTile| tile.plane(k).clone();
        let plain = work(whole, &as_it_is);
        assert_eq!(plain.planes, 0, "nothing is constant all over");
        // A random parameter that is constant all over; one that is a step at the right edge, so over most neighbourhoods;
        // a colour that is one, too, and so depends on it alone and weighs nothing.
        let time = scene("all", [8, 8], 1).channels().planes_of(|role| matches!(role, Role::Random { .. }))[0];
        let constant = |k: usize, tile: &SampleTile| match k {
            k if k == time => Plane::Constant(0.5),
            k => tile.plane(k).clone(),
        };
        let step = |k: usize, tile: &SampleTile| match k {
            k if k == time => {
                let last = |s: usize| s / 3 % tile.geometry().window().width as usize == 39;
                Plane::Values((0..tile.total()).map(|s| f32::from(last(s))).collect())
            }
            k => tile.plane(k).clone(),
        };
        let noise = |k: usize, tile: &SampleTile| match k {
            k if tile.channels().color_planes().contains(&k) => {
                Plane::Values((0..tile.total()).map(|s| tile.value(time, s) * k as f32).collect())
            }
            k => tile.plane(k).clone(),
        };
        let (constant, step, noise) = (work(whole, &constant), work(whole, &step), work(whole, &noise));
        assert!(constant.planes > 0, "{constant:?}");
        assert!(step.planes == 0 && step.columns > plain.columns && step.distances > 0, "{plain:?} {step:?}");
        assert!(noise.distances > plain.distances, "{plain:?} {noise:?}");
        let mut sum = Work::default();
        tiling(image, 16).for_each(|core| sum += work(core, &as_it_is));
        assert_eq!(sum.done + sum.saved(), plain.done + plain.saved());
        assert_eq!(sum.distances, plain.distances);
    }
}

/// Computing what can have no effect changes no bit: constant and missing planes of every role, columns that are constant
/// over a neighbourhood only, features and colours that weigh nothing. Random planes come and go, and so do threads.
#[test]
fn leaving_out_changes_no_bit() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let hash = |i: u64| (i.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as u32;
    for (case, name) in ["plain", "lens", "all", "glossy"].into_iter().enumerate() {
        let noisy = scene(name, [26, 22], 3);
        let mut channels = noisy.channels().channels().to_vec();
        let mut planes: Vec<_> = (0..noisy.channels().planes()).map(|p| noisy.plane(p).clone()).collect();
        // Planes that were there lose what they say: a value, nothing, or a step that few neighbourhoods see.
        for (i, plane) in planes.iter_mut().enumerate() {
            let total = noisy.total();
            match (hash((case * 100 + i) as u64) % 8, noisy.channels().color_planes().contains(&i)) {
                (0, _) => *plane = Plane::Constant(0.7),
                (1, false) => *plane = Plane::Constant(f32::NAN),
                (2, _) => *plane = Plane::Values((0..total).map(|s| f32::from(s > total * 2 / 3)).collect()),
                _ => {}
            }
        }
        for extra in 0..hash(case as u64) % 4 {
            let feature = Role::Feature { position: extra % 2 == 0 };
            let role = if extra < 2 { feature } else { Role::Random { uniform: true } };
            channels.push(Channel::new(format!("extra{extra}"), role, 1));
            planes.push(Plane::Constant([f32::NAN, -1e30, 0.0, 3.5][extra as usize]));
        }
        let channels = ChannelSet::new(channels).unwrap();
        let tile = SampleTile::new(*noisy.geometry(), channels, Counts::Uniform(3), planes).unwrap();
        for method in methods() {
            let on = run(&tile, &method);
            for pool in [None, Some(&pool)] {
                let execution = Execution { seed: 5, pool, leave_out: false, ..Execution::default() };
                let off = filter(&tile, &method, &execution).unwrap();
                assert!(on.rgb.iter().zip(&off.rgb).all(|(on, off)| bits(on) == bits(off)), "{name}, {method:?}");
                assert_eq!(on.report.spikes, off.report.spikes);
                let unused = |l: &LeftOut| l.reason == LeftOutReason::Unused;
                assert!(off.report.left_out.iter().all(unused), "{:?}", off.report.left_out);
                check_work(&on.report, &off.report, tile.total());
                let constant = |r: &Filtered| r.report.left_out.iter().any(|l| !unused(l));
                assert!(!constant(&off) && (constant(&on) || !matches!(method.algorithm(), Algorithm::Rpf(_))));
            }
        }
    }
}

/// Colour channels that are equal are computed once, for the bits of computing each: all three, as in a grey scene, or
/// any two; among them constant ones, missing features, and pixels with different numbers of samples.
#[test]
fn equal_colours_are_computed_once() {
    let geometry = TileGeometry::new([26, 22], Rect::new(0, 0, 26, 22), Halo::default()).unwrap();
    let fixed = scene("all", [26, 22], 3);
    let varying = Scene::by_name("all").unwrap().tile_varying(geometry, 4, &Execution::default()).unwrap();
    for (noisy, counts) in [
        (&fixed, Counts::Uniform(3)),
        (&varying, Counts::Varying((0..26 * 22).map(|p| varying.samples_of(p).len() as u16).collect())),
    ] {
        let colors = noisy.channels().color_planes();
        for (sources, equal) in [
            ([0, 0, 0], &["color.1", "color.2"][..]),
            ([1, 1, 2], &["color.1"]),
            ([0, 1, 0], &["color.2"]),
            ([2, 1, 1], &["color.2"]),
            ([0, 1, 2], &[]),
        ] {
            let plane = |plane: usize| match colors.iter().position(|&color| color == plane) {
                Some(channel) => noisy.plane(colors[sources[channel]]).clone(),
                None => noisy.plane(plane).clone(),
            };
            let planes = (0..noisy.channels().planes()).map(plane).collect();
            let tile = SampleTile::new(*noisy.geometry(), noisy.channels().clone(), counts.clone(), planes).unwrap();
            for method in methods() {
                let on = run(&tile, &method);
                let execution = Execution { seed: 5, leave_out: false, ..Execution::default() };
                let off = filter(&tile, &method, &execution).unwrap();
                assert!(on.rgb.iter().zip(&off.rgb).all(|(on, off)| bits(on) == bits(off)), "{sources:?}, {method:?}");
                assert_eq!(on.report.spikes, off.report.spikes);
                for (k, l) in [(0, 1), (0, 2), (1, 2)] {
                    assert_eq!(sources[k] == sources[l], bits(&on.rgb[k]) == bits(&on.rgb[l]));
                }
                let said = on.report.left_out.iter().filter(|l| l.reason == LeftOutReason::Equal);
                let said: Vec<_> = said.map(|l| l.plane.as_str()).collect();
                let rpf = matches!(method.algorithm(), Algorithm::Rpf(_));
                assert_eq!(said, if rpf { equal } else { &[] });
                check_work(&on.report, &off.report, tile.total());
                assert!(off.report.left_out.iter().all(|l| l.reason == LeftOutReason::Unused));
            }
        }
    }
}

/// Samples that miss a feature, one of whose components is 0 all over a tile, but not all over the image.
#[test]
fn a_component_that_is_zero_in_a_tile_only_gives_the_whole_images_bits() {
    let image = [48, 14];
    let at = |x: u32, y: u32, sample: u32, k: u32| {
        let mixed = (x * 73 + y * 1031 + sample * 7919 + k * 104_729).wrapping_mul(2_654_435_761);
        (mixed >> 8) as f32 / (1 << 24) as f32
    };
    let cut = |core: Rect, halo: u32| {
        let geometry = TileGeometry::with_halo(image, core, halo).unwrap();
        let window = geometry.window();
        let channels = ChannelSet::new(vec![
            Channel::new("color", Role::Color, 3),
            Channel::new("N", Role::Feature { position: false }, 3),
            Channel::new("lens", Role::Random { uniform: true }, 1),
        ]);
        let mut planes = vec![Vec::new(); 7];
        for y in window.y..window.bottom() {
            for x in window.x..window.right() {
                for sample in 0..4 {
                    let missing = at(x, y, sample, 9) < 0.3;
                    let z = if x < 40 { 0.0 } else { at(x, y, sample, 5) };
                    let normal = [at(x, y, sample, 3), at(x, y, sample, 4), z];
                    for (k, plane) in planes.iter_mut().enumerate() {
                        plane.push(match k {
                            3..6 if missing => 0.0,
                            3..6 => normal[k - 3],
                            _ => at(x, y, sample, k as u32),
                        });
                    }
                }
            }
        }
        let planes = planes.into_iter().map(Plane::Values).collect();
        SampleTile::new(geometry, channels.unwrap(), Counts::Uniform(4), planes).unwrap()
    };
    let whole = cut(Rect::new(0, 0, 48, 14), 0);
    for method in methods() {
        let left = cut(Rect::new(0, 0, 12, 14), method.reach(false));
        let constant = matches!(left.plane(5), Plane::Constant(_));
        assert!(matches!(whole.plane(5), Plane::Values(_)) && (constant || method.reach(false) > 28));
        let (whole, left) = (run(&whole, &method), run(&left, &method));
        for (whole, left) in whole.rgb.iter().zip(&left.rgb) {
            for y in 0..14 {
                assert_eq!(bits(&whole[y * 48..y * 48 + 12]), bits(&left[y * 12..y * 12 + 12]), "row {y}");
            }
        }
    }
}

/// Partly missing positions and normals: of these a sample has all components or none, in every tile.
#[test]
fn partly_missing_features_give_the_whole_images_bits() {
    let image = [40, 22];
    let whole = scene("all", image, 3);
    let total = whole.total();
    // Half of the samples lose one component or another; z of the normal is 0 but for a strip at the right.
    let spoil = |plane: usize, sample: usize| {
        let hash = (sample * 31 + plane * 7 + 5).wrapping_mul(2_654_435_761) >> 7;
        let value = whole.value(plane, sample);
        match plane {
            5..11 | 14..20 if hash.is_multiple_of(8) => f32::NAN,
            5..11 | 14..20 if hash % 8 < 3 => 0.0,
            10 if sample / 3 % 40 < 34 => 0.0,
            _ => value,
        }
    };
    let planes: Vec<Vec<f32>> = (0..27).map(|p| (0..total).map(|s| spoil(p, s)).collect()).collect();
    let cut = |geometry: TileGeometry| {
        let window = geometry.window();
        let pixels = (window.y..window.bottom()).flat_map(|y| (window.x..window.right()).map(move |x| y * 40 + x));
        let samples: Vec<usize> = pixels.flat_map(|pixel| whole.samples_of(pixel as usize)).collect();
        let planes = planes.iter().map(|p| Plane::Values(samples.iter().map(|&s| p[s]).collect()));
        SampleTile::new(geometry, whole.channels().clone(), Counts::Uniform(3), planes.collect()).unwrap()
    };
    for method in methods() {
        let expected = tiled(image, 100, 0, &method, cut);
        let tiles = tiled(image, 8, method.reach(false), &method, cut);
        assert!(bits(&tiles) == bits(&expected), "{method:?}");
    }
}

/// With a tolerance the pixels that filtering could help little stay exactly as they are, and are counted; 0 is as
/// without. What nodes only settled pixels would ask for is not computed: there is less work.
#[test]
fn settled_pixels_are_passed_through() {
    let tile = scene("all", [40, 30], 6);
    for preset in ["lean", "paper-fast"] {
        let settings = [("boxes", "15,9,7,5"), ("fractions", "0.05,0.1,0.3,0.5")];
        let settings: &[_] = if preset == "lean" { &[] } else { &settings };
        let with = |tolerance| {
            let settings: Vec<_> = settings.iter().copied().chain([("tolerance", tolerance)]).collect();
            run(&tile, &method(preset, &settings))
        };
        let plain = run(&tile, &method(preset, settings));
        assert_eq!(with("0"), plain);
        assert_eq!((plain.report.settled, plain.report.settled_error), (0, 0.0));
        let before = run(&tile, &method("unfiltered", &[]));
        let (mut last, mut work) = (0, plain.report.work.unwrap().done);
        for (tolerance, limit) in [("0.001", 0.001), ("0.03", 0.03), ("1", 1.0)] {
            let filtered = with(tolerance);
            let Report { settled, settled_error, .. } = filtered.report;
            let same = (0..40 * 30).filter(|&p| (0..3).all(|k| filtered.rgb[k][p] == before.rgb[k][p])).count() as u64;
            assert!(settled >= last && same >= settled, "{settled} settled, {same} the same, {last} before");
            assert!(settled_error >= 0.0 && (settled_error < limit * settled as f64 || settled == 0));
            let done = filtered.report.work.unwrap().done;
            assert!(done <= work, "{done} {work}");
            assert!(tolerance != "0.03" || settled > 100 && settled < 40 * 30, "{settled}");
            (last, work) = (settled, done);
        }
    }
    // One sample says nothing of its noise; without any there is nothing to pass through.
    let one = run(&scene("all", [20, 14], 1), &method("lean", &[("tolerance", "1")]));
    assert_eq!(one.report.settled, 0);
    let none = without_samples(16);
    assert_eq!(run(&none, &method("lean", &[("tolerance", "1")])).report.settled, 0);
}

/// Hole filling looks no further than it has to: this would take hours if it did.
#[test]
fn an_empty_tile_is_quick_whatever_the_box() {
    let method = method("lean", &[("boxes", "255"), ("fractions", "0")]);
    assert_eq!(run(&without_samples(512), &method).report.unfilled, 512 * 512);
}

fn without_samples(side: u32) -> SampleTile {
    let geometry = TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).unwrap();
    let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    SampleTile::new(geometry, channels, Counts::Uniform(0), vec![Plane::Constant(0.0); 3]).unwrap()
}

/// The plainest tiles there are: no film, no features, no random parameters; one or no sample; one pixel.
#[test]
fn the_smallest_tiles_filter() {
    let color = || ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let tile = |size: [u32; 2], counts: Counts, samples: usize| {
        let geometry = TileGeometry::new(size, Rect::new(0, 0, size[0], size[1]), Halo::default()).unwrap();
        let plane = |k: usize| Plane::Values((0..samples).map(|i| ((i * 7 + k) % 5) as f32).collect());
        SampleTile::new(geometry, color(), counts, (0..3).map(plane).collect()).unwrap()
    };
    for (preset, _) in PRESETS {
        for tile in [
            tile([1, 1], Counts::Uniform(1), 1),
            tile([1, 9], Counts::Uniform(2), 18),
            tile([5, 4], Counts::Uniform(0), 0),
            tile([2, 2], Counts::Varying(vec![0, 3, 0, 1]), 4),
        ] {
            let filtered = run(&tile, &method(preset, &[]));
            assert!(filtered.rgb.iter().flatten().all(|v| v.is_finite()));
            assert_eq!(filtered.report.samples as usize, tile.total());
        }
    }
    let empty = run(&tile([5, 4], Counts::Uniform(0), 0), &method("lean", &[]));
    assert_eq!(empty.report.unfilled, 20);
    assert!(empty.rgb.iter().flatten().all(|&v| v == 0.0));
}

/// Colours at the ends of f32, alone and many, leave every pixel finite and within what went in.
#[test]
fn extreme_colours_stay_finite() {
    let noisy = scene("all", [24, 24], 4);
    for (extreme, every) in [(1e4, 97), (1e20, 97), (f32::MAX, 97), (f32::MAX, 2), (-f32::MAX, 5), (1e-42, 3)] {
        let color = noisy.channels().color_planes();
        let planes = (0..noisy.channels().planes()).map(|plane| match noisy.plane(plane) {
            Plane::Values(values) if color.contains(&plane) => Plane::Values(
                values.iter().enumerate().map(|(i, &v)| if i % every == 0 { extreme } else { v }).collect(),
            ),
            other => other.clone(),
        });
        let tile =
            SampleTile::new(*noisy.geometry(), noisy.channels().clone(), Counts::Uniform(4), planes.collect()).unwrap();
        for method in methods() {
            let filtered = run(&tile, &method);
            assert!(filtered.rgb.iter().flatten().all(|v| v.is_finite()), "{extreme:e} every {every}");
        }
    }
}

#[test]
fn a_stop_flag_ends_the_work() {
    let stop = AtomicBool::new(true);
    let tile = scene("all", [16, 16], 2);
    for (preset, _) in PRESETS {
        let execution = Execution { stop: Some(&stop), ..Execution::default() };
        assert_eq!(filter(&tile, &method(preset, &[]), &execution), Err(Stopped));
    }
}
