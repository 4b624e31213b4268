//! Back-pressure: slow, silent and vanishing clients, full queues, results that nobody reads.

use super::{Answer, head, samples, tile};
use rpfd::{
    config::{ByteSize, Config},
    filter::{
        Channel, ChannelSet, Counts, Execution, Method, Plane, Rect, Role, SampleTile, TileGeometry,
        plan::{Shape, plan},
    },
    service::Service,
    synth::Scene,
    wire::{Format, Header, Message, SampleCounts, encode_header},
};
use std::{
    io::{Read, Write},
    net::{SocketAddr, TcpStream},
    time::Duration,
};

/// A service in this process, configured at will.
struct Local {
    address: SocketAddr,
    stop: Option<tokio::sync::oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
    _folder: tempfile::TempDir,
}

impl Local {
    fn start(change: impl FnOnce(&mut Config)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut config = Config {
            listen: "127.0.0.1:0".parse().unwrap(),
            data_dir: folder.path().to_owned(),
            threads: 1,
            ..Config::default()
        };
        change(&mut config);
        let service = Service::bind(config).unwrap();
        let address = service.local_addr();
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(service.run(async { drop(stopped.await) })).unwrap();
        });
        Self { address, stop: Some(stop), thread: Some(thread), _folder: folder }
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        stream.set_write_timeout(Some(Duration::from_secs(60))).unwrap();
        stream
    }

    /// Sends a request, or as much of its body as is given.
    fn send(&self, path: &str, body: &[u8], length: usize) -> TcpStream {
        let mut stream = self.connect();
        stream.write_all(head("POST", path, &[], length).as_bytes()).unwrap();
        // The service may close its end early.
        let _ = stream.write_all(body);
        stream
    }

    fn post(&self, path: &str, body: &[u8]) -> Answer {
        Answer::read(&mut self.send(path, body, body.len()))
    }

    fn get(&self, path: &str) -> Answer {
        let mut stream = self.connect();
        stream.write_all(head("GET", path, &[], 0).as_bytes()).unwrap();
        Answer::read(&mut stream)
    }
}

impl Drop for Local {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}

/// A tile of one colour, some hundred bytes, whose result has 12 bytes a pixel.
pub(crate) fn plain(side: u32, samples: u32, at: u32) -> Vec<u8> {
    let geometry = TileGeometry::with_halo([1 << 20, side], Rect::new(at * side, 0, side, side), 0).unwrap();
    let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
    let header = Header::new(geometry, channels, SampleCounts::Uniform(samples), Format::F32).unwrap();
    let mut bytes = encode_header(&header);
    bytes.extend([1, 2, 3]);
    bytes
}

fn codes(messages: &[Message]) -> Vec<&str> {
    let code = |message: &Message| {
        if let Message::Error { problem, .. } = message { Some(problem.code.clone()) } else { None }
    };
    let codes: Vec<_> = messages.iter().filter_map(code).collect();
    codes.into_iter().map(|code| &*code.leak()).collect()
}

/// Memory for a budget of so much for tiles, where a quarter is for requests, and an eighth for images.
const fn memory(tiles: u64) -> ByteSize {
    ByteSize((tiles + 4) * 8 / 5)
}

fn needed(header: &Header, method: &Method) -> u64 {
    plan(&header.shape(), method).total(1)
}

#[test]
fn who_vanishes_frees_what_he_held_within_a_row_of_work() {
    let settings = [("boxes", "55,55,55,55"), ("fractions", "4,4,4,4")];
    let query = "preset=paper&boxes=55,55,55,55&fractions=4,4,4,4";
    let (image, rect) = ([1024, 48], Rect::new(0, 0, 1024, 48));
    let whole = samples(image, rect, 0, 1);
    let header = Header::of(&whole, Format::F32).unwrap();
    let body = super::encode(&whole);
    // Hours of work, a row of which takes several times the deadline of the next in the queue.
    let server = Local::start(|config| {
        config.memory = memory(needed(&header, &Method::with("paper", settings).unwrap()));
        config.queue_deadline = Duration::from_secs(3);
    });
    for _ in 0..2 {
        let gone = server.send(&format!("/v1/filter?{query}"), &body, body.len());
        // Once it is being filtered nobody else gets in.
        while server.post("/v1/filter?preset=unfiltered", &body).status == 200 {}
        drop(gone);
        assert_eq!(server.post("/v1/filter?preset=unfiltered", &body).messages().len(), 2);
    }
}

#[test]
fn who_never_reads_is_cut_off() {
    let server = Local::start(|config| config.idle_deadline = Duration::from_millis(300));
    let body: Vec<u8> = (0..60).flat_map(|i| plain(256, 1, i)).collect();
    let mut stream = server.send("/v1/filter?preset=unfiltered", &body, body.len());
    // Far more than sockets hold waits to be read; nothing is, until the service has given up.
    while server.get("/v1/images").status != 200 {}
    std::thread::sleep(Duration::from_secs(4));
    let mut read = Vec::new();
    let _ = stream.read_to_end(&mut read);
    assert!(!read.is_empty() && read.len() < 60 * 12 * 256 * 256, "{} bytes", read.len());
}

