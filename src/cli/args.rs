//! What several commands are told in the same words.

use super::failure::Failure;
use crate::{
    filter::{
        Method, ParameterError, SimdLevel,
        method::{Algorithm, PRESETS},
    },
    stitch::{
        ExrCompression, ExrLayout, ExrOptions, ExrSamples,
        exr::{TILE_SIZES, provenance},
    },
};
use std::{num::NonZeroUsize, sync::LazyLock};

/// How to filter.
#[derive(clap::Args)]
#[command(next_help_heading = "How to filter")]
pub(crate) struct MethodArgs {
    /// Preset to start from
    #[arg(long, value_name = "NAME", default_value = crate::filter::method::DEFAULT_PRESET, help = PRESET_HELP.as_str())]
    preset: String,
    /// Keys every random draw: the same seed gives the same file
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Set one of the preset's parameters; may be given several times
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = setting, help = SET_HELP.as_str())]
    settings: Vec<(String, String)>,
    /// Whether what can have no effect is left out, like planes that are constant: off takes longer, for the same image
    #[arg(long, value_name = "on|off", default_value = "on", value_parser = ["on", "off"])]
    leave_out: String,
    /// Pass pixels through whose samples say that filtering can take less than this off their relMSE, to save time: 0,
    /// none, to 1; short for --set tolerance=E
    #[arg(long, value_name = "E")]
    tolerance: Option<String>,
}

static PRESET_HELP: LazyLock<String> = LazyLock::new(|| {
    let presets = PRESETS.iter().map(|(name, what)| format!("\n- {name}: {what}"));
    format!("Preset to start from:{}", presets.collect::<String>())
});

static SET_HELP: LazyLock<String> = LazyLock::new(|| {
    let presets = PRESETS.iter().filter_map(|(name, _)| Method::preset(name).ok());
    // Those that RPF has are listed once, with the default preset's values.
    let listed = presets
        .filter(|method| !method.parameters().is_empty())
        .filter(|method| *method == Method::default() || !matches!(method.algorithm(), Algorithm::Rpf(_)));
    let listed = listed.map(|method| {
        let parameters = method.parameters().into_iter().map(|(name, value)| format!("\n- {name} ({value})"));
        let presets = match method.algorithm() {
            Algorithm::Rpf(_) => "lean, and other values in paper-fast and paper",
            _ => method.preset_name(),
        };
        format!("\n{presets}:{}", parameters.collect::<String>())
    });
    format!(
        "Set one of the preset's parameters; may be given several times, lists with commas (--set boxes=17,7). There \
         are, with their values in{}",
        listed.collect::<String>()
    )
});

fn setting(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err("write NAME=VALUE, like bins=9".to_owned()),
    }
}

impl MethodArgs {
    /// The method, checked.
    pub(crate) fn method(&self) -> Result<Method, ParameterError> {
        Method::with(&self.preset, self.settings())
    }

    /// What is set, the last of a name counts.
    fn settings(&self) -> impl Iterator<Item = (&str, &str)> {
        let tolerance = self.tolerance.iter().map(|value| ("tolerance", value.as_str()));
        self.settings.iter().map(|(name, value)| (name.as_str(), value.as_str())).chain(tolerance)
    }

    /// Whether what can have no effect is left out.
    pub(crate) fn leave_out(&self) -> bool {
        self.leave_out == "on"
    }

    /// As the service takes it: preset, seed, the parameters that were set, and that nothing is to be left out.
    pub(crate) fn to_json(&self, method: &Method) -> serde_json::Value {
        let settings = self.settings().map(|(name, value)| (name.to_owned(), value.into()));
        let own = [("preset".to_owned(), method.preset_name().into()), ("seed".to_owned(), self.seed.into())];
        let all = (!self.leave_out()).then(|| ("leave_out".to_owned(), false.into()));
        settings.chain(own).chain(all).collect::<serde_json::Map<_, _>>().into()
    }
}

