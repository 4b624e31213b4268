//! The stages against theory and against the oracle, and the promises of the whole.

mod against_oracle;
mod promises;
mod theory;

use crate::filter::{Execution, Method, Rect, Role, SampleTile, TileGeometry};
use crate::synth::Scene;

/// A synthetic scene's whole image as one tile.
fn scene(name: &str, size: [u32; 2], samples: u32) -> SampleTile {
    part(name, TileGeometry::new(size, Rect::new(0, 0, size[0], size[1]), Default::default()).unwrap(), samples)
}

/// A synthetic scene's tile.
fn part(name: &str, geometry: TileGeometry, samples: u32) -> SampleTile {
    Scene::by_name(name).unwrap().tile(geometry, samples, &Execution::default()).unwrap()
}

fn method(preset: &str, settings: &[(&str, &str)]) -> Method {
    Method::with(preset, settings.iter().copied()).unwrap()
}

fn is_feature(role: &Role) -> bool {
    matches!(role, Role::Feature { .. })
}
