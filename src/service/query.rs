//! What a request asks for: how to filter, in which form to answer.

use std::collections::BTreeMap;

use axum::{
    extract::Query,
    http::{HeaderMap, StatusCode, Uri, header},
};
use serde_json::Value;

use super::problem::Refusal;
use crate::{
    filter::{Method, method::DEFAULT_PRESET},
    stitch::{
        ExrOptions,
        exr::{ExrCompression, ExrLayout, ExrSamples, provenance},
    },
};

fn refuse(code: &str, detail: String) -> Refusal {
    Refusal::new(StatusCode::BAD_REQUEST, code, "The request is not understood", detail)
}

fn bad_parameter(name: &str, value: &str, right: &str) -> Refusal {
    refuse("bad_parameter", format!("{name} = {value:?}: {right}"))
}

/// The parameters of a request by name, taken out one by one; what is left at the end is unknown.
#[derive(Debug)]
pub(super) struct Parameters(BTreeMap<String, String>, Option<Value>);

impl Parameters {
    /// Of a query. A name may occur once.
    pub(super) fn of_query(uri: &Uri) -> Result<Self, Refusal> {
        let pairs = Query::<Vec<(String, String)>>::try_from_uri(uri)
            .map_err(|error| refuse("bad_query", format!("the query cannot be read: {error}")))?;
        let mut all = BTreeMap::new();
        for (name, value) in pairs.0 {
            if all.contains_key(&name) {
                return Err(refuse("duplicate_parameter", format!("{name:?} occurs twice: each may occur once")));
            }
            all.insert(name, value);
        }
        Ok(Self(all, None))
    }

    /// Of a JSON object: numbers, texts, bools, and lists of these. Its `channels` may be anything.
    pub(super) fn of_json(body: &[u8]) -> Result<Self, Refusal> {
        let value: Value = serde_json::from_slice(body)
            .map_err(|error| refuse("bad_json", format!("the body is not the JSON that it should be: {error}")))?;
        let Value::Object(mut object) = value else {
            return Err(refuse("bad_json", "the body must be a JSON object".to_owned()));
        };
        let mut all = BTreeMap::new();
        let channels = object.remove("channels");
        for (name, value) in object {
            let Some(words) = words(&value, true) else {
                let right = "must be a number, a text, true or false, or a list of them";
                return Err(bad_parameter(&name, &value.to_string(), right));
            };
            all.insert(name, words);
        }
        Ok(Self(all, channels))
    }

    /// Takes out the channels.
    pub(super) fn channels(&mut self) -> Option<Value> {
        self.1.take()
    }

    /// Takes out a parameter.
    pub(super) fn take(&mut self, name: &str) -> Option<String> {
        self.0.remove(name)
    }

    /// Takes out a number.
    pub(super) fn number<T: std::str::FromStr>(&mut self, name: &str) -> Result<Option<T>, Refusal> {
        let read = |text: String| text.parse().map_err(|_| bad_parameter(name, &text, "must be a whole number"));
        self.take(name).map(read).transpose()
    }

    /// Takes out one of several words, by the value that it stands for.
    fn choice<T: Copy>(&mut self, name: &str, choices: &[(&str, T)]) -> Result<Option<T>, Refusal> {
        let Some(text) = self.take(name) else { return Ok(None) };
        let known = || choices.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
        match choices.iter().find(|(name, _)| *name == text) {
            Some((_, value)) => Ok(Some(*value)),
            None => Err(bad_parameter(name, &text, &format!("must be one of {}", known()))),
        }
    }

    /// Takes out a yes or no; absent means no, present without a value yes.
    pub(super) fn flag(&mut self, name: &str) -> Result<bool, Refusal> {
        let choices =
            [("true", true), ("on", true), ("1", true), ("", true), ("false", false), ("off", false), ("0", false)];
        Ok(self.choice(name, &choices)?.unwrap_or(false))
    }

    /// Takes out whether what can have no effect is left out; absent means yes.
    pub(super) fn leave_out(&mut self) -> Result<bool, Refusal> {
        let choices = [("on", true), ("true", true), ("off", false), ("false", false)];
        Ok(self.choice("leave_out", &choices)?.unwrap_or(true))
    }

