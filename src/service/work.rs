//! Work that takes the CPU: a fixed pool of threads, and a bounded number of jobs that share it.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use rayon::ThreadPool;
use tokio::{sync::Semaphore, task::spawn_blocking};

use super::problem::{Refusal, internal};

/// Runs jobs, first come, first served. A few run at once, so that the pool is busy while one of them starts or ends.
#[derive(Debug)]
pub(super) struct Work {
    pool: Arc<ThreadPool>,
    slots: Arc<Semaphore>,
    jobs: usize,
}

impl Work {
    pub(super) fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        let named = |i| format!("filter-{i}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(named).build()?;
        let jobs = threads + 1;
        Ok(Self { pool: Arc::new(pool), slots: Arc::new(Semaphore::new(jobs)), jobs })
    }

    /// Jobs that run at once.
    pub(super) const fn jobs(&self) -> usize {
        self.jobs
    }

    /// Runs a job when its turn comes. If it panics that is an error of this job only. If the future is dropped a job
    /// that runs goes on: it has to look at its [`Stop`].
    pub(super) async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&ThreadPool) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let slot = Arc::clone(&self.slots).acquire_owned().await.map_err(internal)?;
        let pool = Arc::clone(&self.pool);
        blocking(move || {
            let _slot = slot;
            job(&pool)
        })
        .await
    }
}

/// Runs what may block, like reading files, off the threads that serve connections; catches its panics.
pub(super) async fn blocking<T: Send + 'static>(job: impl FnOnce() -> T + Send + 'static) -> Result<T, Refusal> {
    let span = tracing::Span::current();
    spawn_blocking(move || span.in_scope(job)).await.map_err(|error| internal(error).into())
}

/// Tells the jobs of a request to stop when it is dropped: the client has gone, or has all it wanted.
#[derive(Debug, Default)]
pub(super) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// What the jobs look at.
    pub(super) fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.0)
    }
}

impl Drop for Stop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error_of_its_job_only() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let work = Work::new(2).unwrap();
        runtime.block_on(async {
            for _ in 0..5 {
                let panicked: Result<(), Refusal> = work.run(|pool| pool.install(|| panic!("on purpose"))).await;
                let problem = panicked.unwrap_err().0;
                assert_eq!((problem.status, problem.code.as_str()), (500, "internal"));
                assert!(!problem.detail.contains("purpose"));
            }
            assert_eq!(work.run(|pool| pool.install(|| 7)).await.unwrap(), 7);
        });
    }

    #[test]
    fn dropping_stops() {
        let stop = Stop::default();
        let flag = stop.flag();
        assert!(!flag.load(Ordering::Relaxed));
        drop(stop);
        assert!(flag.load(Ordering::Relaxed));
    }
}
