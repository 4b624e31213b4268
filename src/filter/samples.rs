//! The samples of one tile: a planar store, `[plane][pixel][sample]`, of its data window.
//!
//! Every plane ([`channels`](super::channels)) has one value per sample. Pixels are in row-major order, the samples of a
//! pixel next to each other. A plane whose values are all equal is kept as that one value.

use super::channels::{ChannelSet, Role};
use super::geometry::{Rect, TileGeometry};

/// Most samples a pixel may have.
pub const MAX_SAMPLES_PER_PIXEL: u32 = u16::MAX as u32;
/// Most samples a tile may have: positions in a plane are kept in 32 bits.
pub const MAX_SAMPLES: u64 = u32::MAX as u64;

/// How many samples each pixel of the data window has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Counts {
    /// The same number in each.
    Uniform(u32),
    /// One number per pixel, row-major; 0 is allowed.
    Varying(Vec<u16>),
}

/// One plane's values, as they come in.
#[derive(Clone, Debug, PartialEq)]
pub enum Plane {
    /// Every sample has this value.
    Constant(f32),
    /// One value per sample.
    Values(Vec<f32>),
}

impl Plane {
    /// Keeps one value of a plane whose values are all equal.
    fn collapse(&mut self) {
        if let Self::Values(values) = self {
            let first = values.first().copied().unwrap_or(0.0);
            if values.iter().all(|&v| v == first || v.is_nan() && first.is_nan()) {
                *self = Self::Constant(first);
            }
        }
    }
}

/// Values that were not finite where they must be, and what they became.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Replaced {
    /// Colour values set to the mean of their pixel's finite samples, or 0.
    pub color: u64,
    /// Infinite features set to 0 (NaN is a missing feature and stays).
    pub feature: u64,
    /// Random parameters set to 0.
    pub random: u64,
    /// Film positions set to 0.
    pub film: u64,
}

impl Replaced {
    /// All of them.
    pub const fn total(&self) -> u64 {
        self.color + self.feature + self.random + self.film
    }
}

/// Samples that do not fit their shape; says what would be right.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SampleError {
    /// The number of counts is not the number of pixels.
    #[error("{got} sample counts for a data window of {pixels} pixels: there must be one each")]
    Counts {
        /// Counts given.
        got: usize,
        /// Pixels in the data window.
        pixels: u64,
    },
    /// The number of planes is not what the channels announce.
    #[error("{got} planes where the channels announce {expected}")]
    Planes {
        /// Planes given.
        got: usize,
        /// Planes announced.
        expected: usize,
    },
    /// A plane has a wrong number of values.
    #[error("plane {plane} has {got} values: the data window has {expected} samples")]
    Length {
        /// The plane's name.
        plane: String,
        /// Values given.
        got: usize,
        /// Samples in the data window.
        expected: u64,
    },
    /// More samples in a pixel than may be.
    #[error("{0} samples per pixel: at most {MAX_SAMPLES_PER_PIXEL} are allowed")]
    PerPixel(u32),
    /// More samples in the tile than may be.
    #[error("{0} samples in one tile: at most {MAX_SAMPLES} are allowed; send smaller tiles")]
    TooMany(u64),
}

/// The samples of one tile, checked and made finite.
///
/// After construction every value is finite, except features, where NaN says that a sample has none; negative zeros
/// have become zeros, and planes of equal values are [`Plane::Constant`].
#[derive(Clone, Debug)]
pub struct SampleTile {
    geometry: TileGeometry,
    channels: ChannelSet,
    layout: SampleLayout,
    planes: Vec<Plane>,
    replaced: Replaced,
}

/// Where each pixel's samples lie in a plane.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum SampleLayout {
    /// So many samples in each of the pixels.
    Uniform { per_pixel: u32, pixels: u32 },
    /// Pixel i has the samples `starts[i]..starts[i + 1]`.
    Varying { starts: Vec<u32> },
}

