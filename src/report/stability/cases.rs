//! The table of cases: values at the ends of f32, missing and broken ones, odd shapes, scales.

use super::samples::Samples;
use super::{Against, Back, Base, Bounds, Case, invariances};
use crate::filter::Role;

/// All cases, in the order of the report.
pub fn cases() -> Vec<Case> {
    let groups = [fireflies, broken_values, colors, shapes, far_from_the_origin, scales, features, invariances::cases];
    groups.into_iter().flat_map(|group| group()).collect()
}

/// Changes every `every`-th value of some planes, from the `first` on.
fn some(planes: Vec<&mut Vec<f32>>, first: usize, every: usize, values: &[f32]) {
    for plane in planes {
        for (i, value) in plane.iter_mut().skip(first).step_by(every).enumerate() {
            *value = values[i % values.len()];
        }
    }
}

const FIREFLY: &str = "one value far from all others takes the deviation for itself: colours fall into one histogram bin, their \
     weights vanish, and the value is averaged in its own pixel for good, in others as often as chance draws it";

fn fireflies() -> Vec<Case> {
    let mut cases = Vec::new();
    for (name, value) in [("1e4", 1e4), ("1e20", 1e20), ("max", f32::MAX)] {
        let bounds = Bounds {
            // One sample has all the energy, and is in |N| neighbourhoods more or less, by chance.
            energy: [0.3, 3.0],
            // At first 0.02 as everywhere, which is not to be had: the firefly is sqrt(|N|) = 13 deviations away, so that
            // one row in another bin, 0.01 of alpha, is 0.01 x g/2 x 13^2 x 3 = 60 in the exponent, and what a pixel gets
            // of the firefly is this or e^60 times as much. The steps are compared as strictly as ever.
            whole: f64::INFINITY,
            ..Bounds::usual(
                Against::Median(0.25),
                "one sample of 1024 differs: half of the image must stay within a quarter",
            )
        };
        cases.push(
            Case::new(format!("firefly-{name}"), Base::Image, bounds, move |s| {
                some(s.channel("color"), 545, 9999, &[value])
            })
            .known(FIREFLY),
        );
        let bounds = Bounds {
            energy: [0.3, 3.0],
            ..Bounds::usual(Against::Nothing, "a seventh of the samples: there is no clean image left to compare with")
        };
        cases.push(Case::new(format!("fireflies-{name}"), Base::Image, bounds, move |s| {
            some(s.channel("color"), 3, 7, &[value]);
        }));
    }
    cases
}

fn broken_values() -> Vec<Case> {
    const BROKEN: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let mut cases = Vec::new();
    for (role, channel) in
        [("color", "color"), ("position", "P"), ("feature", "N"), ("random", "light"), ("film", "film")]
    {
        let reason = "one sample in 37 is replaced by its pixel's mean, by 0 or by \"none\": half of the image must stay \
                      within a quarter";
        let bounds = Bounds::usual(Against::Median(0.25), reason);
        cases.push(Case::new(format!("not-finite-{role}"), Base::Image, bounds, move |s| {
            some(s.channel(channel), 5, 37, &BROKEN)
        }));
        let reason = "every value is replaced: there is no such channel any more";
        let bounds = Bounds::usual(Against::Nothing, reason);
        cases.push(Case::new(format!("all-nan-{role}"), Base::Image, bounds, move |s| {
            Samples::map(s.channel(channel), |_| f32::NAN)
        }));
    }
    cases
}

