//! What the service is told when it starts: one [`Config`], checked as a whole.
//!
//! Zero never means unlimited: it is refused.

use std::{
    fmt,
    net::{Ipv4Addr, SocketAddr},
    path::PathBuf,
    str::FromStr,
    time::Duration,
};

/// A number of bytes. Read from `512MiB`, `2GiB`, `64kB` or plain bytes; binary units count by 1024, decimal by 1000.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Units by their names, the largest first of each kind.
const UNITS: [(&str, u64); 9] = [
    ("TiB", 1 << 40),
    ("GiB", 1 << 30),
    ("MiB", 1 << 20),
    ("KiB", 1 << 10),
    ("TB", 1_000_000_000_000),
    ("GB", 1_000_000_000),
    ("MB", 1_000_000),
    ("kB", 1000),
    ("B", 1),
];

/// A text that is no size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no size: write bytes or a number and a unit, like 536870912, 512MiB, 1.5GiB or 2GB")]
pub struct SizeError(String);

impl FromStr for ByteSize {
    type Err = SizeError;

    fn from_str(text: &str) -> Result<Self, SizeError> {
        let wrong = || SizeError(text.to_owned());
        let trimmed = text.trim();
        let end = trimmed.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(trimmed.len());
        let (number, unit) = (&trimmed[..end], trimmed[end..].trim());
        let unit = match unit {
            "" => 1,
            unit => UNITS.iter().find(|(name, _)| name.eq_ignore_ascii_case(unit)).ok_or_else(wrong)?.1,
        };
        let (whole, part) = number.split_once('.').unwrap_or((number, "0"));
        let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        // Parts of a unit to 9 digits; parts of a byte mean nothing.
        if !digits(whole) || !digits(part) || part.len() > 9 || (unit == 1 && number.contains('.')) {
            return Err(wrong());
        }
        let whole = whole.parse::<u64>().ok().and_then(|n| n.checked_mul(unit)).ok_or_else(wrong)?;
        let scale = 10u128.pow(part.len() as u32);
        let part = part.parse::<u128>().map_err(|_| wrong())? * u128::from(unit) / scale;
        whole.checked_add(part as u64).map(Self).ok_or_else(wrong)
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let exact = |(_, unit): &&(&str, u64)| self.0 >= *unit && self.0.is_multiple_of(*unit);
        match UNITS[..4].iter().find(exact) {
            Some((name, unit)) => write!(f, "{}{name}", self.0 / unit),
            None => write!(f, "{}B", self.0),
        }
    }
}

/// Least memory that makes a service: 1 MiB.
pub const MIN_MEMORY: u64 = 1 << 20;
/// Most memory that is counted: 4 TiB less 1 KiB.
pub const MAX_MEMORY: u64 = (1 << 42) - 1024;
/// Most threads.
pub const MAX_THREADS: usize = 1024;
/// Most pixels of an image: the greatest width and height there are.
pub const MAX_IMAGE_PIXELS: u64 = 1 << 40;
/// Longest deadline: a day.
pub const MAX_DEADLINE: Duration = Duration::from_secs(86_400);

/// What the service is told when it starts.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Where to listen; port 0 takes any that is free.
    pub listen: SocketAddr,
    /// Bytes that may be held at once: a share (a quarter up to 64 MiB, then an eighth) by requests, for their buffers and
    /// the windows of compressed bodies; the rest by tiles: samples, buffers of the filter, results. [`MIN_MEMORY`] to
    /// [`MAX_MEMORY`].
    pub memory: ByteSize,
    /// Threads that filter: 1 to [`MAX_THREADS`].
    pub threads: usize,
    /// Folder for canvases and for results that nobody has read yet; made if it is not there.
    pub data_dir: PathBuf,
    /// How long a tile may wait for memory before it is refused.
    pub queue_deadline: Duration,
    /// How long the head of a request may take, and a connection be idle between requests.
    pub header_deadline: Duration,
    /// How long a request's body may bring nothing while the service waits for it; and a client that has sent all it
    /// wants to send, take nothing of the answer.
    pub idle_deadline: Duration,
    /// Bytes a second that a client must bring, or take, over each `idle_deadline` that it is waited for. 1 to 1 GiB.
    pub min_rate: ByteSize,
    /// How long filtering one tile may take.
    pub work_deadline: Duration,
    /// Requests that may wait for memory at once; more are refused. 1 to 65536.
    pub queue: usize,
    /// Bytes of disk for results that nobody has read yet, of all requests. 1 MiB to [`MAX_MEMORY`].
    pub unread_results: ByteSize,
    /// How long requests may go on after the service was told to stop.
    pub shutdown_deadline: Duration,
    /// Connections at once; more wait to be accepted. 1 to 65536.
    pub connections: usize,
    /// Images open at once. 1 to 65536.
    pub images: usize,
    /// Pixels of an image at most; its canvas takes 12 bytes of disk for each. 1 to [`MAX_IMAGE_PIXELS`].
    pub image_pixels: u64,
}

impl Default for Config {
    fn default() -> Self {
        let data_dir = std::env::var_os("TMPDIR").map_or_else(|| PathBuf::from("/var/tmp"), PathBuf::from);
        Self {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 8080)),
            memory: ByteSize(1 << 30),
            threads: std::thread::available_parallelism().map_or(1, |n| n.get().min(MAX_THREADS)),
            data_dir,
            queue_deadline: Duration::from_secs(60),
            header_deadline: Duration::from_secs(15),
            idle_deadline: Duration::from_secs(30),
            min_rate: ByteSize(16 << 10),
            work_deadline: Duration::from_secs(3600),
            queue: 1024,
            unread_results: ByteSize(4 << 30),
            shutdown_deadline: Duration::from_secs(20),
            connections: 1024,
            images: 1024,
            image_pixels: 1 << 30,
        }
    }
}

