//! What the reports of the stored tiles come to.

use std::collections::BTreeMap;

use crate::filter::{LeftOut, Rect, Report, Work, geometry::Halo, samples::Replaced};

/// Counts the planes that a report says were left out, and takes them from it.
pub(super) fn count(sums: &mut BTreeMap<(String, &'static str), u64>, report: &mut Report) {
    for LeftOut { plane, reason } in std::mem::take(&mut report.left_out) {
        *sums.entry((plane, reason.as_str())).or_default() += 1;
    }
}

/// Sums over the reports of the stored tiles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Totals {
    /// Tiles stored.
    pub tiles: u64,
    /// Pixels in their cores.
    pub pixels: u64,
    /// Samples in their cores.
    pub samples: u64,
    /// Values made finite, in the data windows: halos count once for every tile that has them.
    pub replaced: Replaced,
    /// Colour values set by the spike step, over all iterations.
    pub spikes: u64,
    /// Sum of pixel values over channels, before.
    pub energy_in: f64,
    /// Sum of pixel values over channels, after.
    pub energy_out: f64,
    /// Pixels without samples that got their neighbours' mean.
    pub filled: u64,
    /// Pixels without samples that stayed black.
    pub unfilled: u64,
    /// Pixels that were passed through, within the tolerance.
    pub settled: u64,
    /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
    pub settled_error: f64,
    /// Tiles that had less halo than the method reads.
    pub short_of_halo: u64,
    /// The widest halo that a tile would have needed, by side.
    pub halo_needed: Halo,
    /// Bytes of the planes that were left out.
    pub left_out_bytes: u64,
    /// How much was done and left out, by estimate, if any tile says so.
    pub work: Option<Work>,
}

impl Totals {
    pub(super) fn add(&mut self, core: &Rect, report: &Report) {
        self.tiles += 1;
        self.pixels += core.area();
        self.samples += report.samples;
        self.replaced.color += report.replaced.color;
        self.replaced.feature += report.replaced.feature;
        self.replaced.random += report.replaced.random;
        self.replaced.film += report.replaced.film;
        self.spikes += report.spikes;
        self.energy_in += report.energy_in;
        self.energy_out += report.energy_out;
        self.filled += report.filled;
        self.unfilled += report.unfilled;
        self.short_of_halo += u64::from(!report.exact());
        self.settled += report.settled;
        self.settled_error += report.settled_error;
        self.left_out_bytes += report.left_out_bytes;
        if let Some(work) = report.work {
            *self.work.get_or_insert_default() += work;
        }
        let (widest, needed) = (&mut self.halo_needed, &report.halo_needed);
        widest.left = widest.left.max(needed.left);
        widest.top = widest.top.max(needed.top);
        widest.right = widest.right.max(needed.right);
        widest.bottom = widest.bottom.max(needed.bottom);
    }
}
