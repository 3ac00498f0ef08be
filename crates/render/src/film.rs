//! Films: raw Y4M (4:4:4, BT.709, limited range, as players expect), or piped into a system `ffmpeg` for
//! any other container. The arguments of `ffmpeg` contain the same colour description, so that it is stored
//! in the file.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufWriter, Error as IoError, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use use3d_capture::Image8;

/// Pads to even sides, which 4:2:0 needs, and sets the colour description.
const FILTER: &str =
    "pad=ceil(iw/2)*2:ceil(ih/2)*2,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv";

/// A reason why a film cannot be begun or written. The caller has its path.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// The frame rate is zero.
    #[error("0 frames per second; a film needs at least one")]
    FrameRate,
    /// The folder for the film cannot be made.
    #[error("cannot make its folder: {0}")]
    Folder(IoError),
    /// The temporary file of the film cannot be created.
    #[error("cannot write {}: {source}", path.display())]
    Create {
        /// That file.
        path: PathBuf,
        /// The system's error.
        source: IoError,
    },
    /// The system has no `ffmpeg`.
    #[error("cannot start ffmpeg ({0}); install ffmpeg, or name a .y4m file, which needs nothing")]
    NoFfmpeg(IoError),
    /// A frame has another size than those before.
    #[error("frames of {}x{} and {}x{} cannot share a film; render one camera size with --size", first.0, first.1, other.0, other.1)]
    Sizes {
        /// Width and height of the frames before.
        first: (usize, usize),
        /// Width and height of this one.
        other: (usize, usize),
    },
    /// A frame could not be written.
    #[error("writing a frame failed: {0}")]
    Frame(IoError),
    /// `ffmpeg` did not write the film.
    #[error("ffmpeg could not write it: {0}; .mp4, .webm, .gif and .y4m are known to work")]
    Refused(String),
    /// The film could not be completed.
    #[error("{0}")]
    Finish(IoError),
}

impl FilmError {
    /// True if the request cannot be fulfilled, before or apart from the writing itself.
    pub fn is_of_the_request(&self) -> bool {
        matches!(
            self,
            Self::FrameRate | Self::Folder(_) | Self::Create { .. } | Self::NoFfmpeg(_) | Self::Sizes { .. }
        )
    }
}

/// A film being written.
pub struct Film {
    sink: Sink,
    path: PathBuf,
    part: TemporaryFilm,
    size: Option<(usize, usize)>,
    rate: (u64, u64),
}

enum Sink {
    File(BufWriter<File>),
    Ffmpeg(Child),
}

/// The temporary file of the film, beside its final path; it is removed when this value is dropped.
struct TemporaryFilm(PathBuf);

impl Drop for TemporaryFilm {
    fn drop(&mut self) {
        // The file no longer exists after it was renamed.
        let _ = std::fs::remove_file(&self.0);
    }
}

