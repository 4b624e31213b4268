//! Values of one plane, packed and unpacked block by block.

use std::{array, cell::RefCell, io};

use super::samples::BLOCK;
use crate::disk::Storage;

/// Favour speed: noise does not compress well anyway.
const LEVEL: i32 = 1;

pub(super) fn hash(bytes: &[u8]) -> [u8; 16] {
    let mut short = [0; 16];
    short.copy_from_slice(&blake3::hash(bytes).as_bytes()[..16]);
    short
}

/// Collects values of one size, and writes blocks of them.
pub(super) struct BlockWriter<'a> {
    file: &'a dyn Storage,
    pub(super) at: u64,
    /// Values, as they come.
    values: Vec<u8>,
    /// The same, by significance, and compressed.
    ordered: Vec<u8>,
    compressed: Vec<u8>,
    /// Bytes of a value.
    size: usize,
    compressor: zstd::bulk::Compressor<'static>,
}

impl<'a> BlockWriter<'a> {
    pub(super) fn new(file: &'a dyn Storage, at: u64) -> io::Result<Self> {
        let mut compressor = zstd::bulk::Compressor::new(LEVEL)?;
        compressor.include_checksum(true)?;
        Ok(Self { file, at, values: Vec::new(), ordered: Vec::new(), compressed: Vec::new(), size: 1, compressor })
    }

    pub(super) fn push(&mut self, value: &[u8], head: &mut Vec<u8>) -> io::Result<()> {
        self.size = value.len();
        self.values.extend_from_slice(value);
        if self.values.len() as u64 == BLOCK * value.len() as u64 { self.end(head) } else { Ok(()) }
    }

    /// Writes what there is as a block.
    pub(super) fn end(&mut self, head: &mut Vec<u8>) -> io::Result<()> {
        if self.values.is_empty() {
            return Ok(());
        }
        self.ordered.clear();
        for byte in 0..self.size {
            self.ordered.extend(self.values.iter().skip(byte).step_by(self.size));
        }
        self.compressed.clear();
        self.compressed.reserve(zstd::zstd_safe::compress_bound(self.ordered.len()));
        self.compressor.compress_to_buffer(&self.ordered, &mut self.compressed)?;
        self.file.write(self.at, &self.compressed)?;
        head.extend_from_slice(&(self.compressed.len() as u32).to_le_bytes());
        self.at += self.compressed.len() as u64;
        self.values.clear();
        Ok(())
    }
}

/// Reads blocks, and keeps the last of the counts and the last of a plane: they are read in turn.
pub(super) struct Reader<'a> {
    pub(super) file: &'a dyn Storage,
    pub(super) caches: RefCell<[Cache; 2]>,
    pub(super) decompressor: RefCell<zstd::bulk::Decompressor<'static>>,
}

#[derive(Default)]
pub(super) struct Cache {
    /// Where the block is, of which these are the values by significance.
    block: Option<u64>,
    bytes: Vec<u8>,
    compressed: Vec<u8>,
}

/// Blocks of a plane, or of the counts.
#[derive(Debug, Default)]
pub(super) struct Blocks {
    /// Where each starts, and the end of the last.
    starts: Vec<u64>,
    pub(super) values: u64,
    /// Values of each but the last.
    block: u64,
}

pub(super) fn damaged(why: impl std::fmt::Display) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("it is damaged: {why}"))
}

impl Reader<'_> {
    /// Reads values of `N` bytes from this one on.
    pub(super) fn read<T, const N: usize>(
        &self,
        blocks: &Blocks,
        from: u64,
        mut into: &mut [T],
        value: impl Fn([u8; N]) -> T,
    ) -> io::Result<()> {
        if from + into.len() as u64 > blocks.values {
            return Err(damaged("a core has fewer samples than it should"));
        }
        let cache = &mut self.caches.borrow_mut()[usize::from(N == 4)];
        let mut at = from;
        while !into.is_empty() {
            let index = (at / blocks.block) as usize;
            let first = index as u64 * blocks.block;
            let values = (blocks.values - first).min(blocks.block) as usize;
            self.unpack(blocks.starts[index], blocks.starts[index + 1], values * N, cache)?;
            let skipped = (at - first) as usize;
            let (now, later) = into.split_at_mut((values - skipped).min(into.len()));
            let bytes: [&[u8]; N] = array::from_fn(|byte| &cache.bytes[byte * values + skipped..][..now.len()]);
            for (i, slot) in now.iter_mut().enumerate() {
                *slot = value(array::from_fn(|byte| bytes[byte][i]));
            }
            at += now.len() as u64;
            into = later;
        }
        Ok(())
    }

    /// Unpacks the block between these places, of so many bytes, unless it is there.
    fn unpack(&self, start: u64, end: u64, length: usize, cache: &mut Cache) -> io::Result<()> {
        let Cache { block, bytes, compressed } = cache;
        if *block != Some(start) {
            *block = None;
            compressed.resize((end - start) as usize, 0);
            self.file.read(start, compressed)?;
            bytes.clear();
            bytes.reserve_exact(length);
            let unpacked = self.decompressor.borrow_mut().decompress_to_buffer(compressed, bytes);
            unpacked.map_err(|_| damaged("a block of samples"))?;
            if bytes.len() != length {
                return Err(damaged("a block of samples has another length"));
            }
            *block = Some(start);
        }
        Ok(())
    }
}

pub(super) fn byte(head: &mut &[u8]) -> Option<u8> {
    let (first, rest) = head.split_first()?;
    *head = rest;
    Some(*first)
}

pub(super) fn number(head: &mut &[u8]) -> Option<u32> {
    let (first, rest) = head.split_first_chunk()?;
    *head = rest;
    Some(u32::from_le_bytes(*first))
}

pub(super) fn blocks(head: &mut &[u8], at: &mut u64, values: u64, block: u64) -> Option<Blocks> {
    let mut starts = vec![*at];
    for _ in 0..values.div_ceil(block) {
        let compressed =
            number(head).filter(|&bytes| bytes as usize <= zstd::zstd_safe::compress_bound(4 * block as usize))?;
        *at += u64::from(compressed);
        starts.push(*at);
    }
    Some(Blocks { starts, values, block })
}
