//! Filters what can be filtered of images whose tiles come as bare cores, while they come and after they have come.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use tokio::{sync::Notify, task::JoinSet, time::sleep};
use tokio_util::sync::CancellationToken;

use super::{
    Shared,
    entry::Opened,
    metrics::Phase,
    problem::Refusal,
    work::{blocking, stopped},
};
use crate::{
    filter::Execution,
    image::{ImageError, Job},
    wire::Problem,
};

/// Pauses after failures: the first, and the longest; each is twice the one before.
const PAUSES: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(60)];

/// What sees to an image's regions.
#[derive(Debug)]
pub(super) struct Runner {
    /// Whether it runs.
    pub(super) running: AtomicBool,
    /// There may be something to filter.
    pub(super) wake: Notify,
    /// Why it cannot go on at the moment.
    trouble: Mutex<Option<Box<Problem>>>,
    /// Stops the work on the image: it is forgotten, or the service ends.
    pub(super) stop: CancellationToken,
    /// Pixels that a part of a region may have: fewer after one that took too long.
    pixels: AtomicU64,
}

impl Default for Runner {
    fn default() -> Self {
        Self {
            running: AtomicBool::new(false),
            wake: Notify::new(),
            trouble: Mutex::default(),
            stop: CancellationToken::new(),
            pixels: AtomicU64::new(u64::MAX),
        }
    }
}

impl Runner {
    /// The next region is filtered in smaller parts than this one, of which none was done in time, as far as there are
    /// any.
    fn too_long(&self, job: &Job) {
        self.pixels.fetch_min(job.pixels / 2, Ordering::Relaxed);
    }

    /// What keeps it from going on, if anything.
    pub(super) fn told(&self) -> Option<Box<Problem>> {
        self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn trouble(&self, problem: Option<Box<Problem>>) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = problem;
    }
}

/// Sees to it that what can be filtered is. To be called in a runtime.
pub(super) fn kick(service: &Shared, opened: &Opened) {
    if !opened.keeps_samples() {
        return;
    }
    let runner = &opened.entry.runner;
    runner.wake.notify_one();
    if !runner.running.swap(true, Ordering::SeqCst) {
        tokio::spawn(run(Arc::clone(service), opened.clone()));
    }
}

/// Filters until nothing is left that can be.
async fn run(service: Shared, mut opened: Opened) {
    let (mut pause, mut woken) = (PAUSES[0], false);
    loop {
        match drain(&service, &opened).await {
            Ok(()) => opened.entry.runner.trouble(None),
            Err(refusal) if refusal.0.code == "stopped" => break,
            Err(refusal) => {
                let (id, late) = (&opened.entry.id.0, refusal.0.code == "work_timeout");
                // What took too long is different the next time.
                pause = if late { PAUSES[0] } else { pause };
                if !woken {
                    tracing::warn!(id, problem = refusal.0.detail, seconds = pause.as_secs(), "regions wait");
                }
                // What is too large keeps nothing else waiting.
                let aside = refusal.0.code == "over_memory";
                let runner = &opened.entry.runner;
                runner.trouble(Some(refusal.0));
                tokio::select! {
                    () = runner.stop.cancelled() => break,
                    () = runner.wake.notified(), if aside => woken = true,
                    () = sleep(pause) => {
                        pause = (pause * 2).min(PAUSES[1]);
                        woken = false;
                    }
                }
                // An image that has failed is opened anew.
                let (images, id) = (Arc::clone(&service), opened.entry.id.clone());
                let again = blocking(move || {
                    let again = images.images.again(&id)?;
                    again.iter().for_each(|again| again.image.retry());
                    Ok(again)
                });
                match again.await.flatten() {
                    Ok(Some(again)) if Arc::ptr_eq(&again.entry, &opened.entry) => opened = again,
                    Ok(_) => break,
                    // It stays as it is, and fails again.
                    Err(_) => {}
                }
                continue;
            }
        }
        let runner = &opened.entry.runner;
        runner.running.store(false, Ordering::SeqCst);
        // What came after the last look and before this was not seen by anybody.
        let image = Arc::clone(&opened.image);
        let more = blocking(move || image.read().regions().is_some_and(|regions| regions.ready() > 0));
        if !more.await.unwrap_or(false) || runner.running.swap(true, Ordering::SeqCst) {
            return;
        }
    }
    opened.entry.runner.running.store(false, Ordering::SeqCst);
}

