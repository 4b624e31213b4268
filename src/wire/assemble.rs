//! Makes a [`SampleTile`] of a decoder's events.

use super::{
    Event, Header,
    value::{CountReader, ValueReader},
};
use crate::filter::{
    Counts, Plane, Role, SampleTile,
    samples::{SampleError, clean},
};

/// Takes the events of one tile; every plane is decoded straight into its final place.
///
/// Nothing is allocated before the first event that needs it, and never more than
/// [`plan`](crate::filter::plan::plan) says of the header's [`shape`](Header::shape): reserve that first.
#[derive(Debug)]
pub struct Assembler {
    header: Header,
    counts: Vec<u16>,
    count_reader: CountReader,
    /// Each with the number of its values that were not finite where they must be.
    planes: Vec<(Plane, u64)>,
    open: Option<Open>,
    /// Room for planes, without values yet.
    spare: Vec<Vec<f32>>,
}

/// The plane that is being read.
#[derive(Debug)]
struct Open {
    role: Role,
    reader: ValueReader,
    values: Vec<f32>,
    replaced: u64,
}

impl Open {
    fn new(header: &Header, plane: usize, spare: Option<Vec<f32>>) -> Option<Self> {
        let (channel, _) = header.channels().plane_channels().nth(plane)?;
        // The header has been validated: at most 4 GiB, and the caller has planned for them.
        let values = spare.unwrap_or_else(|| Vec::with_capacity(header.total() as usize));
        Some(Self { role: channel.role, reader: ValueReader::new(header.plane_format(plane)), values, replaced: 0 })
    }
}

impl Assembler {
    /// Ready for the events that follow this header.
    pub fn new(header: &Header) -> Self {
        Self {
            header: header.clone(),
            counts: Vec::new(),
            count_reader: CountReader::default(),
            planes: Vec::with_capacity(header.channels().planes()),
            open: None,
            spare: Vec::new(),
        }
    }

    /// The header it was made with.
    pub const fn header(&self) -> &Header {
        &self.header
    }

    /// Gives it room for planes that is there already: empty, with a capacity of the header's
    /// [`total`](Header::total). It allocates the others itself.
    pub fn reuse(&mut self, planes: Vec<Vec<f32>>) {
        self.spare = planes;
    }

    /// Takes the next event of this tile. Headers and ends of tiles mean nothing to it.
    pub fn push(&mut self, event: &Event) {
        match event {
            Event::Counts(bytes) => {
                if self.counts.capacity() == 0 {
                    self.counts.reserve_exact(self.header.geometry().window().area() as usize);
                }
                self.count_reader.push(bytes, |count| self.counts.push(count));
            }
            Event::Constant { value, .. } => self.planes.push((Plane::Constant(*value), 0)),
            Event::Values { plane, bytes } => {
                if self.open.is_none() {
                    self.open = Open::new(&self.header, *plane, self.spare.pop());
                }
                let Some(Open { role, reader, values, replaced }) = &mut self.open else { return };
                reader.push(bytes, |piece| {
                    *replaced += clean(*role, piece);
                    values.extend_from_slice(piece);
                });
            }
            Event::PlaneEnd { .. } => {
                let (values, replaced) = self.open.take().map_or_else(Default::default, |o| (o.values, o.replaced));
                self.planes.push((Plane::Values(values), replaced));
            }
            Event::Header(_) | Event::TileEnd => {}
        }
    }

    /// The tile, once all its events are in; without some of them, an error.
    pub fn finish(self) -> Result<SampleTile, SampleError> {
        let Self { header, counts, planes, .. } = self;
        let counts = match header.samples() {
            super::SampleCounts::Uniform(n) => Counts::Uniform(n),
            super::SampleCounts::Varying { .. } => Counts::Varying(counts),
        };
        SampleTile::of_clean(*header.geometry(), header.channels().clone(), counts, planes)
    }
}
