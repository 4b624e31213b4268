//! Work that takes the CPU: a fixed pool of threads, and a bounded number of jobs that share it.

use std::{
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use axum::http::StatusCode;
use rayon::ThreadPool;
use tokio::{sync::Semaphore, task::spawn_blocking, time::timeout};

use super::problem::{Refusal, internal};

/// Runs jobs, first come, first served. A few run at once, so that the pool is busy while one of them starts or ends.
#[derive(Debug)]
pub(super) struct Work {
    pool: Arc<ThreadPool>,
    slots: Arc<Semaphore>,
    pictures: Arc<Semaphore>,
    jobs: usize,
    deadline: Duration,
}

impl Work {
    /// Jobs on so many threads, each of which may take so long.
    pub(super) fn new(threads: usize, deadline: Duration) -> Result<Self, rayon::ThreadPoolBuildError> {
        let named = |i| format!("filter-{i}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(named).build()?;
        let jobs = threads + 1;
        let (slots, pictures) = (Arc::new(Semaphore::new(jobs)), Arc::new(Semaphore::new(threads)));
        Ok(Self { pool: Arc::new(pool), slots, pictures, jobs, deadline })
    }

    /// Jobs that run at once.
    pub(super) const fn jobs(&self) -> usize {
        self.jobs
    }

    /// Makes a picture of an image when its turn comes: as many at once as there are threads, since they take long, and
    /// what else may wait for the disk goes on beside them. When the future is dropped the job's flag is set.
    pub(super) async fn picture<T: Send + 'static>(
        &self,
        job: impl FnOnce(&AtomicBool) -> Result<T, Refusal> + Send + 'static,
    ) -> Result<T, Refusal> {
        let turn = Arc::clone(&self.pictures).acquire_owned().await.map_err(internal)?;
        let stop = Stop::default();
        let flag = stop.flag();
        let made = blocking(move || {
            let _turn = turn;
            job(&flag)
        });
        made.await.flatten()
    }

    /// Runs a job when its turn comes. If it panics that is an error of this job only. When the future is dropped, or
    /// the job's time is up, the flag is set that the job has to look at, and then it fails as [`stopped`].
    pub(super) async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&ThreadPool, &AtomicBool) -> Result<T, Refusal> + Send + 'static,
    ) -> Result<T, Refusal> {
        let slot = Arc::clone(&self.slots).acquire_owned().await.map_err(internal)?;
        let pool = Arc::clone(&self.pool);
        let stop = Stop::default();
        let flag = stop.flag();
        let mut running = pin!(blocking(move || {
            let _slot = slot;
            job(&pool, &flag)
        }));
        if let Ok(done) = timeout(self.deadline, running.as_mut()).await {
            return done.flatten();
        }
        drop(stop);
        // It may have been done just then.
        running.await.flatten().map_err(|refusal| if refusal.0.code == "stopped" { self.too_long() } else { refusal })
    }

    fn too_long(&self) -> Refusal {
        let seconds = self.deadline.as_secs_f64();
        let detail = format!("it took more than {seconds} seconds: send smaller tiles, or choose cheaper parameters");
        Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, "work_timeout", "The tile takes too long to filter", detail)
    }
}

/// What a job says that was told to stop.
pub(super) fn stopped() -> Refusal {
    Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "stopped", "The work was stopped", "the client has gone")
}

/// Runs what may block, like reading files, off the threads that serve connections; catches its panics.
pub(super) async fn blocking<T: Send + 'static>(job: impl FnOnce() -> T + Send + 'static) -> Result<T, Refusal> {
    let span = tracing::Span::current();
    spawn_blocking(move || span.in_scope(job)).await.map_err(|error| internal(error).into())
}

/// Tells a job to stop when it is dropped: the client has gone, or the job's time is up.
#[derive(Debug, Default)]
pub(super) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// What a job looks at.
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

    const LATER: Duration = Duration::from_secs(600);

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap()
    }

    /// Works until it is told to stop.
    fn endless<T>(stop: &AtomicBool) -> Result<T, Refusal> {
        while !stop.load(Ordering::Relaxed) {
            std::thread::yield_now();
        }
        Err(stopped())
    }

    #[test]
    fn a_panic_is_an_error_of_its_job_only() {
        let work = Work::new(2, LATER).unwrap();
        runtime().block_on(async {
            for _ in 0..5 {
                let panicked: Result<(), Refusal> = work.run(|pool, _| pool.install(|| panic!("on purpose"))).await;
                let problem = panicked.unwrap_err().0;
                assert_eq!((problem.status, problem.code.as_str()), (500, "internal"));
                assert!(!problem.detail.contains("purpose"));
            }
            assert_eq!(work.run(|pool, _| pool.install(|| Ok(7))).await.unwrap(), 7);
        });
    }

    #[test]
    fn a_job_that_nobody_waits_for_stops_and_gives_its_place_free() {
        let work = Work::new(1, LATER).unwrap();
        runtime().block_on(async {
            for _ in 0..5 {
                assert!(timeout(Duration::from_millis(1), work.run(|_, stop| endless::<()>(stop))).await.is_err());
            }
            assert_eq!(work.run(|_, _| Ok(7)).await.unwrap(), 7);
        });
    }

    #[test]
    fn a_job_that_takes_too_long_is_stopped() {
        let work = Work::new(1, Duration::from_millis(5)).unwrap();
        runtime().block_on(async {
            assert_eq!(work.run(|_, stop| endless::<()>(stop)).await.unwrap_err().0.code, "work_timeout");
            // One that is done in spite of it is done.
            assert_eq!(work.run(|_, stop| endless(stop).or(Ok(7))).await.unwrap(), 7);
        });
    }

    #[test]
    fn pictures_take_turns_of_their_own() {
        let work = Work::new(1, LATER).unwrap();
        runtime().block_on(async {
            let (begin, begun) = tokio::sync::oneshot::channel();
            let mut first = Box::pin(work.picture(|stop| {
                begin.send(()).unwrap();
                endless::<()>(stop)
            }));
            tokio::select! {
                _ = &mut first => panic!("it ends when it is told to"),
                begun = begun => begun.unwrap(),
            }
            // There is one thread, and so one at a time; tiles do not wait for it.
            let mut second = Box::pin(work.picture(|_| Ok(7)));
            assert!(timeout(Duration::from_millis(100), &mut second).await.is_err());
            assert_eq!(work.run(|_, _| Ok(5)).await.unwrap(), 5);
            drop(first);
            assert_eq!(second.await.unwrap(), 7);
            let panicked: Result<(), Refusal> = work.picture(|_| panic!("on purpose")).await;
            assert_eq!(panicked.unwrap_err().0.code, "internal");
            assert_eq!(work.picture(|_| Ok(9)).await.unwrap(), 9);
        });
    }
}
