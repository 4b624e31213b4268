//! Numerical stability on stiff and extreme cases: the production path against the f64 oracle and against the clean case.
//!
//! Each case changes a small render, and runs every preset on it. What is asked of it is written in its [`Bounds`]:
//!
//! - **Finite**: always.
//! - **Steps**: each iteration against the oracle's, from the same rounded colours and the same draws. The deviation of a
//!   sample is relative to the mean absolute colour that is filtered into its pixel; differences of f32's least step,
//!   1.4e-45, twice over are none. The steps are discontinuous (a
//!   value falls into one bin or the next, a candidate is in or out, a sample is a spike or not); where the oracle saw such
//!   a decision within f32's error of its threshold *and* the deviation is beyond the bound, the pixel is counted as
//!   decided differently, with its own greatest deviation, and the count has a bound.
//! - **Whole**: the filtered image against an oracle that runs by itself through all iterations (its colours are rounded
//!   to f32 between them), where decisions and what follows from them have had their way. See [`Deviation`] for what it is relative to.
//! - **Clean**: the image against that of the case without what is wrong with it ([`Against`]). Where the oracle's image
//!   is as far from its own clean image, the algorithm does that, not the implementation: a *known failure*, if the case
//!   says why.
//! - **Energy**: sum of the filtered image over that of the input; likewise.

mod cases;
mod invariances;
mod measure;
mod run;
mod samples;

pub use cases::cases;
pub use measure::Deviation;
pub use run::{Lab, Outcome, Steps, Verdict};
pub use samples::Base;

use crate::filter::{Method, ParameterError, SampleTile, method::Algorithm};
use samples::Samples;

/// Greatest deviation of a step: f32 columns are within 3e-5 deviations of the oracle's (a bound of its tests), and the
/// steepest distance, g/2 = 25 at 8 samples, turns that into 2 sqrt(25 x 10 columns) x 3e-5 = 1e-3 of a weight.
const STEP: f64 = 1e-3;
/// RMS deviation of the steps: columns are typically 30 times nearer than at worst.
const STEP_RMS: f64 = 3e-5;
/// Share of pixels decided differently: a neighbourhood has some 10 000 values, one in 100 000 is as near a bin's edge
/// as f32 errs, and about one pixel in ten has one; few of them change a weight by 1e-3.
const DIFFERENTLY: f64 = 0.05;
/// RMS deviation of the whole: a few pixels decided differently, a few per cent off each.
const WHOLE: f64 = 0.02;

/// Median deviation of the whole: some iterations of f32 sums, each of about 10 roundings.
const WHOLE_MEDIAN: f64 = 1e-5;

/// RMS deviation of what differs in the order of sums only: some roundings of f32, and sums of a hundred in f64.
const ORDER: f64 = 1e-6;

/// What is compared with the clean case, and how far it may be from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Against {
    /// Nothing: there is no clean case, or the input itself is another.
    Nothing,
    /// Not a bit may differ.
    Exactly,
    /// RMS deviation.
    Rms(f64),
    /// Median deviation: what is wrong is in a few places, most of the image must not care.
    Median(f64),
    /// RMS deviation, as a multiple of that between two seeds; of methods without random draws, rounding is left.
    Seeds(f64),
}

/// How the filtered image is brought back to where the clean one can be compared with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Back {
    /// As it is.
    Same,
    /// Each value divided by this.
    Divided(f64),
    /// Left and right swapped.
    Mirrored,
    /// Top and bottom swapped.
    Flipped,
    /// Rows and columns swapped, of a square image.
    Transposed,
    /// Channels moved on by one: R, G, B of the image are B, R, G of the clean one.
    Rotated,
    /// The image is filtered in square tiles of so many pixels, with the halo that they need.
    Tiles(u32),
}

/// What is asked of a case, and why.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// Greatest deviation of any step, where no decision was near.
    pub step: f64,
    /// RMS deviation of the steps.
    pub step_rms: f64,
    /// Share of the steps' pixels that may be decided differently.
    pub differently: f64,
    /// RMS deviation of the whole.
    pub whole: f64,
    /// Median deviation of the whole: most pixels are decided alike, whatever happens to a few.
    pub whole_median: f64,
    /// Deviation from the clean case.
    pub clean: Against,
    /// Least and greatest energy ratio.
    pub energy: [f64; 2],
    /// Why these.
    pub reason: &'static str,
}

