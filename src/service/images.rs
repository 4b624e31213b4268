//! Images that are being assembled: `/v1/images` and what is below it, but for the tiles that come in.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Write},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use axum::{
    Json,
    extract::{Request, State},
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use serde_json::{Value, json};

use super::{
    Shared,
    auth::Owner,
    body::Frames,
    charge::Charge,
    entry::{Id, Opened, Reading, no_image},
    picture::{encode_png, write_file},
    problem::{Refusal, corners},
    query::{Form, NoQuery, Parameters, attributes},
    regions,
    results::file_response,
    work::blocking,
};
use crate::{
    admission::{AdmissionError, Permit},
    filter::{Rect, TileGeometry, geometry::Halo, samples::MAX_SAMPLES_PER_PIXEL},
    image::{Announced, Description, Image, Inner, RegionState, description::channels_from_json, disk_bytes},
    stitch::{CanvasError, ExrOptions, Pixels, StitchError, StoredPixels, exr},
    wire::{
        Problem, TileReport,
        message::{ReplacedCounts, WorkCounts},
    },
};

/// Most bytes of the JSON that opens an image.
const MAX_JSON: usize = 64 << 10;
/// Bytes of memory that each byte of it takes at most: an object of nothing has a list of eleven places.
const JSON_GROWS: u64 = 128;
/// Most missing regions that a problem lists; it says how many there are.
const MAX_LISTED: usize = 1000;
/// Bytes of memory that looking for what is missing takes for each tile, at most.
const LOOKING: u64 = 192;
/// Bytes of memory that the summary of an image takes at most.
const SUMMARY: u64 = 8 << 10;
/// Of what a region waits for, this much is listed.
const MAX_WAITED: usize = 16;

fn open_refused(detail: String) -> Refusal {
    Refusal::new(StatusCode::BAD_REQUEST, "bad_parameter", "The image cannot be opened", detail)
}

/// What can be said of an image in few words; when it expires its owner knows.
pub(super) fn summary(id: &Id, image: &Image) -> Value {
    let (description, inner) = (image.description(), image.read());
    let stitcher = inner.stitcher();
    let mut summary = json!({
        "id": id.0,
        "width": description.size[0],
        "height": description.size[1],
        "preset": description.method.preset_name(),
        "seed": description.seed,
        "parameters": description.method.parameters().into_iter().collect::<BTreeMap<_, _>>(),
        "halo": if description.neighbors.is_some() { "neighbors" } else { "client" },
        "complete": inner.complete(),
        "finished": inner.finished(),
        "tiles_done": stitcher.tiles().count(),
        "pixels": stitcher.image().area(),
        "pixels_done": stitcher.pixels_done(),
        "disk": description.disk,
    });
    if let Some(regions) = inner.regions() {
        let (tiles, pixels) = inner.arrived();
        summary["tiles_stored"] = tiles.into();
        summary["pixels_stored"] = pixels.into();
        summary["regions"] = regions.count().into();
        summary["regions_open"] = regions.open().into();
    }
    summary
}

impl Opened {
    /// Takes memory for looking at all tiles.
    fn charge(&self, charge: &Charge) -> Result<(), Refusal> {
        let inner = self.image.read();
        charge.add(LOOKING * (inner.stitcher().known() + inner.arrived().0) as u64)
    }

    fn summary(&self, service: &Shared) -> Value {
        let mut summary = summary(&self.entry.id, &self.image);
        summary["expires"] = service.images.expires(&self.entry).into();
        summary
    }