impl SampleLayout {
    /// The samples of a pixel, by its row-major index in the data window.
    #[inline(always)]
    pub(crate) fn of(&self, pixel: usize) -> std::ops::Range<usize> {
        match self {
            Self::Uniform { per_pixel, .. } => pixel * *per_pixel as usize..(pixel + 1) * *per_pixel as usize,
            Self::Varying { starts } => starts[pixel] as usize..starts[pixel + 1] as usize,
        }
    }

    /// Room for a part of so many pixels; varying if this one is.
    pub(crate) fn with_capacity(&self, pixels: usize) -> Self {
        match self {
            Self::Uniform { .. } => Self::Uniform { per_pixel: 0, pixels: 0 },
            Self::Varying { .. } => Self::Varying { starts: Vec::with_capacity(pixels + 1) },
        }
    }

    /// Number of samples in all.
    pub(crate) fn total(&self) -> usize {
        match self {
            Self::Uniform { per_pixel, pixels } => *per_pixel as usize * *pixels as usize,
            Self::Varying { starts } => starts.last().copied().unwrap_or(0) as usize,
        }
    }
}

/// Number of samples in a data window of so many pixels, checked against the limits.
pub fn sample_total(pixels: u64, counts: &Counts) -> Result<u64, SampleError> {
    let total = match counts {
        Counts::Uniform(n) if *n > MAX_SAMPLES_PER_PIXEL => return Err(SampleError::PerPixel(*n)),
        Counts::Uniform(n) => pixels.checked_mul(u64::from(*n)).ok_or(SampleError::TooMany(u64::MAX))?,
        Counts::Varying(counts) => {
            if counts.len() as u64 != pixels {
                return Err(SampleError::Counts { got: counts.len(), pixels });
            }
            counts.iter().map(|&n| u64::from(n)).sum()
        }
    };
    if total > MAX_SAMPLES || pixels > MAX_SAMPLES { Err(SampleError::TooMany(total.max(pixels))) } else { Ok(total) }
}

impl SampleTile {
    /// Checks the shape and makes the values finite, in place: a colour that is not finite becomes the mean of its
    /// pixel's finite samples in that channel (0 if there is none); NaN in a feature stays and means "none", and so does
    /// 0 where it can only mean that ([`super::Channel::zero_is_missing`]); anything else that is not finite becomes 0.
    ///
    /// `planes` are in the order of [`ChannelSet::plane_channels`], each with one value per sample of the data window.
    pub fn new(
        geometry: TileGeometry,
        channels: ChannelSet,
        counts: Counts,
        planes: Vec<Plane>,
    ) -> Result<Self, SampleError> {
        // Planes that no channel announces are refused.
        let roles = channels.plane_channels().map(|(channel, _)| channel.role).chain(std::iter::repeat(Role::Film));
        let cleaned = planes.into_iter().zip(roles).map(|(mut plane, role)| {
            let replaced = if let Plane::Values(values) = &mut plane { clean(role, values) } else { 0 };
            (plane, replaced)
        });
        let cleaned = cleaned.collect();
        Self::of_clean(geometry, channels, counts, cleaned)
    }

    /// As [`new`](Self::new), of planes whose values have been through [`clean`], each with what that came to.
    pub(crate) fn of_clean(
        geometry: TileGeometry,
        channels: ChannelSet,
        counts: Counts,
        planes: Vec<(Plane, u64)>,
    ) -> Result<Self, SampleError> {
        let pixels = geometry.window().area();
        let total = sample_total(pixels, &counts)?;
        if planes.len() != channels.planes() {
            return Err(SampleError::Planes { got: planes.len(), expected: channels.planes() });
        }
        for (index, (plane, _)) in planes.iter().enumerate() {
            if let Plane::Values(values) = plane
                && values.len() as u64 != total
            {
                let plane = channels.plane_name(index);
                return Err(SampleError::Length { plane, got: values.len(), expected: total });
            }
        }
        let layout = match counts {
            Counts::Uniform(per_pixel) => SampleLayout::Uniform { per_pixel, pixels: pixels as u32 },
            Counts::Varying(counts) => {
                let mut starts = Vec::with_capacity(counts.len() + 1);
                starts.push(0);
                let mut end = 0;
                starts.extend(counts.iter().map(|&n| {
                    end += u32::from(n);
                    end
                }));
                SampleLayout::Varying { starts }
            }
        };
        let (planes, replaced) = planes.into_iter().unzip();
        let mut tile = Self { geometry, channels, layout, planes, replaced: Replaced::default() };
        tile.sanitise(replaced);
        Ok(tile)
    }

