//! Each stage against the f64 oracle, on the same inputs and decisions. The stages are discontinuous, so a row within
//! 1e-5 of a clustering, bin or spike threshold is counted and left out.

use super::{is_feature, method, scene};
use crate::filter::lanes::{SimdLevel, dispatch};
use crate::filter::method::Algorithm;
use crate::filter::oracle::{self, Columns, Whole};
use crate::filter::rpf::block::ColumnOrder;
use crate::filter::rpf::iteration::{Pass, Scratch};
use crate::filter::rpf::neighborhood::Offsets;
use crate::filter::rpf::relevance::{Relevant, Source};
use crate::filter::rpf::{Params, draws, information, interleaved_colors, room, spikes};
use crate::filter::{ChannelSet, Counts, Execution, Rect, Role, SampleTile, TileGeometry};
use crate::synth::Scene;

/// Within this of a threshold, a decision may fall either way.
const NEAR: f64 = 1e-5;

/// What the comparison of one stage found.
#[derive(Default)]
struct Tally {
    compared: usize,
    near: usize,
    worst: f64,
}

impl Tally {
    fn add(&mut self, difference: f64) {
        self.compared += 1;
        self.worst = self.worst.max(difference);
    }

    /// The bound, that there was something to compare, and that little was left out.
    fn check(&self, stage: &str, bound: f64) {
        let Self { compared, near, worst } = self;
        println!("{stage}: {compared} compared, {near} near a threshold and left out, worst difference {worst:.2e}");
        assert!(*compared > 1000, "{stage}: only {compared} compared");
        assert!(near * 500 < *compared, "{stage}: {near} of {compared} left out");
        assert!(*worst <= bound, "{stage}: {worst:e} is more than {bound:e}");
    }
}

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn params(preset: &str, settings: &[(&str, &str)]) -> Params {
    match method(preset, settings).algorithm() {
        Algorithm::Rpf(params) => params.clone(),
        _ => unreachable!("only RPF is compared"),
    }
}

/// Runs `compare` at some pixels of a noisy scene, in each iteration, with all that a pass has.
fn at_pixels(params: &Params, tile: &SampleTile, mut compare: impl FnMut(&Pass, &mut Scratch, u32, u32)) {
    let relevant = Relevant::of(tile, true);
    let mut room = room(tile.geometry(), params, tile.total() as u64, tile.max_per_pixel(), tile.varying());
    // The whole image as one block, so that records are numbered like the tile's samples.
    let window = tile.geometry().window();
    (room.pixels, room.samples) = (window.area() as usize, tile.total());
    let (terms, colors) = (information::entropy_terms(room.rows), interleaved_colors(tile));
    let mut scratch = Scratch::new(tile, &relevant, params, &room, true);
    for t in 0..params.boxes.len() {
        let offsets = Offsets::new(params.boxes[t]);
        let execution = Execution { seed: 3, ..Execution::default() };
        let pass = Pass {
            tile,
            relevant: &relevant,
            params,
            t,
            execution: &execution,
            offsets,
            terms: &terms,
            settled: &[],
            colors: &colors,
        };
        dispatch!(SimdLevel::default().level(), simd => pass.load(simd, &mut scratch, &window, true));
        for y in (0..window.height).step_by(5) {
            for x in (0..window.width).step_by(7) {
                compare(&pass, &mut scratch, x, y);
            }
        }
    }
}

fn cases() -> Vec<(Params, SampleTile)> {
    vec![
        (params("paper-fast", &[("boxes", "25,7"), ("fractions", "0.1,0.5")]), scene("all", [40, 30], 8)),
        (params("lean", &[("information_grid", "1")]), scene("glossy", [30, 30], 5)),
        (params("lean", &[("bins", "9"), ("information_grid", "1")]), scene("lens", [30, 30], 3)),
    ]
}

/// The neighbourhood's raw columns, as the oracle takes them.
fn raw_columns(pass: &Pass, scratch: &Scratch) -> Columns {
    let samples = scratch.rows();
    let plane = |plane: usize| samples.iter().map(|&s| f64::from(pass.tile.value(plane, s as usize))).collect();
    let positions = pass.relevant.positions().iter().map(|source| match source {
        Source::Plane(p) => plane(*p),
        _ => unreachable!("these scenes have film positions"),
    });
    let color = |k: usize| samples.iter().map(|&s| f64::from(pass.colors[3 * s as usize + k])).collect();
    Columns {
        positions: positions.collect(),
        random: pass.relevant.random().iter().map(|&p| plane(p)).collect(),
        features: pass.relevant.features().iter().map(|f| plane(f.plane)).collect(),
        colors: (0..3).map(color).collect(),
    }
}

