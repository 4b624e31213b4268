//! The heads of MessagePack objects, and where an object ends; neither recurses nor allocates.

use super::value::Number;

/// The head of an object: its type, and for what has a payload how many bytes or objects follow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Token {
    Nil,
    Bool(bool),
    Number(Number),
    /// Bytes of text that follow.
    Str(u64),
    /// Bytes that follow.
    Bin(u64),
    /// Objects that follow.
    Array(u64),
    /// Pairs of objects that follow.
    Map(u64),
    /// Bytes that follow, the type included.
    Ext(u64),
}

impl Token {
    /// What it is, in words.
    pub(super) fn describe(self) -> String {
        match self {
            Self::Nil => "nil".to_owned(),
            Self::Bool(value) => value.to_string(),
            Self::Number(Number::Unsigned(n)) => n.to_string(),
            Self::Number(Number::Negative(n)) => n.to_string(),
            Self::Number(Number::F32(v)) => format!("the float {v}"),
            Self::Number(Number::F64(v)) => format!("the float {v}"),
            Self::Str(n) => format!("a str of {n} bytes"),
            Self::Bin(n) => format!("a bin of {n} bytes"),
            Self::Array(n) => format!("an array of {n}"),
            Self::Map(n) => format!("a map of {n} pairs"),
            Self::Ext(n) => format!("an ext of {} bytes", n.saturating_sub(1)),
        }
    }
}

/// Longest head: a marker and a number of 8 bytes.
pub(super) const MAX_HEAD: usize = 9;

/// Bytes of the head that starts with `marker`, the marker included; `None` for the one marker that means nothing.
pub(super) const fn head_len(marker: u8) -> Option<usize> {
    Some(match marker {
        0xc1 => return None,
        0xc4 | 0xc7 | 0xcc | 0xd0 | 0xd9 => 2,
        0xc5 | 0xc8 | 0xcd | 0xd1 | 0xda | 0xdc | 0xde => 3,
        0xc6 | 0xc9 | 0xca | 0xce | 0xd2 | 0xdb | 0xdd | 0xdf => 5,
        0xcb | 0xcf | 0xd3 => 9,
        _ => 1,
    })
}

/// Reads a head of exactly [`head_len`] bytes; `None` if it is none.
pub(super) fn token(head: &[u8]) -> Option<Token> {
    let (&marker, rest) = head.split_first()?;
    if rest.len() + 1 != head_len(marker)? {
        return None;
    }
    let bits = rest.iter().fold(0_u64, |bits, &byte| bits << 8 | u64::from(byte));
    let signed = |value: i64| match u64::try_from(value) {
        Ok(value) => Token::Number(Number::Unsigned(value)),
        Err(_) => Token::Number(Number::Negative(value)),
    };
    Some(match marker {
        0x00..=0x7f => Token::Number(Number::Unsigned(u64::from(marker))),
        0x80..=0x8f => Token::Map(u64::from(marker & 0x0f)),
        0x90..=0x9f => Token::Array(u64::from(marker & 0x0f)),
        0xa0..=0xbf => Token::Str(u64::from(marker & 0x1f)),
        0xc0 => Token::Nil,
        0xc1 => return None,
        0xc2 | 0xc3 => Token::Bool(marker == 0xc3),
        0xc4..=0xc6 => Token::Bin(bits),
        0xc7..=0xc9 => Token::Ext(bits + 1),
        0xca => Token::Number(Number::F32(f32::from_bits(bits as u32))),
        0xcb => Token::Number(Number::F64(f64::from_bits(bits))),
        0xcc..=0xcf => Token::Number(Number::Unsigned(bits)),
        0xd0 => signed(i64::from(bits as u8 as i8)),
        0xd1 => signed(i64::from(bits as u16 as i16)),
        0xd2 => signed(i64::from(bits as u32 as i32)),
        0xd3 => signed(bits as i64),
        0xd4..=0xd8 => Token::Ext((1 << (marker - 0xd4)) + 1),
        0xd9..=0xdb => Token::Str(bits),
        0xdc | 0xdd => Token::Array(bits),
        0xde | 0xdf => Token::Map(bits),
        0xe0..=0xff => signed(i64::from(marker as i8)),
    })
}

/// Collects the bytes of one head from pieces of any size.
#[derive(Clone, Debug, Default)]
pub(super) struct HeadReader {
    bytes: [u8; MAX_HEAD],
    len: usize,
}

