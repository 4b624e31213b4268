//! The contract for programs: an OpenAPI document, made from the calls below. `proto/openapi.json` is a copy of it.
//!
//! Each call has one entry in [`calls`], from which the router is built too. The schemas are of JSON that is written
//! elsewhere; a test compares them with real answers.

use std::collections::BTreeMap;

use axum::{
    http::header,
    response::IntoResponse,
    routing::{MethodRouter, get, post},
};
use utoipa::{
    ToSchema,
    openapi::{
        ComponentsBuilder, Content, HttpMethod, InfoBuilder, LicenseBuilder, ObjectBuilder, OpenApiBuilder, PathItem,
        PathsBuilder, Ref, Required, ResponseBuilder, SecurityRequirement, Type,
        path::{OperationBuilder, ParameterBuilder, ParameterIn},
        request_body::RequestBodyBuilder,
        security::{HttpAuthScheme, HttpBuilder, SecurityScheme},
    },
};

use super::{Shared, health, images, query::NoQuery, stream};
use crate::filter::{Method, method::PRESETS};

/// A call: its handlers, and what is told of them.
pub(super) struct Call {
    pub(super) path: &'static str,
    pub(super) handlers: MethodRouter<Shared>,
    operations: Vec<(HttpMethod, OperationBuilder)>,
}

const MESSAGES: &str = "application/msgpack";
const LINES: &str = "application/x-ndjson";
const PROBLEM: &str = "application/problem+json";

/// All calls.
pub(super) fn calls() -> Vec<Call> {
    use HttpMethod::{Delete, Get, Post, Put};
    // PUT as well, where a tile stream comes: `curl -T` sends nothing else.
    let both = |operation: fn(&'static str) -> OperationBuilder, post: &'static str, put: &'static str| {
        vec![(Post, operation(post)), (Put, operation(put))]
    };
    vec![
        Call {
            path: "/v1/filter",
            handlers: post(stream::filter_stream).put(stream::filter_stream),
            operations: both(filter_operation, "filter", "filterPut"),
        },
        Call {
            path: "/v1/images",
            handlers: post(images::open).get(images::list),
            operations: vec![
                (
                    Post,
                    operation("openImage", "Opens an image to be stitched from tiles")
                        .request_body(Some(json_body("OpenImage")))
                        .response("201", json("The image is open", "Image"))
                        .response("200", json("It was open already, opened in the same way", "Image")),
                ),
                (Get, operation("listImages", "Lists the images").response("200", json("All images, by id", "Images"))),
            ],
        },
        Call {
            path: "/v1/images/{id}",
            handlers: get(images::status).delete(images::delete),
            operations: vec![
                (
                    Get,
                    of_image("getImage", "Says all about one image").response("200", json("The image", "ImageStatus")),
                ),
                (
                    Delete,
                    of_image("deleteImage", "Forgets an image")
                        .response("204", ResponseBuilder::new().description("It is forgotten")),
                ),
            ],
        },
        Call {
            path: "/v1/images/{id}/finish",
            handlers: post(images::finish),
            operations: vec![(
                Post,
                of_image("finishImage", "Takes no more tiles, and filters what waits with what there is")
                    .response("200", json("It is done", "Image"))
                    .response("202", json("Regions are still to be filtered", "Image")),
            )],
        },
        Call {
            path: "/v1/images/{id}/tiles",
            handlers: post(stream::image_tiles).put(stream::image_tiles),
            operations: both(tiles_operation, "sendTiles", "sendTilesPut"),
        },
        Call {
            path: "/v1/images/{id}/result.exr",
            handlers: get(images::result),
            operations: vec![(
                Get,
                of_image("getResult", "The stitched image as OpenEXR")
                    .parameter(flag("partial", "Missing pixels are black, instead of a 409"))
                    .parameter(choice("samples", "Type of the values", &["float", "half"]))
                    .parameter(choice(
                        "compression",
                        "How it is compressed, always without loss",
                        &["none", "rle", "zips", "zip", "piz"],
                    ))
                    .parameter(choice("layout", "Rows or tiles", &["scanlines", "tiles"]))
                    .parameter(query(
                        "tile",
                        "Side of the EXR's tiles in pixels, 16 to 4096; implies layout=tiles",
                        Type::Integer,
                    ))
                    .response("200", file("The image", "image/x-exr")),
            )],
        },
        Call {
            path: "/v1/images/{id}/preview.png",
            handlers: get(images::preview),
            operations: vec![(
                Get,
                of_image("getPreview", "The stitched image to look at: sRGB, 8 bits, clipped")
                    .parameter(flag("partial", "Missing pixels are black, instead of a 409"))
                    .response("200", file("The picture", "image/png")),
            )],
        },
        Call {
            path: "/livez",
            handlers: get(health::live),
            operations: vec![(Get, open("live", "Whether the service runs").response("200", plain("It does")))],
        },
        Call {
            path: "/readyz",
            handlers: get(health::ready),
            operations: vec![(
                Get,
                open("ready", "Whether the service should be sent work").response("200", plain("It should")),
            )],
        },
        Call {
            path: "/openapi.json",
            handlers: get(serve),
            operations: vec![(
                Get,
                open("openapi", "This document").response(
                    "200",
                    ResponseBuilder::new()
                        .description("This document")
                        .content("application/json", Content::new(Some(ObjectBuilder::new()))),
                ),
            )],
        },
    ]
}

