//! Reads a result stream: bytes in, in pieces of any size, whole messages out.

use serde::{Deserialize, de::DeserializeOwned};

use super::{
    Fault, Format, Message, Problem, TileReport, TileResult, WireError,
    header_read::Fields,
    message::MAX_MESSAGE,
    pull::{MapReader, Place, Pull},
    token::{HeadReader, Scanner, Token},
    value::ValueReader,
};
use crate::filter::{Halo, Rect, TileGeometry};

#[derive(Debug)]
enum State {
    /// In, or ahead of, a message's map.
    Map,
    /// In an object that belongs to a message of an unknown type.
    Skip(Scanner),
    /// At the marker of a plane.
    PlaneHead,
    /// In a plane, so many bytes before its end.
    Plane(ValueReader, u64),
}

/// Reads a result stream. Messages of a type it does not know are skipped, with the planes that follow them; so are
/// keys of `report` that it does not know. It keeps one message, whose planes grow as their bytes come.
#[derive(Debug)]
pub struct ResultDecoder {
    state: State,
    place: Place,
    map: MapReader,
    head: HeadReader,
    /// The result whose planes are being read, and how many of them are whole.
    result: Option<(Box<TileResult>, usize)>,
    /// Whether the last map had an unknown type, so that what follows may be its planes.
    unknown: bool,
    ended: bool,
}

impl Default for ResultDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl ResultDecoder {
    /// Ready for the first byte of a stream.
    pub fn new() -> Self {
        Self {
            state: State::Map,
            place: Place::default(),
            map: MapReader::new(MAX_MESSAGE),
            head: HeadReader::default(),
            result: None,
            unknown: false,
            ended: false,
        }
    }

    /// Takes bytes from the front of `input` up to the end of the next message. `Ok(None)`: all of `input` was taken,
    /// and more is needed. After an error every later call returns the same one.
    pub fn next(&mut self, input: &mut &[u8]) -> Result<Option<Message>, WireError> {
        self.pull(input)
    }

    /// Says whether the stream may end here: after its `end` message.
    pub fn finish(&self) -> Result<(), WireError> {
        self.alive()?;
        if self.ended {
            return Ok(());
        }
        Err(self.error(if self.place.offset == 0 {
            Fault::Empty
        } else {
            let place = format!("message {}", self.place.index);
            let missing = "the \"end\" message is missing, the connection was cut".to_owned();
            Fault::Truncated { place, missing }
        }))
    }

    fn plane_head(&mut self, head: Token) -> Result<(), Fault> {
        let Some((result, plane)) = &mut self.result else { return Ok(()) };
        let expected = 4 * result.core.area();
        let name = ["R", "G", "B"][*plane];
        match head {
            Token::Bin(found) if found == expected => {
                self.state = State::Plane(ValueReader::new(Format::F32), expected);
                Ok(())
            }
            Token::Bin(found) => Err(Fault::PlaneSize { plane: name.to_owned(), found, expected }),
            other => {
                let right = format!("it must be a bin of {expected} bytes");
                Err(Fault::WrongType { what: format!("plane {name}"), found: other.describe(), right })
            }
        }
    }

    /// Reads a whole map: a message, or none if planes follow or its type is unknown.
    fn read_map(&mut self, map: &[u8]) -> Result<Option<Message>, Fault> {
        let fields = Fields::read("the message", map)?;
        let kind = fields.kind()?;
        self.unknown = !matches!(kind, "result" | "error" | "end");
        if self.unknown {
            self.place.index += 1;
            return Ok(None);
        }
        fields.check_version()?;
        let message = match kind {
            "result" => {
                let ResultMap { image, tile, report } = typed(map)?;
                let geometry = TileGeometry::new(image, rect(tile), Halo::default())?;
                let core = geometry.core();
                if 4 * core.area() > u64::from(u32::MAX) {
                    return Err(Fault::TooLarge(format!("tile {core}: its planes do not fit a MessagePack bin")));
                }
                let rgb = [Vec::new(), Vec::new(), Vec::new()];
                self.result = Some((Box::new(TileResult { image, core, report, rgb }), 0));
                self.state = State::PlaneHead;
                return Ok(None);
            }
            "error" => {
                let ErrorMap { tile, problem } = typed(map)?;
                Message::Error { tile: tile.map(rect), problem: Box::new(problem) }
            }
            _ => {
                let EndMap { tiles, errors } = typed(map)?;
                self.ended = true;
                Message::End { tiles, errors }
            }
        };
        self.place.index += 1;
        Ok(Some(message))
    }
}