/// The fast path's normalised columns.
fn fast_columns(pass: &Pass, scratch: &mut Scratch) -> Columns {
    let (order, rows) = (ColumnOrder::of(pass.relevant), scratch.rows().len());
    let mut columns = |columns: std::ops::Range<usize>| {
        let normalised = columns.map(|column| {
            dispatch!(SimdLevel::default().level(), simd => scratch.multiply(simd, column, 1.0));
            f64s(&scratch.columns([column])[0][..rows])
        });
        normalised.collect::<Vec<_>>()
    };
    Columns {
        positions: columns(order.positions),
        random: columns(order.random),
        features: columns(order.features),
        colors: columns(order.colors),
    }
}

fn all(columns: &Columns) -> impl Iterator<Item = &Vec<f64>> {
    columns.positions.iter().chain(&columns.random).chain(&columns.features).chain(&columns.colors)
}

fn weigh(pass: &Pass, scratch: &mut Scratch, x: u32, y: u32) {
    assert!(dispatch!(SimdLevel::default().level(), simd => pass.weigh(simd, scratch, x, y)));
}

#[test]
fn neighbourhoods_accept_the_same_candidates() {
    let (mut tally, mut rejected) = (Tally::default(), 0);
    for (params, tile) in cases() {
        let features: Vec<(usize, bool)> = tile
            .channels()
            .plane_channels()
            .enumerate()
            .filter(|(_, (channel, _))| is_feature(&channel.role))
            .map(|(plane, (channel, _))| (plane, channel.role == Role::Feature { position: true }))
            .collect();
        at_pixels(&params, &tile, |pass, scratch, x, y| {
            assert!(dispatch!(SimdLevel::default().level(), simd => pass.gather(simd, scratch, x, y)));
            let window = tile.geometry().window();
            let own = tile.samples_of(window.index(x, y));
            let mut fast = scratch.rows()[own.len()..].iter().copied().peekable();
            for (_, sample) in draws(&pass.offsets, &tile, &params, pass.execution.seed, pass.t, x, y) {
                let sample = sample as u32;
                let (mut accepted, mut margin) = (true, f64::INFINITY);
                for &(plane, position) in &features {
                    let value = |s: usize| f64::from(tile.value(plane, s));
                    let own: Vec<f64> = own.clone().map(value).collect();
                    let deviations = if position { params.position_threshold } else { params.feature_threshold };
                    let cluster = oracle::Cluster::of(&own, deviations, params.threshold_floor);
                    let (inside, near) = cluster.accepts(value(sample as usize));
                    accepted &= inside;
                    margin = margin.min(near);
                }
                if margin < NEAR {
                    tally.near += 1;
                    fast.next_if_eq(&sample);
                } else if accepted {
                    assert_eq!(fast.next(), Some(sample), "at ({x}, {y})");
                    tally.add(0.0);
                } else {
                    rejected += 1;
                    tally.add(0.0);
                }
            }
            assert_eq!(fast.next(), None);
        });
    }
    assert!(rejected > 1000, "only {rejected} rejected");
    tally.check("neighbourhood", 0.0);
}

#[test]
fn columns_normalise_alike_and_fall_into_the_same_bins() {
    let (mut values, mut bins) = (Tally::default(), Tally::default());
    for (params, tile) in cases() {
        at_pixels(&params, &tile, |pass, scratch, x, y| {
            weigh(pass, scratch, x, y);
            let expected = raw_columns(pass, scratch).normalised();
            let fast = fast_columns(pass, scratch);
            for (fast, expected) in all(&fast).zip(all(&expected)) {
                for (&fast, &expected) in fast.iter().zip(expected) {
                    values.add((fast - expected).abs() / expected.abs().max(1.0));
                    let (bin, margin) = oracle::bin(expected, params.bins);
                    if margin < NEAR {
                        bins.near += 1;
                    } else {
                        bins.add(if oracle::bin(fast, params.bins).0 == bin { 0.0 } else { 1.0 });
                    }
                }
            }
        });
    }
    // f32 sums over 16 lanes: about sqrt(|N|) roundings of 6e-8, and as many for the deviation.
    values.check("normalised values", 3e-5);
    bins.check("bins", 0.0);
}

