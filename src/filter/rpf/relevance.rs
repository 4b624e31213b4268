//! Which planes can have an effect. A plane that is constant over the data window is constant over every neighbourhood:
//! it has no information, no distance and no weight, and can never reject a candidate, so leaving it out changes nothing.

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
}

/// The planes that matter, by role.
#[derive(Clone, Debug)]
pub(crate) struct Relevant {
    positions: Vec<Source>,
    random: Vec<usize>,
    features: Vec<Feature>,
    /// What was left out, and why.
    pub(crate) left_out: Vec<LeftOut>,
}

impl Relevant {
    /// Looks at each plane of a tile. Colours always stay: they are what is filtered. Without `leave_out` all stay.
    pub(crate) fn of(tile: &SampleTile, leave_out: bool) -> Self {
        let mut found = Self { positions: Vec::new(), random: Vec::new(), features: Vec::new(), left_out: Vec::new() };
        let mut film = false;
        for (plane, (channel, _)) in tile.channels().plane_channels().enumerate() {
            film |= channel.role == Role::Film;
            if let (Plane::Constant(value), true) = (tile.plane(plane), leave_out && channel.role != Role::Color) {
                let reason = if value.is_nan() { LeftOutReason::Missing } else { LeftOutReason::Constant };
                found.left_out.push(LeftOut { plane: tile.channels().plane_name(plane), reason });
                continue;
            }
            match channel.role {
                Role::Film => found.positions.push(Source::Plane(plane)),
                Role::Color => {}
                Role::Feature { position } => found.features.push(Feature { plane, position }),
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
}
