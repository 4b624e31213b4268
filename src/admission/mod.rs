//! The budget: bytes are reserved before they are allocated, or written.
//!
//! A [`Budget`] hands out [`Permit`]s. A permit travels with the data it was taken for and gives its bytes back when it is
//! dropped. Who waits is served first come, first served, but for this: a request that fits now may pass larger ones that
//! do not, as long as each of them is passed by no more bytes in all than it asks for itself. So a large request waits at
//! most about twice as long as in a strict queue, and small ones need not wait while bytes lie idle for it. It knows
//! nothing of what the bytes are for, nor of HTTP.

mod drain;

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use drain::Drain;
use tokio::sync::oneshot;

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
    /// Others held the bytes for too long, or too many waited already.
    #[error("{needed} bytes did not become free within {} seconds", waited.as_secs_f32())]
    Busy {
        /// Bytes asked for.
        needed: u64,
        /// How long it waited; not at all if the queue was full.
        waited: Duration,
        /// When the bytes are likely to be free, by how fast others have given theirs back.
        retry_after: Duration,
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
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    total: u64,
    /// Requests that may wait.
    places: usize,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    free: u64,
    queue: VecDeque<Waiter>,
    /// Tells waiters apart.
    next: u64,
    drain: Drain,
}

#[derive(Debug)]
struct Waiter {
    id: u64,
    bytes: u64,
    /// Bytes by which others may still pass it.
    patience: u64,
    /// Whether it takes one of the places.
    counts: bool,
    granted: oneshot::Sender<Permit>,
}

impl State {
    /// Takes out of the queue all whose turn it is, and their bytes out of what is free.
    fn admit(&mut self) -> Vec<Waiter> {
        let mut admitted = Vec::new();
        let (mut index, mut patience) = (0, u64::MAX);
        while let Some(waiter) = self.queue.get(index) {
            let bytes = waiter.bytes;
            if bytes <= self.free && bytes <= patience {
                self.queue.iter_mut().take(index).for_each(|ahead| ahead.patience -= bytes);
                patience -= if index > 0 { bytes } else { 0 };
                self.free -= bytes;
                admitted.extend(self.queue.remove(index));
            } else {
                patience = patience.min(waiter.patience);
                index += 1;
            }
        }
        admitted
    }

    /// How long until so many more bytes are likely to be free, behind everyone who waits.
    fn wait(&self, bytes: u64, total: u64) -> Option<Duration> {
        let waiting: u64 = self.queue.iter().map(|waiter| waiter.bytes).fold(bytes, u64::saturating_add);
        self.drain.time_for(waiting.saturating_sub(self.free), total)
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A place in the queue, given up when it is dropped.
struct Place {
    budget: Budget,
    id: u64,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.budget.change(|state| state.queue.retain(|waiter| waiter.id != self.id));
    }
}

impl Budget {
    /// A budget of so many bytes, for which so many may wait at once, [`reserve_own`](Self::reserve_own) aside.
    pub fn new(bytes: u64, places: usize) -> Self {
        let state = State { free: bytes, queue: VecDeque::new(), next: 0, drain: Drain::default() };
        Self { shared: Arc::new(Shared { total: bytes, places, state: Mutex::new(state) }) }
    }

    /// Bytes in all.
    pub fn total(&self) -> u64 {
        self.shared.total
    }

    /// Bytes that nobody holds.
    pub fn free(&self) -> u64 {
        self.shared.lock().free
    }

    /// How many wait.
    pub fn waiting(&self) -> usize {
        self.shared.lock().queue.len()
    }

    /// A permit of nothing, to [grow](Permit::grow_to).
    pub fn none(&self) -> Permit {
        Permit { budget: self.clone(), bytes: 0 }
    }

    /// Says whether so many bytes can ever be reserved.
    pub fn check(&self, bytes: u64) -> Result<(), AdmissionError> {
        let total = self.total();
        if bytes > total { Err(AdmissionError::TooLarge { needed: bytes, total }) } else { Ok(()) }
    }

