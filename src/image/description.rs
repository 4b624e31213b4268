//! How an image was opened: what its store says first, and what must be the same when it is opened again.

use serde_json::{Map, Value, json};

use super::{MAX_TILES, MIN_CORE};
use crate::{
    filter::{Channel, ChannelSet, Method, Role, geometry::MAX_SIDE, samples::MAX_SAMPLES_PER_PIXEL},
    store::state,
};

/// What an image is to be.
#[derive(Clone, Debug, PartialEq)]
pub struct Description {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// How it is filtered.
    pub method: Method,
    /// Keys all random draws.
    pub seed: u64,
    /// Whether what can have no effect is left out; the same image either way.
    pub leave_out: bool,
    /// What is announced of its tiles, if they come as bare cores that lend each other their halos.
    pub neighbors: Option<Announced>,
    /// Whose it is, among those who share a service.
    pub owner: Option<String>,
    /// Bytes of disk that it may take.
    pub disk: u64,
}

/// What is known of all tiles before any has come.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Announced {
    /// Their channels.
    pub channels: ChannelSet,
    /// Samples of each pixel, or the most that one has.
    pub samples: u32,
    /// Whether pixels may have different numbers of samples.
    pub varying: bool,
    /// Side of the regions that are filtered at a time, in pixels.
    pub region: u32,
}

impl Description {
    /// An image of which nothing else is said, for tests.
    #[cfg(test)]
    pub(crate) fn plain(size: [u32; 2], method: Method) -> Self {
        Self { size, method, seed: 0, leave_out: true, neighbors: None, owner: None, disk: 0 }
    }

    /// Whether another one asks for the same image. How large its regions are, what it takes, and whose it is, is the
    /// service's.
    pub fn same(&self, other: &Self) -> bool {
        let announced = |of: &Self| of.neighbors.clone().map(|known| Announced { region: 0, ..known });
        self.size == other.size
            && self.method == other.method
            && self.seed == other.seed
            && announced(self) == announced(other)
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        let parameters: Map<_, _> =
            self.method.parameters().into_iter().map(|(name, value)| (name.to_owned(), value.into())).collect();
        let neighbors = self.neighbors.as_ref().map(|known| {
            let channels = channels_to_json(&known.channels);
            json!({ "channels": channels, "samples": known.samples, "varying": known.varying, "region": known.region })
        });
        json!({
            "version": 1, "size": self.size, "preset": self.method.preset_name(), "parameters": parameters,
            "seed": self.seed, "leave_out": self.leave_out, "neighbors": neighbors, "owner": self.owner,
            "disk": self.disk,
        })
        .to_string()
        .into_bytes()
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let value: Value = serde_json::from_slice(bytes).ok()?;
        if value["version"] != 1 {
            return None;
        }
        let side = |i: usize| {
            let side = u32::try_from(value["size"][i].as_u64()?).ok()?;
            (1..=MAX_SIDE).contains(&side).then_some(side)
        };
        let size = [side(0)?, side(1)?];
        // So many parts of the image are kept track of.
        let regions = |region: u32| size.map(|side| u64::from(side.div_ceil(region))).into_iter().product::<u64>();
        let parameters = value["parameters"].as_object()?.iter();
        let parameters = parameters.map(|(name, value)| Some((name, value.as_str()?))).collect::<Option<Vec<_>>>()?;
        let neighbors = match &value["neighbors"] {
            Value::Null => None,
            known => Some(Announced {
                channels: channels_from_json(&known["channels"]).ok()?,
                samples: u32::try_from(known["samples"].as_u64()?).ok().filter(|&n| n <= MAX_SAMPLES_PER_PIXEL)?,
                varying: known["varying"].as_bool()?,
                region: u32::try_from(known["region"].as_u64()?)
                    .ok()
                    .filter(|&side| side > 0 && regions(side) <= MAX_TILES as u64)?,
            }),
        };
        Some(Self {
            size,
            method: Method::with(value["preset"].as_str()?, parameters).ok()?,
            seed: value["seed"].as_u64()?,
            leave_out: value["leave_out"].as_bool()?,
            neighbors,
            owner: value["owner"].as_str().map(ToOwned::to_owned),
            disk: value["disk"].as_u64()?,
        })
    }
}

