//! Writes the frames of a film again, with its times, audio, metadata, turn and colours.
//!
//! ffmpeg takes the frames from a pipe, as Matroska with time stamps in nanoseconds, and writes them in the
//! unit of the source. So constant and variable rates are kept the same way. Audio streams are copied. The
//! file has a temporary name until it is complete. If this process or ffmpeg ends early, the target stays as
//! it was.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, Command, Stdio};

use super::encoder::FilmEncoder;
use super::info::{FilmInfo, Fraction};
use super::words::ProgramWords;
use super::{matroska, mp4};
use crate::error::PrepareError;
use crate::film::numbers_kept;
use crate::process::{self, Ended, ProgramEnd};
use crate::tools::{self, Program, Programs};

/// Endings of the files that are written. All but the last can hold a display matrix.
const ENDINGS: [&str; 4] = ["mp4", "mov", "m4v", "mkv"];

/// The choices of a written film.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FilmChoices {
    /// True to replace a file at the target.
    pub replace: bool,
    /// The constant rate factor of libx264 or libx265, 0 to 51; smaller is better and larger. 17 and 19 are
    /// usual.
    pub quality: Option<u8>,
}

/// A film that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FilmWritten {
    /// The file.
    pub path: PathBuf,
    /// The number of its frames.
    pub frames: u64,
    /// The name of the encoder.
    pub encoder: &'static str,
}

/// The running ffmpeg.
struct Running {
    child: Ended,
    pipe: BufWriter<ChildStdin>,
    words: ProgramWords,
    /// The time of the first frame, seconds.
    first: f64,
}

/// Writes a film. Dropped before [`finish`](Self::finish), it leaves no file.
pub struct FilmWriter {
    source: FilmInfo,
    target: PathBuf,
    choices: FilmChoices,
    ffmpeg: Program,
    encoder: FilmEncoder,
    /// It starts with the first frame, whose time is one of its arguments. Dropped before its file, it ends.
    running: Option<Running>,
    temporary: Temporary,
    padded: Vec<u8>,
    frames: u64,
    last: u64,
}

/// An unfinished file, which is removed when it is dropped.
struct Temporary {
    path: PathBuf,
    _making: use3d_files::Making,
}

impl Drop for Temporary {
    fn drop(&mut self) {
        // The finished file has its own name by now.
        let _ = std::fs::remove_file(&self.path);
    }
}

fn ending(target: &Path) -> Option<&'static str> {
    let own = target.extension()?.to_str()?;
    ENDINGS.into_iter().find(|ending| own.eq_ignore_ascii_case(ending))
}

impl FilmWriter {
    /// Prepares to write a film with the times, audio, metadata, turn and colour tags of `source`.
    ///
    /// # Errors
    /// The target is taken or not a usable name, cannot be written, cannot hold the source's turn, or a
    /// program is missing.
    pub fn create(
        programs: &Programs,
        source: &FilmInfo,
        target: &Path,
        choices: FilmChoices,
    ) -> Result<Self, PrepareError> {
        let Some(ending) = ending(target) else {
            let reason = "expected a name that ends in .mp4, .mov, .m4v or .mkv";
            return Err(PrepareError::input(target, reason));
        };
        let same = || Some(target.canonicalize().ok()? == source.path.canonicalize().ok()?);
        if same() == Some(true) {
            return Err(PrepareError::input(target, "this is the film itself; choose another name"));
        }
        check_free(target, choices)?;
        if source.display_matrix.is_some() && ending == "mkv" {
            let reason = "a player turns this film, and Matroska files do not keep that; choose a name that ends in \
                 .mp4 or .mov";
            return Err(PrepareError::input(target, reason));
        }
        if let Some(quality) = choices.quality.filter(|q| *q > 51) {
            let reason = format!("the quality {quality} is out of range; expected 0 (best) to 51");
            return Err(PrepareError::input(target, reason));
        }
        let ffmpeg = programs.film()?;
        let encoder = FilmEncoder::of(&ffmpeg)?;
        let folder = use3d_files::folder_of(target);
        std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
        use3d_files::sweep(folder, use3d_files::BEING_MADE, |path| {
            path.is_file() && self::ending(path).is_some()
        });
        let made = use3d_files::create_beside(target, use3d_files::BEING_MADE, &format!(".{ending}"));
        let (path, _) = made.map_err(PrepareError::write(target))?;
        let temporary = Temporary { _making: use3d_files::Making::new(&path), path };
        Ok(Self {
            source: source.clone(),
            target: target.to_path_buf(),
            choices,
            ffmpeg,
            encoder,
            temporary,
            running: None,
            padded: Vec::new(),
            frames: 0,
            last: 0,
        })
    }

