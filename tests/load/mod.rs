//! The real binary under load: many connections, tiles of all sizes, good clients among slow, vanishing and never-reading
//! ones. Memory stays within its bound, and every answer is one that the contract allows.
//!
//! `RPFD_LOAD=full` runs all of it: 2000 tiles at each of three sizes of memory.

mod client;
mod large;
pub(crate) mod process;

use std::{
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use crate::service::{Server, encode, samples};
use client::{Client, Tally};
use process::Process;
use rpfd::filter::Rect;

const MIB: u64 = 1 << 20;
const CONNECTIONS: usize = 64;

fn full() -> bool {
    std::env::var("RPFD_LOAD").is_ok_and(|value| value == "full")
}

/// What the clients send.
struct Tiles {
    /// One tile of each size, from small to large, and its side in pixels.
    sizes: Vec<(u32, Vec<u8>)>,
    /// The tiles of one small image.
    image: Vec<Vec<u8>>,
}

impl Tiles {
    const IMAGE: u32 = 96;

    fn new() -> Self {
        let tile = |side| encode(&samples([side, side], Rect::new(0, 0, side, side), 0, 1));
        let part = |i: u32| encode(&samples([Self::IMAGE; 2], Rect::new(i % 3 * 32, i / 3 * 32, 32, 32), 0, 1));
        Self { sizes: [16, 32, 64, 128, 256].map(|side| (side, tile(side))).into(), image: (0..9).map(part).collect() }
    }
}

/// Runs a load of so many tiles against a service of so much memory.
fn load(tiles: &Tiles, memory: u64, count: usize) {
    // No good client is cut off, however slow the machine; those that never read go by themselves.
    let server = Server::start(&["--memory", &memory.to_string(), "--queue-deadline", "60", "--threads", "2"]);
    let process = Process::of(server.pid());
    let (taken, tally) = (AtomicUsize::new(0), Mutex::new(Tally::default()));
    let started = Instant::now();
    std::thread::scope(|scope| {
        for index in 0..CONNECTIONS {
            let (server, taken, tally) = (&server, &taken, &tally);
            scope.spawn(move || {
                let mut client = Client::new(server, tiles, index);
                // Each takes a few tiles at a time until all are taken.
                while taken.fetch_add(client.batch(), Ordering::Relaxed) < count {
                    client.turn();
                }
                tally.lock().unwrap().add(client.tally);
            });
        }
    });
    let seconds = started.elapsed().as_secs_f64();
    let tally = tally.into_inner().unwrap();
    let peak = process.peak_memory();
    println!(
        "\n--memory {} MiB: {} tiles, {:.2} megapixels in {seconds:.1} s: {:.1} tiles/s, {:.0} MiB/s; peak {:.1} MiB; \
         {} times busy; CPU {:.1} s, outside of the filter's threads {:.1} s",
        memory / MIB,
        tally.tiles,
        tally.pixels as f64 / 1e6,
        tally.tiles as f64 / seconds,
        tally.sent as f64 / MIB as f64 / seconds,
        peak as f64 / MIB as f64,
        tally.busy,
        process.cpu_seconds(),
        process.cpu_seconds() - process.filter_seconds(),
    );
    tally.print();
    assert_eq!(tally.unexpected, [""; 0]);
    assert!(tally.tiles as usize >= count, "{} tiles", tally.tiles);
    assert!(peak <= memory + 64 * MIB, "{peak} bytes at the peak, with --memory {memory}");
    // All that was reserved is free again: what needs the most of it gets in.
    let (side, largest) = &tiles.sizes[4];
    let answer = server.post("/v1/filter?preset=unfiltered", largest);
    assert_eq!(answer.messages().len(), 2, "{side}");
}

#[test]
fn memory_is_bounded_under_load() {
    let tiles = Tiles::new();
    if full() {
        [128, 512, 2048].into_iter().for_each(|memory| load(&tiles, memory * MIB, 2000));
    } else {
        load(&tiles, 128 * MIB, 300);
    }
}

/// Filtering tiles of 256 x 256 over HTTP, little of the service's CPU time is spent outside of the filter.
#[test]
fn little_time_is_spent_outside_of_the_filter() {
    let server = Server::start(&["--threads", "2"]);
    let process = Process::of(server.pid());
    let tile = encode(&samples([512, 512], Rect::new(128, 128, 256, 256), 17, 1));
    // The share of some tiles. Taking the samples in, and making them finite, counts as outside.
    let outside = |tiles: usize| {
        let before = (process.cpu_seconds(), process.filter_seconds());
        for _ in 0..tiles {
            assert_eq!(server.post("/v1/filter?preset=lean", &tile).messages().len(), 2);
        }
        let (all, filter) = (process.cpu_seconds() - before.0, process.filter_seconds() - before.1);
        let share = (all - filter) / all;
        println!(
            "{tiles} tiles of 256 x 256 and {} MB: {all:.2} s of CPU, {:.1}% outside",
            tile.len() / 1_000_000,
            100.0 * share
        );
        share
    };
    // Threads and memory are there from then on.
    outside(1);
    // What else the machine does at the same time can only add to it.
    let little = (0..10).any(|_| outside(if full() { 16 } else { 4 }) <= 0.1);
    assert!(little, "more than a tenth of the CPU time is spent outside of the filter's threads, each time");
}

/// Waits a little: what others hold will be free soon.
fn pause() {
    std::thread::sleep(Duration::from_millis(100));
}
