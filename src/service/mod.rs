//! The service: tiles in, results and stitched images out, over HTTP. `proto/tile.md` says what it answers.
//!
//! One tile goes one way: `body` reads frames, which `inflate` decompresses, and `receive` decodes them as they come, after
//! it has reserved the tile's memory; `stream` hands it to `work`, the pool of threads, and writes what comes out to
//! `results`, a file that the client reads from, or to the canvas of one of the `images`. What a request takes beside its
//! tiles is a `charge`, and `pace` says how slow its client may be.
//!
//! Threads that serve connections never wait for the disk or for the filter.

mod body;
mod charge;
mod images;
mod inflate;
mod pace;
mod picture;
mod problem;
mod query;
mod receive;
mod results;
mod routes;
mod stream;
mod work;

use std::{
    io,
    net::{SocketAddr, TcpListener},
    path::PathBuf,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    service::TowerToHyperService,
};
use tokio::{net::TcpStream, sync::watch, task::JoinSet, time::timeout};

use crate::{
    admission::Budget,
    config::{Config, ConfigError},
};
use images::Images;
use pace::{OpenBodies, Pace, Watched};
use work::Work;

/// The service could not start or go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// The configuration is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why not.
        source: io::Error,
    },
    /// The data folder cannot be written.
    #[error("cannot write to the data folder {}: {source}", path.display())]
    DataDir {
        /// The folder.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The threads cannot be started.
    #[error("cannot start the filter's threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl ServeError {
    /// A stable code.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Config(_) => "bad_config",
            Self::Listen { .. } => "listen",
            Self::DataDir { .. } => "data_dir",
            Self::Threads(_) => "threads",
        }
    }
}

/// Bytes that a connection reads, or collects to be written, at a time; the head of a request is no longer.
const BUFFER: usize = 32 << 10;

/// What all requests share.
struct Inner {
    config: Config,
    /// Memory for tiles.
    budget: Budget,
    /// Memory for requests.
    requests: Budget,
    /// Disk for results that nobody has read yet.
    unread: Budget,
    work: Work,
    images: Images,
    /// Whether the service was told to stop.
    draining: AtomicBool,
}

impl Inner {
    /// How slow a client may be.
    const fn pace(&self) -> Pace {
        Pace { idle: self.config.idle_deadline, rate: self.config.min_rate.0 }
    }
}

type Shared = Arc<Inner>;

/// A service that listens already and answers once it [runs](Self::run).
pub struct Service {
    listener: TcpListener,
    address: SocketAddr,
    inner: Shared,
}

impl Service {
    /// Checks the configuration and the data folder, starts the threads, and takes the address.
    pub fn bind(config: Config) -> Result<Self, ServeError> {
        config.validate()?;
        let data_dir = |source| ServeError::DataDir { path: config.data_dir.clone(), source };
        std::fs::create_dir_all(&config.data_dir).map_err(data_dir)?;
        tempfile::tempfile_in(&config.data_dir).map_err(data_dir)?;
        let work = Work::new(config.threads, config.work_deadline)?;
        let listen = |source| ServeError::Listen { address: config.listen, source };
        let listener = TcpListener::bind(config.listen).map_err(listen)?;
        listener.set_nonblocking(true).map_err(listen)?;
        let address = listener.local_addr().map_err(listen)?;
        let share = charge::share(config.memory.0);
        let [budget, requests, unread] =
            [config.memory.0 - share, share, config.unread_results.0].map(|bytes| Budget::new(bytes, config.queue));
        let images = Images::new(config.images);
        let inner =
            Arc::new(Inner { config, budget, requests, unread, work, images, draining: AtomicBool::new(false) });
        Ok(Self { listener, address, inner })
    }

    /// The address it listens on, with the port that it got.
    pub const fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until `shutdown` is done, and then finishes those that were begun, within the deadline of the
    /// configuration. Needs a tokio runtime with I/O and time.
    pub async fn run(self, shutdown: impl Future<Output = ()>) -> Result<(), ServeError> {
        let Self { listener, address, inner } = self;
        let failed = |source| ServeError::Listen { address, source };
        let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
        let router = routes::router(Arc::clone(&inner));
        let (stop, stopping) = watch::channel(false);
        let mut connections = JoinSet::new();
        let mut shutdown = pin!(shutdown);
        tracing::info!(%address, memory = %inner.config.memory, threads = inner.config.threads, "listening");
        loop {
            let room = connections.len() < inner.config.connections;
            tokio::select! {
                () = &mut shutdown => break,
                Some(_) = connections.join_next() => {}
                accepted = listener.accept(), if room => match accepted {
                    Ok((stream, _)) => {
                        connections.spawn(serve(stream, router.clone(), stopping.clone(), Arc::clone(&inner)));
                    }
                    // Out of file handles, say: others will close theirs.
                    Err(error) => {
                        tracing::warn!(%error, "cannot accept a connection");
                        tokio::time::sleep(Duration::from_millis(50)).await;
                    }
                },
            }
        }
        drop(listener);
        inner.draining.store(true, Ordering::Relaxed);
        stop.send_replace(true);
        tracing::info!(connections = connections.len(), "stopping");
        let all = async { while connections.join_next().await.is_some() {} };
        if timeout(inner.config.shutdown_deadline, all).await.is_err() {
            tracing::warn!(connections = connections.len(), "the deadline has passed; requests are cut off");
        }
        Ok(())
    }
}

/// Serves one connection until it ends; after the signal to stop only the request that has begun.
async fn serve(stream: TcpStream, router: Router, mut stopping: watch::Receiver<bool>, inner: Shared) {
    // Small answers should not wait for more.
    let _ = stream.set_nodelay(true);
    let bodies = OpenBodies::default();
    let stream = Watched::new(stream, inner.pace(), bodies.clone());
    let router = router.layer(Extension(bodies));
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(inner.config.header_deadline)
        .max_buf_size(BUFFER)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    let mut connection = pin!(connection);
    let stopped = async { stopping.wait_for(|&stop| stop).await.is_ok() };
    let result = tokio::select! {
        result = connection.as_mut() => Some(result),
        _ = stopped => None,
    };
    let result = match result {
        Some(result) => result,
        None => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        tracing::debug!(%error, "connection failed");
    }
}