impl Bounds {
    /// What every case is asked unless it says otherwise.
    fn usual(clean: Against, reason: &'static str) -> Self {
        // A weighted mean over a neighbourhood moves light, on a crop of 16 pixels not by half of it.
        let energy = [0.5, 2.0];
        Self {
            step: STEP,
            step_rms: STEP_RMS,
            differently: DIFFERENTLY,
            whole: WHOLE,
            whole_median: WHOLE_MEDIAN,
            clean,
            energy,
            reason,
        }
    }
}

/// A stiff or extreme case.
pub struct Case {
    /// What it is called on the command line.
    pub name: String,
    /// What it starts from, which is also the clean case.
    pub base: Base,
    /// How the image is brought back.
    pub back: Back,
    /// What is asked of it; see [`Case::bounds_of`].
    bounds: Bounds,
    /// Why the published algorithm is known to miss the bounds of the clean case and of energy, if it is.
    known: Option<&'static str>,
    /// Why the baselines are, if any is.
    known_of_baselines: Option<&'static str>,
    /// RMS and median deviation of the whole that baselines may have, where that is not what RPF may.
    whole_of_baselines: Option<[f64; 2]>,
    /// Parameters set in every preset.
    settings: Vec<(&'static str, &'static str)>,
    /// The samples come over the wire in half precision.
    f16: bool,
    change: Box<dyn Fn(&mut Samples) + Send + Sync>,
}

impl Case {
    fn new(
        name: impl Into<String>,
        base: Base,
        bounds: Bounds,
        change: impl Fn(&mut Samples) + Send + Sync + 'static,
    ) -> Self {
        let change = Box::new(change);
        Self {
            name: name.into(),
            base,
            back: Back::Same,
            bounds,
            known: None,
            known_of_baselines: None,
            whole_of_baselines: None,
            settings: Vec::new(),
            f16: false,
            change,
        }
    }

    fn back(self, back: Back) -> Self {
        Self { back, ..self }
    }

    fn known(self, known: &'static str) -> Self {
        Self { known: Some(known), ..self }
    }

    fn known_of_baselines(self, known: &'static str) -> Self {
        Self { known_of_baselines: Some(known), ..self }
    }

    fn whole_of_baselines(self, rms: f64, median: f64) -> Self {
        Self { whole_of_baselines: Some([rms, median]), ..self }
    }

    fn over_the_wire_as_f16(self) -> Self {
        Self { f16: true, ..self }
    }

    fn samples(&self) -> Samples {
        let mut samples = self.base.samples();
        (self.change)(&mut samples);
        samples
    }

    /// The whole image as one tile, as it is when it is there.
    fn tile(&self, samples: &Samples) -> SampleTile {
        let tile = samples.whole();
        if self.f16 { samples::over_the_wire_as_f16(&tile) } else { tile }
    }

    /// The method of a preset: `paper` with smaller boxes, so that the oracle is done with it, and of what the case sets
    /// whatever the preset has.
    pub fn method(&self, preset: &str) -> Result<Method, ParameterError> {
        let has = Method::preset(preset)?.parameters();
        let smaller: &[_] = if preset == "paper" { &[("boxes", "15,9,5"), ("fractions", "0.5,0.5,0.5")] } else { &[] };
        let settings = self.settings.iter().filter(|(name, _)| has.iter().any(|(known, _)| known == name));
        Method::with(preset, smaller.iter().chain(settings).copied())
    }

    /// What is asked of a method.
    pub fn bounds_of(&self, method: &Method) -> Bounds {
        match (method.algorithm(), self.whole_of_baselines) {
            (Algorithm::Rpf(_), _) | (_, None) => self.bounds.clone(),
            (_, Some([whole, whole_median])) => Bounds { whole, whole_median, ..self.bounds.clone() },
        }
    }

    /// Why a method is known to miss the bounds of the clean case and of energy, if it is.
    pub fn known_cause(&self, method: &Method) -> Option<&'static str> {
        match method.algorithm() {
            Algorithm::Rpf(_) => self.known,
            _ => self.known_of_baselines,
        }
    }
}
