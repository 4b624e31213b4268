//! The baselines against direct evaluations in f64, and against each other. What they promise as every method does is
//! tried with the others, in `rpf/tests/promises.rs`.

use crate::filter::{
    Channel, ChannelSet, Counts, Execution, Halo, LeftOutReason, Method, Plane, Rect, Role, SampleTile, TileGeometry,
    filter,
};
use crate::synth::Scene;

fn method(preset: &str, settings: &[(&str, &str)]) -> Method {
    Method::with(preset, settings.iter().copied()).unwrap()
}

fn run(tile: &SampleTile, method: &Method) -> [Vec<f32>; 3] {
    filter(tile, method, &Execution::default()).unwrap().rgb
}

fn scene(name: &str, size: [u32; 2], samples: u32) -> SampleTile {
    let geometry = TileGeometry::new(size, Rect::new(0, 0, size[0], size[1]), Halo::default()).unwrap();
    Scene::by_name(name).unwrap().tile(geometry, samples, &Execution::default()).unwrap()
}

/// A copy with some planes replaced.
fn with_planes(tile: &SampleTile, plane: impl Fn(usize, &Role) -> Option<Plane>) -> SampleTile {
    let roles = tile.channels().plane_channels().map(|(channel, _)| channel.role);
    let planes = roles.enumerate().map(|(i, role)| plane(i, &role).unwrap_or_else(|| tile.plane(i).clone())).collect();
    let counts = Counts::Uniform(tile.max_per_pixel());
    SampleTile::new(*tile.geometry(), tile.channels().clone(), counts, planes).unwrap()
}

