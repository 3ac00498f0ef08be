//! The properties of a film, as `ffprobe` prints them.

use std::path::{Path, PathBuf};
use std::process::Stdio;

use serde::Deserialize;

use super::colours::ColourTags;
use super::turn::{DisplayMatrix, parse_matrix};
use crate::error::PrepareError;
use crate::tools::{self, Program, Programs};

/// A fraction of two positive whole numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fraction {
    /// The upper number.
    pub over: u32,
    /// The lower number.
    pub under: u32,
}

impl Fraction {
    /// A fraction from a text such as `30000/1001` or `4:3`; `None` unless both numbers are positive.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        let (over, under) = text.split_once(['/', ':'])?;
        let (over, under) = (over.trim().parse().ok()?, under.trim().parse().ok()?);
        (over > 0 && under > 0).then_some(Self { over, under })
    }

    /// Its value.
    pub fn value(self) -> f64 {
        f64::from(self.over) / f64::from(self.under)
    }
}

/// The properties of a film.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmInfo {
    /// The file.
    pub path: PathBuf,
    /// Its number among the streams of the file. It is the largest film in it; attached pictures do not
    /// count.
    pub stream: usize,
    /// Width of the stored frames, pixels, before any turning.
    pub width: usize,
    /// Height of the stored frames, pixels, before any turning.
    pub height: usize,
    /// Mean frame rate, frames per second.
    pub rate: Fraction,
    /// True if the file states one rate. [`FilmReader`](super::FilmReader) also compares the time stamps.
    pub constant: bool,
    /// The unit of its time stamps, seconds.
    pub time_base: Fraction,
    /// Seconds from the file's begin to the film's end, if the file says it.
    pub end_seconds: Option<f64>,
    /// Seconds from the file's begin to the end of everything in it, if the file says it.
    pub file_seconds: Option<f64>,
    /// The matrix by which a player turns the stored frames.
    pub display_matrix: Option<DisplayMatrix>,
    /// The width of a pixel over its height, if it is not 1.
    pub pixel_aspect: Option<Fraction>,
    /// Its colour tags.
    pub colours: ColourTags,
    /// Bits of a colour value. Frames are read with 8 bits.
    pub bits: u32,
    /// True if a frame holds two half pictures of different times.
    pub interlaced: bool,
    /// The names of the codecs of its audio streams.
    pub audio: Vec<String>,
}

#[derive(Deserialize)]
struct Probe {
    #[serde(default)]
    streams: Vec<ProbeStream>,
    #[serde(default)]
    format: ProbeFormat,
}

