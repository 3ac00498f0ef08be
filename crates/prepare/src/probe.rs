//! The properties of a film, from the words of `ffmpeg` about its file.
//!
//! A file can have several streams of pictures, such as a cover of one frame before the film itself. The
//! largest one that is no attached picture is the film. A film that does not name its matrix has BT.709
//! from 720 lines on, and else BT.601.

use std::path::{Path, PathBuf};
use std::process::Stdio;

use use3d_capture::shown;

use crate::error::PrepareError;
use crate::tools::{self, Program};

/// The properties of a film.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Film {
    pub(crate) path: PathBuf,
    /// The number of its stream in the file.
    stream: usize,
    /// Frames per second.
    pub(crate) rate: f64,
    /// Seconds, if known.
    pub(crate) seconds: Option<f64>,
    /// The colour matrix to assume, if the film names none.
    pub(crate) matrix: Option<&'static str>,
    /// True if its colours are for HDR screens.
    hdr: bool,
    /// True if each frame has two half pictures, one after the other.
    interlaced: bool,
    /// True if its pixels are not square.
    stretched: bool,
}

/// The number and the size of a stream, from ffmpeg's line about it: `Stream #0:1[0x2](und): Video: h264, …`.
fn stream(line: &str) -> Option<(usize, (u32, u32))> {
    let rest = line.trim().strip_prefix("Stream #")?;
    let digits: String = rest.split_once(':')?.1.chars().take_while(char::is_ascii_digit).collect();
    let size = line.split([',', ' ']).find_map(|word| {
        let (w, h) = word.split_once('x')?;
        Some((w.parse::<u32>().ok()?, h.parse::<u32>().ok()?))
    });
    Some((digits.parse().ok()?, size.unwrap_or_default()))
}

/// The reason why ffmpeg finds no film in a file, with a next step.
fn no_film(path: &Path, text: &str) -> String {
    if std::fs::metadata(path).is_ok_and(|data| data.len() == 0) {
        return "the film is empty: copy it from the card again".into();
    }
    if text.contains("moov atom not found") {
        return "the recording was not finished, so the film has no index (a battery that ran out, a lost connection): \
            put the card back into the camera and switch it on, which often repairs the film; if not, a repair program \
            such as untrunc can help, which also needs a good film of the same camera"
            .into();
    }
    let last = text.lines().rfind(|l| !l.trim().is_empty() && !l.starts_with("At least")).unwrap_or_default();
    format!("ffmpeg finds no film in it: {}", last.trim())
}

/// The text of ffmpeg about a file, as the properties of its film.
fn understand(path: &Path, text: &str) -> Result<Film, PrepareError> {
    let films = text.lines().filter(|l| l.contains("Video: ") && !l.contains("(attached pic)"));
    let films = films.filter_map(|line| Some((line, stream(line)?)));
    let area = |(w, h): (u32, u32)| u64::from(w) * u64::from(h);
    // The first of the largest ones.
    let largest = films.reduce(|best, next| if area(next.1.1) > area(best.1.1) { next } else { best });
    let Some((line, (number, (_, height)))) = largest else {
        return Err(PrepareError::input(path, no_film(path, text)));
    };
    let before = |unit: &str| -> Option<f64> {
        line.split(',').find_map(|part| part.trim().strip_suffix(unit)?.trim().parse().ok())
    };
    let thousand = |text: &str| Some(1000.0 * text.trim().strip_suffix('k')?.parse::<f64>().ok()?);
    let rate = before(" fps")
        .or_else(|| before(" tbr"))
        .or_else(|| line.split(',').find_map(|part| thousand(part.trim().strip_suffix(" tbr")?)));
    let rate = rate.filter(|r| r.is_finite() && *r > 0.0).unwrap_or(30.0);
    let clock = text.split("Duration: ").nth(1).and_then(|rest| rest.split(',').next());
    let seconds = clock.and_then(|clock| {
        let parts: Vec<f64> = clock.split(':').map(|p| p.trim().parse().ok()).collect::<Option<_>>()?;
        let &[h, m, s] = &parts[..] else { return None };
        Some(3600.0 * h + 60.0 * m + s).filter(|s| s.is_finite() && *s > 0.0)
    });
    let named =
        ["bt709", "bt470bg", "smpte170m", "bt2020", "fcc", "smpte240m"].iter().any(|m| line.contains(m));
    let guess = if height >= 720 { "bt709" } else { "bt601" };
    let aspect = line.split("SAR ").nth(1).and_then(|rest| rest.split([' ', ']', ',']).next());
    Ok(Film {
        path: path.to_path_buf(),
        stream: number,
        rate,
        seconds,
        matrix: (!named).then_some(guess),
        hdr: line.contains("smpte2084") || line.contains("arib-std-b67"),
        interlaced: ["top first", "bottom first", "top coded first", "bottom coded first"]
            .iter()
            .any(|order| line.contains(order)),
        stretched: aspect.is_some_and(|aspect| aspect.contains(':') && aspect != "1:1" && aspect != "0:1"),
    })
}

