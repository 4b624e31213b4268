//! Decompresses a body: bytes in, in pieces of any size, bytes out, and before each frame of zstd the window it asks for.

use std::io::{self, Write};

use bytes::{Buf, Bytes};
use flate2::write::MultiGzDecoder;
use zstd::stream::raw::{DParameter, Decoder, InBuffer, Operation, OutBuffer};

use crate::wire::file::{MAX_WINDOW_LOG, frame_head_len, window_bytes};

/// Bytes decompressed at a time.
const BUFFER: usize = 64 << 10;
/// What a decompressor keeps beside the window: its tables, and a block of 128 KiB in and out each.
pub(super) const OVERHEAD: u64 = 512 << 10;

/// What comes out.
#[derive(Debug, PartialEq)]
pub(super) enum Inflated {
    /// The next bytes, at most 64 KiB or thereabouts; never none.
    Bytes(Bytes),
    /// A frame follows for which so many bytes are kept: reserve them, and go on.
    Window(u64),
}

/// A decompressor of several frames, or members, one after another.
pub(super) enum Inflate {
    Zstd(Box<Zstd>),
    Gzip(Box<MultiGzDecoder<Vec<u8>>>),
}

pub(super) struct Zstd {
    /// Made when its memory is reserved.
    decoder: Option<Decoder<'static>>,
    /// The head of a frame, until all of it has been fed to the decoder.
    head: Bytes,
    collected: Vec<u8>,
    within: bool,
}

impl Inflate {
    pub(super) fn zstd() -> Self {
        Self::Zstd(Box::new(Zstd { decoder: None, head: Bytes::new(), collected: Vec::new(), within: false }))
    }

    pub(super) fn gzip() -> Self {
        Self::Gzip(Box::new(MultiGzDecoder::new(Vec::with_capacity(BUFFER))))
    }

    /// Takes bytes from the front of `input`; none when it needs more of them.
    pub(super) fn next(&mut self, input: &mut Bytes) -> io::Result<Option<Inflated>> {
        match self {
            Self::Zstd(zstd) => zstd.next(input),
            Self::Gzip(gzip) => loop {
                if !gzip.get_ref().is_empty() {
                    let out = std::mem::replace(gzip.get_mut(), Vec::with_capacity(BUFFER));
                    return Ok(Some(Inflated::Bytes(out.into())));
                }
                if input.is_empty() {
                    gzip.flush()?;
                    if gzip.get_ref().is_empty() {
                        return Ok(None);
                    }
                } else {
                    // Each call makes no more than a buffer's worth.
                    let taken = gzip.write(input)?;
                    input.advance(taken);
                }
            },
        }
    }

    /// Says whether the body may end here.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        match self {
            Self::Zstd(zstd) if zstd.within || !zstd.collected.is_empty() => Err(io::ErrorKind::UnexpectedEof.into()),
            Self::Zstd(_) => Ok(()),
            Self::Gzip(gzip) => gzip.try_finish(),
        }
    }
}

