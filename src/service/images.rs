//! Images that are being assembled: `/v1/images` and what is below it, but for the tiles that come in.

use std::{
    collections::{BTreeMap, HashMap},
    hash::{BuildHasher, RandomState},
    io::{self, Write},
    sync::{Arc, Mutex, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard},
};

use axum::{
    Json,
    extract::{FromRequestParts, Path as UrlPath, Request, State},
    http::{StatusCode, header, request::Parts},
    response::{IntoResponse, Response},
};
use serde_json::{Value, json};

use super::{
    Shared,
    body::Frames,
    charge::Charge,
    picture::{encode_png, write_file},
    problem::{Refusal, corners},
    query::{Form, NoQuery, Parameters, attributes},
    results::file_response,
    work::blocking,
};
use crate::{
    config::Config,
    filter::{ChannelSet, Filtered, Method, Rect, SampleTile},
    stitch::{Added, Claim, Offer, StitchError, Stitcher, digest::digest},
    wire::{
        Problem, TileReport,
        message::{ReplacedCounts, WorkCounts},
    },
};

/// Most bytes of the JSON that opens an image.
const MAX_JSON: usize = 64 << 10;
/// Most bytes of an id.
const MAX_ID: usize = 128;
/// Most missing regions that a problem lists; it says how many there are.
const MAX_LISTED: usize = 1000;
/// Tiles of an image at most: each is kept track of in memory, a few hundred bytes.
const MAX_TILES: usize = 1 << 17;

/// The id of an image, from the path of a request.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Id(String);

impl<S: Send + Sync> FromRequestParts<S> for Id {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Refusal> {
        // What is not even text is no image's id.
        let id = UrlPath::<String>::from_request_parts(parts, state).await;
        id.map(|UrlPath(id)| Self(id)).map_err(|error| no_image(&error.body_text()))
    }
}

impl Id {
    /// An id that a client has chosen.
    fn chosen(id: String) -> Result<Self, Refusal> {
        let fine = |b: u8| b.is_ascii_alphanumeric() || b"._-".contains(&b);
        if (1..=MAX_ID).contains(&id.len()) && id.bytes().all(fine) && !id.starts_with('.') {
            return Ok(Self(id));
        }
        let right = "must be 1 to 128 of A-Z a-z 0-9 . _ - and not start with a dot";
        Err(open_refused(format!("id = {id:?}: {right}")))
    }

    /// An id that nobody has.
    fn new() -> Self {
        let random = || RandomState::new().hash_one("image");
        Self(format!("{:016x}{:016x}", random(), random()))
    }
}

fn open_refused(detail: String) -> Refusal {
    Refusal::new(StatusCode::BAD_REQUEST, "bad_parameter", "The image cannot be opened", detail)
}

fn no_image(id: &str) -> Refusal {
    let detail = format!("there is no image {id:?}: it was never opened, or is forgotten");
    Refusal::new(StatusCode::NOT_FOUND, "unknown_image", "There is no such image", detail)
}

/// What becomes of a tile that was offered.
pub(super) enum Outcome {
    /// It is stored already, made from the same samples.
    Repeated,
    /// It is to be filtered.
    Filter(Claim),
}

/// An image that is being assembled.
pub(super) struct Image {
    id: Id,
    size: [u32; 2],
    pub(super) method: Arc<Method>,
    pub(super) seed: u64,
    /// Whether what can have no effect is left out; the same image either way.
    pub(super) leave_out: bool,
    /// The channels of its tiles: those of the first that came whole.
    channels: OnceLock<ChannelSet>,
    canvas: RwLock<Canvas>,
}

struct Canvas {
    stitcher: Stitcher,
    /// Time that filtering took, by core.
    seconds: HashMap<Rect, f64>,
}

impl Image {
    fn read(&self) -> RwLockReadGuard<'_, Canvas> {
        self.canvas.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Canvas> {
        self.canvas.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether it was opened in the same way.
    fn same(&self, other: &Self) -> bool {
        self.size == other.size && self.method == other.method && self.seed == other.seed
    }

    /// Refuses tiles of other images.
    pub(super) fn check(&self, image: Rect, channels: &ChannelSet) -> Result<(), Refusal> {
        let refuse = |code, detail| {
            let title = "The tile is not of this image";
            Err(Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, code, title, detail))
        };
        let ([width, height], Rect { width: w, height: h, .. }) = (self.size, image);
        if [w, h] != self.size {
            let detail = format!("the tile is of an image of {w} x {h} pixels, this one has {width} x {height}");
            return refuse("image_mismatch", detail);
        }
        match self.channels.get() {
            Some(known) if known != channels => {
                let names =
                    |set: &ChannelSet| set.channels().iter().map(|c| c.name.clone()).collect::<Vec<_>>().join(", ");
                let detail = format!(
                    "the tile's channels ({}) are not those of the tiles before ({}): names, order, roles and components \
                     must be the same in all tiles of an image",
                    names(channels),
                    names(known)
                );
                refuse("channel_mismatch", detail)
            }
            _ => Ok(()),
        }
    }

