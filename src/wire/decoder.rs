//! Reads a tile stream: bytes in, in pieces of any size, events out.

use super::{
    Fault, Header, MAX_HEADER, WireError,
    header_read::read_header,
    pull::{MapReader, Place, Pull},
    token::{HeadReader, Token},
    value::CountReader,
};
use crate::filter::Rect;

/// A part of a tile, in the order of the stream: the header; with varying samples the counts; for every plane either
/// one constant, or pieces of values and the plane's end; the tile's end.
#[derive(Clone, Debug, PartialEq)]
pub enum Event<'a> {
    /// A tile starts.
    Header(Header),
    /// The next bytes of the sample counts, little-endian `u16`, one for each pixel of the data window; a piece may end
    /// within a count. That their sum is the header's total has been checked when the next event comes.
    Counts(&'a [u8]),
    /// All of a plane: every sample has this value, already rounded to the plane's format.
    Constant {
        /// Number of the plane.
        plane: usize,
        /// Its value.
        value: f32,
    },
    /// The next bytes of a plane, little-endian in the plane's format; a piece may end within a value.
    Values {
        /// Number of the plane.
        plane: usize,
        /// The bytes.
        bytes: &'a [u8],
    },
    /// A plane that was spelt out has ended; one without samples comes without [`Event::Values`].
    PlaneEnd {
        /// Number of the plane.
        plane: usize,
    },
    /// The tile has ended.
    TileEnd,
}

/// An event that says how many bytes it has, not which: they are the last that were taken from the input.
pub(super) enum Step {
    Header(Header),
    Counts(usize),
    Constant { plane: usize, value: f32 },
    Values { plane: usize, len: usize },
    PlaneEnd { plane: usize },
    TileEnd,
}

impl Step {
    /// The event, given the bytes that were taken from the input.
    pub(super) fn event(self, taken: &[u8]) -> Event<'_> {
        let last = |len: usize| &taken[taken.len() - len..];
        match self {
            Self::Header(header) => Event::Header(header),
            Self::Counts(len) => Event::Counts(last(len)),
            Self::Constant { plane, value } => Event::Constant { plane, value },
            Self::Values { plane, len } => Event::Values { plane, bytes: last(len) },
            Self::PlaneEnd { plane } => Event::PlaneEnd { plane },
            Self::TileEnd => Event::TileEnd,
        }
    }
}

#[derive(Debug)]
enum State {
    /// In, or ahead of, a header.
    Header,
    /// At the marker of the counts.
    CountsHead,
    /// In the counts, so many bytes before their end.
    Counts(u64),
    /// At the marker of a plane, or behind the last.
    PlaneHead(usize),
    /// In a plane, so many bytes before its end.
    Plane(usize, u64),
}

/// Reads a tile stream. It keeps one header and a few bytes; planes pass through.
#[derive(Debug)]
pub struct Decoder {
    state: State,
    place: Place,
    map: MapReader,
    head: HeadReader,
    header: Option<Header>,
    counts: CountReader,
    /// Sum of the counts so far.
    sum: u64,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// Ready for the first byte of a stream.
    pub fn new() -> Self {
        Self {
            state: State::Header,
            place: Place::default(),
            map: MapReader::new(MAX_HEADER),
            head: HeadReader::default(),
            header: None,
            counts: CountReader::default(),
            sum: 0,
        }
    }

    /// The header of the tile that is being read.
    pub const fn header(&self) -> Option<&Header> {
        self.header.as_ref()
    }

    /// Whether no tile has begun that has not ended.
    pub const fn between(&self) -> bool {
        matches!(self.state, State::Header) && self.map.is_empty()
    }

    /// Bytes taken so far.
    pub const fn offset(&self) -> u64 {
        self.place.offset
    }

    /// Tiles read to their end so far.
    pub const fn tiles(&self) -> u64 {
        self.place.index
    }