fn filter_operation(id: &'static str) -> OperationBuilder {
    let answer = ResponseBuilder::new()
        .description("Results as tiles are done, in any order, then end; or a picture of a single tile, as Accept says")
        .content(MESSAGES, binary())
        .content("image/x-exr", binary())
        .content("image/png", binary());
    let operation = operation(id, "A tile stream in, a result stream or one picture out; nothing is kept");
    method_parameters()
        .into_iter()
        .fold(operation, OperationBuilder::parameter)
        .request_body(Some(tiles()))
        .response("200", answer)
}

fn tiles_operation(id: &'static str) -> OperationBuilder {
    let lines = ResponseBuilder::new()
        .description("A line for each tile, then one for the end")
        .content(LINES, Content::new(Some(Ref::from_schema_name("TileLine"))));
    of_image(id, "A tile stream in, one line a tile out")
        .parameter(flag("replace", "A core that is stored, made from other samples, is replaced"))
        .request_body(Some(tiles()))
        .response("200", lines)
}

/// An operation that needs no token.
fn open(id: &str, summary: &str) -> OperationBuilder {
    let problem = ResponseBuilder::new()
        .description("What is wrong; `code` says it to programs")
        .content(PROBLEM, Content::new(Some(Ref::from_schema_name("Problem"))));
    OperationBuilder::new()
        .operation_id(Some(id))
        .summary(Some(summary))
        .response("default", problem)
        .security(SecurityRequirement::default())
}

fn operation(id: &str, summary: &str) -> OperationBuilder {
    open(id, summary)
        .securities(Some([SecurityRequirement::default(), SecurityRequirement::new("token", [] as [&str; 0])]))
}

fn of_image(id: &str, summary: &str) -> OperationBuilder {
    let parameter = ParameterBuilder::new().name("id").parameter_in(ParameterIn::Path).required(Required::True);
    let pattern = ObjectBuilder::new().schema_type(Type::String).pattern(Some("^[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}$"));
    operation(id, summary).parameter(parameter.description(Some("The image's id")).schema(Some(pattern)))
}

fn query(name: &str, description: &str, kind: Type) -> ParameterBuilder {
    let parameter = ParameterBuilder::new().name(name).parameter_in(ParameterIn::Query).required(Required::False);
    parameter.description(Some(description)).schema(Some(ObjectBuilder::new().schema_type(kind)))
}

fn flag(name: &str, description: &str) -> ParameterBuilder {
    query(name, description, Type::Boolean)
}

fn choice(name: &str, description: &str, values: &[&str]) -> ParameterBuilder {
    let values = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(values.iter().copied()));
    query(name, description, Type::String).schema(Some(values))
}

