//! `rpfd stability`.

use super::{args::SimdArgs, failure::Failure, progress};
use crate::{
    filter::{Method, Stopped, method::PRESETS},
    report::stability::{Case, Deviation, Lab, Outcome, Verdict, cases},
};
use serde_json::{Value, json};
use std::{collections::BTreeMap, sync::atomic::Ordering, time::Instant};

/// Check numerical stability on stiff and extreme cases
///
/// Each case changes a small render, runs every preset on it, and compares every iteration and the whole with an f64
/// oracle that draws the same candidates, and the image with that of the clean case. Exits with 1 if a case is beyond
/// one of its bounds, which stand with their reasons in the code and in --json. `known` are failures of the published
/// algorithm, or of a baseline: the oracle fails in the same way. `paper` runs with boxes of 15, 9 and 5, and spp-1024
/// with at most 2048 neighbours, so that the oracle is done with them.
#[derive(clap::Args)]
#[command(after_help = HELP)]
pub(crate) struct Args {
    /// Run the cases whose names contain this; may be given several times
    #[arg(long = "case", value_name = "NAME")]
    cases: Vec<String>,
    /// Run this preset only; may be given several times
    #[arg(long = "preset", value_name = "NAME", value_parser = names())]
    presets: Vec<String>,
    #[command(flatten)]
    simd: SimdArgs,
    /// Exit with 1 for known failures of the published algorithm as well
    #[arg(long)]
    strict: bool,
    /// Print everything as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

const HELP: &str = "\
Columns:
  bad        values of the image that are not finite
  step       greatest deviation of an iteration from the oracle's, relative to the colours filtered into the pixel
  step rms   RMS of these
  flips      pixels, over all iterations, that f32 decided otherwise than f64 (bin, cluster, spike)
  flip       greatest deviation of these
  whole      RMS deviation of the image from the oracle's, relative to the greatest value in 3 x 3 pixels
  clean      deviation of the image from the clean case's, in the measure that is bounded
  bound      that bound
  oracle     the same deviation of the oracle's image from its own clean image
  energy     sum of the image over that of the input

Examples:
  rpfd stability
  rpfd stability --case firefly --case offset --preset lean
  rpfd stability --json > stability.json";

fn names() -> clap::builder::PossibleValuesParser {
    PRESETS.iter().map(|(name, _)| *name).collect::<Vec<_>>().into()
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let started = Instant::now();
    let wanted = |case: &Case| args.cases.is_empty() || args.cases.iter().any(|part| case.name.contains(part));
    let cases: Vec<Case> = cases().into_iter().filter(wanted).collect();
    if cases.is_empty() {
        let known = crate::report::stability::cases().into_iter().map(|case| case.name).collect::<Vec<_>>().join(", ");
        return Err(Failure::usage(
            "no_case",
            format!("no case has a name with {}: there are {known}", args.cases.join(" or ")),
        ));
    }
    let presets: Vec<&str> = PRESETS.iter().map(|p| p.0).collect();
    let presets: Vec<&str> =
        presets.into_iter().filter(|p| args.presets.is_empty() || args.presets.iter().any(|a| a == p)).collect();
    let stop = progress::interrupted();
    let bar = progress::bar("cases", (cases.len() * presets.len()) as u64);
    let (mut lab, mut results) = (Lab::new(args.simd.level), Vec::new());
    for case in &cases {
        for &preset in &presets {
            if stop.load(Ordering::Relaxed) {
                return Err(Stopped.into());
            }
            let method = case.method(preset)?;
            let outcome = lab.run(case, &method)?;
            results.push((case, method, outcome));
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    let count = |verdict| results.iter().filter(|(_, _, outcome)| outcome.verdict == verdict).count();
    let failed = count(Verdict::Failed);
    if args.json {
        let all: Vec<Value> = results.iter().map(|(case, method, outcome)| to_json(case, method, outcome)).collect();
        let summary = json!({
            "seconds": started.elapsed().as_secs_f64(),
            "ok": count(Verdict::Ok), "known": count(Verdict::Known), "failed": failed, "cases": all,
        });
        say!("{summary:#}");
    } else {
        print_table(&results);
        let seconds = started.elapsed().as_secs_f64();
        let (ok, known) = (count(Verdict::Ok), count(Verdict::Known));
        say!("\n{ok} ok, {known} known failures of the algorithms themselves, {failed} beyond a bound; {seconds:.1} s");
    }
    let beyond = failed + if args.strict { count(Verdict::Known) } else { 0 };
    match beyond {
        0 => Ok(()),
        _ => Err(Failure::failed("unstable", format!("{beyond} of {} results are beyond a bound", results.len()))),
    }
}

fn print_table(results: &[(&Case, Method, Outcome)]) {
    say!(
        "{:<22}{:<16}{:>4}{:>9}{:>9}{:>6}{:>9}{:>9}{:>9}{:>9}{:>9}{:>8}  verdict",
        "case",
        "preset",
        "bad",
        "step",
        "step rms",
        "flips",
        "flip",
        "whole",
        "clean",
        "bound",
        "oracle",
        "energy"
    );
    for (case, method, outcome) in results {
        let steps = &outcome.steps;
        let clean = |deviation: Option<Deviation>| match (deviation, outcome.clean_bound) {
            (Some(deviation), Some((field, _))) => short(deviation.field(field)),
            _ => "-".to_owned(),
        };
        say!(
            "{:<22}{:<16}{:>4}{:>9}{:>9}{:>6}{:>9}{:>9}{:>9}{:>9}{:>9}{:>8}  {}",
            case.name,
            method.preset_name(),
            outcome.nonfinite,
            short(steps.greatest),
            short(steps.rms),
            steps.differently,
            short(steps.greatest_differently),
            short(outcome.whole.rms),
            clean(outcome.clean),
            outcome.clean_bound.map_or("-".to_owned(), |(_, bound)| short(bound)),
            clean(outcome.oracle_clean),
            outcome.energy.map_or("-".to_owned(), |energy| format!("{energy:.3}")),
            outcome.verdict.as_str(),
        );
    }
    let mut known: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (case, method, outcome) in results {
        if outcome.verdict == Verdict::Failed {
            say!("\n{} with {} is beyond its bounds: {}", case.name, method.preset_name(), outcome.beyond.join("; "));
            say!("  bounds: {}", case.bounds_of(method).reason);
        } else if let (Verdict::Known, Some(cause)) = (outcome.verdict, case.known_cause(method)) {
            let names = known.entry(cause).or_default();
            if names.last() != Some(&case.name.as_str()) {
                names.push(&case.name);
            }
        }
    }
    for (cause, names) in known {
        say!("\nknown: {}\n  {cause}", names.join(", "));
    }
}

/// Two digits, 0 as such.
fn short(value: f64) -> String {
    if value == 0.0 { "0".to_owned() } else { format!("{value:.1e}") }
}

/// Numbers that JSON has not become null; [`Outcome::beyond`] says what they were.
fn to_json(case: &Case, method: &Method, outcome: &Outcome) -> Value {
    let deviation = |d: Deviation| json!({ "median": d.median, "rms": d.rms, "greatest": d.greatest });
    let Outcome { steps, .. } = outcome;
    let bounds = case.bounds_of(method);
    json!({
        "case": case.name,
        "preset": method.preset_name(),
        "parameters": method.parameters().into_iter().collect::<BTreeMap<_, _>>(),
        "verdict": outcome.verdict.as_str().to_lowercase(),
        "beyond": outcome.beyond,
        "known_cause": case.known_cause(method).filter(|_| outcome.verdict == Verdict::Known),
        "finite": outcome.nonfinite == 0,
        "nonfinite": outcome.nonfinite,
        "replaced": outcome.replaced,
        "steps": {
            "greatest": steps.greatest, "rms": steps.rms, "pixels": steps.pixels,
            "differently": steps.differently, "greatest_differently": steps.greatest_differently,
        },
        "whole": deviation(outcome.whole),
        "clean": outcome.clean.map(deviation),
        "oracle_clean": outcome.oracle_clean.map(deviation),
        "energy": outcome.energy,
        "oracle_energy": outcome.oracle_energy,
        "bounds": {
            "step": bounds.step, "step_rms": bounds.step_rms, "differently": bounds.differently, "whole": bounds.whole.is_finite().then_some(bounds.whole),
            "whole_median": bounds.whole_median.is_finite().then_some(bounds.whole_median),
            "clean": outcome.clean_bound.map(|(field, bound)| json!({ "field": field, "bound": bound })),
            "energy": bounds.energy.map(|e| e.is_finite().then_some(e)),
            "reason": bounds.reason,
        },
    })
}
