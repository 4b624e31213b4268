//! Samples that a case can change before they become a tile.

use crate::filter::{
    Channel, ChannelSet, Counts, Execution, Halo, Plane, Rect, Role, SampleTile, TileGeometry, geometry::tiling,
};
use crate::synth::Scene;
use crate::wire::{Assembler, Decoder, Format, Header, encode_tile};

/// What a case starts from: crops of one small render, lens, motion, gloss and textures in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Base {
    /// 16 x 16 pixels, 4 samples each.
    Image,
    /// The same without features.
    NoFeatures,
    /// The same with the first hit's position as the only feature.
    Positions,
    /// 16 x 16 pixels, 1 sample each.
    OneSample,
    /// 2 x 2 pixels, 1024 samples each.
    ManySamples,
    /// 6 x 6 pixels, 4 samples each.
    Small,
    /// So many pixels, 4 samples each.
    Size(u32, u32),
}

/// Samples of a whole image, plane by plane.
#[derive(Clone, Debug)]
pub(super) struct Samples {
    pub(super) size: [u32; 2],
    pub(super) channels: Vec<Channel>,
    /// Samples in each pixel.
    pub(super) counts: Vec<u16>,
    /// As in a tile: samples of a pixel next to each other, pixels row by row.
    pub(super) planes: Vec<Vec<f32>>,
}

impl Base {
    /// The samples.
    pub(super) fn samples(self) -> Samples {
        // Sky, a ball in motion and the edge of another before it, and the floor.
        let corner = [16, 14];
        let (corner, size, spp) = match self {
            Self::Image | Self::NoFeatures | Self::Positions => (corner, [16, 16], 4),
            Self::OneSample => (corner, [16, 16], 1),
            Self::ManySamples => ([20, 26], [2, 2], 1024),
            Self::Small => ([20, 18], [6, 6], 4),
            Self::Size(width, height) => (corner, [width, height], 4),
        };
        let mut samples = Samples::render(corner, size, spp);
        // Second hits are features like any others: without them the oracle is done sooner.
        samples.keep(|channel| !matches!(channel.name.as_str(), "P2" | "N2"));
        if self == Self::NoFeatures {
            samples.keep(|channel| !matches!(channel.role, Role::Feature { .. }));
        }
        if self == Self::Positions {
            samples.keep(|channel| !matches!(channel.role, Role::Feature { .. }) || channel.name == "P");
        }
        samples
    }
}

impl Samples {
    /// Part of a render of 64 x 64 pixels.
    fn render([x, y]: [u32; 2], [width, height]: [u32; 2], spp: u32) -> Self {
        let core = Rect::new(x, y, width, height);
        let Some(scene) = Scene::by_name("all") else { unreachable!("the scene of the tests") };
        let Ok(geometry) = TileGeometry::new([64, 64], core, Halo::default()) else { unreachable!("it lies inside") };
        let Ok(tile) = scene.tile(geometry, spp, &Execution::default()) else { unreachable!("it is small") };
        let values = |plane| (0..tile.total()).map(|s| tile.value(plane, s)).collect();
        let mut samples = Self {
            size: [width, height],
            channels: tile.channels().channels().to_vec(),
            counts: vec![spp as u16; core.area() as usize],
            planes: (0..tile.channels().planes()).map(values).collect(),
        };
        // The crop is an image of its own.
        let corner = [core.x as f32, core.y as f32];
        for (plane, corner) in samples.channel("film").iter_mut().zip(corner) {
            plane.iter_mut().for_each(|v| *v -= corner);
        }
        samples
    }

    /// Number of samples.
    pub(super) fn total(&self) -> usize {
        self.counts.iter().map(|&n| usize::from(n)).sum()
    }

    /// The planes of the channels that pass.
    pub(super) fn planes_of(&mut self, wanted: impl Fn(&Channel) -> bool) -> Vec<&mut Vec<f32>> {
        let owners = self.channels.iter().flat_map(|channel| std::iter::repeat_n(channel, channel.components as usize));
        owners.zip(&mut self.planes).filter(|(channel, _)| wanted(channel)).map(|(_, plane)| plane).collect()
    }

    /// The planes of the channel of this name.
    pub(super) fn channel(&mut self, name: &str) -> Vec<&mut Vec<f32>> {
        self.planes_of(|channel| channel.name == name)
    }

