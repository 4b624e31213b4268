//! Filters what can be filtered of images whose tiles come as bare cores, while they come and after they have come.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use tokio::{sync::Notify, task::JoinSet, time::sleep};

use super::{Shared, problem::Refusal, registry::Opened, work::blocking};
use crate::{config::MAX_DEADLINE, wire::Problem};

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
    pub(super) trouble: Mutex<Option<Box<Problem>>>,
}

impl Runner {
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
    let mut pause = PAUSES[0];
    loop {
        match drain(&service, &opened).await {
            Ok(()) => opened.entry.runner.trouble(None),
            Err(refusal) if refusal.0.code == "stopped" => break,
            Err(refusal) => {
                let id = &opened.entry.id.0;
                tracing::warn!(id, problem = refusal.0.detail, seconds = pause.as_secs(), "regions wait");
                opened.entry.runner.trouble(Some(refusal.0));
                sleep(pause).await;
                pause = (pause * 2).min(PAUSES[1]);
                // An image that has failed is opened anew.
                let (images, id) = (Arc::clone(&service), opened.entry.id.clone());
                match blocking(move || images.images.again(&id)).await.flatten() {
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
        let more = opened.image.read().regions().is_some_and(|regions| regions.ready() > 0);
        if !more || runner.running.swap(true, Ordering::SeqCst) {
            return;
        }
    }
    opened.entry.runner.running.store(false, Ordering::SeqCst);
}

/// Filters regions, a few at a time, until none is ready and none is being filtered, or one fails.
async fn drain(service: &Shared, opened: &Opened) -> Result<(), Refusal> {
    let mut jobs: JoinSet<Result<(), Refusal>> = JoinSet::new();
    let mut failed = None;
    loop {
        let next = match &failed {
            Some(_) => None,
            None if jobs.len() > service.work.jobs() => None,
            None => {
                let (image, shared) = (Arc::clone(&opened.image), Arc::clone(service));
                let next = blocking(move || {
                    if image.stopping().load(Ordering::Relaxed) {
                        return Err(crate::image::ImageError::Stopped(crate::filter::Stopped));
                    }
                    image.next_job(shared.config.threads, shared.budget.total())
                });
                match next.await.and_then(|next| next.map_err(Refusal::from)) {
                    Ok(next) => next,
                    Err(refusal) => {
                        failed = Some(refusal);
                        continue;
                    }
                }
            }
        };
        match next {
            Some(job) => {
                let (service, image) = (Arc::clone(service), Arc::clone(&opened.image));
                jobs.spawn(async move {
                    // Others finish some time: there is nobody to be told that it takes long.
                    let permit = match service.reserve(job.bytes, std::future::ready(()), MAX_DEADLINE).await {
                        Ok(permit) => permit,
                        Err(error) => {
                            image.give_back(&job);
                            return Err(error.into());
                        }
                    };
                    let done = service.work.run(move |pool, _| {
                        let done = image.run(&job, pool);
                        drop(permit);
                        Ok(done?)
                    });
                    done.await
                });
            }
            None if jobs.is_empty() => return failed.map_or(Ok(()), Err),
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