/// Asks ffmpeg about a film.
pub(crate) fn probe(ffmpeg: &Program, path: &Path) -> Result<Film, PrepareError> {
    let mut command = tools::command(&ffmpeg.path);
    command.args(["-hide_banner", "-i"]).arg(path).stdin(Stdio::null());
    let output = command.output().map_err(PrepareError::run(&ffmpeg.path))?;
    understand(path, &String::from_utf8_lossy(&output.stderr))
}

impl Film {
    /// The arguments that choose its stream alone.
    pub(crate) fn only(&self) -> [String; 4] {
        ["-map".into(), format!("0:{}", self.stream), "-an".into(), "-sn".into()]
    }

    /// The filters before all others, each with a comma: half pictures are joined, and pixels become square.
    pub(crate) fn before(&self) -> String {
        let joined = if self.interlaced { "yadif=mode=send_frame," } else { "" };
        let square = if self.stretched { "scale=w=2*trunc(iw*sar/2+0.5):h=ih,setsar=1," } else { "" };
        format!("{joined}{square}")
    }

    /// Remarks on the film for the user.
    pub(crate) fn remarks(&self) -> Vec<String> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let name = shown(&name);
        let of = |said: bool, text: &str| said.then(|| format!("{name} {text}"));
        let hdr = "is an HDR film: its colours look pale here; film in standard colours (Rec. 709) next time";
        let interlaced = "is interlaced (50i, 60i): each frame was joined from two half pictures; film in progressive mode \
            (25p, 30p) next time";
        let stretched = "has pixels that are not square: its frames were stretched to their true shape";
        let all = [of(self.hdr, hdr), of(self.interlaced, interlaced), of(self.stretched, stretched)];
        all.into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "Input #0, mov\n  Duration: 00:01:03.60, start: 0.000000, bitrate: 1999 kb/s\n  Stream \
        #0:0[0x1](und): Video: h264 (High) (avc1 / 0x31637661), yuv420p(progressive), 480x270, 1997 kb/s, 29.97 \
        fps, 10 tbr, 10240 tbn (default)\nAt least one output file must be specified\n";

    fn film(text: &str) -> Film {
        understand(Path::new("a.mp4"), text).unwrap()
    }

    #[test]
    fn the_words_of_ffmpeg_are_understood() {
        let found = film(TEXT);
        assert_eq!((found.rate, found.seconds, found.matrix), (29.97, Some(63.6), Some("bt601")));
        assert!(!found.hdr && !found.interlaced && !found.stretched && found.before().is_empty());
        let large = film(&TEXT.replace("480x270", "1920x1080 [SAR 1:1 DAR 16:9]"));
        assert!(large.matrix == Some("bt709") && !large.stretched);
        assert_eq!(film(&TEXT.replace("(progressive)", "(tv, bt709, progressive)")).matrix, None);
        assert!(film(&TEXT.replace("(progressive)", "(tv, bt2020nc/bt2020/arib-std-b67)")).hdr);
        let found = film(&TEXT.replace("29.97 fps, 10 tbr", "1k tbr").replace("00:01:03.60", "N/A"));
        assert_eq!((found.rate, found.seconds), (1000.0, None));
        let interlaced = film(&TEXT.replace("(progressive)", "(tv, bt470bg, top first)"));
        assert!(
            interlaced.before().starts_with("yadif") && interlaced.remarks()[0].contains("half pictures")
        );
        let stretched = film(&TEXT.replace("480x270", "1440x1080 [SAR 4:3 DAR 16:9]"));
        assert!(stretched.before().contains("iw*sar"));
    }

    #[test]
    fn the_largest_stream_is_the_film() {
        let cover = "  Stream #0:0[0x1]: Video: mjpeg (Baseline), yuvj420p(pc), 240x136 [SAR 1:1], 90k fps, 90k tbr\n  \
            Stream #0:2: Video: png, rgb24, 4000x3000, 1 fps, 1 tbr (attached pic)\n";
        let found = film(&TEXT.replace("  Stream #0:0", &format!("{cover}  Stream #0:1")));
        assert_eq!((found.rate, found.only()[1].as_str()), (29.97, "0:1"));
    }

    #[test]
    fn files_without_a_film_are_named_for_what_they_are() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("dive.mp4");
        std::fs::write(&path, "").unwrap();
        let said = |text: &str| understand(&path, text).unwrap_err().to_string();
        assert!(said("dive.mp4: Invalid data found\n").contains("is empty: copy it"));
        std::fs::write(&path, "ftyp").unwrap();
        let unfinished = said("[mov @ 0x1] moov atom not found\ndive.mp4: Invalid data found\n");
        assert!(unfinished.contains("was not finished") && unfinished.contains("untrunc"), "{unfinished}");
        assert!(said("dive.mp4: Invalid data found\n").contains("Invalid data"));
    }
}
