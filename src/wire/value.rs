//! Numbers: the two formats of planes, and how anything is rounded to them.

use half::slice::HalfFloatSliceExt;

/// Values that are read at once: they stay in the fastest cache while something is done with them.
const AT_ONCE: usize = 1024;

/// A number as MessagePack has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Number {
    /// Any integer from 0.
    Unsigned(u64),
    /// An integer below 0.
    Negative(i64),
    /// A float of 32 bits.
    F32(f32),
    /// A float of 64 bits.
    F64(f64),
}

/// How the values of a plane are written: IEEE 754, little-endian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Format {
    /// 4 bytes a value.
    #[default]
    F32,
    /// 2 bytes a value; above 65504 there is only infinity, which is replaced when it is read.
    F16,
}

impl Format {
    /// Bytes of a value: 4 or 2.
    pub const fn bytes(self) -> u64 {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
        }
    }

    /// Its name on the wire: `f32` or `f16`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }

    /// The nearest value of this format, ties to even, in one rounding; too great becomes infinite.
    pub fn round(self, number: Number) -> f32 {
        match (self, number) {
            (Self::F32, Number::Unsigned(n)) => n as f32,
            (Self::F32, Number::Negative(n)) => n as f32,
            (Self::F32, Number::F32(v)) => v,
            (Self::F32, Number::F64(v)) => v as f32,
            // Integers that f64 cannot hold are far beyond f16.
            (Self::F16, Number::Unsigned(n)) => half::f16::from_f32(odd(n as f64)).to_f32(),
            (Self::F16, Number::Negative(n)) => half::f16::from_f32(odd(n as f64)).to_f32(),
            (Self::F16, Number::F32(v)) => half::f16::from_f32(v).to_f32(),
            (Self::F16, Number::F64(v)) => half::f16::from_f32(odd(v)).to_f32(),
        }
    }

    /// The value as it is written, in the first [`bytes`](Self::bytes) bytes.
    pub(super) fn write(self, value: f32, out: &mut Vec<u8>) {
        match self {
            Self::F32 => out.extend_from_slice(&value.to_le_bytes()),
            Self::F16 => out.extend_from_slice(&half::f16::from_f32(value).to_le_bytes()),
        }
    }

    /// Reads as many values, at most [`AT_ONCE`], as there are bytes for.
    fn read(self, bytes: &[u8], values: &mut [f32]) {
        match self {
            Self::F32 => {
                let (bytes, _) = bytes.as_chunks();
                values.iter_mut().zip(bytes).for_each(|(value, &bytes)| *value = f32::from_le_bytes(bytes));
            }
            Self::F16 => {
                let (bytes, _) = bytes.as_chunks();
                let mut halves = [half::f16::ZERO; AT_ONCE];
                halves.iter_mut().zip(bytes).for_each(|(half, &bytes)| *half = half::f16::from_le_bytes(bytes));
                halves[..values.len()].convert_to_f32_slice(values);
            }
        }
    }
}

/// Rounds to `f32` such that rounding the result again, to f16, is as good as rounding `value` once: what is lost shows
/// in the last bit ("round to odd"). `half`'s own conversion from f64 drops bits or rounds twice, as the CPU has it.
fn odd(value: f64) -> f32 {
    let near = value as f32;
    if value.is_nan() || f64::from(near) == value {
        return near;
    }
    let below = if f64::from(near).abs() > value.abs() { near.to_bits() - 1 } else { near.to_bits() };
    f32::from_bits(below | 1)
}

/// Reads the values of a plane from bytes that come in pieces of any size.
#[derive(Clone, Debug)]
pub struct ValueReader {
    format: Format,
    carry: [u8; 4],
    carried: usize,
}

impl ValueReader {
    /// Ready for the first byte of a plane.
    pub const fn new(format: Format) -> Self {
        Self { format, carry: [0; 4], carried: 0 }
    }