#[test]
fn results_that_nobody_reads_have_a_limit() {
    let server = Local::start(|config| {
        config.unread_results = ByteSize(1 << 20);
        config.queue_deadline = Duration::from_millis(300);
    });
    let body: Vec<u8> = (0..60).flat_map(|i| plain(256, 1, i)).collect();
    let mut stream = server.send("/v1/filter?preset=unfiltered", &body, body.len());
    std::thread::sleep(Duration::from_secs(3));
    let messages = Answer::read(&mut stream).messages();
    // Some fit into the sockets; after that one waits, and then it ends in good order.
    assert_eq!(codes(&messages), ["results_unread"]);
    let Some(Message::End { tiles, errors: 1 }) = messages.last() else { panic!("{messages:?}") };
    assert!((1..60).contains(tiles));
    // What was read is free again, and one who reads as he sends knows no limit.
    for _ in 0..3 {
        assert_eq!(server.post("/v1/filter?preset=unfiltered", &body[..body.len() / 4]).status, 200);
    }
    // A result larger than all of them together.
    let answer = server.post("/v1/filter?preset=unfiltered", &plain(512, 1, 0));
    answer.problem(507, "results_unread");
}

#[test]
fn failures_that_nobody_reads_have_a_limit() {
    let server = Local::start(|config| config.memory = ByteSize(1 << 20));
    // Each is refused, with more words than it has bytes.
    let mut body = plain(16, 1, 0);
    (0..150_000).for_each(|i| body.extend(plain(1024, 1000, i % 1024)));
    let mut stream = server.send("/v1/filter?preset=unfiltered", &body, body.len());
    let messages = Answer::read(&mut stream).messages();
    let codes = codes(&messages);
    assert_eq!(codes.last(), Some(&"results_unread"));
    assert!(codes.len() < 150_000 && codes[..codes.len() - 1].iter().all(|&code| code == "over_memory"));
}

#[test]
fn a_trickle_does_not_hold_memory() {
    let server = Local::start(|config| {
        config.idle_deadline = Duration::from_millis(300);
        config.min_rate = ByteSize(100_000);
    });
    let body = tile([64, 64], Rect::new(0, 0, 64, 64), 0);
    let mut stream = server.send("/v1/filter", &body[..2000], body.len());
    let mut writer = stream.try_clone().unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for byte in &body[2000..4000] {
                std::thread::sleep(Duration::from_millis(10));
                if writer.write_all(&[*byte]).is_err() {
                    return;
                }
            }
        });
        let problem = Answer::read(&mut stream).problem(408, "body_timeout");
        assert!(problem["detail"].as_str().unwrap().contains("100000 a second"), "{problem}");
    });
}

#[test]
fn a_tile_that_takes_too_long_is_given_up_and_the_next_is_not() {
    let server = Local::start(|config| config.work_deadline = Duration::from_millis(200));
    let body = tile([64, 64], Rect::new(0, 0, 64, 64), 0);
    let slow = "/v1/filter?preset=paper&boxes=55,55,55,55&fractions=4,4,4,4";
    let messages = server.post(slow, &body).messages();
    assert_eq!(codes(&messages), ["work_timeout"]);
    assert_eq!(messages.last(), Some(&Message::End { tiles: 0, errors: 1 }));
    assert_eq!(codes(&server.post("/v1/filter?preset=unfiltered", &body).messages()), [""; 0]);
}

#[test]
fn a_full_queue_refuses_at_once_and_says_when_to_come_again() {
    let rect = Rect::new(0, 0, 48, 48);
    let header = Header::of(&samples([48, 48], rect, 0, 1), Format::F32).unwrap();
    let body = tile([48, 48], rect, 0);
    let server = Local::start(|config| {
        config.memory = ByteSize(memory(needed(&header, &Method::default())).0 * 3 / 2);
        config.queue = 1;
    });
    // One holds the memory, one waits; the third does not wait for its deadline of a minute.
    let held = server.send("/v1/filter", &body[..body.len() / 2], body.len());
    let mut refused = Vec::new();
    let mut waiting = Vec::new();
    for _ in 0..4 {
        waiting.push(server.send("/v1/filter", &body, body.len()));
    }
    for stream in &mut waiting {
        stream.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
        let mut byte = [0; 1];
        if stream.peek(&mut byte).is_ok() {
            refused.push(Answer::read(stream));
        }
    }
    assert_eq!(refused.len(), 3);
    for answer in &refused {
        answer.problem(503, "busy");
        assert!((1..=600).contains(&answer.header("retry-after").unwrap().parse().unwrap()));
    }
    drop(held);
}

