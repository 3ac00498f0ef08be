//! The words of an ffmpeg that reads or writes a film: time stamps of frames, and errors.
//!
//! The filter `showinfo` writes a line for every frame, before the frame itself leaves ffmpeg:
//! `[Parsed_showinfo_0 @ 0x55] [info] n:   7 pts:   3584 pts_time:0.2333 …`. A line before the first frame
//! has the unit, `config in time_base: 1/15360`. With `-v level+info`, errors have the mark `[error]`.

use std::collections::VecDeque;
use std::io::Read;
use std::sync::mpsc::{Receiver, TryRecvError, channel};

use super::info::Fraction;
use crate::process;

/// The filter that names the time stamp of each frame. Older versions cannot leave out the checksums.
pub(super) fn stamp_filter(version: &str) -> &'static str {
    match crate::film::numbers(version).0 {
        Some(0..=4) => "showinfo",
        _ => "showinfo=checksum=0",
    }
}

/// The number of errors that are kept.
const KEPT: usize = 12;

/// The words of one program.
pub(super) struct ProgramWords {
    lines: Receiver<(String, bool)>,
    time_base: Option<Fraction>,
    errors: VecDeque<String>,
    count: u64,
}

/// A line.
#[derive(Debug, PartialEq)]
enum Word {
    /// The unit of the time stamps.
    Unit(Fraction),
    /// The time stamp of a frame, if it has one.
    Stamp(Option<i64>),
    /// An error.
    Error(String),
    Other,
}

/// The meaning of a line.
fn word(line: &str) -> Word {
    if line.contains("Parsed_showinfo_") {
        let unit = |rest: &str| Fraction::parse(rest.split([',', ' ']).find(|t| !t.is_empty())?);
        if let Some(unit) = line.split_once("config in time_base:").and_then(|(_, rest)| unit(rest)) {
            return Word::Unit(unit);
        }
        return match line.split_once(" pts:") {
            Some((head, rest)) if head.contains("] n:") => {
                Word::Stamp(rest.split_whitespace().next().and_then(|t| t.parse().ok()))
            }
            _ => Word::Other,
        };
    }
    match ["[error] ", "[fatal] ", "[panic] "].iter().find_map(|mark| line.split_once(mark)) {
        Some((_, error)) if !error.trim().is_empty() => Word::Error(error.trim().to_string()),
        _ => Word::Other,
    }
}

impl ProgramWords {
    /// Listens to a program's words in a thread of its own.
    pub(super) fn of(stream: impl Read + Send + 'static) -> Self {
        let (sender, lines) = channel();
        process::forward(stream, sender);
        Self { lines, time_base: None, errors: VecDeque::new(), count: 0 }
    }

    /// Takes a line; the time stamp if it has one, seconds.
    fn take(&mut self, line: &str) -> Option<Option<f64>> {
        match word(line) {
            Word::Unit(unit) => self.time_base = Some(unit),
            Word::Stamp(pts) => {
                let unit = self.time_base.filter(|_| pts.is_some());
                return Some(unit.zip(pts).map(|(u, p)| p as f64 * f64::from(u.over) / f64::from(u.under)));
            }
            Word::Error(error) => {
                self.count += 1;
                self.errors.push_back(error);
                if self.errors.len() > KEPT {
                    self.errors.pop_front();
                }
            }
            Word::Other => {}
        }
        None
    }

    /// Waits for the time stamp of the next frame, seconds; `Some(None)` for a frame without one, `None` if
    /// the program said its last word.
    pub(super) fn stamp(&mut self) -> Option<Option<f64>> {
        loop {
            let (line, _) = self.lines.recv().ok()?;
            if let Some(stamp) = self.take(&line) {
                return Some(stamp);
            }
        }
    }

    /// Takes the lines that have come.
    pub(super) fn listen(&mut self) {
        loop {
            match self.lines.try_recv() {
                Ok((line, _)) => drop(self.take(&line)),
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return,
            }
        }
    }

    /// Takes the lines until the program has said its last word, and returns the last errors.
    pub(super) fn last(&mut self) -> Vec<String> {
        while self.stamp().is_some() {}
        self.errors.iter().cloned().collect()
    }

    /// The number of errors so far.
    pub(super) fn errors(&self) -> u64 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_stamps_and_errors_are_found_among_other_words() {
        let text = "[info] Input #0, mov, from 'pts: 3.mp4':\n\
            [Parsed_showinfo_0 @ 0x5] [info] config in time_base: 1/15360, frame_rate: 30/1\n\
            [Parsed_showinfo_0 @ 0x5] [info] config out time_base: 0/0, frame_rate: 0/0\n\
            frame= 1 speed=2x    \r[Parsed_showinfo_0 @ 0x5] [info] n:   0 pts:   -512 pts_time:-0.0333 pos: 48\n\
            [Parsed_showinfo_0 @ 0x5] [info] color_range:unknown\n\
            [h264 @ 0x7] [error] error while decoding MB 3 7\n\
            [Parsed_showinfo_0 @ 0x5] [info] n:   1 pts: NOPTS pts_time:NOPTS pos: 99\n\
            [h264 @ 0x7] [error] \n[fatal] the end\n";
        let mut words = ProgramWords::of(text.as_bytes());
        assert_eq!(words.stamp(), Some(Some(-512.0 / 15360.0)));
        assert_eq!(words.stamp(), Some(None));
        assert_eq!(words.stamp(), None);
        assert_eq!(words.last(), ["error while decoding MB 3 7", "the end"]);
        assert_eq!(words.errors(), 2);
    }
}