/// Mean of the present values of a pixel in f64; none if all are missing.
fn mean(tile: &SampleTile, plane: usize, pixel: usize) -> Option<f64> {
    let values: Vec<f64> =
        tile.samples_of(pixel).map(|s| f64::from(tile.value(plane, s))).filter(|v| !v.is_nan()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

fn spread(tile: &SampleTile, plane: usize, pixel: usize) -> f64 {
    let Some(mean) = mean(tile, plane, pixel) else { return 0.0 };
    let values: Vec<f64> =
        tile.samples_of(pixel).map(|s| f64::from(tile.value(plane, s))).filter(|v| !v.is_nan()).collect();
    values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64
}

/// Every pixel by the formulas as they stand: Gaussian of `sigma`, times exp(-`difference`(p, q)).
fn direct(tile: &SampleTile, sigma: f64, difference: impl Fn(usize, usize) -> f64) -> [Vec<f64>; 3] {
    let window = tile.geometry().window();
    let radius = (3.0 * sigma).ceil() as i64;
    tile.channels().color_planes().map(|plane| {
        let pixel = |y: u32, x: u32| {
            let (mut sum, mut total) = (0.0, 0.0);
            for dy in -radius..=radius {
                for dx in -radius..=radius {
                    let (x2, y2) = (i64::from(x) + dx, i64::from(y) + dy);
                    if x2 < 0 || y2 < 0 || x2 >= i64::from(window.width) || y2 >= i64::from(window.height) {
                        continue;
                    }
                    let (p, q) = (window.index(x, y), window.index(x2 as u32, y2 as u32));
                    let Some(color) = mean(tile, plane, q) else { continue };
                    let weight = libm::exp(-((dx * dx + dy * dy) as f64) / (2.0 * sigma * sigma) - difference(p, q));
                    sum += weight * color;
                    total += weight;
                }
            }
            sum / total
        };
        (0..window.height).flat_map(|y| (0..window.width).map(move |x| (y, x))).map(|(y, x)| pixel(y, x)).collect()
    })
}

fn assert_close(got: &[Vec<f32>; 3], expected: &[Vec<f64>; 3]) {
    for (got, expected) in got.iter().flatten().zip(expected.iter().flatten()) {
        assert!((f64::from(*got) - expected).abs() <= 2e-5 * expected.abs() + 1e-7, "{got} is not {expected}");
    }
}

fn color_distance(tile: &SampleTile, p: usize, q: usize, scale: impl Fn(f64) -> f64) -> f64 {
    let planes = tile.channels().color_planes().into_iter();
    planes.map(|plane| (scale(mean(tile, plane, p).unwrap()) - scale(mean(tile, plane, q).unwrap())).powi(2)).sum()
}

#[test]
fn gaussian_is_its_formula() {
    let tile = scene("all", [37, 23], 2);
    for (sigma, text) in [(0.5, "0.5"), (1.3, "1.3"), (4.0, "4")] {
        assert_close(&run(&tile, &method("gaussian", &[("sigma", text)])), &direct(&tile, sigma, |_, _| 0.0));
    }
}

#[test]
fn bilateral_is_its_formula() {
    let tile = scene("all", [33, 18], 3);
    let settings = [("sigma", "1.5"), ("color_sigma", "0.4"), ("color_scale", "linear")];
    let range = |d: f64| d / (2.0 * 0.4 * 0.4);
    let expected = direct(&tile, 1.5, |p, q| range(color_distance(&tile, p, q, |c| c)));
    assert_close(&run(&tile, &method("bilateral", &settings)), &expected);
    let log = method("bilateral", &[settings[0], settings[1], ("color_scale", "log")]);
    let expected = direct(&tile, 1.5, |p, q| range(color_distance(&tile, p, q, libm::log1p)));
    assert_close(&run(&tile, &log), &expected);
}

/// Features with missing samples, missing in whole pixels and everywhere, included.
#[test]
fn cross_bilateral_is_its_formula() {
    let whole = scene("motion", [30, 17], 3);
    let holes = with_planes(&whole, |plane, role| {
        let Plane::Values(values) = whole.plane(plane) else { return None };
        let lost = |i: usize| (i * 7 + plane) % 11 == 4 || (i / 3) % 13 == 5;
        let lose = |(i, &v): (usize, &f32)| if lost(i) { f32::NAN } else { v };
        matches!(role, Role::Feature { .. }).then(|| Plane::Values(values.iter().enumerate().map(lose).collect()))
    });
    for tile in [whole, holes] {
        let settings = [
            ("sigma", "1.2"),
            ("color_sigma", "0.5"),
            ("color_scale", "log"),
            ("feature_sigma", "0.3"),
            ("feature_deviations", "1.5"),
            ("position_deviations", "6"),
        ];
        let expected = direct(&tile, 1.2, |p, q| {
            let mut all = color_distance(&tile, p, q, libm::log1p) / (2.0 * 0.25);
            let mut plane = 0;
            for channel in tile.channels().channels() {
                let planes = plane..plane + channel.components as usize;
                plane = planes.end;
                let Role::Feature { position } = channel.role else { continue };
                let (sigma, deviations) = if position { (0.0, 6.0) } else { (0.3, 1.5) };
                let own: f64 = planes.clone().map(|f| spread(&tile, f, p)).sum();
                let variance = sigma * sigma + deviations * deviations * own;
                for feature in planes {
                    all += match (mean(&tile, feature, p), mean(&tile, feature, q)) {
                        (None, None) => 0.0,
                        (Some(_), _) if variance == 0.0 => 0.0,
                        (Some(p), Some(q)) => (p - q).powi(2) / (2.0 * variance),
                        _ => f64::INFINITY,
                    };
                }
            }
            all
        });
        assert_close(&run(&tile, &method("cross-bilateral", &settings)), &expected);
    }
}

#[test]
fn each_is_the_one_before_where_nothing_differs() {
    let tile = scene("all", [40, 30], 4);
    for scale in ["linear", "log"] {
        let huge = method("bilateral", &[("sigma", "2"), ("color_sigma", "1e30"), ("color_scale", scale)]);
        assert_eq!(run(&tile, &huge), run(&tile, &method("gaussian", &[("sigma", "2")])));
    }
    for value in [0.0, 0.25, -1e30, f32::NAN] {
        let flat = with_planes(&tile, |_, role| {
            matches!(role, Role::Feature { .. }).then(|| Plane::Values(vec![value; tile.total()]))
        });
        let settings = [("sigma", "2"), ("color_sigma", "0.5"), ("color_scale", "log")];
        assert_eq!(run(&flat, &method("cross-bilateral", &settings)), run(&flat, &method("bilateral", &settings)));
    }
}

/// Pixels that lack a feature and pixels that have it do not mix, at any number of samples.
#[test]
fn what_lacks_a_feature_does_not_mix_with_what_has_it() {
    for (position, samples) in [(false, 1), (false, 3), (true, 3)] {
        let geometry = TileGeometry::new([20, 6], Rect::new(0, 0, 20, 6), Halo::default()).unwrap();
        let feature = Channel::new("feature", Role::Feature { position }, 1);
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3), feature]).unwrap();
        let total = 120 * samples;
        let left = |i: usize| (i / samples) % 20 < 9;
        let color = Plane::Values((0..total).map(|i| if left(i) { 1.0 } else { 4.0 }).collect());
        let with = |i: usize| 1.0 + (i % samples) as f32 * 0.1;
        let feature = Plane::Values((0..total).map(|i| if left(i) { f32::NAN } else { with(i) }).collect());
        let planes = vec![color.clone(), color.clone(), color, feature];
        let tile = SampleTile::new(geometry, channels, Counts::Uniform(samples as u32), planes).unwrap();
        let rgb = run(&tile, &method("cross-bilateral", &[("color_sigma", "1e30"), ("sigma", "3")]));
        for (i, value) in rgb[0].iter().enumerate() {
            assert_eq!(*value, if i % 20 < 9 { 1.0 } else { 4.0 }, "pixel {i}, position {position}");
        }
    }
}