    /// Takes bytes from the front of `input` up to the end of the next event. `Ok(None)`: all of `input` was taken, and
    /// more is needed. After an error every later call returns the same one.
    pub fn next<'a>(&mut self, input: &mut &'a [u8]) -> Result<Option<Event<'a>>, WireError> {
        let all = *input;
        let step = self.pull(input)?;
        Ok(step.map(|step| step.event(&all[..all.len() - input.len()])))
    }

    /// Says whether the stream may end here: between tiles, after at least one.
    pub fn finish(&self) -> Result<(), WireError> {
        self.alive()?;
        let name = |plane: usize| self.header.as_ref().map_or_else(String::new, |h| h.channels().plane_name(plane));
        let planes = self.header.as_ref().map_or(0, |h| h.channels().planes());
        let (place, missing) = match &self.state {
            State::Header if self.place.offset == 0 => return Err(self.error(Fault::Empty)),
            State::Header if self.map.is_empty() => return Ok(()),
            State::Header => ("a header".to_owned(), format!("at least {} bytes of it are missing", self.map.wanted())),
            State::CountsHead => {
                ("a tile".to_owned(), format!("the sample counts and all {planes} planes are missing"))
            }
            State::Counts(left) => {
                ("the sample counts".to_owned(), format!("{left} bytes of them and all {planes} planes are missing"))
            }
            State::PlaneHead(plane) => (
                format!("a tile ahead of plane {}", name(*plane)),
                format!("{} of {planes} planes are missing", planes - plane),
            ),
            State::Plane(plane, left) => (
                format!("plane {}", name(*plane)),
                format!("{left} bytes of it and {} of {planes} planes are missing", planes - plane - 1),
            ),
        };
        Err(self.error(Fault::Truncated { place, missing }))
    }

    fn read_header(&mut self, input: &mut &[u8]) -> Result<Option<Step>, Fault> {
        let Some(&first) = input.first() else { return Ok(None) };
        if self.map.is_empty() && !MapReader::starts(first) {
            return Err(self.no_header(input));
        }
        let Some(map) = self.map.push(input)? else { return Ok(None) };
        let header = read_header(&map)?;
        self.sum = 0;
        self.state = if header.varying() { State::CountsHead } else { State::PlaneHead(0) };
        self.header = Some(header.clone());
        Ok(Some(Step::Header(header)))
    }

    /// What to say of bytes that start no map.
    fn no_header(&self, input: &[u8]) -> Fault {
        let mut head = input;
        let object = match HeadReader::default().push(&mut head) {
            Ok(Some(token)) => token.describe(),
            _ => format!("the byte {:#04x}", input[0]),
        };
        if self.place.index > 0 {
            return Fault::Trailing(object);
        }
        Fault::NotATile(match input {
            [0x28, ..] => format!("{object} (is it zstd-compressed? then say so with Content-Encoding)"),
            [0x1f, ..] => format!("{object} (is it gzip-compressed? then say so with Content-Encoding)"),
            [b'{' | b'[', ..] => format!("{object} (is it JSON?)"),
            _ => object,
        })
    }

    /// Judges the head of a plane: the value of a constant, or the state is now within the plane.
    fn plane_head(&mut self, plane: usize, head: Token) -> Result<Option<f32>, Fault> {
        let Some(header) = &self.header else { return Ok(None) };
        let expected = header.plane_bytes(plane);
        let name = || header.channels().plane_name(plane);
        match head {
            Token::Number(number) => Ok(Some(header.plane_format(plane).round(number))),
            Token::Bin(found) if found == expected => {
                self.state = State::Plane(plane, expected);
                Ok(None)
            }
            Token::Bin(found) => Err(Fault::PlaneSize { plane: name(), found, expected }),
            other => {
                let hint = if matches!(other, Token::Str(_)) { "; use your library's bin type, not str" } else { "" };
                let right = format!("it must be a bin of {expected} bytes, or one number{hint}");
                Err(Fault::WrongType { what: format!("plane {}", name()), found: other.describe(), right })
            }
        }
    }

    fn check_counts(&self) -> Result<(), Fault> {
        let total = self.header.as_ref().map_or(0, Header::total);
        if self.sum == total {
            return Ok(());
        }
        Err(Fault::Counts(format!("the sample counts add up to {}: the header's \"total\" is {total}", self.sum)))
    }
}

impl Pull for Decoder {
    type Out = Step;

    fn place(&self) -> &Place {
        &self.place
    }

    fn place_mut(&mut self) -> &mut Place {
        &mut self.place
    }

    fn tile(&self) -> Option<Rect> {
        self.header.as_ref().map(|header| header.geometry().core())
    }

    fn advance(&mut self, input: &mut &[u8]) -> Result<Option<Step>, Fault> {
        loop {
            match &mut self.state {
                State::Header => return self.read_header(input),
                State::CountsHead => {
                    let Some(head) = self.head.push(input)? else { return Ok(None) };
                    let pixels = self.header.as_ref().map_or(0, |h| h.geometry().window().area());
                    let expected = 2 * pixels;
                    match head {
                        Token::Bin(found) if found == expected => self.state = State::Counts(expected),
                        Token::Bin(found) => {
                            let plane = "of sample counts".to_owned();
                            return Err(Fault::PlaneSize { plane, found, expected });
                        }
                        other => {
                            let right = format!("they must be a bin of {expected} bytes");
                            let what = "the plane of sample counts".to_owned();
                            return Err(Fault::WrongType { what, found: other.describe(), right });
                        }
                    }
                }
                State::Counts(left) => {
                    if input.is_empty() {
                        return Ok(None);
                    }
                    let bytes = take(input, left);
                    let ended = *left == 0;
                    self.counts.push(bytes, |count| self.sum += u64::from(count));
                    if ended {
                        self.state = State::PlaneHead(0);
                        self.check_counts()?;
                    }
                    return Ok(Some(Step::Counts(bytes.len())));
                }
                State::PlaneHead(plane) => {
                    let plane = *plane;
                    if self.header.as_ref().is_none_or(|header| plane == header.channels().planes()) {
                        self.place.index += 1;
                        self.header = None;
                        self.state = State::Header;
                        return Ok(Some(Step::TileEnd));
                    }
                    let Some(head) = self.head.push(input)? else { return Ok(None) };
                    if let Some(value) = self.plane_head(plane, head)? {
                        self.state = State::PlaneHead(plane + 1);
                        return Ok(Some(Step::Constant { plane, value }));
                    }
                }
                State::Plane(plane, left) => {
                    let plane = *plane;
                    if *left == 0 {
                        self.state = State::PlaneHead(plane + 1);
                        return Ok(Some(Step::PlaneEnd { plane }));
                    }
                    if input.is_empty() {
                        return Ok(None);
                    }
                    let len = take(input, left).len();
                    return Ok(Some(Step::Values { plane, len }));
                }
            }
        }
    }
}

/// Takes at most `left` bytes from the front.
fn take<'a>(input: &mut &'a [u8], left: &mut u64) -> &'a [u8] {
    let len = (*left).min(input.len() as u64);
    let (taken, rest) = input.split_at(len as usize);
    *left -= len;
    *input = rest;
    taken
}
