//! Random numbers, and what they do to bytes.

/// SplitMix64.
pub(super) struct Random(u64);

impl Random {
    pub(super) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(super) const fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Below `limit`, which is above 0.
    pub(super) const fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit as u64) as usize
    }

    pub(super) const fn one_in(&mut self, chances: usize) -> bool {
        self.below(chances) == 0
    }

    pub(super) fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }
}

/// Bytes that begin something in MessagePack, and numbers at the edge of something.
const MARKERS: [u8; 24] = [
    0x00, 0x01, 0x7f, 0x80, 0x81, 0x8f, 0x90, 0x94, 0xa0, 0xa4, 0xc0, 0xc1, 0xc3, 0xc4, 0xc6, 0xca, 0xcb, 0xcd, 0xce,
    0xcf, 0xd0, 0xdb, 0xdf, 0xff,
];

/// Changes bytes a few times; `others` lend pieces of theirs, `words` are put in as they are.
pub(super) fn mutate(bytes: &mut Vec<u8>, random: &mut Random, others: &[Vec<u8>], words: &[&[u8]]) {
    // Often once: most of what is right stays so.
    let times = [1, 1, 1, 2, 3, 8][random.below(6)];
    for _ in 0..times {
        if bytes.is_empty() {
            bytes.push(random.next() as u8);
        }
        let at = random.below(bytes.len());
        let end = at + 1 + random.below((bytes.len() - at).min(16));
        match random.below(12) {
            0 => bytes[at] ^= 1 << random.below(8),
            1 => bytes[at] = random.next() as u8,
            2 | 3 => bytes[at] = *random.pick(&MARKERS),
            4 => bytes[at] = bytes[at].wrapping_add(if random.one_in(2) { 1 } else { 0xff }),
            5 => drop(bytes.drain(at..end)),
            6 => bytes.insert(at, *random.pick(&MARKERS)),
            7 => bytes.extend_from_within(at..end),
            8 => bytes.truncate(at),
            9 => {
                let other = random.pick(others);
                if !other.is_empty() {
                    let from = random.below(other.len());
                    let to = from + 1 + random.below(other.len() - from);
                    bytes.splice(at..at, other[from..to].iter().copied());
                }
            }
            10 => {
                let word = *random.pick(words);
                bytes.splice(at..end.min(at + word.len()), word.iter().copied());
            }
            _ => {
                // A number of 16 to 64 bits in the place of some bytes.
                let marker = [0xcd, 0xce, 0xcf, 0xd3][random.below(4)];
                let number = [u64::MAX, 1 << 31, 1 << 32, 1 << 16, 65_535, random.next()][random.below(6)];
                let width = [2, 4, 8, 8][random.below(4)];
                let number = number.to_be_bytes();
                bytes.splice(at..end, [marker].into_iter().chain(number[8 - width..].iter().copied()));
            }
        }
        bytes.truncate(1 << 17);
    }
}