#[test]
fn what_is_not_looked_at_is_said() {
    let tile = scene("lens", [12, 12], 2);
    let reason = |preset: &str, plane: &str| {
        let report = filter(&tile, &method(preset, &[]), &Execution::default()).unwrap().report;
        report.left_out.iter().find(|l| l.plane == plane).map(|l| l.reason)
    };
    for preset in ["gaussian", "bilateral"] {
        assert_eq!(reason(preset, "P.0"), Some(LeftOutReason::Unused));
    }
    assert_eq!(reason("cross-bilateral", "P.0"), None);
    for preset in ["gaussian", "bilateral", "cross-bilateral"] {
        assert_eq!(reason(preset, "time"), Some(LeftOutReason::Unused));
        assert_eq!(reason(preset, "color.0"), None);
    }
}

#[test]
fn limits_are_exact_and_say_what_is_right() {
    for (name, good, bad) in [
        ("sigma", "0.1", "0.09"),
        ("sigma", "20", "20.1"),
        ("sigma", "1", "nan"),
        ("color_sigma", "1e-6", "0"),
        ("color_sigma", "1e30", "inf"),
        ("color_scale", "log", "sqrt"),
        ("feature_sigma", "1e-6", "-1"),
        ("feature_deviations", "0", "1e7"),
        ("position_deviations", "1e6", "-0.1"),
    ] {
        let with = |value: &str| Method::with("cross-bilateral", [(name, value)]);
        assert!(with(good).is_ok(), "{name}={good}");
        let message = with(bad).unwrap_err().to_string();
        assert!(message.starts_with(name) && message.contains("must be"), "{message}");
    }
    let message = Method::with("gaussian", [("color_sigma", "1")]).unwrap_err().to_string();
    assert!(message.contains("it has sigma"), "{message}");
    let reach = |varying| method("gaussian", &[("sigma", "1.5")]).reach(varying);
    assert_eq!((reach(false), reach(true)), (5, 10));
}
