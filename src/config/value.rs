//! What a setting can be: how its value is read from text, wherever the text is from, and written as TOML.

use std::{fmt, net::SocketAddr, path::PathBuf, str::FromStr, time::Duration};

use crate::filter::{SimdLevel, SimdLevelError};

/// A number of bytes. Read from `512MiB`, `2GiB`, `64kB` or plain bytes; binary units count by 1024, decimal by 1000.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Units by their names, the largest first of each kind.
const UNITS: [(&str, u64); 9] = [
    ("TiB", 1 << 40),
    ("GiB", 1 << 30),
    ("MiB", 1 << 20),
    ("KiB", 1 << 10),
    ("TB", 1_000_000_000_000),
    ("GB", 1_000_000_000),
    ("MB", 1_000_000),
    ("kB", 1000),
    ("B", 1),
];

/// A text that is no size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no size: write bytes or a number and a unit, like 536870912, 512MiB, 1.5GiB or 2GB")]
pub struct SizeError(String);

/// The number at the start of a text, and the unit behind it.
fn split_unit(text: &str) -> (&str, &str) {
    let trimmed = text.trim();
    let end = trimmed.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(trimmed.len());
    (&trimmed[..end], trimmed[end..].trim())
}

impl FromStr for ByteSize {
    type Err = SizeError;

    fn from_str(text: &str) -> Result<Self, SizeError> {
        let wrong = || SizeError(text.to_owned());
        let (number, unit) = split_unit(text);
        let unit = match unit {
            "" => 1,
            unit => UNITS.iter().find(|(name, _)| name.eq_ignore_ascii_case(unit)).ok_or_else(wrong)?.1,
        };
        let (whole, part) = number.split_once('.').unwrap_or((number, "0"));
        let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        // Parts of a unit to 9 digits; parts of a byte mean nothing.
        if !digits(whole) || !digits(part) || part.len() > 9 || (unit == 1 && number.contains('.')) {
            return Err(wrong());
        }
        let whole = whole.parse::<u64>().ok().and_then(|n| n.checked_mul(unit)).ok_or_else(wrong)?;
        let scale = 10u128.pow(part.len() as u32);
        let part = part.parse::<u128>().map_err(|_| wrong())? * u128::from(unit) / scale;
        whole.checked_add(part as u64).map(Self).ok_or_else(wrong)
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let exact = |(_, unit): &&(&str, u64)| self.0 >= *unit && self.0.is_multiple_of(*unit);
        match UNITS[..4].iter().find(exact) {
            Some((name, unit)) => write!(f, "{}{name}", self.0 / unit),
            None => write!(f, "{}B", self.0),
        }
    }
}

/// How the log is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogFormat {
    /// Lines to read.
    Text,
    /// A JSON object a line.
    Json,
}

/// A kind of setting.
pub(crate) trait Value: Sized {
    /// Reads it; the error says what would be right.
    fn read(text: &str) -> Result<Self, String>;

    /// As a value in TOML; none if it is not set, or cannot be written as text.
    fn to_toml(&self) -> Option<String>;
}

/// A text in quotes, as TOML has it.
pub(crate) fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => out += &format!("\\u{:04X}", u32::from(c)),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

impl Value for ByteSize {
    fn read(text: &str) -> Result<Self, String> {
        text.parse().map_err(|error: SizeError| error.to_string())
    }

    fn to_toml(&self) -> Option<String> {
        Some(quoted(&self.to_string()))
    }
}

/// Units of time in seconds, the largest first.
const TIMES: [(&str, f64); 5] = [("d", 86_400.0), ("h", 3600.0), ("m", 60.0), ("s", 1.0), ("ms", 0.001)];

impl Value for Duration {
    fn read(text: &str) -> Result<Self, String> {
        let (number, unit) = split_unit(text);
        let seconds = TIMES.iter().find(|(name, _)| *name == if unit.is_empty() { "s" } else { unit });
        let read = || {
            let fine = number.starts_with(|c: char| c.is_ascii_digit()) && !number.ends_with('.');
            Self::try_from_secs_f64(number.parse::<f64>().ok().filter(|_| fine)? * seconds?.1).ok()
        };
        read().ok_or_else(|| {
            format!("{text:?} is no time: write seconds or a number and a unit, like 0.5, 200ms, 30s, 5m, 2h or 7d")
        })
    }

    fn to_toml(&self) -> Option<String> {
        let text = match (self.as_secs(), self.subsec_nanos()) {
            (seconds, 0) => {
                let exact = |(_, unit): &&(&str, f64)| seconds > 0 && seconds.is_multiple_of(*unit as u64);
                let (name, unit) = TIMES[..4].iter().find(exact).unwrap_or(&("s", 1.0));
                format!("{}{name}", seconds / *unit as u64)
            }
            (0, nanos) if nanos.is_multiple_of(1_000_000) => format!("{}ms", nanos / 1_000_000),
            (seconds, nanos) => format!("{}s", format!("{seconds}.{nanos:09}").trim_end_matches('0')),
        };
        Some(quoted(&text))
    }
}

