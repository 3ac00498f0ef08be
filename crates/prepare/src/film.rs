//! Takes frames out of a film with `ffmpeg`: one pass looks at small grey frames, and a second one writes the
//! chosen frames at full size.
//!
//! Frames become JPEGs of high quality. JPEG has the colours of BT.601 in full range, so the film's own
//! colours are converted to these.

use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use use3d_capture::Image8;
use use3d_overlay::{Bars, Overlay, Still, find};

use crate::choose::{Frame, FrameChoice, choose};
use crate::error::PrepareError;
use crate::left_out::{LeftCause, left_out};
use crate::probe::{Film, probe};
use crate::process::{self, Ended, ProgramEnd, StepWatch};
use crate::tools::{self, Program};
use crate::work;

/// Width of the grey frames, pixels.
const WIDTH: usize = 480;
/// About how many frames of one second are looked at.
const RATE: f64 = 10.0;
/// The most grey frames in which an overlay is looked for.
const LOOKED: usize = 64;
/// The largest side of a grey frame that is accepted from ffmpeg, pixels.
const MAX_SIDE: usize = 1 << 13;
/// The most terms of one sum in a filter. Sums of many thousand terms exceed a limit of ffmpeg.
const SUM: usize = 16;
/// The file with the filter, in the folder of the work.
const FILTER: &str = "filter.txt";
/// The file with the time stamps of the written frames, in their folder while they are written.
const STAMPS: &str = "stamps.txt";

/// A chosen frame.
#[derive(Clone, Debug)]
pub(crate) struct Chosen {
    /// Its number in the film, from 0.
    pub(crate) number: u64,
    /// Its sharpness, on small grey frames.
    pub(crate) sharpness: f32,
    /// Its time in the film, seconds from the file's begin. Until the frame is written, it is computed from
    /// its number and the mean rate.
    pub(crate) seconds: f64,
    /// True if the time is the frame's own time stamp.
    pub(crate) stamped: bool,
}

/// The frames of one film.
pub(crate) struct Choice {
    pub(crate) film: Film,
    pub(crate) frames: Vec<Chosen>,
    pub(crate) looked_at: usize,
    /// Frames that are neither black nor white.
    pub(crate) usable: usize,
    /// The overlap of neighbours at least; 0 if the limit of frames is too small for the film.
    pub(crate) overlap: f64,
    /// True if all frames show the same place.
    pub(crate) stands: bool,
    /// The overlay of all frames.
    pub(crate) overlay: Option<Overlay>,
    /// Some of the other frames: number, cause and small picture.
    pub(crate) left_out: Vec<(u64, LeftCause, Image8)>,
}

impl Choice {
    /// The reason why a film gives hardly any frame, with a next step.
    pub(crate) fn why_few(&self) -> String {
        let (all, usable) = (self.looked_at, self.usable);
        if 2 * usable < all {
            let which = format!("{} of {all} frames that were looked at are black or white", all - usable);
            return format!("{which}; film with more light, or cut the film to its good part");
        }
        if self.stands {
            return "the camera does not move: all frames show the same place, and distances cannot be found; swim \
                sideways along the scene while filming"
                .into();
        }
        format!("the film is short: {all} frames were looked at; film for 20 seconds or more")
    }

    /// The filter of ffmpeg that cuts the bars off, with a comma; empty without bars.
    fn crop(&self) -> String {
        let Some(overlay) = self.overlay.as_ref().filter(|overlay| !overlay.bars.is_none()) else {
            return String::new();
        };
        let Bars { left, top, right, bottom } = overlay.bars;
        // The edge of a bar may lie within a pixel of the grey frames.
        let wider = |bar: usize| if bar > 0 { bar + 1 } else { 0 };
        let even = |side: &str, bar: usize, of: usize| format!("2*ceil({side}*{bar}/{of}/2)");
        let (w, h) = (overlay.width, overlay.height);
        let [left, right] = [left, right].map(|bar| even("iw", wider(bar), w));
        let [top, bottom] = [top, bottom].map(|bar| even("ih", wider(bar), h));
        format!("crop=w=iw-{left}-{right}:h=ih-{top}-{bottom}:x={left}:y={top},")
    }
}

