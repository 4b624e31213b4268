//! HTTP/2 with prior knowledge, on the same port and within the same bounds.

use super::{Answer, Server, has, tile, wait_until, whole};
use rpfd::filter::Rect;
use std::{
    io::{Read, Write},
    net::TcpStream,
    process::Command,
    time::Duration,
};

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// An empty SETTINGS frame.
const SETTINGS: &[u8] = &[0, 0, 0, 4, 0, 0, 0, 0, 0];

fn curl(arguments: &[&str]) -> (u16, Vec<u8>) {
    let output = Command::new("curl")
        .args(["-sS", "--http2-prior-knowledge", "-w", "%{stderr}%{http_version} %{http_code}"])
        .args(arguments)
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{arguments:?}: {said}");
    (said.strip_prefix("2 ").unwrap_or_else(|| panic!("no HTTP/2: {said}")).trim().parse().unwrap(), output.stdout)
}

#[test]
fn it_gives_what_http_1_gives() {
    if !has("curl", "--version") {
        return;
    }
    let server = Server::start(&["--threads", "1"]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiles");
    let both = [tile([32, 16], Rect::new(0, 0, 16, 16), 0), tile([32, 16], Rect::new(16, 0, 16, 16), 0)].concat();
    std::fs::write(&path, &both).unwrap();
    let (file, url) = (path.to_str().unwrap(), |path: &str| format!("http://{}{path}", server.address));
    let (status, streamed) = curl(&["-T", file, &url("/v1/filter")]);
    let answer =
        Answer { status, headers: vec![("content-type".into(), "application/msgpack".into())], body: streamed };
    assert_eq!(answer.messages().len(), 3);
    std::fs::write(&path, whole(16)).unwrap();
    let (status, two) = curl(&["-H", "Accept: image/png", "-T", file, &url("/v1/filter")]);
    let one = server.call("POST", "/v1/filter", &["Accept: image/png"], &whole(16));
    assert!(status == 200 && two == one.body);
    let open = r#"{"width": 32, "height": 16, "id": "x"}"#;
    assert_eq!(curl(&["-d", open, &url("/v1/images")]).0, 201);
    std::fs::write(&path, zstd::encode_all(&both[..], 3).unwrap()).unwrap();
    let (status, lines) = curl(&["-H", "Content-Encoding: zstd", "-T", file, &url("/v1/images/x/tiles")]);
    assert_eq!((status, String::from_utf8(lines).unwrap().matches("filtered").count()), (200, 2));
    let (status, exr) = curl(&[&url("/v1/images/x/result.exr")]);
    assert!(status == 200 && exr == server.get("/v1/images/x/result.exr").body);
    let (status, problem) = curl(&[&url("/v1/images/y")]);
    assert!(status == 404 && String::from_utf8(problem).unwrap().contains("unknown_image"));
    assert_eq!(curl(&["-X", "DELETE", &url("/v1/images/x")]).0, 204);
    assert_eq!(curl(&["-I", &url("/livez")]).0, 200);
}

/// Sends this, and waits until the service closes the connection.
fn closed_after(server: &Server, parts: &[&[u8]]) {
    let mut stream = server.connect();
    for part in parts {
        // It may be closed before all of it is sent.
        let _ = stream.write_all(part);
        std::thread::sleep(Duration::from_millis(50));
    }
    if let Err(error) = stream.read_to_end(&mut Vec::new()) {
        // Closed with something unread.
        assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "it was not closed");
    }
}

#[test]
fn silence_is_ended_as_in_http_1() {
    let server = Server::start(&["--header-deadline", "500ms", "--metrics-listen", "127.0.0.1:0"]);
    // HEADERS of stream 1 that announce more, which never comes.
    let half = [&[0, 0, 1, 1, 0, 0, 0, 0, 1][..], &[0x82]].concat();
    for parts in [
        &[&b""[..]][..],
        &[b"GET /livez HTTP/1.1\r\n"],
        &[b"PRI * HT"],
        &[PREFACE],
        &[&PREFACE[..5], &PREFACE[5..], SETTINGS],
        &[PREFACE, SETTINGS, &half],
    ] {
        // That it takes its time is not measured, as the machine may be slow.
        closed_after(&server, parts);
    }
    wait_until("none is left", || server.metric("rpfd_connections") == Some(1.0));
}

