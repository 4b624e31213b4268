//! What leaving out saves: `paper-fast` on a scene without lens, time and second hits.

use rpfd::filter::{Execution, Halo, Method, Rect, TileGeometry, filter};
use rpfd::synth::Scene;
use std::time::Instant;

/// Medians of alternating runs, so that whatever else the machine does meets both.
#[test]
#[ignore = "measures time: run it by its name on a quiet machine"]
fn leaving_out_saves_time() {
    let geometry = TileGeometry::new([96, 96], Rect::new(0, 0, 96, 96), Halo::default()).unwrap();
    let tile = Scene::by_name("plain").unwrap().tile(geometry, 8, &Execution::default()).unwrap();
    let method = Method::preset("paper-fast").unwrap();
    let mut ratios: Vec<f64> = (0..7)
        .map(|_| {
            let [on, off] = [true, false].map(|leave_out| {
                let started = Instant::now();
                let filtered = filter(&tile, &method, &Execution { leave_out, ..Execution::default() }).unwrap();
                (filtered.rgb, started.elapsed().as_secs_f64())
            });
            assert!(on.0 == off.0);
            println!("on {:.3} s, off {:.3} s", on.1, off.1);
            off.1 / on.1
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    println!("off / on: median {:.2}, {:.2} to {:.2}", ratios[3], ratios[0], ratios[6]);
    assert!(ratios[3] >= 1.4);
}
