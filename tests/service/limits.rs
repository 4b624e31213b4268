//! Memory is bounded, and given back.

use super::{Answer, Server, flow::plain, head, samples, tile, wait_until, whole};
use rpfd::{
    config::Config,
    filter::{Channel, ChannelSet, Method, Rect, Role, TileGeometry, plan::plan},
    service::Service,
    wire::{Format, Header, Message, SampleCounts, encode_header},
};
use std::{
    io::Write,
    time::{Duration, Instant},
};

const IMAGE: [u32; 2] = [128, 128];

/// Memory with which a service can take this tile, and no more beside it, as an argument: a quarter is for requests, of
/// which there may be a few if the tile is large, and an eighth for images.
fn memory(side: u32, method: &Method) -> String {
    let tile = samples(IMAGE, Rect::new(0, 0, side, side), 0, 1);
    let header = Header::of(&tile, Format::F32).unwrap();
    let threads = Config::default().threads;
    ((plan(&header.shape(), method).total(threads) + 1024) * 8 / 5).to_string()
}

#[test]
fn a_tile_that_never_fits_is_told_the_size_that_would() {
    let server = Server::start(&["--memory", "4MiB", "--threads", "2"]);
    let problem = server.post("/v1/filter", &whole(128)).problem(413, "over_memory");
    assert!(problem["needed"].as_u64() > problem["available"].as_u64());
    let fits = problem["fits"][0].as_u64().unwrap() as u32;
    assert!(problem["detail"].as_str().unwrap().contains(&format!("{fits} x {fits}")), "{problem}");
    let with = |side| server.post("/v1/filter", &tile(IMAGE, Rect::new(0, 0, side, side), 0));
    assert_eq!(with(fits).messages().len(), 2);
    with(fits + 1).problem(413, "over_memory");
}

#[test]
fn a_full_budget_is_503_until_it_is_free_again() {
    let metrics = ["--metrics-listen", "127.0.0.1:0"];
    let memory = memory(128, &Method::default());
    let server = Server::start(&[&metrics[..], &["--memory", &memory, "--queue-deadline", "0.3"]].concat());
    let body = tile(IMAGE, Rect::new(0, 0, 128, 128), 0);
    // This client sends half of a tile and then nothing.
    let slow = server.send("/v1/filter", &[], &body[..body.len() / 2], body.len());
    let admitted = "rpfd_tile_phase_seconds_count{phase=\"queue\"}";
    wait_until("it has the memory", || server.metric(admitted) == Some(1.0));
    let answer = server.post("/v1/filter", &body);
    answer.problem(503, "busy");
    assert!(answer.header("retry-after").unwrap().parse::<u64>().unwrap() >= 1);
    // What needs no memory is answered all the same.
    assert_eq!(server.get("/livez").status, 200);
    assert_eq!(server.get("/readyz").status, 200);
    drop(slow);
    wait_until("its memory is free", || server.metric("rpfd_memory_used_bytes") == Some(0.0));
    assert_eq!(server.post("/v1/filter", &body).messages().len(), 2);
}

#[test]
fn nobody_has_to_read_while_sending() {
    let server = Server::start(&["--memory", "16MiB"]);
    // More than sockets buffer, both ways: 60 tiles of 0.4 MB, results of 0.8 MB.
    let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let side = 256;
    let tiles: Vec<u8> = (0..60)
        .flat_map(|i| {
            let geometry = TileGeometry::with_halo([side * 60, side], Rect::new(side * i, 0, side, side), 0).unwrap();
            let header = Header::new(geometry, channels.clone(), SampleCounts::Uniform(1), Format::F16).unwrap();
            let mut bytes = encode_header(&header);
            for _ in 0..3 {
                bytes.extend([0xc6, 0, 2, 0, 0]);
                bytes.extend((0..side * side).flat_map(|i| (0x3800 + (i % 700) as u16).to_le_bytes()));
            }
            bytes
        })
        .collect();
    let mut stream = server.connect();
    stream.write_all(head("POST", "/v1/filter?preset=unfiltered", &[], tiles.len()).as_bytes()).unwrap();
    stream.write_all(&tiles).expect("the service takes everything while nothing is read");
    let messages = Answer::read(&mut stream).messages();
    assert_eq!(messages.last(), Some(&Message::End { tiles: 60, errors: 0 }));
    assert_eq!(messages.len(), 61);
}

#[test]
fn a_client_that_only_sends_gets_its_refusal() {
    let server = Server::start(&["--memory", "8MiB"]);
    let body = whole(320);
    let zstd = ["Content-Encoding: zstd"];
    // What has stalled for about as long as the service waits for more, here or there, is tried again.
    let sent = |path: &str, headers: &[&str]| {
        let (began, mut last, mut longest) = (Instant::now(), Instant::now(), Duration::ZERO);
        let mut stream = server.connect();
        stream.write_all(head("POST", path, headers, body.len()).as_bytes()).unwrap();
        for piece in body.chunks(1 << 16) {
            let written = stream.write_all(piece);
            longest = longest.max(last.elapsed());
            last = Instant::now();
            if longest >= Duration::from_millis(500) || began.elapsed() >= Duration::from_secs(5) {
                return None;
            }
            written.expect("the service takes what it has refused");
        }
        Some(stream)
    };
    for (path, headers, status, code) in [
        ("/v1/filter?preset=x", &[][..], 400, "unknown_preset"),
        ("/v1/images/x/tiles", &[], 404, "unknown_image"),
        ("/v1/filter", &[], 413, "over_memory"),
        ("/v1/filter", &zstd, 400, "compression"),
    ] {
        let mut stream = (0..200).find_map(|_| sent(path, headers)).expect("a while without a stall");
        Answer::read(&mut stream).problem(status, code);
    }
}

