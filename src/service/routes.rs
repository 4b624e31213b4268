//! Which call goes where.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Instant,
};

use axum::{
    Router,
    extract::{Request, State},
    http::{Method, StatusCode, Uri},
    middleware::{Next, from_fn, from_fn_with_state, map_request},
    response::Response,
    routing::{get, post},
};

use super::{Shared, body, charge, images, problem::Refusal, query::NoQuery, stream};

pub(super) fn router(service: Shared) -> Router {
    Router::new()
        // PUT as well: `curl -T` sends nothing else.
        .route("/v1/filter", post(stream::filter_stream).put(stream::filter_stream))
        .route("/v1/images", post(images::open).get(images::list))
        .route("/v1/images/{id}", get(images::status).delete(images::delete))
        .route("/v1/images/{id}/tiles", post(stream::image_tiles).put(stream::image_tiles))
        .route("/v1/images/{id}/result.exr", get(images::result))
        .route("/v1/images/{id}/preview.png", get(images::preview))
        .route_layer(from_fn_with_state(Arc::clone(&service), charge::charge))
        .route("/livez", get(async |_: NoQuery| "alive\n"))
        .route("/readyz", get(ready))
        .fallback(nothing)
        .method_not_allowed_fallback(not_allowed)
        .layer(map_request(body::linger))
        .layer(from_fn(log))
        .with_state(service)
}

async fn ready(State(service): State<Shared>, _: NoQuery) -> Result<&'static str, Refusal> {
    if service.draining.load(Ordering::Relaxed) {
        let detail = "it finishes what it has begun and takes nothing new";
        return Err(Refusal::new(StatusCode::SERVICE_UNAVAILABLE, "draining", "The service is stopping", detail));
    }
    Ok("ready\n")
}

async fn nothing(uri: Uri) -> Refusal {
    let detail = format!("there is nothing at {}", uri.path());
    Refusal::new(StatusCode::NOT_FOUND, "not_found", "There is no such resource", detail)
}

async fn not_allowed(method: Method, uri: Uri) -> Refusal {
    let detail = format!("{method} means nothing at {}; the header Allow says what does", uri.path());
    Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", "The method is not allowed here", detail)
}

/// One line a request, when its answer begins.
async fn log(request: Request, next: Next) -> Response {
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let started = Instant::now();
    let response = next.run(request).await;
    let seconds = started.elapsed().as_secs_f64();
    tracing::info!(%method, path, status = response.status().as_u16(), seconds, "request");
    response
}
