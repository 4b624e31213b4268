//! The `rpfd` command, one file per subcommand.
//!
//! Exit codes: 0 done, 1 failed, 2 bad usage, 3 bad input, 4 the service refused. What a command has to say goes to
//! standard output, with `--json` as one JSON object; progress, warnings and errors go to standard error, the error with
//! `--json` as one JSON object on one line.

/// Prints a line. A reader that has gone, as `head` does, has all that it wanted; any other failure ends the program.
macro_rules! say {
    ($($text:tt)*) => {
        $crate::cli::say(format_args!($($text)*))
    };
}

mod allocator;
mod args;
mod cost;
mod demo;
mod failure;
mod filter;
mod input;
mod inspect;
mod post;
mod progress;
mod report;
mod schedule;
mod serve;
mod stability;
mod synth;
mod token;

use crate::{picture::PictureError, stitch::atomic::AtomicFile};
use clap::Parser;
use failure::{Failure, FailureKind};
use std::{io::Write, process::ExitCode};

/// Streaming, tile-based denoising of Monte Carlo renders by Random Parameter Filtering.
#[derive(Parser)]
#[command(version, propagate_version = true, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const EXIT_CODES: &str = "\
Exit codes: 0 done, 1 failed, 2 bad usage, 3 bad input, 4 the service refused.

Examples:
  rpfd demo                                       see it work, on a real render
  rpfd inspect render.tiles.zst                   what is in a file, and what is wrong with it
  rpfd filter render.tiles.zst -o render.exr      denoise a file
  rpfd report --folder renders --html report.html error against run time, as a page
  rpfd serve --listen 127.0.0.1:8080              run the service
  rpfd post render.tiles.zst --to http://HOST:8080 -o render.exr
                                                  denoise a file by the service";

#[derive(clap::Subcommand)]
enum Command {
    Cost(Box<cost::Args>),
    Demo(demo::Args),
    Filter(Box<filter::Args>),
    Inspect(inspect::Args),
    Post(Box<post::Args>),
    Report(Box<report::Args>),
    Serve(serve::Args),
    Stability(stability::Args),
    Synth(synth::Args),
    Token(token::Args),
}

/// Parses the command line, runs the command, and says how it went.
pub fn main() -> ExitCode {
    let (json, result) = match Cli::parse().command {
        Command::Cost(args) => (args.json_errors(), cost::run(&args)),
        Command::Demo(args) => (args.json, demo::run(&args)),
        Command::Filter(args) => (args.json, filter::run(&args)),
        Command::Inspect(args) => (args.json, inspect::run(&args)),
        Command::Post(args) => (args.json, post::run(&args)),
        Command::Report(args) => (args.json_errors(), report::run(&args)),
        Command::Serve(args) => (false, serve::run(args)),
        Command::Stability(args) => (args.json, stability::run(&args)),
        Command::Synth(args) => (args.json, synth::run(&args)),
        Command::Token(args) => (false, token::run(&args)),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(json),
    }
}

fn say(line: std::fmt::Arguments) {
    use std::io::ErrorKind;
    if let Err(error) = writeln!(std::io::stdout().lock(), "{line}")
        && error.kind() != ErrorKind::BrokenPipe
    {
        eprintln!("rpfd: standard output: {error} (output_io)");
        std::process::exit(1);
    }
}

/// Writes the text files that are wanted, each whole or not at all.
fn write_texts<const N: usize>(
    outputs: [Option<AtomicFile>; N],
    contents: [&dyn Fn() -> String; N],
) -> Result<(), Failure> {
    for (file, content) in outputs.into_iter().zip(contents) {
        let Some(mut file) = file else { continue };
        let written = file.out().write_all(content().as_bytes());
        written.map_err(|error| Failure::from(PictureError::Io(error)))?;
        file.commit()?;
    }
    Ok(())
}
