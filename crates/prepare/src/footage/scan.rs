//! A film's packets: their times show if the film is whole, how many frames it has, and if its rate is
//! constant.
//!
//! Nothing is decoded. ffmpeg's muxer `framecrc` writes a line for each packet, `stream, dts, pts, duration,
//! size, checksum`, and one for the unit of each stream, `#tb 0: 1/15360`.

use std::io::{BufRead, BufReader, Read};
use std::process::Stdio;

use super::info::{FilmInfo, Fraction};
use super::words::{ProgramWords, stamp_filter};
use crate::error::PrepareError;
use crate::film::numbers_kept;
use crate::process::{self, Ended, ProgramEnd, StepWatch};
use crate::tools::{self, Program};

/// A film that ends this much before its stated end is cut off, seconds. Files round the ends of streams.
const MISSING: f64 = 0.5;
/// A film that ends this many frames before its stated end is cut off.
const MISSING_FRAMES: f64 = 3.0;

/// The packets of a film.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FilmPackets {
    /// About the number of its frames. Frames that a player skips can be among them.
    pub(super) frames: u64,
    /// True if all frames have the same distance in time, up to the unit of time stamps.
    pub(super) constant: bool,
    /// The end of the film, seconds.
    pub(super) end: f64,
    /// The end of everything in the file, seconds.
    file_end: f64,
    /// The mean distance of two frames, seconds.
    spacing: f64,
}

/// The packets in the words of `framecrc`; the first stream is the film.
fn understand(
    lines: impl Iterator<Item = String>,
    watch: &StepWatch<'_>,
) -> Result<FilmPackets, PrepareError> {
    let mut units: Vec<f64> = Vec::new();
    let (mut times, mut end, mut file_end) = (Vec::new(), 0.0f64, 0.0f64);
    for line in lines {
        if let Some((stream, unit)) = line.strip_prefix("#tb ").and_then(|rest| rest.split_once(':')) {
            let (Ok(stream), Some(unit)) = (stream.trim().parse::<usize>(), Fraction::parse(unit)) else {
                continue;
            };
            units.resize(units.len().max(stream.saturating_add(1).min(1 << 10)), 0.0);
            if let Some(slot) = units.get_mut(stream) {
                *slot = unit.value();
            }
            continue;
        }
        let mut fields = line.split(',').map(|f| f.trim().parse::<i64>().ok());
        let mut next = || fields.next().flatten();
        let (Some(stream), _, pts, duration) = (next(), next(), next(), next()) else { continue };
        let (Some(unit), Some(pts)) = (usize::try_from(stream).ok().and_then(|s| units.get(s)), pts) else {
            continue;
        };
        let packet_end = (pts as f64 + duration.unwrap_or(0) as f64) * unit;
        file_end = file_end.max(packet_end);
        if stream == 0 {
            if times.len() % 4096 == 0 {
                watch.check()?;
            }
            times.push(pts);
            end = end.max(packet_end);
        }
    }
    times.sort_unstable();
    let span = times.last().zip(times.first()).map_or(0, |(last, first)| last - first) as f64;
    let steps = times.len().saturating_sub(1).max(1) as f64;
    let mean = span / steps;
    // A rate such as 30000/1001 in milliseconds has steps of 33 and 34.
    let even = |pair: &[i64]| ((pair[1] - pair[0]) as f64 - mean).abs() <= 1.0;
    let constant = times.windows(2).all(even);
    let spacing = mean * units.first().copied().unwrap_or(0.0);
    Ok(FilmPackets { frames: times.len() as u64, constant, end, file_end, spacing })
}

impl FilmPackets {
    /// Reads the packets of a film and of its audio.
    ///
    /// # Errors
    /// The film cannot be read, or the caller stopped the work.
    pub(super) fn of(ffmpeg: &Program, info: &FilmInfo, watch: &StepWatch<'_>) -> Result<Self, PrepareError> {
        let mut command = tools::command(&ffmpeg.path);
        command.args(["-hide_banner", "-nostats", "-nostdin", "-v", "level+error"]).args(info.input());
        command.args(["-map", &format!("0:{}", info.stream), "-map", "0:a?", "-c", "copy"]);
        command.args(["-f", "framecrc", "-"]).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = Ended::spawn(&mut command)?;
        let (Some(out), Some(err)) = (child.0.stdout.take(), child.0.stderr.take()) else {
            return Err(PrepareError::input(&info.path, "ffmpeg gave no output; try again"));
        };
        let mut words = ProgramWords::of(err);
        // A line of framecrc is short; a longer one is cut, so that memory stays small.
        let mut reader = BufReader::new(out);
        let lines = std::iter::from_fn(|| {
            let mut line = Vec::new();
            let read = (&mut reader).take(1 << 16).read_until(b'\n', &mut line);
            read.ok().filter(|n| *n > 0).map(|_| String::from_utf8_lossy(&line).into_owned())
        });
        let found = understand(lines, watch)?;
        let last = words.last();
        let status = child.0.wait().map_err(PrepareError::run(&ffmpeg.path))?;
        if found.frames == 0 || !status.success() && found.end == 0.0 {
            let said = last.last().map_or("no reason was given", String::as_str);
            return Err(PrepareError::input(
                &info.path,
                format!(
                    "ffmpeg finds no frame in this film: {said}; copy it again from the camera, or repair it"
                ),
            ));
        }
        Ok(found)
    }