fn colors() -> Vec<Case> {
    let mirrored =
        "every step is odd in the colours but for the order of sums: the last bits, and a decision now and then";
    let mut cancels = Bounds::usual(Against::Nothing, "what is negative is as good as any other value");
    // Sums of both signs have any ratio.
    cancels.energy = [f64::NEG_INFINITY, f64::INFINITY];
    let denormal = Bounds {
        // A denormal of 1e-40 has 16 bits: its own rounding is 1e-5, and that of the result as much.
        step_rms: 1e-4,
        ..Bounds::usual(
            Against::Median(1e-2),
            "the input is rounded by 1e-5 of its size, which moves a row in 1000 to another bin",
        )
    };
    vec![
        Case::new("negative-all", Base::Image, Bounds::usual(Against::Rms(1e-2), mirrored), |s| {
            Samples::map(s.channel("color"), |v| -v);
        })
        .back(Back::Divided(-1.0)),
        Case::new("negative-some", Base::Image, cancels, |s| some(s.channel("color"), 2, 5, &[-1.0, -30.0])),
        Case::new("denormal-color", Base::Image, denormal, |s| Samples::map(s.channel("color"), |v| v * 1e-40))
            .back(Back::Divided(f64::from(1e-40_f32)))
            .known_of_baselines(COLOR_SIGMA)
            // At first 1e-5 as everywhere: but each product of a weight and a colour is rounded to 1.4e-45, 1.4e-5 of the
            // colour, and a pixel is the sum of tens of them.
            .whole_of_baselines(super::WHOLE, 1e-4),
        Case::new(
            "denormal-features",
            Base::Image,
            Bounds::usual(Against::Nothing, "all features are within the floor of 0.1: others are accepted"),
            |s| {
                Samples::map(s.features(), |v| v * 1e-40);
            },
        )
        // Not bounded: a cross-bilateral filter scales differences by 1e30 at most, so positions that all lie within 1e-30
        // of each other are one place to it, and two to the oracle.
        .whole_of_baselines(f64::INFINITY, f64::INFINITY),
        Case::new("all-equal", Base::Image, exact_steps("nothing varies: every mean is the value itself"), |s| {
            s.planes.iter_mut().for_each(|plane| {
                let first = plane[0];
                plane.fill(first);
            });
        }),
        Case::new(
            "equal-in-pixel",
            Base::Image,
            Bounds::usual(Against::Nothing, "deviations of 0 within each pixel: clusters are as wide as the floor"),
            |s| {
                s.planes.iter_mut().for_each(|plane| plane.chunks_exact_mut(4).for_each(|pixel| pixel.fill(pixel[0])));
            },
        ),
    ]
}

/// The image is constant: the fast path must return it, which the oracle's f64 mean is within a rounding of.
fn exact_steps(reason: &'static str) -> Bounds {
    let bounds = Bounds::usual(Against::Nothing, reason);
    Bounds { step: 1e-6, step_rms: 1e-6, differently: 0.0, whole: 1e-6, energy: [1.0 - 1e-6, 1.0 + 1e-6], ..bounds }
}