impl Zstd {
    fn next(&mut self, input: &mut Bytes) -> io::Result<Option<Inflated>> {
        while !self.within {
            let wanted = frame_head_len(&self.collected);
            if self.collected.len() < wanted {
                let taken = input.split_to(input.len().min(wanted - self.collected.len()));
                self.collected.extend_from_slice(&taken);
                if taken.is_empty() {
                    return Ok(None);
                }
                continue;
            }
            self.within = true;
            self.head = std::mem::take(&mut self.collected).into();
            return Ok(Some(Inflated::Window(window_bytes(&self.head))));
        }
        let decoder = match &mut self.decoder {
            Some(decoder) => decoder,
            none => {
                let mut decoder = Decoder::new()?;
                decoder.set_parameter(DParameter::WindowLogMax(MAX_WINDOW_LOG))?;
                none.insert(decoder)
            }
        };
        loop {
            let from = if self.head.is_empty() { &mut *input } else { &mut self.head };
            let mut out = Vec::with_capacity(BUFFER);
            let mut source = InBuffer::around(from);
            let mut sink = OutBuffer::around(&mut out);
            let hint = decoder.run(&mut source, &mut sink)?;
            let taken = source.pos();
            from.advance(taken);
            self.within = hint != 0;
            if !out.is_empty() {
                return Ok(Some(Inflated::Bytes(out.into())));
            }
            if !self.within {
                return self.next(input);
            }
            if taken == 0 {
                return Ok(None);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All of what comes out of pieces of so many bytes, and the windows.
    fn inflate(mut inflate: Inflate, body: &[u8], piece: usize) -> io::Result<(Vec<u8>, Vec<u64>)> {
        let (mut out, mut windows) = (Vec::new(), Vec::new());
        for piece in body.chunks(piece) {
            let mut input = Bytes::copy_from_slice(piece);
            while let Some(next) = inflate.next(&mut input)? {
                match next {
                    Inflated::Window(window) => windows.push(window),
                    Inflated::Bytes(bytes) => {
                        assert!(!bytes.is_empty() && bytes.len() <= 2 * BUFFER);
                        out.extend_from_slice(&bytes);
                    }
                }
            }
            assert!(input.is_empty());
        }
        inflate.finish()?;
        Ok((out, windows))
    }

    fn gzip(data: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(data).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn any_pieces_give_the_same_bytes() {
        let data: Vec<u8> = (0..300_000u32).map(|i| (i / 7) as u8).collect();
        let (a, b) = data.split_at(5000);
        let skippable = b"\x50\x2a\x4d\x18\x03\x00\x00\x00abc";
        let pack = |data: &[u8]| zstd::encode_all(data, 3).unwrap();
        let zstd = [pack(&[]), pack(a), skippable.to_vec(), pack(b), pack(&[])].concat();
        let gzip = [gzip(a), gzip(b)].concat();
        for piece in [1, 7, 1000, 65_536, 1 << 20] {
            let (out, windows) = inflate(Inflate::zstd(), &zstd, piece).unwrap();
            assert!(out == data, "pieces of {piece}");
            assert_eq!(windows.len(), 5);
            assert!(inflate(Inflate::gzip(), &gzip, piece).unwrap().0 == data, "pieces of {piece}");
        }
    }

    #[test]
    fn much_out_of_little_comes_in_pieces() {
        let data = vec![0; 20 << 20];
        let zstd = zstd::encode_all(&data[..], 3).unwrap();
        let (out, windows) = inflate(Inflate::zstd(), &zstd, zstd.len()).unwrap();
        assert!(out == data && windows == [2 << 20]);
        let gzip = gzip(&data);
        assert!(inflate(Inflate::gzip(), &gzip, gzip.len()).unwrap().0 == data);
    }

    #[test]
    fn what_is_cut_or_damaged_shows() {
        let data: Vec<u8> = (0..3000u32).map(|i| (i * i / 7) as u8).collect();
        let (zstd, gzip) = (zstd::encode_all(&data[..], 3).unwrap(), gzip(&data));
        for end in 1..zstd.len() {
            let error = inflate(Inflate::zstd(), &zstd[..end], 64).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::UnexpectedEof, "cut at {end}: {error}");
        }
        for end in 1..gzip.len() {
            let error = inflate(Inflate::gzip(), &gzip[..end], 64).unwrap_err();
            // In the checksum, and the length behind it, it is no different from damage.
            let expected =
                if end < gzip.len() - 8 { io::ErrorKind::UnexpectedEof } else { io::ErrorKind::InvalidInput };
            assert_eq!(error.kind(), expected, "cut at {end}: {error}");
        }
        let garbage = |mut good: Vec<u8>| {
            good.extend_from_slice(b"garbage");
            good
        };
        assert!(inflate(Inflate::zstd(), &garbage(zstd), 64).is_err());
        assert!(inflate(Inflate::gzip(), &garbage(gzip), 64).is_err());
    }
}
