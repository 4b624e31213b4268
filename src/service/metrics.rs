//! What the service counts, as Prometheus reads it: OpenMetrics, on an address of its own.
//!
//! Every label has few values, whatever is sent: routes are those that there are, methods those that mean anything.

use std::{
    sync::atomic::AtomicU64,
    time::{Duration, Instant},
};

use axum::{
    extract::State,
    http::{Method, header},
    response::{IntoResponse, Response},
};
use prometheus_client::{
    encoding::{EncodeLabelSet, text::encode},
    metrics::{
        counter::Counter,
        family::{Family, MetricConstructor},
        gauge::Gauge,
        histogram::{Histogram, exponential_buckets},
        info::Info,
    },
    registry::{Registry, Unit},
};

use super::{
    Shared,
    health::{disk, unready},
    problem::{Refusal, internal},
    work::blocking,
};
use crate::admission::Budget;

/// The content type of what is served.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// What happens to a tile, or to a region that is made of bare cores, one after another.
#[derive(Clone, Copy, Debug)]
pub(super) enum Phase {
    /// Waiting for memory.
    Queue,
    /// Reading its samples: from the client, or from the disk.
    Receive,
    /// Waiting for a thread.
    Turn,
    /// Filtering.
    Filter,
    /// Keeping what came out: on the canvas, or for the client to read.
    Write,
}

