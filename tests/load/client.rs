//! Clients, good and bad.

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    time::{Duration, Instant},
};

use super::{Tiles, pause};
use crate::service::{Answer, Server, flow::plain, head};
use rpfd::wire::{Message, ResultDecoder};

/// What came of it all.
#[derive(Default)]
pub(super) struct Tally {
    pub(super) tiles: u64,
    pub(super) pixels: u64,
    /// Bytes sent.
    pub(super) sent: u64,
    /// Times that a client was asked to come again.
    pub(super) busy: u64,
    /// Answers that should not be.
    pub(super) unexpected: Vec<String>,
    /// Seconds, by phase.
    phases: BTreeMap<&'static str, Vec<f64>>,
    /// Requests by kind of client.
    kinds: BTreeMap<&'static str, u64>,
}

impl Tally {
    pub(super) fn add(&mut self, other: Self) {
        self.tiles += other.tiles;
        self.pixels += other.pixels;
        self.sent += other.sent;
        self.busy += other.busy;
        self.unexpected.extend(other.unexpected);
        other.phases.into_iter().for_each(|(phase, seconds)| self.phases.entry(phase).or_default().extend(seconds));
        other.kinds.into_iter().for_each(|(kind, count)| *self.kinds.entry(kind).or_default() += count);
    }

    pub(super) fn print(&self) {
        for (phase, seconds) in &self.phases {
            let mut sorted = seconds.clone();
            sorted.sort_by(f64::total_cmp);
            let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
            println!("  {phase:8} median {:7.3} s, 95% {:7.3} s, most {:7.3} s", at(0.5), at(0.95), at(1.0));
        }
        println!("  requests: {:?}", self.kinds);
    }
}

/// One connection's worth of requests, one after another.
pub(super) struct Client<'a> {
    server: &'a Server,
    tiles: &'a Tiles,
    index: usize,
    /// State of the random numbers.
    random: u64,
    turns: usize,
    pub(super) tally: Tally,
}

impl<'a> Client<'a> {
    pub(super) fn new(server: &'a Server, tiles: &'a Tiles, index: usize) -> Self {
        Self { server, tiles, index, random: index as u64, turns: 0, tally: Tally::default() }
    }