impl Film {
    /// Starts a film at `path`: `.y4m` is written directly, anything else needs `ffmpeg`. Until it is
    /// complete it is written to `part`, a path in the same folder, whose extension becomes the film's.
    /// `rate` is its number of frames per second.
    ///
    /// # Errors
    /// See [`FilmError`]; [`FilmError::is_of_the_request`] is true for all of them.
    pub fn create(path: &Path, mut part: PathBuf, rate: f64) -> Result<Self, FilmError> {
        let rate = fraction(rate).ok_or(FilmError::FrameRate)?;
        // The extension is needed, because ffmpeg chooses the format by it.
        if let Some(extension) = path.extension() {
            part.set_extension(extension);
        }
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder).map_err(FilmError::Folder)?;
        // The file must be new, so neither this program nor ffmpeg follows a link of that name.
        let created = File::options().write(true).create_new(true).open(&part);
        let file = created.map_err(|source| FilmError::Create { path: part.clone(), source })?;
        let part = TemporaryFilm(part);
        let sink = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("y4m")) {
            Sink::File(BufWriter::new(file))
        } else {
            let child = Command::new("ffmpeg")
                .args(["-loglevel", "error", "-y", "-f", "yuv4mpegpipe", "-i", "-", "-pix_fmt", "yuv420p"])
                .args(["-vf", FILTER])
                .args(["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"])
                .args(["-color_range", "tv"])
                // The URL form keeps the path from being read as an option or another protocol.
                .arg(file_url(&part.0))
                .stdin(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .map_err(FilmError::NoFfmpeg)?;
            Sink::Ffmpeg(child)
        };
        Ok(Self { sink, path: path.to_path_buf(), part, size: None, rate })
    }

    /// Appends a frame; all frames have one size.
    ///
    /// # Errors
    /// The frame has another size, or cannot be written.
    pub fn push(&mut self, frame: &Image8) -> Result<(), FilmError> {
        let size = (frame.width(), frame.height());
        let mut bytes = Vec::new();
        match self.size {
            None => {
                self.size = Some(size);
                bytes.extend_from_slice(
                    format!(
                        "YUV4MPEG2 W{} H{} F{}:{} Ip A1:1 C444 XCOLORRANGE=LIMITED\n",
                        size.0, size.1, self.rate.0, self.rate.1
                    )
                    .as_bytes(),
                );
            }
            Some(first) if first != size => return Err(FilmError::Sizes { first, other: size }),
            Some(_) => {}
        }
        bytes.extend_from_slice(b"FRAME\n");
        bytes.extend(to_ycbcr(frame));
        let written = match &mut self.sink {
            Sink::File(writer) => writer.write_all(&bytes),
            Sink::Ffmpeg(child) => match child.stdin.as_mut() {
                Some(stdin) => stdin.write_all(&bytes),
                None => Err(std::io::ErrorKind::BrokenPipe.into()),
            },
        };
        written.map_err(|e| match &mut self.sink {
            // The process has ended; its error text has the reason.
            Sink::Ffmpeg(child) => ended(child, &e.to_string()),
            Sink::File { .. } => FilmError::Frame(e),
        })
    }

    /// Completes the film; only now its final name appears.
    ///
    /// # Errors
    /// The film could not be written to its end; its name does not appear.
    pub fn finish(self) -> Result<(), FilmError> {
        match self.sink {
            Sink::File(writer) => {
                let file = writer.into_inner().map_err(|e| FilmError::Finish(e.into_error()))?;
                file.sync_all().map_err(FilmError::Finish)?;
            }
            Sink::Ffmpeg(mut child) => {
                drop(child.stdin.take());
                // The text is read first, because a full pipe would keep the process from ending.
                let said = said(&mut child);
                let status = child.wait().map_err(FilmError::Finish)?;
                if !status.success() {
                    return Err(refused(&said, &status.to_string()));
                }
            }
        }
        std::fs::rename(&self.part.0, &self.path).map_err(FilmError::Finish)
    }
}

/// A rate as a fraction: whole numbers, the rates of television (30000/1001), else thousandths. `None` for a
/// rate that no film has.
fn fraction(rate: f64) -> Option<(u64, u64)> {
    if !(rate >= 1e-3 && rate <= f64::from(u32::MAX)) {
        return None;
    }
    let near =
        |by: f64| Some((rate * by).round()).filter(|whole| (whole / by - rate).abs() <= 1e-3 * rate.min(1.0));
    let whole = near(1.0).map(|n| (n as u64, 1));
    let television = || near(1.001).map(|n| (1000 * n as u64, 1001));
    whole.or_else(television).or(Some(((1000.0 * rate).round() as u64, 1000)))
}

/// A path in the form that ffmpeg reads literally.
fn file_url(path: &Path) -> OsString {
    let mut url = OsString::from("file:");
    url.push(path);
    url
}

/// Reads the text that ffmpeg wrote to its stderr.
fn said(child: &mut Child) -> String {
    let mut text = Vec::new();
    if let Some(mut stderr) = child.stderr.take() {
        let _ = stderr.read_to_end(&mut text);
    }
    String::from_utf8_lossy(&text).into_owned()
}

