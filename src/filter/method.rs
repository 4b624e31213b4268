//! Methods by name: presets and their parameters, set one by one by the same names everywhere (flags, query, JSON).

use super::baseline::{bilateral, cross_bilateral, gaussian};
use super::{Role, rpf};

/// The preset used when none is named.
pub const DEFAULT_PRESET: &str = "lean";

/// Every preset: its name and what it is.
pub const PRESETS: &[(&str, &str)] = &[
    ("lean", "the best of RPF for its cost: two small boxes, information on every 4th pixel"),
    ("paper-fast", "RPF with the report's boxes and few neighbours"),
    ("paper", "RPF as published; ten times the neighbours of paper-fast"),
    ("cross-bilateral", "a bilateral filter of pixels over distance, colour and features"),
    ("bilateral", "a bilateral filter of pixels over distance and colour"),
    ("gaussian", "a Gaussian blur of pixels"),
    ("unfiltered", "the mean of each pixel's samples"),
];

/// A preset or parameter that cannot be; says what would be right.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// No preset has this name.
    #[error("unknown preset {0:?}: known are {known}", known = PRESETS.iter().map(|p| p.0).collect::<Vec<_>>().join(", "))]
    Preset(String),
    /// The preset has no parameter of this name.
    #[error("preset {preset} has no parameter {name:?}: it has {known}")]
    Name {
        /// The preset.
        preset: &'static str,
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// The value cannot be read or is out of its range.
    #[error("{name} = {value:?}: {right}")]
    Value {
        /// The parameter.
        name: &'static str,
        /// What was given.
        value: String,
        /// What would be right.
        right: String,
    },
}

/// How to filter: a preset and its parameters, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Method {
    preset: &'static str,
    algorithm: Algorithm,
}

/// What a method runs.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Algorithm {
    /// The mean of each pixel's samples.
    Unfiltered,
    /// A Gaussian blur of pixels.
    Gaussian(gaussian::Params),
    /// A bilateral filter of pixels over distance and colour.
    Bilateral(bilateral::Params),
    /// A bilateral filter of pixels over distance, colour and features.
    CrossBilateral(cross_bilateral::Params),
    /// Random Parameter Filtering.
    Rpf(rpf::Params),
}

impl Default for Method {
    fn default() -> Self {
        Self { preset: DEFAULT_PRESET, algorithm: Algorithm::Rpf(rpf::Params::lean()) }
    }
}

impl Method {
    /// The preset of this name, as it is.
    pub fn preset(name: &str) -> Result<Self, ParameterError> {
        Self::with(name, [] as [(&str, &str); 0])
    }

    /// The preset of this name with some parameters set, each by its name and its value in words (numbers, lists with
    /// commas, `on` or `off`). Parameters are checked together after the last is set.
    pub fn with<N: AsRef<str>, V: AsRef<str>>(
        preset: &str,
        settings: impl IntoIterator<Item = (N, V)>,
    ) -> Result<Self, ParameterError> {
        let unknown = || ParameterError::Preset(preset.to_owned());
        let preset = PRESETS.iter().map(|p| p.0).find(|&p| p == preset).ok_or_else(unknown)?;
        let mut algorithm = match preset {
            "lean" => Algorithm::Rpf(rpf::Params::lean()),
            "paper-fast" => Algorithm::Rpf(rpf::Params::paper_fast()),
            "paper" => Algorithm::Rpf(rpf::Params::paper()),
            "cross-bilateral" => Algorithm::CrossBilateral(cross_bilateral::Params::default()),
            "bilateral" => Algorithm::Bilateral(bilateral::Params::default()),
            "gaussian" => Algorithm::Gaussian(gaussian::Params::default()),
            _ => Algorithm::Unfiltered,
        };
        for (name, value) in settings {
            let (name, value) = (name.as_ref(), value.as_ref());
            if !algorithm.set(name, value)? {
                let names: Vec<_> = algorithm.entries().into_iter().map(|(name, _)| name).collect();
                let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
                return Err(ParameterError::Name { preset, name: name.to_owned(), known });
            }
        }
        algorithm.validate()?;
        Ok(Self { preset, algorithm })
    }

    /// Name of the preset it started from.
    pub const fn preset_name(&self) -> &'static str {
        self.preset
    }

    /// What it runs.
    pub const fn algorithm(&self) -> &Algorithm {
        &self.algorithm
    }

    /// Every parameter and its value in words, as [`Method::with`] reads them.
    pub fn parameters(&self) -> Vec<(&'static str, String)> {
        self.algorithm.entries()
    }

    /// Whether it looks at channels of this role.
    pub fn reads(&self, role: &Role) -> bool {
        match &self.algorithm {
            Algorithm::Rpf(_) => true,
            Algorithm::CrossBilateral(_) => matches!(role, Role::Color | Role::Feature { .. }),
            Algorithm::Unfiltered | Algorithm::Gaussian(_) | Algorithm::Bilateral(_) => *role == Role::Color,
        }
    }

    /// Pixels of halo that a tile needs for the same bits as in the whole image. `varying` says that pixels may have
    /// different numbers of samples: one without any is filled from filtered pixels around it, which reaches further.
    pub fn reach(&self, varying: bool) -> u32 {
        match &self.algorithm {
            Algorithm::Unfiltered => 0,
            Algorithm::Gaussian(params) => params.reach(varying),
            Algorithm::Bilateral(params) => params.gaussian.reach(varying),
            Algorithm::CrossBilateral(params) => params.bilateral.gaussian.reach(varying),
            Algorithm::Rpf(params) => params.reach(varying),
        }
    }
}

impl Algorithm {
    fn set(&mut self, name: &str, value: &str) -> Result<bool, ParameterError> {
        match self {
            Self::Unfiltered => Ok(false),
            Self::Gaussian(params) => params.set(name, value),
            Self::Bilateral(params) => params.set(name, value),
            Self::CrossBilateral(params) => params.set(name, value),
            Self::Rpf(params) => params.set(name, value),
        }
    }

    fn entries(&self) -> Vec<(&'static str, String)> {
        match self {
            Self::Unfiltered => Vec::new(),
            Self::Gaussian(params) => params.entries(),
            Self::Bilateral(params) => params.entries(),
            Self::CrossBilateral(params) => params.entries(),
            Self::Rpf(params) => params.entries().to_vec(),
        }
    }

    fn validate(&self) -> Result<(), ParameterError> {
        match self {
            Self::Unfiltered => Ok(()),
            Self::Gaussian(params) => params.validate(),
            Self::Bilateral(params) => params.validate(),
            Self::CrossBilateral(params) => params.validate(),
            Self::Rpf(params) => params.validate(),
        }
    }
}

/// What is wrong with a parameter's value.
pub(super) fn wrong(name: &'static str, value: &str, right: &str) -> ParameterError {
    ParameterError::Value { name, value: value.to_owned(), right: right.to_owned() }
}

/// Reads one value; `kind` says of what kind it must be.
pub(super) fn one<T: std::str::FromStr>(name: &'static str, value: &str, kind: &str) -> Result<T, ParameterError> {
    value.trim().parse().map_err(|_| wrong(name, value, &format!("must be {kind}")))
}

/// Checks that a number lies within its range, which NaN never does.
pub(super) fn within(
    name: &'static str,
    value: f64,
    range: std::ops::RangeInclusive<f64>,
    unit: &str,
) -> Result<(), ParameterError> {
    let right = || format!("must be {} to {} {unit}", range.start(), range.end());
    if range.contains(&value) { Ok(()) } else { Err(wrong(name, &value.to_string(), &right())) }
}
