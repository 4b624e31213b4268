//! Requests to a service in this process: paths, queries, headers, JSON and tiles changed at random, over real sockets.

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::{SocketAddr, TcpStream},
    path::Path,
    thread::JoinHandle,
    time::Duration,
};

use super::{alone, decoder, fuzz, mutate::Random, mutate::mutate};
use rpfd::{
    config::{ByteSize, Config},
    service::Service,
};
use tokio::sync::oneshot;

/// A service in this process; once it is dropped nothing of it is at work any more.
struct Local {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Local {
    fn start() -> Self {
        // Without the images of the run before.
        let data_dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz-http");
        let _ = std::fs::remove_dir_all(&data_dir);
        let config = Config {
            listen: "127.0.0.1:0".parse().unwrap(),
            data_dir,
            memory: ByteSize(64 << 20),
            threads: 1,
            idle_deadline: Duration::from_millis(500),
            header_deadline: Duration::from_millis(500),
            work_deadline: Duration::from_millis(500),
            images: 16,
            image_pixels: 1 << 20,
            ..Config::default()
        };
        let service = Service::bind(config).unwrap();
        let address = service.local_addr();
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
            runtime.block_on(service.run(async { drop(stopped.await) })).unwrap();
        });
        Self { address, stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Local {
    fn drop(&mut self) {
        drop(self.stop.take());
        let ended = self.thread.take().map(JoinHandle::join);
        assert!(std::thread::panicking() || ended.is_some_and(|ended| ended.is_ok()));
    }
}

/// Lines that are a request: method and target, headers, and what the body is.
const REQUESTS: [&str; 14] = [
    "POST /v1/filter?preset=unfiltered\n\ntile",
    "POST /v1/filter?preset=gaussian&sigma=1.5&seed=7\nAccept: application/msgpack;q=0.5, */*;q=0\ntile",
    "PUT /v1/filter?preset=lean&boxes=5,3&leave_out=off\nAccept: image/png, image/x-exr;q=0.9\ntile",
    "POST /v1/filter?preset=bilateral\nContent-Encoding: zstd\nzstd",
    "POST /v1/filter?preset=cross-bilateral\nContent-Encoding: gzip\ngzip",
    "POST /v1/images\n\n{\"id\": \"a\", \"width\": 8, \"height\": 8, \"preset\": \"gaussian\", \"seed\": 3}",
    "POST /v1/images\n\n{\"width\": 16, \"height\": 16, \"boxes\": [9, 5], \"spikes\": false, \"bins\": \"9\"}",
    "POST /v1/images/a/tiles?replace=true\n\ntile",
    "GET /v1/images\n\n",
    "GET /v1/images/a\n\n",
    "GET /v1/images/a/result.exr?partial=true&samples=half&compression=piz&tile=32\n\n",
    "GET /v1/images/a/preview.png?partial\nAccept: */*\n",
    "DELETE /v1/images/a\n\n",
    "GET /readyz\n\n",
];

const WORDS: &[&[u8]] = &[
    b"?",
    b"&",
    b"=",
    b"%00",
    b"%ff",
    b"%2F",
    b"..",
    b"partial",
    b"true",
    b"seed",
    b"preset",
    b"\"",
    b"{",
    b"}",
    b"[",
    b"]",
    b",",
    b":",
    b"null",
    b"1e999",
    b"-1",
    b"18446744073709551616",
    b"\\ud800",
    b"q=0",
    b"*/*",
    b"zstd",
    b"gzip",
    b"/v1",
    b"/images",
    b"/tiles",
    b"\n",
];

fn make(random: &mut Random) -> Vec<u8> {
    let others: Vec<Vec<u8>> = REQUESTS.iter().map(|request| request.as_bytes().to_vec()).collect();
    let mut request = random.pick(&others).clone();
    if !random.one_in(6) {
        mutate(&mut request, random, &others, WORDS);
    }
    request
}

/// The body that a request's last line stands for.
fn body(line: &[u8], random: &mut Random) -> Vec<u8> {
    let mut tile = decoder::tile(random);
    if random.one_in(3) {
        mutate(&mut tile, random, &[Vec::new()], decoder::WORDS);
    }
    let mut body = match line {
        b"tile" => tile,
        b"zstd" => zstd::encode_all(&tile[..], 1).unwrap(),
        b"gzip" => {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(&tile).unwrap();
            encoder.finish().unwrap()
        }
        other => other.to_vec(),
    };
    if line.len() == 4 && random.one_in(4) {
        mutate(&mut body, random, &[Vec::new()], decoder::WORDS);
    }
    body
}

/// Sends a request and reads the head and the body of the answer; none if what was sent is no HTTP.
fn ask(service: SocketAddr, request: &[u8], random: &mut Random) -> Option<(u16, String, Vec<u8>)> {
    // Whatever else they are, lines stay lines.
    let clean =
        |line: &[u8]| line.iter().copied().filter(|b| (b' '..0x7f).contains(b) || *b >= 0x80).collect::<Vec<_>>();
    let mut lines = request.splitn(3, |&b| b == b'\n');
    let target = clean(lines.next().unwrap_or_default());
    let header = clean(lines.next().unwrap_or_default());
    let body = body(lines.next().unwrap_or_default(), random);
    let mut bytes = [&target[..], b" HTTP/1.1\r\nHost: fuzz\r\nConnection: close\r\n"].concat();
    if !header.is_empty() {
        bytes.extend([&header[..], b"\r\n"].concat());
    }
    bytes.extend(format!("Content-Length: {}\r\n\r\n", body.len()).into_bytes());
    bytes.extend(body);
    let mut stream = TcpStream::connect(service).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(600))).unwrap();
    let _ = stream.write_all(&bytes);
    let mut reader = BufReader::new(stream);
    let mut head = String::new();
    while reader.read_line(&mut head).ok()? > 2 {}
    let status = head.split(' ').nth(1)?.parse().ok()?;
    let mut body = Vec::new();
    // An answer that is cut off would be an error of the service.
    let _ = reader.read_to_end(&mut body);
    Some((status, head.to_ascii_lowercase(), body))
}

#[test]
fn requests() {
    let alone = alone();
    let service = Local::start();
    let reached = fuzz(&alone, "http", 20, make, |request, random| {
        let Some((status, head, body)) = ask(service.address, request, random) else {
            // The service is there all the same; a client that stalls it may have taken for one that says nothing.
            let answer = (0..20).find_map(|_| ask(service.address, b"GET /livez\n\n", random));
            assert_eq!(answer.unwrap().0, 200);
            return "no answer";
        };
        if status < 400 {
            // A stream ends with its end.
            assert!(!head.contains("transfer-encoding: chunked") || body.ends_with(b"0\r\n\r\n"), "{head}");
            return "done";
        }
        if !head.contains("application/problem+json") {
            // What is no HTTP, hyper refuses.
            assert!([400, 414, 431].contains(&status), "{head}");
            return "no HTTP";
        }
        let text = String::from_utf8_lossy(&body);
        let problem: serde_json::Value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
        assert_eq!(problem["status"], status);
        assert!(status < 500 || problem["code"] == "too_many_images", "{text}");
        "a problem"
    });
    assert!(reached["done"] > 0 && reached["a problem"] > 0, "{reached:?}");
}
