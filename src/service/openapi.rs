//! The contract for programs: an OpenAPI document, made from the calls below. `proto/openapi.json` is a copy of it.
//!
//! Each call has one entry in [`calls`], from which the router is built too. The schemas are in
//! `schemas.rs`.

use std::{collections::BTreeMap, sync::LazyLock};

use axum::{
    http::header,
    response::IntoResponse,
    routing::{MethodRouter, get, post},
};
use utoipa::openapi::{
    ComponentsBuilder, Content, HttpMethod, InfoBuilder, LicenseBuilder, ObjectBuilder, OpenApiBuilder, PathItem,
    PathsBuilder, Ref, Required, ResponseBuilder, SecurityRequirement, Type,
    path::{OperationBuilder, ParameterBuilder, ParameterIn},
    request_body::RequestBodyBuilder,
    security::{HttpAuthScheme, HttpBuilder, SecurityScheme},
};

use super::{Shared, health, images, query::NoQuery, schemas, stream};
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
        .schema_from::<schemas::OpenImage>()
        .schema_from::<schemas::Image>()
        .schema_from::<schemas::Images>()
        .schema_from::<schemas::ListedImage>()
        .schema_from::<schemas::OpenChannel>()
        .schema_from::<schemas::WaitingRegion>()
        .schema_from::<schemas::ImageStatus>()
        .schema_from::<schemas::TileStatus>()
        .schema_from::<schemas::Report>()
        .schema_from::<schemas::Replaced>()
        .schema_from::<schemas::Work>()
        .schema_from::<schemas::Totals>()
        .schema_from::<schemas::LeftOut>()
        .schema_from::<schemas::TileLine>()
        .schema_from::<schemas::Problem>()
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
    // One for all: who reads it is not asked for memory.
    static DOCUMENT: LazyLock<String> = LazyLock::new(document);
    ([(header::CONTENT_TYPE, "application/json")], DOCUMENT.as_str())
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