    /// Remarks on the written film for the user: an unusual encoder, a size that grows.
    pub fn remarks(&self) -> Vec<String> {
        let grown = (self.size() != (self.source.width, self.source.height)).then(|| {
            let (w, h) = self.size();
            format!(
                "the film is written with {w}x{h} pixels, since its encoder needs even sides; the last row or column is \
                 doubled"
            )
        });
        self.encoder.remark().into_iter().chain(grown).collect()
    }

    /// The written size: even sides, because colours have half the resolution.
    fn size(&self) -> (usize, usize) {
        (self.source.width.next_multiple_of(2), self.source.height.next_multiple_of(2))
    }

    /// The command that encodes a film whose first frame is at a time, seconds.
    fn command(&self, first: f64) -> Command {
        let source = &self.source;
        let mut command = tools::command(&self.ffmpeg.path);
        command.args(["-hide_banner", "-nostats", "-nostdin", "-v", "level+error", "-y"]);
        // Raw frames are large, so none is read ahead to guess properties that the head states.
        command.args(["-probesize", "32", "-analyzeduration", "0", "-fpsprobesize", "0"]);
        command.args(["-itsoffset", &format!("{first:.6}"), "-f", "matroska", "-i", "pipe:0"]);
        let [_, input, path] = source.input();
        command.arg(input).arg(path).args(["-map", "0:v:0", "-map", "1:a?", "-c:a", "copy"]);
        command.args(["-map_metadata", "1", "-map_chapters", "1"]);
        command.args(["-map_metadata:s:v:0", &format!("1:s:{}", source.stream)]);
        // Older versions have the turn as a tag, too; the matrix of the finished file is the only one.
        command.args(["-metadata:s:v:0", "rotate="]);
        let tags = source.colours.written(source.height);
        let mut filter = tags.rgb_to_film(source.height, "yuv420p");
        if let Some(Fraction { over, under }) = source.pixel_aspect {
            filter.push_str(&format!(",setsar={over}/{under}"));
        }
        command
            .args(["-vf", &filter])
            .args(self.encoder.arguments(self.choices.quality))
            .args(tags.arguments());
        command.args(numbers_kept(&self.ffmpeg.version));
        let Fraction { over, under } = self.encoder.time_base(source.time_base);
        command.args(["-enc_time_base", &format!("{over}:{under}")]);
        if over == 1 && ending(&self.target) != Some("mkv") {
            command.args(["-video_track_timescale", &under.to_string()]);
        }
        command.arg(&self.temporary.path);
        command
    }

    fn start(&self, first: f64) -> Result<Running, PrepareError> {
        let mut command = self.command(first);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let child = command.spawn().map_err(PrepareError::run(&self.ffmpeg.path))?;
        let mut child = Ended(child);
        let (Some(pipe), Some(words)) = (child.0.stdin.take(), child.0.stderr.take()) else {
            return Err(PrepareError::input(&self.target, "ffmpeg took no input; try again"));
        };
        let mut pipe = BufWriter::with_capacity(1 << 16, pipe);
        let distance = (1e9 / self.source.rate.value()).round() as u64;
        // An ffmpeg that has ended already says why when the first frame is written.
        let _ = matroska::write_head(&mut pipe, self.size(), distance);
        Ok(Running { child, pipe, words: ProgramWords::of(words), first })
    }

    /// Writes the next frame: red, green and blue of each pixel, row by row from the top, as they are stored
    /// in the source; and its time in the source, seconds. Times rise from frame to frame.
    ///
    /// # Errors
    /// The frame has another size, its time does not rise, or ffmpeg ends: for example a full disk, or audio
    /// that the target cannot hold.
    pub fn write(&mut self, rgb: &[u8], seconds: f64) -> Result<(), PrepareError> {
        let (width, height) = (self.source.width, self.source.height);
        let bad = |reason: String| Err(PrepareError::input(&self.target, reason));
        if rgb.len() != 3 * width * height {
            return bad(format!(
                "frame {} has {} bytes; expected {} for {width}x{height} pixels",
                self.frames,
                rgb.len(),
                3 * width * height
            ));
        }
        if !seconds.is_finite() {
            return bad(format!("the time of frame {} is {seconds}; expected seconds", self.frames));
        }
        if self.running.is_none() {
            self.running = Some(self.start(seconds)?);
        }
        let odd = self.size() != (width, height);
        if odd {
            pad(rgb, (width, height), &mut self.padded);
        }
        let Some(running) = &mut self.running else { return Ok(()) };
        let nanoseconds = ((seconds - running.first) * 1e9).round();
        if nanoseconds < 0.0 || self.frames > 0 && nanoseconds <= self.last as f64 {
            let reason =
                format!("frame {} is shown at {seconds} s, and the frame before it not earlier", self.frames);
            return bad(reason);
        }
        let frame = if odd { &self.padded[..] } else { rgb };
        let written = matroska::write_frame(&mut running.pipe, nanoseconds as u64, frame);
        running.words.listen();
        if written.is_err() {
            return Err(self.broken());
        }
        self.last = nanoseconds as u64;
        self.frames += 1;
        Ok(())
    }

