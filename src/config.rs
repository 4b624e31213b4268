//! Sizes in bytes, as people write them.

use std::{fmt, str::FromStr};

/// A number of bytes. Read from words like `4096`, `512MiB` or `1.5 GB`; K, M, G and T alone are powers of 1024.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Powers of 1024, greatest first.
const UNITS: [(&str, u64); 4] = [("TiB", 1 << 40), ("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)];

impl FromStr for ByteSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is no size: write a number and a unit, like 512MiB, 2GiB or 1.5GB");
        let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let number: f64 = text[..end].parse().map_err(|_| wrong())?;
        let unit = match text[end..].trim().to_ascii_lowercase().as_str() {
            "" | "b" => 1.0,
            "k" | "kib" => 1024.0,
            "m" | "mib" => 1_048_576.0,
            "g" | "gib" => 1_073_741_824.0,
            "t" | "tib" => 1_099_511_627_776.0,
            "kb" => 1e3,
            "mb" => 1e6,
            "gb" => 1e9,
            "tb" => 1e12,
            _ => return Err(wrong()),
        };
        // Exact up to 2^53 bytes, and more than that is no size that anything here could have.
        let bytes = number * unit;
        if (1.0..9e15).contains(&bytes) { Ok(Self(bytes as u64)) } else { Err(wrong()) }
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UNITS.into_iter().find(|&(_, unit)| self.0 >= unit) {
            Some((name, unit)) if self.0 % unit == 0 => write!(f, "{} {name}", self.0 / unit),
            Some((name, unit)) => write!(f, "{:.1} {name}", self.0 as f64 / unit as f64),
            None => write!(f, "{} bytes", self.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_written() {
        let read = |text: &str| text.parse::<ByteSize>().map(|size| size.0).ok();
        assert_eq!(read("512MiB"), Some(512 << 20));
        assert_eq!(read("512m"), Some(512 << 20));
        assert_eq!(read("1.5 GB"), Some(1_500_000_000));
        assert_eq!(read("4096"), Some(4096));
        for wrong in ["", "x", "0", "-1", "12 parsecs", "1e5", "1.2.3M", "99999999TiB"] {
            assert_eq!(read(wrong), None, "{wrong:?}");
        }
        assert_eq!(ByteSize(512 << 20).to_string(), "512 MiB");
        assert_eq!(ByteSize(1_600_000).to_string(), "1.5 MiB");
        assert_eq!(ByteSize(12).to_string(), "12 bytes");
    }
}