    /// SplitMix64, below `limit`.
    fn below(&mut self, limit: u64) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % limit
    }

    /// Tiles that it takes on at a time; those that get no answer do not count.
    pub(super) const fn batch(&self) -> usize {
        match self.index % 8 {
            1 | 2 => 0,
            0 | 5 => 1,
            3 => 9,
            _ => 4,
        }
    }

    pub(super) fn turn(&mut self) {
        self.turns += 1;
        let kind = match self.index % 8 {
            0 => self.slow(),
            1 => self.vanishing(),
            2 => self.silent(),
            3 => self.image(),
            4 => self.compressed(),
            5 => self.picture(),
            6 => self.sends_first(),
            _ => self.reads_as_it_sends(),
        };
        *self.tally.kinds.entry(kind).or_default() += 1;
    }

    /// A tile, small ones more often than large ones, and a preset that takes little time for one of its size.
    fn tile(&mut self) -> (usize, &'static str) {
        let size = match self.below(20) {
            0..=5 => 0,
            6..=11 => 1,
            12..=16 => 2,
            17..=18 => 3,
            _ => 4,
        };
        let presets = ["lean", "cross-bilateral", "bilateral", "gaussian", "unfiltered"];
        let preset = presets[self.below(presets.len() as u64) as usize];
        (size, if size > 2 && preset == "lean" { "gaussian" } else { preset })
    }

    /// Several tiles of one preset after another, their number and pixels.
    fn stream(&mut self, count: usize) -> (String, Vec<u8>, u64, u64) {
        let (mut body, mut pixels, mut path) = (Vec::new(), 0, String::new());
        for _ in 0..count {
            let (size, preset) = self.tile();
            let (side, tile) = &self.tiles.sizes[size];
            body.extend_from_slice(tile);
            pixels += u64::from(side * side);
            path = format!("/v1/filter?preset={preset}");
        }
        (path, body, count as u64, pixels)
    }

    fn unexpected(&mut self, what: &str, answer: &Answer) {
        let body = String::from_utf8_lossy(&answer.body[..answer.body.len().min(300)]).into_owned();
        self.tally.unexpected.push(format!("client {}: {what}: {} {body}", self.index, answer.status));
    }

    /// Sends a request until it is not busy; the answer, and how long each part of it took.
    fn ask(&mut self, head: &str, body: &[u8], first: bool) -> Answer {
        loop {
            let mut stream = self.server.connect();
            let mut writer = stream.try_clone().unwrap();
            let started = Instant::now();
            let mut send = || {
                let _ = writer.write_all(head.as_bytes()).and_then(|()| writer.write_all(body));
                started.elapsed().as_secs_f64()
            };
            let mut bytes = Vec::new();
            let mut read = |sent: Option<f64>| {
                let mut byte = [0];
                let _ = stream.read_exact(&mut byte).map(|()| bytes.push(byte[0]));
                let begun = started.elapsed().as_secs_f64();
                let _ = stream.read_to_end(&mut bytes);
                (sent, begun, started.elapsed().as_secs_f64())
            };
            let (sent, begun, ended) = if first {
                let sent = send();
                read(Some(sent))
            } else {
                std::thread::scope(|scope| {
                    let sending = scope.spawn(send);
                    let (_, begun, ended) = read(None);
                    (sending.join().ok(), begun, ended)
                })
            };
            self.tally.sent += body.len() as u64;
            let answer = Answer::parse(bytes);
            if answer.status == 503 && answer.problem(503, "busy")["retry_after"].as_u64() >= Some(1) {
                self.tally.busy += 1;
                pause();
                continue;
            }
            let sent = sent.unwrap_or(begun).min(begun);
            for (phase, seconds) in [("1 send", sent), ("2 wait", begun - sent), ("4 read", ended - begun)] {
                self.tally.phases.entry(phase).or_default().push(seconds);
            }
            return answer;
        }
    }

    /// Checks a result stream.
    fn results(&mut self, answer: &Answer, tiles: u64, pixels: u64) {
        let (mut decoder, mut input, mut done, mut busy) = (ResultDecoder::new(), &answer.body[..], 0, 0);
        while answer.status == 200
            && let Ok(Some(message)) = decoder.next(&mut input)
        {
            match message {
                Message::Result(result) => {
                    done += 1;
                    self.tally.phases.entry("3 filter").or_default().push(result.report.seconds);
                }
                Message::Error { problem, .. } if problem.code == "busy" => busy += 1,
                _ => {}
            }
        }
        self.tally.busy += busy;
        if decoder.finish().is_err() || done + busy != tiles {
            self.unexpected(&format!("{done} results of {tiles} tiles"), answer);
            return;
        }
        self.tally.tiles += done;
        self.tally.pixels += if busy == 0 { pixels } else { 0 };
    }

    fn reads_as_it_sends(&mut self) -> &'static str {
        let (path, body, tiles, pixels) = self.stream(4);
        let answer = self.ask(&head("POST", &path, &[], body.len()), &body, false);
        self.results(&answer, tiles, pixels);
        "read as they send"
    }

    fn sends_first(&mut self) -> &'static str {
        let (path, body, tiles, pixels) = self.stream(4);
        let answer = self.ask(&head("POST", &path, &[], body.len()), &body, true);
        self.results(&answer, tiles, pixels);
        "send first"
    }

    fn compressed(&mut self) -> &'static str {
        let (path, body, tiles, pixels) = self.stream(4);
        let packed = zstd::encode_all(&body[..], 1).unwrap();
        let head = head("POST", &path, &["Content-Encoding: zstd"], packed.len());
        let answer = self.ask(&head, &packed, false);
        self.results(&answer, tiles, pixels);
        "compress"
    }

    fn picture(&mut self) -> &'static str {
        let (path, body, _, pixels) = self.stream(1);
        let accept = if self.turns.is_multiple_of(2) { "Accept: image/png" } else { "Accept: image/x-exr" };
        let answer = self.ask(&head("POST", &path, &[accept], body.len()), &body, false);
        if answer.status == 200 && answer.header("content-length") == Some(&answer.body.len().to_string()) {
            self.tally.tiles += 1;
            self.tally.pixels += pixels;
        } else {
            self.unexpected("a picture", &answer);
        }
        "want a picture"
    }

    /// Opens an image, sends its tiles, fetches it, and deletes it.
    fn image(&mut self) -> &'static str {
        let id = format!("{}-{}", self.index, self.turns);
        let side = Tiles::IMAGE;
        let json = format!(r#"{{"id": "{id}", "width": {side}, "height": {side}, "preset": "gaussian"}}"#);
        let opened = self.ask(&head("POST", "/v1/images", &[], json.len()), json.as_bytes(), false);
        let body = self.tiles.image.concat();
        let path = format!("/v1/images/{id}");
        let lines = loop {
            let answer = self.ask(&head("POST", &format!("{path}/tiles"), &[], body.len()), &body, false);
            let text = String::from_utf8_lossy(&answer.body).into_owned();
            if !text.contains("\"code\":\"busy\"") {
                break text;
            }
            self.tally.busy += 1;
        };
        let exr = self.ask(&head("GET", &format!("{path}/result.exr"), &[], 0), &[], false);
        let deleted = self.ask(&head("DELETE", &path, &[], 0), &[], false);
        let end = r#"{"errors":0,"state":"end","tiles":9}"#;
        if (opened.status, exr.status, deleted.status) == (201, 200, 204) && lines.trim_end().ends_with(end) {
            self.tally.tiles += 9;
            self.tally.pixels += u64::from(side * side);
        } else {
            self.tally.unexpected.push(format!("image: {opened:?} {lines} {} {}", exr.status, deleted.status));
        }
        "have an image stitched"
    }

    /// Brings a small tile at 200 kB a second.
    fn slow(&mut self) -> &'static str {
        let (side, tile) = &self.tiles.sizes[self.turns % 2];
        let mut stream = self.server.connect();
        let _ = stream.write_all(head("POST", "/v1/filter?preset=gaussian", &[], tile.len()).as_bytes());
        for piece in tile.chunks(4000) {
            std::thread::sleep(Duration::from_millis(20));
            if stream.write_all(piece).is_err() {
                break;
            }
        }
        let mut bytes = Vec::new();
        let _ = stream.read_to_end(&mut bytes);
        let answer = Answer::parse(bytes);
        if answer.status == 503 && answer.problem(503, "busy")["retry_after"].as_u64() >= Some(1) {
            self.tally.busy += 1;
        } else {
            self.results(&answer, 1, u64::from(side * side));
        }
        "are slow"
    }

    /// Goes away somewhere in a request, or before it has read the answer.
    fn vanishing(&mut self) -> &'static str {
        let (path, body, ..) = self.stream(1);
        let end = if self.turns.is_multiple_of(3) { body.len() } else { self.below(body.len() as u64) as usize };
        let mut stream = self.server.connect();
        let _ = stream.write_all(head("POST", &path, &[], body.len()).as_bytes());
        let _ = stream.write_all(&body[..end]);
        pause();
        "vanish"
    }

    /// Sends little that comes to much, and never reads; after a while it goes.
    fn silent(&mut self) -> &'static str {
        let body: Vec<u8> = (0..40).flat_map(|at| plain(256, 1, at)).collect();
        let mut stream = self.server.connect();
        let _ = stream.write_all(head("POST", "/v1/filter?preset=unfiltered", &[], body.len()).as_bytes());
        let _ = stream.write_all(&body);
        std::thread::sleep(Duration::from_secs(5));
        "never read"
    }
}
