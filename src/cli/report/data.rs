//! What `rpfd report` measures on: files with references, folders of them, and renders of our own.

use super::super::{failure::Failure, input::Input, progress};
use crate::{
    filter::{Execution, Rect, SampleTile, TileGeometry},
    report::rows::Own,
    stitch::exr,
    store::spool::Spool,
    synth::Scene,
};
use std::{
    collections::BTreeMap,
    fs::File,
    path::{Path, PathBuf},
};

/// Pixels that a reference may have.
const MAX_PIXELS: u64 = 1 << 28;

/// Images of one scene, with its reference.
pub(super) struct DataSet {
    pub(super) name: String,
    pub(super) image: [u32; 2],
    pub(super) reference: Vec<[f32; 3]>,
    pub(super) own: Own,
    /// Tells the reference's content.
    digest: String,
    sources: Vec<Source>,
}

/// Samples of the scene.
struct Source {
    /// Per pixel, at most.
    spp: u32,
    digest: String,
    samples: Samples,
}

enum Samples {
    File(Box<Input>),
    Synth { scene: Box<Scene>, seed: u64 },
}

/// `--data TILES=REFERENCE.exr[:OWN_RELMSE]`.
#[derive(Clone, Debug)]
pub(super) struct DataArg {
    tiles: PathBuf,
    reference: PathBuf,
    own: Option<f64>,
}

pub(super) fn data_arg(text: &str) -> Result<DataArg, String> {
    let right = || "write TILES=REFERENCE.exr or TILES=REFERENCE.exr:OWN_RELMSE".to_owned();
    let (tiles, reference) = text.split_once('=').filter(|(a, b)| !a.is_empty() && !b.is_empty()).ok_or_else(right)?;
    let (reference, own) = match reference.rsplit_once(':') {
        Some((path, own)) => match own.parse() {
            Ok(own) if (0.0..f64::INFINITY).contains(&own) => (path, Some(own)),
            _ => return Err(format!("{own:?} is no relMSE: {}", right())),
        },
        None => (reference, None),
    };
    Ok(DataArg { tiles: tiles.into(), reference: reference.into(), own })
}

/// `--synth SCENE@WxH`.
#[derive(Clone, Debug)]
pub(super) struct SynthArg {
    scene: String,
    size: [u32; 2],
}

pub(super) fn synth_arg(text: &str) -> Result<SynthArg, String> {
    let known = || crate::synth::scenes().iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
    let (scene, size) = text.split_once('@').ok_or("write SCENE@WxH, like all@256x256")?;
    if Scene::by_name(scene).is_none() {
        return Err(format!("no scene has the name {scene:?}: known are {}", known()));
    }
    Ok(SynthArg { scene: scene.to_owned(), size: super::super::args::size(size)? })
}

/// A file's name without `.tiles`, `.zst` and `.8spp`.
fn scene_name(path: &Path) -> String {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let name = name.strip_suffix(".zst").unwrap_or(&name);
    let name = name.strip_suffix(".tiles").unwrap_or(name);
    let bare = name.rsplit_once('.').filter(|(_, end)| {
        end.strip_suffix("spp").is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
    });
    bare.map_or(name, |(bare, _)| bare).to_owned()
}

fn digest(path: &Path) -> Result<String, Failure> {
    let read = || {
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(File::open(path)?)?;
        Ok(hasher.finalize().to_hex()[..32].to_owned())
    };
    read().map_err(|error: std::io::Error| Failure::input("io", format!("{}: {error}", path.display())))
}

