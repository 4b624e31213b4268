//! Which call goes where.

use axum::{
    Router,
    http::{Method, StatusCode, Uri},
    middleware::{from_fn_with_state, map_request},
    routing::get,
};

use super::{Shared, auth, body, charge, health, metrics, openapi, problem::Refusal, recover, trace};

pub(super) fn router(service: Shared) -> Router {
    let charged = from_fn_with_state(service.clone(), charge::charge);
    let recovered = from_fn_with_state(service.clone(), recover::recovered);
    openapi::calls()
        .into_iter()
        .fold(Router::new(), |router, call| {
            // Not what says how the service is: that has to be known most when memory is short.
            let free = !call.path.starts_with("/v1/");
            let handlers = if free { call.handlers } else { call.handlers.route_layer(charged.clone()) };
            let of_images = call.path.starts_with("/v1/images");
            router.route(call.path, if of_images { handlers.route_layer(recovered.clone()) } else { handlers })
        })
        .fallback(nothing)
        .method_not_allowed_fallback(not_allowed)
        // The last of these comes first.
        .layer(from_fn_with_state(service.clone(), auth::admit))
        .layer(map_request(body::linger))
        .layer(from_fn_with_state(service.clone(), trace::observe))
        .with_state(service)
}

/// What is served on the address for metrics, which lasts to the very end.
pub(super) fn metrics_router(service: Shared) -> Router {
    Router::new()
        .route("/metrics", get(metrics::metrics))
        .route("/livez", get(health::live))
        .route("/readyz", get(health::ready))
        .fallback(nothing)
        .method_not_allowed_fallback(not_allowed)
        .with_state(service)
}

async fn nothing(uri: Uri) -> Refusal {
    let detail = format!("there is nothing at {}", uri.path());
    Refusal::new(StatusCode::NOT_FOUND, "not_found", "There is no such resource", detail)
}

async fn not_allowed(method: Method, uri: Uri) -> Refusal {
    let detail = format!("{method} means nothing at {}; the header Allow says what does", uri.path());
    Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", "The method is not allowed here", detail)
}