/// The first two numbers of a version such as `5.1.8-0+deb12u1` or `n7.1`.
pub(crate) fn numbers(version: &str) -> (Option<u32>, Option<u32>) {
    let mut parts = version.trim_start_matches('n').split(['.', '-']).map(|p| p.parse().ok());
    (parts.next().flatten(), parts.next().flatten())
}

/// The argument that keeps every frame's number: ffmpeg 5.1 renamed it.
pub(crate) fn numbers_kept(version: &str) -> [&'static str; 2] {
    match numbers(version) {
        (Some(0..=4), _) | (Some(5), Some(0)) => ["-vsync", "0"],
        _ => ["-fps_mode", "passthrough"],
    }
}

/// The argument that reads the filter from a file: ffmpeg 7.1 renamed it, and 9.0 removed the older name.
fn filter_from_file(version: &str) -> &'static str {
    match numbers(version).0 {
        Some(0..=7) => "-filter_script:v",
        _ => "-/filter:v",
    }
}

/// An expression of ffmpeg that is 1 for the frames of these sorted numbers, and else 0. It is a binary
/// search, so that its depth and the time for a frame stay small.
fn expression(numbers: &[u64]) -> String {
    if numbers.len() <= SUM {
        let terms: Vec<String> = numbers.iter().map(|number| format!("eq(n\\,{number})")).collect();
        return terms.join("+");
    }
    let (low, high) = numbers.split_at(numbers.len() / 2);
    format!("if(lt(n\\,{})\\,{}\\,{})", high[0], expression(low), expression(high))
}

/// Reads exactly one line, at most 256 bytes, without its end; `None` at the end of the stream.
fn line(reader: &mut impl Read) -> std::io::Result<Option<String>> {
    let mut bytes = Vec::new();
    let mut byte = [0];
    while reader.read(&mut byte)? == 1 {
        if byte[0] == b'\n' {
            return Ok(Some(String::from_utf8_lossy(&bytes).into_owned()));
        }
        bytes.push(byte[0]);
        if bytes.len() > 256 {
            return Err(std::io::Error::other("ffmpeg wrote no Y4M frames"));
        }
    }
    Ok(None)
}

/// The size in the header of a Y4M stream.
fn y4m_size(header: &str) -> Option<(usize, usize)> {
    let field = |letter: char| header.split(' ').skip(1).find_map(|f| f.strip_prefix(letter)?.parse().ok());
    let size: (usize, usize) = (field('W')?, field('H')?);
    let sides = [size.0, size.1].iter().all(|side| (1..=MAX_SIDE).contains(side));
    (header.starts_with("YUV4MPEG2 ") && sides).then_some(size)
}

/// Looks at a film's frames, and chooses some.
pub(crate) fn look(
    ffmpeg: &Program,
    path: &Path,
    (most, wanted): (usize, Option<f64>),
    log: &Path,
    watch: &StepWatch<'_>,
) -> Result<Choice, PrepareError> {
    let absolute = std::path::absolute(path).map_err(PrepareError::read(path))?;
    let film = probe(ffmpeg, &absolute)?;
    let usual = (film.rate / RATE).round().max(1.0) as u64;
    let mut looked = look_at(ffmpeg, &film, usual, log, watch)?;
    let overlay = find(&looked.pictures);
    let mut found = choose(&looked.frames, most, wanted, overlay.as_ref());
    // Where the camera is fast, neighbours of the frames that were looked at overlap too little.
    let fast = usual > 1 && 2 * found.frames.len() > looked.frames.len() && found.frames.len() < most;
    if fast {
        looked = look_at(ffmpeg, &film, 1, log, watch)?;
        found = choose(&looked.frames, most, wanted, overlay.as_ref());
    }
    let left_out = left_out(&looked.frames, &found);
    let FrameChoice { frames: chosen, overlap, usable, stands } = found;
    let looked_at = looked.frames.len();
    let frame = |i: usize| {
        let Frame { number, sharpness, .. } = looked.frames[i];
        Chosen { number, sharpness, seconds: number as f64 / film.rate, stamped: false }
    };
    let frames = chosen.into_iter().map(frame).collect();
    Ok(Choice { film, frames, looked_at, usable, overlap, stands, overlay, left_out })
}

