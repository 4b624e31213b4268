//! Back-pressure: slow, silent and vanishing clients, full queues, results that nobody reads.

use super::{Answer, Server, samples, tile, wait_until, whole};
use crate::load::process::Process;
use rpfd::{
    filter::{
        Channel, ChannelSet, Counts, Execution, Method, Plane, Rect, Role, SampleTile, TileGeometry,
        plan::{Shape, plan},
    },
    synth::Scene,
    wire::{Format, Header, Message, SampleCounts, encode_header},
};
use std::{
    io::{Read, Write},
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

const MEMORY_USED: &str = "rpfd_memory_used_bytes";
const IN_FLIGHT: &str = "rpfd_requests_in_flight";
/// Tiles that got their memory, that got a thread, and that were filtered.
const ADMITTED: &str = "rpfd_tile_phase_seconds_count{phase=\"queue\"}";
const BEGUN: &str = "rpfd_tile_phase_seconds_count{phase=\"turn\"}";
const FILTERED: &str = "rpfd_tile_phase_seconds_count{phase=\"filter\"}";

/// A service that filters on one thread.
fn start(arguments: &[&str]) -> Server {
    Server::start(&[&["--threads", "1", "--metrics-listen", "127.0.0.1:0"], arguments].concat())
}

fn problems(server: &Server, code: &str) -> f64 {
    server.metric(&format!("rpfd_problems_total{{code=\"{code}\"}}")).unwrap_or_default()
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

/// Memory for a budget of so much for tiles, where a quarter is for requests, and an eighth for images, as an argument.
fn memory(tiles: u64) -> String {
    ((tiles + 4) * 8 / 5).to_string()
}

fn needed(header: &Header, method: &Method) -> u64 {
    plan(&header.shape(), method).total(1)
}

#[test]
fn who_vanishes_frees_what_he_held_within_a_row_of_work() {
    // Days of work, a row of which takes minutes.
    const SIZE: [u32; 2] = [8192, 16];
    let path = "/v1/filter?preset=paper&boxes=55,55,55,55&fractions=4,4,4,4";
    let body = tile(SIZE, Rect::new(0, 0, SIZE[0], SIZE[1]), 0);
    let server = start(&[]);
    let process = Process::of(server.pid());
    for (begun, accept) in [(1.0, "Accept: application/msgpack"), (2.0, "Accept: image/x-exr")] {
        let gone = server.send(path, &[accept], &body, body.len());
        wait_until("it is being filtered", || server.metric(BEGUN) == Some(begun));
        let before = process.filter_seconds();
        drop(gone);
        wait_until("what he held is free", || server.metric(MEMORY_USED) == Some(0.0));
        // Of the filter's own time, whatever else the machine does.
        let seconds = process.filter_seconds() - before;
        assert!(seconds < 30.0, "{seconds}");
    }
    assert_eq!(server.metric(FILTERED), Some(0.0));
    assert_eq!(server.post("/v1/filter", &whole(16)).messages().len(), 2);
}

#[test]
fn who_never_reads_is_cut_off() {
    let server = start(&["--idle-deadline", "300ms"]);
    let body: Vec<u8> = (0..60).flat_map(|i| plain(256, 1, i)).collect();
    // Far more than sockets hold waits to be read; nothing is, until the service has given up.
    let mut stream = server.send("/v1/filter?preset=unfiltered", &[], &body, body.len());
    let answered = "rpfd_requests_total{route=\"/v1/filter\",method=\"POST\",status=\"200\"}";
    wait_until("it is answered", || server.metric(answered) == Some(1.0));
    wait_until("it is cut off", || server.metric(IN_FLIGHT) == Some(0.0));
    let mut read = Vec::new();
    let _ = stream.read_to_end(&mut read);
    assert!(read.starts_with(b"HTTP/1.1 200") && read.len() < 60 * 12 * 256 * 256, "{} bytes", read.len());
}

#[test]
fn results_that_nobody_reads_have_a_limit() {
    let server = start(&["--unread-results", "1MiB", "--queue-deadline", "300ms"]);
    let body = |tiles| (0..tiles).flat_map(|i| plain(256, 1, i)).collect::<Vec<u8>>();
    let sixty = body(60);
    let mut stream = server.send("/v1/filter?preset=unfiltered", &[], &sixty, sixty.len());
    wait_until("no more are taken", || problems(&server, "results_unread") == 1.0);
    let messages = Answer::read(&mut stream).messages();
    // Some fit into the sockets; after that one waits, and then it ends in good order.
    assert_eq!(codes(&messages), ["results_unread"]);
    let Some(Message::End { tiles, errors: 1 }) = messages.last() else { panic!("{messages:?}") };
    assert!((1..60).contains(tiles));
    // A result larger than all of them together.
    let answer = server.post("/v1/filter?preset=unfiltered", &plain(512, 1, 0));
    answer.problem(507, "results_unread");
    // What was read is free again, and one who reads as he sends knows no limit.
    let server = start(&["--unread-results", "1MiB"]);
    for _ in 0..3 {
        let messages = server.post("/v1/filter?preset=unfiltered", &body(15)).messages();
        assert_eq!((codes(&messages), messages.len()), (Vec::new(), 16));
    }
}

#[test]
fn room_that_ones_own_tiles_hold_is_waited_for() {
    // Room for one result; two tiles, each of which is at work for longer than anybody may wait.
    let arguments = ["--unread-results", "1MiB", "--queue-deadline", "200ms", "--work-deadline", "1s"];
    let server = start(&arguments);
    let tiles = [0, 200].map(|x| tile([400, 200], Rect::new(x, 0, 200, 200), 0)).concat();
    let slow = "/v1/filter?preset=paper&boxes=55,55,55,55&fractions=4,4,4,4";
    let messages = server.post(slow, &tiles).messages();
    assert_eq!(codes(&messages), ["work_timeout", "work_timeout"]);
}

#[test]
fn failures_that_nobody_reads_have_a_limit() {
    let server = start(&["--memory", "4MiB"]);
    // Each is refused, with more words than it has bytes.
    let (first, part) = (plain(16, 1, 0), plain(1024, 1000, 1).repeat(1000));
    let mut stream = server.send("/v1/filter?preset=unfiltered", &[], &first, first.len() + 150 * part.len());
    let refused = || problems(&server, "results_unread") == 1.0;
    // It is sent no more than it takes, which it would have to throw away.
    for parts in 1..=150 {
        stream.write_all(&part).unwrap();
        let all = || problems(&server, "over_memory") == f64::from(parts * 1000);
        wait_until("they are refused", || refused() || all());
        if refused() {
            break;
        }
    }
    wait_until("no more are taken", refused);
    let messages = Answer::read(&mut stream).messages();
    let codes = codes(&messages);
    assert_eq!(codes.last(), Some(&"results_unread"));
    assert!(codes.len() < 150_000 && codes[..codes.len() - 1].iter().all(|&code| code == "over_memory"));
}

#[test]
fn a_trickle_does_not_hold_memory() {
    let server = start(&["--idle-deadline", "300ms", "--min-rate", "100000"]);
    let body = tile([64, 64], Rect::new(0, 0, 64, 64), 0);
    let mut stream = server.send("/v1/filter", &[], &body[..2000], body.len());
    let (mut writer, answered) = (stream.try_clone().unwrap(), AtomicBool::new(false));
    std::thread::scope(|scope| {
        // All of it would take hours.
        scope.spawn(|| {
            for byte in &body[2000..] {
                std::thread::sleep(Duration::from_millis(10));
                if answered.load(Ordering::Relaxed) || writer.write_all(&[*byte]).is_err() {
                    return;
                }
            }
        });
        let there = stream.peek(&mut [0]);
        answered.store(true, Ordering::Relaxed);
        there.unwrap();
        Answer::read(&mut stream).problem(408, "body_timeout");
    });
    wait_until("its memory is free", || server.metric(MEMORY_USED) == Some(0.0));
}

#[test]
fn a_tile_that_takes_too_long_is_given_up_and_the_next_is_not() {
    let server = start(&["--work-deadline", "200ms"]);
    let body = tile([64, 64], Rect::new(0, 0, 64, 64), 0);
    let slow = "/v1/filter?preset=paper&boxes=55,55,55,55&fractions=4,4,4,4";
    let messages = server.post(slow, &body).messages();
    assert_eq!(codes(&messages), ["work_timeout"]);
    assert_eq!(messages.last(), Some(&Message::End { tiles: 0, errors: 1 }));
    // On a machine that stalls even this may take too long.
    wait_until("the next is filtered", || {
        let messages = server.post("/v1/filter?preset=unfiltered", &body).messages();
        let codes = codes(&messages);
        assert!(codes.iter().all(|&code| code == "work_timeout"), "{codes:?}");
        codes.is_empty()
    });
}

#[test]
fn a_full_queue_refuses_at_once_and_says_when_to_come_again() {
    let rect = Rect::new(0, 0, 128, 128);
    let header = Header::of(&samples([128, 128], rect, 0, 1), Format::F32).unwrap();
    let body = tile([128, 128], rect, 0);
    // A third of that is enough for the five requests.
    let memory = memory(needed(&header, &Method::default()));
    let server = start(&["--memory", &memory, "--queue", "1"]);
    // One holds the memory, one waits; the others do not wait for their deadline.
    let mut held = server.send("/v1/filter", &[], &body[..body.len() / 2], body.len());
    wait_until("one has the memory", || server.metric(ADMITTED) == Some(1.0));
    let waiting = [(); 4].map(|()| server.send("/v1/filter", &[], &body[..2000], body.len()));
    wait_until("three are refused", || problems(&server, "busy") == 3.0);
    assert_eq!(server.metric("rpfd_queue_length"), Some(1.0));
    held.write_all(&body[body.len() / 2..]).unwrap();
    assert_eq!(Answer::read(&mut held).messages().len(), 2);
    let mut refused = 0;
    for mut stream in waiting {
        // The service may not take the rest of those that it has refused.
        let _ = stream.write_all(&body[2000..]);
        let answer = Answer::read(&mut stream);
        if answer.status == 200 {
            assert_eq!(answer.messages().len(), 2);
            continue;
        }
        answer.problem(503, "busy");
        assert!((1..=600).contains(&answer.header("retry-after").unwrap().parse().unwrap()));
        refused += 1;
    }
    assert_eq!(refused, 3);
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
    let fits = start(&["--memory", &memory(exact)]);
    assert_eq!(codes(&fits.post("/v1/filter", &body).messages()), [""; 0]);
    let short = start(&["--memory", &memory(exact * 4 / 5)]);
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
    // Room for six requests and their counts; once six of them are let in two more come.
    let server = start(&["--memory", "8MiB"]);
    let geometry = TileGeometry::with_halo([16, 16], Rect::new(0, 0, 16, 16), 0).unwrap();
    let tile = Scene::by_name("all").unwrap().tile_varying(geometry, 2, &Execution::default()).unwrap();
    let body = super::encode(&tile);
    let path = "/v1/filter?preset=gaussian";
    let mut streams: Vec<_> = (0..6).map(|_| server.begin(path, &[], &body[..8], body.len())).collect();
    streams.extend((0..2).map(|_| server.send(path, &[], &body[..8], body.len())));
    for stream in &mut streams {
        stream.write_all(&body[8..]).unwrap();
    }
    for stream in &mut streams {
        assert_eq!(codes(&Answer::read(stream).messages()), [""; 0]);
    }
}

#[test]
fn requests_take_memory_too() {
    // Room for three requests at a time.
    let server = start(&["--memory", "4MiB", "--queue-deadline", "200ms"]);
    let body = whole(16);
    let half = [(); 3].map(|()| server.begin("/v1/filter", &[], &body[..body.len() / 2], body.len()));
    server.get("/v1/images").problem(503, "busy");
    assert_eq!(server.get("/livez").status, 200);
    drop(half);
    wait_until("its memory is free", || server.metric(MEMORY_USED) == Some(0.0));
    assert_eq!(server.get("/v1/images").status, 200);
    wait_until("its memory is free", || server.metric(MEMORY_USED) == Some(0.0));
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
    let [no_room, room] = ["1MiB", "4GiB"].map(|unread| start(&["--memory", "8MiB", "--unread-results", unread]));
    let problem = no_room.post("/v1/filter?preset=unfiltered", &varying(600)).problem(413, "over_memory");
    assert_eq!((problem["needed"].as_u64(), problem["available"].as_u64()), (Some(720_000), Some(1 << 19)));
    let fits = problem["fits"][0].as_u64().unwrap() as u32;
    assert!((64..512).contains(&fits), "{problem}");
    assert_eq!(codes(&room.post("/v1/filter?preset=unfiltered", &varying(fits)).messages()), [""; 0]);
}