    /// Writes all that there is to say, the tiles one by one: there may be many.
    fn write_status(&self, service: &Shared, out: &mut impl Write) -> io::Result<()> {
        let mut status = self.summary(service);
        let (description, inner) = (self.image.description(), self.image.read());
        let stitcher = inner.stitcher();
        let totals = stitcher.totals();
        let (mut replaced, needed) = (totals.replaced, totals.halo_needed);
        if inner.regions().is_some() {
            // What regions are cut from was finite already.
            replaced = inner.replaced();
        }
        let tiles = || stitcher.tiles().map(|(core, report)| (core, report, inner.seconds(&core)));
        status["totals"] = json!({
            "seconds": tiles().map(|(_, _, seconds)| seconds).sum::<f64>(),
            "tiles": totals.tiles,
            "pixels": totals.pixels,
            "samples": totals.samples,
            "replaced": ReplacedCounts {
                color: replaced.color,
                feature: replaced.feature,
                random: replaced.random,
                film: replaced.film,
            },
            "spikes": totals.spikes,
            "energy_in": totals.energy_in,
            "energy_out": totals.energy_out,
            "filled": totals.filled,
            "unfilled": totals.unfilled,
            "settled": totals.settled,
            "settled_error": totals.settled_error,
            "short_of_halo": totals.short_of_halo,
            "halo_needed": [needed.left, needed.top, needed.right, needed.bottom],
            "left_out_bytes": totals.left_out_bytes,
            "work": totals.work.map(WorkCounts::from),
        });
        let left_out = stitcher.left_out().iter();
        status["totals"]["left_out"] = left_out
            .map(|((plane, reason), tiles)| json!({ "plane": plane, "reason": reason, "tiles": tiles }))
            .collect();
        if inner.regions().is_some() {
            status["trouble"] = json!(self.entry.runner.told());
        }
        // The object, but for its last brace.
        let mut head = status.to_string();
        head.pop();
        write!(out, "{head},\"missing\":[")?;
        for (i, rect) in stitcher.missing().into_iter().enumerate() {
            let comma = if i == 0 { "" } else { "," };
            write!(out, "{comma}{}", json!(corners(rect)))?;
        }
        write!(out, "],\"tiles\":[")?;
        for (i, (core, report, seconds)) in tiles().enumerate() {
            let mut report = json!(TileReport::new(report, &description.method, description.seed, seconds));
            // The same for all tiles, or told of all of them together, above.
            if let Value::Object(report) = &mut report {
                report.retain(|name, _| !["preset", "seed", "parameters", "left_out"].contains(&name.as_str()));
            }
            let comma = if i == 0 { "" } else { "," };
            write!(out, "{comma}{}", json!({ "tile": corners(core), "report": report }))?;
        }
        write!(out, "]")?;
        if let Some(regions) = inner.regions() {
            write!(out, ",\"waiting\":[")?;
            let open = (0..regions.count()).filter(|&index| regions.state(index) != RegionState::Done);
            for (i, index) in open.enumerate() {
                let state = match regions.state(index) {
                    RegionState::Waiting => "waiting",
                    RegionState::Ready | RegionState::Done => "ready",
                    RegionState::Running => "running",
                    RegionState::TooLarge => "too_large",
                    RegionState::Filtered => "filtered",
                };
                let mut region = json!({ "region": corners(regions.core(index)), "state": state });
                if ["waiting", "filtered"].contains(&state) {
                    let awaited = inner.awaited(index);
                    region["for"] = awaited.iter().take(MAX_WAITED).map(|rect| json!(corners(*rect))).collect();
                    region["for_regions"] = awaited.len().into();
                }
                let comma = if i == 0 { "" } else { "," };
                write!(out, "{comma}{region}")?;
            }
            write!(out, "]")?;
        }
        write!(out, "}}")
    }

    /// Writes what there is of the image, without keeping anybody from adding to it: if a tile is replaced meanwhile it
    /// is written again.
    fn consistent<T>(
        &self,
        partial: bool,
        stop: &AtomicBool,
        write: impl Fn(&Snapshot, bool, u64) -> Result<Option<T>, Refusal>,
    ) -> Result<T, Refusal> {
        loop {
            let (snapshot, settled, replacements) = {
                let inner = self.image.read();
                let settled = inner.settled();
                check_complete(&inner, partial || settled && inner.finished()).map_err(|mut refusal| {
                    if let Some(trouble) = self.entry.runner.told() {
                        refusal.0.more.insert("trouble".to_owned(), json!(trouble));
                    }
                    refusal
                })?;
                let (pixels, missing) = (inner.stitcher().pixels(), inner.stitcher().check_complete(true)?);
                (Snapshot { pixels, missing, stop }, settled, inner.replacements())
            };
            if let Some(written) = write(&snapshot, settled, replacements)?
                && self.image.read().replacements() == replacements
            {
                return Ok(written);
            }
        }
    }

