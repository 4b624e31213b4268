//! How fast bytes become free: from how long they were held of late.

use std::time::{Duration, Instant};

/// What was measured counts half after so long.
const HALF_LIFE: Duration = Duration::from_secs(60);

/// By Little's law the mean time for which a byte is held: byte-seconds held over bytes given back.
#[derive(Debug, Default)]
pub(super) struct Drain {
    /// Bytes given back.
    bytes: f64,
    /// Bytes held, times the seconds for which they were.
    byte_seconds: f64,
    last: Option<Instant>,
}

impl Drain {
    /// Time has passed, up to `now`, in which so many bytes were held.
    pub(super) fn pass(&mut self, now: Instant, held: u64) {
        let passed = self.last.map_or(0.0, |last| now.saturating_duration_since(last).as_secs_f64());
        let kept = 0.5f64.powf(passed / HALF_LIFE.as_secs_f64());
        self.bytes *= kept;
        self.byte_seconds = self.byte_seconds * kept + held as f64 * passed;
        self.last = Some(now);
    }

    /// Bytes were given back.
    pub(super) fn give_back(&mut self, bytes: u64) {
        self.bytes += bytes as f64;
    }

    /// How long it takes until so many bytes are given back while all of `total` is held; none if nothing is known.
    pub(super) fn time_for(&self, bytes: u64, total: u64) -> Option<Duration> {
        let seconds = self.byte_seconds / self.bytes * (bytes as f64 / total as f64);
        Duration::try_from_secs_f64(seconds).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// After these events: (seconds since the one before, bytes held meanwhile, bytes given back then).
    fn drain(events: &[(f64, u64, u64)]) -> Drain {
        let (mut drain, mut now) = (Drain::default(), Instant::now());
        drain.pass(now, 0);
        for &(seconds, held, back) in events {
            now += Duration::from_secs_f64(seconds);
            drain.pass(now, held);
            drain.give_back(back);
        }
        drain
    }

    #[test]
    fn the_time_is_that_of_the_bytes_ahead() {
        let seconds = |drain: &Drain, bytes| drain.time_for(bytes, 100).map(|time| time.as_secs_f64().round());
        assert_eq!(seconds(&drain(&[]), 50), None);
        assert_eq!(seconds(&drain(&[(5.0, 100, 0)]), 50), None);
        // Every byte is held for 10 seconds, whether few are or many.
        for held in [10, 100] {
            let events: Vec<_> = (0..50).map(|_| (10.0, held, held)).collect();
            let drain = drain(&events);
            // 100 of 100 bytes in 10 seconds; twice as many wait twice as long.
            assert_eq!(
                (seconds(&drain, 100), seconds(&drain, 200), seconds(&drain, 0)),
                (Some(10.0), Some(20.0), Some(0.0))
            );
        }
        // It slows down: after a while only the new pace counts.
        let mut events = vec![(1.0, 100, 100); 100];
        events.extend([(20.0, 100, 100); 3]);
        let between = seconds(&drain(&events), 100);
        assert!(Some(1.0) < between && between < Some(20.0), "{between:?}");
        events.extend([(20.0, 100, 100); 50]);
        assert_eq!(seconds(&drain(&events), 100), Some(20.0));
    }
}
