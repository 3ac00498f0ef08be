//! The pulse of a lease: a sign that the holder is alive, its working time and its progress. It is one line
//! of a fixed length after the holder's line, overwritten in place every few seconds. So a lease costs a
//! shared file system one small write and no new names.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::cache::lock;

/// Most letters of a unit that are written.
const UNIT: usize = 16;

/// A pulse.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Beat {
    /// Number of writes. A living holder changes its lease in this way, even without progress.
    pub(crate) number: u64,
    /// The time for which the holder has had the lease, in seconds by its own clock.
    pub(crate) seconds: u64,
    /// Work done.
    pub(crate) done: u64,
    /// Total work; 0 where the stage does not report it.
    pub(crate) total: u64,
    /// The unit of the work.
    pub(crate) unit: String,
    /// The peak memory of the holder in megabytes.
    pub(crate) memory: u64,
    /// True if the holder gave up: its artifact does not exist.
    pub(crate) left: bool,
}

/// The line of a pulse, which always has the same length.
pub(crate) fn line(beat: &Beat) -> Vec<u8> {
    const MOST: u64 = 9_999_999_999;
    let number = |n: u64| n.min(MOST);
    let unit: String = beat.unit.chars().filter(char::is_ascii_alphanumeric).take(UNIT).collect();
    let word = if beat.left { "left" } else { "here" };
    let unit = if unit.is_empty() { "-" } else { &unit };
    format!(
        "{word} {:010} {:010} {:010} {:010} {:010} {unit:<UNIT$}\n",
        beat.number % MOST,
        number(beat.seconds),
        number(beat.done),
        number(beat.total),
        number(beat.memory)
    )
    .into_bytes()
}

/// Parses a line; `None` if it is not a pulse.
pub(crate) fn parse(bytes: &[u8]) -> Option<Beat> {
    let mut words = std::str::from_utf8(bytes).ok()?.split_whitespace();
    let left = match words.next()? {
        "left" => true,
        "here" => false,
        _ => return None,
    };
    let mut number = || words.next()?.parse().ok();
    let (number, seconds, done, total) = (number()?, number()?, number()?, number()?);
    // Earlier versions did not write the memory.
    let (next, last) = (words.next()?, words.next());
    let (memory, unit) = match last {
        Some(unit) => (next.parse().ok()?, unit),
        None => (0, next),
    };
    Some(Beat { number, seconds, done, total, unit: unit.replace('-', ""), memory, left })
}

/// The progress of a stage, passed from the working threads to the thread that renews the lease.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    memory: AtomicU64,
    done: AtomicU64,
    total: AtomicU64,
    unit: Mutex<String>,
}

impl Progress {
    /// Stores the progress.
    pub(crate) fn note(&self, done: u64, total: u64, unit: &str) {
        self.done.store(done, Ordering::Relaxed);
        self.total.store(total, Ordering::Relaxed);
        let mut known = lock(&self.unit);
        if *known != unit {
            unit.clone_into(&mut known);
        }
    }

    /// Notes the memory in use, in bytes; the pulse shows the peak.
    pub(crate) fn note_memory(&self, bytes: u64) {
        self.memory.fetch_max(bytes >> 20, Ordering::Relaxed);
    }

    /// Copies the progress into a pulse.
    pub(crate) fn read(&self, beat: &mut Beat) {
        beat.done = self.done.load(Ordering::Relaxed);
        beat.memory = self.memory.load(Ordering::Relaxed);
        beat.total = self.total.load(Ordering::Relaxed);
        beat.unit.clone_from(&lock(&self.unit));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pulse_comes_back_and_is_always_as_long() {
        let long = Beat {
            number: 7,
            seconds: 12_345,
            done: 300,
            total: 15_000,
            unit: "steps".to_string(),
            memory: 1234,
            left: true,
        };
        for beat in [Beat::default(), long.clone(), Beat { total: u64::MAX, ..Beat::default() }] {
            assert_eq!(line(&beat).len(), line(&Beat::default()).len());
        }
        for beat in [Beat::default(), long] {
            assert_eq!(parse(&line(&beat)), Some(beat));
        }
        for wrong in [&b""[..], b"here", b"there 1 2 3 4 steps", b"here 1 2 3 x steps", &[0xff, 0xfe]] {
            assert_eq!(parse(wrong), None);
        }
        let old = parse(b"here 0000000001 0000000002 0000000003 0000000004 steps           \n").unwrap();
        assert_eq!((old.total, old.memory, old.unit.as_str()), (4, 0, "steps"));
        // A unit of several words, or a long unit, becomes one word.
        let odd = Beat { unit: "pictures of all views".to_string(), ..Beat::default() };
        assert_eq!(parse(&line(&odd)).map(|b| b.unit), Some("picturesofallvie".to_string()));
    }
}