    /// Asks whether a tile is wanted. Blocks.
    pub(super) fn offer(&self, tile: &SampleTile, replace: bool) -> Result<Outcome, Refusal> {
        self.channels.get_or_init(|| tile.channels().clone());
        self.check(tile.geometry().image(), tile.channels())?;
        let digest = digest(tile);
        let mut canvas = self.write();
        if canvas.stitcher.known() >= MAX_TILES {
            let detail = format!("an image has {MAX_TILES} tiles at most: send larger ones");
            let title = "The image has too many tiles";
            return Err(Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, "too_many_tiles", title, detail));
        }
        match canvas.stitcher.offer(tile.geometry().core(), digest, replace)? {
            Offer::Repeated => Ok(Outcome::Repeated),
            Offer::Filter(claim) => Ok(Outcome::Filter(claim)),
        }
    }

    /// Puts a filtered core on the canvas and says what became of it. Blocks.
    pub(super) fn add(&self, claim: Claim, filtered: &Filtered, seconds: f64) -> Result<&'static str, Refusal> {
        let mut canvas = self.write();
        match canvas.stitcher.add(claim, filtered)? {
            Added::Repeated => Ok("repeated"),
            Added::Stored => {
                canvas.seconds.insert(filtered.core, seconds);
                Ok("filtered")
            }
        }
    }

    fn summary(&self) -> Value {
        let canvas = self.read();
        let stitcher = &canvas.stitcher;
        json!({
            "id": self.id.0,
            "width": self.size[0],
            "height": self.size[1],
            "preset": self.method.preset_name(),
            "seed": self.seed,
            "parameters": self.method.parameters().into_iter().collect::<BTreeMap<_, _>>(),
            "complete": stitcher.is_complete(),
            "tiles_done": stitcher.tiles().count(),
            "pixels": stitcher.image().area(),
            "pixels_done": stitcher.pixels_done(),
        })
    }

    /// Writes all that there is to say, the tiles one by one: there may be many.
    fn write_status(&self, out: &mut impl Write) -> io::Result<()> {
        let mut status = self.summary();
        let canvas = self.read();
        let stitcher = &canvas.stitcher;
        status["missing"] = stitcher.missing().into_iter().map(|rect| json!(corners(rect))).collect();
        let totals = stitcher.totals();
        let (replaced, needed) = (totals.replaced, totals.halo_needed);
        status["totals"] = json!({
            "seconds": canvas.seconds.values().sum::<f64>(),
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
        // The object, but for its last brace.
        let mut head = status.to_string();
        head.pop();
        write!(out, "{head},\"tiles\":[")?;
        for (i, (core, report)) in stitcher.tiles().enumerate() {
            let seconds = canvas.seconds.get(&core).copied().unwrap_or(0.0);
            let mut report = json!(TileReport::new(report, &self.method, self.seed, seconds));
            // The same for all tiles, or told of all of them together, above.
            if let Value::Object(report) = &mut report {
                report.retain(|name, _| !["preset", "seed", "parameters", "left_out"].contains(&name.as_str()));
            }
            let comma = if i == 0 { "" } else { "," };
            write!(out, "{comma}{}", json!({ "tile": corners(core), "report": report }))?;
        }
        write!(out, "]}}")
    }

    /// Refuses while pixels are missing, and says which.
    fn check_complete(&self, stitcher: &Stitcher, partial: bool) -> Result<(), Refusal> {
        let Err(error) = stitcher.check_complete(partial) else { return Ok(()) };
        let regions = matches!(error, StitchError::Incomplete { .. }).then(|| stitcher.missing());
        let mut problem = Problem::from(error);
        if let Some(missing) = regions {
            let listed: Value = missing.iter().take(MAX_LISTED).map(|rect| json!(corners(*rect))).collect();
            problem = problem.with("missing", listed).with("missing_regions", missing.len());
            problem.detail += "; ?partial=true gives what there is";
        }
        Err(problem.into())
    }
}

/// All images, by id.
pub(super) struct Images {
    all: Mutex<BTreeMap<Id, Arc<Image>>>,
    limit: usize,
}

impl Images {
    /// None yet, and at most so many.
    pub(super) const fn new(limit: usize) -> Self {
        Self { all: Mutex::new(BTreeMap::new()), limit }
    }

    fn with<T>(&self, work: impl FnOnce(&mut BTreeMap<Id, Arc<Image>>) -> T) -> T {
        work(&mut self.all.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.with(|all| all.len())
    }

    pub(super) fn find(&self, id: &Id) -> Result<Arc<Image>, Refusal> {
        self.with(|all| all.get(id).cloned()).ok_or_else(|| no_image(&id.0))
    }

    /// Adds an image, unless there is one with its id: says whether it is new, and gives the one that is there now.
    fn open(&self, image: Image) -> Result<(bool, Arc<Image>), Refusal> {
        self.with(|all| match all.get(&image.id) {
            Some(known) if known.same(&image) => Ok((false, Arc::clone(known))),
            Some(_) => Err(Refusal::new(
                StatusCode::CONFLICT,
                "image_conflict",
                "The image is there, opened differently",
                format!("image {:?} was opened with another size, preset, seed or parameters", image.id.0),
            )),
            None if all.len() >= self.limit => Err(Problem::new(
                503,
                "too_many_images",
                "Too many images are open",
                format!("{} images are open; delete some that are done", self.limit),
            )
            .with("retry_after", 60)
            .into()),
            None => {
                let image = Arc::new(image);
                all.insert(image.id.clone(), Arc::clone(&image));
                Ok((true, image))
            }
        })
    }
}

/// What the JSON that opens an image says.
fn described(body: &[u8], config: &Config) -> Result<Image, Refusal> {
    let mut parameters = Parameters::of_json(body)?;
    let mut side = |name: &str| {
        let side = parameters.number(name)?;
        side.ok_or_else(|| open_refused(format!("{name:?} is missing: an image needs width and height, in pixels")))
    };
    let size: [u32; 2] = [side("width")?, side("height")?];
    let id = parameters.take("id").map_or_else(|| Ok(Id::new()), Id::chosen)?;
    let leave_out = parameters.leave_out()?;
    let (method, seed) = parameters.method()?;
    let (pixels, most) = (u64::from(size[0]) * u64::from(size[1]), config.image_pixels);
    if pixels > most {
        let detail =
            format!("{} x {} is {pixels} pixels: this service takes images of {most} at most", size[0], size[1]);
        return Err(Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, "image_too_large", "The image is too large", detail));
    }
    let stitcher = Stitcher::new(size[0], size[1], &config.data_dir)?;
    let canvas = RwLock::new(Canvas { stitcher, seconds: HashMap::new() });
    Ok(Image { id, size, method: Arc::new(method), seed, leave_out, channels: OnceLock::new(), canvas })
}

/// `POST /v1/images`.
pub(super) async fn open(State(service): State<Shared>, charge: Charge, request: Request) -> Result<Response, Refusal> {
    Parameters::of_query(request.uri())?.done("none: an image is described in the body")?;
    let (parts, body) = request.into_parts();
    let body = Frames::new(&parts.headers, body, charge, service.pace())?.all(MAX_JSON).await?;
    let (status, image) = blocking(move || {
        let image = described(&body, &service.config)?;
        let (new, image) = service.images.open(image)?;
        let status = if new { StatusCode::CREATED } else { StatusCode::OK };
        Ok::<_, Refusal>((status, image))
    })
    .await??;
    tracing::info!(id = image.id.0, width = image.size[0], height = image.size[1], "image opened");
    let location = format!("/v1/images/{}", image.id.0);
    let summary = blocking(move || image.summary()).await?;
    Ok((status, [(header::LOCATION, location)], Json(summary)).into_response())
}

/// `GET /v1/images`.
pub(super) async fn list(State(service): State<Shared>, _: NoQuery) -> Result<Json<Value>, Refusal> {
    let images: Vec<_> = service.images.with(|all| all.values().cloned().collect());
    let list = blocking(move || images.iter().map(|image| image.summary()).collect::<Value>()).await?;
    Ok(Json(json!({ "images": list })))
}

/// `GET /v1/images/{id}`.
pub(super) async fn status(State(service): State<Shared>, id: Id, _: NoQuery) -> Result<Response, Refusal> {
    let image = service.images.find(&id)?;
    let file = blocking(move || write_file(&service.config.data_dir, |out| Ok(image.write_status(out)?)));
    Ok(file_response(file.await??, "application/json").await?)
}

/// `DELETE /v1/images/{id}`.
pub(super) async fn delete(State(service): State<Shared>, id: Id, _: NoQuery) -> Result<StatusCode, Refusal> {
    let removed = service.images.with(|all| all.remove(&id)).ok_or_else(|| no_image(&id.0))?;
    tracing::info!(id = id.0, "image deleted");
    // Closing the last handle of a large file takes a while.
    blocking(move || drop(removed)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `GET /v1/images/{id}/result.exr`.
pub(super) async fn result(State(service): State<Shared>, id: Id, request: Request) -> Result<Response, Refusal> {
    let image = service.images.find(&id)?;
    let mut parameters = Parameters::of_query(request.uri())?;
    let partial = parameters.flag("partial")?;
    let mut options = parameters.exr()?;
    options.attributes = attributes(&image.method, image.seed);
    let file = blocking(move || {
        let stitcher = &image.read().stitcher;
        image.check_complete(stitcher, partial)?;
        write_file(&service.config.data_dir, |out| Ok(stitcher.encode_exr(&options, partial, out).map(drop)?))
    });
    Ok(file_response(file.await??, Form::Exr.media()).await?)
}

/// `GET /v1/images/{id}/preview.png`.
pub(super) async fn preview(State(service): State<Shared>, id: Id, request: Request) -> Result<Response, Refusal> {
    let image = service.images.find(&id)?;
    let mut parameters = Parameters::of_query(request.uri())?;
    let partial = parameters.flag("partial")?;
    parameters.done("partial")?;
    let file = blocking(move || {
        let stitcher = &image.read().stitcher;
        image.check_complete(stitcher, partial)?;
        write_file(&service.config.data_dir, |out| encode_png(&stitcher.pixels(), out))
    });
    Ok(file_response(file.await??, Form::Png.media()).await?)
}
