//! What went wrong, as an answer: RFC 9457 problems with stable codes.

use axum::{
    body::Body,
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};

use crate::{
    admission::AdmissionError,
    filter::{ParameterError, Rect, samples::SampleError},
    image::ImageError,
    picture::PictureError,
    stitch::{ExrError, StitchError},
    wire::{Problem, WireError},
};

/// Most seconds after which a client is asked to come again.
const MAX_RETRY_AFTER: f64 = 600.0;

/// An answer that is not what was asked for.
#[derive(Debug)]
pub(super) struct Refusal(pub(super) Box<Problem>);

impl<P: Into<Problem>> From<P> for Refusal {
    fn from(problem: P) -> Self {
        Self(Box::new(problem.into()))
    }
}

impl Refusal {
    pub(super) fn new(status: StatusCode, code: &str, title: &str, detail: impl Into<String>) -> Self {
        Problem::new(status.as_u16(), code, title, detail).into()
    }
}

/// The problem that an answer is, beside it, for whoever passes it on.
#[derive(Clone, Debug)]
pub(super) struct Said(pub(super) Box<Problem>);

impl Said {
    /// The answer, which says too which request it is about.
    pub(super) fn with_request_id(self, id: &str, mut answer: Response) -> Response {
        answer.headers_mut().remove(header::CONTENT_LENGTH);
        answer.map(|_| Body::from(json(&self.0.with("request_id", id))))
    }
}

/// A problem is strings and numbers, which always can be written.
fn json(problem: &Problem) -> Vec<u8> {
    serde_json::to_vec(problem).unwrap_or_default()
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.0.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let kind = HeaderValue::from_static("application/problem+json");
        let mut response = (status, [(header::CONTENT_TYPE, kind)], json(&self.0)).into_response();
        if status == StatusCode::UNAUTHORIZED {
            let known = if self.0.code == "missing_token" { "" } else { ", error=\"invalid_token\"" };
            if let Ok(value) = HeaderValue::try_from(format!("Bearer realm=\"rpfd\"{known}")) {
                response.headers_mut().insert(header::WWW_AUTHENTICATE, value);
            }
        }
        if let Some(seconds) = self.0.more.get("retry_after").and_then(serde_json::Value::as_u64) {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        response.extensions_mut().insert(Said(self.0));
        response
    }
}

/// A rectangle as JSON has it: `[x, y, width, height]`.
pub(super) fn corners(rect: Rect) -> [u32; 4] {
    [rect.x, rect.y, rect.width, rect.height]
}

/// An error of ours; the detail stays in the log.
pub(super) fn internal(detail: impl std::fmt::Display) -> Problem {
    tracing::error!(%detail, "internal error");
    Problem::new(500, "internal", "The service failed", "an internal error; the service's log says more")
}

/// The disk or the file system refused.
pub(super) fn storage(code: &str, detail: impl std::fmt::Display) -> Problem {
    if code == "stopped" {
        return Problem::new(503, "stopped", "The work was stopped", "the client has gone, or the image");
    }
    tracing::error!(%detail, code, "storage error");
    match code {
        "disk-full" => Problem::new(507, "disk_full", "The service's disk is full", "the data folder takes no more"),
        "damaged" => {
            let advice = "delete the image, and send it anew";
            Problem::new(500, "damaged", "A file of the image is damaged", format!("{detail}: {advice}"))
        }
        _ => Problem::new(500, "storage", "The service's disk failed", "an I/O error; the service's log says more"),
    }
}

impl From<std::io::Error> for Refusal {
    fn from(error: std::io::Error) -> Self {
        let full = crate::disk::is_full(&error);
        storage(if full { "disk-full" } else { "io" }, error).into()
    }
}

impl From<WireError> for Problem {
    fn from(error: WireError) -> Self {
        Self::from(&error)
    }
}

impl From<SampleError> for Problem {
    fn from(error: SampleError) -> Self {
        Self::new(400, "bad_counts", "The samples do not fit their shape", error.to_string())
    }
}

impl From<ParameterError> for Problem {
    fn from(error: ParameterError) -> Self {
        let code = match error {
            ParameterError::Preset(_) => "unknown_preset",
            ParameterError::Name { .. } => "unknown_parameter",
            ParameterError::Value { .. } => "bad_parameter",
        };
        Self::new(400, code, "How to filter is not understood", error.to_string())
    }
}

