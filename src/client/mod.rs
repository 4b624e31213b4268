//! HTTP client of the service, for `rpfd post` and `rpfd demo`: blocking, with retries.
//!
//! Every call can be repeated without harm: an image is opened under an id of the caller's, and a tile that arrives twice
//! is `repeated`. So whatever may pass (no connection, a cut one, a busy service) is tried again: after a pause that
//! doubles each time and is spread by a hash, so that many clients do not come back at once, and that is never shorter
//! than the service's `Retry-After`. What will not pass is an error at once.

mod retry;

use crate::{filter::Rect, wire::Problem};
use retry::{Attempt, Retry};
use serde_json::{Value, json};
use std::{
    io::{self, Read},
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};
use ureq::{
    Agent, Body, SendBody,
    http::{HeaderValue, Request, Response, header},
    middleware::MiddlewareNext,
    tls::{RootCerts, TlsConfig},
};

/// Most bytes of an answer that is no file.
const MAX_ANSWER: u64 = 16 << 20;

/// A call that failed for good.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// The service said no.
    #[error("the service refused{}: {}", tile.map_or_else(String::new, |tile| format!(" tile {tile}")), said(problem))]
    Refused {
        /// The tile, if it was about one.
        tile: Option<Rect>,
        /// What it said.
        problem: Box<Problem>,
    },
    /// No answer, however often it was tried.
    #[error("{url}: no answer in {attempts} attempts, the last time: {why}")]
    Unreachable {
        /// What was asked for.
        url: String,
        /// How often.
        attempts: u32,
        /// What happened the last time.
        why: String,
    },
    /// An answer that a service of this kind does not give.
    #[error("{url}: {why}")]
    Answer {
        /// What was asked for.
        url: String,
        /// What is wrong with the answer.
        why: String,
    },
    /// This is no address of a service.
    #[error("{0:?} is no address of a service: it must start with http:// or https://")]
    Url(String),
    /// The token cannot be one: it has a control character in it.
    #[error("the token cannot be sent: it has characters that no header may have")]
    Token,
    /// The answer could not be written down.
    #[error("cannot keep the answer: {0}")]
    Output(io::Error),
    /// The caller wanted to stop.
    #[error("interrupted")]
    Stopped,
}

impl ClientError {
    /// A stable code; of what the service refused, the service's.
    pub fn code(&self) -> &str {
        match self {
            Self::Refused { problem, .. } if problem.code.is_empty() => "refused",
            Self::Refused { problem, .. } => &problem.code,
            Self::Unreachable { .. } => "unreachable",
            Self::Answer { .. } => "bad_answer",
            Self::Url(_) => "bad_url",
            Self::Token => "bad_token",
            Self::Output(_) => "output_io",
            Self::Stopped => "interrupted",
        }
    }
}

fn said(problem: &Problem) -> String {
    match (&*problem.title, &*problem.detail) {
        ("", "") => format!("HTTP status {}", problem.status),
        (title, "") => title.to_owned(),
        (_, detail) => detail.to_owned(),
    }
}

/// What became of a tile that was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// It is filtered.
    Filtered,
    /// It is kept safe and will be filtered.
    Stored,
    /// It was there already.
    Repeated,
}

/// A connection to a service; threads may share it.
#[derive(Debug)]
pub struct Client {
    agent: Agent,
    base: String,
    retry: Retry,
}

impl Client {
    /// A client of the service at this address, like `http://localhost:8080`. Calls are tried `attempts` times at most
    /// (0 means once), and no more once `stop` is set. Nothing is sent yet.
    pub fn new(base: &str, attempts: u32, stop: Arc<AtomicBool>) -> Result<Self, ClientError> {
        Self::with_token(base, attempts, stop, None)
    }