/// Filters regions, a few at a time, until none is ready and none is being filtered, or one fails. One that is too large
/// is told of at the end.
async fn drain(service: &Shared, opened: &Opened) -> Result<(), Refusal> {
    let mut jobs: JoinSet<Result<(), Refusal>> = JoinSet::new();
    let (mut failed, mut aside) = (None, None);
    loop {
        let next = match &failed {
            Some(_) => None,
            None if jobs.len() > service.work.jobs() => None,
            None => {
                let (opened, shared) = (opened.clone(), Arc::clone(service));
                let next = blocking(move || next_job(&shared, &opened));
                match next.await.and_then(|next| next.map_err(Refusal::from)) {
                    Ok(next) => next,
                    Err(refusal) if refusal.0.code == "over_memory" => {
                        service.metrics.region(&refusal.0.code);
                        aside.get_or_insert(refusal);
                        continue;
                    }
                    Err(refusal) => {
                        failed = Some(refusal);
                        continue;
                    }
                }
            }
        };
        match next {
            Some(job) => {
                jobs.spawn(filter(Arc::clone(service), opened.clone(), job));
            }
            None if jobs.is_empty() => return failed.or(aside).map_or(Ok(()), Err),
            None => {
                tokio::select! {
                    Some(done) = jobs.join_next() => {
                        if let Err(refusal) = done.map_err(super::problem::internal).map_err(Refusal::from).flatten() {
                            failed.get_or_insert(refusal);
                        }
                    }
                    () = opened.entry.runner.wake.notified(), if failed.is_none() && jobs.len() <= service.work.jobs() => {}
                }
            }
        }
    }
}

/// The next region that can be filtered. Blocks.
fn next_job(service: &Shared, opened: &Opened) -> Result<Option<Job>, ImageError> {
    let runner = &opened.entry.runner;
    if runner.stop.is_cancelled() {
        return Err(crate::filter::Stopped.into());
    }
    opened.image.next_job(service.config.threads, service.budget.total(), runner.pixels.load(Ordering::Relaxed))
}

/// Filters a region when its turn comes.
async fn filter(service: Shared, opened: Opened, job: Job) -> Result<(), Refusal> {
    let (image, runner, metrics) = (Arc::clone(&opened.image), &opened.entry.runner, &service.metrics);
    let (waiting, asked) = (metrics.wait(), Instant::now());
    let permit = tokio::select! {
        permit = service.budget.reserve_own(job.bytes) => permit.map_err(Refusal::from),
        () = runner.stop.cancelled() => Err(stopped()),
    };
    drop(waiting);
    let permit = match permit {
        Ok(permit) => permit,
        Err(refusal) => {
            blocking(move || image.give_back(&job)).await?;
            return Err(refusal);
        }
    };
    service.spare.make_room();
    metrics.phase(Phase::Queue, asked);
    let (shared, here, ready) = (Arc::clone(&service), opened.clone(), Instant::now());
    let work = service.work.run(move |pool, stop| {
        let _permit = permit;
        shared.metrics.phase(Phase::Turn, ready);
        shared.images.make_room(&here).inspect_err(|_| image.give_back(&job))?;
        let simd = shared.config.simd;
        let execution = Execution { pool: Some(pool), stop: Some(stop), simd, ..Execution::default() };
        let done = image.run(&job, &execution);
        if let (Err(ImageError::Stopped(_)), false) = (&done, job.has_progress()) {
            // If it was not for the time, this image is not filtered any more.
            here.entry.runner.too_long(&job);
        }
        Ok(done?)
    });
    let done = tokio::select! {
        done = work => done,
        () = runner.stop.cancelled() => Err(stopped()),
    };
    metrics.region(done.as_ref().map_or_else(|refusal| &*refusal.0.code, |_| "filtered"));
    let spent = done.map_err(|mut refusal| {
        if refusal.0.code == "work_timeout" {
            let seconds = service.config.work_deadline.as_secs_f64();
            refusal.0.detail =
                format!("filtering a region took more than {seconds} seconds: it is tried again in smaller parts");
        }
        refusal
    })?;
    for (phase, taken) in [(Phase::Receive, spent.read), (Phase::Filter, spent.filter), (Phase::Write, spent.write)] {
        metrics.took(phase, taken);
    }
    Ok(())
}