#[test]
fn a_stream_waits_for_its_own_tiles_whatever_the_deadline() {
    // Room for one tile, a deadline that filtering it takes longer than.
    let server =
        Server::start(&["--memory", &memory(48, &Method::preset("paper-fast").unwrap()), "--queue-deadline", "0.001"]);
    let image = [144, 48];
    let tiles: Vec<u8> = (0..3).flat_map(|i| tile(image, Rect::new(48 * i, 0, 48, 48), 0)).collect();
    let messages = server.post("/v1/filter?preset=paper-fast", &tiles).messages();
    assert_eq!(messages.last(), Some(&Message::End { tiles: 3, errors: 0 }), "{messages:?}");
}

#[test]
fn an_idle_body_is_given_up() {
    let server = Server::start(&["--idle-deadline", "0.2"]);
    let body = whole(16);
    let mut stream = server.connect();
    stream.write_all(head("POST", "/v1/filter", &[], body.len()).as_bytes()).unwrap();
    stream.write_all(&body[..100]).unwrap();
    Answer::read(&mut stream).problem(408, "body_timeout");
    // Between tiles too; what came before is done.
    let body = plain(16, 1, 0);
    let mut stream = server.send("/v1/filter", &[], &body, body.len() + 100);
    let messages = Answer::read(&mut stream).messages();
    let Message::Error { problem, .. } = &messages[1] else { panic!("{messages:?}") };
    assert_eq!((&*problem.code, messages.last()), ("body_timeout", Some(&Message::End { tiles: 1, errors: 1 })));
}

#[test]
fn heads_have_a_limit() {
    let server = Server::start(&[]);
    let ask = |head: &str| {
        let mut stream = server.connect();
        stream.write_all(head.as_bytes()).unwrap();
        Answer::read(&mut stream).status
    };
    let fields = |count: usize| format!("GET /livez HTTP/1.1\r\n{}", "Connection: close\r\n".repeat(count));
    let long = |length: usize| {
        let start = fields(1) + "X: ";
        let filled = "x".repeat(length - start.len() - 4);
        start + &filled
    };
    // As long as can be, and one that has as many bytes and no end yet.
    assert_eq!(ask(&(long(65_536) + "\r\n\r\n")), 200);
    assert_eq!(ask(&(long(65_536) + "xxxx")), 431);
    assert_eq!(ask(&(fields(100) + "\r\n")), 200);
    assert_eq!(ask(&(fields(101) + "\r\n")), 431);
}

#[test]
fn connections_at_once_are_bounded() {
    let server = Server::start(&["--connections", "1"]);
    let mut first = server.connect();
    let mut ask = || {
        first.write_all(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n").unwrap();
        let mut answer = [0; 4096];
        let length = std::io::Read::read(&mut first, &mut answer).unwrap();
        assert!(answer[..length].starts_with(b"HTTP/1.1 200"), "{:?}", String::from_utf8_lossy(&answer[..length]));
    };
    ask();
    let mut second = server.connect();
    second.write_all(head("GET", "/livez", &[], 0).as_bytes()).unwrap();
    // However long the first one takes.
    (0..200).for_each(|_| ask());
    second.set_nonblocking(true).unwrap();
    assert_eq!(second.peek(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
    second.set_nonblocking(false).unwrap();
    drop(first);
    assert_eq!(Answer::read(&mut second).status, 200);
}

#[test]
fn it_stops_when_told_to_after_what_has_begun() {
    // Half a head is not waited for longer than that.
    let server = Server::start(&["--header-deadline", "1"]);
    let mut idle = server.connect();
    idle.write_all(b"GET /livez HTTP/1.1\r\n").unwrap();
    let (body, mut busy) = (whole(32), None);
    // If its head came too late, on a machine that stalls, it is tried again.
    wait_until("a request is let in", || {
        busy = server.try_begin("/v1/filter", &[], &body[..body.len() / 2], body.len());
        busy.is_some()
    });
    let mut busy = busy.unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(300));
            busy.write_all(&body[body.len() / 2..]).unwrap();
            assert_eq!(Answer::read(&mut busy).messages().len(), 2);
        });
        assert_eq!(server.terminate().code(), Some(0));
    });
}

#[test]
fn a_wrong_configuration_is_refused_all_at_once() {
    let serve = |arguments: &[&str]| {
        let command = std::process::Command::new(env!("CARGO_BIN_EXE_rpfd")).arg("serve").args(arguments).output();
        let output = command.unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, message) = serve(&["--listen", "127.0.0.1:0", "--memory", "0", "--threads", "0"]);
    assert_eq!(code, Some(2));
    assert!(message.contains("memory") && message.contains("threads") && message.contains("bad_config"), "{message}");
    assert_eq!(serve(&["--memory", "lots"]).0, Some(2));
    let (code, message) = serve(&["--listen", "127.0.0.1:0", "--data-dir", "/dev/null/x"]);
    assert_eq!(code, Some(1));
    assert!(message.contains("/dev/null/x") && message.contains("data_dir"), "{message}");
}

#[test]
fn it_runs_in_process_too() {
    let folder = tempfile::tempdir().unwrap();
    let config = Config {
        listen: "127.0.0.1:0".parse().unwrap(),
        data_dir: folder.path().join("made/for/it"),
        threads: 1,
        ..Config::default()
    };
    let service = Service::bind(config).unwrap();
    let address = service.local_addr();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let thread = std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(service.run(async { drop(stopped.await) }))
    });
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    let body = whole(16);
    stream.write_all(head("POST", "/v1/filter", &[], body.len()).as_bytes()).unwrap();
    stream.write_all(&body).unwrap();
    assert_eq!(Answer::read(&mut stream).messages().len(), 2);
    stop.send(()).unwrap();
    thread.join().unwrap().unwrap();
}