    /// As [`new`](Self::new), with the bearer token that the service wants to see.
    pub fn with_token(
        base: &str,
        attempts: u32,
        stop: Arc<AtomicBool>,
        token: Option<&str>,
    ) -> Result<Self, ClientError> {
        let known = ["http://", "https://"].iter().any(|scheme| base.len() > scheme.len() && base.starts_with(scheme));
        if !known {
            return Err(ClientError::Url(base.to_owned()));
        }
        // Filtering a tile may take long, and so may waiting for the service's memory; silence between bytes may not.
        let config = Agent::config_builder()
            .http_status_as_error(false)
            // The certificates that this system trusts; the library itself trusts none.
            .tls_config(TlsConfig::builder().root_certs(RootCerts::PlatformVerifier).build())
            .user_agent(concat!("rpfd/", env!("CARGO_PKG_VERSION")))
            .timeout_connect(Some(Duration::from_secs(10)))
            .timeout_send_body(Some(Duration::from_secs(600)))
            .timeout_recv_response(Some(Duration::from_secs(1800)))
            .timeout_recv_body(Some(Duration::from_secs(3600)));
        // A proxy of the environment's cannot reach what is on this machine.
        let local = ["://127.", "://localhost", "://[::1]"].iter().any(|host| base.contains(host));
        let config = if local { config.proxy(None) } else { config };
        let config = match token {
            Some(token) => {
                let mut value = HeaderValue::try_from(format!("Bearer {token}")).map_err(|_| ClientError::Token)?;
                value.set_sensitive(true);
                config.middleware(move |mut request: Request<SendBody>, next: MiddlewareNext| {
                    request.headers_mut().insert(header::AUTHORIZATION, value.clone());
                    next.handle(request)
                })
            }
            None => config,
        };
        let agent = config.build().new_agent();
        let base = base.trim_end_matches('/').to_owned();
        Ok(Self { agent, base, retry: Retry { attempts: attempts.max(1), stop } })
    }

    /// Opens an image under this id, or finds it open just so. `method` holds preset, seed and parameters by name.
    pub fn open_image(&self, id: &str, size: [u32; 2], method: Value) -> Result<(), ClientError> {
        let url = format!("{}/v1/images", self.base);
        let mut body = method;
        body["id"] = id.into();
        [body["width"], body["height"]] = size.map(Value::from);
        let body = body.to_string();
        self.retry.call(&url, |_| {
            let request = self.agent.post(&url).content_type("application/json");
            let mut response = accepted(&url, request.send(&body))?;
            let answer: Value = serde_json::from_slice(&read(&url, &mut response)?).unwrap_or_default();
            match answer["id"].as_str() {
                Some(found) if found == id => Ok(()),
                _ => Err(bad(&url, "the answer to opening an image lacks its id: is this an rpfd service?")),
            }
        })
    }

