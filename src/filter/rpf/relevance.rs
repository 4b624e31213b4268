//! Which planes can have an effect. A plane that is constant over the data window is constant over every neighbourhood:
//! it has no information, no distance and no weight, and can never reject a candidate, so leaving it out changes nothing.
//!
//! A colour plane that has the values of an earlier one, as in a grey scene, keeps them: each step does to both the same.
//! Its neighbourhoods, information and filtered values are those of the earlier one.

use super::work::Columns;
use crate::filter::{LeftOut, LeftOutReason, Plane, Role, SampleTile};

/// Where a column of the neighbourhood comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// A plane of the tile.
    Plane(usize),
    /// The x of the pixel's centre: no film position was sent.
    CenterX,
    /// The y of the pixel's centre.
    CenterY,
}

/// A feature plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Feature {
    /// Its index in the tile.
    pub(crate) plane: usize,
    /// Whether it is a world position.
    pub(crate) position: bool,
    /// Whether any sample has none.
    pub(crate) may_miss: bool,
}

/// The planes that matter, by role.
#[derive(Clone, Debug)]
pub(crate) struct Relevant {
    positions: Vec<Source>,
    random: Vec<usize>,
    features: Vec<Feature>,
    /// Of each colour channel the first that has the same values.
    twins: [usize; 3],
    /// How many columns there are without leaving any out.
    pub(crate) columns: Columns,
    /// What was left out, and why.
    pub(crate) left_out: Vec<LeftOut>,
}

impl Relevant {
    /// Looks at each plane of a tile. Of colours only copies go: they are what is filtered. Without `leave_out` all stay.
    pub(crate) fn of(tile: &SampleTile, leave_out: bool) -> Self {
        let mut found = Self {
            positions: Vec::new(),
            random: Vec::new(),
            features: Vec::new(),
            twins: if leave_out { twins(tile) } else { [0, 1, 2] },
            columns: Columns::of(tile.channels(), &[]),
            left_out: Vec::new(),
        };
        let (mut film, colors) = (false, tile.channels().color_planes());
        for (plane, (channel, _)) in tile.channels().plane_channels().enumerate() {
            film |= channel.role == Role::Film;
            if let (Plane::Constant(value), true) = (tile.plane(plane), leave_out && channel.role != Role::Color) {
                let reason = if value.is_nan() { LeftOutReason::Missing } else { LeftOutReason::Constant };
                found.left_out.push(LeftOut { plane: tile.channels().plane_name(plane), reason });
                continue;
            }
            match channel.role {
                Role::Film => found.positions.push(Source::Plane(plane)),
                Role::Color => {
                    if found.twins[plane - colors[0]] < plane - colors[0] {
                        let reason = LeftOutReason::Equal;
                        found.left_out.push(LeftOut { plane: tile.channels().plane_name(plane), reason });
                    }
                }
                Role::Feature { position } => {
                    let may_miss = misses_any(tile.plane(plane));
                    found.features.push(Feature { plane, position, may_miss });
                }
                Role::Random { .. } => found.random.push(plane),
            }
        }
        if !film {
            found.positions.extend([Source::CenterX, Source::CenterY]);
        }
        found
    }

    /// The film positions.
    pub(crate) fn positions(&self) -> &[Source] {
        &self.positions
    }

    /// The random parameters.
    pub(crate) fn random(&self) -> &[usize] {
        &self.random
    }

    /// The features.
    pub(crate) fn features(&self) -> &[Feature] {
        &self.features
    }

    /// Of each colour channel the first that has the same values in every sample: often itself.
    pub(crate) fn twins(&self) -> &[usize; 3] {
        &self.twins
    }

    /// How many columns are kept.
    pub(crate) fn kept(&self) -> Columns {
        Columns {
            positions: self.positions.len() as u64,
            random: self.random.len() as u64,
            features: self.features.len() as u64,
            colors: self.twins.iter().enumerate().filter(|(channel, twin)| channel == *twin).count() as u64,
        }
    }
}

/// Whether any value of a plane is missing.
fn misses_any(plane: &Plane) -> bool {
    match plane {
        Plane::Constant(value) => value.is_nan(),
        // Some at a time, all of them, so that the compiler puts them into lanes.
        Plane::Values(values) => {
            values.chunks(64).any(|some| some.iter().fold(false, |missing, value| missing | value.is_nan()))
        }
    }
}

/// Of each colour channel the first that has the same values.
fn twins(tile: &SampleTile) -> [usize; 3] {
    let planes = tile.channels().color_planes().map(|plane| tile.plane(plane));
    // Colours have no NaN and no -0.
    [0, 1, 2].map(|channel| (0..channel).find(|&earlier| planes[earlier] == planes[channel]).unwrap_or(channel))
}
