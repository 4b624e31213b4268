//! A tile stream in, results out: `POST /v1/filter` and `POST /v1/images/{id}/tiles`.
//!
//! Until the first tile's samples are all here a failure is an HTTP status. From then on the answer has begun: failures
//! are messages in it, and it always ends with the number of tiles that were filtered and that were not.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use axum::{
    body::Body,
    extract::{Request, State},
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use rayon::ThreadPool;
use serde_json::json;
use tokio::{sync::watch, task::JoinSet};
use tracing::Instrument;

use super::{
    Shared,
    body::Frames,
    charge::{Charge, keep},
    entry::{Id, Opened},
    metrics::Phase,
    picture::{CorePixels, encode_png, write_file},
    problem::{Refusal, corners, internal},
    query::{Form, Parameters, attributes},
    receive::{Fault, Received, Receiver},
    results::{AROUND, Results, file_response},
    work::{blocking, stopped},
};
use crate::{
    admission::Permit,
    filter::{
        Execution, Filtered, Method, Rect, SampleTile, filter,
        plan::{Plan, Shape, plan},
    },
    image::{Outcome, keeping},
    stitch::ExrOptions,
    wire::{Header, Problem, TileReport, message},
};

/// Bytes of unread failures at most: nothing was reserved for them.
const MAX_UNPAID: u64 = 1 << 20;

/// One request: how to filter, and where results go.
pub(super) struct Call {
    pub(super) service: Shared,
    pub(super) method: Arc<Method>,
    pub(super) seed: u64,
    /// Whether what can have no effect is left out.
    leave_out: bool,
    pub(super) target: Target,
    /// Tiles of this request that are being worked on.
    busy: watch::Sender<usize>,
}

/// Where results go.
pub(super) enum Target {
    /// Back to the client.
    Client,
    /// Onto an image's canvas.
    Image {
        image: Opened,
        /// Whether a stored core made from other samples is replaced.
        replace: bool,
    },
}

/// A tile, filtered.
struct Done {
    filtered: Filtered,
    report: TileReport,
}

impl Call {
    fn new(service: Shared, method: Arc<Method>, seed: u64, leave_out: bool, target: Target) -> Self {
        Self { service, method, seed, leave_out, target, busy: watch::Sender::new(0) }
    }

    /// Waits until none of this request's tiles is being worked on.
    pub(super) async fn idle(&self) {
        // The sender lives as long as this does.
        let _ = self.busy.subscribe().wait_for(|&tiles| tiles == 0).await;
    }

    /// Says whether a tile with this header is wanted here.
    pub(super) fn check(&self, header: &Header) -> Result<(), Refusal> {
        match &self.target {
            Target::Client => Ok(()),
            Target::Image { image, .. } => image.check(header),
        }
    }

    /// Bytes of disk that what is said of a tile takes at most, until it is read.
    pub(super) fn result_bytes(&self, core: Rect) -> u64 {
        match &self.target {
            Target::Client => Results::bytes(core),
            Target::Image { .. } => AROUND,
        }
    }

    /// Bytes that a tile of this shape will need.
    pub(super) fn plan(&self, shape: &Shape) -> Plan {
        match &self.target {
            Target::Image { image, .. } if image.keeps_samples() => keeping(shape),
            _ => plan(shape, &self.method),
        }
    }

    /// Filters a tile; its samples, and the memory they took, are free afterwards.
    fn filter(
        &self,
        tile: SampleTile,
        mut held: Held,
        pool: &ThreadPool,
        stop: &AtomicBool,
    ) -> Result<(Done, Held), Refusal> {
        let started = Instant::now();
        let execution = Execution {
            seed: self.seed,
            pool: Some(pool),
            stop: Some(stop),
            leave_out: self.leave_out,
            simd: self.service.config.simd,
            ..Execution::default()
        };
        let filtered = filter(&tile, &self.method, &execution).map_err(|_| stopped())?;
        self.service.metrics.phase(Phase::Filter, started);
        held.free(tile, &self.service);
        let seconds = started.elapsed().as_secs_f64();
        let report = TileReport::new(&filtered.report, &self.method, self.seed, seconds);
        tracing::debug!(tile = %filtered.core, seconds, samples = report.samples, exact = report.exact, "tile filtered");
        Ok((Done { filtered, report }, held))
    }