    /// Takes out whether tiles lend each other their halos; absent means no.
    pub(super) fn neighbors(&mut self) -> Result<bool, Refusal> {
        Ok(self.choice("halo", &[("client", false), ("neighbors", true)])?.unwrap_or(false))
    }

    /// Takes out everything that is left: preset, seed, and the preset's parameters.
    pub(super) fn method(mut self) -> Result<(Method, u64), Refusal> {
        if self.1.is_some() {
            let right = "only images with \"halo\": \"neighbors\" are told of channels";
            return Err(refuse("bad_parameter", format!("channels: {right}")));
        }
        let preset = self.take("preset").unwrap_or_else(|| DEFAULT_PRESET.to_owned());
        let seed = self.number("seed")?.unwrap_or(0);
        Ok((Method::with(&preset, self.0)?, seed))
    }

    /// Takes out everything that is left: what an EXR is to be like.
    pub(super) fn exr(mut self) -> Result<ExrOptions, Refusal> {
        let samples = self.choice("samples", &ExrSamples::NAMES)?.unwrap_or_default();
        let compression = self.choice("compression", &ExrCompression::NAMES)?.unwrap_or_default();
        let tiled = self.choice("layout", &[("scanlines", false), ("tiles", true)])?;
        let size = self.number::<u32>("tile")?;
        let layout = match (tiled, size) {
            (Some(false), Some(size)) => {
                return Err(bad_parameter("tile", &size.to_string(), "means nothing with layout=scanlines"));
            }
            (_, Some(size)) => ExrLayout::Tiles(size),
            (Some(true), None) => ExrLayout::Tiles(64),
            _ => ExrLayout::Scanlines,
        };
        self.done("samples, compression, layout, tile, partial")?;
        Ok(ExrOptions { samples, compression, layout, ..ExrOptions::default() })
    }

    /// Refuses what is left.
    pub(super) fn done(self, known: &str) -> Result<(), Refusal> {
        match self.0.into_keys().next() {
            Some(name) => Err(refuse("unknown_parameter", format!("unknown parameter {name:?}: known are {known}"))),
            None => Ok(()),
        }
    }
}

/// A JSON value in words, as [`Method::with`] reads them.
fn words(value: &Value, list: bool) -> Option<String> {
    match value {
        Value::Number(number) => Some(number.to_string()),
        Value::String(text) => Some(text.clone()),
        Value::Bool(on) => Some(if *on { "on" } else { "off" }.to_owned()),
        Value::Array(values) if list => {
            Some(values.iter().map(|value| words(value, false)).collect::<Option<Vec<_>>>()?.join(","))
        }
        _ => None,
    }
}

/// The attributes of an EXR that was filtered so.
pub(super) fn attributes(method: &Method, seed: u64) -> BTreeMap<String, String> {
    provenance(method.preset_name(), seed, method.parameters())
}

/// In which form results are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// A result stream.
    Messages,
    /// One tile's core as an EXR.
    Exr,
    /// One tile's core as a PNG.
    Png,
}

