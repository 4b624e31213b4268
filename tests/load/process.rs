//! What the system says of a process.

use std::path::PathBuf;

pub(crate) struct Process(PathBuf);

impl Process {
    pub(crate) fn of(id: u32) -> Self {
        Self(format!("/proc/{id}").into())
    }

    /// Most memory that was resident at once, in bytes.
    pub(crate) fn peak_memory(&self) -> u64 {
        let status = std::fs::read_to_string(self.0.join("status")).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
    }

    /// CPU time of all its threads, also those that have ended.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        seconds(&std::fs::read_to_string(self.0.join("stat")).unwrap())
    }

    /// CPU time of the threads that filter.
    pub(crate) fn filter_seconds(&self) -> f64 {
        let threads = std::fs::read_dir(self.0.join("task")).unwrap();
        let stats = threads.filter_map(|thread| std::fs::read_to_string(thread.unwrap().path().join("stat")).ok());
        stats.filter(|stat| stat.contains("(filter-")).map(|stat| seconds(&stat)).sum()
    }
}

/// User and system time of a line of `stat`, in ticks of a hundredth of a second.
fn seconds(stat: &str) -> f64 {
    let fields: Vec<_> = stat.rsplit(") ").next().unwrap().split(' ').collect();
    let ticks = |field: usize| fields[field].parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / 100.0
}
