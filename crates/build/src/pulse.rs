//! What a lease says of its holder besides who it is: that it lives, how long it has worked, and how far it
//! is. One line of a fixed length behind the holder's, written over in place every few seconds, so that a
//! lease costs a shared file system one small write and no new names.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Letters of a unit that are told.
const UNIT: usize = 16;

/// A pulse.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Beat {
    /// Counts the writes: a holder that lives changes its lease, whatever else it does.
    pub(crate) number: u64,
    /// How long the holder has had the lease, by its own clock.
    pub(crate) seconds: u64,
    /// Work done.
    pub(crate) done: u64,
    /// Work in all; 0 where the stage does not say.
    pub(crate) total: u64,
    /// What is counted.
    pub(crate) unit: String,
    /// The most memory that the holder has held, megabytes.
    pub(crate) memory: u64,
    /// The holder gave up: its artifact is not there.
    pub(crate) left: bool,
}

/// The line of a pulse: of the same length whatever it says.
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

/// Reads a line; `None` for what is none.
pub(crate) fn parse(bytes: &[u8]) -> Option<Beat> {
    let mut words = std::str::from_utf8(bytes).ok()?.split_whitespace();
    let left = match words.next()? {
        "left" => true,
        "here" => false,
        _ => return None,
    };
    let mut number = || words.next()?.parse().ok();
    let (number, seconds, done, total) = (number()?, number()?, number()?, number()?);
    // Earlier versions said nothing of memory.
    let (next, last) = (words.next()?, words.next());
    let (memory, unit) = match last {
        Some(unit) => (next.parse().ok()?, unit),
        None => (0, next),
    };
    Some(Beat { number, seconds, done, total, unit: unit.replace('-', ""), memory, left })
}

/// How far a stage is, from the threads that work to the one that tells.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    memory: AtomicU64,
    done: AtomicU64,
    total: AtomicU64,
    unit: Mutex<String>,
}

impl Progress {
    /// Notes it.
    pub(crate) fn note(&self, done: u64, total: u64, unit: &str) {
        self.done.store(done, Ordering::Relaxed);
        self.total.store(total, Ordering::Relaxed);
        let mut known = self.unit.lock().unwrap_or_else(PoisonError::into_inner);
        if *known != unit {
            unit.clone_into(&mut known);
        }
    }

    /// Notes the most memory that was held so far, bytes.
    pub(crate) fn note_memory(&self, bytes: u64) {
        self.memory.fetch_max(bytes >> 20, Ordering::Relaxed);
    }

    /// Puts it into a pulse.
    pub(crate) fn read(&self, beat: &mut Beat) {
        beat.done = self.done.load(Ordering::Relaxed);
        beat.memory = self.memory.load(Ordering::Relaxed);
        beat.total = self.total.load(Ordering::Relaxed);
        beat.unit.clone_from(&self.unit.lock().unwrap_or_else(PoisonError::into_inner));
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
        // A unit of two words, or one too long, stays one word.
        let odd = Beat { unit: "pictures of all views".to_string(), ..Beat::default() };
        assert_eq!(parse(&line(&odd)).map(|b| b.unit), Some("picturesofallvie".to_string()));
    }
}
