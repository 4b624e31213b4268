//! A progress bar where somebody is looking, and a flag that Ctrl-C sets.

use indicatif::{ProgressBar, ProgressStyle};
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};
use tokio::signal::unix::{SignalKind, signal};

/// A bar on standard error that counts to `total`; it draws nothing unless that is a terminal.
pub(crate) fn bar(what: &'static str, total: u64) -> ProgressBar {
    let template = "{prefix} {wide_bar} {percent:>3} %  {elapsed} (still {eta})";
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style).with_prefix(what)
}

/// A sign of life on standard error for what has no known end.
pub(crate) fn spinner(what: impl Into<String>) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(what.into());
    spinner.enable_steady_tick(std::time::Duration::from_millis(200));
    spinner
}

/// A flag that the first Ctrl-C (or SIGTERM) sets, so that temporary files are removed on the way out; the second one
/// ends the program at once.
pub(crate) fn interrupted() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let set = flag.clone();
    // Where signals cannot be caught they end the program as ever.
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else { return flag };
    let caught = {
        // From here on, not from whenever the thread gets to run.
        let _context = runtime.enter();
        (signal(SignalKind::interrupt()), signal(SignalKind::terminate()))
    };
    let (Ok(mut interrupt), Ok(mut terminate)) = caught else { return flag };
    std::thread::spawn(move || {
        runtime.block_on(async {
            tokio::select! { _ = interrupt.recv() => {} _ = terminate.recv() => {} }
            set.store(true, Ordering::Relaxed);
            tokio::select! { _ = interrupt.recv() => {} _ = terminate.recv() => {} }
            std::process::exit(130);
        });
    });
    flag
}
