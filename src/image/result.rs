//! The image as a file, which is kept so that it need not be written again.

use std::fs::File;

use super::{Image, RESULT};
use crate::stitch::ExrOptions;

impl Image {
    /// The result that was written down with these options, if it is that of the image as it is.
    pub fn result(&self, options: &ExrOptions) -> Option<File> {
        let inner = self.read();
        let known = inner.result.as_deref() == Some(&key(options));
        known.then(|| File::open(self.folder().join(RESULT)).ok()).flatten()
    }

    /// Removes the result that was written down, if there is one.
    pub fn forget_result(&self) {
        self.write().forget_result(&*self.folder);
    }

    /// Keeps a file as the result with these options, until the image changes or another one is kept. It was written in
    /// the image's folder when there had been so many [replacements](super::Inner::replacements): if there were more, it
    /// is none.
    pub fn keep_result(&self, file: tempfile::NamedTempFile, options: &ExrOptions, replacements: u64) -> bool {
        let mut inner = self.write();
        let current = inner.replacements == replacements;
        if current {
            inner.result = None;
            // Without it, the result is written anew each time.
            inner.result = file.persist(self.folder().join(RESULT)).is_ok().then(|| key(options));
        }
        current
    }
}

fn key(options: &ExrOptions) -> String {
    format!("{options:?}")
}
