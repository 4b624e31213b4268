//! How much work the steps are, as [`Work`] counts it: from shapes and counts only, so that it is reproducible.
//!
//! The costs are shares of a profile (`paper-fast` at 8 samples per pixel on a path-traced render with 26 planes, one
//! thread of a Zen 4 with AVX-512), rounded. `tests/quality/leave_out.rs` holds the share that they say is saved
//! against the time that `--leave-out off` takes.

use super::iteration::{Pass, Scratch};
use super::params::Params;
use super::statistics::Span;
use crate::filter::{ChannelSet, Role, Work};

/// Drawing a candidate.
const DRAW: u64 = 175;
/// Testing a candidate against the pixel's own samples in one feature.
const CLUSTER: u64 = 1;
/// Copying a row of a column into place and normalising it.
const LOAD: u64 = 15;
/// Finding the bin of a row of a column.
const HISTOGRAM: u64 = 4;
/// The information of a pair of columns, for each of the bins but one; of a pair with a constant one, for one bin.
const PAIR: u64 = 105;
/// The weight of a pair of samples, and what it adds to the sums.
const WEIGHT: u64 = 10;
/// The difference of a pair of samples in one column: the unit.
const DIFFERENCE: u64 = 1;

/// How many columns there are of each role.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Columns {
    pub(crate) positions: u64,
    pub(crate) random: u64,
    pub(crate) features: u64,
    pub(crate) colors: u64,
}

impl Columns {
    /// Those that the planes of a tile make, but for some planes.
    pub(crate) fn of(channels: &ChannelSet, without: &[usize]) -> Self {
        let count = |wanted: fn(&Role) -> bool| {
            channels.planes_of(wanted).iter().filter(|plane| !without.contains(plane)).count() as u64
        };
        // Without a film position the pixel's centre takes its place.
        let film = channels.channels().iter().any(|channel| channel.role == Role::Film);
        Self {
            positions: if film { count(|role| *role == Role::Film) } else { 2 },
            random: count(|role| matches!(role, Role::Random { .. })),
            features: count(|role| matches!(role, Role::Feature { .. })),
            colors: count(|role| *role == Role::Color),
        }
    }

    const fn all(&self) -> u64 {
        self.positions + self.random + self.features + self.colors
    }

    /// Pairs whose information is asked for.
    const fn pairs(&self) -> u64 {
        self.colors * (self.positions + self.random + self.features) + self.features * (self.positions + self.random)
    }

    /// What the filter compares.
    const fn compared(&self) -> u64 {
        self.features + self.colors
    }
}

/// Step 1, for so many candidates.
const fn drawing(candidates: u64, features: u64) -> u64 {
    candidates * (DRAW + features * CLUSTER)
}

/// Steps 2 and 3: of the columns that are loaded some are put into histograms, and of these some vary.
fn weighing(rows: u64, [loaded, informed, varying]: [&Columns; 3], bins: u32) -> u64 {
    let columns = LOAD * loaded.all() + HISTOGRAM * informed.all();
    rows * columns + PAIR * ((u64::from(bins) - 1) * varying.pairs() + informed.pairs() - varying.pairs())
}

/// Step 5: the columns that are loaded for it, and those that are compared.
const fn filtering(own: u64, rows: u64, loaded: u64, compared: u64) -> u64 {
    rows * LOAD * loaded + own * rows * (WEIGHT + DIFFERENCE * compared)
}