    /// Calls `sink` with all values that are whole, some at a time; the bytes of one that is not are kept for the next
    /// call.
    pub fn push(&mut self, mut bytes: &[u8], mut sink: impl FnMut(&mut [f32])) {
        let size = self.format.bytes() as usize;
        if self.carried > 0 {
            let taken = (size - self.carried).min(bytes.len());
            self.carry[self.carried..self.carried + taken].copy_from_slice(&bytes[..taken]);
            self.carried += taken;
            bytes = &bytes[taken..];
            if self.carried < size {
                return;
            }
            self.carried = 0;
            let mut value = [0.0];
            self.format.read(&self.carry[..size], &mut value);
            sink(&mut value);
        }
        let (whole, rest) = bytes.split_at(bytes.len() / size * size);
        let mut values = [0.0; AT_ONCE];
        for bytes in whole.chunks(AT_ONCE * size) {
            let values = &mut values[..bytes.len() / size];
            self.format.read(bytes, values);
            sink(values);
        }
        self.carry[..rest.len()].copy_from_slice(rest);
        self.carried = rest.len();
    }
}

/// Reads little-endian `u16` counts from bytes that come in pieces of any size.
#[derive(Clone, Debug, Default)]
pub struct CountReader {
    low: Option<u8>,
}

impl CountReader {
    /// Calls `sink` with every count that is whole; half a count is kept for the next call.
    pub fn push(&mut self, mut bytes: &[u8], mut sink: impl FnMut(u16)) {
        if let (Some(low), Some((&high, rest))) = (self.low, bytes.split_first()) {
            sink(u16::from_le_bytes([low, high]));
            self.low = None;
            bytes = rest;
        }
        let (counts, rest) = bytes.as_chunks::<2>();
        counts.iter().for_each(|&n| sink(u16::from_le_bytes(n)));
        if let [low] = rest {
            self.low = Some(*low);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_is_rounded_once() {
        let round = |v: f64| Format::F16.round(Number::F64(v));
        // Halfway between 1 and the next f16 goes to even; a hair more, far below f32's precision, goes up.
        let half_way = 1.0 + 2f64.powi(-11);
        assert_eq!(round(half_way), 1.0);
        assert_eq!(round(half_way + 2f64.powi(-50)), 1.0 + 2f32.powi(-10));
        assert_eq!(round(-half_way - 2f64.powi(-50)), -1.0 - 2f32.powi(-10));
        assert_eq!(round(half_way - 2f64.powi(-50)), 1.0);
        assert_eq!(round(65520.0 - 1e-9), 65504.0);
        assert_eq!(round(65520.0), f32::INFINITY);
        assert_eq!(round(1e300), f32::INFINITY);
        assert_eq!(round(-1e-300), 0.0);
        assert!(round(f64::NAN).is_nan());
        assert_eq!(round(2f64.powi(-25)), 0.0);
        assert_eq!(round(2f64.powi(-25) * (1.0 + 1e-15)), 2f32.powi(-24));
        assert_eq!(Format::F16.round(Number::Unsigned(2049)), 2048.0);
        assert_eq!(Format::F16.round(Number::Negative(i64::MIN)), f32::NEG_INFINITY);
        assert_eq!(Format::F32.round(Number::Unsigned(16_777_217)), 16_777_216.0);
        assert_eq!(Format::F32.round(Number::F64(0.1)), 0.1);
    }

    #[test]
    fn pieces_of_any_size_give_the_same_values() {
        let values = [1.5_f32, -0.25, 65504.0, 0.0, 1.0e-3];
        for format in [Format::F32, Format::F16] {
            let mut bytes = Vec::new();
            values.iter().for_each(|&v| format.write(v, &mut bytes));
            let read = |piece: usize| {
                let (mut reader, mut out) = (ValueReader::new(format), Vec::new());
                bytes.chunks(piece).for_each(|chunk| reader.push(chunk, |v| out.extend_from_slice(v)));
                out
            };
            for piece in 1..=bytes.len() {
                assert_eq!(read(piece), read(bytes.len()));
            }
        }
        let (mut reader, mut out) = (CountReader::default(), Vec::new());
        [1, 0, 2, 0, 3, 1].chunks(1).for_each(|chunk| reader.push(chunk, |n| out.push(n)));
        assert_eq!(out, [1, 2, 259]);
    }
}