/// Bytes of disk that such an image takes at most: pixels, result, a tile on its way, records, samples.
pub fn disk_bytes(description: &Description) -> u64 {
    let [width, height] = description.size.map(u64::from);
    let pixels = width * height;
    let samples = description.neighbors.as_ref().map_or(0, |known| {
        let cores = most_cores(description.size);
        known.room(cores, pixels) + known.room(cores.div_ceil(4), lendable(pixels))
    });
    beside_samples(description).saturating_add(samples)
}

/// Of these bytes, those that are for samples.
pub(super) fn sample_bytes(description: &Description) -> u64 {
    description.disk.saturating_sub(beside_samples(description))
}

/// Pixels for which there is always room when halos bring them ahead of their cores: of a small image all, of a large one
/// a quarter. Room that cores do not need, since samples compress or are dropped, comes on top.
fn lendable(pixels: u64) -> u64 {
    pixels.min(pixels / 4 + (1 << 16))
}

/// Cores that an image may have, and parts of halos that are kept of it.
pub(super) fn most_cores(size: [u32; 2]) -> u64 {
    let [columns, rows] = size.map(|side| u64::from(side / MIN_CORE) + 2);
    (columns * rows).min(MAX_TILES as u64)
}

fn beside_samples(description: &Description) -> u64 {
    let [width, height] = description.size.map(u64::from);
    let pixels = width * height;
    let (base, record) = state::STATE_BYTES;
    let most = |tiles: u64| tiles.min(MAX_TILES as u64);
    // An EXR does not compress at worst, and has a table and attributes.
    let result = pixels * 12 + pixels / 64 + (1 << 20);
    match &description.neighbors {
        None => pixels * 24 + result + base + most(pixels) * record,
        Some(known) => {
            let region = u64::from(known.region);
            let regions = most(width.div_ceil(region) * height.div_ceil(region));
            // Of cores and halos one record each; of the parts of a region the tile, and whether it is final. A tile that
            // is filtered again has a file of its own on its way.
            let again = 12 * region * region;
            pixels * 12 + again + result + base + (2 * most_cores(description.size) + 8 * regions) * record
        }
    }
}

/// Channels as the header of a tile has them.
pub fn channels_to_json(channels: &ChannelSet) -> Value {
    let one = |channel: &Channel| {
        let mut map = json!({ "name": channel.name, "components": channel.components });
        map["role"] = match channel.role {
            Role::Film => "film",
            Role::Color => "color",
            Role::Feature { position } => {
                map["space"] = if position { "position" } else { "other" }.into();
                "feature"
            }
            Role::Random { uniform } => {
                map["uniform"] = uniform.into();
                "random"
            }
        }
        .into();
        map
    };
    channels.channels().iter().map(one).collect()
}