impl Pass<'_> {
    /// Counts steps 1 to 4 at the pixel in `scratch`, if it lies in the core.
    pub(super) fn count_weighing(&self, scratch: &mut Scratch, spans: &[Span; 3], x: u32, y: u32) {
        if !self.tile.geometry().core().contains(x, y) {
            return;
        }
        let (all, kept, varying) =
            (&self.relevant.columns, &self.relevant.kept(), &scratch.varying(self.relevant.twins()));
        let (rows, candidates, bins) = (scratch.count as u64, self.candidates(x, y), self.params.bins);
        let cost = |columns: [&Columns; 3]| drawing(candidates, columns[0].features) + weighing(rows, columns, bins);
        let colors = spans.iter().filter(|span| !span.constant()).count() as u64;
        let everything = cost([all, all, &Columns { colors, ..*varying }]);
        let without_planes = cost([kept, kept, varying]);
        let done = if self.execution.leave_out { cost([kept, varying, varying]) } else { without_planes };
        let (planes, columns) = (everything - without_planes, without_planes - done);
        scratch.work += Work { done, planes, columns, ..Work::default() };
    }

    /// Counts step 5 at the pixel in `scratch`, if it lies in the core, and steps 1 and 2 with `interpolated` weights.
    pub(super) fn count_filtering(&self, scratch: &mut Scratch, interpolated: bool, x: u32, y: u32) {
        if !self.tile.geometry().core().contains(x, y) {
            return;
        }
        let (all, kept) = (self.relevant.columns, self.relevant.kept());
        let own = self.tile.samples_of(self.tile.geometry().window().index(x, y)).len() as u64;
        let rows = scratch.count as u64;
        // A column that is there twice is loaded once; compared too, if it is that of a grey scene.
        let (active, loaded) = (&scratch.active, scratch.loaded as u64);
        let again = active.windows(2).filter(|pair| kept.colors == 1 && pair[0] == pair[1]).count();
        let compared = (active.len() - again) as u64;
        let twice = if kept.colors == 2 { 1 } else { 0 };
        let (candidates, share) = (self.candidates(x, y), u64::from(interpolated));
        let cost = |features: u64, loaded: u64, compared: u64| {
            share * drawing(candidates, features) + filtering(own, rows, share * loaded, compared)
        };
        let done = cost(kept.features, loaded, compared);
        let without_planes = cost(kept.features, kept.compared(), kept.compared() + twice);
        let everything = cost(all.features, all.compared(), all.compared());
        scratch.work +=
            Work { done, planes: everything - without_planes, distances: without_planes - done, ..Work::default() };
    }

    fn candidates(&self, x: u32, y: u32) -> u64 {
        let own = self.tile.samples_of(self.tile.geometry().window().index(x, y)).len();
        (self.params.neighbors(self.t, own) - own) as u64
    }
}

/// What is to be expected, for each pixel with so many samples: as if every candidate were accepted, everything weighed
/// something, and none of the columns that are kept were constant. For as many pixels as share a node of the grid.
pub(crate) fn forecast(params: &Params, samples: u32, all: &Columns, kept: &Columns) -> Work {
    let own = samples as usize;
    let nodes = u64::from(params.information_grid).pow(2);
    let cost = |columns: &Columns, varying: &Columns| -> u64 {
        let passes = (0..params.boxes.len()).map(|t| {
            let rows = params.neighbors(t, own);
            let (drawn, rows, own) = (drawing((rows - own) as u64, columns.features), rows as u64, own as u64);
            let weighed = drawn + weighing(rows, [columns, columns, varying], params.bins);
            let twice = if columns.colors == 2 { 1 } else { 0 };
            let filtered = |loaded| filtering(own, rows, loaded, columns.compared() + twice);
            match nodes {
                1 => weighed + filtered(0),
                _ => weighed + nodes * (drawn + filtered(columns.compared())),
            }
        });
        passes.sum()
    };
    // What is left out of colours are copies, which vary as much as what they are copies of.
    let (done, everything) = (cost(kept, kept), cost(all, &Columns { colors: all.colors, ..*kept }));
    Work { done, planes: everything - done, ..Work::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: Columns = Columns { positions: 2, random: 5, features: 9, colors: 3 };

    #[test]
    fn pairs_are_those_of_the_dependencies() {
        // Of each colour with 2 positions, 5 random parameters and 9 features; of each feature with the former 7.
        assert_eq!(ALL.pairs(), 3 * 16 + 9 * 7);
        assert_eq!(Columns { colors: 1, ..ALL }.pairs(), 16 + 9 * 7);
    }

    #[test]
    fn a_forecast_saves_more_the_fewer_columns_are_kept() {
        for params in [Params::lean(), Params::paper_fast()] {
            let share = |kept: Columns| forecast(&params, 8, &ALL, &kept).saved_share();
            assert_eq!(share(ALL), 0.0);
            let grey = share(Columns { colors: 1, ..ALL });
            let still = share(Columns { random: 2, ..ALL });
            let both = share(Columns { random: 2, colors: 1, ..ALL });
            assert!(0.0 < grey && 0.0 < still && grey.max(still) < both && both < 1.0, "{grey} {still} {both}");
        }
    }
}
