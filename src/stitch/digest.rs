//! Whether two tiles bring the same samples.

use super::Digest;
use crate::filter::{Rect, Role, SampleTile};

/// The digest of a core's samples: where the core lies, the channels, the sample counts, and every value, by rows.
///
/// It does not depend on the halo, nor on whether a plane was sent as one constant; what was not finite counts as what it
/// was replaced by, and missing features (NaN) are all equal, whatever a component that is constant in the data window
/// holds for them. Takes one pass over the core's samples and 64 KiB.
pub fn digest(tile: &SampleTile) -> Digest {
    digest_of(tile, tile.geometry().core())
}

/// The same of all the data window's samples: of what decides what becomes of the core.
pub fn window_digest(tile: &SampleTile) -> Digest {
    digest_of(tile, tile.geometry().window())
}

fn digest_of(tile: &SampleTile, core: Rect) -> Digest {
    let (image, window) = (tile.geometry().image(), tile.geometry().window());
    let mut out = Hasher { hash: blake3::Hasher::new(), bytes: Vec::with_capacity(1 << 16) };
    out.numbers([image.width, image.height, core.x, core.y, core.width, core.height]);
    out.number(tile.channels().channels().len() as u32);
    for channel in tile.channels().channels() {
        let (role, detail) = match channel.role {
            Role::Film => (0, false),
            Role::Color => (1, false),
            Role::Feature { position } => (2, position),
            Role::Random { uniform } => (3, uniform),
        };
        out.numbers([role, u32::from(detail), channel.components, channel.name.len() as u32]);
        out.numbers(channel.name.bytes().map(u32::from));
    }
    for y in core.y..core.bottom() {
        for x in core.x..core.right() {
            out.number(tile.samples_of(window.index(x, y)).len() as u32);
        }
    }
    for (plane, (channel, component)) in tile.channels().plane_channels().enumerate() {
        let first = plane - component as usize;
        let siblings = if channel.zero_is_missing() { first..first + channel.components as usize } else { 0..0 };
        for y in core.y..core.bottom() {
            // The samples of a row of pixels are next to each other.
            let first = tile.samples_of(window.index(core.x, y)).start;
            let end = tile.samples_of(window.index(core.right() - 1, y)).end;
            for sample in first..end {
                let value = tile.value(plane, sample);
                let missing = value.is_nan() || siblings.clone().any(|p| tile.value(p, sample).is_nan());
                out.number(if missing { f32::NAN.to_bits() } else { value.to_bits() });
            }
        }
    }
    out.hash.update(&out.bytes);
    *out.hash.finalize().as_bytes()
}

struct Hasher {
    hash: blake3::Hasher,
    bytes: Vec<u8>,
}

impl Hasher {
    fn numbers(&mut self, numbers: impl IntoIterator<Item = u32>) {
        numbers.into_iter().for_each(|number| self.number(number));
    }

    fn number(&mut self, number: u32) {
        if self.bytes.len() == 1 << 16 {
            self.hash.update(&self.bytes);
            self.bytes.clear();
        }
        self.bytes.extend_from_slice(&number.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, ChannelSet, Counts, Execution, Plane, TileGeometry};
    use crate::synth::Scene;

    fn scene(core: Rect, halo: u32, seed: u64) -> SampleTile {
        let geometry = TileGeometry::with_halo([40, 40], core, halo).unwrap();
        Scene::by_name("all").unwrap().tile(geometry, 3, &Execution { seed, ..Execution::default() }).unwrap()
    }

    #[test]
    fn the_halo_does_not_count_everything_else_does() {
        let core = Rect::new(10, 12, 9, 7);
        let bare = digest(&scene(core, 0, 1));
        assert_eq!(bare, digest(&scene(core, 5, 1)));
        assert_ne!(bare, digest(&scene(core, 0, 2)));
        assert_ne!(bare, digest(&scene(Rect::new(10, 12, 7, 9), 0, 1)));
        assert_eq!(bare, window_digest(&scene(core, 0, 1)));
        assert_ne!(window_digest(&scene(core, 5, 1)), window_digest(&scene(core, 4, 1)));
    }

    fn small(name: &str, counts: Counts, values: [Plane; 4]) -> Digest {
        let feature = Channel::new(name, Role::Feature { position: false }, 1);
        let channels = ChannelSet::new(vec![Channel::new("color", Role::Color, 3), feature]).unwrap();
        let geometry = TileGeometry::with_halo([2, 1], Rect::new(0, 0, 2, 1), 0).unwrap();
        digest(&SampleTile::new(geometry, channels, counts, values.into()).unwrap())
    }

    /// A component that is 0 in all the core stays 0 in a tile of the core alone; with a halo where it is not, samples
    /// without the feature have none of it.
    #[test]
    fn the_halo_does_not_count_where_zeros_mean_missing() {
        let with_halo = |halo: u32| {
            let geometry = TileGeometry::with_halo([3, 1], Rect::new(0, 0, 2, 1), halo).unwrap();
            let channels =
                [Channel::new("color", Role::Color, 3), Channel::new("N", Role::Feature { position: false }, 2)];
            let cut = |values: [f32; 3]| Plane::Values(values[..2 + halo as usize].to_vec());
            let planes = vec![cut([1.0; 3]), cut([1.0; 3]), cut([1.0; 3]), cut([0.0, 1.0, 1.0]), cut([0.0, 0.0, 1.0])];
            let channels = ChannelSet::new(channels.into()).unwrap();
            SampleTile::new(geometry, channels, Counts::Uniform(1), planes).unwrap()
        };
        assert_eq!(digest(&with_halo(0)), digest(&with_halo(1)));
    }

    #[test]
    fn constant_and_spelt_out_planes_are_the_same() {
        let planes = |feature: Plane| [Plane::Constant(1.0), Plane::Constant(0.5), Plane::Constant(0.0), feature];
        let spelt = |values: [f32; 2]| planes(Plane::Values(values.to_vec()));
        let two = || Counts::Uniform(1);
        let one = small("f", two(), planes(Plane::Constant(7.0)));
        assert_eq!(one, small("f", two(), spelt([7.0, 7.0])));
        assert_eq!(one, small("f", Counts::Varying(vec![1, 1]), spelt([7.0, 7.0])));
        assert_ne!(one, small("f", Counts::Varying(vec![2, 0]), spelt([7.0, 7.0])));
        assert_ne!(one, small("g", two(), spelt([7.0, 7.0])));
        assert_ne!(one, small("f", two(), spelt([7.0, 7.5])));
        let negative = f32::from_bits(0xffc0_0001);
        assert_eq!(small("f", two(), spelt([1.0, f32::NAN])), small("f", two(), spelt([1.0, negative])));
        assert_eq!(small("f", two(), spelt([1.0, 0.0])), small("f", two(), spelt([1.0, -0.0])));
    }
}