impl Phase {
    const fn name(self) -> &'static str {
        match self {
            Self::Queue => "queue",
            Self::Receive => "receive",
            Self::Turn => "turn",
            Self::Filter => "filter",
            Self::Write => "write",
        }
    }
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Call {
    route: String,
    method: &'static str,
    status: u16,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Route {
    route: String,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Code {
    code: String,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Outcome {
    outcome: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct PhaseName {
    phase: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Build {
    version: &'static str,
}

/// From a millisecond to more than an hour.
#[derive(Clone, Copy, Debug)]
struct Seconds;

impl MetricConstructor<Histogram> for Seconds {
    fn new_metric(&self) -> Histogram {
        Histogram::new(exponential_buckets(0.001, 4.0, 12))
    }
}

type Bytes = Gauge<i64>;

/// All that is counted.
#[derive(Debug)]
pub(super) struct Metrics {
    registry: Registry,
    requests: Family<Call, Counter>,
    seconds: Family<Route, Histogram, Seconds>,
    /// Requests whose answer is not all sent.
    in_flight: Gauge,
    problems: Family<Code, Counter>,
    tiles: Family<Outcome, Counter>,
    regions: Family<Outcome, Counter>,
    phases: Family<PhaseName, Histogram, Seconds>,
    /// Tiles and regions that wait for memory.
    waiting: Gauge,
    pub(super) connections: Gauge,
    images: Gauge,
    images_in_memory: Gauge,
    memory_used: Bytes,
    memory_limit: Bytes,
    unread_used: Bytes,
    unread_limit: Bytes,
    images_used: Bytes,
    images_limit: Bytes,
    disk_free: Bytes,
    disk_size: Bytes,
    ready: Gauge,
    resident: Gauge<u64, AtomicU64>,
}

/// Counts one as long as it lives.
#[derive(Debug)]
pub(super) struct Counted(Gauge);

impl Counted {
    pub(super) fn new(gauge: &Gauge) -> Self {
        gauge.inc();
        Self(gauge.clone())
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl Metrics {
    pub(super) fn new() -> Self {
        let mut all = Self {
            registry: Registry::default(),
            requests: Family::default(),
            seconds: Family::new_with_constructor(Seconds),
            in_flight: Gauge::default(),
            problems: Family::default(),
            tiles: Family::default(),
            regions: Family::default(),
            phases: Family::new_with_constructor(Seconds),
            waiting: Gauge::default(),
            connections: Gauge::default(),
            images: Gauge::default(),
            images_in_memory: Gauge::default(),
            memory_used: Gauge::default(),
            memory_limit: Gauge::default(),
            unread_used: Gauge::default(),
            unread_limit: Gauge::default(),
            images_used: Gauge::default(),
            images_limit: Gauge::default(),
            disk_free: Gauge::default(),
            disk_size: Gauge::default(),
            ready: Gauge::default(),
            resident: Gauge::default(),
        };
        let process = &mut all.registry;
        process.register_with_unit(
            "process_resident_memory",
            "Memory of the process that is in RAM",
            Unit::Bytes,
            all.resident.clone(),
        );
        let own = all.registry.sub_registry_with_prefix("rpfd");
        own.register("build", "The program that runs", Info::new(Build { version: env!("CARGO_PKG_VERSION") }));
        own.register("requests", "Requests answered, by route, method and HTTP status", all.requests.clone());
        own.register_with_unit(
            "request",
            "From a request's head to the last byte of its answer",
            Unit::Seconds,
            all.seconds.clone(),
        );
        own.register("requests_in_flight", "Requests whose answer is not all sent", all.in_flight.clone());
        own.register("problems", "Refusals and failures by code, in answers and within streams", all.problems.clone());
        own.register("tiles", "Tiles by what became of them", all.tiles.clone());
        own.register("regions", "Regions of bare cores by what became of them", all.regions.clone());
        own.register_with_unit(
            "tile_phase",
            "Time that tiles and regions took, by phase",
            Unit::Seconds,
            all.phases.clone(),
        );
        own.register("queue_length", "Tiles and regions that wait for memory", all.waiting.clone());
        own.register("connections", "Open connections", all.connections.clone());
        own.register("images_open", "Images that are open", all.images.clone());
        own.register("images_in_memory", "Those of them that are in memory", all.images_in_memory.clone());
        for (name, help, gauge) in [
            ("memory_used", "Memory reserved for tiles, requests and images", &all.memory_used),
            ("memory_limit", "Memory that tiles, requests and images may have", &all.memory_limit),
            ("unread_results", "Disk reserved for results that nobody has read yet", &all.unread_used),
            ("unread_results_limit", "Disk that such results may have", &all.unread_limit),
            ("images_disk", "Disk set aside for images", &all.images_used),
            ("images_disk_limit", "Disk that images may have", &all.images_limit),
            ("disk_free", "Free space of the data folder's file system", &all.disk_free),
            ("disk_size", "Size of the data folder's file system", &all.disk_size),
        ] {
            own.register_with_unit(name, help, Unit::Bytes, gauge.clone());
        }
        own.register("ready", "Whether the service takes work: 1 or 0", all.ready.clone());
        // So that a rate is there from the first of its kind on.
        for outcome in ["filtered", "stored", "repeated", "failed", "stopped"] {
            drop(all.tiles.get_or_create(&Outcome { outcome }));
        }
        for outcome in ["filtered", "failed", "stopped"] {
            drop(all.regions.get_or_create(&Outcome { outcome }));
        }
        for phase in [Phase::Queue, Phase::Receive, Phase::Turn, Phase::Filter, Phase::Write] {
            drop(all.phases.get_or_create(&PhaseName { phase: phase.name() }));
        }
        all
    }

    /// A request has come; counted until it is dropped.
    pub(super) fn enter(&self) -> Counted {
        Counted::new(&self.in_flight)
    }

    /// A request was answered, though not all of the answer may be sent.
    pub(super) fn answered(&self, route: &str, method: &Method, status: u16) {
        let methods = ["GET", "HEAD", "POST", "PUT", "DELETE"];
        let method = methods.into_iter().find(|name| *name == method.as_str()).unwrap_or("other");
        self.requests.get_or_create(&Call { route: route.to_owned(), method, status }).inc();
    }

    /// All of an answer is sent, or the client has gone.
    pub(super) fn sent(&self, route: &str, taken: Duration) {
        self.seconds.get_or_create(&Route { route: route.to_owned() }).observe(taken.as_secs_f64());
    }

    /// Something was refused, or failed.
    pub(super) fn problem(&self, code: &str) {
        self.problems.get_or_create(&Code { code: code.to_owned() }).inc();
    }

    /// A tile is done with: `filtered`, `stored`, `repeated`, `failed` or `stopped`.
    pub(super) fn tile(&self, outcome: &'static str) {
        self.tiles.get_or_create(&Outcome { outcome }).inc();
    }

    /// A region is done with, for now: `filtered`, or with the code of a problem.
    pub(super) fn region(&self, what: &str) {
        let outcome = ["filtered", "stopped"].into_iter().find(|outcome| *outcome == what).unwrap_or("failed");
        self.regions.get_or_create(&Outcome { outcome }).inc();
    }

    /// A tile went through a phase that began then.
    pub(super) fn phase(&self, phase: Phase, began: Instant) {
        self.took(phase, began.elapsed());
    }

    /// A phase took so long.
    pub(super) fn took(&self, phase: Phase, taken: Duration) {
        self.phases.get_or_create(&PhaseName { phase: phase.name() }).observe(taken.as_secs_f64());
    }

    /// A tile, or region, waits for memory; counted until it is dropped.
    pub(super) fn wait(&self) -> Counted {
        Counted::new(&self.waiting)
    }

    /// All of it as text. Blocks.
    fn render(&self, service: &Shared) -> Result<String, Refusal> {
        let bytes = |bytes: u64| i64::try_from(bytes).unwrap_or(i64::MAX);
        let memory = [&service.budget, &service.requests, &service.counts, &service.images.memory];
        let (used, unread) = (|budget: &Budget| budget.total() - budget.free(), &service.unread);
        self.memory_limit.set(bytes(memory.map(Budget::total).into_iter().sum()));
        self.memory_used.set(bytes(memory.map(used).into_iter().sum()));
        self.unread_limit.set(bytes(unread.total()));
        self.unread_used.set(bytes(used(unread)));
        self.images.set(bytes(service.images.count() as u64));
        self.images_in_memory.set(bytes(service.images.in_memory() as u64));
        let [used, limit] = service.images.disk();
        self.images_used.set(bytes(used));
        self.images_limit.set(bytes(limit));
        self.ready.set(unready(service).is_none().into());
        if let Ok(disk) = disk(&service.config.data_dir) {
            self.disk_free.set(bytes(disk.free));
            self.disk_size.set(bytes(disk.size));
        }
        self.resident.set(resident());
        let mut text = String::new();
        encode(&mut text, &self.registry).map_err(internal)?;
        Ok(text)
    }
}

/// Bytes of this process that are in RAM; 0 where that is not known.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kib =
        status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kib.unwrap_or(0) * 1024
}

/// `GET /metrics`.
pub(super) async fn metrics(State(service): State<Shared>) -> Result<Response, Refusal> {
    let text = blocking(move || service.metrics.render(&service)).await??;
    Ok(([(header::CONTENT_TYPE, OPEN_METRICS)], text).into_response())
}
