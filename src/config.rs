//! What the service is told when it starts: one [`Config`], checked as a whole.
//!
//! Every setting is one entry of the table in this file: its name is the key of the file, the flag (`--queue-deadline`)
//! and the environment variable (`RPFD_QUEUE_DEADLINE`); [`load`] reads these. Zero never means unlimited: it is refused.

pub mod load;
mod value;

use crate::filter::SimdLevel;
use std::{
    fmt,
    net::{Ipv4Addr, SocketAddr},
    path::PathBuf,
    time::Duration,
};

use value::Value;
pub use value::{ByteSize, LogFormat, SizeError};

/// Least memory that makes a service: 4 MiB. A small image can be open then, three requests be under way, and a tile of
/// 16 x 16 pixels with a sample each be filtered by the default preset, with its halo.
pub const MIN_MEMORY: u64 = 4 << 20;
/// The same for each thread, beyond 8 of them.
pub const THREAD_MEMORY: u64 = 512 << 10;
/// Connections that cost nothing of the memory: what comes over them before a request has its own is in what the service
/// takes beside.
pub const FREE_CONNECTIONS: usize = 512;
/// Memory for each connection more: the head of a request, or what was read of the next one, and its state.
pub const CONNECTION_MEMORY: u64 = 96 << 10;
/// Least disk, for images and for results: 1 MiB.
pub const MIN_DISK: u64 = 1 << 20;
/// Most memory that is counted: 4 TiB less 1 KiB.
pub const MAX_MEMORY: u64 = (1 << 42) - 1024;
/// Most threads.
pub const MAX_THREADS: usize = 1024;
/// Most pixels of an image: the greatest width and height there are.
pub const MAX_IMAGE_PIXELS: u64 = 1 << 40;
/// Most disk: 1 EiB.
pub const MAX_DISK: u64 = 1 << 60;
/// Longest time that images are kept: ten years.
pub const MAX_TTL: Duration = Duration::from_secs(10 * 365 * 86_400);
/// Longest deadline: a day.
pub const MAX_DEADLINE: Duration = Duration::from_secs(86_400);
/// Most of whatever is counted one by one: connections, requests, images.
pub const MAX_COUNT: usize = 65536;

/// One setting, apart from its type.
pub(crate) struct Setting {
    /// `snake_case`, as in the file.
    pub(crate) name: &'static str,
    /// What stands for its value in the help; empty for a switch.
    pub(crate) value: &'static str,
    /// What it is, one line each.
    pub(crate) help: &'static [&'static str],
    pub(crate) read: fn(&mut Config, &str) -> Result<(), String>,
    pub(crate) to_toml: fn(&Config) -> Option<String>,
    /// What would be right, if its value is not.
    pub(crate) check: fn(&Config) -> Option<&'static str>,
}

