//! `rpfd token`: bearer tokens for a service.

use super::failure::Failure;
use crate::service::auth::{Role, check_name, check_token, hash_token};
use std::{
    io::{self, Read, Write},
    path::{Path, PathBuf},
};

/// Make a bearer token for a service
///
/// Prints the entry for the service's file of tokens (--token-file), which holds only a hash, to standard output. The token
/// itself is random; it is written to --secret, or to standard error, and is nowhere else.
#[derive(clap::Args)]
#[command(after_long_help = "Examples:
  rpfd token farm --secret farm.token >> tokens.toml
  rpfd serve --listen 0.0.0.0:8080 --token-file tokens.toml
  rpfd post render.tiles --to http://HOST:8080 -o render.exr --token-file farm.token
  kill -HUP $(pidof rpfd)                           the service reads tokens.toml again")]
pub(crate) struct Args {
    /// Whose token it is, for the log: 1 to 64 of A-Z a-z 0-9 . _ -
    name: String,
    /// What it allows: submit (send tiles, open and delete images), read (look at images and fetch them)
    #[arg(long, value_name = "ROLES", value_delimiter = ',', default_value = "submit,read", value_parser = Role::NAMES.map(|(name, _)| name))]
    roles: Vec<String>,
    /// Requests at once with it; as the service's token_requests says by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65536))]
    requests: Option<u32>,
    /// Images open at once that were opened with it; as the service's token_images says by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65536))]
    images: Option<u32>,
    /// File for the token; if it is there, the token in it is used
    #[arg(long, value_name = "FILE")]
    secret: Option<PathBuf>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    check_name(&args.name).map_err(|error| Failure::usage("bad_name", error))?;
    let token = match &args.secret {
        Some(path) if path.exists() => read_secret(path)?,
        Some(path) => {
            let token = random()?;
            write_secret(path, &token)
                .map_err(|error| Failure::failed("secret", format!("{}: {error}", path.display())))?;
            token
        }
        None => {
            let token = random()?;
            eprintln!("{token}");
            token
        }
    };
    let mut roles = args.roles.clone();
    roles.dedup();
    let limit = |key: &str, limit: Option<u32>| limit.map_or_else(String::new, |n| format!("{key} = {n}\n"));
    let limits = limit("requests", args.requests) + &limit("images", args.images);
    say!("[[token]]\nname = {:?}\nroles = {roles:?}\nhash = {:?}\n{limits}", args.name, hash_token(&token));
    Ok(())
}

/// A token from a file, of which blanks around it are no part.
pub(crate) fn read_secret(path: &Path) -> Result<String, Failure> {
    let mut text = String::new();
    let read = std::fs::File::open(path).and_then(|file| file.take(4096).read_to_string(&mut text));
    read.map_err(|error| Failure::usage("bad_token", format!("{}: {error}", path.display())))?;
    let token = text.trim();
    check_token(token).map_err(|error| Failure::usage("bad_token", format!("{}: {error}", path.display())))?;
    Ok(token.to_owned())
}

/// 256 random bits in hex.
fn random() -> Result<String, Failure> {
    let mut bytes = [0; 32];
    let read = std::fs::File::open("/dev/urandom").and_then(|mut file| file.read_exact(&mut bytes));
    read.map_err(|error| Failure::failed("random", format!("/dev/urandom: {error}")))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// A new file that only its owner reads.
fn write_secret(path: &Path, token: &str) -> io::Result<()> {
    use std::os::unix::fs::OpenOptionsExt;
    let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    writeln!(file, "{token}")
}
