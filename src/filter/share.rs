//! Work shared out among the threads that were given.

use super::Execution;
use std::sync::Mutex;

/// Works through the items, each thread with its own scratch, each taking the next item when it is done with one.
pub(crate) fn share_out<S: Send, T: Send>(
    execution: &Execution,
    scratches: &mut [S],
    items: impl Iterator<Item = T> + Send,
    work: impl Fn(&mut S, T) + Sync,
) {
    match execution.pool {
        Some(pool) => {
            let items = Mutex::new(items);
            let next = || items.lock().ok().and_then(|mut items| items.next());
            pool.scope(|scope| {
                for scratch in scratches {
                    scope.spawn(|_| {
                        while let Some(item) = next() {
                            work(scratch, item);
                        }
                    });
                }
            });
        }
        None => {
            if let Some(scratch) = scratches.first_mut() {
                items.for_each(|item| work(scratch, item));
            }
        }
    }
}
