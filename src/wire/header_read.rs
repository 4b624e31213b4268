//! Reads the map of a header out of its bytes, every mistake with the name of its key and what would be right.

use super::{
    Fault, Format, Header, SampleCounts, VERSION,
    header::{Extra, KEYS, Own, check_film},
    token::{self, Token, head_len, object_len},
    value::Number,
};
use crate::filter::{Channel, ChannelSet, Halo, Rect, Role, TileGeometry};

/// A map of a few keys, split into the raw bytes of each value; nothing in it is interpreted yet.
pub(super) struct Fields<'a> {
    /// What the map is, for messages: the header, or a channel.
    of: String,
    fields: Vec<(&'a str, &'a [u8])>,
}

impl<'a> Fields<'a> {
    /// Splits the map that is all of `bytes`.
    pub(super) fn read(of: &str, bytes: &'a [u8]) -> Result<Self, Fault> {
        let (head, mut rest) = split_head(bytes)?;
        let Token::Map(pairs) = head else {
            let right = "it must be a map".to_owned();
            return Err(Fault::WrongType { what: of.to_owned(), found: head.describe(), right });
        };
        let mut fields: Vec<(&str, &[u8])> = Vec::new();
        for _ in 0..pairs {
            let (key, after) = split_object(rest)?;
            let (value, after) = split_object(after)?;
            rest = after;
            fields.push((text(&format!("a key of {of}"), key)?, value));
        }
        Ok(Self { of: of.to_owned(), fields })
    }

    /// Refuses keys twice, and keys that are neither known nor start with `x-`.
    fn check_keys(&self, known: &[&str]) -> Result<(), Fault> {
        for (index, (key, _)) in self.fields.iter().enumerate() {
            if self.fields[..index].iter().any(|(other, _)| other == key) {
                return Err(Fault::DuplicateKey((*key).to_owned()));
            }
            if !known.contains(key) && !key.starts_with("x-") {
                let known = format!("{} has {}", self.of, known.join(", "));
                return Err(Fault::UnknownKey { key: (*key).to_owned(), known });
            }
        }
        Ok(())
    }

    fn optional(&self, key: &str) -> Option<&'a [u8]> {
        self.fields.iter().find(|(k, _)| *k == key).map(|(_, value)| *value)
    }

    fn required(&self, key: &str, right: &'static str) -> Result<&'a [u8], Fault> {
        self.optional(key).ok_or_else(|| Fault::MissingKey { key: format!("{key} of {}", self.of), right })
    }

    /// The `x-` keys.
    fn extra(&self) -> Vec<Extra> {
        let own = self.fields.iter().filter(|(key, _)| key.starts_with("x-"));
        own.map(|(key, value)| Extra { key: (*key).to_owned(), value: value.to_vec() }).collect()
    }

    /// The message's `type`.
    pub(super) fn kind(&self) -> Result<&'a str, Fault> {
        text("\"type\"", self.required("type", "it says what the message is")?)
    }

    /// Refuses any version but ours.
    pub(super) fn check_version(&self) -> Result<(), Fault> {
        let version = self.required("version", "it must be 1")?;
        match unsigned("\"version\"", version)? {
            n if n == u64::from(VERSION) => Ok(()),
            n => Err(Fault::Version(n.to_string())),
        }
    }
}

/// Reads a header from the bytes of its map, which are one whole MessagePack object.
pub(super) fn read_header(bytes: &[u8]) -> Result<Header, Fault> {
    let map = Fields::read("the header", bytes)?;
    // What it is and which version come first: in another version, other keys are right.
    let kind = map.kind()?;
    if kind != "tile" {
        return Err(Fault::NotATile(format!("a map whose \"type\" is {kind:?}")));
    }
    map.check_version()?;
    map.check_keys(&KEYS)?;

    let image = numbers("\"image\"", map.required("image", "[W, H], the size of the image")?, "[W, H]")?;
    let tile = map.required("tile", "[x, y, w, h], the pixels that the tile is responsible for")?;
    let [x, y, width, height] = numbers("\"tile\"", tile, "[x, y, w, h]")?;
    let halo = map.required("halo", "[left, top, right, bottom], the pixels of context; zeros for none")?;
    let [left, top, right, bottom] = numbers("\"halo\"", halo, "[left, top, right, bottom]")?;
    let geometry = TileGeometry::new(image, Rect::new(x, y, width, height), Halo { left, top, right, bottom })?;

    let samples = read_samples(&map)?;
    let format = read_format("\"format\"", map.required("format", "\"f32\" or \"f16\"")?)?;
    let (channels, own) = read_channels(map.required("channels", "an array of maps, one a channel")?)?;
    Header::checked(geometry, channels, samples, format, own, map.extra())
}

fn read_samples(map: &Fields) -> Result<SampleCounts, Fault> {
    let right = "samples per pixel, or \"varying\"";
    let value = map.required("samples", right)?;
    let total = map.optional("total");
    let (head, _) = split_head(value)?;
    match head {
        Token::Str(_) => match (text("\"samples\"", value)?, total) {
            ("varying", Some(total)) => Ok(SampleCounts::Varying { total: unsigned("\"total\"", total)? }),
            ("varying", None) => {
                Err(Fault::MissingKey { key: "total".to_owned(), right: "with varying samples it is their number" })
            }
            (other, _) => Err(wrong_value("\"samples\"", other, right)),
        },
        _ if total.is_some() => {
            let known = "it goes with \"samples\": \"varying\" only".to_owned();
            Err(Fault::UnknownKey { key: "total".to_owned(), known })
        }
        Token::Number(Number::Unsigned(n)) => {
            // More than 32 bits is more than the limit, which is checked with the rest.
            Ok(SampleCounts::Uniform(u32::try_from(n).unwrap_or(u32::MAX)))
        }
        other => Err(wrong_type("\"samples\"", other, right)),
    }
}