    /// All that is done with a tile, on a thread that may block; says what became of it.
    fn process(
        &self,
        received: Received,
        results: &Results,
        pool: &ThreadPool,
        stop: &AtomicBool,
    ) -> Result<&'static str, Refusal> {
        if stop.load(Ordering::Relaxed) {
            return Err(stopped());
        }
        let geometry = *received.assembler.header().geometry();
        let Received { assembler, plan, permit, unread } = received;
        let mut held = Held { permit, output: plan.output };
        let tile = assembler.finish()?;
        match &self.target {
            Target::Client => {
                let (Done { filtered, report }, _held) = self.filter(tile, held, pool, stop)?;
                let image = [geometry.image().width, geometry.image().height];
                let began = Instant::now();
                results.append(Some(unread), |mut out| message::encode_result(image, &filtered, &report, &mut out))?;
                self.service.metrics.phase(Phase::Write, began);
                Ok("filtered")
            }
            Target::Image { image, replace } => {
                let mut began = Instant::now();
                let state = match image.offer(&tile, *replace, &self.service)? {
                    Outcome::Repeated => {
                        held.free(tile, &self.service);
                        "repeated"
                    }
                    Outcome::Stored => {
                        held.free(tile, &self.service);
                        "stored"
                    }
                    Outcome::Filter(claim) => {
                        let (Done { filtered, report }, _held) = self.filter(tile, held, pool, stop)?;
                        began = Instant::now();
                        image.add(claim, &filtered, report.seconds)?
                    }
                };
                image.flush(&self.service)?;
                if state != "repeated" {
                    // Until it is durable: that is what takes the time.
                    self.service.metrics.phase(Phase::Write, began);
                }
                let line = json!({ "tile": corners(geometry.core()), "state": state });
                results.append(Some(unread), |out| writeln!(out, "{line}"))?;
                Ok(state)
            }
        }
    }

    /// Writes a failure in a result's place.
    async fn report(&self, results: &Arc<Results>, tile: Option<Rect>, problem: Box<Problem>) {
        tracing::debug!(tile = tile.map(tracing::field::display), code = problem.code, "tile refused");
        self.service.metrics.problem(&problem.code);
        self.service.metrics.tile("failed");
        let (results, lines) = (Arc::clone(results), self.lines());
        let written = blocking(move || {
            results.append(None, |mut out| {
                if lines {
                    let line = json!({ "tile": tile.map(corners), "state": "error", "problem": problem });
                    return writeln!(out, "{line}");
                }
                message::encode_error(tile, &problem, &mut out)
            })
        });
        log(written.await);
    }

    /// Writes the end of a result stream. If even that fails the connection is cut, which shows as well.
    async fn end(&self, results: Arc<Results>, tiles: u64, errors: u64) {
        let lines = self.lines();
        let written = blocking(move || {
            results.append(None, |mut out| {
                if lines {
                    let line = json!({ "state": "end", "tiles": tiles, "errors": errors });
                    return writeln!(out, "{line}");
                }
                message::encode_end(tiles, errors, &mut out)
            })?;
            results.finish();
            Ok(())
        });
        log(written.await);
    }

    const fn lines(&self) -> bool {
        matches!(self.target, Target::Image { .. })
    }
}

/// Memory that a tile holds, and how much of it its result needs.
struct Held {
    permit: Permit,
    output: u64,
}

impl Held {
    /// Gives up the samples, and the memory they took.
    fn free(&mut self, tile: SampleTile, service: &Shared) {
        service.spare.keep(tile, &mut self.permit, self.output);
    }
}