    /// Refuses a film that ends before its stated end.
    ///
    /// # Errors
    /// The film is cut off.
    pub(super) fn check_whole(&self, info: &FilmInfo) -> Result<(), PrepareError> {
        check_end(info, info.end_seconds, self.end, self.spacing)?;
        check_end(info, info.file_seconds, self.file_end, self.spacing)
    }

    /// Refuses a film whose last frame was read at a time, seconds, that is before the film's end.
    ///
    /// # Errors
    /// Frames at the end cannot be read.
    pub(super) fn check_read(&self, info: &FilmInfo, last: f64) -> Result<(), PrepareError> {
        check_end(info, Some(self.end), last + self.spacing, self.spacing)
    }
}

/// The time of every frame in the order in which they are shown, seconds: the film is decoded, and no frame
/// kept.
///
/// # Errors
/// The film cannot be decoded, or the caller stopped the work.
pub(super) fn decoded_times(
    ffmpeg: &Program,
    info: &FilmInfo,
    watch: &StepWatch<'_>,
) -> Result<Vec<f64>, PrepareError> {
    let mut command = tools::command(&ffmpeg.path);
    command.args(["-hide_banner", "-nostats", "-nostdin", "-v", "level+info"]).args(info.input());
    command.args(["-map", &format!("0:{}", info.stream), "-vf", stamp_filter(&ffmpeg.version)]);
    command.args(numbers_kept(&ffmpeg.version)).args(["-f", "null", "-"]);
    let mut child = Ended::spawn(command.stdout(Stdio::null()).stderr(Stdio::piped()))?;
    let Some(err) = child.0.stderr.take() else {
        return Err(PrepareError::input(&info.path, "ffmpeg gave no output; try again"));
    };
    let (mut words, mut times) = (ProgramWords::of(err), Vec::new());
    let total = info.end_seconds.map_or(0, |end| (end * info.rate.value()).ceil() as u64);
    while let Some(stamp) = words.stamp() {
        watch.check()?;
        times.push(stamp.unwrap_or(times.len() as f64 / info.rate.value()));
        let done = times.len() as u64;
        watch.tell("times", (done, total.max(done)), "frames");
    }
    let status = child.0.wait().map_err(PrepareError::run(&ffmpeg.path))?;
    if times.is_empty() || status.code().is_none() {
        let reason = process::reason(&ProgramEnd { status, last: words.last() });
        return Err(PrepareError::input(
            &info.path,
            format!("ffmpeg can read no frame of this film: {reason}"),
        ));
    }
    Ok(times)
}

fn check_end(info: &FilmInfo, stated: Option<f64>, end: f64, spacing: f64) -> Result<(), PrepareError> {
    let Some(stated) = stated.filter(|s| end < s - MISSING.max(MISSING_FRAMES * spacing)) else {
        return Ok(());
    };
    let reason = format!(
        "this film ends after {end:.1} of {stated:.1} seconds, so the file is cut off or damaged; copy it again from \
         the camera, or keep its readable part: `ffmpeg -i IN -t {end:.1} -c copy OUT.mp4`"
    );
    Err(PrepareError::input(&info.path, reason))
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;

    fn packets(text: &str) -> FilmPackets {
        let stop = AtomicBool::new(false);
        let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
        understand(text.lines().map(String::from), &watch).unwrap()
    }

    #[test]
    fn packets_in_any_order_give_frames_rate_and_ends() {
        let found = packets(
            "#software: x\n#tb 0: 1/1000\n#tb 1: 1/44100\n0, -33, 0, 33, 9, 0x1\n1, 0, 0, 44100, 5, 0x2\n\
             0, 0, 67, 33, 9, 0x3\n0, 33, 33, 34, 9, 0x4\nnothing\n9, 1, 1, 1\n0, 1, NOPTS, 3\n",
        );
        assert_eq!((found.frames, found.constant, found.end, found.file_end), (3, true, 0.1, 1.0));
        assert!(!packets("#tb 0: 1/1000\n0,0,0,33\n0,33,33,33\n0,99,99,33\n").constant);
        assert_eq!(packets("").frames, 0);
    }
}