impl Value for SocketAddr {
    fn read(text: &str) -> Result<Self, String> {
        text.parse().map_err(|_| format!("{text:?} is no address: write IP:PORT, like 127.0.0.1:8080 or [::1]:8080"))
    }

    fn to_toml(&self) -> Option<String> {
        Some(quoted(&self.to_string()))
    }
}

impl Value for PathBuf {
    fn read(text: &str) -> Result<Self, String> {
        if text.is_empty() { Err("must name a file or folder".to_owned()) } else { Ok(text.into()) }
    }

    fn to_toml(&self) -> Option<String> {
        self.to_str().map(quoted)
    }
}

impl Value for bool {
    fn read(text: &str) -> Result<Self, String> {
        text.parse().map_err(|_| format!("{text:?}: must be true or false"))
    }

    fn to_toml(&self) -> Option<String> {
        Some(self.to_string())
    }
}

impl Value for String {
    fn read(text: &str) -> Result<Self, String> {
        Ok(text.to_owned())
    }

    fn to_toml(&self) -> Option<String> {
        Some(quoted(self))
    }
}

impl Value for LogFormat {
    fn read(text: &str) -> Result<Self, String> {
        match text {
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err(format!("{text:?}: must be text or json")),
        }
    }

    fn to_toml(&self) -> Option<String> {
        Some(quoted(if *self == Self::Json { "json" } else { "text" }))
    }
}

impl<T: Value> Value for Option<T> {
    fn read(text: &str) -> Result<Self, String> {
        T::read(text).map(Some)
    }

    fn to_toml(&self) -> Option<String> {
        self.as_ref().and_then(T::to_toml)
    }
}

impl Value for SimdLevel {
    fn read(text: &str) -> Result<Self, String> {
        text.parse().map_err(|error: SimdLevelError| error.to_string())
    }

    fn to_toml(&self) -> Option<String> {
        // Not the best level's name: another machine may have another.
        Some(quoted(if *self == Self::default() { "auto" } else { self.name() }))
    }
}

macro_rules! whole_numbers {
    ($($type:ty),*) => { $(
        impl Value for $type {
            fn read(text: &str) -> Result<Self, String> {
                text.parse().map_err(|_| format!("{text:?}: must be a whole number"))
            }

            fn to_toml(&self) -> Option<String> {
                Some(self.to_string())
            }
        }
    )* };
}

whole_numbers!(u32, u64, usize);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_written() {
        for (text, bytes) in [
            ("0", 0),
            ("1048576", 1 << 20),
            ("512MiB", 512 << 20),
            ("2 GiB", 2 << 30),
            ("2gib", 2 << 30),
            ("1.5GiB", 3 << 29),
            ("64kB", 64_000),
            ("0.1KiB", 102),
            ("16777215TiB", u64::MAX - ((1 << 40) - 1)),
            ("18446744073709551615B", u64::MAX),
        ] {
            assert_eq!(text.parse(), Ok(ByteSize(bytes)), "{text}");
        }
        for text in ["", "MiB", "1.5", "1.", ".5MiB", "-1", "1e3", "12 parsecs", "16777216TiB", "18446744073709551616"]
        {
            let error = text.parse::<ByteSize>().unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")) && error.contains("512MiB"), "{error}");
        }
        for bytes in [0, 1, 1023, 1 << 10, 3 << 29, (1 << 30) + 1, u64::MAX] {
            assert_eq!(ByteSize(bytes).to_string().parse(), Ok(ByteSize(bytes)));
        }
        assert_eq!(ByteSize(512 << 20).to_string(), "512MiB");
    }

    #[test]
    fn times_are_read_and_written() {
        for (text, millis) in [
            ("0", 0),
            ("0.25", 250),
            ("30", 30_000),
            ("30s", 30_000),
            ("1.5 m", 90_000),
            ("2h", 7_200_000),
            ("200ms", 200),
            ("7d", 604_800_000),
        ] {
            assert_eq!(Duration::read(text), Ok(Duration::from_millis(millis)), "{text}");
        }
        for text in ["", "s", "-1s", "1e3", "1.s", "30 parsecs", "1.2.3s", "99999999999999999999d"] {
            assert!(Duration::read(text).unwrap_err().contains("30s"), "{text}");
        }
        for (time, text) in [
            (Duration::ZERO, "\"0s\""),
            (Duration::from_secs(60), "\"1m\""),
            (Duration::from_secs(90), "\"90s\""),
            (Duration::from_millis(200), "\"200ms\""),
            (Duration::from_secs(172_800), "\"2d\""),
            (Duration::from_micros(1_500_250), "\"1.50025s\""),
        ] {
            assert_eq!(time.to_toml().unwrap(), text);
            assert_eq!(Duration::read(text.trim_matches('"')), Ok(time));
        }
    }

    #[test]
    fn texts_are_quoted() {
        assert_eq!(quoted("a \"b\" \\ \n"), r#""a \"b\" \\ \u000A""#);
        assert_eq!(Option::<PathBuf>::None.to_toml(), None);
        assert_eq!(Option::<PathBuf>::read("x"), Ok(Some(PathBuf::from("x"))));
        assert!(LogFormat::read("xml").unwrap_err().contains("json"));
    }
}
