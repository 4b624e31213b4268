//! The service: tiles in, results and stitched images out, over HTTP. `proto/tile.md` says what it answers.
//!
//! One tile goes one way: `body` reads frames, which `inflate` decompresses, and `receive` decodes them as they come, after
//! it has reserved the tile's memory; `stream` hands it to `work`, the pool of threads, and writes what comes out to
//! `results`, a file that the client reads from, or to the canvas of one of the `images`. The memory of its samples stays
//! `spare` for the next. What a request takes beside its tiles is a `charge`, and `pace` says how slow its client may be.
//!
//! Threads that serve connections never wait for the disk or for the filter.

pub mod auth;
mod body;
mod charge;
mod connection;
mod entry;
mod health;
mod images;
mod inflate;
mod known;
mod metrics;
mod openapi;
mod opened;
mod pace;
mod picture;
mod problem;
mod query;
mod receive;
mod recover;
mod regions;
mod registry;
mod results;
mod routes;
mod schemas;
mod spare;
mod stream;
mod trace;
mod work;

use std::{
    io,
    net::{SocketAddr, TcpListener},
    path::PathBuf,
    pin::pin,
    sync::Arc,
    time::Duration,
};

use axum::Router;
use tokio::{sync::watch, task::JoinSet, time::timeout};

use crate::{
    admission::{AdmissionError, Budget, Permit},
    config::{Config, ConfigError},
};
use auth::{Auth, TokensError};
use connection::Limits;
use health::{Readiness, Reason};
use metrics::{Counted, Metrics};
use pace::Pace;
use registry::{Images, StartError};
use spare::Spare;
use work::Work;

/// Connections at once to the address for metrics.
const METRICS_CONNECTIONS: usize = 16;
/// How often images that nobody uses are looked for, at least and at most.
const TIDY: [Duration; 2] = [Duration::from_secs(30), Duration::from_millis(100)];

/// The service could not start or go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// The configuration is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The file of tokens is wrong.
    #[error(transparent)]
    Tokens(#[from] TokensError),
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
    /// Another service uses the data folder.
    #[error("the data folder {} is in use by another service", path.display())]
    InUse {
        /// The folder.
        path: PathBuf,
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
            Self::Tokens(_) => "bad_tokens",
            Self::Listen { .. } => "listen",
            Self::DataDir { .. } => "data_dir",
            Self::InUse { .. } => "data_dir_in_use",
            Self::Threads(_) => "threads",
        }
    }
}

/// What all requests share.
struct Inner {
    config: Config,
    /// Memory for tiles.
    budget: Budget,
    spare: Spare,
    /// Memory for requests.
    requests: Budget,
    /// What requests over HTTP/2 hold while they wait for that; nobody waits for it.
    ahead: Budget,
    /// Memory for the counts of tiles whose pixels differ in them, while these come: of its own, since who waits for it
    /// holds some of that for requests.
    counts: Budget,
    /// Disk for results that nobody has read yet.
    unread: Budget,
    work: Work,
    images: Images,
    auth: Auth,
    metrics: Metrics,
    readiness: Readiness,
}

impl Inner {
    /// Reserves memory for a tile, as [`Budget::reserve_after`] does.
    async fn reserve(
        &self,
        bytes: u64,
        own: impl Future<Output = ()>,
        deadline: Duration,
    ) -> Result<Permit, AdmissionError> {
        let permit = self.budget.reserve_after(bytes, own, deadline).await?;
        self.spare.make_room();
        Ok(permit)
    }

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
    metrics: Option<(TcpListener, SocketAddr)>,
    /// What was found in the data folder.
    found: Vec<PathBuf>,
    inner: Shared,
}

/// Reads the tokens again, while the service runs.
#[derive(Clone)]
pub struct Reload(Shared);

impl Reload {
    /// Reads the file of tokens and says how many there are. If anything is wrong with it, all stays as it was. Blocks.
    pub fn tokens(&self) -> Result<usize, TokensError> {
        self.0.auth.reload()
    }
}

/// Takes an address, and says which it got.
fn listen(address: SocketAddr) -> Result<(TcpListener, SocketAddr), ServeError> {
    let failed = |source| ServeError::Listen { address, source };
    let listener = TcpListener::bind(address).map_err(failed)?;
    listener.set_nonblocking(true).map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    Ok((listener, address))
}

