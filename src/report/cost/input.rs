//! Samples with so many features and random parameters: of the synthetic scene in which everything varies.

use crate::filter::{
    Channel, ChannelSet, Counts, Execution, Plane, Role, SampleTile, TileGeometry, samples::SampleError,
};
use crate::synth::{Scene, SynthError};

/// Planes of features that the scene has: P, N, albedo, P2 and N2.
pub const FEATURES: u32 = 15;
/// Random parameters that the scene has: lens, time, light and bsdf.
pub const RANDOM: u32 = 7;
/// With one more each that follows from these: the way to the second hit, and the sum of two random numbers, modulo 1.
pub const MOST: (u32, u32) = (FEATURES + 3, RANDOM + 1);

/// The samples of a tile with the first so many features, three at a time, and random parameters of those above.
pub fn tile(
    geometry: TileGeometry,
    samples: u32,
    features: u32,
    random: u32,
    execution: &Execution,
) -> Result<SampleTile, SynthError> {
    let Some(scene) = Scene::by_name("all") else { unreachable!("there is a scene all") };
    let tile = scene.tile(geometry, samples, &Execution { seed: 0, ..*execution })?;
    if (features, random) == (FEATURES, RANDOM) {
        return Ok(tile);
    }
    let of = |name: &str, component: u32| {
        let found = tile.channels().plane_channels().position(|(channel, c)| (&*channel.name, c) == (name, component));
        found.map_or(0, |plane| plane)
    };
    let combined = |a: usize, b: usize, combine: fn(f32, f32) -> f32| {
        Plane::Values((0..tile.total()).map(|s| combine(tile.value(a, s), tile.value(b, s))).collect())
    };
    let mut channels = Vec::new();
    let mut planes = Vec::new();
    let mut add = |name: &str, role, added: Vec<Plane>| {
        channels.push(Channel::new(name, role, added.len() as u32));
        planes.extend(added);
    };
    let (mut features, mut random) = (features, random);
    for channel in tile.channels().channels() {
        let wanted = match channel.role {
            Role::Film | Role::Color => channel.components,
            Role::Feature { .. } => take(&mut features, channel.components, 3),
            Role::Random { .. } => take(&mut random, channel.components, 1),
        };
        if wanted > 0 {
            let own = (0..wanted).map(|component| tile.plane(of(&channel.name, component)).clone());
            add(&channel.name, channel.role, own.collect());
        }
    }
    if features > 0 {
        let way = (0..3).map(|component| combined(of("P2", component), of("P", component), |a, b| a - b));
        add("way", Role::Feature { position: false }, way.collect());
    }
    if random > 0 {
        let sum = combined(of("light", 0), of("bsdf", 0), |a, b| (a + b) % 1.0);
        add("sum", Role::Random { uniform: true }, vec![sum]);
    }
    let Ok(channels) = ChannelSet::new(channels) else { unreachable!("a part of a valid set, and two more names") };
    SampleTile::new(geometry, channels, Counts::Uniform(samples), planes).map_err(|error: SampleError| error.into())
}

/// Takes what is left, `step` planes at a time, of a channel that has so many components.
fn take(left: &mut u32, components: u32, step: u32) -> u32 {
    let taken = components.min(*left / step * step);
    *left -= taken;
    taken
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::Rect;

    #[test]
    fn planes_are_as_many_as_asked_for_and_all_alive() {
        let geometry = TileGeometry::with_halo([12, 9], Rect::new(0, 0, 12, 9), 0).unwrap();
        for features in (3..=MOST.0).step_by(3) {
            for random in 0..=MOST.1 {
                let tile = tile(geometry, 3, features, random, &Execution::default()).unwrap();
                let count = |wanted: fn(&Role) -> bool| tile.channels().planes_of(wanted).len() as u32;
                assert_eq!(count(|role| matches!(role, Role::Feature { .. })), features);
                assert_eq!(count(|role| matches!(role, Role::Random { .. })), random);
                assert_eq!(count(|role| matches!(role, Role::Film | Role::Color)), 5);
                for plane in 0..tile.channels().planes() {
                    assert!(matches!(tile.plane(plane), Plane::Values(_)), "{}", tile.channels().plane_name(plane));
                }
            }
        }
    }
}