#[test]
fn what_is_not_http_is_refused() {
    let server = Server::start(&[]);
    for parts in [
        &[&b"PRI * HTTP/2.0\r\n\r\nXX\r\n\r\n"[..]][..],
        &[b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"],
        &[PREFACE, &[0xff; 64]],
    ] {
        closed_after(&server, parts);
    }
    assert_eq!(server.get("/livez").status, 200);
}

#[test]
fn requests_at_once_are_bounded() {
    let server = Server::start(&["--streams", "7"]);
    let mut stream = server.connect();
    stream.write_all(&[PREFACE, SETTINGS].concat()).unwrap();
    let mut head = [0; 9];
    stream.read_exact(&mut head).unwrap();
    assert_eq!(head[3], 4, "the first frame is SETTINGS: {head:?}");
    let mut settings = vec![0; usize::from(head[2])];
    stream.read_exact(&mut settings).unwrap();
    let streams = settings.chunks(6).find(|setting| setting[..2] == [0, 3]).expect("MAX_CONCURRENT_STREAMS");
    assert_eq!(streams[2..], [0, 0, 0, 7]);
}

/// A frame of a stream.
fn frame(kind: u8, flags: u8, stream: u8, payload: &[u8]) -> Vec<u8> {
    let [high, low] = u16::try_from(payload.len()).unwrap().to_be_bytes();
    [&[0, high, low, kind, flags, 0, 0, 0, stream][..], payload].concat()
}

/// HEADERS of a whole request without a body.
fn get(stream: u8, path: &str) -> Vec<u8> {
    let field = |index: u8, value: &str| [&[index, u8::try_from(value.len()).unwrap()], value.as_bytes()].concat();
    frame(1, 5, stream, &[&[0x82, 0x86][..], &field(0x04, path), &field(0x01, "test")].concat())
}

/// The next frame of this stream: its kind and payload.
fn next_frame(connection: &mut TcpStream, stream: u8) -> (u8, Vec<u8>) {
    loop {
        let mut head = [0; 9];
        connection.read_exact(&mut head).unwrap();
        let mut payload = vec![0; usize::from(head[1]) << 8 | usize::from(head[2])];
        connection.read_exact(&mut payload).unwrap();
        if head[5..] == [0, 0, 0, stream] {
            return (head[3], payload);
        }
    }
}

#[test]
fn heads_have_a_limit() {
    let server = Server::start(&[]);
    let mut stream = server.connect();
    // GET /livez with a field of so many bytes, in frames of a size that need not be asked for.
    let request = |id: u8, length: usize| {
        let long = [&[0x00, 1, b'x', 0x7f][..], &varint(length - 127), &vec![b'x'; length]].concat();
        let head = [&[0x82, 0x86, 0x04, 6][..], b"/livez", &[0x01, 4], b"test", &long].concat();
        let parts = head.chunks(16_384).enumerate();
        let last = head.len().div_ceil(16_384) - 1;
        let frames = parts.map(|(i, part)| {
            // END_STREAM of the first, END_HEADERS of the last; HEADERS, and then CONTINUATION.
            let (flags, kind) = (u8::from(i == 0) | if i == last { 4 } else { 0 }, if i == 0 { 1 } else { 9 });
            let length = part.len() as u32;
            [&length.to_be_bytes()[1..], &[kind, flags, 0, 0, 0, id], part].concat()
        });
        frames.collect::<Vec<_>>().concat()
    };
    stream.write_all(&[PREFACE, SETTINGS, &request(1, 60_000)].concat()).unwrap();
    let (kind, head) = next_frame(&mut stream, 1);
    assert_eq!((kind, head[0]), (1, 0x88), "HEADERS with :status 200");
    assert_eq!(next_frame(&mut stream, 1), (0, b"alive\n".to_vec()));
    stream.write_all(&request(3, 66_000)).unwrap();
    let (kind, head) = next_frame(&mut stream, 3);
    // :status, its value in Huffman's code.
    assert_eq!((kind, &head[..5]), (1, &[0x48, 0x83, 0x69, 0x90, 0xff][..]), "HEADERS with :status 431");
}

/// A number of HPACK, behind its prefix.
fn varint(mut number: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    while number > 127 {
        bytes.push(number as u8 | 128);
        number >>= 7;
    }
    bytes.push(number as u8);
    bytes
}

#[test]
fn an_answer_that_is_not_taken_is_let_go_of() {
    let server =
        Server::start(&["--idle-deadline", "200ms", "--header-deadline", "10m", "--metrics-listen", "127.0.0.1:0"]);
    assert_eq!(server.post("/v1/images", br#"{"width": 200, "height": 200, "id": "x"}"#).status, 201);
    let path = "/v1/images/x/result.exr?partial=true&compression=none";
    let mut stream = server.connect();
    // No bytes of any stream are wanted before more is said.
    let no_window = frame(4, 0, 0, &[0, 4, 0, 0, 0, 0]);
    stream.write_all(&[PREFACE, &no_window, &get(1, path)].concat()).unwrap();
    let answered = "rpfd_requests_total{route=\"/v1/images/{id}/result.exr\",method=\"GET\",status=\"200\"}";
    wait_until("it is answered", || server.metric(answered) == Some(1.0));
    wait_until("it is given up", || server.metric("rpfd_requests_in_flight") == Some(0.0));
    wait_until("its memory is free", || server.metric("rpfd_memory_used_bytes") == Some(0.0));
    let more = |id: u8| frame(8, 0, id, &[0, 16, 0, 0]);
    stream.write_all(&[more(0), more(1)].concat()).unwrap();
    assert_eq!(next_frame(&mut stream, 1).0, 1, "HEADERS");
    // What was read already may still come, in DATA, but then RST_STREAM.
    let mut came = 0;
    while let (0, bytes) = next_frame(&mut stream, 1) {
        came += bytes.len();
        assert!(came < 200 * 200 * 12, "all of it came");
    }
    // The others of the connection go on, though on a machine that stalls each may be let go of.
    let alive = (3..100).step_by(2).any(|id| {
        stream.write_all(&[get(id, "/livez"), more(id)].concat()).unwrap();
        // HEADERS, and DATA or RST_STREAM.
        assert_eq!(next_frame(&mut stream, id).0, 1);
        match next_frame(&mut stream, id) {
            (0, bytes) => bytes == b"alive\n",
            (kind, _) => {
                assert_eq!(kind, 3);
                false
            }
        }
    });
    assert!(alive);
}

#[test]
fn stopping_ends_what_has_begun() {
    if !has("curl", "--version") {
        return;
    }
    let server = Server::start(&["--metrics-listen", "127.0.0.1:0"]);
    let body = whole(16);
    let mut child = Command::new("curl")
        .args(["-sS", "--http2-prior-knowledge", "-T", "-", &format!("http://{}/v1/filter", server.address)])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(&body[..body.len() / 2]).unwrap();
    wait_until("the request is under way", || server.metric("rpfd_requests_in_flight") == Some(1.0));
    server.signal("-TERM");
    wait_until("it is draining", || server.metric("rpfd_ready") == Some(0.0));
    stdin.write_all(&body[body.len() / 2..]).unwrap();
    drop(stdin);
    let output = child.wait_with_output().unwrap();
    let answer = Answer {
        status: 200,
        headers: vec![("content-type".into(), "application/msgpack".into())],
        body: output.stdout,
    };
    assert_eq!(answer.messages().len(), 2);
    assert_eq!(server.ended().code(), Some(0));
}

/// What is sent of a request before there is memory for it is in no request's share.
#[test]
fn few_requests_wait_for_their_memory() {
    let server = Server::start(&["--memory", "4MiB", "--threads", "1", "--metrics-listen", "127.0.0.1:0"]);
    // Room for three requests, who have it for as long as they like.
    let body = whole(16);
    let held = [(); 3].map(|()| server.begin("/v1/filter", &[], &body[..body.len() / 2], body.len()));
    let requests: Vec<u8> = (0..32).flat_map(|i| get(1 + 2 * i, "/v1/images")).collect();
    let waiting = [(); 5].map(|()| {
        let mut stream = server.connect();
        stream.write_all(&[PREFACE, SETTINGS, &requests].concat()).unwrap();
        stream
    });
    // 8 MiB for 64 KiB each, and some for the head.
    let refused = "rpfd_problems_total{code=\"busy\"}";
    wait_until("33 of 160 are refused", || server.metric(refused) == Some(33.0));
    wait_until("the others wait", || server.metric("rpfd_requests_in_flight") == Some(130.0));
    drop(held);
    wait_until("all are answered", || server.metric("rpfd_requests_in_flight") == Some(0.0));
    assert_eq!(server.metric(refused), Some(33.0));
    drop(waiting);
}

#[test]
fn a_head_has_no_more_fields_than_in_http_1() {
    if !has("curl", "--version") {
        return;
    }
    let server = Server::start(&[]);
    // With user-agent and accept, that curl sends.
    let fields: Vec<String> = (0..99).map(|i| format!("x-{i}: 1")).collect();
    let url = format!("http://{}/livez", server.address);
    let ask = |fields: &[String]| {
        let headers = fields.iter().flat_map(|field| ["-H", field]);
        curl(&headers.chain([url.as_str()]).collect::<Vec<_>>()).0
    };
    assert_eq!((ask(&fields[1..]), ask(&fields)), (200, 431));
}