/// The error for an ffmpeg process that no longer accepts frames.
fn ended(child: &mut Child, otherwise: &str) -> FilmError {
    drop(child.stdin.take());
    let said = said(child);
    let _ = child.wait();
    refused(&said, otherwise)
}

/// The error with ffmpeg's reason: the first line of its text, without the memory address at its beginning.
fn refused(said: &str, otherwise: &str) -> FilmError {
    let line = said.lines().map(str::trim).find(|l| !l.is_empty());
    let why = line.map_or(otherwise, |l| l.rsplit_once("] ").map_or(l, |(_, words)| words));
    FilmError::Refused(why.to_string())
}

/// BT.709 planes Y (16 to 235), Cb, Cr (16 to 240).
fn to_ycbcr(frame: &Image8) -> Vec<u8> {
    let n = frame.width() * frame.height();
    let [r, g, b] = frame.planes();
    let mut out = vec![0u8; 3 * n];
    let round = |v: f32| (v + 0.5).clamp(0.0, 255.0) as u8;
    for p in 0..n {
        let [r, g, b] = [r[p], g[p], b[p]].map(|v| f32::from(v) / 255.0);
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        out[p] = round(16.0 + 219.0 * y);
        out[n + p] = round(128.0 + 224.0 * (b - y) / 1.8556);
        out[2 * n + p] = round(128.0 + 224.0 * (r - y) / 1.5748);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_written_as_fractions() {
        for (rate, expected) in [(24.0, (24, 1)), (29.97, (30_000, 1001)), (12.5, (12_500, 1000))] {
            assert_eq!(fraction(rate), Some(expected));
        }
        assert_eq!([0.0, -1.0, f64::NAN].map(fraction), [None; 3]);
    }

    #[test]
    fn grey_has_no_chroma_and_primaries_have_the_standard_values() {
        let image = Image8::from_interleaved(2, 1, &[128, 128, 128, 255, 0, 0]).unwrap();
        assert_eq!(to_ycbcr(&image), [126, 63, 128, 102, 128, 240]);
    }

    #[test]
    fn ffmpegs_words_are_told_without_its_addresses() {
        let said =
            "[NULL @ 0x55d0c8] Unable to choose an output format for 'a.xyz'\nError opening output file\n";
        let message = refused(said, "Broken pipe").to_string();
        assert!(message.contains("write it: Unable to choose an output format") && !message.contains("0x55"));
        let message = refused("\n", "exit status: 1").to_string();
        assert!(message.contains("exit status: 1"), "{message}");
    }

    #[test]
    fn a_film_appears_whole_or_not_at_all() {
        let dir = tempfile::tempdir().unwrap();
        let (path, part) = (dir.path().join("swim.y4m"), dir.path().join("growing"));
        let frame = |width| Image8::from_interleaved(width, 1, &vec![128; 3 * width]).unwrap();
        let names = || std::fs::read_dir(dir.path()).unwrap().count();
        assert!(matches!(Film::create(&path, part.clone(), 0.0), Err(FilmError::FrameRate)));
        let mut film = Film::create(&path, part.clone(), 25.0).unwrap();
        film.push(&frame(2)).unwrap();
        assert!(matches!(film.push(&frame(3)), Err(FilmError::Sizes { first: (2, 1), other: (3, 1) })));
        assert!(!path.exists() && names() == 1, "it grows beside its place");
        drop(film);
        assert_eq!(names(), 0, "and goes with a command that ends before");
        let mut film = Film::create(&path, part, 25.0).unwrap();
        film.push(&frame(2)).unwrap();
        film.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert!(
            bytes.starts_with(b"YUV4MPEG2 W2 H1 F25:1 ") && bytes.ends_with(&[126, 126, 128, 128, 128, 128])
        );
        assert_eq!(names(), 1);
    }
}