/// How to filter, in a query: every parameter of any preset.
fn method_parameters() -> Vec<ParameterBuilder> {
    let presets: Vec<_> = PRESETS.iter().map(|(name, _)| *name).collect();
    let mut all = vec![
        choice("preset", "How to filter; lean by default", &presets),
        query("seed", "Keys every random draw; 0 by default", Type::Integer),
        choice(
            "leave_out",
            "Whether what has no effect is left out: the time, never a bit of the result",
            &["on", "off"],
        ),
    ];
    let mut parameters: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for preset in presets {
        for (name, value) in Method::preset(preset).map(|method| method.parameters()).unwrap_or_default() {
            parameters.entry(name).or_default().push(format!("{value} in {preset}"));
        }
    }
    all.extend(parameters.into_iter().map(|(name, values)| query(name, &values.join(", "), Type::String)));
    all
}

fn tiles() -> utoipa::openapi::request_body::RequestBody {
    let body = RequestBodyBuilder::new().description(Some("A tile stream (proto/tile.md), of any content type"));
    body.content(MESSAGES, binary()).required(Some(Required::True)).build()
}

fn json_body(schema: &str) -> utoipa::openapi::request_body::RequestBody {
    let content = Content::new(Some(Ref::from_schema_name(schema)));
    RequestBodyBuilder::new().content("application/json", content).required(Some(Required::True)).build()
}

/// Bytes of no further schema.
fn binary() -> Content {
    Content::default()
}

fn json(description: &str, schema: &str) -> ResponseBuilder {
    let content = Content::new(Some(Ref::from_schema_name(schema)));
    ResponseBuilder::new().description(description).content("application/json", content)
}

fn file(description: &str, media: &str) -> ResponseBuilder {
    ResponseBuilder::new().description(description).content(media, binary())
}

fn plain(description: &str) -> ResponseBuilder {
    let text = Content::new(Some(ObjectBuilder::new().schema_type(Type::String)));
    ResponseBuilder::new().description(description).content("text/plain", text)
}

/// The document.
pub(super) fn document() -> String {
    let info = InfoBuilder::new()
        .title("rpfd")
        .version("1")
        .description(Some("Denoises renders that come in tiles. proto/http.md and proto/tile.md are normative."))
        .license(Some(LicenseBuilder::new().name("Apache-2.0").identifier(Some("Apache-2.0")).build()));
    let token =
        HttpBuilder::new().scheme(HttpAuthScheme::Bearer).description(Some("If the service was started with tokens"));
    let components = ComponentsBuilder::new()
        .schema_from::<OpenImage>()
        .schema_from::<Image>()
        .schema_from::<Images>()
        .schema_from::<ListedImage>()
        .schema_from::<OpenChannel>()
        .schema_from::<WaitingRegion>()
        .schema_from::<ImageStatus>()
        .schema_from::<TileStatus>()
        .schema_from::<Report>()
        .schema_from::<Replaced>()
        .schema_from::<Work>()
        .schema_from::<Totals>()
        .schema_from::<LeftOut>()
        .schema_from::<TileLine>()
        .schema_from::<Problem>()
        .security_scheme("token", SecurityScheme::Http(token.build()));
    let mut paths = PathsBuilder::new();
    for call in calls() {
        for (method, operation) in call.operations {
            paths = paths.path(call.path, PathItem::new(method, operation));
        }
    }
    let document = OpenApiBuilder::new().info(info).paths(paths).components(Some(components.build())).build();
    // Made of texts and numbers, it always can be written.
    let mut text = document.to_pretty_json().unwrap_or_default();
    text.push('\n');
    text
}

/// `GET /openapi.json`.
async fn serve(_: NoQuery) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], document())
}