/// All that is wrong with a configuration, one line each.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct ConfigError(pub Vec<String>);

impl Config {
    /// Checks all of it, and says all that is wrong.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let mut wrong = Vec::new();
        let mut rule = |fine: bool, name: &str, value: &dyn fmt::Display, right: &str| {
            if !fine {
                wrong.push(format!("{name} = {value}: {right}"));
            }
        };
        let memory = (MIN_MEMORY..=MAX_MEMORY).contains(&self.memory.0);
        rule(memory, "memory", &self.memory, "must be 1MiB to 4TiB less 1KiB");
        rule((1..=MAX_THREADS).contains(&self.threads), "threads", &self.threads, "must be 1 to 1024");
        rule(!self.data_dir.as_os_str().is_empty(), "data_dir", &self.data_dir.display(), "must name a folder");
        for (name, deadline) in [
            ("queue_deadline", self.queue_deadline),
            ("header_deadline", self.header_deadline),
            ("idle_deadline", self.idle_deadline),
            ("work_deadline", self.work_deadline),
            ("shutdown_deadline", self.shutdown_deadline),
        ] {
            let fine = !deadline.is_zero() && deadline <= MAX_DEADLINE;
            rule(fine, name, &format_args!("{}s", deadline.as_secs_f64()), "must be more than 0 and a day at most");
        }
        for (name, count) in [("connections", self.connections), ("images", self.images), ("queue", self.queue)] {
            rule((1..=65536).contains(&count), name, &count, "must be 1 to 65536");
        }
        let rate = (1..=1 << 30).contains(&self.min_rate.0);
        rule(rate, "min_rate", &self.min_rate, "must be 1B to 1GiB");
        let unread = (MIN_MEMORY..=MAX_MEMORY).contains(&self.unread_results.0);
        rule(unread, "unread_results", &self.unread_results, "must be 1MiB to 4TiB less 1KiB");
        let pixels = (1..=MAX_IMAGE_PIXELS).contains(&self.image_pixels);
        rule(pixels, "image_pixels", &self.image_pixels, "must be 1 to 2^40");
        if wrong.is_empty() { Ok(()) } else { Err(ConfigError(wrong)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_written() {
        for (text, bytes) in [
            ("0", 0),
            ("1048576", 1 << 20),
            ("512MiB", 512 << 20),
            ("2 GiB", 2 << 30),
            ("2gib", 2 << 30),
            ("1.5GiB", 3 << 29),
            ("64kB", 64_000),
            ("0.1KiB", 102),
            ("16777215TiB", u64::MAX - ((1 << 40) - 1)),
            ("18446744073709551615B", u64::MAX),
        ] {
            assert_eq!(text.parse(), Ok(ByteSize(bytes)), "{text}");
        }
        for text in ["", "MiB", "1.5", "1.", ".5MiB", "-1", "1e3", "12 parsecs", "16777216TiB", "18446744073709551616"]
        {
            let error = text.parse::<ByteSize>().unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")) && error.contains("512MiB"), "{error}");
        }
        for bytes in [0, 1, 1023, 1 << 10, 3 << 29, (1 << 30) + 1, u64::MAX] {
            assert_eq!(ByteSize(bytes).to_string().parse(), Ok(ByteSize(bytes)));
        }
        assert_eq!(ByteSize(512 << 20).to_string(), "512MiB");
    }

    #[test]
    fn all_errors_come_at_once() {
        assert_eq!(Config::default().validate(), Ok(()));
        let zero = Config {
            memory: ByteSize(0),
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
            images: 0,
            image_pixels: 0,
            ..Config::default()
        };
        assert_eq!(zero.validate().unwrap_err().0.len(), 14);
    }

    #[test]
    fn limits_are_exact() {
        let with = |change: &dyn Fn(&mut Config)| {
            let mut config = Config::default();
            change(&mut config);
            config.validate().is_ok()
        };
        let second = Duration::from_secs(1);
        assert!(with(&|c| c.memory.0 = MIN_MEMORY) && !with(&|c| c.memory.0 = MIN_MEMORY - 1));
        assert!(with(&|c| c.memory.0 = MAX_MEMORY) && !with(&|c| c.memory.0 = MAX_MEMORY + 1));
        assert!(with(&|c| c.threads = MAX_THREADS) && !with(&|c| c.threads = MAX_THREADS + 1));
        assert!(with(&|c| c.idle_deadline = MAX_DEADLINE) && !with(&|c| c.idle_deadline = MAX_DEADLINE + second));
        assert!(with(&|c| c.connections = 65536) && !with(&|c| c.connections = 65537));
        assert!(with(&|c| c.image_pixels = MAX_IMAGE_PIXELS) && !with(&|c| c.image_pixels = MAX_IMAGE_PIXELS + 1));
        assert!(with(&|c| c.min_rate.0 = 1 << 30) && !with(&|c| c.min_rate.0 = (1 << 30) + 1));
        assert!(with(&|c| c.unread_results.0 = MIN_MEMORY) && !with(&|c| c.unread_results.0 = MIN_MEMORY - 1));
        assert!(with(&|c| c.images = 1) && !with(&|c| c.images = 65537));
    }
}
