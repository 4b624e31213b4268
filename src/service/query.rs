//! What a request asks for: how to filter, in which form to answer.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    fmt,
};

use axum::{
    extract::{FromRequestParts, Query},
    http::{HeaderMap, StatusCode, Uri, header, request::Parts},
};
use serde::{
    Deserialize, Deserializer,
    de::{MapAccess, Visitor},
};
use serde_json::Value;

use super::problem::Refusal;
use crate::{
    filter::{Method, ParameterError, method::DEFAULT_PRESET},
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

/// The pairs of a JSON object as they stand there.
struct Object(Vec<(String, Value)>);

impl<'de> Deserialize<'de> for Object {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Pairs;
        impl<'de> Visitor<'de> for Pairs {
            type Value = Object;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Object, A::Error> {
                let mut pairs = Vec::new();
                while let Some(pair) = map.next_entry()? {
                    pairs.push(pair);
                }
                Ok(Object(pairs))
            }
        }
        deserializer.deserialize_map(Pairs)
    }
}

fn add(all: &mut BTreeMap<String, String>, name: String, value: String) -> Result<(), Refusal> {
    match all.entry(name) {
        Entry::Vacant(entry) => {
            entry.insert(value);
            Ok(())
        }
        Entry::Occupied(entry) => {
            let detail = format!("{:?} occurs twice: each may occur once", entry.key());
            Err(refuse("duplicate_parameter", detail))
        }
    }
}

/// For calls that take no parameters.
pub(super) struct NoQuery;

impl<S: Sync> FromRequestParts<S> for NoQuery {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Refusal> {
        Parameters::of_query(&parts.uri)?.done("none")?;
        Ok(Self)
    }
}

impl Parameters {
    /// Of a query. A name may occur once.
    pub(super) fn of_query(uri: &Uri) -> Result<Self, Refusal> {
        let pairs = Query::<Vec<(String, String)>>::try_from_uri(uri)
            .map_err(|error| refuse("bad_query", format!("the query cannot be read: {error}")))?;
        let mut all = BTreeMap::new();
        for (name, value) in pairs.0 {
            add(&mut all, name, value)?;
        }
        Ok(Self(all, None))
    }

    /// Of a JSON object: numbers, texts, bools, and lists of these. A name may occur once. Its `channels` may be anything.
    pub(super) fn of_json(body: &[u8]) -> Result<Self, Refusal> {
        let object: Object = serde_json::from_slice(body).map_err(|error| {
            refuse("bad_json", format!("the body is not the JSON object that it should be: {error}"))
        })?;
        let (mut all, mut channels) = (BTreeMap::new(), None);
        for (name, value) in object.0 {
            if name == "channels" {
                if channels.replace(value).is_some() {
                    return Err(refuse("duplicate_parameter", format!("{name:?} occurs twice: each may occur once")));
                }
                continue;
            }
            let Some(words) = words(&value, true) else {
                let right = "must be a number, a text, true or false, or a list of them";
                return Err(bad_parameter(&name, &value.to_string(), right));
            };
            add(&mut all, name, words)?;
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
        let method = Method::with(&preset, self.0).map_err(|error| {
            let unknown = matches!(error, ParameterError::Name { .. });
            let mut refusal = Refusal::from(error);
            if unknown {
                refusal.0.detail += "; beside these there are preset, seed and leave_out";
            }
            refusal
        })?;
        Ok((method, seed))
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

    /// In order of preference, where the client has none.
    const ALL: [Self; 3] = [Self::Messages, Self::Exr, Self::Png];

    /// How closely a media range of `Accept` describes this form, if it does: 1 for any, 2 for the type, 3 for itself.
    fn matched(self, range: &str) -> Option<u8> {
        let (kind, names): (_, &[&str]) = match self {
            Self::Messages => {
                ("application/*", &["application/msgpack", "application/x-msgpack", "application/vnd.msgpack"])
            }
            Self::Exr => ("image/*", &["image/x-exr", "image/aces"]),
            Self::Png => ("image/*", &["image/png"]),
        };
        match range {
            "*/*" => Some(1),
            range if range == kind => Some(2),
            range => names.contains(&range).then_some(3),
        }
    }

    /// The form that the client likes best; result streams if it does not say.
    pub(super) fn accepted(headers: &HeaderMap) -> Result<Self, Refusal> {
        let values = headers.get_all(header::ACCEPT).into_iter();
        let text: Vec<_> = values.map(|value| value.to_str().unwrap_or("?").to_ascii_lowercase()).collect();
        let ranges = text.iter().flat_map(|value| value.split(',')).map(str::trim).filter(|range| !range.is_empty());
        let ranges: Vec<(&str, f32)> = ranges
            .map(|range| {
                let (range, parameters) = range.split_once(';').unwrap_or((range, ""));
                let quality = parameters.split(';').find_map(|p| p.trim().strip_prefix("q="));
                (range.trim_end(), quality.map_or(1.0, |quality| quality.trim().parse().unwrap_or(0.0)))
            })
            .collect();
        if ranges.is_empty() {
            return Ok(Self::Messages);
        }
        // What is said of a form most closely decides on it; of equals the first that was said.
        let mut best: Option<(f32, usize, Self)> = None;
        for form in Self::ALL {
            let said = ranges.iter().enumerate().filter_map(|(at, (range, quality))| {
                form.matched(range).map(|closeness| (closeness, std::cmp::Reverse(at), *quality))
            });
            let Some((_, std::cmp::Reverse(at), quality)) = said.max_by_key(|(closeness, at, _)| (*closeness, *at))
            else {
                continue;
            };
            let better = best.is_none_or(|(other, place, _)| quality > other || (quality == other && at < place));
            if quality > 0.0 && better {
                best = Some((quality, at, form));
            }
        }
        best.map(|(_, _, form)| form).ok_or_else(|| {
            Refusal::new(
                StatusCode::NOT_ACCEPTABLE,
                "not_acceptable",
                "There is no such form of the answer",
                "this answers in application/msgpack, image/x-exr or image/png",
            )
        })
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
        assert_eq!(json(r#"{"seed": 1} x"#), "bad_json");
        assert_eq!(json(r#"{"seed": 1, "bins": 9, "seed": 1}"#), "duplicate_parameter");
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
        assert_eq!(form("image/png;q=0, image/*"), Some(Form::Exr));
        assert_eq!(form("*/*, application/msgpack;q=0"), Some(Form::Exr));
        assert_eq!(form("*/*;q=0.1, Image/PNG; v=1; Q=0.2, application/*;q=0"), Some(Form::Png));
        assert_eq!(form("image/*;q=0.5, image/x-exr;q=0.4"), Some(Form::Png));
        assert_eq!(form("image/png, application/msgpack"), Some(Form::Png));
        assert_eq!(form("image/png;q=nan, image/aces;q=x"), None);
    }
}
