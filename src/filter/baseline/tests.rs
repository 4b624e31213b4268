//! The baselines against direct evaluations in f64, and against each other. What they promise as every method does is
//! tried with the others, in `rpf/tests/promises.rs`.

use crate::filter::{
    Channel, ChannelSet, Counts, Execution, Halo, LeftOutReason, Method, Plane, Rect, Role, SampleTile, TileGeometry,
    filter, oracle::baseline,
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

/// Within f32's error of the formulas as they stand, in f64.
fn assert_formula(tile: &SampleTile, method: &Method) {
    let expected = baseline(tile, method.algorithm()).unwrap();
    let got = run(tile, method);
    for (i, expected) in expected.iter().enumerate() {
        for (got, expected) in got.iter().map(|plane| f64::from(plane[i])).zip(expected) {
            assert!((got - expected).abs() <= 2e-5 * expected.abs() + 1e-7, "{got} is not {expected}");
        }
    }
}

#[test]
fn gaussian_is_its_formula() {
    let tile = scene("all", [37, 23], 2);
    ["0.5", "1.3", "4"].iter().for_each(|sigma| assert_formula(&tile, &method("gaussian", &[("sigma", sigma)])));
}

#[test]
fn bilateral_is_its_formula() {
    let tile = scene("all", [33, 18], 3);
    for scale in ["linear", "log"] {
        let settings = [("sigma", "1.5"), ("color_sigma", "0.4"), ("color_scale", scale)];
        assert_formula(&tile, &method("bilateral", &settings));
    }
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
        assert_formula(&tile, &method("cross-bilateral", &settings));
    }
}

/// Pixels without samples do not count, and are filled.
#[test]
fn holes_are_as_in_the_formulas() {
    let geometry = TileGeometry::new([30, 20], Rect::new(5, 4, 18, 12), Halo { left: 5, top: 4, right: 7, bottom: 4 });
    let tile = Scene::by_name("all").unwrap().tile_varying(geometry.unwrap(), 3, &Execution::default()).unwrap();
    let empty = (0..tile.geometry().window().area() as usize).filter(|&pixel| tile.samples_of(pixel).is_empty());
    assert!(empty.count() > 10);
    for preset in ["unfiltered", "gaussian", "bilateral", "cross-bilateral"] {
        assert_formula(&tile, &method(preset, &[]));
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
