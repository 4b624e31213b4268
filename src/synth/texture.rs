//! Solid textures: a colour for every point of a surface, in the coordinates of the surface at rest.

use super::random::mix;
use super::vector::Vec3;

/// A reflectance, each component in 0..=1.
#[derive(Clone, Copy, Debug)]
pub(super) enum Texture {
    /// The same everywhere.
    Solid(Vec3),
    /// Cubes of the edge `1 / scale`, alternating. Cell borders lie half a cell off the multiples of the edge, so that
    /// a wall standing on one is well inside its cells.
    Checker { scale: f64, colors: [Vec3; 2] },
    /// Cubes as in `Checker` between lines that take `line` of an edge, each with a brightness of its own.
    Tiles { scale: f64, line: f64, colors: [Vec3; 2] },
    /// Two octaves of value noise, sharpened: fine detail down to a quarter of `1 / scale`.
    Noise { scale: f64, colors: [Vec3; 2] },
    /// Wavy stripes along x, `scale` of them a unit.
    Stripes { scale: f64, colors: [Vec3; 2] },
}

impl Texture {
    /// The reflectance at a point.
    pub(super) fn at(&self, point: Vec3) -> Vec3 {
        let blend = |[a, b]: [Vec3; 2], share: f64| a * (1.0 - share) + b * share;
        match *self {
            Self::Solid(color) => color,
            Self::Checker { scale, colors } => {
                let [x, y, z] = cell(point * scale).map(|(index, _)| index);
                colors[((x + y + z) & 1) as usize]
            }
            Self::Tiles { scale, line, colors } => {
                let cells = cell(point * scale);
                // A surface lies in the middle of its cells in its own direction, and shows lines only in the others.
                if cells.iter().any(|&(_, within)| within < line) {
                    return colors[1];
                }
                colors[0] * (0.5 + 0.5 * lattice(cells.map(|(index, _)| index)))
            }
            Self::Noise { scale, colors } => {
                let value = 0.6 * noise(point * scale) + 0.4 * noise(point * (4.0 * scale));
                blend(colors, (4.0 * (value - 0.5) + 0.5).clamp(0.0, 1.0))
            }
            Self::Stripes { scale, colors } => {
                let wave = (point.x + 0.25 * noise(point * 2.0)) * scale;
                let within = wave - wave.floor();
                blend(colors, if within < 0.5 { 0.0 } else { 1.0 })
            }
        }
    }
}

/// Index of, and place within, the unit cell of each coordinate; cells are centred on the integers.
fn cell(point: Vec3) -> [(i64, f64); 3] {
    [point.x, point.y, point.z].map(|v| {
        let floor = (v + 0.5).floor();
        (floor as i64, v + 0.5 - floor)
    })
}

/// A fixed number in [0, 1) for every lattice point.
fn lattice([x, y, z]: [i64; 3]) -> f64 {
    const PRIMES: [u64; 3] = [0x9e37_79b9_7f4a_7c15, 0xc2b2_ae3d_27d4_eb4f, 0x1656_67b1_9e37_79f9];
    let joined =
        (x as u64).wrapping_mul(PRIMES[0]) ^ (y as u64).wrapping_mul(PRIMES[1]) ^ (z as u64).wrapping_mul(PRIMES[2]);
    (mix(joined) >> 40) as f64 / (1 << 24) as f64
}

/// Value noise: lattice numbers, interpolated smoothly; in [0, 1).
fn noise(point: Vec3) -> f64 {
    let cells = cell(point);
    let [x, y, z] = cells.map(|(index, _)| index);
    let [a, b, c] = cells.map(|(_, t)| t * t * (3.0 - 2.0 * t));
    let along_x = |dy, dz| {
        let (low, high) = (lattice([x, y + dy, z + dz]), lattice([x + 1, y + dy, z + dz]));
        low + (high - low) * a
    };
    let along_y = |dz| {
        let (low, high) = (along_x(0, dz), along_x(1, dz));
        low + (high - low) * b
    };
    let (low, high) = (along_y(0), along_y(1));
    low + (high - low) * c
}