    /// The planes of all features.
    pub(super) fn features(&mut self) -> Vec<&mut Vec<f32>> {
        self.planes_of(|channel| matches!(channel.role, Role::Feature { .. }))
    }

    /// Changes every value of some planes.
    pub(super) fn map(planes: Vec<&mut Vec<f32>>, change: impl Fn(f32) -> f32) {
        planes.into_iter().flatten().for_each(|v| *v = change(*v));
    }

    /// Adds a channel of one plane.
    pub(super) fn add(&mut self, name: &str, role: Role, plane: Vec<f32>) {
        self.channels.push(Channel::new(name, role, 1));
        self.planes.push(plane);
    }

    /// Keeps the channels that pass.
    pub(super) fn keep(&mut self, wanted: impl Fn(&Channel) -> bool) {
        self.planes = self.planes_of(&wanted).into_iter().map(std::mem::take).collect();
        self.channels.retain(wanted);
    }

    /// Brings the samples into another order: new sample i is old sample `order[i]`; pixels keep their counts.
    pub(super) fn reorder(&mut self, order: &[usize]) {
        for plane in &mut self.planes {
            *plane = order.iter().map(|&from| plane[from]).collect();
        }
    }

    /// Leaves each pixel the first of its samples, as many as `count` says of its index.
    pub(super) fn thin(&mut self, count: impl Fn(usize) -> u16) {
        let (mut kept, mut start) = (Vec::new(), 0);
        for (pixel, have) in self.counts.iter_mut().enumerate() {
            let left = count(pixel).min(*have);
            kept.extend(start..start + usize::from(left));
            start += usize::from(*have);
            *have = left;
        }
        self.reorder(&kept);
    }

    /// The whole image as one tile.
    pub(super) fn whole(&self) -> SampleTile {
        let [width, height] = self.size;
        self.tile(Rect::new(0, 0, width, height), 0)
    }

    /// Tiles of so many pixels with this halo, which cover the image.
    pub(super) fn tiles(&self, size: u32, halo: u32) -> impl Iterator<Item = SampleTile> {
        tiling(self.size, size).map(move |core| self.tile(core, halo))
    }

    fn tile(&self, core: Rect, halo: u32) -> SampleTile {
        let Ok(geometry) = TileGeometry::with_halo(self.size, core, halo) else { unreachable!("it lies inside") };
        let Ok(channels) = ChannelSet::new(self.channels.clone()) else { unreachable!("cases add good channels") };
        let mut starts = vec![0];
        for count in &self.counts {
            starts.push(starts[starts.len() - 1] + usize::from(*count));
        }
        let window = geometry.window();
        let rows = window.y..window.bottom();
        let pixels: Vec<usize> = rows
            .flat_map(|y| (window.x..window.right()).map(move |x| y * self.size[0] + x))
            .map(|p| p as usize)
            .collect();
        let first = self.counts.first().copied().unwrap_or(0);
        let counts = match self.counts.iter().all(|&n| n == first) {
            true => Counts::Uniform(first.into()),
            false => Counts::Varying(pixels.iter().map(|&p| self.counts[p]).collect()),
        };
        let cut = |plane: &Vec<f32>| pixels.iter().flat_map(|&p| &plane[starts[p]..starts[p + 1]]).copied().collect();
        let planes = self.planes.iter().map(|plane| Plane::Values(cut(plane))).collect();
        let Ok(tile) = SampleTile::new(geometry, channels, counts, planes) else { unreachable!("cases fit") };
        tile
    }
}

/// A tile as it arrives if it was sent in half precision: what is beyond 65504 is infinite on the way.
pub(super) fn over_the_wire_as_f16(tile: &SampleTile) -> SampleTile {
    let Ok(header) = Header::of(tile, Format::F16) else { unreachable!("cases fit into a tile") };
    let mut bytes = Vec::new();
    if encode_tile(&header, tile, &mut bytes).is_err() {
        unreachable!("the header is the tile's, and memory takes all")
    }
    let (mut decoder, mut input, mut assembler) = (Decoder::new(), &bytes[..], Assembler::new(&header));
    while let Ok(Some(event)) = decoder.next(&mut input) {
        assembler.push(&event);
    }
    let Ok(arrived) = assembler.finish() else { unreachable!("what was encoded decodes") };
    arrived
}