    /// Sends a tile, header and planes, to an open image, and waits until the service has it.
    pub fn send_tile(&self, id: &str, core: Rect, bytes: &[u8]) -> Result<State, ClientError> {
        let url = format!("{}/v1/images/{id}/tiles", self.base);
        self.retry.call(&format!("{url}#{core}"), |_| {
            let request = self.agent.post(&url).content_type("application/msgpack");
            let mut response = accepted(&url, request.send(bytes)).map_err(|attempt| attempt.of_tile(core))?;
            let answer = read(&url, &mut response)?;
            for line in answer.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
                let Ok(line) = serde_json::from_slice::<Value>(line) else {
                    // A line that is cut off, as the whole answer is then.
                    return Err(Attempt::Again { why: "the answer was cut off".to_owned(), after: None });
                };
                let problem = line.get("problem").map(|problem| serde_json::from_value::<Problem>(problem.clone()));
                if let Some(Ok(problem)) = problem {
                    return Err(refused(problem, None).of_tile(core));
                }
                if line["tile"] != json!([core.x, core.y, core.width, core.height]) {
                    continue;
                }
                match line["state"].as_str() {
                    Some("filtered") => return Ok(State::Filtered),
                    Some("stored") => return Ok(State::Stored),
                    Some("repeated") => return Ok(State::Repeated),
                    _ => {}
                }
            }
            Err(Attempt::Again { why: format!("the answer does not say what became of tile {core}"), after: None })
        })
    }

    /// The stitched image. `query` says how it is to be written; `begin` makes a new, empty file for each attempt, and
    /// `write` adds to it.
    pub fn fetch_exr<F>(
        &self,
        id: &str,
        query: &[(&str, String)],
        begin: impl Fn() -> Result<F, ClientError>,
        write: impl Fn(&mut F, &[u8]) -> io::Result<()>,
    ) -> Result<F, ClientError> {
        let url = format!("{}/v1/images/{id}/result.exr", self.base);
        self.retry.call(&url, |_| {
            let request = query.iter().fold(self.agent.get(&url), |request, (name, value)| request.query(name, value));
            let response = accepted(&url, request.call())?;
            let mut file = begin().map_err(Attempt::Never)?;
            copy(response.into_body().into_reader(), |bytes| write(&mut file, bytes))?;
            Ok(file)
        })
    }

    /// Has the service forget an image.
    pub fn delete_image(&self, id: &str) -> Result<(), ClientError> {
        let url = format!("{}/v1/images/{id}", self.base);
        self.retry.call(&url, |_| accepted(&url, self.agent.delete(&url).call()).map(drop))
    }
}

/// The answer, if the service did what it was asked to.
fn accepted(url: &str, answer: Result<Response<Body>, ureq::Error>) -> Result<Response<Body>, Attempt> {
    let mut response = answer.map_err(|error| match error {
        ureq::Error::BadUri(_) | ureq::Error::Http(_) | ureq::Error::TooManyRedirects | ureq::Error::RedirectFailed => {
            bad(url, &error.to_string())
        }
        error => Attempt::Again { why: error.to_string(), after: None },
    })?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let after = response.headers().get(header::RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    let body = read(url, &mut response).unwrap_or_default();
    let mut problem = serde_json::from_slice(&body).unwrap_or_else(|_| {
        let reason = status.canonical_reason().unwrap_or("no reason given");
        Problem::new(status.as_u16(), "", format!("HTTP status {} ({reason}) from {url}", status.as_u16()), "")
    });
    problem.status = status.as_u16();
    Err(refused(problem, after))
}

/// Whether to come again after this problem.
fn refused(problem: Problem, after: Option<u64>) -> Attempt {
    let after = after.or_else(|| problem.more.get("retry_after").and_then(Value::as_u64));
    let passing = matches!(problem.status, 408 | 425 | 429 | 502 | 503 | 504);
    Attempt::Refused { tile: None, problem: Box::new(problem), passing, after: after.map(Duration::from_secs) }
}

fn bad(url: &str, why: &str) -> Attempt {
    Attempt::Never(ClientError::Answer { url: url.to_owned(), why: why.to_owned() })
}

/// An answer that fits in memory.
fn read(url: &str, response: &mut Response<Body>) -> Result<Vec<u8>, Attempt> {
    let mut answer = Vec::new();
    let mut body = response.body_mut().as_reader().take(MAX_ANSWER + 1);
    body.read_to_end(&mut answer).map_err(|error| Attempt::Again { why: error.to_string(), after: None })?;
    if answer.len() as u64 > MAX_ANSWER { Err(bad(url, "the answer is too long")) } else { Ok(answer) }
}

/// An answer of any length. What cannot be read may come another time, what cannot be written will not.
fn copy(mut from: impl Read, mut to: impl FnMut(&[u8]) -> io::Result<()>) -> Result<(), Attempt> {
    let mut buffer = vec![0; 64 << 10];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(len) => to(&buffer[..len]).map_err(|error| Attempt::Never(ClientError::Output(error)))?,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(Attempt::Again { why: error.to_string(), after: None }),
        }
    }
}
