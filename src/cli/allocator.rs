//! The system's allocator, told to give large blocks back.
//!
//! glibc maps a large block by itself, and unmaps it when it is freed; but after the first is freed it takes blocks of
//! that size, up to 32 MiB, from heaps that it cuts up and does not give back: twice the memory that tiles reserve then
//! stays resident. A threshold that was set does not move. It is read from the environment when a process starts.

/// The variable that glibc reads, and what it is told: blocks from 128 KiB on are mapped.
const TUNABLES: &str = "GLIBC_TUNABLES";
const THRESHOLD: &str = "glibc.malloc.mmap_threshold";

/// Starts the program again, as the same process with the same arguments, with the threshold set; once it is, this does
/// nothing. Must be called before anything else is done.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(super) fn settle() {
    use std::{env, os::unix::process::CommandExt, process::Command};
    let mut tunables = env::var(TUNABLES).unwrap_or_default();
    if tunables.contains(THRESHOLD) {
        return;
    }
    if !tunables.is_empty() {
        tunables.push(':');
    }
    tunables += &format!("{THRESHOLD}={}", 128 << 10);
    let mut arguments = env::args_os();
    let (name, Ok(program)) = (arguments.next(), env::current_exe()) else { return };
    let mut command = Command::new(program);
    name.map(|name| command.arg0(name));
    // It comes back only if it fails; then more memory than was asked for may stay resident.
    let _ = command.args(arguments).env(TUNABLES, tunables).exec();
}

/// Other allocators keep less.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(super) const fn settle() {}
