//! Unfiltered: the mean of each pixel's samples (a box filter of one pixel).

use crate::filter::{Execution, Filtered, LeftOut, LeftOutReason, Report, Role, SampleTile, Stopped};

/// Mean of some colour values in f64; 0 for none.
pub(crate) fn mean(values: impl ExactSizeIterator<Item = f32>) -> f64 {
    let count = values.len();
    if count == 0 { 0.0 } else { values.map(f64::from).sum::<f64>() / count as f64 }
}

/// Every core pixel's mean; a pixel without samples is black.
pub(crate) fn filter(tile: &SampleTile, execution: &Execution) -> Result<Filtered, Stopped> {
    let (core, window) = (tile.geometry().core(), tile.geometry().window());
    let left_out = tile
        .channels()
        .planes_of(|role| *role != Role::Color)
        .into_iter()
        .map(|plane| LeftOut { plane: tile.channels().plane_name(plane), reason: LeftOutReason::Unused })
        .collect();
    let report = Report { replaced: tile.replaced(), halo: tile.geometry().halo(), ..Report::default() };
    let mut report = report.leaving_out(left_out, tile);
    let color = tile.channels().color_planes();
    let mut rgb = color.map(|_| Vec::with_capacity(core.area() as usize));
    for y in core.y..core.bottom() {
        if execution.stopped() {
            return Err(Stopped);
        }
        for x in core.x..core.right() {
            let samples = tile.samples_of(window.index(x, y));
            report.samples += samples.len() as u64;
            report.unfilled += u64::from(samples.is_empty());
            for (plane, out) in color.into_iter().zip(&mut rgb) {
                let mean = mean(samples.clone().map(|sample| tile.value(plane, sample)));
                report.energy_in += mean;
                out.push(mean as f32);
            }
        }
    }
    report.energy_out = report.energy_in;
    Ok(Filtered { core, rgb, report })
}