#[test]
fn dependencies_and_weights_agree() {
    let mut tally = Tally::default();
    for (params, tile) in cases() {
        at_pixels(&params, &tile, |pass, scratch, x, y| {
            weigh(pass, scratch, x, y);
            // On the fast path's own columns, so that both count the same bins.
            let columns = fast_columns(pass, scratch);
            let expected = oracle::weigh(&columns, params.bins, pass.t);
            let sum = |column: &[f64], others: &[Vec<f64>]| -> f64 {
                others.iter().map(|other| oracle::information(column, other, params.bins)).sum()
            };
            for (k, color) in columns.colors.iter().enumerate() {
                tally.add((scratch.dependencies.color_random[k] - sum(color, &columns.random)).abs());
                tally.add((scratch.dependencies.color_position[k] - sum(color, &columns.positions)).abs());
                tally.add((f64::from(scratch.weights.color[k]) - expected.alpha[k]).abs());
            }
            for (k, feature) in columns.features.iter().enumerate() {
                tally.add((scratch.dependencies.color_feature[k] - sum(feature, &columns.colors)).abs());
                tally.add((scratch.dependencies.feature_random[k] - sum(feature, &columns.random)).abs());
                tally.add((f64::from(scratch.weights.features[k]) - expected.beta[k]).abs());
            }
            let confidence = (1.0 - expected.color_on_random).powi(2);
            tally.add((f64::from(scratch.weights.confidence) - confidence).abs());
        });
    }
    // Integer counts and f64 sums; the weights are rounded to f32 at the end.
    tally.check("dependencies and weights", 1e-7);
}

#[test]
fn filtered_samples_agree() {
    let mut tally = Tally::default();
    for (params, tile) in cases() {
        at_pixels(&params, &tile, |pass, scratch, x, y| {
            let own = tile.samples_of(tile.geometry().window().index(x, y)).len();
            let mut out = vec![0.0; 3 * own];
            dispatch!(SimdLevel::default().level(), simd => pass.pixel(simd, scratch, None, x, y, &mut out));
            let raw = raw_columns(pass, scratch);
            let weights = oracle::Weights {
                alpha: f64s(&scratch.weights.color),
                beta: f64s(&scratch.weights.features),
                color_on_random: 1.0 - f64::from(scratch.weights.confidence).sqrt(),
            };
            let expected = oracle::filter(&raw.normalised(), &raw.colors, &weights, own, &params);
            for (out, expected) in out.chunks_exact(3).zip(expected) {
                for k in 0..3 {
                    let size = raw.colors[k].iter().fold(1e-30, |size: f64, c| size.max(c.abs()));
                    tally.add((f64::from(out[k]) - expected[k]).abs() / size);
                }
            }
        });
    }
    // Relative to the greatest colour of the neighbourhood. A distance of up to 80 amplifies the columns' 1e-5.
    tally.check("filtered samples", 1e-5);
}

#[test]
fn spikes_agree() {
    let mut tally = Tally::default();
    for (_, tile) in cases() {
        let colors = interleaved_colors(&tile);
        for pixel in 0..tile.geometry().window().area() as usize {
            let samples = tile.samples_of(pixel);
            let mut out = colors[3 * samples.start..3 * samples.end].to_vec();
            let before = out.clone();
            spikes::tame(&mut out);
            for k in 0..3 {
                let channel = |values: &[f32]| f64s(&values.iter().skip(k).step_by(3).copied().collect::<Vec<_>>());
                let (expected, margin) = oracle::tame_spikes(&channel(&before));
                for (fast, expected) in channel(&out).iter().zip(&expected) {
                    if margin < NEAR {
                        tally.near += 1;
                    } else {
                        tally.add((fast - expected).abs() / expected.abs().max(1e-3));
                    }
                }
            }
        }
    }
    tally.check("spikes", 1e-6);
}

