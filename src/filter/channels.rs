//! What a tile's planes are: channels by name, role and number of components.
//!
//! A *channel* is what a renderer calls by one name (colour, a feature, a random parameter) and has 1 to 4 components;
//! each component is a *plane* of `f32`.

/// Most planes a tile may have: components of all channels together.
pub const MAX_PLANES: usize = 256;
/// What a channel's values mean to the filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// Position on the film in continuous image coordinates (pixel (x, y) covers x..x+1), 2 components.
    Film,
    /// Linear radiance R, G, B, 3 components.
    Color,
    /// A scene feature; NaN where a sample has none.
    Feature {
        /// Whether this is a world-space position, which clusters more loosely.
        position: bool,
    },
    /// A random parameter of the renderer.
    Random {
        /// Whether these are the uniform numbers in [0, 1) as drawn, not something derived from them.
        uniform: bool,
    },
}

/// One named channel.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Channel {
    /// Unique in its tile, 1 to 255 bytes.
    pub name: String,
    /// What the values mean.
    pub role: Role,
    /// Number of planes, 1 to 4; a colour has 3, a film position 2.
    pub components: u32,
}

impl Channel {
    /// A channel; [`ChannelSet::new`] checks it.
    pub fn new(name: impl Into<String>, role: Role, components: u32) -> Self {
        Self { name: name.into(), role, components }
    }

    /// Whether a sample whose components are all 0 has no such feature, as the papers encode it: world positions, and the
    /// normals that everyone calls `N` and `N2`, since no normal is 0. (An albedo of 0 is black.) Of these a sample has
    /// all components or none: one that is NaN stands for all.
    pub fn zero_is_missing(&self) -> bool {
        match self.role {
            Role::Feature { position } => position || matches!(self.name.as_str(), "N" | "N2"),
            _ => false,
        }
    }
}

/// Channels that cannot be; says what would be right.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChannelError {
    /// A name is empty or too long.
    #[error("channel {0:?}: a name must have 1 to 255 bytes")]
    Name(String),
    /// Two channels share a name.
    #[error("channel {0:?} is announced twice: names must be unique")]
    Repeated(String),
    /// A component count that the role does not allow.
    #[error("channel {name:?} has {components} components: {right}")]
    Components {
        /// The channel.
        name: String,
        /// What it announced.
        components: u32,
        /// What would be right.
        right: &'static str,
    },
    /// No colour, or more than one.
    #[error("{0} channels have the role color: there must be exactly one")]
    Color(usize),
    /// More than one film position.
    #[error("{0} channels have the role film: there may be one")]
    Film(usize),
    /// Too many planes.
    #[error("the channels have {0} components in all: at most {MAX_PLANES} are allowed")]
    TooMany(u64),
}

/// The channels of a tile, checked: one colour, at most one film position, unique names.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ChannelSet {
    channels: Vec<Channel>,
}

impl ChannelSet {
    /// Checks the channels; their order is the order of the planes.
    pub fn new(channels: Vec<Channel>) -> Result<Self, ChannelError> {
        let mut names = std::collections::HashSet::new();
        for channel in &channels {
            let Channel { name, role, components } = channel;
            if name.is_empty() || name.len() > 255 {
                return Err(ChannelError::Name(name.clone()));
            }
            if !names.insert(name.as_str()) {
                return Err(ChannelError::Repeated(name.clone()));
            }
            let right = match role {
                Role::Color if *components != 3 => "a color has 3",
                Role::Film if *components != 2 => "a film position has 2",
                _ if !(1..=4).contains(components) => "1 to 4 are allowed",
                _ => continue,
            };
            return Err(ChannelError::Components { name: name.clone(), components: *components, right });
        }
        let count = |role: Role| channels.iter().filter(|c| c.role == role).count();
        if count(Role::Color) != 1 {
            return Err(ChannelError::Color(count(Role::Color)));
        }
        if count(Role::Film) > 1 {
            return Err(ChannelError::Film(count(Role::Film)));
        }
        let planes: u64 = channels.iter().map(|c| u64::from(c.components)).sum();
        if planes > MAX_PLANES as u64 {
            return Err(ChannelError::TooMany(planes));
        }
        Ok(Self { channels })
    }

    /// The channels in plane order.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Number of planes: components of all channels together.
    pub fn planes(&self) -> usize {
        self.channels.iter().map(|c| c.components as usize).sum()
    }

    /// The channel, and the component in it, of every plane in order.
    pub fn plane_channels(&self) -> impl Iterator<Item = (&Channel, u32)> {
        self.channels.iter().flat_map(|channel| (0..channel.components).map(move |component| (channel, component)))
    }

    /// Indices of the planes whose channel passes `wanted`, in plane order.
    pub fn planes_of(&self, wanted: impl Fn(&Role) -> bool) -> Vec<usize> {
        self.plane_channels().enumerate().filter(|(_, (c, _))| wanted(&c.role)).map(|(plane, _)| plane).collect()
    }

    /// The three colour planes R, G, B.
    pub fn color_planes(&self) -> [usize; 3] {
        let first = self.plane_channels().position(|(c, _)| c.role == Role::Color).unwrap_or(0);
        [first, first + 1, first + 2]
    }

    /// A name for a plane: the channel's name, with the component's number where there are several (`P.1`).
    pub fn plane_name(&self, plane: usize) -> String {
        match self.plane_channels().nth(plane) {
            Some((channel, _)) if channel.components == 1 => channel.name.clone(),
            Some((channel, component)) => format!("{}.{component}", channel.name),
            None => format!("#{plane}"),
        }
    }
}
