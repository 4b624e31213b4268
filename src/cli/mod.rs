//! The `rpfd` command, one file per subcommand.
//!
//! Exit codes: 0 done, 1 failed, 2 bad usage, 3 bad input, 4 the service refused.

mod serve;
mod synth;

use clap::Parser;
use std::process::ExitCode;

/// Streaming, tile-based denoising of Monte Carlo renders by Random Parameter Filtering.
#[derive(Parser)]
#[command(version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    Serve(serve::Args),
    Synth(synth::Args),
}

/// Why a command did not do what it was asked to.
#[derive(Debug)]
pub(crate) struct Failure {
    kind: FailureKind,
    /// Stable word for scripts, like `truncated`.
    code: &'static str,
    message: String,
}

/// What a failure exits with.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FailureKind {
    /// Something went wrong here.
    Failed = 1,
    /// The command line does not make sense.
    Usage = 2,
    /// The input is not what it should be.
    Input = 3,
    /// The service said no.
    Refused = 4,
}

impl Failure {
    pub(crate) fn new(kind: FailureKind, code: &'static str, message: impl std::fmt::Display) -> Self {
        Self { kind, code, message: message.to_string() }
    }
}

/// Parses the command line, runs the command, and says how it went.
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Serve(args) => serve::run(args),
        Command::Synth(args) => synth::run(args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { kind, code, message }) => {
            eprintln!("rpfd: {message} ({code})");
            ExitCode::from(kind as u8)
        }
    }
}
