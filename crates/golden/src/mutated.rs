//! Bounded, seeded changes of a file's bytes, for tests that readers of text formats never panic.

use use3d_numerics::random::{Purpose, Stream};

/// The number of random draws that one file may take.
const DRAWS: u64 = 32;

/// The mutation of `round` of a file: one to three bytes are overwritten, inserted or replaced by one of
/// `marks` (characters with a meaning in the format), or a piece of the file is doubled, or its end is cut
/// off. At least one byte is left. The same arguments give the same bytes.
pub fn mutated(file: &[u8], marks: &[u8], round: u64) -> Vec<u8> {
    let stream = Stream::new(7, Purpose::new("mutated files"), 0);
    let mut draws = round * DRAWS..;
    let mut below = |n: usize| stream.below(draws.next().unwrap_or(u64::MAX), n.max(1));
    let mut bytes = file.to_vec();
    for _ in 0..1 + below(3) {
        let at = below(bytes.len());
        match below(5) {
            0 => bytes[at] = below(256) as u8,
            1 => bytes.insert(at, below(256) as u8),
            2 => bytes[at] = marks[below(marks.len())],
            3 => {
                let end = (at + below(60)).min(bytes.len());
                let (piece, to) = (bytes[at..end].to_vec(), below(bytes.len()));
                bytes.splice(to..to, piece);
            }
            _ => bytes.truncate(at.max(1)),
        }
    }
    bytes
}
