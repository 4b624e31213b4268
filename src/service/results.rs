//! Results on their way to a client that may not read them yet: they go to a file, and from it as the client reads.
//!
//! So a client may send all it has before it reads anything, and memory stays bounded.

use std::{
    collections::VecDeque,
    fs::File,
    io::{self, BufWriter, Write},
    os::unix::fs::FileExt,
    path::Path,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use axum::{
    body::Body,
    http::header,
    response::{IntoResponse, Response},
};
use bytes::Bytes;
use futures_util::{Stream, stream};
use rustix::{fs::FallocateFlags, io::Errno};
use tokio::sync::watch;
use tokio_util::io::ReaderStream;

use super::{charge::keep, work::blocking};
use crate::{admission::Permit, filter::Rect};

/// Bytes read or written at a time.
const BUFFER: usize = 64 << 10;

/// Bytes that are taken from the disk at the start, so that a full disk can be told of.
const ROOM: u64 = 64 << 10;
/// Bytes that are read before their place on the disk is given back.
const HOLE: u64 = 1 << 20;
/// More than a result has beside its pixels, and than is said of a tile without them.
pub(super) const AROUND: u64 = 64 << 10;

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
    unread: Arc<Mutex<Unread>>,
}

/// What waits to be read.
#[derive(Debug, Default)]
struct Unread {
    /// Where each message ends, its length, and what was reserved for it.
    messages: VecDeque<(u64, u64, Option<Permit>)>,
    /// Bytes for which nothing was.
    unpaid: u64,
}

impl Unread {
    fn add(&mut self, end: u64, length: u64, mut paid: Option<Permit>) {
        match &mut paid {
            Some(permit) => permit.shrink_to(length),
            None => self.unpaid += length,
        }
        self.messages.push_back((end, length, paid));
    }

    /// All up to here was read.
    fn read(&mut self, at: u64) {
        while let Some((_, length, paid)) = self.messages.pop_front_if(|(end, ..)| *end <= at) {
            self.unpaid -= if paid.is_none() { length } else { 0 };
        }
    }
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
    /// Bytes that the result of this core has at most.
    pub(super) fn bytes(core: Rect) -> u64 {
        12 * core.area() + AROUND
    }

    /// A file without a name in this folder, and what reads from it as it grows. The stream ends after
    /// [`finish`](Self::finish); if the results are dropped before that it ends in an error, which cuts the connection.
    pub(super) fn new(folder: &Path) -> io::Result<(Self, impl Stream<Item = io::Result<Bytes>> + Send + use<>)> {
        let file = Arc::new(tempfile::tempfile_in(folder)?);
        match rustix::fs::fallocate(&*file, FallocateFlags::KEEP_SIZE, 0, ROOM) {
            // Not every file system can.
            Ok(()) | Err(Errno::OPNOTSUPP | Errno::NOSYS) => {}
            Err(error) => return Err(error.into()),
        }
        let (progress, seen) = watch::channel(Progress::default());
        let unread = Arc::new(Mutex::new(Unread::default()));
        let state = (Arc::clone(&file), Arc::clone(&unread), seen, 0u64);
        let reader = stream::try_unfold(state, async |(file, unread, mut seen, at)| {
            // What was handed over before has been taken.
            unread.lock().unwrap_or_else(PoisonError::into_inner).read(at);
            let ready = seen.wait_for(|progress| progress.bytes > at || progress.ended).await;
            let Progress { bytes, .. } =
                *ready.map_err(|_| io::Error::new(io::ErrorKind::BrokenPipe, "the results were given up"))?;
            if bytes == at {
                return Ok(None);
            }
            let mut buffer = vec![0; ((bytes - at) as usize).min(BUFFER)];
            let after = at + buffer.len() as u64;
            let source = Arc::clone(&file);
            let read = blocking(move || {
                source.read_exact_at(&mut buffer, at)?;
                forget(&source, at, after);
                Ok::<_, io::Error>(buffer)
            });
            let buffer = read.await.map_err(|_| io::Error::other("reading panicked"))??;
            Ok::<_, io::Error>(Some((Bytes::from(buffer), (file, unread, seen, after))))
        });
        Ok((Self { file, end: Mutex::new(0), progress, unread }, reader))
    }