/// Every data set of a folder: NAME.NNspp.tiles[.zst] with NAME.reference.exr, and what reference-noise.json, where
/// there is one, says of NAME.
fn folder(path: &Path) -> Result<Vec<(DataArg, Own)>, Failure> {
    let fail = |error: &dyn std::fmt::Display| Failure::input("io", format!("{}: {error}", path.display()));
    let noise_path = path.join("reference-noise.json");
    let noise: serde_json::Value = match std::fs::read(&noise_path) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .map_err(|error| Failure::input("bad_json", format!("{}: {error}", noise_path.display())))?,
        Err(_) => serde_json::Value::Null,
    };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(path).map_err(|error| fail(&error))? {
        let tiles = entry.map_err(|error| fail(&error))?.path();
        let text = tiles.to_string_lossy();
        let name = scene_name(&tiles);
        let reference = path.join(format!("{name}.reference.exr"));
        if (text.ends_with(".tiles") || text.ends_with(".tiles.zst")) && reference.is_file() {
            let own = Own { relmse: noise[&name]["relmse"].as_f64(), mse: noise[&name]["mse"].as_f64() };
            found.push((DataArg { tiles, reference, own: own.relmse }, own));
        }
    }
    found.sort_by(|a, b| a.0.tiles.cmp(&b.0.tiles));
    if found.is_empty() {
        return Err(fail(&"it has no NAME.NNspp.tiles[.zst] with a NAME.reference.exr"));
    }
    Ok(found)
}

/// Where the data sets come from.
pub(super) struct Wanted<'a> {
    pub(super) data: &'a [DataArg],
    pub(super) folders: &'a [PathBuf],
    pub(super) synth: &'a [SynthArg],
    /// Most samples that are asked for, for renders of our own.
    pub(super) spp: u32,
    pub(super) reference_spp: u32,
    pub(super) seed: u64,
}

/// Looks through all that is wanted; the samples are read later.
pub(super) fn find(wanted: &Wanted, execution: &Execution) -> Result<Vec<DataSet>, Failure> {
    let mut files: Vec<(DataArg, Own)> = Vec::new();
    for path in wanted.folders {
        files.extend(folder(path)?);
    }
    files.extend(wanted.data.iter().map(|arg| (arg.clone(), Own { relmse: arg.own, mse: None })));
    let mut sets: BTreeMap<String, DataSet> = BTreeMap::new();
    for (arg, own) in files {
        add_file(&mut sets, &arg, own)?;
    }
    for arg in wanted.synth {
        let set = synth(arg, wanted, execution)?;
        sets.insert(set.name.clone(), set);
    }
    let mut sets: Vec<DataSet> = sets.into_values().collect();
    sets.iter_mut().for_each(|set| set.sources.sort_by_key(|source| source.spp));
    Ok(sets)
}

fn add_file(sets: &mut BTreeMap<String, DataSet>, arg: &DataArg, own: Own) -> Result<(), Failure> {
    let input = Input::scan(&arg.tiles)?;
    input.check(None)?;
    let (name, image, reference_digest) = (scene_name(&arg.tiles), input.image(), digest(&arg.reference)?);
    let source = Source {
        spp: input.summary.max_per_pixel,
        digest: digest(&arg.tiles)?,
        samples: Samples::File(Box::new(input)),
    };
    if let Some(set) = sets.get_mut(&name) {
        let same = set.sources.iter().any(|other| other.spp == source.spp);
        if set.digest != reference_digest || set.image != image || same {
            let why = "two data sets have this name, and are not the same scene at different sample counts";
            return Err(Failure::usage("data", format!("{name}: {why}: rename a file")));
        }
        set.sources.push(source);
        return Ok(());
    }
    let reference = exr::read(&arg.reference, MAX_PIXELS).map_err(|error| Failure::input(error.code(), &error))?;
    if [reference.width, reference.height] != image {
        let sizes = format!("{} x {}, the tiles are of {} x {}", reference.width, reference.height, image[0], image[1]);
        return Err(Failure::input("picture_size", format!("{} has {sizes} pixels", arg.reference.display())));
    }
    let set = DataSet {
        name: name.clone(),
        image,
        reference: reference.pixels,
        own,
        digest: reference_digest,
        sources: vec![source],
    };
    sets.insert(name, set);
    Ok(())
}