    /// The error of an ffmpeg that ended early or without success.
    fn broken(&mut self) -> PrepareError {
        let Some(Running { mut child, pipe, mut words, .. }) = self.running.take() else {
            return PrepareError::input(&self.target, "no frame was written; expected at least one");
        };
        // Dropping the writer would write the rest into the closed pipe again.
        let _ = pipe.into_parts();
        let last = words.last();
        let status = match child.0.wait() {
            Ok(status) => status,
            Err(e) => return PrepareError::run(&self.ffmpeg.path)(e),
        };
        let mut reason =
            format!("ffmpeg cannot write this film: {}", process::reason(&ProgramEnd { status, last }));
        if !self.source.audio.is_empty() && self.frames < 2 {
            reason.push_str(&format!(
                "\nif it is about the audio ({}), choose a name that ends in .mov or .mkv",
                self.source.audio.join(", ")
            ));
        }
        PrepareError::input(&self.target, reason)
    }

    /// Completes the film and gives it its name.
    ///
    /// # Errors
    /// No frame was written, ffmpeg fails, or the target cannot be written.
    pub fn finish(mut self) -> Result<FilmWritten, PrepareError> {
        let flushed = self.running.as_mut().map(|running| running.pipe.flush());
        if !matches!(flushed, Some(Ok(()))) {
            return Err(self.broken());
        }
        let Some(Running { mut child, pipe, mut words, .. }) = self.running.take() else {
            return Err(self.broken());
        };
        // With its pipe closed, ffmpeg completes the film.
        drop(pipe);
        let last = words.last();
        let status = child.0.wait().map_err(PrepareError::run(&self.ffmpeg.path))?;
        if !status.success() {
            let reason = process::reason(&ProgramEnd { status, last });
            return Err(PrepareError::input(
                &self.target,
                format!("ffmpeg cannot complete this film: {reason}"),
            ));
        }
        let failed = PrepareError::write(&self.target);
        if let Some(matrix) = &self.source.display_matrix {
            mp4::write_matrix(&self.temporary.path, matrix).map_err(&failed)?;
        }
        check_free(&self.target, self.choices)?;
        std::fs::rename(&self.temporary.path, &self.target).map_err(failed)?;
        let (path, frames, encoder) = (self.target.clone(), self.frames, self.encoder.name);
        Ok(FilmWritten { path, frames, encoder })
    }
}

/// Refuses a target that is taken.
fn check_free(target: &Path, choices: FilmChoices) -> Result<(), PrepareError> {
    if target.is_dir() {
        return Err(PrepareError::input(target, "this is a folder; expected the name of a film"));
    }
    if !choices.replace && target.symlink_metadata().is_ok() {
        let reason =
            "there is a file of this name already; choose another name, or pass --force to replace it";
        return Err(PrepareError::input(target, reason));
    }
    Ok(())
}

/// Repeats the last column and the last row of an odd frame.
fn pad(rgb: &[u8], (width, height): (usize, usize), padded: &mut Vec<u8>) {
    padded.clear();
    let rows = (0..height.next_multiple_of(2)).map(|y| y.min(height - 1));
    for row in rows.map(|y| &rgb[3 * width * y..3 * width * (y + 1)]) {
        padded.extend_from_slice(row);
        if width % 2 == 1 {
            padded.extend_from_slice(&row[3 * (width - 1)..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_frames_repeat_their_last_row_and_column() {
        let pixels: Vec<u8> = (0..9u8).flat_map(|i| [i, i, i]).collect();
        let mut padded = Vec::new();
        pad(&pixels, (3, 3), &mut padded);
        let first: Vec<u8> = padded.iter().step_by(3).copied().collect();
        assert_eq!(first, [0, 1, 2, 2, 3, 4, 5, 5, 6, 7, 8, 8, 6, 7, 8, 8]);
    }

    #[test]
    fn endings_are_known_in_any_case() {
        assert_eq!(ending(Path::new("a/b.MP4")), Some("mp4"));
        assert_eq!(ending(Path::new("a/b.avi")), None);
        assert_eq!(ending(Path::new("mp4")), None);
    }
}
