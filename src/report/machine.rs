//! On what a report was made, and what the process has used. Linux tells; elsewhere things are left out.

use crate::filter::SimdLevel;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use std::fs;

/// The machine and the program.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Machine {
    /// What the processor calls itself.
    pub cpu: String,
    /// Processors that the program may use.
    pub cores: usize,
    /// The SIMD level that the filter uses.
    pub simd: String,
    /// Operating system, kernel and architecture.
    pub os: String,
    /// Version of the program.
    pub version: String,
}

impl Machine {
    /// This one, where the filter uses this SIMD level.
    pub fn here(simd: SimdLevel) -> Self {
        let line = |path: &str, key: &str| {
            let text = fs::read_to_string(path).ok()?;
            let line = text.lines().find_map(|line| line.strip_prefix(key))?;
            Some(line.trim_start_matches([' ', '\t', ':', '=']).trim_matches('"').to_owned())
        };
        let unknown = || "unknown".to_owned();
        let name = line("/etc/os-release", "PRETTY_NAME").unwrap_or_else(|| std::env::consts::OS.to_owned());
        let kernel = line("/proc/sys/kernel/osrelease", "").map(|kernel| format!(", kernel {kernel}"));
        Self {
            cpu: line("/proc/cpuinfo", "model name").unwrap_or_else(unknown),
            cores: std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get),
            simd: simd.name().to_owned(),
            os: format!("{name}{}, {}", kernel.unwrap_or_default(), std::env::consts::ARCH),
            version: format!("rpfd {}", env!("CARGO_PKG_VERSION")),
        }
    }
}

impl Machine {
    /// The version of the program, and what tells this build of it from any other: BLAKE3 of its file, where that can be
    /// read. Times measured by another build are not this one's.
    pub fn build() -> String {
        let version = env!("CARGO_PKG_VERSION");
        let hash = || {
            let mut hasher = blake3::Hasher::new();
            hasher.update_reader(fs::File::open(std::env::current_exe().ok()?).ok()?).ok()?;
            Some(hasher.finalize().to_hex()[..16].to_owned())
        };
        hash().map_or_else(|| version.to_owned(), |hash| format!("{version}+{hash}"))
    }
}

/// Seconds of processor time that all threads of this process have used, in user and system mode.
pub fn cpu_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Forgets the greatest resident size so far; says whether the system can do that.
pub fn reset_peak() -> bool {
    fs::write("/proc/self/clear_refs", "5").is_ok()
}

/// Greatest resident size of this process in bytes, since the last [`reset_peak`].
pub fn peak_resident() -> Option<u64> {
    status("VmHWM:")
}

/// Resident size of this process in bytes.
pub fn resident() -> Option<u64> {
    status("VmRSS:")
}

fn status(key: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
}
