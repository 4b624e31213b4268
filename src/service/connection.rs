//! One connection: HTTP/1.1, or HTTP/2 if the client begins with its preface, both within the same deadlines.

use std::{convert::Infallible, io, pin::pin, sync::Arc, time::Duration};

use axum::{Extension, Router, http::StatusCode, response::IntoResponse};
use hyper::{
    Request,
    body::Incoming,
    server::conn::{http1, http2},
    service::{Service, service_fn},
};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWrite},
    net::TcpStream,
    sync::watch,
    time::timeout,
};

use super::pace::{OpenBodies, Pace, Taken, Watched};

/// What an HTTP/2 client sends first.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Bytes that a connection over HTTP/1.1, or a stream over HTTP/2, reads ahead; the head of a request is no longer.
pub(super) const BUFFER: u32 = 64 << 10;
/// Most fields of the head of a request; over HTTP/1.1 hyper sees to it.
const FIELDS: usize = 100;
/// Most bytes of the answers of one HTTP/2 stream that wait to be sent: with [`BUFFER`] within a request's charge.
const SEND_BUFFER: usize = 128 << 10;

/// The standard's least window of a connection.
const MIN_WINDOW: u32 = 65_535;

/// How a connection is served.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// How long the head of a request may take, and a connection be idle.
    pub(super) header_deadline: Duration,
    /// Requests at once, over HTTP/2.
    pub(super) streams: u32,
    /// How slow a client may be.
    pub(super) pace: Pace,
}

/// A request that is under way on an HTTP/2 connection, as long as one of these lives.
#[derive(Clone, Debug)]
pub(super) struct Stream(#[expect(dead_code, reason = "it lives")] Arc<Active>);

#[derive(Debug)]
struct Active(watch::Sender<usize>);

impl Stream {
    fn new(active: &watch::Sender<usize>) -> Self {
        active.send_modify(|streams| *streams += 1);
        Self(Arc::new(Active(active.clone())))
    }
}

impl Drop for Active {
    fn drop(&mut self) {
        self.0.send_modify(|streams| *streams -= 1);
    }
}

/// Serves one connection until it ends; after the signal to stop only the requests that have begun.
pub(super) async fn serve(stream: TcpStream, router: Router, stopping: watch::Receiver<bool>, limits: Limits) {
    // Small answers should not wait for more.
    let _ = stream.set_nodelay(true);
    let bodies = OpenBodies::default();
    let (mut read, write) = tokio::io::split(Watched::new(stream, limits.pace, bodies.clone()));
    let mut seen = Vec::new();
    let begun = tokio::select! {
        begun = timeout(limits.header_deadline, first_bytes(&mut read, &mut seen)) => begun,
        () = stopped(stopping.clone()) => Ok(Ok(())),
    };
    // One that brought nothing in time, or was closed, has asked for nothing.
    if seen.is_empty() || !matches!(begun, Ok(Ok(()))) {
        return;
    }
    let two = seen == PREFACE;
    let io = tokio::io::join(io::Cursor::new(seen).chain(read), write);
    let result = if two {
        serve_2(io, router, stopping, limits).await
    } else {
        serve_1(io, router.layer(Extension(bodies)), stopping, limits).await
    };
    if let Err(error) = result {
        tracing::debug!(%error, "connection failed");
    }
}

/// Reads until it is clear which HTTP it is.
async fn first_bytes(read: &mut (impl AsyncRead + Unpin), seen: &mut Vec<u8>) -> io::Result<()> {
    while seen.len() < PREFACE.len() && PREFACE.starts_with(seen) {
        let mut buffer = [0; PREFACE.len()];
        let room = PREFACE.len() - seen.len();
        match read.read(&mut buffer[..room]).await? {
            0 => break,
            len => seen.extend_from_slice(&buffer[..len]),
        }
    }
    Ok(())
}

async fn stopped(mut stopping: watch::Receiver<bool>) {
    // If there is nobody left who could stop it, it has stopped.
    let _ = stopping.wait_for(|&stop| stop).await;
}

async fn serve_1(
    io: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    stopping: watch::Receiver<bool>,
    limits: Limits,
) -> hyper::Result<()> {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.header_deadline)
        .max_buf_size(BUFFER as usize)
        .serve_connection(TokioIo::new(io), TowerToHyperService::new(router));
    let mut connection = pin!(connection);
    tokio::select! {
        result = connection.as_mut() => return result,
        () = stopped(stopping) => connection.as_mut().graceful_shutdown(),
    }
    connection.await
}

async fn serve_2(
    io: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    stopping: watch::Receiver<bool>,
    limits: Limits,
) -> hyper::Result<()> {
    let (active, streams) = watch::channel(0);
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |mut request: Request<Incoming>| {
        // Before anything is kept of it.
        let many = request.headers().len() > FIELDS;
        let bodies = OpenBodies::default();
        request.extensions_mut().insert(Stream::new(&active));
        request.extensions_mut().insert(bodies.clone());
        let answered = if many { Err(StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE) } else { Ok(router.call(request)) };
        // What is written to the connection does not tell who takes his answer and who does not.
        async move {
            let answer = match answered {
                Ok(answer) => answer.await?,
                Err(status) => status.into_response(),
            };
            Ok::<_, Infallible>(answer.map(|body| Taken::new(body, limits.pace, bodies)))
        }
    });
    let connection = http2::Builder::new(TokioExecutor::new())
        .timer(TokioTimer::new())
        .max_concurrent_streams(limits.streams)
        .initial_stream_window_size(BUFFER)
        // Enough for all, so that none who waits for memory keeps another from sending.
        .initial_connection_window_size(limits.streams.saturating_mul(BUFFER).max(MIN_WINDOW))
        .max_send_buf_size(SEND_BUFFER)
        .max_header_list_size(BUFFER)
        // A client that has vanished answers no ping.
        .keep_alive_interval(limits.header_deadline)
        .keep_alive_timeout(limits.header_deadline)
        .serve_connection(TokioIo::new(io), service);
    let mut connection = pin!(connection);
    tokio::select! {
        result = connection.as_mut() => return result,
        () = stopped(stopping) => {}
        // The head of a request that never ends is idleness too.
        () = idle(streams.clone(), limits.header_deadline) => {}
    }
    connection.as_mut().graceful_shutdown();
    tokio::select! {
        result = connection => result,
        // What has begun ends, and then the client has to close.
        () = idle(streams, limits.header_deadline) => Ok(()),
    }
}

/// Waits until nothing has been under way for so long.
async fn idle(mut streams: watch::Receiver<usize>, deadline: Duration) {
    loop {
        let none = streams.wait_for(|&streams| streams == 0).await.is_ok();
        if !none || timeout(deadline, streams.wait_for(|&streams| streams > 0)).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_preface_is_known_however_it_comes() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let seen = |parts: &[&[u8]]| {
            let mut mock =
                parts.iter().fold(Box::new(tokio::io::empty()) as Box<dyn AsyncRead + Unpin>, |all, part| {
                    Box::new(all.chain(io::Cursor::new(part.to_vec())))
                });
            let mut seen = Vec::new();
            runtime.block_on(first_bytes(&mut mock, &mut seen)).unwrap();
            seen
        };
        assert_eq!(seen(&[&PREFACE[..1], &PREFACE[1..20], &PREFACE[20..], b"more"]), PREFACE);
        assert!(b"PUT / HTTP/1.1".starts_with(&seen(&[b"P", b"UT / HTTP/1.1"])));
        assert_eq!(seen(&[b"PRI"]), b"PRI");
        assert!(seen(&[]).is_empty());
    }
}
