//! From filtered pixels to the core: counts, energy, and what becomes of pixels without samples.

use super::{Execution, Filtered, Rect, Report, SampleTile, Stopped, baseline::mean::mean};

/// Copies out the core. `pixel` gives a filtered pixel by its image coordinates, none if it has no samples: such a one
/// becomes the mean of the filtered pixels in the smallest odd window around it that has any, up to `fill_reach` pixels
/// away; if none has, it is black and counted.
pub(crate) fn finish(
    tile: &SampleTile,
    pixel: impl Fn(u32, u32) -> Option<[f64; 3]>,
    fill_reach: u32,
    mut report: Report,
    execution: &Execution,
) -> Result<Filtered, Stopped> {
    let (core, window) = (tile.geometry().core(), tile.geometry().window());
    let planes = tile.channels().color_planes();
    let mut rgb = [(); 3].map(|()| Vec::with_capacity(core.area() as usize));
    for y in core.y..core.bottom() {
        for x in core.x..core.right() {
            if execution.stopped() {
                return Err(Stopped);
            }
            let samples = tile.samples_of(window.index(x, y));
            report.samples += samples.len() as u64;
            for plane in planes {
                report.energy_in += mean(samples.clone().map(|s| tile.value(plane, s)));
            }
            let value = pixel(x, y).or_else(|| {
                // In a tile without samples there is nothing to find.
                let reach = if tile.total() == 0 { 0 } else { fill_reach };
                let filled = fill(&window, &pixel, x, y, reach);
                *if filled.is_some() { &mut report.filled } else { &mut report.unfilled } += 1;
                filled
            });
            for (value, plane) in value.unwrap_or([0.0; 3]).into_iter().zip(&mut rgb) {
                report.energy_out += value;
                plane.push(value as f32);
            }
        }
    }
    Ok(Filtered { core, rgb, report })
}

/// Mean of the filtered pixels in the smallest window around a pixel that has any.
fn fill(window: &Rect, pixel: &impl Fn(u32, u32) -> Option<[f64; 3]>, x: u32, y: u32, reach: u32) -> Option<[f64; 3]> {
    (1..=reach).find_map(|radius| {
        let around = Rect::new(x, y, 1, 1).grown(radius, window);
        let (mut sum, mut count) = ([0.0; 3], 0.0);
        let across = around.x..around.right();
        for row in around.y..around.bottom() {
            // Nearer pixels have no samples, else a smaller window would have done: only the ring is new.
            let edge = row.abs_diff(y) == radius;
            let sides = [x.wrapping_sub(radius), x + radius].into_iter().filter(|side| !edge && across.contains(side));
            let ring = if edge { across.clone() } else { 0..0 }.chain(sides);
            for mean in ring.filter_map(|x| pixel(x, row)) {
                sum = std::array::from_fn(|k| sum[k] + mean[k]);
                count += 1.0;
            }
        }
        (count > 0.0).then(|| sum.map(|s| s / count))
    })
}
