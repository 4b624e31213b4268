//! When to try again.

use super::ClientError;
use crate::{filter::Rect, wire::Problem};
use std::{
    hash::{DefaultHasher, Hash, Hasher},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

/// Pause after the first attempt, and the longest one.
const FIRST: Duration = Duration::from_millis(250);
const LONGEST: Duration = Duration::from_secs(10);
/// Longest that a service may ask to wait.
const LONGEST_ASKED: Duration = Duration::from_secs(60);

/// An attempt that failed.
#[derive(Debug)]
pub(super) enum Attempt {
    /// It is no use to try again.
    Never(ClientError),
    /// Something between here and the service.
    Again { why: String, after: Option<Duration> },
    /// The service said no; `passing` if it may say yes later.
    Refused { tile: Option<Rect>, problem: Box<Problem>, passing: bool, after: Option<Duration> },
}

impl Attempt {
    /// Says which tile it was about.
    pub(super) fn of_tile(self, core: Rect) -> Self {
        match self {
            Self::Refused { problem, passing, after, .. } => {
                Self::Refused { tile: Some(core), problem, passing, after }
            }
            other => other,
        }
    }
}

/// How often to try.
#[derive(Debug)]
pub(super) struct Retry {
    pub(super) attempts: u32,
    pub(super) stop: Arc<AtomicBool>,
}

impl Retry {
    /// Calls until it works, or there is no use in it. `url` is for messages, and spreads the pauses.
    pub(super) fn call<T>(&self, url: &str, mut call: impl FnMut(u32) -> Result<T, Attempt>) -> Result<T, ClientError> {
        let mut attempt = 0;
        loop {
            if self.stop.load(Ordering::Relaxed) {
                return Err(ClientError::Stopped);
            }
            let failed = match call(attempt) {
                Ok(done) => return Ok(done),
                Err(failed) => failed,
            };
            attempt += 1;
            let last = attempt == self.attempts;
            let after = match failed {
                Attempt::Never(error) => return Err(error),
                Attempt::Refused { tile, problem, passing, .. } if last || !passing => {
                    return Err(ClientError::Refused { tile, problem });
                }
                Attempt::Again { why, .. } if last => {
                    return Err(ClientError::Unreachable { url: url.to_owned(), attempts: attempt, why });
                }
                Attempt::Again { after, .. } | Attempt::Refused { after, .. } => after,
            };
            self.sleep(pause(url, attempt, after));
        }
    }

    fn sleep(&self, pause: Duration) {
        let until = Instant::now() + pause;
        while !self.stop.load(Ordering::Relaxed) {
            let Some(left) = until.checked_duration_since(Instant::now()) else { return };
            std::thread::sleep(left.min(Duration::from_millis(100)));
        }
    }
}

/// How long to wait after so many attempts: half of it is fixed, the other half spread by a hash of what was asked for.
fn pause(url: &str, attempt: u32, asked: Option<Duration>) -> Duration {
    let doubled = FIRST.saturating_mul(1 << (attempt - 1).min(16)).min(LONGEST);
    let mut hasher = DefaultHasher::new();
    (url, attempt, std::process::id()).hash(&mut hasher);
    let spread = (hasher.finish() >> 11) as f64 / (1_u64 << 53) as f64;
    doubled.mul_f64(0.5 + 0.5 * spread).max(asked.unwrap_or_default().min(LONGEST_ASKED))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn retry(attempts: u32) -> Retry {
        Retry { attempts, stop: Arc::default() }
    }

    fn refused(status: u16, passing: bool) -> Attempt {
        let problem = Box::new(Problem::new(status, "busy", "", ""));
        Attempt::Refused { tile: None, problem, passing, after: None }
    }

    #[test]
    fn pauses_double_within_limits_and_heed_the_service() {
        for attempt in 1..40 {
            let longest = Duration::from_millis(250 << (attempt - 1).min(16)).min(LONGEST);
            let pause = pause("a", attempt, None);
            assert!(pause >= longest / 2 && pause <= longest, "{attempt}: {pause:?}");
        }
        assert_eq!(pause("a", 1, Some(Duration::from_secs(7))), Duration::from_secs(7));
        assert_eq!(pause("a", 1, Some(Duration::from_secs(7000))), LONGEST_ASKED);
        assert_ne!(pause("a", 3, None), pause("b", 3, None));
    }

    #[test]
    fn what_may_pass_is_tried_again() {
        let mut calls = 0;
        let done = retry(3).call("a", |_| {
            calls += 1;
            if calls < 3 { Err(refused(503, true)) } else { Ok(()) }
        });
        assert!(done.is_ok() && calls == 3);
    }

    #[test]
    fn attempts_are_limited_and_what_will_not_pass_is_not_repeated() {
        for (attempts, passing, expected) in [(2, true, 2), (5, false, 1)] {
            let mut calls = 0;
            let result = retry(attempts).call("a", |_| {
                calls += 1;
                Err::<(), _>(refused(503, passing))
            });
            assert_eq!((calls, result.unwrap_err().code()), (expected, "busy"));
        }
        let cut = || Attempt::Again { why: "cut".to_owned(), after: None };
        let result = retry(1).call("a", |_| Err::<(), _>(cut()));
        assert_eq!(result.unwrap_err().code(), "unreachable");
    }

    #[test]
    fn who_wants_to_stop_does_not_wait() {
        let retry = retry(100);
        let result = retry.call("a", |_| {
            retry.stop.store(true, Ordering::Relaxed);
            Err::<(), _>(refused(503, true))
        });
        assert_eq!(result.unwrap_err().code(), "interrupted");
    }
}