impl From<AdmissionError> for Problem {
    fn from(error: AdmissionError) -> Self {
        let detail = error.to_string();
        match error {
            AdmissionError::TooLarge { needed, total } => {
                Self::new(413, error.code(), "The tile needs more memory than the service has", detail)
                    .with("needed", needed)
                    .with("available", total)
            }
            AdmissionError::Busy { needed, retry_after, .. } => {
                let seconds = retry_after.as_secs_f64().ceil().min(MAX_RETRY_AFTER) as u64;
                Self::new(503, error.code(), "The service's memory is in use", detail)
                    .with("needed", needed)
                    .with("retry_after", seconds.max(1))
            }
        }
    }
}

impl From<StitchError> for Problem {
    fn from(error: StitchError) -> Self {
        let detail = error.to_string();
        let code = error.code().replace('-', "_");
        match &error {
            StitchError::Geometry(_) => Self::new(400, "bad_geometry", "The geometry is impossible", detail),
            StitchError::Overlap { other, .. } => {
                Self::new(409, &code, "The tile overlaps another", detail).with("other", corners(*other).to_vec())
            }
            StitchError::Conflict(_) => Self::new(409, &code, "The tile is there with other samples", detail),
            StitchError::Busy(_) => Self::new(409, &code, "The tile is being made from other samples", detail),
            StitchError::Superseded(_) => Self::new(409, &code, "The tile was replaced by a later one", detail),
            StitchError::Incomplete { .. } => Self::new(409, &code, "The image is not complete", detail),
            StitchError::Exr(ExrError::TileSize(_) | ExrError::Attribute(_)) => {
                Self::new(400, "bad_parameter", "The EXR cannot be like that", detail)
            }
            StitchError::Canvas(inner) => storage(inner.code(), detail),
            StitchError::Exr(inner) => storage(inner.code(), detail),
            StitchError::Mismatch(_) => internal(detail),
        }
    }
}

impl From<ImageError> for Problem {
    fn from(error: ImageError) -> Self {
        let detail = error.to_string();
        match error {
            _ if error.is_damage() => storage("damaged", detail),
            _ if error.is_full() => storage("disk-full", detail),
            ImageError::Stitch(error) => error.into(),
            ImageError::Finished => Self::new(409, "image_finished", "The image takes no more tiles", detail),
            ImageError::TooManyTiles => Self::new(422, "too_many_tiles", "The image has too many tiles", detail),
            ImageError::Channels => Self::new(422, "channel_mismatch", "The tile is not of this image", detail),
            ImageError::TooSmall(_) => Self::new(422, "tile_too_small", "The tile is too small", detail),
            ImageError::SampleCount { .. } => {
                Self::new(422, "samples_mismatch", "The tile's samples are not as announced", detail)
            }
            ImageError::TooLarge { needed, most, .. } => {
                let title = "The tile needs more memory than the service has";
                Self::new(413, "over_memory", title, detail).with("needed", needed).with("available", most)
            }
            ImageError::Stopped(_) => storage("stopped", detail),
            _ => storage("io", detail),
        }
    }
}

impl From<ExrError> for Problem {
    fn from(error: ExrError) -> Self {
        StitchError::from(error).into()
    }
}

impl From<PictureError> for Problem {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Encode(detail) => internal(detail),
            error => storage(error.code(), error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_problem_json_and_says_when_to_come_again() {
        for (millis, seconds) in [(0, "1"), (1000, "1"), (1001, "2"), (90_000, "90"), (9_999_999_999, "600")] {
            let [waited, retry_after] = [200, millis].map(std::time::Duration::from_millis);
            let refusal = Refusal::from(AdmissionError::Busy { needed: 5, waited, retry_after });
            let response = refusal.into_response();
            assert_eq!(response.status(), 503);
            assert_eq!(response.headers()["content-type"], "application/problem+json");
            assert_eq!(response.headers()["retry-after"], seconds);
        }
    }

    #[test]
    fn codes_are_snake_case() {
        let rect = Rect::new(0, 0, 1, 1);
        for error in [StitchError::Conflict(rect), StitchError::Overlap { core: rect, other: rect }] {
            let problem = Problem::from(error);
            assert!(problem.code.bytes().all(|b| b == b'_' || b.is_ascii_lowercase()), "{}", problem.code);
        }
    }
}
