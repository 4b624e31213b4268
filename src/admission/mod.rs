//! The memory budget: bytes are reserved before they are allocated.
//!
//! A [`Budget`] hands out [`Permit`]s, first come, first served: a large request that waits is not overtaken by small ones
//! that would fit. A permit travels with the data it was taken for and gives its bytes back when it is dropped. It knows
//! nothing of what the bytes are for, nor of HTTP.

use std::{sync::Arc, time::Duration};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// What is counted: 1 KiB, so that a semaphore's 32 bits reach to 4 TiB.
const UNIT: u64 = 1024;

/// Why bytes were not reserved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AdmissionError {
    /// More than there ever is; waiting would not help.
    #[error("{needed} bytes are needed, more than the {total} bytes that there are in all")]
    TooLarge {
        /// Bytes asked for.
        needed: u64,
        /// Bytes that would fit: all there are.
        total: u64,
    },
    /// Others held the bytes for too long.
    #[error("{needed} bytes did not become free within {} seconds", deadline.as_secs_f32())]
    Busy {
        /// Bytes asked for.
        needed: u64,
        /// How long it waited.
        deadline: Duration,
    },
}

impl AdmissionError {
    /// A stable code.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::TooLarge { .. } => "over_memory",
            Self::Busy { .. } => "busy",
        }
    }
}

/// Bytes that may be in use at once, over all holders.
#[derive(Clone, Debug)]
pub struct Budget {
    semaphore: Arc<Semaphore>,
    units: u32,
}

impl Budget {
    /// A budget of so many bytes, rounded down to whole KiB; at most 4 TiB.
    pub fn new(bytes: u64) -> Self {
        let units = u32::try_from(bytes / UNIT).unwrap_or(u32::MAX);
        // On 32 bits a semaphore counts less far.
        let units = units.min(u32::try_from(Semaphore::MAX_PERMITS).unwrap_or(u32::MAX));
        Self { semaphore: Arc::new(Semaphore::new(units as usize)), units }
    }

    /// Bytes in all.
    pub const fn total(&self) -> u64 {
        self.units as u64 * UNIT
    }

    /// Bytes that nobody holds.
    pub fn free(&self) -> u64 {
        self.semaphore.available_permits() as u64 * UNIT
    }

    /// Says whether so many bytes can ever be reserved.
    pub const fn check(&self, bytes: u64) -> Result<(), AdmissionError> {
        if bytes > self.total() {
            return Err(AdmissionError::TooLarge { needed: bytes, total: self.total() });
        }
        Ok(())
    }

    /// Reserves bytes, rounded up to whole KiB, after everyone who asked before; waits until `deadline` has passed.
    /// Giving up, or dropping the future, loses the place in the queue and holds nothing.
    pub async fn reserve(&self, bytes: u64, deadline: Duration) -> Result<Permit, AdmissionError> {
        self.reserve_after(bytes, std::future::ready(()), deadline).await
    }

    /// As [`reserve`](Self::reserve), the deadline starting when `own` is done: whoever waits for bytes that he holds
    /// himself, and that will become free, waits for nobody else.
    pub async fn reserve_after(
        &self,
        bytes: u64,
        own: impl Future<Output = ()>,
        deadline: Duration,
    ) -> Result<Permit, AdmissionError> {
        self.check(bytes)?;
        let late = async {
            own.await;
            tokio::time::sleep(deadline).await;
        };
        tokio::select! {
            biased;
            // The semaphore is never closed.
            Ok(permit) = Arc::clone(&self.semaphore).acquire_many_owned(units(bytes)) => Ok(Permit { permit }),
            () = late => Err(AdmissionError::Busy { needed: bytes, deadline }),
        }
    }
}

/// Units that hold so many bytes, which are within a budget.
fn units(bytes: u64) -> u32 {
    u32::try_from(bytes.div_ceil(UNIT)).unwrap_or(u32::MAX)
}

/// Reserved bytes; dropping it gives them back.
#[derive(Debug)]
pub struct Permit {
    permit: OwnedSemaphorePermit,
}

impl Permit {
    /// Bytes that it holds.
    pub fn bytes(&self) -> u64 {
        self.permit.num_permits() as u64 * UNIT
    }

