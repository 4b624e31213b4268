//! The service over HTTP: the real binary on a free port.

mod answers;
mod bad_input;
mod clients;
mod codes;
mod config;
mod curl;
mod deploy;
mod durable;
pub(crate) mod exact;
pub(crate) mod flow;
mod http2;
mod images;
mod index;
mod limits;
pub(crate) mod neighbors;
mod observe;
mod openapi;
mod proxy;
mod recovering;
mod stop;
mod tokens;
mod too_large;

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

use rpfd::{
    filter::{Counts, Execution, Plane, Rect, SampleTile, TileGeometry},
    synth::Scene,
    wire::{Format, Header, Message, ResultDecoder, encode_tile},
};
use serde_json::Value;

/// No deadline ends anything that a test does not mean to be ended, however slow the machine: a test that is about one
/// sets it.
const PATIENT: [(&str, &str); 4] = [
    ("RPFD_HEADER_DEADLINE", "10m"),
    ("RPFD_IDLE_DEADLINE", "10m"),
    ("RPFD_QUEUE_DEADLINE", "10m"),
    ("RPFD_SHUTDOWN_DEADLINE", "10m"),
];
/// What a machine that stalls may take for anything; it is waited for that long only if it does not come.
const LATEST: Duration = Duration::from_secs(600);

/// A running service, which ends with this.
pub(crate) struct Server {
    child: Child,
    pub(crate) address: String,
    /// Where its metrics are, if it was told to have any.
    metrics: Option<String>,
    folder: Option<tempfile::TempDir>,
}