fn shapes() -> Vec<Case> {
    let plain = |reason| Bounds::usual(Against::Nothing, reason);
    let exactly = |reason| Bounds::usual(Against::Exactly, reason);
    let holes = "pixels without samples are filled, nodes without samples leave their share to others";
    let mut one_left = Bounds::usual(Against::Nothing, holes);
    // Filling makes light where none was sampled.
    one_left.energy = [0.5, f64::INFINITY];
    let mut zero_or_one = one_left.clone();
    zero_or_one.energy = [0.5, 4.0];
    let border = |s: &mut Samples| {
        let edge = |i: usize| (i / 4) % 16 >= 8;
        let dim = |plane: &mut Vec<f32>, by: f32| {
            plane.iter_mut().enumerate().for_each(|(i, v)| *v *= if edge(i) { by } else { 1.0 })
        };
        s.channel("color").into_iter().for_each(|plane| dim(plane, 1e-3));
        s.features().into_iter().for_each(|plane| dim(plane, -4.0));
    };
    let mut many =
        Case::new("spp-1024", Base::ManySamples, plain("deviations shrink with the samples: g grows by 128"), |_| {});
    // Distances are 128 times as steep as at 8 samples, so errors weigh sqrt(128) as much; the filter then tells
    // apart what differs by a hundredth of a deviation.
    (many.bounds.step, many.bounds.step_rms) = (12.0 * super::STEP, 12.0 * super::STEP_RMS);
    // A neighbourhood has 20 times the usual values, so every pixel has one near a bin's edge.
    many.bounds.differently = 1.0;
    many.settings = vec![("max_neighbors", "2048")];
    vec![
        Case::new("clean", Base::Image, exactly("nothing is changed"), |_| {}),
        Case::new("spp-1", Base::OneSample, plain("deviations within a pixel are 0, n - 1 would be too"), |_| {}),
        many,
        Case::new("spp-0-or-1", Base::Image, zero_or_one, |s| s.thin(|pixel| (pixel % 3 == 0).into())),
        Case::new("one-pixel-left", Base::Image, one_left, |s| s.thin(|pixel| if pixel == 100 { 4 } else { 0 })),
        Case::new("image-1x1", Base::Size(1, 1), plain("no neighbours at all"), |_| {}),
        Case::new("image-1x24", Base::Size(1, 24), plain("narrower than every box"), |_| {}),
        Case::new("image-24x1", Base::Size(24, 1), plain("lower than every box"), |_| {}),
        Case::new(
            "image-3x20",
            Base::Size(3, 20),
            plain("narrower than every box, and than the grid's spacing"),
            |_| {},
        ),
        Case::new("tiles-1x1", Base::Small, exactly("tiles with enough halo give the whole image's bits"), |_| {})
            .back(Back::Tiles(1)),
        Case::new(
            "tiles-1xn",
            Base::Size(1, 20),
            exactly("tiles with enough halo give the whole image's bits"),
            |_| {},
        )
        .back(Back::Tiles(7)),
        Case::new(
            "border-between-tiles",
            Base::Image,
            exactly("a tile's edge on an edge of the scene must not matter"),
            border,
        )
        .back(Back::Tiles(8)),
    ]
}

fn far_from_the_origin() -> Vec<Case> {
    let offsets = [("1e3", 1e3), ("1e4", 1e4), ("1e5", 1e5), ("1e6", 1e6), ("1e7", 1e7), ("1e8", 1e8), ("1e9", 1e9)];
    let case = |(name, offset): (&str, f32)| {
        let bounds = if offset < 1e5 {
            Bounds::usual(
                Against::Rms(0.1),
                "positions are rounded by a centimetre's tenth at most: a candidate now and then",
            )
        } else {
            // The steps' bounds stay: whatever is left of the positions must be used as well as any other.
            Bounds::usual(
                Against::Nothing,
                "f32 itself has no centimetres there: the input is another, the oracle's too",
            )
        };
        Case::new(format!("offset-{name}"), Base::Image, bounds, move |s| Samples::map(s.channel("P"), |v| v + offset))
    };
    offsets.into_iter().map(case).collect()
}

const UNITS: &str = "a difference of 0.1 is never too far, in the scene's own unit: in smaller units everything is accepted, in \
     larger ones only what is near";

const COLOR_SIGMA: &str =
    "a bilateral filter's color_sigma is a radiance: the darker the image, the less colours differ by it";

fn scales() -> Vec<Case> {
    let mut cases = Vec::new();
    let reason = "the unit is nothing that the image shows";
    // Beside normals and albedo positions reject little; alone they must do it all.
    for (group, base) in [("units", Base::Image), ("units-alone", Base::Positions)] {
        for (name, scale) in [("1e-6", 1e-6), ("1e-3", 1e-3), ("1e3", 1e3), ("1e6", 1e6)] {
            let bounds = Bounds::usual(Against::Rms(0.02), reason);
            let case = Case::new(format!("{group}-{name}"), base, bounds, move |s| {
                Samples::map(s.channel("P"), |v| v * scale);
            });
            cases.push(case.known(UNITS));
        }
    }
    for (name, scale) in [("1e-6", 1e-6_f32), ("1e-3", 1e-3), ("1e3", 1e3), ("1e6", 1e6)] {
        let reason =
            "colours are normalised: what is left is their rounding, and a row in 1000 that it moves to another bin";
        let bounds = Bounds::usual(Against::Rms(0.02), reason);
        let case = Case::new(format!("exposure-{name}"), Base::Image, bounds, move |s| {
            Samples::map(s.channel("color"), |v| v * scale)
        });
        cases.push(case.back(Back::Divided(scale.into())).known_of_baselines(COLOR_SIGMA));
    }
    cases
}