impl Pull for ResultDecoder {
    type Out = Message;

    fn place(&self) -> &Place {
        &self.place
    }

    fn place_mut(&mut self) -> &mut Place {
        &mut self.place
    }

    fn tile(&self) -> Option<Rect> {
        self.result.as_ref().map(|(result, _)| result.core)
    }

    fn advance(&mut self, input: &mut &[u8]) -> Result<Option<Message>, Fault> {
        loop {
            let Some(&first) = input.first() else { return Ok(None) };
            match &mut self.state {
                State::Map if self.ended => return Err(Fault::Trailing(format!("the byte {first:#04x}"))),
                State::Map if self.map.is_empty() && !MapReader::starts(first) => {
                    if !self.unknown {
                        let found = format!("the byte {first:#04x}");
                        let right = "it must be a map".to_owned();
                        return Err(Fault::WrongType { what: "a message".to_owned(), found, right });
                    }
                    self.state = State::Skip(Scanner::new());
                }
                State::Map => {
                    if let Some(map) = self.map.push(input)?
                        && let Some(message) = self.read_map(&map)?
                    {
                        return Ok(Some(message));
                    }
                }
                State::Skip(scanner) => {
                    if scanner.push(input)? {
                        self.state = State::Map;
                    }
                }
                State::PlaneHead => {
                    let Some(head) = self.head.push(input)? else { return Ok(None) };
                    self.plane_head(head)?;
                }
                State::Plane(reader, left) => {
                    let len = (*left).min(input.len() as u64);
                    let (bytes, rest) = input.split_at(len as usize);
                    *input = rest;
                    *left -= len;
                    let ended = *left == 0;
                    if let Some((result, plane)) = &mut self.result {
                        let values = &mut result.rgb[*plane];
                        reader.push(bytes, |piece| values.extend_from_slice(piece));
                        *plane += usize::from(ended);
                    }
                    if ended {
                        self.state = State::PlaneHead;
                        if let Some((result, _)) = self.result.take_if(|(_, planes)| *planes == 3) {
                            self.state = State::Map;
                            self.place.index += 1;
                            return Ok(Some(Message::Result(result)));
                        }
                    }
                }
            }
        }
    }
}

#[derive(Deserialize)]
struct ResultMap {
    image: [u32; 2],
    tile: [u32; 4],
    #[serde(default)]
    report: TileReport,
}

#[derive(Deserialize)]
struct ErrorMap {
    tile: Option<[u32; 4]>,
    problem: Problem,
}

#[derive(Deserialize)]
struct EndMap {
    tiles: u64,
    errors: u64,
}

/// The scanner has seen that the map is whole, so no length in it is more than there are bytes; the depth is limited
/// since a reader of nested values recurses.
fn typed<T: DeserializeOwned>(map: &[u8]) -> Result<T, Fault> {
    let mut reader = rmp_serde::Deserializer::from_read_ref(map);
    reader.set_max_depth(16);
    T::deserialize(&mut reader).map_err(|error| Fault::Malformed(format!("a message that cannot be read: {error}")))
}

