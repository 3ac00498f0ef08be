//! All frames of a film in the order in which they are shown, each with its time.
//!
//! ffmpeg decodes the film and writes RGB frames of 8 bits into a pipe. Stored frames are read, before any
//! turning. Times are seconds from the file's begin, the earliest time of any of its streams, which is the
//! origin of all times in this module. Frames of variable rate come as they are: none is doubled or left out.

use std::io::{BufReader, Read};
use std::path::Path;
use std::process::{ChildStdout, Stdio};

use super::info::FilmInfo;
use super::scan::FilmPackets;
use super::words::{ProgramWords, stamp_filter};
use crate::error::PrepareError;
use crate::film::numbers_kept;
use crate::process::{self, Ended, ProgramEnd, StepWatch};
use crate::tools::{self, Programs};

/// The most pixels of a frame that is read.
const MOST_PIXELS: usize = 1 << 28;

/// A frame of a film.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmFrame {
    /// Its number in the film, from 0, as in the record of a preparation.
    pub number: u64,
    /// Its time, seconds from the file's begin.
    pub seconds: f64,
    /// Its pixels: red, green and blue of each, row by row from the top; `3 × width × height` bytes.
    pub rgb: Vec<u8>,
}

/// Reads the frames of a film, as an iterator. One frame is in memory at a time. After an error it ends.
/// Dropped early, it ends its ffmpeg.
pub struct FilmReader {
    info: FilmInfo,
    packets: FilmPackets,
    child: Ended,
    frames: Option<BufReader<ChildStdout>>,
    words: ProgramWords,
    next: u64,
    last_seconds: f64,
}

impl FilmReader {
    /// Opens a film. The whole file is read once without decoding, so that a film that is cut off is refused
    /// before any work.
    ///
    /// # Errors
    /// A program is missing, the file is no film, or it ends before its stated end.
    pub fn open(programs: &Programs, film: &Path, watch: &StepWatch<'_>) -> Result<Self, PrepareError> {
        let ffmpeg = programs.film()?;
        let mut info = FilmInfo::of(programs, film)?;
        if info.width.saturating_mul(info.height) > MOST_PIXELS {
            let reason =
                format!("its frames of {}x{} pixels are too large to be read", info.width, info.height);
            return Err(PrepareError::input(film, reason));
        }
        let packets = FilmPackets::of(&ffmpeg, &info, watch)?;
        packets.check_whole(&info)?;
        info.constant = packets.constant;
        let filter = format!(
            "{},scale={}:{},{}",
            stamp_filter(&ffmpeg.version),
            info.width,
            info.height,
            info.colours.film_to_rgb(info.height)
        );
        let mut command = tools::command(&ffmpeg.path);
        command.args(["-hide_banner", "-nostats", "-nostdin", "-v", "level+info"]).args(info.input());
        command.args(["-map", &format!("0:{}", info.stream), "-vf", &filter]);
        command.args(numbers_kept(&ffmpeg.version)).args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]);
        let mut child = Ended::spawn(command.stdout(Stdio::piped()).stderr(Stdio::piped()))?;
        let (Some(out), Some(err)) = (child.0.stdout.take(), child.0.stderr.take()) else {
            return Err(PrepareError::input(film, "ffmpeg gave no output; try again"));
        };
        let (frames, words) = (Some(BufReader::with_capacity(1 << 20, out)), ProgramWords::of(err));
        Ok(Self { info, packets, child, frames, words, next: 0, last_seconds: 0.0 })
    }

    /// The properties of the film. Its `constant` is measured on the time stamps.
    pub fn info(&self) -> &FilmInfo {
        &self.info
    }

    /// About the number of frames, for progress. Frames that a player skips are counted, too.
    pub fn frames(&self) -> u64 {
        self.packets.frames
    }

    /// The number of errors in the film that ffmpeg has met and repaired so far. Frames can look damaged.
    pub fn damages(&mut self) -> u64 {
        self.words.listen();
        self.words.errors()
    }

    /// Reads the next frame, or finds the end.
    fn read(&mut self) -> Result<Option<FilmFrame>, PrepareError> {
        let Some(frames) = &mut self.frames else { return Ok(None) };
        let number = self.next;
        let mut rgb = vec![0; 3 * self.info.width * self.info.height];
        let mut filled = 0;
        while filled < rgb.len() {
            match frames.read(&mut rgb[filled..]) {
                Ok(0) => break,
                Ok(n) => filled += n,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(PrepareError::read(&self.info.path)(e)),
            }
        }
        if filled == 0 {
            return self.end().map(|()| None);
        }
        let stamp = (filled == rgb.len()).then(|| self.words.stamp()).flatten();
        let Some(stamp) = stamp else {
            let reason = format!("ffmpeg broke off after {number} frames; {}", self.reason()?);
            return Err(PrepareError::input(&self.info.path, reason));
        };
        // Raw streams have no time stamps.
        let seconds = stamp.unwrap_or_else(|| number as f64 / self.info.rate.value());
        self.next += 1;
        self.last_seconds = self.last_seconds.max(seconds);
        Ok(Some(FilmFrame { number, seconds, rgb }))
    }

    /// The end of ffmpeg in words.
    fn reason(&mut self) -> Result<String, PrepareError> {
        self.frames = None;
        let last = self.words.last();
        let status = self.child.0.wait().map_err(PrepareError::read(&self.info.path))?;
        Ok(process::reason(&ProgramEnd { status, last }))
    }

    /// Checks that the whole film was read.
    fn end(&mut self) -> Result<(), PrepareError> {
        let reason = self.reason()?;
        let status = self.child.0.wait().map_err(PrepareError::read(&self.info.path))?;
        let bad = |reason: String| Err(PrepareError::input(&self.info.path, reason));
        if self.next == 0 {
            return bad(format!("ffmpeg can read no frame of this film: {reason}"));
        }
        // A film with damaged frames can end with an error code, but not by a signal.
        if status.code().is_none() {
            return bad(format!("ffmpeg broke off after {} frames; {reason}", self.next));
        }
        self.packets.check_read(&self.info, self.last_seconds)
    }
}

impl Iterator for FilmReader {
    type Item = Result<FilmFrame, PrepareError>;

    fn next(&mut self) -> Option<Self::Item> {
        let read = self.read();
        if !matches!(read, Ok(Some(_))) {
            self.frames = None;
        }
        read.transpose()
    }
}