/// Makes the struct, its defaults, and the table of settings, from one list.
macro_rules! settings {
    ($($(#[doc = $doc:literal])+ $name:ident: $type:ty = $default:expr, $value:literal, $fine:expr, $right:literal;)+) => {
        /// What the service is told when it starts.
        #[derive(Clone, Debug, PartialEq)]
        pub struct Config {
            $($(#[doc = $doc])+ pub $name: $type,)+
        }

        impl Default for Config {
            fn default() -> Self {
                Self { $($name: $default,)+ }
            }
        }

        /// All settings, in the order in which they are printed.
        pub(crate) static SETTINGS: &[Setting] = &[$(Setting {
            name: stringify!($name),
            value: $value,
            help: &[$($doc),+],
            read: |config, text| {
                config.$name = Value::read(text)?;
                Ok(())
            },
            to_toml: |config| config.$name.to_toml(),
            check: |config| {
                let fine: fn(&$type) -> bool = $fine;
                if fine(&config.$name) { None } else { Some($right) }
            },
        },)+];
    };
}

fn deadline(value: &Duration) -> bool {
    !value.is_zero() && *value <= MAX_DEADLINE
}

fn count(value: &usize) -> bool {
    (1..=MAX_COUNT).contains(value)
}

settings! {
    /// Address to listen on; port 0 takes any that is free. Other than loopback only with token_file
    listen: SocketAddr = SocketAddr::from((Ipv4Addr::LOCALHOST, 8080)), "ADDRESS", |_| true, "";

    /// Address on which Prometheus metrics are served, at /metrics and without tokens; nowhere if it is not set
    metrics_listen: Option<SocketAddr> = None, "ADDRESS", |_| true, "";

    /// File of bearer tokens, read again at SIGHUP; `rpfd token` makes its entries. Not set: whoever can connect may do
    /// everything
    token_file: Option<PathBuf> = None, "FILE", |_| true, "";

    /// Listen beyond loopback without tokens: for networks that let nobody else in
    insecure_no_auth: bool = false, "", |_| true, "";

    /// Folder for images and unread results, of this service alone; made if it is not there. By default rpfd in $TMPDIR or
    /// /var/tmp
    data_dir: PathBuf = PathBuf::from(
        std::env::var_os("TMPDIR").filter(|dir| !dir.is_empty()).unwrap_or_else(|| "/var/tmp".into())
    ).join("rpfd"),
        "DIR", |dir| !dir.as_os_str().is_empty(), "must name a folder";

    /// Memory for tiles at work (samples, the filter's buffers, results) and, a share of it (a quarter up to 64 MiB, then
    /// an eighth), for requests, and of that, a quarter, for the counts of tiles that vary in them; and half as much as that
    /// share for what is known of images. 4MiB, and half a MiB a thread, to 4TiB less 1KiB
    memory: ByteSize = ByteSize(1 << 30), "SIZE", |size| (MIN_MEMORY..=MAX_MEMORY).contains(&size.0),
        "must be 4MiB to 4TiB less 1KiB";

    /// Free space of the data folder's file system below which the service says that it is not ready. 4KiB at least
    disk_reserve: ByteSize = ByteSize(256 << 20), "SIZE", |size| size.0 >= 4096, "must be 4KiB at least";

    /// Threads that filter, 1 to 1024. By default one per CPU
    threads: usize = std::thread::available_parallelism().map_or(1, |n| n.get().min(MAX_THREADS)), "N",
        |n| (1..=MAX_THREADS).contains(n), "must be 1 to 1024";

    /// SIMD instructions to filter with, for the same bits in more time: auto for the best that this CPU has, or one of
    /// its levels, like sse4.2 or avx2
    simd: SimdLevel = SimdLevel::default(), "LEVEL", |_| true, "";

    /// Connections at once; more wait to be accepted. Beyond 512 each takes 96KiB of the memory. 1 to 65536
    connections: usize = 512, "N", count, "must be 1 to 65536";

    /// Requests at once on one HTTP/2 connection; more wait at the client. 1 to 1000
    streams: u32 = 32, "N", |n| (1..=1000).contains(n), "must be 1 to 1000";

    /// Requests at once, in all; more are refused. 1 to 65536
    requests: usize = 2048, "N", count, "must be 1 to 65536";

    /// Requests at once with one token, unless the token file says otherwise; more are refused. 1 to 65536
    token_requests: usize = 512, "N", count, "must be 1 to 65536";

    /// Images open at once. 1 to 65536
    images: usize = 1024, "N", count, "must be 1 to 65536";

    /// Images open at once that were opened with one token, unless the token file says otherwise. 1 to 65536
    token_images: usize = 256, "N", count, "must be 1 to 65536";

    /// Disk for all images; what one takes at worst is set aside when it is opened. 1MiB to 1EiB
    disk: ByteSize = ByteSize(64 << 30), "SIZE", |size| (MIN_DISK..=MAX_DISK).contains(&size.0),
        "must be 1MiB to 1EiB";

    /// How long an image is kept that nobody uses. A second to ten years
    image_ttl: Duration = Duration::from_secs(7 * 86_400), "TIME",
        |time| (Duration::from_secs(1)..=MAX_TTL).contains(time), "must be a second to ten years";

    /// How long an image that nobody uses stays in memory, and its files open. Up to a day
    image_idle: Duration = Duration::from_secs(30), "TIME", deadline, "must be more than 0 and a day at most";

    /// Pixels of an image, at most; its canvas takes 12 bytes of disk for each. 1 to 2^40
    image_pixels: u64 = 1 << 30, "N", |n| (1..=MAX_IMAGE_PIXELS).contains(n), "must be 1 to 2^40";

    /// Requests and tiles that may wait for memory at once; more are refused. 1 to 65536
    queue: usize = 1024, "N", count, "must be 1 to 65536";

    /// Disk for results and other answers that nobody has read yet, of all requests. 1MiB to 4TiB less 1KiB
    unread_results: ByteSize = ByteSize(4 << 30), "SIZE", |size| (MIN_DISK..=MAX_MEMORY).contains(&size.0),
        "must be 1MiB to 4TiB less 1KiB";

    /// Bytes a second that a client must bring, or take, over each idle_deadline that it is waited for. 1B to 1GiB
    min_rate: ByteSize = ByteSize(16 << 10), "SIZE", |rate| (1..=1 << 30).contains(&rate.0), "must be 1B to 1GiB";

    /// How long a tile may wait for memory before it is refused. Up to a day, like all deadlines
    queue_deadline: Duration = Duration::from_secs(60), "TIME", deadline, "must be more than 0 and a day at most";

    /// How long the head of a request may take, and a connection be idle between requests
    header_deadline: Duration = Duration::from_secs(15), "TIME", deadline, "must be more than 0 and a day at most";

    /// How long a request's body may bring nothing while the service waits for it, and a client that has sent all take
    /// nothing of the answer
    idle_deadline: Duration = Duration::from_secs(30), "TIME", deadline, "must be more than 0 and a day at most";

    /// How long filtering one tile may take, or one region of bare cores, which is then filtered in smaller parts
    work_deadline: Duration = Duration::from_secs(3600), "TIME", deadline, "must be more than 0 and a day at most";

    /// How long requests may go on after the service was told to stop
    shutdown_deadline: Duration = Duration::from_secs(20), "TIME", deadline, "must be more than 0 and a day at most";

    /// What is logged, in the words of RUST_LOG, which takes its place if it is set
    log: String = "info".to_owned(), "FILTER",
        |log| tracing_subscriber::EnvFilter::try_new(log).is_ok(), "must be like info, or warn,rpfd=debug";

    /// How the log is written: text or json
    log_format: LogFormat = LogFormat::Text, "FORMAT", |_| true, "";
}

/// All that is wrong with a configuration, one line each.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct ConfigError(pub Vec<String>);

impl Config {
    /// Checks all of it, and says all that is wrong.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let wrong = self.faults(|setting| setting.name.to_owned());
        if wrong.is_empty() { Ok(()) } else { Err(ConfigError(wrong)) }
    }

    /// Bytes of memory that connections take beside those that are free.
    fn connection_memory(&self) -> u64 {
        CONNECTION_MEMORY * self.connections.saturating_sub(FREE_CONNECTIONS) as u64
    }

    /// Bytes of memory for tiles, requests and images.
    pub(crate) fn shared_memory(&self) -> u64 {
        self.memory.0.saturating_sub(self.connection_memory())
    }

    /// What is wrong with each setting, which goes by the name that `named` gives it.
    fn faults(&self, named: impl Fn(&Setting) -> String) -> Vec<String> {
        let shown = |setting: &Setting| (setting.to_toml)(self).unwrap_or_else(|| "unset".to_owned());
        let one =
            |setting: &&Setting| Some(format!("{} = {}: {}", named(setting), shown(setting), (setting.check)(self)?));
        let mut wrong: Vec<String> = SETTINGS.iter().filter_map(|setting| one(&setting)).collect();
        let name = |name| SETTINGS.iter().find(|setting| setting.name == name).map(&named).unwrap_or_default();
        let least = MIN_MEMORY.max(THREAD_MEMORY.saturating_mul(self.threads as u64)) + self.connection_memory();
        // Else the one that is wrong has been told of.
        let fine = self.memory.0 >= MIN_MEMORY && self.threads <= MAX_THREADS && self.connections <= MAX_COUNT;
        if fine && self.memory.0 < least {
            wrong.push(format!(
                "{} = \"{}\": with {} threads and {} connections must be {} at least",
                name("memory"),
                self.memory,
                self.threads,
                self.connections,
                ByteSize(least)
            ));
        }
        if !self.listen.ip().to_canonical().is_loopback() && self.token_file.is_none() && !self.insecure_no_auth {
            wrong.push(format!(
                "{} = \"{}\": whoever reaches this address could use the service, as no tokens are set. Set token_file \
                 (rpfd token makes its entries), or listen on loopback (127.0.0.1 or [::1]) behind a proxy; \
                 insecure_no_auth = true serves without tokens all the same",
                name("listen"),
                self.listen
            ));
        }
        wrong
    }
}

impl fmt::Debug for Setting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_errors_come_at_once() {
        assert_eq!(Config::default().validate(), Ok(()));
        let zero = Config {
            listen: SocketAddr::from(([0, 0, 0, 0], 8080)),
            memory: ByteSize(0),
            disk_reserve: ByteSize(0),
            threads: 0,
            data_dir: PathBuf::new(),
            queue_deadline: Duration::ZERO,
            header_deadline: Duration::ZERO,
            idle_deadline: Duration::ZERO,
            min_rate: ByteSize(0),
            work_deadline: Duration::ZERO,
            queue: 0,
            unread_results: ByteSize(0),
            shutdown_deadline: Duration::ZERO,
            connections: 0,
            streams: 0,
            requests: 0,
            token_requests: 0,
            images: 0,
            token_images: 0,
            disk: ByteSize(0),
            image_ttl: Duration::ZERO,
            image_idle: Duration::ZERO,
            image_pixels: 0,
            log: "a=b=c".to_owned(),
            metrics_listen: None,
            token_file: None,
            insecure_no_auth: false,
            log_format: LogFormat::Text,
            simd: SimdLevel::default(),
        };
        // All but those that have no wrong value.
        assert_eq!(zero.validate().unwrap_err().0.len(), SETTINGS.len() - 5);
    }

    #[test]
    fn limits_are_exact() {
        let with = |change: &dyn Fn(&mut Config)| {
            let mut config = Config::default();
            change(&mut config);
            config.validate().is_ok()
        };
        let second = Duration::from_secs(1);
        let memory = |bytes, threads, connections| {
            with(&|c| (c.memory.0, c.threads, c.connections) = (bytes, threads, connections))
        };
        assert!(memory(MIN_MEMORY, 8, FREE_CONNECTIONS) && !memory(MIN_MEMORY - 1, 1, 1));
        assert!(memory(9 * THREAD_MEMORY, 9, 1) && !memory(9 * THREAD_MEMORY - 1, 9, 1));
        let more = MIN_MEMORY + 3 * CONNECTION_MEMORY;
        assert!(memory(more, 1, FREE_CONNECTIONS + 3) && !memory(more - 1, 1, FREE_CONNECTIONS + 3));
        assert_eq!(
            Config { memory: ByteSize(more), connections: 515, ..Config::default() }.shared_memory(),
            MIN_MEMORY
        );
        assert!(with(&|c| c.memory.0 = MAX_MEMORY) && !with(&|c| c.memory.0 = MAX_MEMORY + 1));
        assert!(with(&|c| c.threads = MAX_THREADS) && !with(&|c| c.threads = MAX_THREADS + 1));
        assert!(with(&|c| c.idle_deadline = MAX_DEADLINE) && !with(&|c| c.idle_deadline = MAX_DEADLINE + second));
        let connections = |n| with(&|c| (c.memory.0, c.connections) = (8 << 30, n));
        assert!(connections(MAX_COUNT) && !connections(MAX_COUNT + 1));
        assert!(with(&|c| c.requests = MAX_COUNT) && !with(&|c| c.requests = MAX_COUNT + 1));
        assert!(with(&|c| c.token_requests = MAX_COUNT) && !with(&|c| c.token_requests = MAX_COUNT + 1));
        assert!(with(&|c| c.streams = 1000) && !with(&|c| c.streams = 1001));
        assert!(with(&|c| c.disk_reserve.0 = 4096) && !with(&|c| c.disk_reserve.0 = 4095));
        assert!(with(&|c| c.image_pixels = MAX_IMAGE_PIXELS) && !with(&|c| c.image_pixels = MAX_IMAGE_PIXELS + 1));
        assert!(with(&|c| c.disk.0 = MAX_DISK) && !with(&|c| c.disk.0 = MAX_DISK + 1));
        assert!(with(&|c| c.image_ttl = second) && !with(&|c| c.image_ttl = second / 2));
        assert!(with(&|c| c.image_ttl = MAX_TTL) && !with(&|c| c.image_ttl = MAX_TTL + second));
        assert!(with(&|c| c.queue = MAX_COUNT) && !with(&|c| c.queue = MAX_COUNT + 1));
        assert!(with(&|c| c.work_deadline = MAX_DEADLINE) && !with(&|c| c.work_deadline = MAX_DEADLINE + second));
        assert!(with(&|c| c.min_rate.0 = 1 << 30) && !with(&|c| c.min_rate.0 = (1 << 30) + 1));
        assert!(with(&|c| c.unread_results.0 = MIN_DISK) && !with(&|c| c.unread_results.0 = MIN_DISK - 1));
        assert!(with(&|c| c.images = 1) && !with(&|c| c.images = MAX_COUNT + 1));
        assert!(with(&|c| c.token_images = 1) && !with(&|c| c.token_images = MAX_COUNT + 1));
    }

    #[test]
    fn only_loopback_goes_without_tokens() {
        let config = |listen: &str| Config { listen: listen.parse().unwrap(), ..Config::default() };
        for loopback in ["127.0.0.1:0", "127.3.2.1:80", "[::1]:8080", "[::ffff:127.0.0.1]:80"] {
            assert_eq!(config(loopback).validate(), Ok(()));
        }
        for other in ["0.0.0.0:0", "[::]:80", "10.0.0.1:80", "[::ffff:10.0.0.1]:80"] {
            assert!(config(other).validate().unwrap_err().0[0].contains("token_file"));
            assert_eq!(Config { token_file: Some("x".into()), ..config(other) }.validate(), Ok(()));
            assert_eq!(Config { insecure_no_auth: true, ..config(other) }.validate(), Ok(()));
        }
    }
}