    /// Gives back all but `bytes`, rounded up to whole KiB; it never grows.
    pub fn shrink_to(&mut self, bytes: u64) {
        let held = self.permit.num_permits();
        drop(self.permit.split(held.saturating_sub(units(bytes) as usize)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(20);
    const LATER: Duration = Duration::from_secs(20);

    fn run<T>(work: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap().block_on(work)
    }

    #[test]
    fn limits_are_exact() {
        run(async {
            let budget = Budget::new(10 * UNIT + 1023);
            assert_eq!(budget.total(), 10 * UNIT);
            let all = budget.reserve(10 * UNIT, SOON).await.unwrap();
            assert_eq!((all.bytes(), budget.free()), (10 * UNIT, 0));
            let one = budget.reserve(1, SOON).await.unwrap_err();
            assert_eq!(one, AdmissionError::Busy { needed: 1, deadline: SOON });
            drop(all);
            assert_eq!(budget.free(), 10 * UNIT);
            // At once, not after the deadline.
            let more = tokio::time::timeout(SOON, budget.reserve(10 * UNIT + 1, LATER)).await.unwrap().unwrap_err();
            assert_eq!(more, AdmissionError::TooLarge { needed: 10 * UNIT + 1, total: 10 * UNIT });
            assert!(budget.reserve(u64::MAX, LATER).await.is_err());
            assert_eq!(budget.reserve(0, SOON).await.unwrap().bytes(), 0);
        });
    }

    #[test]
    fn counts_up_to_four_tebibytes() {
        run(async {
            let budget = Budget::new(u64::MAX);
            assert_eq!(budget.total(), u64::from(u32::MAX) * UNIT);
            let all = budget.reserve(budget.total(), SOON).await.unwrap();
            assert_eq!(all.bytes(), budget.total());
        });
    }

    #[test]
    fn permits_shrink_and_never_grow() {
        run(async {
            let budget = Budget::new(10 * UNIT);
            let mut permit = budget.reserve(8 * UNIT, SOON).await.unwrap();
            permit.shrink_to(9 * UNIT);
            assert_eq!(permit.bytes(), 8 * UNIT);
            permit.shrink_to(2 * UNIT + 1);
            assert_eq!((permit.bytes(), budget.free()), (3 * UNIT, 7 * UNIT));
            permit.shrink_to(0);
            assert_eq!(budget.free(), 10 * UNIT);
        });
    }

    #[test]
    fn a_large_request_is_not_starved_by_small_ones() {
        run(async {
            let budget = Budget::new(10 * UNIT);
            let held = budget.reserve(6 * UNIT, SOON).await.unwrap();
            let large = tokio::spawn({
                let budget = budget.clone();
                async move { budget.reserve(8 * UNIT, LATER).await }
            });
            tokio::task::yield_now().await;
            // It would fit, but the large one came first.
            assert_eq!(budget.reserve(UNIT, SOON).await.unwrap_err().code(), "busy");
            drop(held);
            let large = large.await.unwrap().unwrap();
            assert_eq!((large.bytes(), budget.free()), (8 * UNIT, 2 * UNIT));
        });
    }

    #[test]
    fn the_deadline_starts_after_ones_own_work() {
        run(async {
            let budget = Budget::new(10 * UNIT);
            let held = budget.reserve(6 * UNIT, SOON).await.unwrap();
            let own = async {
                tokio::time::sleep(4 * SOON).await;
            };
            let work = async {
                tokio::time::sleep(3 * SOON).await;
                drop(held);
            };
            let (reserved, ()) = tokio::join!(budget.reserve_after(8 * UNIT, own, SOON), work);
            let all = reserved.unwrap();
            let own = tokio::time::sleep(SOON);
            assert_eq!(budget.reserve_after(8 * UNIT, own, SOON).await.unwrap_err().code(), "busy");
            drop(all);
        });
    }

    #[test]
    fn one_who_gives_up_leaves_the_queue() {
        run(async {
            let budget = Budget::new(10 * UNIT);
            let held = budget.reserve(6 * UNIT, SOON).await.unwrap();
            assert!(budget.reserve(8 * UNIT, SOON).await.is_err());
            let small = budget.reserve(4 * UNIT, SOON).await.unwrap();
            drop((held, small));
            assert_eq!(budget.free(), 10 * UNIT);
        });
    }
}