/// Says what cannot be said to the client.
fn log(written: Result<io::Result<()>, Refusal>) {
    if let Ok(Err(error)) = written {
        internal(format_args!("results cannot be written: {error}"));
    }
}

/// `POST /v1/filter`.
pub(super) async fn filter_stream(
    State(service): State<Shared>,
    charge: Charge,
    request: Request,
) -> Result<Response, Refusal> {
    let form = Form::accepted(request.headers())?;
    let mut parameters = Parameters::of_query(request.uri())?;
    let leave_out = parameters.leave_out()?;
    let (method, seed) = parameters.method()?;
    let call = Call::new(service, Arc::new(method), seed, leave_out, Target::Client);
    match form {
        Form::Messages => answer(call, charge, request, form.media()).await,
        Form::Exr | Form::Png => single(call, charge, request, form).await,
    }
}

/// `POST /v1/images/{id}/tiles`.
pub(super) async fn image_tiles(
    State(service): State<Shared>,
    id: Id,
    charge: Charge,
    request: Request,
) -> Result<Response, Refusal> {
    let images = Arc::clone(&service);
    let image = blocking(move || images.images.find(&id)).await??;
    let mut parameters = Parameters::of_query(request.uri())?;
    let replace = parameters.flag("replace")?;
    parameters.done("replace")?;
    let (method, seed, leave_out) = image.method();
    let call = Call::new(service, method, seed, leave_out, Target::Image { image, replace });
    answer(call, charge, request, "application/x-ndjson").await
}

fn receiver(call: &Call, charge: Charge, request: Request) -> Result<Receiver, Refusal> {
    let (parts, body) = request.into_parts();
    Ok(Receiver::new(Frames::new(&parts.headers, body, charge, call.service.pace())?))
}

/// The first tile; a failure is the answer to the whole request.
async fn first(call: &Call, receiver: &mut Receiver) -> Result<Received, Refusal> {
    match receiver.next(call).await {
        Ok(Some(received)) => Ok(received),
        // A stream without tiles has failed to decode.
        Ok(None) => Err(internal("a stream without tiles was accepted").into()),
        Err(fault) => Err(fault.into_refusal()),
    }
}

/// Answers with a result stream.
async fn answer(call: Call, charge: Charge, request: Request, media: &'static str) -> Result<Response, Refusal> {
    let mut receiver = receiver(&call, charge, request)?;
    let received = first(&call, &mut receiver).await?;
    let folder = call.service.config.data_dir.clone();
    let (results, reader) = blocking(move || Results::new(&folder)).await??;
    // The body is dropped when all is sent, or when the client has gone.
    let session = session(Arc::new(call), receiver, received, Arc::new(results));
    let guard = Guard(tokio::spawn(session.in_current_span()));
    let body = keep(Body::from_stream(reader), guard);
    Ok((StatusCode::OK, [(header::CONTENT_TYPE, media)], body).into_response())
}

/// Ends a session, and with it its jobs, when it is dropped.
struct Guard(tokio::task::JoinHandle<()>);