const fn rect([x, y, width, height]: [u32; 4]) -> Rect {
    Rect::new(x, y, width, height)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        filter::{Filtered, Method, Report, Work},
        wire::message::{encode_end, encode_error, encode_result},
    };

    fn stream() -> (Vec<u8>, Vec<Message>) {
        let core = Rect::new(2, 1, 3, 2);
        let plane = |k: f32| (0..6).map(|i| k + i as f32).collect::<Vec<_>>();
        let rgb = [plane(0.5), plane(-7.0), plane(1e9)];
        let work = Work { done: 60, planes: 30, columns: 9, distances: 1 };
        let report = TileReport::new(
            &Report { samples: 48, left_out_bytes: 96, work: Some(work), ..Report::default() },
            &Method::default(),
            7,
            0.25,
        );
        let filtered = Filtered { core, rgb: rgb.clone(), report: Report::default() };
        let problem = Problem::new(413, "too_large", "Too large", "it is").with("limit", 5);
        let mut out = Vec::new();
        encode_result([8, 8], &filtered, &report, &mut out).unwrap();
        encode_error(Some(core), &problem, &mut out).unwrap();
        // {"type": "progress", "x": [nil]} and a plane of it
        out.extend_from_slice(b"\x82\xa4type\xa8progress\xa1x\x91\xc0\xc4\x03abc");
        encode_error(None, &problem, &mut out).unwrap();
        encode_end(1, 2, &mut out).unwrap();
        let problem = Box::new(problem);
        let messages = vec![
            Message::Result(Box::new(TileResult { image: [8, 8], core, report, rgb })),
            Message::Error { tile: Some(core), problem: problem.clone() },
            Message::Error { tile: None, problem },
            Message::End { tiles: 1, errors: 2 },
        ];
        (out, messages)
    }

    fn read(bytes: &[u8], piece: usize) -> Result<Vec<Message>, WireError> {
        let (mut decoder, mut messages) = (ResultDecoder::new(), Vec::new());
        for mut chunk in bytes.chunks(piece) {
            while let Some(message) = decoder.next(&mut chunk)? {
                messages.push(message);
            }
        }
        decoder.finish()?;
        Ok(messages)
    }

    #[test]
    fn every_chunking_gives_the_same_messages() {
        let (bytes, messages) = stream();
        for piece in [1, 2, 3, 7, 64, bytes.len()] {
            assert_eq!(read(&bytes, piece).unwrap(), messages);
        }
    }

    #[test]
    fn a_cut_stream_shows_wherever_it_is_cut() {
        let (bytes, _) = stream();
        for end in 1..bytes.len() {
            assert_eq!(read(&bytes[..end], 64).unwrap_err().code(), "truncated", "cut at {end}");
        }
        assert_eq!(read(&[], 1).unwrap_err().code(), "empty");
        assert_eq!(read(&[&bytes[..], b"\xc0"].concat(), 64).unwrap_err().code(), "trailing");
    }

    #[test]
    fn wrong_messages_are_refused() {
        let code = |bytes: &[u8]| read(bytes, 1).unwrap_err().code();
        assert_eq!(code(b"\xc0"), "wrong_type");
        assert_eq!(code(b"\x80"), "missing_key");
        assert_eq!(code(b"\x81\xa4type\x01"), "wrong_type");
        assert_eq!(code(b"\x81\xa4type\xa3end"), "missing_key");
        assert_eq!(code(b"\x82\xa4type\xa3end\xa7version\x02"), "version");
        assert_eq!(code(b"\x82\xa4type\xa3end\xa7version\x01"), "malformed");
        assert_eq!(code(b"\xdf\xff\xff\xff\xff"), "header_too_large");
        let result = b"\x84\xa4type\xa6result\xa7version\x01\xa5image\x92\x01\x01\xa4tile\x94\x00\x00\x01";
        assert_eq!(code(&[&result[..], b"\x02"].concat()), "bad_geometry");
        assert_eq!(code(&[&result[..], b"\x01\xc4\x05"].concat()), "plane_size");
        assert_eq!(code(&[&result[..], b"\x01\xca\x00\x00\x00\x00"].concat()), "wrong_type");
    }
}