const TWICE: &str = "dependencies are of pairs only: what two features both say counts twice, in their own weights and \
     against the others";

const EVERY_CHANNEL: &str = "a cross-bilateral filter has a Gaussian for every feature channel, whatever the others say: one more \
     narrows its weights";

fn features() -> Vec<Case> {
    let feature = Role::Feature { position: false };
    let quantise = |values: &mut [f32], steps: f32| {
        let present = values.iter().copied().filter(|v| !v.is_nan());
        let (least, greatest) = (present.clone().fold(f32::MAX, f32::min), present.fold(f32::MIN, f32::max));
        let step = (greatest - least) / steps;
        values.iter_mut().for_each(|v| *v = least + ((*v - least) / step).round() * step);
    };
    let overflow = |s: &mut Samples| {
        some(s.channel("color"), 11, 50, &[1e5, 7e4]);
    };
    let like = |s: &mut Samples, channel: &str, name: &str, role: Role, of: fn(f32) -> f32| {
        let plane = s.channel(channel)[0].iter().map(|&v| of(v)).collect();
        s.add(name, role, plane);
    };
    let usual = |clean, reason| Bounds::usual(clean, reason);
    let mut few_values =
        usual(Against::Median(0.1), "half a step is 0.2 % of a feature's range, some per cent of its deviation around");
    // Columns of few values can have many rows on the same edge of a bin: they move together, or not.
    few_values.differently = 0.1;
    vec![
        Case::new("stiff-1e12", Base::Image, usual(Against::Nothing, "features of 1e6 beside others of 1e-6: each is normalised by itself"), |s| {
            Samples::map(s.channel("P"), |v| v * 1e6);
            Samples::map(s.channel("albedo"), |v| v * 1e-6);
        }),
        Case::new("features-duplicated", Base::Image, usual(Against::Seeds(2.0), "a copy says nothing new"), move |s| {
            for copy in ["N again", "N once more"] {
                like(s, "N", copy, feature, |v| v);
            }
        }).known(TWICE).known_of_baselines(EVERY_CHANNEL),
        Case::new("features-correlated", Base::Image, usual(Against::Seeds(2.0), "a linear function says nothing new"), move |s| {
            like(s, "albedo", "shade", feature, |v| 1.0 - 2.0 * v);
        }).known(TWICE).known_of_baselines(EVERY_CHANNEL),
        Case::new("feature-is-random", Base::Image, usual(Against::Seeds(2.0), "a feature that is a random parameter has weight 0; it still clusters"), move |s| {
            like(s, "lens", "lens again", feature, |v| v);
        }).known("a feature of noise rejects three candidates in a thousand and more, and takes its share of the colour's dependence").known_of_baselines(EVERY_CHANNEL),
        Case::new("random-is-color", Base::Image, usual(Against::Nothing, "a colour that is a random parameter is noise: it is averaged away"), move |s| {
            like(s, "color", "noise", Role::Random { uniform: false }, |v| v);
        }),
        Case::new("features-8-bit", Base::Image, few_values, move |s| {
            s.features().into_iter().for_each(|plane| quantise(plane, 255.0));
        }),
        Case::new("f16-overflow", Base::Image, usual(Against::Median(0.25), "one sample in 50 becomes its pixel's mean, all others lose 13 bits"), overflow)
            .over_the_wire_as_f16(),
    ]
}
