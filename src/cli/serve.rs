//! `rpfd serve`.

use std::{net::SocketAddr, path::PathBuf};

use tokio::signal::unix::{SignalKind, signal};

use super::{Failure, FailureKind, allocator};
use crate::{
    config::{ByteSize, Config},
    service::{ServeError, Service},
};

/// Runs the service.
///
/// It answers at POST /v1/filter (tiles in, results out) and below /v1/images (images stitched from tiles). The address
/// it listens on is printed to standard output, the log goes to standard error (RUST_LOG says how much, info by default).
/// SIGTERM and Ctrl-C stop it: what has begun is finished first.
#[derive(clap::Args)]
#[command(after_long_help = "Examples:
  rpfd serve
  rpfd serve --listen 127.0.0.1:0 --memory 4GiB --data-dir /var/lib/rpfd
  curl -T tile.tiles -H 'Accept: image/png' -o tile.png http://127.0.0.1:8080/v1/filter")]
pub(crate) struct Args {
    /// Address to listen on; port 0 takes any that is free [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<SocketAddr>,
    /// Memory for tiles, like 512MiB, 4GiB or plain bytes [default: 1GiB]
    #[arg(long, value_name = "SIZE")]
    memory: Option<ByteSize>,
    /// Threads that filter [default: one per CPU]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Folder for canvases and unread results; made if missing [default: $TMPDIR or /var/tmp]
    #[arg(long, value_name = "DIR")]
    data_dir: Option<PathBuf>,
    /// Seconds that a tile may wait for memory before it is refused [default: 60]
    #[arg(long, value_name = "SECONDS")]
    queue_deadline: Option<f64>,
    /// Seconds that a request's body may bring nothing [default: 30]
    #[arg(long, value_name = "SECONDS")]
    idle_deadline: Option<f64>,
    /// Seconds that the head of a request may take [default: 15]
    #[arg(long, value_name = "SECONDS")]
    header_deadline: Option<f64>,
}

impl Args {
    fn config(self) -> Result<Config, Failure> {
        let default = Config::default();
        let seconds = |value: Option<f64>, default| match value.map(std::time::Duration::try_from_secs_f64) {
            None => Ok(default),
            Some(Ok(deadline)) => Ok(deadline),
            Some(Err(error)) => Err(Failure::new(FailureKind::Usage, "bad_config", format!("a deadline: {error}"))),
        };
        Ok(Config {
            listen: self.listen.unwrap_or(default.listen),
            memory: self.memory.unwrap_or(default.memory),
            threads: self.threads.unwrap_or(default.threads),
            data_dir: self.data_dir.unwrap_or(default.data_dir),
            queue_deadline: seconds(self.queue_deadline, default.queue_deadline)?,
            idle_deadline: seconds(self.idle_deadline, default.idle_deadline)?,
            header_deadline: seconds(self.header_deadline, default.header_deadline)?,
            ..Config::default()
        })
    }
}

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Self {
        let kind = if matches!(error, ServeError::Config(_)) { FailureKind::Usage } else { FailureKind::Failed };
        Self::new(kind, error.code(), error)
    }
}

pub(crate) fn run(args: Args) -> Result<(), Failure> {
    use std::io::{IsTerminal, Write};
    use tracing_subscriber::EnvFilter;
    allocator::settle();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    log.with_ansi(std::io::stderr().is_terminal()).init();

    let config = args.config()?;
    let threads = config.threads;
    let service = Service::bind(config)?;
    let failed = |error: std::io::Error| Failure::new(FailureKind::Failed, "runtime", error);
    // Jobs, and what reads and writes files for them and for those who read results.
    let blocking = threads + 16;
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime = runtime.enable_all().max_blocking_threads(blocking).build().map_err(failed)?;
    let result = runtime.block_on(async {
        let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
        let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
        // Signals are heeded from here on: who reads the address may send one.
        let mut out = std::io::stdout();
        writeln!(out, "listening on http://{}", service.local_addr()).and_then(|()| out.flush()).map_err(failed)?;
        let stopped = async {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
        };
        Ok(service.run(stopped).await?)
    });
    // Jobs without a client stop soon; none of them is worth waiting for.
    runtime.shutdown_timeout(std::time::Duration::from_secs(2));
    result
}