    /// Appends what `write` writes; after an error, nothing of it. What was reserved for it is kept until it is read.
    /// Blocks.
    pub(super) fn append(
        &self,
        paid: Option<Permit>,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> io::Result<()> {
        let mut end = self.end.lock().unwrap_or_else(PoisonError::into_inner);
        let mut out = BufWriter::with_capacity(BUFFER, At { file: &self.file, offset: *end });
        let written = write(&mut out).and_then(|()| out.flush());
        let (at, _) = out.into_parts();
        written?;
        self.unread().add(at.offset, at.offset - *end, paid);
        *end = at.offset;
        self.progress.send_replace(Progress { bytes: *end, ended: false });
        Ok(())
    }

    /// Unread bytes for which nothing was reserved.
    pub(super) fn unpaid(&self) -> u64 {
        self.unread().unpaid
    }

    fn unread(&self) -> MutexGuard<'_, Unread> {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the stream.
    pub(super) fn finish(self: Arc<Self>) {
        self.progress.send_modify(|progress| progress.ended = true);
    }
}

/// Gives the place on the disk back of what was read, whole megabytes at a time. Where the file system cannot do that the
/// file grows until the request is done.
fn forget(file: &File, from: u64, to: u64) {
    let (from, to) = (from / HOLE * HOLE, to / HOLE * HOLE);
    if to > from {
        let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        let _ = rustix::fs::fallocate(file, hole, from, to - from);
    }
}

/// A response of this content type whose body is all of a file. Something is kept until it is sent, or nobody wants it.
pub(super) async fn file_response(
    (file, kept): (File, impl Send + Unpin + 'static),
    media: &'static str,
) -> io::Result<Response> {
    use tokio::io::AsyncSeekExt;
    let mut file = tokio::fs::File::from_std(file);
    file.rewind().await?;
    let length = file.metadata().await?.len();
    let body = Body::from_stream(ReaderStream::with_capacity(file, BUFFER));
    let headers = [(header::CONTENT_TYPE, media.to_owned()), (header::CONTENT_LENGTH, length.to_string())];
    Ok((headers, keep(body, kept)).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Budget;
    use futures_util::{StreamExt, TryStreamExt};
    use std::time::Duration;
    use tokio::time::timeout;

    #[test]
    fn what_is_appended_is_read_and_halves_are_not() {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).build().unwrap();
        let (results, reader) = Results::new(&std::env::temp_dir()).unwrap();
        let results = Arc::new(results);
        let reader = runtime.spawn(reader.try_concat_bytes());
        results.append(None, |out| out.write_all(&[1; 300_000])).unwrap();
        let failed = results.append(None, |out| {
            out.write_all(&[9; 300_000])?;
            Err(io::Error::other("on purpose"))
        });
        assert!(failed.is_err());
        results.append(None, |out| out.write_all(&[2; 3])).unwrap();
        results.finish();
        let read = runtime.block_on(reader).unwrap().unwrap();
        assert_eq!(read, [&[1; 300_000][..], &[2; 3]].concat());
    }

    #[test]
    fn results_given_up_are_an_error() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let (results, reader) = Results::new(&std::env::temp_dir()).unwrap();
        results.append(None, |out| out.write_all(b"abc")).unwrap();
        drop(results);
        assert!(runtime.block_on(reader.try_concat_bytes()).is_err());
    }

    #[test]
    fn what_was_read_gives_back_its_room_and_its_place() {
        use std::os::unix::fs::MetadataExt;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let (results, reader) = Results::new(&std::env::temp_dir()).unwrap();
        let (budget, mut reader) = (Budget::new(20 << 20, 1), std::pin::pin!(reader));
        let message = vec![7; 2 << 20];
        runtime.block_on(async {
            let mut most = 0;
            for _ in 0..40 {
                // More than is needed: the surplus goes back when it is written.
                let permit = budget.reserve(9 << 20, Duration::from_secs(5)).await.unwrap();
                results.append(Some(permit), |out| out.write_all(&message)).unwrap();
                results.append(None, |out| out.write_all(b"unpaid")).unwrap();
                assert_eq!(budget.free(), 18 << 20);
                let mut left = message.len() + 6;
                while left > 0 {
                    left -= reader.try_next().await.unwrap().unwrap().len();
                }
                assert_eq!(results.unpaid(), 6);
                // To ask for more is to have taken what came before.
                assert!(timeout(Duration::from_millis(1), reader.next()).await.is_err());
                assert_eq!((budget.free(), results.unpaid()), (20 << 20, 0));
                most = most.max(results.file.metadata().unwrap().blocks() * 512);
            }
            // 80 MiB went through a file that never took more than a few, where the file system knows of holes.
            let holes =
                rustix::fs::fallocate(&*results.file, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, 0, 1);
            assert!(most < 8 << 20 || holes.is_err(), "{most} bytes on disk");
        });
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