impl HeadReader {
    /// Takes bytes from the front of `input` until the head is whole; `Ok(None)` if it needs more; the marker that
    /// means nothing is an error.
    pub(super) fn push(&mut self, input: &mut &[u8]) -> Result<Option<Token>, ReservedMarker> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            self.bytes[self.len] = byte;
            self.len += 1;
            let wanted = head_len(self.bytes[0]).ok_or(ReservedMarker)?;
            if self.len == wanted {
                let head = &self.bytes[..wanted];
                self.len = 0;
                return token(head).map(Some).ok_or(ReservedMarker);
            }
        }
        Ok(None)
    }
}

/// The byte 0xc1 where a MessagePack object must start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ReservedMarker;

/// Finds where an object ends, nested as it may be, by counting the objects that are still to come.
#[derive(Clone, Debug)]
pub(super) struct Scanner {
    objects: u64,
    payload: u64,
    head: HeadReader,
}

impl Scanner {
    /// Ready for the first byte of an object.
    pub(super) const fn new() -> Self {
        Self { objects: 1, payload: 0, head: HeadReader { bytes: [0; MAX_HEAD], len: 0 } }
    }

    /// Bytes that must still come at least.
    pub(super) const fn wanted(&self) -> u64 {
        self.objects.saturating_add(self.payload)
    }

    /// Takes bytes from the front of `input`; true once the object has ended.
    pub(super) fn push(&mut self, input: &mut &[u8]) -> Result<bool, ReservedMarker> {
        while self.step(input)? {}
        Ok(self.ended())
    }

    /// Whether the object has ended.
    pub(super) const fn ended(&self) -> bool {
        self.objects == 0 && self.payload == 0
    }

    /// As [`push`](Self::push), but up to the next head only; false once it has ended or needs more.
    pub(super) fn step(&mut self, input: &mut &[u8]) -> Result<bool, ReservedMarker> {
        let skipped = self.payload.min(input.len() as u64);
        *input = &input[skipped as usize..];
        self.payload -= skipped;
        if self.payload > 0 || self.objects == 0 {
            return Ok(false);
        }
        let Some(token) = self.head.push(input)? else { return Ok(false) };
        self.objects -= 1;
        match token {
            Token::Str(bytes) | Token::Bin(bytes) | Token::Ext(bytes) => self.payload = bytes,
            Token::Array(n) => self.objects = self.objects.saturating_add(n),
            Token::Map(n) => self.objects = self.objects.saturating_add(2 * n),
            Token::Nil | Token::Bool(_) | Token::Number(_) => {}
        }
        Ok(true)
    }
}

/// Length of the object at the front of `bytes`; `None` if it is not whole or not MessagePack.
pub(super) fn object_len(bytes: &[u8]) -> Option<usize> {
    let mut rest = bytes;
    matches!(Scanner::new().push(&mut rest), Ok(true)).then(|| bytes.len() - rest.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_every_width() {
        let number = |bytes: &[u8]| match token(bytes) {
            Some(Token::Number(n)) => n,
            other => panic!("{other:?}"),
        };
        assert_eq!(number(&[0x7f]), Number::Unsigned(127));
        assert_eq!(number(&[0xff]), Number::Negative(-1));
        assert_eq!(number(&[0xd0, 0x80]), Number::Negative(-128));
        assert_eq!(number(&[0xd1, 0x01, 0x00]), Number::Unsigned(256));
        assert_eq!(number(&[0xcd, 0x01, 0x00]), Number::Unsigned(256));
        assert_eq!(number(&[0xcf, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff]), Number::Unsigned(u64::MAX));
        assert_eq!(number(&[0xd3, 0x80, 0, 0, 0, 0, 0, 0, 0]), Number::Negative(i64::MIN));
        assert_eq!(number(&[0xca, 0x3f, 0x80, 0, 0]), Number::F32(1.0));
        assert_eq!(token(&[0xc1]), None);
        assert_eq!(token(&[0xcd, 0]), None);
    }

    #[test]
    fn objects_end_where_they_end() {
        // {"a": [1, {"b": bin 3}], "c": ext}
        let object = b"\x82\xa1a\x92\x01\x81\xa1b\xc4\x03xyz\xa1c\xd5\x07pq";
        assert_eq!(object_len(object), Some(object.len()));
        assert_eq!(object_len(&object[..object.len() - 1]), None);
        // A deep nest costs nothing, and an enormous announcement nothing either.
        let mut deep = vec![0x91; 100_000];
        deep.push(0xc0);
        assert_eq!(object_len(&deep), Some(deep.len()));
        assert_eq!(object_len(b"\xdf\xff\xff\xff\xff"), None);
    }
}