impl Server {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        Self::start_logging(arguments, None)
    }

    /// As `start`, with the log in a file.
    pub(crate) fn start_logging(arguments: &[&str], log: Option<&Path>) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rpfd"));
        command.stderr(log.map_or_else(Stdio::inherit, |path| std::fs::File::create(path).unwrap().into()));
        Self::start_by(command, tempfile::tempdir().unwrap(), arguments)
    }

    /// One that finds what was in its data folder before, and knows it.
    pub(crate) fn start_in(folder: tempfile::TempDir, arguments: &[&str]) -> Self {
        let server = Self::start_by(Command::new(env!("CARGO_BIN_EXE_rpfd")), folder, arguments);
        server.wait_recovered();
        server
    }

    /// Waits until it knows the images that were there.
    pub(crate) fn wait_recovered(&self) {
        wait_until("the images to be recovered", || {
            let ready = self.get("/readyz");
            ready.status == 200 || ready.json()["code"] != "recovering"
        });
    }

    /// One that is started by another program, whose arguments it follows.
    pub(crate) fn start_by(mut command: Command, folder: tempfile::TempDir, arguments: &[&str]) -> Self {
        let mut child = command
            .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder.path())
            .args(arguments)
            .env("RUST_LOG", if arguments.contains(&"--log-format") { "info" } else { "warn" })
            .envs(PATIENT)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut address = || lines.next()?.unwrap().rsplit("//").next().map(ToOwned::to_owned);
        let (first, second) = (address().expect("the service did not start"), arguments.contains(&"--metrics-listen"));
        let metrics = if second { address().map(|address| address.replace("/metrics", "")) } else { None };
        Self { child, address: first, metrics, folder: Some(folder) }
    }

    /// What it answers where its metrics are.
    pub(crate) fn beside(&self, path: &str) -> Answer {
        let mut stream = TcpStream::connect(self.metrics.as_ref().unwrap()).unwrap();
        stream.write_all(head("GET", path, &[], 0).as_bytes()).unwrap();
        Answer::read(&mut stream)
    }

    /// What it counts now.
    pub(crate) fn metrics(&self) -> String {
        let answer = self.beside("/metrics");
        assert_eq!(answer.header("content-type"), Some("application/openmetrics-text; version=1.0.0; charset=utf-8"));
        String::from_utf8(answer.body).unwrap()
    }

    /// The value of one of these, with its labels.
    pub(crate) fn metric(&self, name: &str) -> Option<f64> {
        let text = self.metrics();
        text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok())
    }

    pub(crate) fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args([name, &id]).status().unwrap().success());
    }

    pub(crate) fn data_dir(&self) -> &Path {
        self.folder.as_ref().unwrap().path()
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Kills it at once, and gives what it has left.
    pub(crate) fn kill(mut self) -> tempfile::TempDir {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.folder.take().unwrap()
    }

    pub(crate) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(LATEST)).unwrap();
        stream.set_write_timeout(Some(LATEST)).unwrap();
        stream
    }

    /// A request, all of it sent while the answer is read.
    pub(crate) fn call(&self, method: &str, path: &str, headers: &[&str], body: &[u8]) -> Answer {
        let mut stream = self.connect();
        let mut writer = stream.try_clone().unwrap();
        // At once: a small body does not come later than its head.
        let request = [head(method, path, headers, body.len()).as_bytes(), body].concat();
        std::thread::scope(|scope| {
            // An early answer may close the connection under us.
            scope.spawn(move || writer.write_all(&request));
            Answer::read(&mut stream)
        })
    }

    /// Sends a request at once, of whose body of this length so much comes. The service may close its end early.
    pub(crate) fn send(&self, path: &str, headers: &[&str], body: &[u8], length: usize) -> TcpStream {
        let mut stream = self.connect();
        let _ = stream.write_all(&[head("POST", path, headers, length).as_bytes(), body].concat());
        stream
    }

    /// The same, once the service has let the request in: it asks for the body then.
    pub(crate) fn begin(&self, path: &str, headers: &[&str], body: &[u8], length: usize) -> TcpStream {
        self.try_begin(path, headers, body, length).expect("a request is let in")
    }

    /// The same, unless it is not let in.
    pub(crate) fn try_begin(&self, path: &str, headers: &[&str], body: &[u8], length: usize) -> Option<TcpStream> {
        const GO_ON: &[u8] = b"HTTP/1.1 100 Continue\r\n\r\n";
        let mut stream = self.send(path, &[headers, &["Expect: 100-continue"]].concat(), &[], length);
        let mut answer = [0; GO_ON.len()];
        stream.read_exact(&mut answer).ok().filter(|()| answer == GO_ON)?;
        stream.write_all(body).unwrap();
        Some(stream)
    }

    pub(crate) fn get(&self, path: &str) -> Answer {
        self.call("GET", path, &[], &[])
    }

    pub(crate) fn post(&self, path: &str, body: &[u8]) -> Answer {
        self.call("POST", path, &[], body)
    }

    /// Tells it to stop, and says how it ended.
    pub(crate) fn terminate(self) -> std::process::ExitStatus {
        self.terminated().0
    }

    /// The same, and gives what it has left.
    pub(crate) fn terminated(mut self) -> (std::process::ExitStatus, tempfile::TempDir) {
        self.signal("-TERM");
        (self.child.wait().unwrap(), self.folder.take().unwrap())
    }

    /// Says how it ended, when it does.
    pub(crate) fn ended(mut self) -> std::process::ExitStatus {
        self.child.wait().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(crate) fn head(method: &str, path: &str, headers: &[&str], length: usize) -> String {
    let headers: String = headers.iter().map(|header| format!("{header}\r\n")).collect();
    format!("{method} {path} HTTP/1.1\r\nHost: test\r\nConnection: close\r\n{headers}Content-Length: {length}\r\n\r\n")
}

#[derive(Debug)]
pub(crate) struct Answer {
    pub(crate) status: u16,
    pub(crate) headers: Vec<(String, String)>,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    /// Reads an answer up to the end of the connection.
    pub(crate) fn read(stream: &mut TcpStream) -> Self {
        let mut bytes = Vec::new();
        // A connection that is reset after the answer is as good as one that ends.
        let _ = stream.read_to_end(&mut bytes);
        Self::parse(bytes)
    }

    pub(crate) fn parse(mut bytes: Vec<u8>) -> Self {
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").expect("an answer");
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let mut lines = head.lines();
        let status = lines.next().unwrap().split(' ').nth(1).unwrap().parse().unwrap();
        let headers: Vec<(String, String)> = lines
            .map(|line| line.split_once(": ").unwrap())
            .map(|(name, value)| (name.to_ascii_lowercase(), value.to_owned()))
            .collect();
        let mut body = bytes.split_off(end + 4);
        if headers.iter().any(|(name, value)| name == "transfer-encoding" && value == "chunked") {
            body = unchunked(&body);
        }
        Self { status, headers, body }
    }

    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(n, _)| n == name).map(|(_, value)| value.as_str())
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|_| panic!("{self:?}"))
    }

    /// The lines of NDJSON.
    pub(crate) fn lines(&self) -> Vec<Value> {
        assert_eq!(self.status, 200, "{}", String::from_utf8_lossy(&self.body));
        assert_eq!(self.header("content-type"), Some("application/x-ndjson"));
        self.body.split(|&b| b == b'\n').filter(|l| !l.is_empty()).map(|l| serde_json::from_slice(l).unwrap()).collect()
    }

    /// The messages of a result stream, which must be whole.
    pub(crate) fn messages(&self) -> Vec<Message> {
        assert_eq!(self.status, 200, "{}", String::from_utf8_lossy(&self.body));
        assert_eq!(self.header("content-type"), Some("application/msgpack"));
        let (mut decoder, mut input, mut messages) = (ResultDecoder::new(), &self.body[..], Vec::new());
        while let Some(message) = decoder.next(&mut input).unwrap() {
            messages.push(message);
        }
        assert!(matches!(messages.last(), Some(Message::End { .. })), "no end: {messages:?}");
        messages
    }

    /// Checks that it is a problem of this status and code, and gives it.
    #[track_caller]
    pub(crate) fn problem(&self, status: u16, code: &str) -> Value {
        let text = String::from_utf8_lossy(&self.body);
        assert_eq!(self.status, status, "{text}");
        assert_eq!(self.header("content-type"), Some("application/problem+json"), "{text}");
        let problem = self.json();
        assert_eq!((problem["code"].as_str(), problem["status"].as_u64()), (Some(code), Some(status.into())), "{text}");
        assert!(!problem["detail"].as_str().unwrap().is_empty());
        codes::check_documented(code, status);
        problem
    }
}