    /// Changes the state, and hands out what that has made free.
    fn change<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.shared.lock();
        let (now, total) = (Instant::now(), self.shared.total);
        let free = state.free;
        state.drain.pass(now, total - free);
        let changed = change(&mut state);
        let given_back = state.free.saturating_sub(free);
        state.drain.give_back(given_back);
        let admitted = state.admit();
        drop(state);
        for waiter in admitted {
            // Who has gone meanwhile drops the permit, which takes the lock again.
            drop(waiter.granted.send(Permit { budget: self.clone(), bytes: waiter.bytes }));
        }
        changed
    }

    /// Reserves bytes when its turn comes; waits until `deadline` has passed. Giving up, or dropping the future, loses
    /// the place in the queue and holds nothing.
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
        self.wait(true, bytes, own, deadline).await
    }

    /// As [`reserve`](Self::reserve), for work that is nobody's request: it takes no place of one in the queue, is never
    /// refused for want of one, and waits for its turn however long that is.
    pub async fn reserve_own(&self, bytes: u64) -> Result<Permit, AdmissionError> {
        self.wait(false, bytes, std::future::pending(), Duration::MAX).await
    }

    async fn wait(
        &self,
        counts: bool,
        bytes: u64,
        own: impl Future<Output = ()>,
        deadline: Duration,
    ) -> Result<Permit, AdmissionError> {
        self.check(bytes)?;
        let busy = |waited, wait: Option<Duration>| {
            // Nothing was given back yet: who waited in vain for so long may as well wait that long again.
            Err(AdmissionError::Busy { needed: bytes, waited, retry_after: wait.unwrap_or(deadline) })
        };
        let (granted, grant) = oneshot::channel();
        let queued = self.change(|state| {
            let waiting = || state.queue.iter().filter(|waiter| waiter.counts).count();
            if counts && state.free < bytes && waiting() >= self.shared.places {
                return Err(state.wait(bytes, self.shared.total));
            }
            state.next += 1;
            let id = state.next;
            state.queue.push_back(Waiter { id, bytes, patience: bytes, counts, granted });
            Ok(id)
        });
        let _place = match queued {
            Ok(id) => Place { budget: self.clone(), id },
            Err(wait) => return busy(Duration::ZERO, wait),
        };
        let late = async {
            own.await;
            tokio::time::sleep(deadline).await;
        };
        tokio::select! {
            biased;
            // The sender is in the queue as long as the place is kept.
            Ok(permit) = grant => Ok(permit),
            () = late => busy(deadline, self.shared.lock().wait(0, self.shared.total)),
        }
    }
}

/// Reserved bytes; dropping it gives them back.
#[derive(Debug)]
pub struct Permit {
    budget: Budget,
    bytes: u64,
}

impl Permit {
    /// Bytes that it holds.
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Gives back all but `bytes`; it never grows.
    pub fn shrink_to(&mut self, bytes: u64) {
        let surplus = self.bytes.saturating_sub(bytes);
        if surplus > 0 {
            self.bytes -= surplus;
            self.budget.change(|state| state.free += surplus);
        }
    }

