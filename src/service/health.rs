//! Whether the service runs, and whether it should be sent work.

use std::{
    path::Path,
    sync::atomic::{AtomicU8, Ordering},
};

use axum::{extract::State, http::StatusCode};

use super::{Shared, problem::Refusal, query::NoQuery, work::blocking};
use crate::wire::Problem;

/// Seconds after which it is worth asking again whether the images are known.
const RECOVERING_AGAIN: u64 = 5;

/// Why a service that runs should be sent no work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reason {
    /// It was told to stop.
    Draining = 1,
    /// It reads what it kept before it was started again.
    Recovering = 2,
}

/// The reasons that there are at the moment. The disk is looked at when it is asked for.
#[derive(Debug, Default)]
pub(super) struct Readiness(AtomicU8);

impl Readiness {
    /// Adds a reason, or takes it back.
    pub(super) fn set(&self, reason: Reason, there: bool) {
        if there {
            self.0.fetch_or(reason as u8, Ordering::Relaxed);
        } else {
            self.0.fetch_and(!(reason as u8), Ordering::Relaxed);
        }
    }

    pub(super) fn has(&self, reason: Reason) -> bool {
        self.0.load(Ordering::Relaxed) & reason as u8 != 0
    }
}

/// Space of the file system of a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Disk {
    /// Bytes in all.
    pub(super) size: u64,
    /// Bytes that this process may still write.
    pub(super) free: u64,
}

/// Asks the file system. Blocks.
pub(super) fn disk(folder: &Path) -> std::io::Result<Disk> {
    let stat = rustix::fs::statvfs(folder)?;
    let bytes = |blocks: u64| blocks.saturating_mul(stat.f_frsize);
    Ok(Disk { size: bytes(stat.f_blocks), free: bytes(stat.f_bavail) })
}

/// The answer as long as the images are not known.
pub(super) fn recovering() -> Refusal {
    let detail = "it reads what it kept before it was started again";
    Problem::new(503, "recovering", "The service is starting", detail).with("retry_after", RECOVERING_AGAIN).into()
}

/// Why no work should be sent, if so. Blocks.
pub(super) fn unready(service: &Shared) -> Option<Refusal> {
    if service.readiness.has(Reason::Draining) {
        let detail = "it finishes what it has begun and takes nothing new";
        return Some(Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "draining", "The service is stopping", detail));
    }
    if service.readiness.has(Reason::Recovering) {
        return Some(recovering());
    }
    let reserve = service.config.disk_reserve;
    let detail = match disk(&service.config.data_dir) {
        Ok(disk) if disk.free >= reserve.0 => return None,
        Ok(disk) => format!("{} bytes are free, less than the {reserve} kept in reserve", disk.free),
        Err(error) => {
            tracing::error!(%error, "the data folder's file system cannot be asked");
            "the data folder's file system does not answer".to_owned()
        }
    };
    Some(Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "low_disk", "The service's disk is nearly full", detail))
}

/// `GET /livez`.
pub(super) async fn live(_: NoQuery) -> &'static str {
    "alive\n"
}

/// `GET /readyz`.
pub(super) async fn ready(State(service): State<Shared>, _: NoQuery) -> Result<&'static str, Refusal> {
    match blocking(move || unready(&service)).await? {
        Some(refusal) => Err(refusal),
        None => Ok("ready\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_come_and_go() {
        let readiness = Readiness::default();
        readiness.set(Reason::Recovering, true);
        readiness.set(Reason::Draining, true);
        readiness.set(Reason::Recovering, false);
        assert!(readiness.has(Reason::Draining) && !readiness.has(Reason::Recovering));
    }

    #[test]
    fn the_disk_is_asked() {
        let disk = disk(&std::env::temp_dir()).unwrap();
        assert!(disk.size >= disk.free && disk.size > 0);
        assert!(super::disk(Path::new("/nowhere/at/all")).is_err());
    }
}