/// Looks at every frame of a film whose number is a multiple of `step`.
fn look_at(
    ffmpeg: &Program,
    film: &Film,
    step: u64,
    log: &Path,
    watch: &StepWatch<'_>,
) -> Result<Looked, PrepareError> {
    let before = film.before();
    let filter = format!("{before}select=not(mod(n\\,{step})),scale=w=min({WIDTH}\\,iw):h=-2,format=gray");
    let mut command = tools::command(&ffmpeg.path);
    command.args(["-v", "error", "-nostdin", "-i"]).arg(&film.path).args(film.only()).args(["-vf", &filter]);
    command.args(numbers_kept(&ffmpeg.version)).args(["-strict", "-1", "-f", "yuv4mpegpipe", "-"]);
    let total = film.seconds.map(|s| s * film.rate);
    grey_frames(&mut command, log, watch, step, total).map_err(|e| match e {
        PrepareError::Step { reason, .. } => PrepareError::input(&film.path, reason),
        other => other,
    })
}

/// The frames of a film that were looked at.
#[derive(Default)]
struct Looked {
    frames: Vec<Frame>,
    /// Some of them as grey pictures, evenly spread.
    pictures: Vec<Still>,
    /// Every so many frames one is kept as a picture.
    every: usize,
}

impl Looked {
    fn add(&mut self, number: u64, (width, height): (usize, usize), grey: &[u8]) {
        if self.pictures.len() == LOOKED {
            // Every second one stays, and half as many are kept from now on.
            self.every *= 2;
            let mut keep = false;
            self.pictures.retain(|_| {
                keep = !keep;
                keep
            });
        }
        if self.frames.len().is_multiple_of(self.every.max(1)) {
            self.pictures.push(Still { width, height, values: grey.to_vec() });
        }
        self.frames.push(Frame::new(number, width, height, grey));
    }
}

fn grey_frames(
    command: &mut Command,
    log: &Path,
    watch: &StepWatch<'_>,
    step: u64,
    total: Option<f64>,
) -> Result<Looked, PrepareError> {
    let file = process::open_log(log, command)?;
    let mut child = Ended::spawn(command.stdout(Stdio::piped()).stderr(file))?;
    let mut looked = Looked { every: 1, ..Looked::default() };
    let Some(out) = child.0.stdout.take() else { return Ok(looked) };
    let mut reader = BufReader::with_capacity(1 << 20, out);
    let failed = |reason: String| PrepareError::Step { step: "frames", reason, log: log.to_path_buf() };
    let broken = |e: std::io::Error| failed(e.to_string());
    let total = total.map_or(0, |frames| (frames / step as f64).ceil() as u64);
    if let Some(header) = line(&mut reader).map_err(broken)? {
        let (width, height) = y4m_size(&header).ok_or_else(|| failed("ffmpeg wrote no Y4M frames".into()))?;
        let mut grey = vec![0; width * height];
        while let Some(head) = line(&mut reader).map_err(broken)? {
            // Of a film that was cut off, ffmpeg writes the frames that it can read, and each of them whole.
            let whole = head.starts_with("FRAME") && reader.read_exact(&mut grey).is_ok();
            if !whole {
                let so_far = looked.frames.len();
                return Err(failed(format!("ffmpeg's stream broke off after {so_far} frames; try again")));
            }
            looked.add(looked.frames.len() as u64 * step, (width, height), &grey);
            watch.check()?;
            let done = looked.frames.len() as u64;
            watch.tell("frames", (done, total.max(done)), "frames looked at");
        }
    }
    // With its stream closed, a program that still writes ends.
    drop(reader);
    let status = child.0.wait().map_err(PrepareError::run(Path::new(command.get_program())))?;
    if status.code().is_none() {
        return Err(failed(process::reason(&ProgramEnd { status, last: Vec::new() })));
    }
    if looked.frames.is_empty() {
        return Err(failed(format!("ffmpeg can read no frame of it; its words are in {}", log.display())));
    }
    Ok(looked)
}

/// The time stamps in the words of ffmpeg's filter `metadata`: `frame:0 pts:80000 pts_time:0.08` for each
/// frame, and other lines. The unit of `pts` is a microsecond.
fn stamps(text: &str) -> Vec<Option<f64>> {
    let lines = text.lines().filter(|l| l.starts_with("frame:"));
    let pts = |line: &str| -> Option<f64> {
        let stamp: i64 = line.split_whitespace().find_map(|word| word.strip_prefix("pts:"))?.parse().ok()?;
        Some(stamp as f64 / 1e6)
    };
    lines.map(pts).collect()
}