#[test]
fn a_varying_tile_is_admitted_by_its_counts() {
    let geometry = TileGeometry::with_halo([96, 96], Rect::new(4, 4, 64, 64), 4).unwrap();
    let tile = Scene::by_name("all").unwrap().tile_varying(geometry, 6, &Execution::default()).unwrap();
    let header = Header::of(&tile, Format::F32).unwrap();
    let shape = Shape { max_per_pixel: tile.max_per_pixel(), ..header.shape() };
    let exact = plan(&shape, &Method::default()).total(1);
    // By what its header says one pixel might have all its samples.
    assert!(needed(&header, &Method::default()) > 4 * exact);
    let body = super::encode(&tile);
    let fits = Local::start(|config| config.memory = memory(exact));
    assert_eq!(codes(&fits.post("/v1/filter", &body).messages()), [""; 0]);
    let short = Local::start(|config| config.memory = ByteSize(memory(exact).0 * 4 / 5));
    let problem = short.post("/v1/filter", &body).problem(413, "over_memory");
    let fits = problem["fits"][0].as_u64().unwrap();
    assert!(problem["needed"].as_u64() == Some(exact) && (1..64).contains(&fits), "{problem}");
    // Counts that nobody would have the memory for.
    let geometry = TileGeometry::with_halo([60_000, 60_000], Rect::new(0, 0, 60_000, 60_000), 0).unwrap();
    let counts = SampleCounts::Varying { total: 1 };
    let header = Header::new(geometry, tile.channels().clone(), counts, Format::F32);
    if let Ok(header) = header {
        short.post("/v1/filter", &encode_header(&header)).problem(413, "over_memory");
    }
}

/// Requests that hold all memory there is for requests need none of it to go on.
#[test]
fn tiles_whose_counts_vary_do_not_wait_for_each_other() {
    // Room for six requests and their counts; eight come, of each a part at first.
    let server = Local::start(|config| config.memory = ByteSize(8 << 20));
    let geometry = TileGeometry::with_halo([16, 16], Rect::new(0, 0, 16, 16), 0).unwrap();
    let tile = Scene::by_name("all").unwrap().tile_varying(geometry, 2, &Execution::default()).unwrap();
    let body = super::encode(&tile);
    let begin = |_| server.send("/v1/filter?preset=gaussian", &body[..8], body.len());
    let mut streams: Vec<TcpStream> = (0..8).map(begin).collect();
    for stream in &mut streams {
        stream.write_all(&body[8..]).unwrap();
    }
    for stream in &mut streams {
        assert_eq!(codes(&Answer::read(stream).messages()), [""; 0]);
    }
}

#[test]
fn requests_take_memory_too() {
    // Room for one request at a time.
    let server = Local::start(|config| {
        config.memory = ByteSize(1 << 20);
        config.queue_deadline = Duration::from_millis(200);
    });
    let body = tile([16, 16], Rect::new(0, 0, 16, 16), 0);
    let half = server.send("/v1/filter", &body[..body.len() / 2], body.len());
    let mut answer = server.get("/v1/images");
    while answer.status == 200 {
        // The half tile was not there yet.
        answer = server.get("/v1/images");
    }
    answer.problem(503, "busy");
    assert_eq!(server.get("/livez").status, 200);
    drop(half);
    while server.get("/v1/images").status != 200 {}
    assert_eq!(server.post("/v1/filter", &body).messages().len(), 2);
}

/// Whatever else the tile would have to wait for.
#[test]
fn counts_that_never_fit_are_refused_at_once_with_the_size_that_would() {
    let varying = |side: u32| {
        let geometry = TileGeometry::with_halo([side, side], Rect::new(0, 0, side, side), 0).unwrap();
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3)]).unwrap();
        let counts = Counts::Varying((0..side * side).map(|i| 1 + (i % 2) as u16).collect());
        let planes = [1.0, 2.0, 3.0].map(Plane::Constant).to_vec();
        super::encode(&SampleTile::new(geometry, channels, counts, planes).unwrap())
    };
    // Half a MiB for counts.
    let [no_room, room] = [1, 4096].map(|unread| {
        Local::start(|config| {
            config.memory = ByteSize(8 << 20);
            config.unread_results = ByteSize(unread << 20);
        })
    });
    let problem = no_room.post("/v1/filter?preset=unfiltered", &varying(600)).problem(413, "over_memory");
    assert_eq!((problem["needed"].as_u64(), problem["available"].as_u64()), (Some(720_000), Some(1 << 19)));
    let fits = problem["fits"][0].as_u64().unwrap() as u32;
    assert!((64..512).contains(&fits), "{problem}");
    assert_eq!(codes(&room.post("/v1/filter?preset=unfiltered", &varying(fits)).messages()), [""; 0]);
}