/// What the EXR is like.
#[derive(clap::Args)]
#[command(next_help_heading = "The EXR")]
pub(crate) struct ExrArgs {
    /// Type of the values
    #[arg(long, value_name = "TYPE", default_value = "float", value_parser = names(&ExrSamples::NAMES))]
    exr_samples: String,
    /// Short for --exr-samples half
    #[arg(long, conflicts_with_all = ["exr_samples", "float"])]
    half: bool,
    /// Short for --exr-samples float, the default
    #[arg(long, conflicts_with = "exr_samples")]
    float: bool,
    /// How it is compressed, always without loss
    #[arg(long, value_name = "NAME", default_value = "zip", value_parser = names(&ExrCompression::NAMES))]
    compression: String,
    /// Square tiles of so many pixels instead of rows: 16 to 4096
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(i64::from(*TILE_SIZES.start())..=i64::from(*TILE_SIZES.end())))]
    exr_tiles: Option<u32>,
}

/// Accepts exactly these names, and lists them in the help.
fn names<T>(names: &[(&'static str, T)]) -> clap::builder::PossibleValuesParser {
    names.iter().map(|(name, _)| *name).collect::<Vec<_>>().into()
}

impl ExrArgs {
    /// As the service takes them.
    pub(crate) fn query(&self) -> Vec<(&'static str, String)> {
        let samples = if self.half { "half" } else { &self.exr_samples };
        let mut query = vec![("samples", samples.to_owned()), ("compression", self.compression.clone())];
        query.extend(self.exr_tiles.map(|size| ("tile", size.to_string())));
        query
    }

    /// As the writer takes them; metadata says how the image was made.
    pub(crate) fn options(&self, method: &Method, seed: u64) -> ExrOptions {
        let samples = if self.half { "half" } else { &self.exr_samples };
        ExrOptions {
            samples: by_name(&ExrSamples::NAMES, samples),
            compression: by_name(&ExrCompression::NAMES, &self.compression),
            layout: self.exr_tiles.map_or(ExrLayout::Scanlines, ExrLayout::Tiles),
            attributes: provenance(method.preset_name(), seed, method.parameters()),
        }
    }
}

/// The value of a name; of one that [`names`] does not accept, the default.
fn by_name<T: Copy + Default>(names: &[(&str, T)], name: &str) -> T {
    names.iter().find(|(known, _)| *known == name).map(|(_, value)| *value).unwrap_or_default()
}

/// On how many threads.
#[derive(clap::Args)]
pub(crate) struct ThreadArgs {
    /// Threads to compute on; by default one for each processor
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

impl ThreadArgs {
    /// How many.
    pub(crate) fn count(&self) -> usize {
        let processors = || std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
        self.threads.map_or_else(processors, |n| n as usize)
    }

    /// The threads; none if the one that asks is enough.
    pub(crate) fn pool(&self) -> Result<Option<rayon::ThreadPool>, Failure> {
        let count = self.count();
        if count == 1 {
            return Ok(None);
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).thread_name(|i| format!("compute-{i}")).build();
        pool.map(Some).map_err(|error| Failure::failed("threads", format!("cannot start {count} threads: {error}")))
    }
}

/// With which SIMD instructions.
#[derive(clap::Args)]
pub(crate) struct SimdArgs {
    /// SIMD instructions to compute with, for the same bits in more time: auto for the best that this CPU has, or one
    /// of its levels, sse2, sse4.2, avx2 or avx512
    #[arg(long = "simd", env = "RPFD_SIMD", value_name = "LEVEL", default_value = "auto")]
    pub(crate) level: SimdLevel,
}

/// Reads a size like `640x480`.
pub(crate) fn size(text: &str) -> Result<[u32; 2], String> {
    let max = crate::filter::geometry::MAX_SIDE;
    let side = |text: &str| text.parse().ok().filter(|side| (1..=max).contains(side));
    let sides = text.split_once(['x', 'X']).and_then(|(width, height)| Some([side(width)?, side(height)?]));
    sides.ok_or_else(|| format!("write WIDTHxHEIGHT, like 640x480, each 1 to {max}"))
}