/// Describes the JSON of this module's calls.
macro_rules! schemas {
    ($($(#[$meta:meta])* struct $name:ident { $($(#[$field_meta:meta])* $field:ident: $type:ty,)+ })+) => { $(
        $(#[$meta])*
        #[derive(ToSchema)]
        #[expect(dead_code, reason = "it only describes")]
        struct $name { $($(#[$field_meta])* $field: $type,)+ }
    )+ };
}

schemas! {
    /// What an image is to be. Every other key is a parameter of the preset.
    struct OpenImage {
        /// Width in pixels, 1 to 1048576.
        #[schema(minimum = 1, maximum = 1_048_576)]
        width: u32,
        /// Height in pixels, 1 to 1048576.
        #[schema(minimum = 1, maximum = 1_048_576)]
        height: u32,
        /// Chosen by the client; the service makes one if it is absent.
        #[schema(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}$")]
        id: Option<String>,
        /// How to filter; `lean` if it is absent.
        preset: Option<String>,
        /// Keys every random draw; 0 if it is absent.
        seed: Option<u64>,
        /// Who brings the context around tiles: `client` (also if it is absent) with each tile, or `neighbors`, the tiles
        /// around it.
        halo: Option<String>,
        /// With `neighbors`: samples of each pixel; or `max_samples`.
        samples: Option<u32>,
        /// With `neighbors`: most samples of a pixel, if they vary.
        max_samples: Option<u32>,
        /// With `neighbors`: the channels of all tiles, in order.
        channels: Option<Vec<OpenChannel>>,
    }

    /// A channel as tiles announce it (proto/tile.md).
    struct OpenChannel {
        /// Its name.
        name: String,
        /// `film`, `color`, `feature` or `random`.
        role: String,
        /// Values of each sample.
        components: u32,
        /// Of a feature: `position` or `other`.
        #[schema(nullable = false)]
        space: Option<String>,
        /// Of a random parameter: whether it is uniform on [0, 1).
        #[schema(nullable = false)]
        uniform: Option<bool>,
    }

    /// An image's summary.
    struct Image {
        /// Its id.
        id: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// How it is filtered.
        preset: String,
        /// Keys every random draw.
        seed: u64,
        /// Every parameter of the preset, in words.
        parameters: BTreeMap<String, String>,
        /// `client` or `neighbors`: who brings the context around tiles.
        halo: String,
        /// Whether every pixel is filtered and stored.
        complete: bool,
        /// Whether it takes no more tiles.
        finished: bool,
        /// Tiles filtered and stored; with `neighbors` these are regions, or parts of them.
        tiles_done: u64,
        /// Pixels of the image.
        pixels: u64,
        /// Pixels filtered and stored.
        pixels_done: u64,
        /// Bytes of disk that are set aside for it.
        disk: u64,
        /// Seconds since 1970 at which it is forgotten, if nobody uses it until then.
        expires: u64,
        /// With `neighbors`: cores that have come.
        #[schema(nullable = false)]
        tiles_stored: Option<u64>,
        /// With `neighbors`: their pixels.
        #[schema(nullable = false)]
        pixels_stored: Option<u64>,
        /// With `neighbors`: regions in all.
        #[schema(nullable = false)]
        regions: Option<u64>,
        /// With `neighbors`: regions that are not filtered yet.
        #[schema(nullable = false)]
        regions_open: Option<u64>,
    }

    /// All images.
    struct Images {
        /// By id.
        images: Vec<ListedImage>,
    }

    /// An image's summary; if it cannot be read, only what is known all the same.
    struct ListedImage {
        /// Its id.
        id: String,
        /// Width in pixels.
        #[schema(nullable = false)]
        width: Option<u32>,
        /// Height in pixels.
        #[schema(nullable = false)]
        height: Option<u32>,
        /// How it is filtered.
        #[schema(nullable = false)]
        preset: Option<String>,
        /// Keys every random draw.
        #[schema(nullable = false)]
        seed: Option<u64>,
        /// Every parameter of the preset, in words.
        #[schema(nullable = false)]
        parameters: Option<BTreeMap<String, String>>,
        /// `client` or `neighbors`: who brings the context around tiles.
        #[schema(nullable = false)]
        halo: Option<String>,
        /// Whether every pixel is filtered and stored.
        #[schema(nullable = false)]
        complete: Option<bool>,
        /// Whether it takes no more tiles.
        #[schema(nullable = false)]
        finished: Option<bool>,
        /// Tiles filtered and stored; with `neighbors` these are regions, or parts of them.
        #[schema(nullable = false)]
        tiles_done: Option<u64>,
        /// Pixels of the image.
        #[schema(nullable = false)]
        pixels: Option<u64>,
        /// Pixels filtered and stored.
        #[schema(nullable = false)]
        pixels_done: Option<u64>,
        /// Bytes of disk that are set aside for it.
        #[schema(nullable = false)]
        disk: Option<u64>,
        /// Seconds since 1970 at which it is forgotten, if nobody uses it until then.
        expires: u64,
        /// With `neighbors`: cores that have come.
        #[schema(nullable = false)]
        tiles_stored: Option<u64>,
        /// With `neighbors`: their pixels.
        #[schema(nullable = false)]
        pixels_stored: Option<u64>,
        /// With `neighbors`: regions in all.
        #[schema(nullable = false)]
        regions: Option<u64>,
        /// With `neighbors`: regions that are not filtered yet.
        #[schema(nullable = false)]
        regions_open: Option<u64>,
        /// Which file is damaged, if one is.
        #[schema(nullable = false)]
        damaged: Option<String>,
    }

    /// All about one image.
    struct ImageStatus {
        /// Its id.
        id: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// How it is filtered.
        preset: String,
        /// Keys every random draw.
        seed: u64,
        /// Every parameter of the preset, in words.
        parameters: BTreeMap<String, String>,
        /// `client` or `neighbors`: who brings the context around tiles.
        halo: String,
        /// Whether every pixel is filtered and stored.
        complete: bool,
        /// Whether it takes no more tiles.
        finished: bool,
        /// Tiles filtered and stored; with `neighbors` these are regions, or parts of them.
        tiles_done: u64,
        /// Pixels of the image.
        pixels: u64,
        /// Pixels filtered and stored.
        pixels_done: u64,
        /// Bytes of disk that are set aside for it.
        disk: u64,
        /// Seconds since 1970 at which it is forgotten, if nobody uses it until then.
        expires: u64,
        /// With `neighbors`: cores that have come.
        #[schema(nullable = false)]
        tiles_stored: Option<u64>,
        /// With `neighbors`: their pixels.
        #[schema(nullable = false)]
        pixels_stored: Option<u64>,
        /// With `neighbors`: regions in all.
        #[schema(nullable = false)]
        regions: Option<u64>,
        /// With `neighbors`: regions that are not filtered yet.
        #[schema(nullable = false)]
        regions_open: Option<u64>,
        /// Regions that are not stored: x, y, width, height.
        missing: Vec<[u32; 4]>,
        /// The tiles stored, by rows.
        tiles: Vec<TileStatus>,
        /// Sums of the tiles' reports.
        totals: Totals,
        /// With `neighbors`: the regions that are not filtered, by rows.
        #[schema(nullable = false)]
        waiting: Option<Vec<WaitingRegion>>,
        /// With `neighbors`: what keeps regions from being filtered, until it is tried again.
        trouble: Option<Problem>,
    }

    /// A region that is not filtered yet.
    struct WaitingRegion {
        /// The region: x, y, width, height.
        region: [u32; 4],
        /// `waiting`, `ready` or `running`.
        state: String,
        /// If it waits: what is missing of the pixels that it reads, the first 16.
        #[schema(nullable = false)]
        r#for: Option<Vec<[u32; 4]>>,
        /// If it waits: how many there are.
        #[schema(nullable = false)]
        for_regions: Option<u64>,
    }

    /// A tile that is stored.
    struct TileStatus {
        /// Its core: x, y, width, height.
        tile: [u32; 4],
        /// What happened.
        report: Report,
    }

    /// What happened to a tile.
    struct Report {
        /// Time that filtering took, in seconds.
        seconds: f64,
        /// Samples in the core.
        samples: u64,
        /// Values made finite, by role.
        replaced: Replaced,
        /// Colour values that the spike step set to their pixel's mean.
        spikes: u64,
        /// Sum of the core's pixel values, before.
        energy_in: f64,
        /// The same sum after.
        energy_out: f64,
        /// Energy out over energy in; null for a core that was black.
        energy_ratio: Option<f64>,
        /// Pixels without samples that got their neighbours' mean.
        filled: u64,
        /// Pixels without samples that stayed black.
        unfilled: u64,
        /// Pixels that were passed through, within the tolerance.
        settled: u64,
        /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
        settled_error: f64,
        /// The halo that it had: left, top, right, bottom, in pixels.
        halo: [u32; 4],
        /// The halo that it would need for the same bits as in the whole image.
        halo_needed: [u32; 4],
        /// Whether the halo was enough.
        exact: bool,
        /// Bytes of the planes that were not looked at, over the data window.
        left_out_bytes: u64,
        /// An estimate of the work; null if the method does not tell.
        work: Option<Work>,
    }

    /// An estimate of work, in steps: about the difference of two samples in one column.
    struct Work {
        /// Steps done.
        done: u64,
        /// Steps left out with whole planes.
        planes: u64,
        /// Steps left out for columns that are constant over a neighbourhood.
        columns: u64,
        /// Steps left out for differences that weigh nothing.
        distances: u64,
        /// The share that was left out, 0 to 1.
        saved: f64,
    }

    /// Values that were not finite and were replaced.
    struct Replaced {
        /// Of colours.
        color: u64,
        /// Of features, infinities only.
        feature: u64,
        /// Of random parameters.
        random: u64,
        /// Of film positions.
        film: u64,
    }

    /// Sums of the reports of an image's tiles.
    struct Totals {
        /// Time that filtering took, in seconds.
        seconds: f64,
        /// Tiles.
        tiles: u64,
        /// Pixels.
        pixels: u64,
        /// Samples.
        samples: u64,
        /// Values made finite, by role.
        replaced: Replaced,
        /// Colour values that the spike step set to their pixel's mean.
        spikes: u64,
        /// Sum of the pixel values, before.
        energy_in: f64,
        /// The same sum after.
        energy_out: f64,
        /// Pixels without samples that got their neighbours' mean.
        filled: u64,
        /// Pixels without samples that stayed black.
        unfilled: u64,
        /// Pixels that were passed through, within the tolerance.
        settled: u64,
        /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
        settled_error: f64,
        /// Tiles whose halo was not enough.
        short_of_halo: u64,
        /// The widest halo needed on each side.
        halo_needed: [u32; 4],
        /// Planes that the method did not look at.
        left_out: Vec<LeftOut>,
        /// Bytes of the planes that were not looked at, over the data window.
        left_out_bytes: u64,
        /// An estimate of the work; null if the method does not tell.
        work: Option<Work>,
    }

    /// A plane that tiles did without.
    struct LeftOut {
        /// The plane.
        plane: String,
        /// `constant`, `missing`, `unused` or `equal`.
        reason: String,
        /// How many tiles.
        tiles: u64,
    }

    /// A line of the answer to tiles. What is not said of a state is absent.
    struct TileLine {
        /// `filtered`, `stored`, `repeated`, `error` or `end`; skip what you do not know.
        state: String,
        /// Its core: x, y, width, height; null if it is not known which tile it was.
        tile: Option<[u32; 4]>,
        /// With `error`: what is wrong.
        #[schema(nullable = false)]
        problem: Option<Problem>,
        /// With `end`: tiles filtered, stored or repeated, as a number.
        #[schema(nullable = false)]
        tiles: Option<u64>,
        /// With `end`: tiles refused.
        #[schema(nullable = false)]
        errors: Option<u64>,
    }

    /// What is wrong (RFC 9457). Further members by code: see proto/http.md.
    struct Problem {
        /// `urn:rpfd:problem:` and the code.
        r#type: String,
        /// The kind of problem in words.
        title: String,
        /// The HTTP status.
        status: u16,
        /// What is wrong this time, where, and what would be right.
        detail: String,
        /// For programs to decide by.
        code: String,
        /// The request that it is about, as in the header X-Request-Id; absent within streams.
        #[schema(nullable = false)]
        request_id: Option<String>,
        /// Seconds after which the request is worth repeating.
        #[schema(nullable = false)]
        retry_after: Option<u64>,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Set `RPFD_REGENERATE` to write the copy anew.
    #[test]
    fn the_copy_in_proto_is_this_document() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/openapi.json");
        let document = document();
        if std::env::var_os("RPFD_REGENERATE").is_some() {
            std::fs::write(&path, &document).unwrap();
        }
        let copy = std::fs::read_to_string(&path).unwrap();
        assert!(
            copy == document,
            "proto/openapi.json is not what the code says: set RPFD_REGENERATE=1 and run this again"
        );
    }
}