fn read_channels(bytes: &[u8]) -> Result<(ChannelSet, Vec<Own>), Fault> {
    let (head, mut rest) = split_head(bytes)?;
    let Token::Array(count) = head else { return Err(wrong_type("\"channels\"", head, "an array of maps")) };
    let (mut channels, mut own) = (Vec::new(), Vec::new());
    for index in 0..count {
        let (object, after) = split_object(rest)?;
        rest = after;
        let map = Fields::read(&format!("channel {index}"), object)?;
        let (channel, its) = read_channel(index, &map)?;
        channels.push(channel);
        own.push(its);
    }
    Ok((ChannelSet::new(channels)?, own))
}

fn read_channel(index: u64, map: &Fields) -> Result<(Channel, Own), Fault> {
    let what = |key: &str| format!("{key:?} of channel {index}");
    let role = "\"film\", \"color\", \"feature\" or \"random\"";
    let name = text(&what("name"), map.required("name", "a str, different in each channel")?)?;
    let (role, own_key) = match text(&what("role"), map.required("role", role)?)? {
        "film" => (Role::Film, None),
        "color" => (Role::Color, None),
        "feature" => (Role::Feature { position: false }, Some("space")),
        "random" => (Role::Random { uniform: true }, Some("uniform")),
        other => return Err(wrong_value(&what("role"), other, role)),
    };
    let mut known = vec!["name", "role", "components", "format"];
    known.extend(own_key);
    map.check_keys(&known)?;
    let role = match (role, own_key.and_then(|key| map.optional(key))) {
        (Role::Feature { .. }, Some(space)) => match text(&what("space"), space)? {
            "position" => Role::Feature { position: true },
            "other" => Role::Feature { position: false },
            other => return Err(wrong_value(&what("space"), other, "\"position\" or \"other\"")),
        },
        (Role::Random { .. }, Some(uniform)) => match split_head(uniform)?.0 {
            Token::Bool(uniform) => Role::Random { uniform },
            other => return Err(wrong_type(&what("uniform"), other, "true or false")),
        },
        (role, _) => role,
    };
    let components = unsigned(&what("components"), map.required("components", "1 to 4")?)?;
    let format = map.optional("format").map(|format| read_format(&what("format"), format)).transpose()?;
    let channel = Channel::new(name, role, u32::try_from(components).unwrap_or(u32::MAX));
    check_film(&channel, format)?;
    Ok((channel, Own { format, extra: map.extra() }))
}

fn read_format(what: &str, bytes: &[u8]) -> Result<Format, Fault> {
    match text(what, bytes)? {
        "f32" => Ok(Format::F32),
        "f16" => Ok(Format::F16),
        other => Err(wrong_value(what, other, "\"f32\" or \"f16\"")),
    }
}

/// The text that is all of `bytes`.
pub(super) fn text<'a>(what: &str, bytes: &'a [u8]) -> Result<&'a str, Fault> {
    let (head, payload) = split_head(bytes)?;
    let Token::Str(_) = head else { return Err(wrong_type(what, head, "a str")) };
    std::str::from_utf8(payload).map_err(|_| Fault::Malformed(format!("{what} is a str that is not UTF-8")))
}

/// The unsigned integer that is all of `bytes`.
pub(super) fn unsigned(what: &str, bytes: &[u8]) -> Result<u64, Fault> {
    match split_head(bytes)?.0 {
        Token::Number(Number::Unsigned(n)) => Ok(n),
        other => Err(wrong_type(what, other, "an integer from 0")),
    }
}

/// The N unsigned integers of 32 bits in the array that is all of `bytes`.
fn numbers<const N: usize>(what: &str, bytes: &[u8], names: &str) -> Result<[u32; N], Fault> {
    let (head, mut rest) = split_head(bytes)?;
    let right = format!("{names}, each an integer from 0 to {}", u32::MAX);
    if head != Token::Array(N as u64) {
        return Err(wrong_type(what, head, &right));
    }
    let mut values = [0; N];
    for value in &mut values {
        let (object, after) = split_object(rest)?;
        rest = after;
        *value = match split_head(object)?.0 {
            Token::Number(Number::Unsigned(n)) if n <= u64::from(u32::MAX) => n as u32,
            other => return Err(wrong_type(&format!("a number of {what}"), other, &right)),
        };
    }
    Ok(values)
}

fn wrong_type(what: &str, found: Token, right: &str) -> Fault {
    Fault::WrongType { what: what.to_owned(), found: found.describe(), right: format!("it must be {right}") }
}

fn wrong_value(what: &str, found: &str, right: &str) -> Fault {
    Fault::WrongValue { what: what.to_owned(), found: format!("{found:?}"), right: format!("it must be {right}") }
}

/// The head of the object at the front, and the bytes after the head.
fn split_head(bytes: &[u8]) -> Result<(Token, &[u8]), Fault> {
    let head = bytes.first().and_then(|&marker| head_len(marker)).and_then(|len| bytes.split_at_checked(len));
    head.and_then(|(head, rest)| Some((token::token(head)?, rest))).ok_or_else(not_whole)
}

/// The object at the front, and the bytes after it.
fn split_object(bytes: &[u8]) -> Result<(&[u8], &[u8]), Fault> {
    object_len(bytes).map(|len| bytes.split_at(len)).ok_or_else(not_whole)
}

/// The scanner has found the whole map before, so this is a fault of ours; still no reason to panic.
fn not_whole() -> Fault {
    Fault::Malformed("a map that is not whole MessagePack".to_owned())
}