    /// Takes as many more bytes as it needs to hold `bytes`, ahead of everyone who waits, and without waiting.
    pub fn grow_to(&mut self, bytes: u64) -> Result<(), AdmissionError> {
        self.budget.check(bytes)?;
        let more = bytes.saturating_sub(self.bytes);
        let total = self.budget.total();
        self.budget.change(|state| {
            if more > state.free {
                let retry_after = state.wait(more, total).unwrap_or_default();
                return Err(AdmissionError::Busy { needed: bytes, waited: Duration::ZERO, retry_after });
            }
            state.free -= more;
            Ok(())
        })?;
        self.bytes += more;
        Ok(())
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.shrink_to(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::task::{JoinHandle, yield_now};

    const SOON: Duration = Duration::from_millis(20);
    const LATER: Duration = Duration::from_secs(600);

    fn run<T>(work: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap().block_on(work)
    }

    /// A request that waits in the queue, if it must.
    async fn ask(budget: &Budget, bytes: u64) -> JoinHandle<Permit> {
        let budget = budget.clone();
        let asked = tokio::spawn(async move { budget.reserve(bytes, LATER).await.unwrap() });
        yield_now().await;
        asked
    }

    #[test]
    fn limits_are_exact() {
        run(async {
            let budget = Budget::new(10, 5);
            let all = budget.reserve(10, SOON).await.unwrap();
            assert_eq!((all.bytes(), budget.free()), (10, 0));
            let one = budget.reserve(1, SOON).await.unwrap_err();
            assert_eq!(one, AdmissionError::Busy { needed: 1, waited: SOON, retry_after: SOON });
            drop(all);
            assert_eq!(budget.free(), 10);
            // At once, not after the deadline.
            let more = tokio::time::timeout(SOON, budget.reserve(11, LATER)).await.unwrap().unwrap_err();
            assert_eq!(more, AdmissionError::TooLarge { needed: 11, total: 10 });
            assert!(budget.reserve(u64::MAX, LATER).await.is_err());
            assert_eq!(budget.reserve(0, SOON).await.unwrap().bytes(), 0);
            let vast = Budget::new(u64::MAX, 1);
            assert_eq!(vast.reserve(u64::MAX, SOON).await.unwrap().bytes(), u64::MAX);
        });
    }

    #[test]
    fn permits_shrink_and_grow_if_there_is_room() {
        run(async {
            let budget = Budget::new(10, 5);
            let mut permit = budget.reserve(8, SOON).await.unwrap();
            permit.shrink_to(9);
            assert_eq!(permit.bytes(), 8);
            permit.shrink_to(3);
            assert_eq!((permit.bytes(), budget.free()), (3, 7));
            let large = ask(&budget, 8).await;
            assert!(permit.grow_to(5).is_ok() && permit.grow_to(4).is_ok());
            assert_eq!(permit.grow_to(11).unwrap_err().code(), "over_memory");
            let other = budget.reserve(1, SOON).await.unwrap();
            assert_eq!(permit.grow_to(10).unwrap_err().code(), "busy");
            drop(other);
            assert_eq!((permit.bytes(), budget.free()), (5, 5));
            permit.shrink_to(0);
            assert_eq!(large.await.unwrap().bytes(), 8);
            assert_eq!(budget.free(), 10);
        });
    }

    #[test]
    fn small_requests_pass_a_large_one_only_so_often() {
        run(async {
            let budget = Budget::new(12, 9);
            let held = budget.reserve(8, SOON).await.unwrap();
            let large = ask(&budget, 9).await;
            // Each fits, and is done at once; but the large one lets no more than 9 bytes pass.
            for _ in 0..3 {
                assert_eq!(budget.reserve(3, SOON).await.unwrap().bytes(), 3);
            }
            let small = ask(&budget, 3).await;
            assert!(!small.is_finished() && budget.free() == 4 && budget.waiting() == 2);
            drop(held);
            let large = large.await.unwrap();
            // With the large one out of the way the next fits again.
            assert_eq!((small.await.unwrap().bytes(), large.bytes(), budget.free()), (3, 9, 0));
        });
    }

    #[test]
    fn equals_are_served_in_their_order() {
        run(async {
            let budget = Budget::new(10, 9);
            let held = budget.reserve(10, SOON).await.unwrap();
            let asked = [ask(&budget, 6).await, ask(&budget, 6).await, ask(&budget, 6).await];
            drop(held);
            for asked in asked {
                assert_eq!(asked.await.unwrap().bytes(), 6);
            }
            assert_eq!((budget.free(), budget.waiting()), (10, 0));
        });
    }

    #[test]
    fn the_deadline_starts_after_ones_own_work() {
        run(async {
            let budget = Budget::new(10, 5);
            let held = budget.reserve(6, SOON).await.unwrap();
            let own = async {
                tokio::time::sleep(4 * SOON).await;
            };
            let work = async {
                tokio::time::sleep(3 * SOON).await;
                drop(held);
            };
            let (reserved, ()) = tokio::join!(budget.reserve_after(8, own, SOON), work);
            let all = reserved.unwrap();
            let own = tokio::time::sleep(SOON);
            assert_eq!(budget.reserve_after(8, own, SOON).await.unwrap_err().code(), "busy");
            drop(all);
        });
    }

    #[test]
    fn one_who_gives_up_leaves_the_queue() {
        run(async {
            let budget = Budget::new(10, 5);
            let held = budget.reserve(6, SOON).await.unwrap();
            assert!(budget.reserve(8, SOON).await.is_err());
            let gone = ask(&budget, 10).await;
            let next = ask(&budget, 5).await;
            assert_eq!(budget.waiting(), 2);
            gone.abort();
            let small = budget.reserve(4, SOON).await.unwrap();
            drop((held, small));
            assert_eq!(next.await.unwrap().bytes(), 5);
            assert_eq!(budget.free(), 10);
        });
    }

    #[test]
    fn a_full_queue_refuses_at_once() {
        run(async {
            let budget = Budget::new(10, 1);
            let held = budget.reserve(10, SOON).await.unwrap();
            let waiting = ask(&budget, 1).await;
            let refused = tokio::time::timeout(SOON, budget.reserve(1, LATER)).await.unwrap().unwrap_err();
            assert!(matches!(refused, AdmissionError::Busy { waited: Duration::ZERO, .. }), "{refused:?}");
            drop(held);
            assert_eq!(waiting.await.unwrap().bytes(), 1);
        });
    }

    #[test]
    fn who_is_refused_is_told_when_by_how_fast_others_were_and_how_many_wait() {
        run(async {
            let budget = Budget::new(10, 0);
            let held = budget.reserve(10, LATER).await.unwrap();
            let refused = async |bytes| match budget.reserve(bytes, LATER).await.unwrap_err() {
                AdmissionError::Busy { retry_after, .. } => retry_after,
                other => panic!("{other}"),
            };
            assert_eq!(refused(10).await, LATER);
            std::thread::sleep(SOON);
            drop(held);
            let held = budget.reserve(10, LATER).await.unwrap();
            // Not by the deadline, now that something was given back; half of it takes half the time.
            let (half, all) = (refused(5).await, refused(10).await);
            assert!(SOON / 2 <= half && 2 * half <= all + SOON && all < LATER, "{half:?} {all:?}");
            let own = budget.clone();
            let ahead = tokio::spawn(async move { own.reserve_own(10).await });
            yield_now().await;
            let behind = refused(10).await;
            assert!(behind >= 2 * all - SOON / 100, "{all:?} {behind:?}");
            drop(held);
            assert!(ahead.await.unwrap().is_ok());
        });
    }

    #[test]
    fn own_work_waits_its_turn_and_takes_no_place() {
        run(async {
            let budget = Budget::new(10, 1);
            let held = budget.reserve(10, SOON).await.unwrap();
            let own = |bytes| {
                let budget = budget.clone();
                tokio::spawn(async move { budget.reserve_own(bytes).await })
            };
            let first = [own(6), own(6), own(6)];
            yield_now().await;
            // There is a place for a request, and one only; own work is let in all the same.
            let request = ask(&budget, 6).await;
            assert_eq!(budget.reserve(6, LATER).await.unwrap_err().code(), "busy");
            let last = own(6);
            yield_now().await;
            assert_eq!(budget.waiting(), 5);
            drop(held);
            // In the order of coming.
            for own in first {
                assert_eq!((own.await.unwrap().unwrap().bytes(), last.is_finished()), (6, false));
            }
            assert_eq!((request.await.unwrap().bytes(), last.is_finished()), (6, false));
            assert_eq!(last.await.unwrap().unwrap().bytes(), 6);
            assert_eq!((budget.free(), budget.waiting()), (10, 0));
            assert_eq!(budget.reserve_own(11).await.unwrap_err().code(), "over_memory");
        });
    }
}