/// The whole, through all iterations, with and without the grid. Where a decision fell the other way a pixel, and those
/// that read it, differ a little more: few may.
#[test]
fn whole_images_agree() {
    let in_a_corner = |halo| TileGeometry::with_halo([40, 30], Rect::new(0, 4, 12, 10), halo).unwrap();
    let scene = |name| Scene::by_name(name).unwrap();
    for (what, tile) in [
        ("image", super::scene("all", [18, 14], 4)),
        ("tile with halo", super::part("motion", in_a_corner(20), 3)),
        ("tile with too little halo", super::part("motion", in_a_corner(3), 3)),
        ("holes", scene("all").tile_varying(in_a_corner(3), 2, &Execution::default()).unwrap()),
        ("no film", without_film(&super::scene("glossy", [9, 30], 4))),
    ] {
        for settings in [
            [("information_grid", "1"), ("spikes", "on"), ("tolerance", "0")],
            [("information_grid", "4"), ("spikes", "off"), ("tolerance", "0")],
            [("information_grid", "4"), ("spikes", "on"), ("tolerance", "0.05")],
        ] {
            let method = method("lean", &settings);
            let Algorithm::Rpf(params) = method.algorithm() else { unreachable!("lean is RPF") };
            let execution = Execution { seed: 9, ..Execution::default() };
            let fast = crate::filter::filter(&tile, &method, &execution).unwrap();
            let expected = Whole::new(&tile, params, 9).image();
            if params.tolerance > 0.0 {
                println!("{what}: {} of {} pixels settled", fast.report.settled, expected.len());
            }
            let fast = fast.rgb;
            let mut far = 0;
            for (pixel, expected) in expected.iter().enumerate() {
                let differs =
                    (0..3).any(|k| (f64::from(fast[k][pixel]) - expected[k]).abs() > 1e-4 * expected[k].max(0.01));
                far += usize::from(differs);
            }
            println!("{what}, {settings:?}: {far} of {} pixels differ by more than 1e-4", expected.len());
            assert!(far * 10 < expected.len(), "{what}: {far} of {} pixels differ", expected.len());
        }
    }
}

/// The scalar path, against which speed is measured, computes the same: pixels differ by more only where a decision fell
/// the other way in f32, which is rare but is seen in all that reads such a pixel.
#[test]
fn the_scalar_path_computes_the_same() {
    let in_a_corner = TileGeometry::with_halo([40, 30], Rect::new(0, 4, 12, 10), 9).unwrap();
    let small = [("boxes", "15,9,7"), ("fractions", "0.1,0.2,0.5")];
    for (what, tile) in [
        ("image", scene("all", [24, 20], 8)),
        ("holes", Scene::by_name("all").unwrap().tile_varying(in_a_corner, 6, &Execution::default()).unwrap()),
        ("no film", without_film(&scene("glossy", [20, 20], 4))),
    ] {
        for (preset, settings) in [("lean", &[][..]), ("paper-fast", &small), ("lean", &[("bins", "9")])] {
            let (method, params) = (method(preset, settings), params(preset, settings));
            let fast = crate::filter::filter(&tile, &method, &Execution { seed: 9, ..Execution::default() }).unwrap();
            let scalar = crate::filter::scalar::filter(&tile, &params, 9).unwrap();
            assert_eq!((fast.report.filled, fast.core), (scalar.report.filled, scalar.core));
            let (mut far, mut squares, mut size) = (0, 0.0, 0.0);
            let pixels = fast.rgb[0].len();
            for pixel in 0..pixels {
                let values = [0, 1, 2].map(|k| (f64::from(fast.rgb[k][pixel]), f64::from(scalar.rgb[k][pixel])));
                far += usize::from(values.iter().any(|(a, b)| (a - b).abs() > 1e-4 * b.max(0.01)));
                squares += values.iter().map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
                size += values.iter().map(|(_, b)| b * b).sum::<f64>();
            }
            let rms = (squares / size).sqrt();
            println!("{what}, {preset} {settings:?}: {far} of {pixels} pixels differ by more than 1e-4, RMS {rms:.1e}");
            assert!(far * 10 < pixels && rms < 0.01, "{what}, {preset}: {far} of {pixels}, RMS {rms:e}");
        }
    }
}

fn without_film(tile: &SampleTile) -> SampleTile {
    let planes = 2..tile.channels().planes();
    SampleTile::new(
        *tile.geometry(),
        ChannelSet::new(tile.channels().channels()[1..].to_vec()).unwrap(),
        Counts::Uniform(tile.max_per_pixel()),
        planes.map(|plane| tile.plane(plane).clone()).collect(),
    )
    .unwrap()
}