    /// The image as an EXR file. One at a time may make it.
    fn exr(&self, service: &Shared, options: &ExrOptions, partial: bool, stop: &AtomicBool) -> Result<Exr, Refusal> {
        self.image.flush()?;
        self.consistent(partial, stop, |snapshot, settled, replacements| {
            if settled && let Some(file) = self.image.result(options) {
                return Ok(Some((file, Kept::Result(Reading::new(&self.entry)))));
            }
            self.image.verify(stop)?;
            let mut full = options.clone();
            if snapshot.missing > 0 {
                full.attributes.insert("rpfd:missing".into(), snapshot.missing.to_string());
            }
            // There is disk set aside for one result, which may still be read.
            if !settled || self.entry.is_read() {
                let (folder, permit) = (&service.config.data_dir, service.unread.none());
                let written = write_file(folder, permit, |out| Ok(exr::encode(snapshot, &full, out).map(drop)?));
                return written.map(|(file, permit)| Some((file, Kept::Other(permit))));
            }
            // It will not change any more: worth keeping.
            self.image.forget_result();
            let file = tempfile::NamedTempFile::new_in(self.image.folder())?;
            let mut out = io::BufWriter::with_capacity(256 << 10, file);
            exr::encode(snapshot, &full, &mut out)?;
            let file = out.into_inner().map_err(io::IntoInnerError::into_error)?;
            let reader = file.reopen()?;
            let kept = Kept::Result(Reading::new(&self.entry));
            Ok(self.image.keep_result(file, options, replacements).then_some((reader, kept)))
        })
    }
}

/// An EXR file, and what keeps its room on the disk.
type Exr = (File, Kept);

/// What an answer keeps until it is sent.
enum Kept {
    /// Room of the image itself.
    Result(#[expect(dead_code, reason = "it lives")] Reading),
    /// Room for results that nobody has read.
    Other(#[expect(dead_code, reason = "it lives")] Permit),
}

/// The pixels of an image at a moment, as long as somebody waits for them.
struct Snapshot<'a> {
    pixels: StoredPixels,
    /// Pixels that are missing.
    missing: u64,
    stop: &'a AtomicBool,
}

impl Pixels for Snapshot<'_> {
    fn image(&self) -> Rect {
        self.pixels.image()
    }

    fn read(&self, rect: Rect, pixels: &mut [[f32; 3]]) -> Result<(), CanvasError> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(CanvasError::Stopped);
        }
        self.pixels.read(rect, pixels)
    }
}

/// Refuses while pixels are missing or not final, and says which.
fn check_complete(inner: &Inner, partial: bool) -> Result<(), Refusal> {
    if partial || inner.complete() {
        return Ok(());
    }
    let (mut missing, all) = (inner.stitcher().missing(), inner.regions());
    if let (true, Some(regions)) = (missing.is_empty(), all) {
        // They are there, but not from all that they are to be filtered from.
        let open = (0..regions.count()).filter(|&index| regions.state(index) != RegionState::Done);
        missing = open.map(|index| regions.core(index)).collect();
    }
    let pixels = missing.iter().map(Rect::area).sum();
    let first = missing.first().copied().unwrap_or_else(|| inner.stitcher().image());
    let mut problem = Problem::from(StitchError::Incomplete { pixels, first });
    let listed: Value = missing.iter().take(MAX_LISTED).map(|rect| json!(corners(*rect))).collect();
    problem = problem.with("missing", listed).with("missing_regions", missing.len());
    problem.detail += "; ?partial=true gives what there is";
    Err(problem.into())
}