    /// Given how many values of each plane were not finite where they must be.
    fn sanitise(&mut self, replaced: Vec<u64>) {
        let roles = self.channels.plane_channels().map(|(channel, _)| channel.role);
        for ((plane, role), mut replaced) in self.planes.iter_mut().zip(roles).zip(replaced) {
            match plane {
                Plane::Constant(value) => {
                    let bad = clean(role, std::slice::from_mut(value)) > 0;
                    *value = if bad { 0.0 } else { *value };
                    replaced = if bad { self.layout.total() as u64 } else { 0 };
                }
                Plane::Values(values) if replaced > 0 && role == Role::Color => {
                    for pixel in 0..self.geometry.window().area() as usize {
                        replace_by_mean(&mut values[self.layout.of(pixel)]);
                    }
                }
                Plane::Values(_) => {}
            }
            match role {
                Role::Color => self.replaced.color += replaced,
                Role::Feature { .. } => self.replaced.feature += replaced,
                Role::Random { .. } => self.replaced.random += replaced,
                Role::Film => self.replaced.film += replaced,
            }
        }
        // A plane is the same whether it was spelt out or not, also where only some of its zeros mean something.
        self.planes.iter_mut().for_each(Plane::collapse);
        let mut first = 0;
        for channel in self.channels.channels() {
            let components = channel.components as usize;
            if channel.zero_is_missing() {
                unite_missing(&mut self.planes[first..first + components], self.layout.total());
            }
            first += components;
        }
        self.planes.iter_mut().for_each(Plane::collapse);
    }

    /// Where the tile lies.
    pub const fn geometry(&self) -> &TileGeometry {
        &self.geometry
    }

    /// The channels, in plane order.
    pub const fn channels(&self) -> &ChannelSet {
        &self.channels
    }

    /// One plane's values; `plane` is below [`ChannelSet::planes`].
    pub fn plane(&self, plane: usize) -> &Plane {
        &self.planes[plane]
    }

    /// Value of one sample (its position in the plane) in one plane.
    #[inline(always)]
    pub fn value(&self, plane: usize, sample: usize) -> f32 {
        match &self.planes[plane] {
            Plane::Constant(value) => *value,
            Plane::Values(values) => values[sample],
        }
    }

    /// The samples of a pixel, by its row-major index in the data window: a range of positions in each plane.
    pub fn samples_of(&self, pixel: usize) -> std::ops::Range<usize> {
        self.layout.of(pixel)
    }

    /// Sets `layout`, from [`SampleLayout::with_capacity`] of this tile's, to that of a part of the data window alone.
    pub(crate) fn set_layout_of(&self, part: &Rect, layout: &mut SampleLayout) {
        let window = self.geometry.window();
        match layout {
            SampleLayout::Uniform { per_pixel, pixels } => {
                (*per_pixel, *pixels) = (self.max_per_pixel(), part.area() as u32);
            }
            SampleLayout::Varying { starts } => {
                starts.clear();
                starts.push(0);
                let mut total = 0;
                for y in part.y..part.bottom() {
                    for x in part.x..part.right() {
                        total += self.samples_of(window.index(x, y)).len() as u32;
                        starts.push(total);
                    }
                }
            }
        }
    }

    /// Where each pixel's samples lie in the planes.
    pub(crate) const fn layout(&self) -> &SampleLayout {
        &self.layout
    }

    /// Whether the pixels may have different numbers of samples.
    pub const fn varying(&self) -> bool {
        matches!(self.layout, SampleLayout::Varying { .. })
    }

    /// Number of samples in the data window.
    pub fn total(&self) -> usize {
        self.layout.total()
    }

    /// Greatest number of samples in any pixel of the data window.
    pub fn max_per_pixel(&self) -> u32 {
        match &self.layout {
            SampleLayout::Uniform { per_pixel, .. } => *per_pixel,
            SampleLayout::Varying { starts } => starts.windows(2).map(|w| w[1] - w[0]).max().unwrap_or(0),
        }
    }

