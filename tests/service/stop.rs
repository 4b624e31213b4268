//! Stopping: what has begun ends, nothing new begins, and the end comes within its time.

use super::{Answer, Server, wait_until, whole};
use std::{
    io::{Read, Write},
    net::TcpStream,
};

#[test]
fn what_has_begun_ends_while_nothing_new_begins() {
    let server = Server::start(&["--metrics-listen", "127.0.0.1:0"]);
    let body = whole(16);
    let mut busy = server.send("/v1/filter", &[], &body[..body.len() / 2], body.len());
    wait_until("the request is under way", || server.metric("rpfd_requests_in_flight") == Some(1.0));
    let mut idle = server.connect();
    idle.write_all(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n").unwrap();
    idle.read_exact(&mut [0; 12]).unwrap();
    assert_eq!((server.beside("/readyz").status, server.beside("/livez").status), (200, 200));
    server.signal("-TERM");
    wait_until("it is draining", || server.metric("rpfd_ready") == Some(0.0));
    server.beside("/readyz").problem(503, "draining");
    assert_eq!(server.beside("/livez").status, 200);
    wait_until("nobody is let in", || TcpStream::connect(&server.address).is_err());
    // A connection without a request ends.
    idle.read_to_end(&mut Vec::new()).unwrap();
    busy.write_all(&body[body.len() / 2..]).unwrap();
    assert_eq!(Answer::read(&mut busy).messages().len(), 2);
    assert_eq!(server.ended().code(), Some(0));
}

#[test]
fn the_end_comes_whoever_dawdles() {
    let server = Server::start(&["--shutdown-deadline", "300ms"]);
    let body = whole(16);
    let _slow = server.begin("/v1/filter", &[], &body[..body.len() / 2], body.len());
    let mut silent = server.connect();
    silent.write_all(b"G").unwrap();
    assert_eq!(server.terminate().code(), Some(0));
}
