//! Measurements that are done, one JSON object on a line: `{"key": …, "measurement": …}`. A report that was interrupted
//! goes on from there; a line that was cut short is measured anew.

use super::{measure::Measurement, plan::Key};
use serde_json::{Value, json};
use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
};

/// What is done, in memory and, if there is a file, there.
#[derive(Debug, Default)]
pub struct State {
    done: BTreeMap<Key, Measurement>,
    file: Option<File>,
}

fn foreign(line: usize) -> io::Error {
    let why = format!("line {line} is no measurement: is this a state file of rpfd report?");
    io::Error::new(io::ErrorKind::InvalidData, why)
}

impl State {
    /// Opens a file, or makes it, and reads what is in it. A line that is not a measurement is an error, unless it is
    /// the last and has no end.
    pub fn open(path: &Path) -> io::Result<Self> {
        let mut file = OpenOptions::new().read(true).append(true).create(true).open(path)?;
        let mut text = String::new();
        file.read_to_string(&mut text)?;
        let mut done = BTreeMap::new();
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        for (index, line) in text[..whole].lines().enumerate().filter(|(_, line)| !line.is_empty()) {
            let read = || {
                let mut value: Value = serde_json::from_str(line).ok()?;
                let key = serde_json::from_value(value["key"].take()).ok()?;
                Some((key, Measurement::from_json(&value["measurement"])?))
            };
            let Some((key, measurement)) = read() else {
                return Err(foreign(index + 1));
            };
            done.insert(key, measurement);
        }
        // Only what we have begun ourselves is cut off: any other file is left as it is.
        let (rest, ours) = (&text[whole..], "{\"key\":");
        if !rest.starts_with(ours) && !ours.starts_with(rest) {
            return Err(foreign(text.lines().count()));
        }
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Self { done, file: Some(file) })
    }

    /// The measurement of this key, if it is done.
    pub fn get(&self, key: &Key) -> Option<&Measurement> {
        self.done.get(key)
    }

    /// Keeps a measurement; it is in the file when this returns.
    pub fn add(&mut self, key: Key, measurement: Measurement) -> io::Result<()> {
        if let Some(file) = &mut self.file {
            let mut line = json!({ "key": key, "measurement": measurement.to_json() }).to_string();
            line.push('\n');
            file.write_all(line.as_bytes())?;
            file.sync_data()?;
        }
        self.done.insert(key, measurement);
        Ok(())
    }
}