    /// The planes, in the order of the channels.
    pub fn into_planes(self) -> Vec<Plane> {
        self.planes
    }

    /// What had to be made finite.
    pub const fn replaced(&self) -> Replaced {
        self.replaced
    }
}

/// Makes a sample that lacks any component, or whose components are all 0, lack all of them. A component that is constant
/// may stay so: the others say it.
fn unite_missing(components: &mut [Plane], samples: usize) {
    if components.iter().all(|plane| matches!(plane, Plane::Constant(_))) {
        let values = || components.iter().map(|plane| if let Plane::Constant(value) = plane { *value } else { 0.0 });
        if values().any(f32::is_nan) || values().all(|value| value == 0.0) {
            components.fill(Plane::Constant(f32::NAN));
        }
        return;
    }
    // Plane by plane, some samples at a time, so that the loops run in lanes: masks have the width of values.
    const AT_ONCE: usize = 512;
    const NONE: u32 = f32::NAN.to_bits();
    let mask = |set: bool| if set { u32::MAX } else { 0 };
    for start in (0..samples).step_by(AT_ONCE) {
        let range = start..samples.min(start + AT_ONCE);
        let (mut nan, mut not_zero) = ([0; AT_ONCE], [0; AT_ONCE]);
        for plane in &*components {
            let constant;
            let values = match plane {
                Plane::Constant(value) => {
                    constant = [*value; AT_ONCE];
                    &constant[..range.len()]
                }
                Plane::Values(values) => &values[range.clone()],
            };
            for ((nan, not_zero), value) in nan.iter_mut().zip(&mut not_zero).zip(values) {
                *nan |= mask(value.is_nan());
                *not_zero |= mask(*value != 0.0);
            }
        }
        for plane in components.iter_mut() {
            let Plane::Values(values) = plane else { continue };
            let values = &mut values[range.clone()];
            let lacking = || nan.iter().zip(&not_zero).map(|(nan, not_zero)| nan | !not_zero);
            let changed =
                values.iter().zip(lacking()).fold(0, |all, (v, lacking)| all | (v.to_bits() ^ NONE) & lacking);
            // Most often nothing is to be written.
            if changed != 0 {
                let united = |v: f32, lacking: u32| f32::from_bits(v.to_bits() & !lacking | NONE & lacking);
                values.iter_mut().zip(lacking()).for_each(|(v, lacking)| *v = united(*v, lacking));
            }
        }
    }
}

/// Makes finite what must be, as far as a value alone says what it becomes, and says how many were not: all become 0 but
/// colours, which wait for the [mean](replace_by_mean) of their pixel. -0 and 0 are equal, and which of them a tile meets
/// first must not matter: -0 becomes 0. A plane can be cleaned in pieces, while each is at hand.
pub(crate) fn clean(role: Role, values: &mut [f32]) -> u64 {
    match role {
        Role::Color => replace(values, |v| !v.is_finite(), |v| v),
        Role::Feature { .. } => replace(values, f32::is_infinite, |_| 0.0),
        Role::Random { .. } | Role::Film => replace(values, |v| !v.is_finite(), |_| 0.0),
    }
}

/// Replaces bad values, and says how many there were; in one pass without branches, which runs in lanes.
#[inline(always)]
fn replace(values: &mut [f32], bad: impl Fn(f32) -> bool, by: impl Fn(f32) -> f32) -> u64 {
    let piece = |values: &mut [f32]| {
        let mut replaced = 0_u32;
        for value in values {
            let bad = bad(*value);
            replaced += u32::from(bad);
            *value = if bad { by(*value) } else { *value + 0.0 };
        }
        u64::from(replaced)
    };
    values.chunks_mut(1 << 16).map(piece).sum()
}

