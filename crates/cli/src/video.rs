//! Films: raw Y4M (4:4:4, BT.709, limited range, as players expect), or piped into a system `ffmpeg` for any other
//! container, which is told the same, so that its file says how the colours are meant.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use use3d_capture::Image8;
use use3d_pipeline::engine::place::{parent, sibling};

use crate::error::CliError;

/// Even sides, as 4:2:0 needs them, and what the numbers mean.
const FILTER: &str =
    "pad=ceil(iw/2)*2:ceil(ih/2)*2,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv";

/// A film being written.
pub(crate) struct Video {
    sink: Sink,
    path: PathBuf,
    part: Part,
    size: Option<(usize, usize)>,
    fps: u32,
}

enum Sink {
    File(BufWriter<File>),
    Ffmpeg(Child),
}

/// The film until it is whole, beside its place; what is left of it goes with the command.
struct Part(PathBuf);

impl Drop for Part {
    fn drop(&mut self) {
        // Not there any more once it was renamed.
        let _ = std::fs::remove_file(&self.0);
    }
}

impl Video {
    /// Starts a film at `path`: `.y4m` is written directly, anything else needs `ffmpeg`.
    pub(crate) fn create(path: &Path, fps: u32) -> Result<Self, CliError> {
        let shown = path.display();
        if fps == 0 {
            return Err(CliError::Input("--frame-rate 0: a film needs at least one frame per second".into()));
        }
        // With its extension, by which ffmpeg knows what to write.
        let mut part = sibling(path);
        if let Some(extension) = path.extension() {
            part.set_extension(extension);
        }
        let part = Part(part);
        std::fs::create_dir_all(parent(path))
            .map_err(|e| CliError::Input(format!("--video {shown}: cannot make its folder: {e}")))?;
        let sink = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("y4m")) {
            let file = File::create(&part.0).map_err(|e| {
                CliError::Input(format!("--video {shown}: cannot write {}: {e}", part.0.display()))
            })?;
            Sink::File(BufWriter::new(file))
        } else {
            let child = Command::new("ffmpeg")
                .args(["-loglevel", "error", "-y", "-f", "yuv4mpegpipe", "-i", "-", "-pix_fmt", "yuv420p"])
                .args(["-vf", FILTER])
                .args(["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"])
                .args(["-color_range", "tv"])
                // Never taken for an option or another protocol.
                .arg(file_url(&part.0))
                .stdin(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .map_err(|e| {
                    CliError::Input(format!(
                        "--video {shown}: cannot start ffmpeg ({e}); install ffmpeg, or name a .y4m file, which needs nothing"
                    ))
                })?;
            Sink::Ffmpeg(child)
        };
        Ok(Self { sink, path: path.to_path_buf(), part, size: None, fps })
    }

    /// Appends a frame; all frames have one size.
    pub(crate) fn push(&mut self, frame: &Image8) -> Result<(), CliError> {
        let size = (frame.width(), frame.height());
        let mut bytes = Vec::new();
        match self.size {
            None => {
                self.size = Some(size);
                bytes.extend_from_slice(
                    format!(
                        "YUV4MPEG2 W{} H{} F{}:1 Ip A1:1 C444 XCOLORRANGE=LIMITED\n",
                        size.0, size.1, self.fps
                    )
                    .as_bytes(),
                );
            }
            Some(expected) if expected != size => {
                return Err(CliError::Input(format!(
                    "--video: frames of {}x{} and {}x{} cannot share a film; render one camera size with --size",
                    expected.0, expected.1, size.0, size.1
                )));
            }
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
            // It has ended; why, it says itself.
            Sink::Ffmpeg(child) => ended(&self.path, child, &e.to_string()),
            Sink::File { .. } => {
                CliError::Failed(format!("--video {}: writing a frame failed: {e}", self.path.display()))
            }
        })
    }

    /// Ends the film; only now does its name appear.
    pub(crate) fn finish(self) -> Result<(), CliError> {
        let failed = |e: std::io::Error| CliError::Failed(format!("--video {}: {e}", self.path.display()));
        match self.sink {
            Sink::File(writer) => {
                let file = writer.into_inner().map_err(|e| failed(e.into_error()))?;
                file.sync_all().map_err(failed)?;
            }
            Sink::Ffmpeg(mut child) => {
                drop(child.stdin.take());
                // Read first: a full pipe would keep it from ending.
                let said = said(&mut child);
                let status = child.wait().map_err(failed)?;
                if !status.success() {
                    return Err(refused(&self.path, &said, &status.to_string()));
                }
            }
        }
        std::fs::rename(&self.part.0, &self.path).map_err(failed)
    }
}

/// A path as ffmpeg takes it literally.
fn file_url(path: &Path) -> OsString {
    let mut url = OsString::from("file:");
    url.push(path);
    url
}

/// What ffmpeg has told on its stderr.
fn said(child: &mut Child) -> String {
    let mut text = Vec::new();
    if let Some(mut stderr) = child.stderr.take() {
        let _ = stderr.read_to_end(&mut text);
    }
    String::from_utf8_lossy(&text).into_owned()
}

/// An ffmpeg that no longer takes frames.
fn ended(path: &Path, child: &mut Child, otherwise: &str) -> CliError {
    drop(child.stdin.take());
    let said = said(child);
    let _ = child.wait();
    refused(path, &said, otherwise)
}

/// Why ffmpeg did not write a film: the last of its words, without the memory addresses that it begins lines with.
fn refused(path: &Path, said: &str, otherwise: &str) -> CliError {
    let line = said.lines().map(str::trim).find(|l| !l.is_empty());
    let why = line.map_or(otherwise, |l| l.rsplit_once("] ").map_or(l, |(_, words)| words));
    CliError::Failed(format!(
        "--video {}: ffmpeg could not write it: {why}; .mp4, .webm, .gif and .y4m are known to work",
        path.display()
    ))
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
    fn grey_has_no_chroma_and_primaries_have_the_standard_values() {
        let image = Image8::from_interleaved(2, 1, &[128, 128, 128, 255, 0, 0]).unwrap();
        assert_eq!(to_ycbcr(&image), [126, 63, 128, 102, 128, 240]);
    }
    #[test]
    fn ffmpegs_words_are_told_without_its_addresses() {
        let said =
            "[NULL @ 0x55d0c8] Unable to choose an output format for 'a.xyz'\nError opening output file\n";
        let CliError::Failed(message) = refused(Path::new("a.xyz"), said, "Broken pipe") else { panic!() };
        assert!(message.contains("write it: Unable to choose an output format") && !message.contains("0x55"));
        let CliError::Failed(message) = refused(Path::new("a.mp4"), "\n", "exit status: 1") else { panic!() };
        assert!(message.contains("exit status: 1"), "{message}");
    }
}
