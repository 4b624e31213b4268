//! `rpfd synth`.

use super::Failure;

/// Makes a tile stream of a synthetic scene.
#[derive(clap::Args)]
pub(crate) struct Args {}

pub(crate) fn run(_: Args) -> Result<(), Failure> {
    Ok(())
}
