//! Makes a [`SampleTile`] of a decoder's events.

use super::{
    Event, Header,
    value::{CountReader, ValueReader},
};
use crate::filter::{Counts, Plane, SampleTile, samples::SampleError};

/// Takes the events of one tile; every plane is decoded straight into its final place.
///
/// Nothing is allocated before the first event that needs it, and never more than
/// [`plan`](crate::filter::plan::plan) says of the header's [`shape`](Header::shape): reserve that first.
#[derive(Debug)]
pub struct Assembler {
    header: Header,
    counts: Vec<u16>,
    count_reader: CountReader,
    planes: Vec<Plane>,
    /// Reader and values of the plane that is being read.
    open: Option<(ValueReader, Vec<f32>)>,
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
        }
    }

    /// The header it was made with.
    pub const fn header(&self) -> &Header {
        &self.header
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
            Event::Constant { value, .. } => self.planes.push(Plane::Constant(*value)),
            Event::Values { plane, bytes } => {
                let (reader, values) = self.open.get_or_insert_with(|| {
                    // The header has been validated: at most 4 GiB, and the caller has planned for them.
                    let values = Vec::with_capacity(self.header.total() as usize);
                    (ValueReader::new(self.header.plane_format(*plane)), values)
                });
                reader.push(bytes, |value| values.push(value));
            }
            Event::PlaneEnd { .. } => {
                let values = self.open.take().map_or_else(Vec::new, |(_, values)| values);
                self.planes.push(Plane::Values(values));
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
        SampleTile::new(*header.geometry(), header.channels().clone(), counts, planes)
    }
}