/// Whether a tool is there; where it must be, it is.
pub(crate) fn has(tool: &str, argument: &str) -> bool {
    match Command::new(tool).arg(argument).stdout(Stdio::null()).stderr(Stdio::null()).status() {
        Ok(_) => true,
        Err(error) if std::env::var_os("RPFD_CI").is_none() => {
            eprintln!("skipped: {tool} cannot be run: {error}");
            false
        }
        Err(error) => panic!("{tool} cannot be run: {error}"),
    }
}

/// Waits until something is so.
#[track_caller]
pub(crate) fn wait_until(what: &str, mut so: impl FnMut() -> bool) {
    let started = std::time::Instant::now();
    while !so() {
        assert!(started.elapsed() < LATEST, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn unchunked(mut bytes: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    loop {
        let line = bytes.windows(2).position(|w| w == b"\r\n").expect("the answer was cut off");
        let size = usize::from_str_radix(std::str::from_utf8(&bytes[..line]).unwrap(), 16).unwrap();
        if size == 0 {
            return body;
        }
        body.extend_from_slice(&bytes[line + 2..line + 2 + size]);
        bytes = &bytes[line + 4 + size..];
    }
}

/// Samples of the scene that has everything, 4 in each pixel.
pub(crate) fn samples(image: [u32; 2], core: Rect, halo: u32, seed: u64) -> SampleTile {
    let geometry = TileGeometry::with_halo(image, core, halo).unwrap();
    let execution = Execution { seed, ..Execution::default() };
    Scene::by_name("all").unwrap().tile(geometry, 4, &execution).unwrap()
}

/// The same with a halo whose samples are others than those of the cores around it.
pub(crate) fn contradicting(image: [u32; 2], core: Rect, halo: u32) -> SampleTile {
    let [right, wrong] = [1, 2].map(|seed| samples(image, core, halo, seed));
    let window = right.geometry().window();
    let pixels = (window.y..window.bottom()).flat_map(|y| (window.x..window.right()).map(move |x| (x, y)));
    let owners: Vec<&SampleTile> = pixels.map(|(x, y)| if core.contains(x, y) { &right } else { &wrong }).collect();
    let plane = |plane| {
        let samples =
            owners.iter().enumerate().flat_map(|(pixel, tile)| right.samples_of(pixel).map(move |s| (tile, s)));
        Plane::Values(samples.map(|(tile, sample)| tile.value(plane, sample)).collect())
    };
    let planes = (0..right.channels().planes()).map(plane).collect();
    SampleTile::new(*right.geometry(), right.channels().clone(), Counts::Uniform(4), planes).unwrap()
}

pub(crate) fn encode(tile: &SampleTile) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode_tile(&Header::of(tile, Format::F32).unwrap(), tile, &mut bytes).unwrap();
    bytes
}

pub(crate) fn tile(image: [u32; 2], core: Rect, halo: u32) -> Vec<u8> {
    encode(&samples(image, core, halo, 1))
}

/// A small image as one tile.
pub(crate) fn whole(side: u32) -> Vec<u8> {
    tile([side, side], Rect::new(0, 0, side, side), 0)
}