/// Writes the chosen frames as `names`, which has a path for each, and gives them their time stamps.
pub(crate) fn write(
    ffmpeg: &Program,
    choice: &mut Choice,
    (folder, names): (&Path, &[PathBuf]),
    log: &Path,
    watch: &StepWatch<'_>,
) -> Result<(), PrepareError> {
    let crop = choice.crop();
    let Choice { film, frames, .. } = choice;
    if frames.is_empty() {
        return Ok(());
    }
    let wanted: Vec<u64> = frames.iter().map(|f| f.number).collect();
    let matrix = film.matrix.map_or_else(String::new, |m| format!("in_color_matrix={m}:"));
    let before = film.before();
    let filter = format!(
        "{before}select={},settb=AVTB,metadata=add:key=use3d:value=1,metadata=print:file={STAMPS},{crop}scale={matrix}out_color_matrix=bt601:out_range=pc:flags=bicubic+accurate_rnd+full_chroma_int,\
         format=yuvj420p",
        expression(&wanted)
    );
    // As an argument the filter of many frames could be too long.
    let script = log.with_file_name(FILTER);
    work::write(&script, filter)?;
    let script = std::path::absolute(&script).map_err(PrepareError::read(&script))?;
    let mut command = tools::command(&ffmpeg.path);
    command.args(["-v", "error", "-stats", "-nostdin", "-y", "-i"]).arg(&film.path).args(film.only());
    command.arg(filter_from_file(&ffmpeg.version)).arg(script);
    command.args(numbers_kept(&ffmpeg.version)).args(["-qscale:v", "2"]);
    // The pattern has no folder, because a percent sign in the folder's name would be a part of it.
    command.arg("part-%06d.jpg").current_dir(folder);
    let total = frames.len() as u64;
    let heard = |line: &str| {
        let done = line.rsplit("frame=").next().and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        if let Some(done) = done.filter(|_| line.contains("frame=")) {
            watch.tell("frames", (done, total), "frames written");
        }
    };
    let outcome = process::run(&mut command, log, watch.stop, heard)?;
    if !outcome.status.success() {
        let (step, log) = ("frames", log.to_path_buf());
        return Err(PrepareError::Step { step, reason: process::reason(&outcome), log });
    }
    take_parts(folder, names, log)?;
    let path = folder.join(STAMPS);
    let stamps = stamps(&std::fs::read_to_string(&path).unwrap_or_default());
    // A film without time stamps keeps the computed times.
    if stamps.len() == choice.frames.len() {
        for (frame, stamp) in choice.frames.iter_mut().zip(stamps) {
            (frame.seconds, frame.stamped) = stamp.map_or((frame.seconds, false), |stamp| (stamp, true));
        }
    }
    std::fs::remove_file(&path).map_err(PrepareError::write(&path))
}

/// Gives the frames that ffmpeg wrote into a folder their names.
fn take_parts(folder: &Path, names: &[PathBuf], log: &Path) -> Result<(), PrepareError> {
    let parts: Vec<PathBuf> =
        (1..=names.len()).map(|number| folder.join(format!("part-{number:06}.jpg"))).collect();
    // ffmpeg can also end well if it could not read the whole film.
    let written = parts.iter().take_while(|part| part.is_file()).count();
    if written < names.len() {
        let reason = format!(
            "ffmpeg wrote {written} of the {} frames that were chosen; the film may be damaged",
            names.len()
        );
        return Err(PrepareError::Step { step: "frames", reason, log: log.to_path_buf() });
    }
    for (part, name) in parts.iter().zip(names) {
        std::fs::rename(part, name).map_err(PrepareError::write(name))?;
    }
    Ok(())
}