fn synth(arg: &SynthArg, wanted: &Wanted, execution: &Execution) -> Result<DataSet, Failure> {
    let SynthArg { scene: name, size } = arg;
    let scene = Scene::by_name(name).ok_or_else(|| Failure::usage("scene", format!("no scene {name:?}")))?;
    let (seed, [width, height]) = (wanted.seed, *size);
    let bar = progress::bar("reference", 1000);
    let report = |share: f32| bar.set_position((share * 1000.0) as u64);
    let execution = Execution { seed, progress: Some(&report), ..*execution };
    let reference = scene.reference(*size, Rect::new(0, 0, width, height), wanted.reference_spp, &execution)?;
    bar.finish_and_clear();
    let [r, g, b] = &reference.rgb;
    let spp = wanted.spp;
    Ok(DataSet {
        name: format!("synth {name} {width}x{height}"),
        image: *size,
        reference: r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect(),
        own: Own { relmse: Some(reference.relmse), mse: Some(reference.mse) },
        digest: format!("{} spp", reference.samples),
        sources: vec![Source {
            spp,
            // Samples are the same whatever their number.
            digest: format!("seed {seed}"),
            samples: Samples::Synth { scene: Box::new(scene), seed },
        }],
    })
}

impl DataSet {
    /// The sample counts that there are files of.
    pub(super) fn counts(&self) -> Vec<u32> {
        self.sources.iter().map(|source| source.spp).collect()
    }

    /// The index of the source that serves so many samples: the smallest that has them.
    pub(super) fn serving(&self, spp: u32) -> Option<usize> {
        self.sources.iter().position(|source| source.spp >= spp)
    }

    /// What tells the content of a source and the reference from any other.
    pub(super) fn content(&self, source: usize) -> String {
        format!("{} {}", self.sources[source].digest, self.digest)
    }

    /// All samples of a source, as one tile.
    pub(super) fn read(&self, source: usize, execution: &Execution) -> Result<SampleTile, Failure> {
        let [width, height] = self.image;
        let geometry = TileGeometry::with_halo(self.image, Rect::new(0, 0, width, height), 0)
            .map_err(|error| Failure::usage("bad_geometry", error))?;
        let Source { spp, samples, .. } = &self.sources[source];
        match samples {
            Samples::Synth { scene, seed } => {
                Ok(scene.tile(geometry, *spp, &Execution { seed: *seed, ..*execution })?)
            }
            Samples::File(input) => {
                let mut spool = Spool::in_memory(input.summary.spool_bytes);
                let never = Default::default();
                input.fill(&mut spool, execution.stop.unwrap_or(&never))?;
                Ok(spool.cut(geometry)?)
            }
        }
    }

    /// The reference's pixels in a part of the image.
    pub(super) fn reference_of(&self, part: Rect) -> Vec<[f32; 3]> {
        let rows = self.reference.chunks(self.image[0] as usize).skip(part.y as usize).take(part.height as usize);
        rows.flat_map(|row| &row[part.x as usize..part.right() as usize]).copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_scenes() {
        let known = [
            ("a/motion_blur.8spp.tiles.zst", "motion_blur"),
            ("small.tiles.zst", "small"),
            ("x.y.tiles", "x.y"),
            ("x.spp.tiles", "x.spp"),
            ("plain", "plain"),
        ];
        known.into_iter().for_each(|(path, name)| assert_eq!(scene_name(Path::new(path)), name));
    }

    #[test]
    fn arguments_are_read() {
        let arg = data_arg("a.tiles=b.exr:2e-4").unwrap();
        assert_eq!((arg.reference, arg.own), (PathBuf::from("b.exr"), Some(2e-4)));
        assert_eq!(data_arg("a.tiles=b.exr").unwrap().own, None);
        ["a.tiles", "=b.exr", "a=", "a=b:x", "a=b:-1", "a=b:inf"]
            .into_iter()
            .for_each(|bad| assert!(data_arg(bad).is_err()));
        assert_eq!(synth_arg("all@48x32").unwrap().size, [48, 32]);
        ["all", "all@", "all@0x3", "none@3x3"].into_iter().for_each(|bad| assert!(synth_arg(bad).is_err()));
    }
}