impl Drop for Guard {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Reads and filters tiles until the stream ends. Results are written as they are done, in any order.
async fn session(call: Arc<Call>, mut receiver: Receiver, received: Received, results: Arc<Results>) {
    let started = Instant::now();
    let (mut tiles, mut errors) = (0, 0);
    let mut count = |fine: Option<Result<bool, _>>| match fine {
        Some(Ok(true)) => tiles += 1,
        _ => errors += 1,
    };
    let mut jobs: JoinSet<bool> = JoinSet::new();
    let mut next = Ok(Some(received));
    loop {
        match next {
            Ok(Some(received)) => {
                call.busy.send_modify(|tiles| *tiles += 1);
                let job = job(Arc::clone(&call), received, Arc::clone(&results));
                jobs.spawn(job.in_current_span());
                // One more than can run, so that there always is one to run.
                if jobs.len() > call.service.work.jobs() {
                    count(jobs.join_next().await);
                }
            }
            Ok(None) => break,
            Err(Fault::Tile(core, refusal)) => {
                call.report(&results, Some(core), refusal.0).await;
                count(Some(Ok(false)));
            }
            Err(Fault::Stream(tile, refusal)) => {
                // All that came before is done first: nothing follows this error.
                while let Some(fine) = jobs.join_next().await {
                    count(Some(fine));
                }
                call.report(&results, tile, refusal.0).await;
                count(Some(Ok(false)));
                break;
            }
        }
        next = if results.unpaid() > MAX_UNPAID { Err(Fault::unread()) } else { receiver.next(&call).await };
    }
    while let Some(fine) = jobs.join_next().await {
        count(Some(fine));
    }
    tracing::info!(tiles, errors, seconds = started.elapsed().as_secs_f64(), "tile stream done");
    call.end(results, tiles, errors).await;
}

/// Counts what becomes of a tile when it is dropped, which without a word is that its client went away.
struct Fate<'a>(Option<&'static str>, &'a Call);

impl<'a> Fate<'a> {
    const fn new(call: &'a Call) -> Self {
        Self(Some("stopped"), call)
    }
}

impl Drop for Fate<'_> {
    fn drop(&mut self) {
        if let Some(outcome) = self.0 {
            self.1.service.metrics.tile(outcome);
        }
    }
}

/// One tile, from its samples to its place among the results. Says whether it went well.
async fn job(call: Arc<Call>, received: Received, results: Arc<Results>) -> bool {
    let core = received.core();
    let (inner, out) = (Arc::clone(&call), Arc::clone(&results));
    let mut fate = Fate::new(&call);
    let ready = Instant::now();
    let done = call.service.work.run(move |pool, stop| {
        inner.service.metrics.phase(Phase::Turn, ready);
        inner.process(received, &out, pool, stop)
    });
    let done = done.await;
    call.busy.send_modify(|tiles| *tiles -= 1);
    match done {
        Ok(outcome) => {
            fate.0 = Some(outcome);
            true
        }
        Err(refusal) => {
            // Whoever reports it counts it.
            fate.0 = None;
            call.report(&results, Some(core), refusal.0).await;
            false
        }
    }
}

/// Answers with a picture of a single tile.
async fn single(call: Call, charge: Charge, request: Request, form: Form) -> Result<Response, Refusal> {
    let mut receiver = receiver(&call, charge, request)?;
    let received = first(&call, &mut receiver).await?;
    receiver.end().await?;
    let call = Arc::new(call);
    let inner = Arc::clone(&call);
    let mut fate = Fate::new(&call);
    let ready = Instant::now();
    let done = call.service.work.run(move |pool, stop| {
        inner.service.metrics.phase(Phase::Turn, ready);
        picture(&inner, received, form, pool, stop)
    });
    let done = done.await;
    fate.0 = Some(if done.is_ok() { "filtered" } else { "failed" });
    Ok(file_response(done?, form.media()).await?)
}

fn picture(
    call: &Call,
    received: Received,
    form: Form,
    pool: &ThreadPool,
    stop: &AtomicBool,
) -> Result<(std::fs::File, Permit), Refusal> {
    let Received { assembler, plan, permit, unread } = received;
    let geometry = *assembler.header().geometry();
    let held = Held { permit, output: plan.output };
    let (done, _held) = call.filter(assembler.finish()?, held, pool, stop)?;
    let mut options = ExrOptions { attributes: attributes(&call.method, call.seed), ..ExrOptions::default() };
    if geometry.core() != geometry.image() {
        options.attributes.insert("rpfd:tile".into(), geometry.core().to_string());
    }
    let pixels = CorePixels(&done.filtered);
    write_file(&call.service.config.data_dir, unread, |out| match form {
        Form::Png => encode_png(&pixels, out),
        _ => Ok(crate::stitch::exr::encode(&pixels, &options, out).map(drop)?),
    })
}