/// What the JSON that opens an image says.
fn described(body: &[u8], service: &Shared) -> Result<(Id, Description), Refusal> {
    let config = &service.config;
    let mut parameters = Parameters::of_json(body)?;
    let mut side = |name: &str| {
        let side = parameters.number(name)?;
        side.ok_or_else(|| open_refused(format!("{name:?} is missing: an image needs width and height, in pixels")))
    };
    let size: [u32; 2] = [side("width")?, side("height")?];
    let id = match parameters.take("id") {
        None => Id::new(),
        Some(id) => Id::chosen(&id).ok_or_else(|| {
            let right = "must be 1 to 128 of A-Z a-z 0-9 . _ - and not start with a dot";
            open_refused(format!("id = {id:?}: {right}"))
        })?,
    };
    let leave_out = parameters.leave_out()?;
    let announced = if parameters.neighbors()? { Some(announced(&mut parameters)?) } else { None };
    let (method, seed) = parameters.method()?;
    TileGeometry::new(size, Rect::new(0, 0, 1, 1), Halo::default()).map_err(StitchError::from)?;
    let (pixels, most) = (u64::from(size[0]) * u64::from(size[1]), config.image_pixels);
    if pixels > most {
        let detail =
            format!("{} x {} is {pixels} pixels: this service takes images of {most} at most", size[0], size[1]);
        return Err(Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, "image_too_large", "The image is too large", detail));
    }
    let mut description = Description { size, method, seed, leave_out, neighbors: announced, owner: None, disk: 0 };
    if let Some(announced) = &mut description.neighbors {
        // A quarter, so that a few regions are at work while tiles come in.
        let (threads, most) = (config.threads, service.budget.total());
        let chosen = announced.choose_region(size, &description.method, threads, most / 4, most);
        chosen.map_err(|needed| AdmissionError::TooLarge { needed, total: most })?;
    }
    description.disk = disk_bytes(&description);
    Ok((id, description))
}

/// What is said of tiles that will come as bare cores.
fn announced(parameters: &mut Parameters) -> Result<Announced, Refusal> {
    let (samples, most) = (parameters.number::<u32>("samples")?, parameters.number::<u32>("max_samples")?);
    let (samples, varying) = match (samples, most) {
        (Some(n), None) => (n, false),
        (None, Some(n)) => (n, true),
        _ => {
            let right = "\"samples\", of each pixel, or \"max_samples\", if they vary: one of them must be there";
            return Err(open_refused(format!("with \"halo\": \"neighbors\" {right}")));
        }
    };
    if !(1..=MAX_SAMPLES_PER_PIXEL).contains(&samples) {
        return Err(open_refused(format!("{samples} samples: must be 1 to {MAX_SAMPLES_PER_PIXEL}")));
    }
    let channels = parameters.channels().unwrap_or_default();
    let channels = channels_from_json(&channels).map_err(|why| open_refused(format!("\"channels\": {why}")))?;
    Ok(Announced { channels, samples, varying, region: 0 })
}

/// `POST /v1/images`.
pub(super) async fn open(State(service): State<Shared>, charge: Charge, request: Request) -> Result<Response, Refusal> {
    Parameters::of_query(request.uri())?.done("none: an image is described in the body")?;
    let (parts, body) = request.into_parts();
    let owner = parts.extensions.get::<Owner>().cloned();
    let body = Frames::new(&parts.headers, body, charge.clone(), service.pace())?.all(MAX_JSON).await?;
    charge.add(JSON_GROWS * body.len() as u64)?;
    let (status, id, summary) = blocking(move || {
        let (id, mut description) = described(&body, &service)?;
        description.owner = owner.as_ref().map(|owner| owner.name.to_string());
        let limit = owner.map_or(usize::MAX, |owner| owner.images);
        let (new, opened) = service.images.open(id, description, limit)?;
        let status = if new { StatusCode::CREATED } else { StatusCode::OK };
        Ok::<_, Refusal>((status, opened.entry.id.clone(), opened.summary(&service)))
    })
    .await??;
    tracing::info!(id = id.0, width = %summary["width"], height = %summary["height"], "image opened");
    let location = format!("/v1/images/{}", id.0);
    Ok((status, [(header::LOCATION, location)], Json(summary)).into_response())
}

