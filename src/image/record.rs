//! How tiles and samples are written down in the image's store: fixed fields, little-endian.

use crate::{
    filter::{ChannelSet, Halo, LeftOut, LeftOutReason, Report, Work, samples::Replaced},
    stitch::{Digest, canvas::Checksum},
    store::Extent,
};

/// A tile on the canvas.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TileRecord {
    pub(super) digest: Digest,
    pub(super) checksum: Checksum,
    pub(super) seconds: f64,
    pub(super) report: Report,
}

/// The samples of a core.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CoreRecord {
    pub(super) digest: Digest,
    pub(super) extent: Extent,
    pub(super) replaced: Replaced,
}

/// Where samples are.
pub(super) fn extent_to_bytes(extent: &Extent) -> Vec<u8> {
    let mut out = Vec::with_capacity(128);
    out.extend_from_slice(&extent.offset.to_le_bytes());
    out.extend_from_slice(&extent.len.to_le_bytes());
    out.extend_from_slice(&extent.head.to_le_bytes());
    out.extend_from_slice(&extent.check);
    out
}

pub(super) fn extent_from_bytes(bytes: &[u8]) -> Option<Extent> {
    let mut from = Reader(bytes);
    let extent = from.extent()?;
    from.0.is_empty().then_some(extent)
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*first)
    }

    fn long(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn int(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn real(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    fn extent(&mut self) -> Option<Extent> {
        let extent = Extent { offset: self.long()?, len: self.long()?, head: self.int()?, check: self.take()? };
        extent.possible().then_some(extent)
    }

    fn replaced(&mut self) -> Option<Replaced> {
        Some(Replaced { color: self.long()?, feature: self.long()?, random: self.long()?, film: self.long()? })
    }

    fn halo(&mut self) -> Option<Halo> {
        Some(Halo { left: self.int()?, top: self.int()?, right: self.int()?, bottom: self.int()? })
    }
}

fn put_replaced(out: &mut Vec<u8>, replaced: &Replaced) {
    for count in [replaced.color, replaced.feature, replaced.random, replaced.film] {
        out.extend_from_slice(&count.to_le_bytes());
    }
}

impl TileRecord {
    /// Planes are named by their place in `channels`.
    pub(super) fn encode(&self, channels: &ChannelSet) -> Vec<u8> {
        let Self { digest, checksum, seconds, report } = self;
        let mut out = Vec::with_capacity(256);
        out.extend_from_slice(digest);
        out.extend_from_slice(checksum);
        for real in [*seconds, report.energy_in, report.energy_out, report.settled_error] {
            out.extend_from_slice(&real.to_le_bytes());
        }
        let counts =
            [report.samples, report.spikes, report.filled, report.unfilled, report.settled, report.left_out_bytes];
        let work = report.work.unwrap_or_default();
        for count in counts.into_iter().chain([work.done, work.planes, work.columns, work.distances]) {
            out.extend_from_slice(&count.to_le_bytes());
        }
        out.push(u8::from(report.work.is_some()));
        put_replaced(&mut out, &report.replaced);
        for halo in [report.halo, report.halo_needed] {
            for side in [halo.left, halo.top, halo.right, halo.bottom] {
                out.extend_from_slice(&side.to_le_bytes());
            }
        }
        for (plane, reason) in (0..channels.planes()).filter_map(|plane| {
            let name = channels.plane_name(plane);
            let left = report.left_out.iter().find(|left| left.plane == name)?;
            Some((plane, LeftOutReason::ALL.iter().position(|reason| *reason == left.reason)?))
        }) {
            // At most 256 planes.
            out.extend_from_slice(&[plane as u8, reason as u8]);
        }
        out
    }

    pub(super) fn decode(bytes: &[u8], channels: &ChannelSet) -> Option<Self> {
        let mut from = Reader(bytes);
        let (digest, checksum) = (from.take()?, from.take()?);
        let (seconds, energy_in, energy_out, settled_error) = (from.real()?, from.real()?, from.real()?, from.real()?);
        let (samples, spikes, filled, unfilled) = (from.long()?, from.long()?, from.long()?, from.long()?);
        let (settled, left_out_bytes) = (from.long()?, from.long()?);
        let [done, planes, columns, distances] = [from.long()?, from.long()?, from.long()?, from.long()?];
        let [counted] = from.take()?;
        let work = (counted != 0).then_some(Work { done, planes, columns, distances });
        let (replaced, halo, halo_needed) = (from.replaced()?, from.halo()?, from.halo()?);
        let mut left_out = Vec::new();
        while !from.0.is_empty() {
            let [plane, reason] = from.take()?;
            if usize::from(plane) >= channels.planes() {
                return None;
            }
            let reason = *LeftOutReason::ALL.get(usize::from(reason))?;
            left_out.push(LeftOut { plane: channels.plane_name(plane.into()), reason });
        }
        let report = Report {
            samples,
            replaced,
            spikes,
            energy_in,
            energy_out,
            filled,
            unfilled,
            settled,
            settled_error,
            halo,
            halo_needed,
            left_out,
            left_out_bytes,
            work,
        };
        Some(Self { digest, checksum, seconds, report })
    }
}

impl CoreRecord {
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(128);
        out.extend_from_slice(&self.digest);
        out.extend(extent_to_bytes(&self.extent));
        put_replaced(&mut out, &self.replaced);
        out
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let mut from = Reader(bytes);
        let record = Self { digest: from.take()?, extent: from.extent()?, replaced: from.replaced()? };
        from.0.is_empty().then_some(record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{Channel, Role};

    #[test]
    fn records_are_read_as_they_were_written() {
        let channels = vec![Channel::new("color", Role::Color, 3), Channel::new("f", Role::Film, 2)];
        let channels = ChannelSet::new(channels).unwrap();
        let replaced = Replaced { color: 1, feature: 2, random: 3, film: 4 };
        let halo = Halo { left: 5, top: 6, right: 7, bottom: 8 };
        let left = |plane: &str, reason| LeftOut { plane: plane.to_owned(), reason };
        let report = Report {
            samples: 9,
            replaced,
            spikes: 10,
            energy_in: 0.1,
            energy_out: f64::MAX,
            filled: 11,
            unfilled: 12,
            settled: 13,
            settled_error: 1e-9,
            halo,
            halo_needed: Halo::default(),
            left_out: vec![left("color.1", LeftOutReason::Constant), left("f.0", LeftOutReason::Unused)],
            left_out_bytes: 14,
            work: Some(Work { done: 15, planes: 16, columns: 17, distances: 18 }),
        };
        let tile = TileRecord { digest: [3; 32], checksum: [4; 16], seconds: 0.3, report };
        let bytes = tile.encode(&channels);
        assert_eq!(TileRecord::decode(&bytes, &channels), Some(tile));
        let extent = Extent { offset: 1 << 40, len: 7, head: 5, check: [8; 16] };
        let core = CoreRecord { digest: [1; 32], extent, replaced };
        assert_eq!(CoreRecord::decode(&core.encode()), Some(core.clone()));
        for cut in 0..bytes.len() {
            assert!(cut % 2 == 1 && cut > 216 || TileRecord::decode(&bytes[..cut], &channels).is_none(), "{cut}");
        }
        assert_eq!(CoreRecord::decode(&core.encode()[1..]), None);
        assert_eq!(extent_from_bytes(&extent_to_bytes(&extent)), Some(extent));
        assert_eq!(extent_from_bytes(&core.encode()), None);
    }
}