#[derive(Default, Deserialize)]
struct ProbeFormat {
    start_time: Option<String>,
    duration: Option<String>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct ProbeStream {
    index: usize,
    codec_type: String,
    codec_name: String,
    width: usize,
    height: usize,
    pix_fmt: String,
    field_order: String,
    r_frame_rate: String,
    avg_frame_rate: String,
    time_base: String,
    start_time: Option<String>,
    duration: Option<String>,
    sample_aspect_ratio: String,
    color_range: Option<String>,
    color_space: Option<String>,
    color_transfer: Option<String>,
    color_primaries: Option<String>,
    bits_per_raw_sample: Option<String>,
    disposition: Disposition,
    tags: StreamTags,
    side_data_list: Vec<SideData>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Disposition {
    attached_pic: u8,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct StreamTags {
    /// Matroska has a stream's duration as a tag, `00:01:03.600000000`.
    #[serde(rename = "DURATION")]
    duration: Option<String>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct SideData {
    displaymatrix: Option<String>,
}

/// Seconds in a text such as `12.5`.
fn seconds(text: Option<&String>) -> Option<f64> {
    text?.trim().parse().ok().filter(|s: &f64| s.is_finite())
}

/// Seconds in a text such as `00:01:03.600000000`.
fn clock(text: Option<&String>) -> Option<f64> {
    let parts: Vec<f64> = text?.split(':').map(|p| p.trim().parse().ok()).collect::<Option<_>>()?;
    let &[h, m, s] = &parts[..] else { return None };
    Some(3600.0 * h + 60.0 * m + s).filter(|s| s.is_finite() && *s > 0.0)
}

/// The JSON of ffprobe about a file, as the properties of its film.
fn understand(path: &Path, json: &[u8]) -> Result<FilmInfo, PrepareError> {
    let bad = |reason: String| PrepareError::input(path, reason);
    let probe: Probe = serde_json::from_slice(json)
        .map_err(|e| bad(format!("ffprobe's words about it are not understood: {e}")))?;
    let films = probe.streams.iter().filter(|s| s.codec_type == "video" && s.disposition.attached_pic == 0);
    // Of two films of one size, the first one counts.
    let film = films.rev().max_by_key(|s| s.width * s.height).filter(|s| s.width * s.height > 0);
    let film = film
        .ok_or_else(|| bad("ffprobe finds no film in it; give the film that the frames come from".into()))?;
    let (mean, usual) = (Fraction::parse(&film.avg_frame_rate), Fraction::parse(&film.r_frame_rate));
    let rate = mean.or(usual).unwrap_or(Fraction { over: 30, under: 1 });
    // Files round the mean rate; a thousandth is less than one frame in half a minute.
    let constant = usual.is_some_and(|r| (r.value() / rate.value() - 1.0).abs() < 1e-3);
    let begin = seconds(probe.format.start_time.as_ref()).unwrap_or(0.0);
    let own_begin = seconds(film.start_time.as_ref()).unwrap_or(begin);
    let end = seconds(film.duration.as_ref()).map(|d| own_begin - begin + d);
    // Matroska states the time at which a stream ends.
    let end = end.or_else(|| clock(film.tags.duration.as_ref()).map(|d| d - begin));
    let tag = |tag: &Option<String>| {
        tag.clone().filter(|t| !t.is_empty() && !["unknown", "unspecified", "reserved"].contains(&&**t))
    };
    let bits = film.bits_per_raw_sample.as_ref().and_then(|b| b.parse().ok());
    let deep = ["p10", "p12", "p14", "p16"].into_iter().find(|d| film.pix_fmt.contains(d));
    let matrix = film.side_data_list.iter().find_map(|s| s.displaymatrix.as_deref());
    Ok(FilmInfo {
        path: path.to_path_buf(),
        stream: film.index,
        width: film.width,
        height: film.height,
        rate,
        constant,
        time_base: Fraction::parse(&film.time_base).unwrap_or(Fraction { over: 1, under: 90_000 }),
        end_seconds: end.filter(|s| *s > 0.0),
        file_seconds: seconds(probe.format.duration.as_ref()).filter(|s| *s > 0.0),
        display_matrix: matrix.and_then(parse_matrix).filter(|m| !m.is_identity()),
        pixel_aspect: Fraction::parse(&film.sample_aspect_ratio).filter(|a| a.over != a.under),
        colours: ColourTags {
            range: tag(&film.color_range).or_else(|| film.pix_fmt.starts_with("yuvj").then(|| "pc".into())),
            matrix: tag(&film.color_space),
            primaries: tag(&film.color_primaries),
            transfer: tag(&film.color_transfer),
        },
        bits: deep.and_then(|d| d[1..].parse().ok()).or(bits.filter(|b| *b > 0)).unwrap_or(8),
        interlaced: !["", "progressive", "unknown"].contains(&&*film.field_order),
        audio: {
            let audio = probe.streams.iter().filter(|s| s.codec_type == "audio");
            audio.map(|s| s.codec_name.clone()).collect()
        },
    })
}

impl FilmInfo {
    /// Asks `ffprobe`, which is installed with `ffmpeg`, about a film.
    ///
    /// # Errors
    /// `ffprobe` is missing, or it finds no film in the file.
    pub fn of(programs: &Programs, path: &Path) -> Result<Self, PrepareError> {
        let absolute = std::path::absolute(path).map_err(PrepareError::read(path))?;
        if !absolute.is_file() {
            return Err(PrepareError::input(path, "there is no such film"));
        }
        let ffprobe = programs.probe()?;
        let mut command = tools::command(&ffprobe.path);
        command.args(["-v", "error", "-show_streams", "-show_format", "-of", "json"]);
        // A name that begins with a dash, or has a colon, is a file's all the same.
        let output = command.arg(&absolute).stdin(Stdio::null()).output();
        let output = output.map_err(PrepareError::run(&ffprobe.path))?;
        if !output.status.success() {
            let text = String::from_utf8_lossy(&output.stderr);
            let last = text.lines().rfind(|l| !l.trim().is_empty()).unwrap_or("no reason was given");
            let reason = format!(
                "ffprobe cannot read this film: {}; copy it again from the camera, or repair it",
                last.trim()
            );
            return Err(PrepareError::input(path, reason));
        }
        understand(path, &output.stdout)
    }

    /// Remarks on properties that are not kept or matter for the result, for the user.
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = Vec::new();
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let name = use3d_capture::shown(&name);
        if self.colours.is_hdr() {
            remarks.push(format!("{name} is an HDR film; it is read with 8 bits, and its tags are kept"));
        } else if self.bits > 8 {
            remarks.push(format!("{name} has {} bits per colour value; it is read with 8 bits", self.bits));
        }
        if self.interlaced {
            remarks.push(format!(
                "{name} is interlaced: fast movements have combs; for better results, convert it first: `ffmpeg -i IN -vf \
                 bwdif -c:a copy OUT.mp4`, and prepare the result"
            ));
        }
        remarks
    }

    /// The arguments that make ffmpeg read this film's frames, as they are stored.
    pub(super) fn input(&self) -> [std::ffi::OsString; 3] {
        let absolute = std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone());
        ["-noautorotate".into(), "-i".into(), absolute.into()]
    }
}

impl Programs {
    /// `ffprobe`: the file of that name beside `ffmpeg`, or any on the path.
    ///
    /// # Errors
    /// It is not installed.
    pub(crate) fn probe(&self) -> Result<Program, PrepareError> {
        let ffmpeg = self.film()?;
        let name = |path: &Path| {
            let name = path.file_name()?.to_str()?;
            Some(path.with_file_name(name.replacen("ffmpeg", "ffprobe", 1)))
                .filter(|_| name.contains("ffmpeg"))
        };
        let beside = name(&ffmpeg.path).into_iter().chain([PathBuf::from("ffprobe")]);
        let found = beside.into_iter().find_map(|path| tools::of_ffmpeg("ffprobe", &path));
        found.ok_or_else(|| {
            PrepareError::Program(format!(
                "ffprobe is needed to read the properties of films, and it was not found beside {}; the package \
                 imageio-ffmpeg lacks it; `sudo apt install ffmpeg` (Debian, Ubuntu) or `brew install ffmpeg` (Mac) \
                 brings both",
                ffmpeg.path.display()
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_film_counts_and_attached_pictures_do_not() {
        let json = br#"{"streams": [
            {"index": 0, "codec_type": "video", "width": 4000, "height": 3000, "disposition": {"attached_pic": 1}},
            {"index": 1, "codec_type": "video", "width": 240, "height": 136, "r_frame_rate": "90000/1"},
            {"index": 2, "codec_type": "video", "width": 1920, "height": 1080, "r_frame_rate": "30000/1001",
             "avg_frame_rate": "30000/1001", "time_base": "1/30000", "start_time": "0.040", "duration": "10.0",
             "color_range": "tv", "color_space": "bt709", "color_transfer": "unknown",
             "pix_fmt": "yuv420p10le", "field_order": "tt", "sample_aspect_ratio": "4:3",
             "side_data_list": [{"side_data_type": "x"}, {"displaymatrix":
             "\n00000000:            0       65536           0\n00000001:       -65536           0           0\n00000002:            0           0  1073741824\n"}]},
            {"index": 3, "codec_type": "audio", "codec_name": "aac"},
            {"index": 4, "codec_type": "data"}],
            "format": {"start_time": "-0.020"}}"#;
        let info = understand(Path::new("a.mp4"), json).unwrap();
        assert_eq!((info.stream, info.width, info.height, info.bits), (2, 1920, 1080, 10));
        assert_eq!((info.rate, info.constant), (Fraction { over: 30000, under: 1001 }, true));
        assert!((info.end_seconds.unwrap() - 10.06).abs() < 1e-9, "{:?}", info.end_seconds);
        assert_eq!((info.file_seconds, info.interlaced), (None, true));
        assert_eq!(info.colours.matrix.as_deref(), Some("bt709"));
        assert_eq!(info.colours.transfer, None);
        assert_eq!(info.pixel_aspect, Some(Fraction { over: 4, under: 3 }));
        assert_eq!(info.display_matrix.unwrap().quarter_turns(), Some(1));
        assert_eq!(info.audio, ["aac"]);
        assert_eq!(info.remarks().len(), 2);
        for (bad, part) in [("{", "not understood"), ("{}", "no film"), (r#"{"streams": [{}]}"#, "no film")] {
            let said = understand(Path::new("a.mp4"), bad.as_bytes()).unwrap_err().to_string();
            assert!(said.contains(part) && said.contains("a.mp4"), "{said}");
        }
    }
}
