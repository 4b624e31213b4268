//! Results on their way to a client that may not read them yet: they go to a file, and from it as the client reads.
//!
//! So a client may send all it has before it reads anything, and memory stays bounded.

use std::{
    fs::File,
    io::{self, BufWriter, Write},
    os::unix::fs::FileExt,
    path::Path,
    sync::{Arc, Mutex, PoisonError},
};

use axum::{
    body::Body,
    http::header,
    response::{IntoResponse, Response},
};
use bytes::Bytes;
use futures_util::{Stream, stream};
use tokio::sync::watch;
use tokio_util::io::ReaderStream;

use super::work::blocking;

/// Bytes read or written at a time.
const BUFFER: usize = 128 << 10;

/// How far the file has been written.
#[derive(Clone, Copy, Debug, Default)]
struct Progress {
    bytes: u64,
    ended: bool,
}

/// The writing end. Whole messages are appended; what fails half-way is never seen by the reader.
#[derive(Debug)]
pub(super) struct Results {
    file: Arc<File>,
    end: Mutex<u64>,
    progress: watch::Sender<Progress>,
}

/// Writes at a place of its own in the file.
struct At<'a> {
    file: &'a File,
    offset: u64,
}

impl Write for At<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write_at(bytes, self.offset)?;
        self.offset += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Results {
    /// A file without a name in this folder, and what reads from it as it grows. The stream ends after
    /// [`finish`](Self::finish); if the results are dropped before that it ends in an error, which cuts the connection.
    pub(super) fn new(folder: &Path) -> io::Result<(Self, impl Stream<Item = io::Result<Bytes>> + Send + use<>)> {
        let file = Arc::new(tempfile::tempfile_in(folder)?);
        let (progress, seen) = watch::channel(Progress::default());
        let reader = stream::try_unfold((Arc::clone(&file), seen, 0u64), async |(file, mut seen, at)| {
            let ready = seen.wait_for(|progress| progress.bytes > at || progress.ended).await;
            let Progress { bytes, .. } =
                *ready.map_err(|_| io::Error::new(io::ErrorKind::BrokenPipe, "the results were given up"))?;
            if bytes == at {
                return Ok(None);
            }
            let mut buffer = vec![0; ((bytes - at) as usize).min(BUFFER)];
            let source = Arc::clone(&file);
            let read = blocking(move || source.read_exact_at(&mut buffer, at).map(|()| buffer)).await;
            let buffer = read.map_err(|_| io::Error::other("reading panicked"))??;
            let after = at + buffer.len() as u64;
            Ok::<_, io::Error>(Some((Bytes::from(buffer), (file, seen, after))))
        });
        Ok((Self { file, end: Mutex::new(0), progress }, reader))
    }

    /// Appends what `write` writes; after an error, nothing of it. Blocks.
    pub(super) fn append(&self, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        let mut end = self.end.lock().unwrap_or_else(PoisonError::into_inner);
        let mut out = BufWriter::with_capacity(BUFFER, At { file: &self.file, offset: *end });
        let written = write(&mut out).and_then(|()| out.flush());
        let (at, _) = out.into_parts();
        written?;
        *end = at.offset;
        self.progress.send_replace(Progress { bytes: *end, ended: false });
        Ok(())
    }

    /// Ends the stream.
    pub(super) fn finish(self: Arc<Self>) {
        self.progress.send_modify(|progress| progress.ended = true);
    }
}

/// A response of this content type whose body is all of a file.
pub(super) async fn file_response(file: File, media: &'static str) -> io::Result<Response> {
    use tokio::io::AsyncSeekExt;
    let mut file = tokio::fs::File::from_std(file);
    file.rewind().await?;
    let length = file.metadata().await?.len();
    let body = Body::from_stream(ReaderStream::with_capacity(file, BUFFER));
    let headers = [(header::CONTENT_TYPE, media.to_owned()), (header::CONTENT_LENGTH, length.to_string())];
    Ok((headers, body).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::TryStreamExt;

    #[test]
    fn what_is_appended_is_read_and_halves_are_not() {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).build().unwrap();
        let (results, reader) = Results::new(&std::env::temp_dir()).unwrap();
        let results = Arc::new(results);
        let reader = runtime.spawn(reader.try_concat_bytes());
        results.append(|out| out.write_all(&[1; 300_000])).unwrap();
        let failed = results.append(|out| {
            out.write_all(&[9; 300_000])?;
            Err(io::Error::other("on purpose"))
        });
        assert!(failed.is_err());
        results.append(|out| out.write_all(&[2; 3])).unwrap();
        results.finish();
        let read = runtime.block_on(reader).unwrap().unwrap();
        assert_eq!(read, [&[1; 300_000][..], &[2; 3]].concat());
    }

    #[test]
    fn results_given_up_are_an_error() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let (results, reader) = Results::new(&std::env::temp_dir()).unwrap();
        results.append(|out| out.write_all(b"abc")).unwrap();
        drop(results);
        assert!(runtime.block_on(reader.try_concat_bytes()).is_err());
    }

    trait Concat {
        async fn try_concat_bytes(self) -> io::Result<Vec<u8>>;
    }

    impl<S: Stream<Item = io::Result<Bytes>>> Concat for S {
        async fn try_concat_bytes(self) -> io::Result<Vec<u8>> {
            self.try_fold(Vec::new(), async |mut all, part| {
                all.extend_from_slice(&part);
                Ok(all)
            })
            .await
        }
    }
}
