//! The sweep that chose the baselines' default parameters, as their documentation prints it.

use super::{SCENES, data, loaded};
use rpfd::filter::{Execution, Method, filter};
use rpfd::report::errors;

/// Settings of a preset, one per row of its table.
type Settings = Vec<(&'static str, String)>;

fn settings(preset: &str) -> Vec<Settings> {
    let mut all = Vec::new();
    let texts = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>();
    match preset {
        "gaussian" => {
            all.extend(
                texts(&[0.3, 0.4, 0.5, 0.6, 0.75, 1.0, 1.5, 2.0]).into_iter().map(|sigma| vec![("sigma", sigma)]),
            );
        }
        "bilateral" => {
            for scale in ["linear", "log"] {
                for sigma in texts(&[1.0, 1.5, 2.0, 3.0]) {
                    for color in texts(&[0.1, 0.2, 0.4, 0.8, 1.6]) {
                        let scale = ("color_scale", scale.to_owned());
                        all.push(vec![scale, ("sigma", sigma.clone()), ("color_sigma", color)]);
                    }
                }
            }
        }
        _ => {
            for (sigma, color) in SPACE.iter().flat_map(|s| COLOR.map(|c| (s, c))) {
                for (feature, deviations) in FEATURE.iter().flat_map(|f| DEVIATIONS.map(|d| (f, d))) {
                    for position in POSITION {
                        all.push(vec![
                            ("color_scale", "log".to_owned()),
                            ("sigma", sigma.to_string()),
                            ("color_sigma", color.to_string()),
                            ("feature_sigma", feature.to_string()),
                            ("feature_deviations", deviations.to_string()),
                            ("position_deviations", position.to_string()),
                        ]);
                    }
                }
            }
        }
    }
    all
}

const SPACE: [f64; 3] = [2.0, 3.0, 4.0];
const COLOR: [f64; 3] = [1.6, 3.2, 6.4];
const FEATURE: [f64; 3] = [0.025, 0.05, 0.1];
const DEVIATIONS: [f64; 3] = [0.5, 1.0, 2.0];
const POSITION: [f64; 3] = [5.0, 10.0, 30.0];

/// Geometric mean over the scenes of relMSE at 8 samples per pixel; the best is the default.
#[test]
#[ignore = "takes minutes: run it by its name, with RPFD_DATA"]
fn baselines_sweep() {
    let Some(folder) = data() else { return };
    let pool = rayon::ThreadPoolBuilder::new().build().unwrap();
    let scenes = SCENES.map(|scene| loaded(&folder, scene, 8));
    let mut wrong = Vec::new();
    for preset in ["gaussian", "bilateral", "cross-bilateral"] {
        let mut best = (f64::INFINITY, String::new());
        for settings in settings(preset) {
            let method = Method::with(preset, settings.iter().map(|(name, value)| (*name, value))).unwrap();
            let mut relmse = Vec::new();
            for (tile, reference, noise) in &scenes {
                let execution = Execution { pool: Some(&pool), ..Execution::default() };
                let [r, g, b] = filter(tile, &method, &execution).unwrap().rgb;
                let pixels: Vec<[f32; 3]> = r.into_iter().zip(g).zip(b).map(|((r, g), b)| [r, g, b]).collect();
                relmse.push(errors(&pixels, reference).unwrap().relmse - noise);
            }
            let mean = (relmse.iter().map(|e| e.ln()).sum::<f64>() / 5.0).exp();
            let values: Vec<&str> = settings.iter().map(|(_, value)| value.as_str()).collect();
            println!("{preset} | {} | {mean:.4} | {relmse:.4?}", values.join(" | "));
            if mean < best.0 {
                best = (mean, format!("{settings:?}"));
            }
        }
        println!("{preset}: best {:.4} with {}", best.0, best.1);
        let default = Method::preset(preset).unwrap().parameters();
        if !default.iter().all(|(name, value)| best.1.contains(&format!("({name:?}, {value:?})"))) {
            wrong.push(preset);
        }
    }
    assert!(wrong.is_empty(), "the best are not the defaults of {wrong:?}");
}