/// `GET /v1/images`.
pub(super) async fn list(State(service): State<Shared>, charge: Charge, _: NoQuery) -> Result<Json<Value>, Refusal> {
    charge.add(SUMMARY * service.images.count() as u64)?;
    let list = blocking(move || service.images.list()).await?;
    Ok(Json(json!({ "images": list })))
}

/// `GET /v1/images/{id}`.
pub(super) async fn status(
    State(service): State<Shared>,
    id: Id,
    charge: Charge,
    _: NoQuery,
) -> Result<Response, Refusal> {
    let file = blocking(move || {
        let opened = service.images.find(&id)?;
        opened.charge(&charge)?;
        opened.image.flush()?;
        // It may have been out of memory since the service was started.
        regions::kick(&service, &opened);
        write_file(&service.config.data_dir, service.unread.none(), |out| Ok(opened.write_status(&service, out)?))
    });
    Ok(file_response(file.await??, "application/json").await?)
}

/// `DELETE /v1/images/{id}`.
pub(super) async fn delete(State(service): State<Shared>, id: Id, _: NoQuery) -> Result<StatusCode, Refusal> {
    let name = id.clone();
    let removed = blocking(move || service.images.delete(&name)).await??;
    if !removed {
        return Err(no_image(&id.0));
    }
    tracing::info!(id = id.0, "image deleted");
    Ok(StatusCode::NO_CONTENT)
}

/// `POST /v1/images/{id}/finish`.
pub(super) async fn finish(State(service): State<Shared>, id: Id, _: NoQuery) -> Result<Response, Refusal> {
    let (settled, summary) = blocking(move || {
        let opened = service.images.find(&id)?;
        opened.image.finish()?;
        regions::kick(&service, &opened);
        let settled = opened.image.read().settled();
        Ok::<_, Refusal>((settled, opened.summary(&service)))
    })
    .await??;
    tracing::info!(id = %summary["id"], "image finished");
    let status = if settled { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, Json(summary)).into_response())
}

/// `GET /v1/images/{id}/result.exr`.
pub(super) async fn result(
    State(service): State<Shared>,
    id: Id,
    charge: Charge,
    request: Request,
) -> Result<Response, Refusal> {
    let images = Arc::clone(&service);
    let opened = blocking(move || images.images.find(&id)).await??;
    let mut parameters = Parameters::of_query(request.uri())?;
    let partial = parameters.flag("partial")?;
    let mut options = parameters.exr()?;
    let description = opened.image.description();
    options.attributes = attributes(&description.method, description.seed);
    // What one has written the next need not write again.
    let entry = Arc::clone(&opened.entry);
    let _turn = entry.encoding.lock().await;
    let shared = Arc::clone(&service);
    let file = service.work.picture(move |stop| {
        opened.charge(&charge)?;
        opened.exr(&shared, &options, partial, stop)
    });
    let file = file.await?;
    Ok(file_response(file, Form::Exr.media()).await?)
}

/// `GET /v1/images/{id}/preview.png`.
pub(super) async fn preview(
    State(service): State<Shared>,
    id: Id,
    charge: Charge,
    request: Request,
) -> Result<Response, Refusal> {
    let images = Arc::clone(&service);
    let opened = blocking(move || images.images.find(&id)).await??;
    let mut parameters = Parameters::of_query(request.uri())?;
    let partial = parameters.flag("partial")?;
    parameters.done("partial")?;
    let shared = Arc::clone(&service);
    let file = service.work.picture(move |stop| {
        opened.charge(&charge)?;
        opened.image.flush()?;
        opened.consistent(partial, stop, |snapshot, _, _| {
            let (folder, permit) = (&shared.config.data_dir, shared.unread.none());
            write_file(folder, permit, |out| encode_png(snapshot, out)).map(Some)
        })
    });
    Ok(file_response(file.await?, Form::Png.media()).await?)
}