/// Reads channels as the header of a tile has them; says what is wrong and what would be right.
pub fn channels_from_json(value: &Value) -> Result<ChannelSet, String> {
    let list = value.as_array().ok_or("must be a list of channels, as in the header of a tile")?;
    let one = |(index, value): (usize, &Value)| {
        let at = |what: &str| format!("channel {index}: {what}");
        let map = value.as_object().ok_or_else(|| at("must be an object"))?;
        let known = ["name", "role", "components", "format", "space", "uniform"];
        if let Some(key) = map.keys().find(|key| !known.contains(&key.as_str()) && !key.starts_with("x-")) {
            return Err(at(&format!("unknown key {key:?}: known are {}", known.join(", "))));
        }
        let name = map.get("name").and_then(Value::as_str).ok_or_else(|| at("\"name\" must be a text"))?;
        let at = |what: &str| format!("channel {name:?}: {what}");
        let components = map.get("components").and_then(Value::as_u64).and_then(|n| u32::try_from(n).ok());
        let components = components.ok_or_else(|| at("\"components\" must be 1 to 4"))?;
        let role = map.get("role").and_then(Value::as_str).unwrap_or_default();
        let (space, uniform) = (map.get("space"), map.get("uniform"));
        if space.is_some() && role != "feature" {
            return Err(at("\"space\" is for features only"));
        }
        if uniform.is_some() && role != "random" {
            return Err(at("\"uniform\" is for random parameters only"));
        }
        if !matches!(map.get("format").map(Value::as_str), None | Some(Some("f32" | "f16"))) {
            return Err(at("\"format\" must be \"f32\" or \"f16\""));
        }
        let role = match role {
            "film" => Role::Film,
            "color" => Role::Color,
            "feature" => match space.map(Value::as_str) {
                None | Some(Some("other")) => Role::Feature { position: false },
                Some(Some("position")) => Role::Feature { position: true },
                _ => return Err(at("\"space\" must be \"position\" or \"other\"")),
            },
            "random" => match uniform {
                None => Role::Random { uniform: true },
                Some(Value::Bool(uniform)) => Role::Random { uniform: *uniform },
                _ => return Err(at("\"uniform\" must be true or false")),
            },
            _ => return Err(at("\"role\" must be \"film\", \"color\", \"feature\" or \"random\"")),
        };
        Ok(Channel::new(name, role, components))
    };
    let channels = list.iter().enumerate().map(one).collect::<Result<Vec<_>, _>>()?;
    ChannelSet::new(channels).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channels() -> ChannelSet {
        let channels = vec![
            Channel::new("film", Role::Film, 2),
            Channel::new("color", Role::Color, 3),
            Channel::new("P", Role::Feature { position: true }, 3),
            Channel::new("albedo", Role::Feature { position: false }, 3),
            Channel::new("lens", Role::Random { uniform: true }, 2),
            Channel::new("w", Role::Random { uniform: false }, 1),
        ];
        ChannelSet::new(channels).unwrap()
    }

    #[test]
    fn a_description_is_read_as_it_was_written() {
        let method = Method::with("lean", [("boxes", "9,5"), ("spikes", "off")]).unwrap();
        let bare = Description {
            size: [3, 4],
            method,
            seed: u64::MAX,
            leave_out: false,
            neighbors: None,
            owner: None,
            disk: 7,
        };
        assert_eq!(Description::decode(&bare.encode()), Some(bare.clone()));
        let known = Announced { channels: channels(), samples: 8, varying: true, region: 64 };
        let owned = Description { owner: Some("farm".to_owned()), ..bare.clone() };
        assert_eq!(Description::decode(&owned.encode()), Some(owned.clone()));
        assert!(owned.same(&bare));
        let with = Description { neighbors: Some(known.clone()), ..bare.clone() };
        assert_eq!(Description::decode(&with.encode()), Some(with.clone()));
        assert!(!bare.same(&with));
        let other = Description { neighbors: Some(Announced { region: 32, ..known.clone() }), disk: 8, ..with.clone() };
        assert!(with.same(&other) && with != other);
        assert_eq!(Description::decode(b"{}"), None);
        let many = |size, region| {
            let known = Announced { region, ..known.clone() };
            Description::decode(&Description { size, neighbors: Some(known), ..bare.clone() }.encode())
        };
        assert!(many([MAX_TILES as u32, 2], 2).is_some() && many([MAX_TILES as u32, 2], 1).is_none());
    }

    #[test]
    fn channels_are_read_and_bad_ones_refused() {
        assert_eq!(channels_from_json(&channels_to_json(&channels())), Ok(channels()));
        let color = json!({ "name": "c", "role": "color", "components": 3, "format": "f16", "x-a": 1 });
        assert!(channels_from_json(&json!([color])).is_ok());
        for (extra, said) in [
            (json!(5), "must be an object"),
            (json!({ "name": "a", "role": "random", "components": 1, "spase": 1 }), "unknown key"),
            (json!({ "name": "a", "role": "color", "components": 3 }), "exactly one"),
            (json!({ "name": "a", "role": "light", "components": 1 }), "role"),
            (json!({ "name": "a", "role": "random", "components": 5 }), "1 to 4"),
            (json!({ "name": "a", "role": "random", "components": -1 }), "1 to 4"),
            (json!({ "name": "a", "role": "random", "components": 1, "uniform": 1 }), "true or false"),
            (json!({ "name": "a", "role": "random", "components": 1, "space": "other" }), "features only"),
            (json!({ "name": "a", "role": "feature", "components": 1, "space": "world" }), "position"),
        ] {
            let error = channels_from_json(&json!([color, extra])).unwrap_err();
            assert!(error.contains(said), "{error}");
        }
        assert!(channels_from_json(&json!({})).is_err());
    }
}