impl Form {
    /// The content type.
    pub(super) const fn media(self) -> &'static str {
        match self {
            Self::Messages => "application/msgpack",
            Self::Exr => "image/x-exr",
            Self::Png => "image/png",
        }
    }

    /// The form that the client likes best; result streams if it does not say.
    pub(super) fn accepted(headers: &HeaderMap) -> Result<Self, Refusal> {
        let mut best: Option<(f32, Self)> = None;
        let mut asked = false;
        for value in headers.get_all(header::ACCEPT) {
            let ranges = value.to_str().unwrap_or("?").split(',').map(str::trim).filter(|range| !range.is_empty());
            for range in ranges {
                asked = true;
                let mut parts = range.split(';').map(str::trim);
                let form = match parts.next().unwrap_or_default().to_ascii_lowercase().as_str() {
                    "*/*"
                    | "application/*"
                    | "application/msgpack"
                    | "application/x-msgpack"
                    | "application/vnd.msgpack" => Self::Messages,
                    "image/*" | "image/x-exr" | "image/aces" => Self::Exr,
                    "image/png" => Self::Png,
                    _ => continue,
                };
                let quality = parts.find_map(|p| p.strip_prefix("q=")).and_then(|q| q.parse().ok()).unwrap_or(1.0);
                if quality > best.map_or(0.0, |(quality, _)| quality) {
                    best = Some((quality, form));
                }
            }
        }
        match best {
            Some((_, form)) => Ok(form),
            None if !asked => Ok(Self::Messages),
            None => Err(Refusal::new(
                StatusCode::NOT_ACCEPTABLE,
                "not_acceptable",
                "There is no such form of the answer",
                "this answers in application/msgpack, image/x-exr or image/png",
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn query(query: &str) -> Result<Parameters, Refusal> {
        Parameters::of_query(&format!("/x?{query}").parse().unwrap())
    }

    fn code<T>(result: Result<T, Refusal>) -> String {
        result.map_or_else(|refusal| refusal.0.code, |_| "ok".to_owned())
    }

    #[test]
    fn a_method_is_the_same_in_query_and_json() {
        let of_query = query("preset=lean&seed=7&boxes=9,5&spikes=off&bins=9").unwrap().method().unwrap();
        let json = br#"{"preset": "lean", "seed": 7, "boxes": [9, 5], "spikes": false, "bins": "9"}"#;
        assert_eq!(Parameters::of_json(json).unwrap().method().unwrap(), of_query);
        assert_eq!(of_query.1, 7);
        assert_eq!(query("boxes=9%2C5&spikes=off&bins=9").unwrap().method().unwrap().0, of_query.0);
        assert_eq!(query("").unwrap().method().unwrap(), (Method::default(), 0));
    }

    #[test]
    fn leaving_out_is_on_unless_it_is_off() {
        let leave_out = |text: &str| query(text).and_then(|mut parameters| parameters.leave_out());
        assert!(leave_out("").unwrap() && leave_out("leave_out=on").unwrap() && !leave_out("leave_out=off").unwrap());
        assert_eq!(code(leave_out("leave_out=maybe")), "bad_parameter");
        assert!(!Parameters::of_json(br#"{"leave_out": false}"#).unwrap().leave_out().unwrap());
    }

    #[test]
    fn what_is_not_understood_is_refused() {
        let method = |text: &str| code(query(text).and_then(Parameters::method));
        assert_eq!(method("seed=-1"), "bad_parameter");
        assert_eq!(method("seed=18446744073709551615"), "ok");
        assert_eq!(method("preset=leen"), "unknown_preset");
        assert_eq!(method("presett=lean"), "unknown_parameter");
        assert_eq!(method("boxes=8,5"), "bad_parameter");
        assert_eq!(method("seed=1&seed=1"), "duplicate_parameter");
        let json = |text: &str| code(Parameters::of_json(text.as_bytes()).and_then(Parameters::method));
        assert_eq!(json("{"), "bad_json");
        assert_eq!(json("[]"), "bad_json");
        assert_eq!(json(r#"{"boxes": [[9], 5]}"#), "bad_parameter");
        assert_eq!(json(r#"{"seed": null}"#), "bad_parameter");
        assert_eq!(json(r#"{"seed": 1.5}"#), "bad_parameter");
    }

    #[test]
    fn exr_options_are_checked() {
        let exr = |text: &str| query(text).and_then(Parameters::exr);
        let options = exr("samples=half&compression=piz&tile=32").unwrap();
        assert_eq!((options.samples, options.compression), (ExrSamples::Half, ExrCompression::Piz));
        assert_eq!(options.layout, ExrLayout::Tiles(32));
        assert_eq!(exr("layout=tiles").unwrap().layout, ExrLayout::Tiles(64));
        assert_eq!(code(exr("layout=scanlines&tile=32")), "bad_parameter");
        assert_eq!(code(exr("samples=quarter")), "bad_parameter");
        assert_eq!(code(exr("compress=zip")), "unknown_parameter");
    }

    #[test]
    fn the_best_form_wins() {
        let form = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT, text.parse().unwrap());
            Form::accepted(&headers).ok()
        };
        assert_eq!(Form::accepted(&HeaderMap::new()).ok(), Some(Form::Messages));
        assert_eq!(form("*/*"), Some(Form::Messages));
        assert_eq!(form("image/png"), Some(Form::Png));
        assert_eq!(form("text/html, image/png;q=0.5, image/x-exr; q=0.8"), Some(Form::Exr));
        assert_eq!(form("text/html"), None);
        assert_eq!(form("image/png;q=0"), None);
    }
}
