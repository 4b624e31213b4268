//! Problems as RFC 9457 has them, with a stable code: what a service answers when it cannot do what it was asked.

use serde::{Deserialize, Serialize};

use super::{Fault, WireError};

/// A problem (RFC 9457): in JSON `application/problem+json`, in MessagePack the `problem` of an `error` message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Problem {
    /// A URI that names the kind of problem: `urn:rpfd:problem:` and the code.
    #[serde(rename = "type", default)]
    pub kind: String,
    /// The kind of problem in words, the same for every problem of its code.
    #[serde(default)]
    pub title: String,
    /// The HTTP status that it has or would have.
    #[serde(default)]
    pub status: u16,
    /// What is wrong this time, where, and what would be right.
    #[serde(default)]
    pub detail: String,
    /// A URI that names this one occurrence.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instance: Option<String>,
    /// A stable `snake_case` word for programs to decide by.
    #[serde(default)]
    pub code: String,
    /// Further members, by kind of problem.
    #[serde(flatten)]
    pub more: serde_json::Map<String, serde_json::Value>,
}

impl Problem {
    /// A problem of this HTTP status and code.
    pub fn new(status: u16, code: &str, title: impl Into<String>, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("urn:rpfd:problem:{code}"),
            title: title.into(),
            status,
            detail: detail.into(),
            instance: None,
            code: code.to_owned(),
            more: serde_json::Map::new(),
        }
    }

    /// With one further member.
    pub fn with(mut self, name: &str, value: impl Into<serde_json::Value>) -> Self {
        self.more.insert(name.to_owned(), value.into());
        self
    }
}

impl std::fmt::Display for Problem {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({}): {}", self.title, self.code, self.detail)
    }
}

impl From<&WireError> for Problem {
    fn from(error: &WireError) -> Self {
        let (status, title) = match error.fault {
            Fault::TooLarge(_) | Fault::HeaderTooLarge { .. } => (413, "The tile is larger than any tile may be"),
            _ => (400, "The stream cannot be read"),
        };
        Self::new(status, error.code(), title, error.to_string())
            .with("offset", error.offset)
            .with("index", error.index)
    }
}