/// Replaces what is not finite by the mean of what is, or by 0.
fn replace_by_mean(samples: &mut [f32]) {
    let finite = samples.iter().filter(|v| v.is_finite());
    let count = finite.clone().count();
    if count < samples.len() {
        let sum: f64 = finite.map(|&v| f64::from(v)).sum();
        let mean = if count == 0 { 0.0 } else { (sum / count as f64) as f32 + 0.0 };
        samples.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = mean);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, Rect};

    /// Two pixels of two samples; one feature of three components.
    fn feature(name: &str, position: bool, components: [Plane; 3]) -> SampleTile {
        let channels = vec![Channel::new("color", Role::Color, 3), Channel::new(name, Role::Feature { position }, 3)];
        let geometry = TileGeometry::with_halo([2, 1], Rect::new(0, 0, 2, 1), 0).unwrap();
        let planes = [Plane::Constant(0.0), Plane::Constant(0.0), Plane::Constant(0.0)].into_iter().chain(components);
        SampleTile::new(geometry, ChannelSet::new(channels).unwrap(), Counts::Uniform(2), planes.collect()).unwrap()
    }

    /// What became of the feature, missing values as 9.
    fn read(tile: &SampleTile) -> [[f32; 4]; 3] {
        let value = |plane, sample| Some(tile.value(plane, sample)).filter(|v| !v.is_nan()).unwrap_or(9.0);
        [3, 4, 5].map(|plane| [0, 1, 2, 3].map(|sample| value(plane, sample)))
    }

    const NAMES: [(&str, bool, bool); 6] = [
        ("P", true, true),
        ("anything", true, true),
        ("N", false, true),
        ("N2", false, true),
        ("albedo", false, false),
        ("N3", false, false),
    ];

    #[test]
    fn constant_zeros_are_missing_where_no_feature_is_zero() {
        let values = || Plane::Values(vec![0.0, -0.0, 0.0, 0.0]);
        for (name, position, missing) in NAMES {
            for planes in [[0.0; 3].map(Plane::Constant), [values(), values(), values()], {
                [Plane::Constant(0.0), values(), Plane::Constant(-0.0)]
            }] {
                let tile = feature(name, position, planes);
                for plane in 3..6 {
                    let Plane::Constant(value) = tile.plane(plane) else { panic!("{name}: it is constant") };
                    assert!(if missing { value.is_nan() } else { *value == 0.0 }, "{name}");
                }
                assert_eq!(tile.replaced().total(), 0);
            }
        }
    }

    #[test]
    fn single_samples_of_zeros_are_missing_and_others_are_not() {
        let planes = || {
            let x = Plane::Values(vec![0.0, 0.0, 1.0, f32::NAN]);
            [x, Plane::Values(vec![0.0, -2.0, 0.0, 0.0]), Plane::Values(vec![-0.0, 0.0, 3.0, 0.0])]
        };
        for (name, position, missing) in NAMES {
            let expected = if missing {
                [[9.0, 0.0, 1.0, 9.0], [9.0, -2.0, 0.0, 9.0], [9.0, 0.0, 3.0, 9.0]]
            } else {
                [[0.0, 0.0, 1.0, 9.0], [0.0, -2.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0]]
            };
            assert_eq!(read(&feature(name, position, planes())), expected, "{name}");
        }
    }

    #[test]
    fn a_component_that_is_zero_throughout_stays_constant() {
        let values = |values: [f32; 4]| Plane::Values(values.to_vec());
        for zeros in [Plane::Constant(0.0), values([0.0; 4]), values([0.0, -0.0, 0.0, 0.0])] {
            let tile = feature("N", false, [values([0.0, 1.0, 0.0, 0.5]), zeros, values([0.0, 0.0, 1.0, 0.5])]);
            assert_eq!(read(&tile), [[9.0, 1.0, 0.0, 0.5], [0.0; 4], [9.0, 0.0, 1.0, 0.5]]);
            assert_eq!(tile.plane(4), &Plane::Constant(0.0));
        }
        // One that is constant but not 0 makes a feature of every sample.
        let tile = feature("P", true, [values([0.0, 1.0, 0.0, 0.0]), Plane::Constant(0.0), Plane::Constant(5.0)]);
        assert_eq!(read(&tile), [[0.0, 1.0, 0.0, 0.0], [0.0; 4], [5.0; 4]]);
    }
}