#[cfg(test)]
#[path = "film_tests.rs"]
mod real_tests;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_argument_for_numbers_fits_the_version() {
        for (version, expected) in [
            ("4.4.2-0ubuntu", "-vsync"),
            ("5.0", "-vsync"),
            ("5.1.8-0+deb12u1", "-fps_mode"),
            ("7.0.2-static", "-fps_mode"),
            ("N-111-gabc", "-fps_mode"),
            ("n4.4", "-vsync"),
        ] {
            assert_eq!(numbers_kept(version)[0], expected, "{version}");
        }
        for (version, expected) in [
            ("4.4.2-0ubuntu", "-filter_script:v"),
            ("5.1.8-0+deb12u1", "-filter_script:v"),
            ("n7.1", "-filter_script:v"),
            ("9.0.1", "-/filter:v"),
            ("N-111-gabc", "-/filter:v"),
        ] {
            assert_eq!(filter_from_file(version), expected, "{version}");
        }
    }

    #[test]
    fn the_expression_of_many_frames_is_shallow() {
        assert_eq!(expression(&[3, 8]), "eq(n\\,3)+eq(n\\,8)");
        let few: Vec<u64> = (0..=SUM as u64).collect();
        let (low, high) = (expression(&few[..8]), expression(&few[8..]));
        assert_eq!(expression(&few), format!("if(lt(n\\,8)\\,{low}\\,{high})"));
        let many: Vec<u64> = (0..100_000).map(|i| 7 * i).collect();
        let text = expression(&many);
        assert_eq!(text.matches("eq(").count(), many.len());
        let deepest = text.chars().scan(0i32, |depth, c| {
            *depth += i32::from(c == '(') - i32::from(c == ')');
            Some(*depth)
        });
        assert!(deepest.max().unwrap() < 20);
        assert!(text.split("eq(").all(|part| part.matches('+').count() < 2), "sums are flat");
    }

    #[cfg(unix)]
    #[test]
    fn a_stream_that_breaks_off_is_an_error_and_ends_the_program() {
        const HEAD: &str = "printf 'YUV4MPEG2 W4 H4 F1:1 Cmono\n'; printf 'FRAME\n0123456789abcdef'; ";
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log.txt");
        let stop = std::sync::atomic::AtomicBool::new(false);
        let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
        let read = |rest: &str| {
            let mut command = Command::new("sh");
            command.arg("-c").arg(format!("{HEAD}{rest}"));
            grey_frames(&mut command, &log, &watch, 1, None)
        };
        let read = |rest: &str| read(rest).map(|looked| looked.frames.len());
        assert_eq!(read("exit 0").unwrap(), 1);
        // A film with damaged parts still counts.
        assert_eq!(read("exit 69").unwrap(), 1);
        for (rest, part) in [
            ("printf 'FRAME\n0123'", "broke off after 1 frames"),
            ("yes", "broke off after 1 frames"),
            ("kill -9 $$", "it was killed"),
        ] {
            let message = read(rest).unwrap_err().to_string();
            assert!(message.contains(part), "{rest}: {message}");
        }
    }

    #[test]
    fn frames_that_ffmpeg_did_not_write_are_counted() {
        let dir = tempfile::tempdir().unwrap();
        let names = ["f_3.jpg", "f_8.jpg", "f_9.jpg"].map(|name| dir.path().join(name));
        for number in 1..=2 {
            std::fs::write(dir.path().join(format!("part-{number:06}.jpg")), "frame").unwrap();
        }
        let said = take_parts(dir.path(), &names, Path::new("log.txt")).unwrap_err().to_string();
        let part = "ffmpeg wrote 2 of the 3 frames that were chosen; the film may be damaged";
        assert!(said.contains(part) && said.contains("log.txt"), "{said}");
        std::fs::write(dir.path().join("part-000003.jpg"), "frame").unwrap();
        take_parts(dir.path(), &names, Path::new("log.txt")).unwrap();
        assert!(names.iter().all(|name| name.is_file()));
    }

    #[test]
    fn time_stamps_are_read_in_microseconds() {
        let text = "frame:0    pts:-40000  pts_time:-0.04\nuse3d=1\nframe:1 pts:NOPTS pts_time:NOPTS\nuse3d=1\n\
            frame:12 pts:3600033367 pts_time:3600.03\n";
        assert_eq!(stamps(text), [Some(-0.04), None, Some(3600.033367)]);
    }

    #[test]
    fn headers_of_y4m_are_checked() {
        assert_eq!(y4m_size("YUV4MPEG2 W480 H270 F10:1 Ip Cmono"), Some((480, 270)));
        for bad in ["YUV4MPEG2 W480", "YUV4MPEG2 W0 H9", "YUV4MPEG2 W99999 H9", "P5 W4 H4", ""] {
            assert_eq!(y4m_size(bad), None, "{bad}");
        }
    }
}
