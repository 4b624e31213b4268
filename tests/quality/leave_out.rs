//! What leaving out saves: `paper-fast` on a scene without lens, time and second hits, and others; and whether what the
//! report says of it is so.

use rpfd::filter::{Counts, Execution, Halo, Method, Plane, Rect, SampleTile, TileGeometry, filter};
use rpfd::{report::machine::cpu_seconds, synth::Scene};

/// A scene's whole image; a grey one has its red in all three channels.
fn tile(scene: &str, grey: bool) -> SampleTile {
    let geometry = TileGeometry::new([96, 96], Rect::new(0, 0, 96, 96), Halo::default()).unwrap();
    let tile = Scene::by_name(scene).unwrap().tile(geometry, 8, &Execution::default()).unwrap();
    let colors = tile.channels().color_planes();
    let plane = |plane: usize| tile.plane(if grey && colors.contains(&plane) { colors[0] } else { plane }).clone();
    let planes: Vec<Plane> = (0..tile.channels().planes()).map(plane).collect();
    SampleTile::new(geometry, tile.channels().clone(), Counts::Uniform(8), planes).unwrap()
}

/// Medians of alternating runs, so that whatever else the machine does meets both.
#[test]
#[ignore = "measures time: run it by its name on a quiet machine"]
fn leaving_out_saves_time() {
    println!("scene, preset: CPU time off / on, median (least to greatest); estimated from the report's work");
    for (scene, grey) in
        [("plain", false), ("plain", true), ("glossy", false), ("lens", false), ("all", false), ("all", true)]
    {
        let tile = tile(scene, grey);
        for preset in ["paper-fast", "lean"] {
            let method = Method::preset(preset).unwrap();
            let mut estimated = 0.0;
            let mut ratios: Vec<f64> = (0..7)
                .map(|_| {
                    let [on, off] = [true, false].map(|leave_out| {
                        let started = cpu_seconds();
                        let filtered =
                            filter(&tile, &method, &Execution { leave_out, ..Execution::default() }).unwrap();
                        (filtered, cpu_seconds() - started)
                    });
                    assert!(on.0.rgb == off.0.rgb);
                    estimated = 1.0 / (1.0 - on.0.report.work.unwrap().saved_share());
                    off.1 / on.1
                })
                .collect();
            ratios.sort_by(f64::total_cmp);
            let shade = if grey { ", grey" } else { "" };
            println!(
                "{scene}{shade}, {preset}: {:.2} ({:.2} to {:.2}); {estimated:.2}",
                ratios[3], ratios[0], ratios[6]
            );
            if scene == "plain" && preset == "paper-fast" {
                assert!(ratios[3] >= 1.4);
            }
        }
    }
}