impl Service {
    /// Checks the configuration, the tokens and the data folder, starts the threads, and takes the addresses.
    pub fn bind(config: Config) -> Result<Self, ServeError> {
        config.validate()?;
        let auth = Auth::new(&config)?;
        let data_dir = |source| ServeError::DataDir { path: config.data_dir.clone(), source };
        crate::disk::make_folders(&config.data_dir).map_err(data_dir)?;
        tempfile::tempfile_in(&config.data_dir).map_err(data_dir)?;
        let work = Work::new(config.threads, config.work_deadline)?;
        let (listener, address) = listen(config.listen)?;
        let metrics = config.metrics_listen.map(listen).transpose()?;
        let of = |bytes| Budget::new(bytes, config.queue);
        let ([budget, requests, counts, memory], unread) =
            (charge::shares(config.shared_memory()).map(of), of(config.unread_results.0));
        let (images, found) = Images::start(&config, memory).map_err(|error| match error {
            StartError::InUse => ServeError::InUse { path: config.data_dir.clone() },
            StartError::Io(source) => data_dir(source),
        })?;
        let readiness = Readiness::default();
        readiness.set(Reason::Recovering, !found.is_empty());
        let spare = Spare::new(budget.clone());
        let inner = Inner {
            config,
            budget,
            spare,
            requests,
            ahead: Budget::new(charge::AHEAD, 0),
            counts,
            unread,
            work,
            images,
            auth,
            metrics: Metrics::new(),
            readiness,
        };
        Ok(Self { listener, address, metrics, found, inner: Arc::new(inner) })
    }

    /// The address it listens on, with the port that it got.
    pub const fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// The address of the metrics, with the port that it got.
    pub fn metrics_addr(&self) -> Option<SocketAddr> {
        self.metrics.as_ref().map(|(_, address)| *address)
    }

    /// What reads the tokens again.
    pub fn reload(&self) -> Reload {
        Reload(Arc::clone(&self.inner))
    }

    /// Recovers the images that are in the data folder, and answers requests, until `shutdown` is done, and then finishes those that were begun, within the deadline of the
    /// configuration. Needs a tokio runtime with I/O and time.
    pub async fn run(self, shutdown: impl Future<Output = ()>) -> Result<(), ServeError> {
        let Self { listener, address, metrics, found, inner } = self;
        let failed = |source| ServeError::Listen { address, source };
        let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
        let (stop, stopping) = watch::channel(false);
        let mut connections = JoinSet::new();
        // Metrics are served to the very end, stopping or not.
        let (_never, serving) = watch::channel(false);
        let mut beside = JoinSet::new();
        if let Some((listener, _)) = metrics {
            let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
            let (router, inner) = (routes::metrics_router(Arc::clone(&inner)), Arc::clone(&inner));
            beside.spawn(async move {
                let (mut connections, never) = (JoinSet::new(), std::future::pending());
                accept(&listener, &router, &serving, &inner, METRICS_CONNECTIONS, &mut connections, never).await;
            });
        }
        let recovering = tokio::spawn(recover::recover(Arc::clone(&inner), found));
        let tidying = tokio::spawn(tidy(Arc::clone(&inner)));
        let router = routes::router(Arc::clone(&inner));
        let (config, simd) = (&inner.config, inner.config.simd.name());
        tracing::info!(%address, memory = %config.memory, threads = config.threads, simd, "listening");
        accept(&listener, &router, &stopping, &inner, inner.config.connections, &mut connections, shutdown).await;
        inner.readiness.set(Reason::Draining, true);
        drop(listener);
        stop.send_replace(true);
        tracing::info!(connections = connections.len(), "stopping");
        let all = async { while connections.join_next().await.is_some() {} };
        if timeout(inner.config.shutdown_deadline, all).await.is_err() {
            tracing::warn!(connections = connections.len(), "the deadline has passed; requests are cut off");
        }
        // What is not filtered yet goes on at the next start.
        tidying.abort();
        recovering.abort();
        inner.images.stop();
        Ok(())
    }
}

/// Sees to images, and memory, that nobody uses, now and then.
async fn tidy(inner: Shared) {
    let mut interval =
        tokio::time::interval(TIDY[0].min(inner.config.image_ttl / 4).min(inner.config.image_idle).max(TIDY[1]));
    loop {
        interval.tick().await;
        inner.spare.tidy();
        let inner = Arc::clone(&inner);
        let _ = work::blocking(move || inner.images.tidy()).await;
    }
}

/// Serves connections, so many at once, until `shutdown` is done.
async fn accept(
    listener: &tokio::net::TcpListener,
    router: &Router,
    stopping: &watch::Receiver<bool>,
    inner: &Shared,
    limit: usize,
    connections: &mut JoinSet<()>,
    shutdown: impl Future<Output = ()>,
) {
    let mut shutdown = pin!(shutdown);
    let limits =
        Limits { header_deadline: inner.config.header_deadline, streams: inner.config.streams, pace: inner.pace() };
    loop {
        let room = connections.len() < limit;
        tokio::select! {
            () = &mut shutdown => return,
            Some(_) = connections.join_next() => {}
            accepted = listener.accept(), if room => match accepted {
                Ok((stream, _)) => {
                    let counted = Counted::new(&inner.metrics.connections);
                    let served = connection::serve(stream, router.clone(), stopping.clone(), limits);
                    connections.spawn(async move {
                        served.await;
                        drop(counted);
                    });
                }
                // Out of file handles, say: others will close theirs.
                Err(error) => {
                    tracing::warn!(%error, "cannot accept a connection");
                    tokio::time::sleep(Duration::from_millis(50)).await;
                }
            },
        }
    }
}
