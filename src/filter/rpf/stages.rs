//! The fast path stage by stage, for `tests/bench`: what [`Pass`] does with one pixel, so that each part can be timed.
//!
//! A stage reads what those before it have left in [`Stages`], in the order of [`STAGES`].

use super::information::entropy_terms;
use super::iteration::{Pass, Scratch};
use super::relevance::Relevant;
use super::statistics::Span;
use super::{Offsets, Params, interleaved_colors, room, spikes};
use crate::filter::lanes::{Simd, dispatch};
use crate::filter::{Execution, Rect, SampleTile};

/// A part of what is done with a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Step 1: candidates are drawn, and rejected or not.
    Select,
    /// The columns are copied together.
    Gather,
    /// Step 2.
    Normalise,
    /// A bit mask for each bin of each column.
    Histograms,
    /// Step 3: the information of all pairs.
    Information,
    /// Step 5: the columns are scaled, and the samples filtered.
    Bilateral,
    /// Step 6.
    Spikes,
}

/// All of them in order, with their names.
pub const STAGES: [(Stage, &str); 7] = [
    (Stage::Select, "select"),
    (Stage::Gather, "gather"),
    (Stage::Normalise, "normalise"),
    (Stage::Histograms, "histograms"),
    (Stage::Information, "information"),
    (Stage::Bilateral, "bilateral"),
    (Stage::Spikes, "spikes"),
];

/// One thread at work on one pixel after another.
pub struct Stages<'a> {
    pass: &'a Pass<'a>,
    scratch: Scratch,
    spans: [Span; 3],
    out: Vec<f32>,
}

/// Prepares iteration `t` at the pixels of a block, and hands it to `work`.
pub fn with_stages<T>(
    tile: &SampleTile,
    params: &Params,
    t: usize,
    execution: &Execution,
    pixels: &Rect,
    work: impl FnOnce(&mut Stages) -> T,
) -> T {
    let relevant = Relevant::of(tile, execution.leave_out);
    let room = room(tile.geometry(), params, tile.total() as u64, tile.max_per_pixel(), tile.varying());
    let (terms, colors) = (entropy_terms(room.rows), interleaved_colors(tile));
    let offsets = Offsets::new(params.boxes[t]);
    let pass =
        Pass { tile, relevant: &relevant, params, t, execution, offsets, terms: &terms, settled: &[], colors: &colors };
    let mut scratch = Scratch::new(tile, &relevant, params, &room, execution.leave_out);
    dispatch!(execution.simd.level(), simd => pass.load(simd, &mut scratch, pixels, true));
    work(&mut Stages { pass: &pass, scratch, spans: Default::default(), out: Vec::new() })
}

impl Stages<'_> {
    /// Does one stage of a pixel of the block, which must have samples.
    pub fn run(&mut self, stage: Stage, x: u32, y: u32) {
        dispatch!(self.pass.execution.simd.level(), simd => self.stage(simd, stage, x, y));
    }

    #[inline(always)]
    fn stage<S: Simd>(&mut self, simd: S, stage: Stage, x: u32, y: u32) {
        let Self { pass, scratch, spans, out } = self;
        match stage {
            Stage::Select => {
                pass.gather(simd, scratch, x, y);
            }
            Stage::Gather => {
                pass.load_columns(simd, scratch);
                *spans = pass.load_radiance(simd, scratch);
            }
            Stage::Normalise => pass.center_columns(simd, scratch, spans),
            Stage::Histograms => pass.count_bins(simd, scratch),
            Stage::Information => pass.measure_dependencies(simd, scratch),
            Stage::Bilateral => {
                let own = scratch.block.samples_of(x, y).len();
                out.resize(3 * own, 0.0);
                pass.scale_columns(simd, scratch, spans, false, own);
                pass.filter_samples(simd, scratch, spans, out);
            }
            Stage::Spikes => {
                spikes::tame(out);
            }
        }
    }
}
