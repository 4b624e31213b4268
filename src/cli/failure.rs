//! Why a command did not do what it was asked to.

use crate::{
    client::ClientError,
    filter::{ParameterError, Rect, Stopped},
    picture::PictureError,
    stitch::{CanvasError, ExrError, StitchError, atomic::AtomicError},
    store::spool::SpoolError,
    synth::SynthError,
    wire::file::FileError,
};
use std::process::ExitCode;

/// Why a command did not do what it was asked to.
#[derive(Debug)]
pub(crate) struct Failure {
    kind: FailureKind,
    /// Stable word for scripts, like `truncated`.
    code: String,
    message: String,
}

/// What a failure exits with.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FailureKind {
    /// Something went wrong here.
    Failed = 1,
    /// The command line does not make sense.
    Usage = 2,
    /// The input is not what it should be.
    Input = 3,
    /// The service said no.
    Refused = 4,
}

impl Failure {
    pub(crate) fn new(kind: FailureKind, code: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self { kind, code: code.into().replace('-', "_"), message: message.to_string() }
    }

    pub(crate) fn failed(code: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self::new(FailureKind::Failed, code, message)
    }

    pub(crate) fn usage(code: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self::new(FailureKind::Usage, code, message)
    }

    pub(crate) fn input(code: impl Into<String>, message: impl std::fmt::Display) -> Self {
        Self::new(FailureKind::Input, code, message)
    }

    /// An output file of tiles that could not be written; where they are read, faults are the input's.
    pub(crate) fn output(error: &FileError) -> Self {
        Self::failed(error.code(), error)
    }

    /// Says it on standard error, and what to exit with.
    pub(crate) fn report(&self, json: bool) -> ExitCode {
        let Self { kind, code, message } = self;
        if json {
            let exit = *kind as u8;
            eprintln!("{}", serde_json::json!({ "error": { "code": code, "message": message, "exit": exit } }));
        } else {
            eprintln!("rpfd: {message} ({code})");
        }
        ExitCode::from(*kind as u8)
    }
}

/// The first few rectangles, in words.
pub(crate) fn list(rects: &[Rect]) -> String {
    let shown: Vec<_> = rects.iter().take(8).map(Rect::to_string).collect();
    let more = if rects.len() > 8 { format!(" and {} more", rects.len() - 8) } else { String::new() };
    format!("{}{more}", shown.join(", "))
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        Self::input(error.code(), &error)
    }
}

impl From<ParameterError> for Failure {
    fn from(error: ParameterError) -> Self {
        Self::usage("parameter", error)
    }
}

impl From<SpoolError> for Failure {
    fn from(error: SpoolError) -> Self {
        let kind = match error {
            SpoolError::Io(_) | SpoolError::Full { .. } => FailureKind::Failed,
            _ => FailureKind::Input,
        };
        Self::new(kind, error.code(), error)
    }
}

impl From<Stopped> for Failure {
    fn from(_: Stopped) -> Self {
        Self::failed("interrupted", "interrupted")
    }
}

impl From<SynthError> for Failure {
    fn from(error: SynthError) -> Self {
        match error {
            SynthError::Stopped => Stopped.into(),
            other => Self::usage("too_large", other),
        }
    }
}

impl From<ClientError> for Failure {
    fn from(error: ClientError) -> Self {
        let kind = match error {
            ClientError::Refused { .. } => FailureKind::Refused,
            ClientError::Url(_) | ClientError::Token => FailureKind::Usage,
            ClientError::Stopped => return Stopped.into(),
            _ => FailureKind::Failed,
        };
        Self::new(kind, error.code(), &error)
    }
}

/// Errors of what is written: nobody's fault but this machine's.
macro_rules! failed {
    ($($error:ty),*) => { $(
        impl From<$error> for Failure {
            fn from(error: $error) -> Self {
                Self::failed(error.code(), error)
            }
        }
    )* };
}

failed!(AtomicError, CanvasError, ExrError, PictureError, StitchError);
