//! Films: raw Y4M (4:4:4, BT.709, full range), or piped into a system `ffmpeg` for any other container.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use use3d_capture::Image8;

use crate::error::CliError;

/// A film being written.
pub(crate) struct Video {
    sink: Sink,
    path: PathBuf,
    size: Option<(usize, usize)>,
    fps: u32,
}

enum Sink {
    File { writer: BufWriter<File>, temporary: PathBuf },
    Ffmpeg(Child),
}

impl Video {
    /// Starts a film at `path`: `.y4m` is written directly, anything else needs `ffmpeg`.
    pub(crate) fn create(path: &Path, fps: u32) -> Result<Self, CliError> {
        let shown = path.display();
        if fps == 0 {
            return Err(CliError::Input("--frame-rate 0: a film needs at least one frame per second".into()));
        }
        let sink = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("y4m")) {
            let temporary = path.with_extension("y4m.part");
            let file = File::create(&temporary).map_err(|e| {
                CliError::Input(format!("--video {shown}: cannot write {}: {e}", temporary.display()))
            })?;
            Sink::File { writer: BufWriter::new(file), temporary }
        } else {
            let child = Command::new("ffmpeg")
                .args(["-loglevel", "error", "-y", "-f", "yuv4mpegpipe", "-i", "-", "-pix_fmt", "yuv420p"])
                .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])
                .arg(path)
                .stdin(Stdio::piped())
                .spawn()
                .map_err(|e| {
                    CliError::Input(format!(
                        "--video {shown}: cannot start ffmpeg ({e}); install ffmpeg, or name a .y4m file, which needs nothing"
                    ))
                })?;
            Sink::Ffmpeg(child)
        };
        Ok(Self { sink, path: path.to_path_buf(), size: None, fps })
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
                        "YUV4MPEG2 W{} H{} F{}:1 Ip A1:1 C444 XCOLORRANGE=FULL\n",
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
            Sink::File { writer, .. } => writer.write_all(&bytes),
            Sink::Ffmpeg(child) => match child.stdin.as_mut() {
                Some(stdin) => stdin.write_all(&bytes),
                None => Err(std::io::ErrorKind::BrokenPipe.into()),
            },
        };
        written.map_err(|e| {
            CliError::Failed(format!("--video {}: writing a frame failed: {e}", self.path.display()))
        })
    }

    /// Ends the film; only now does its name appear.
    pub(crate) fn finish(self) -> Result<(), CliError> {
        let failed = |e: std::io::Error| CliError::Failed(format!("--video {}: {e}", self.path.display()));
        match self.sink {
            Sink::File { writer, temporary } => {
                let file = writer.into_inner().map_err(|e| failed(e.into_error()))?;
                file.sync_all().map_err(failed)?;
                std::fs::rename(temporary, &self.path).map_err(failed)
            }
            Sink::Ffmpeg(mut child) => {
                drop(child.stdin.take());
                let status = child.wait().map_err(failed)?;
                if status.success() {
                    return Ok(());
                }
                Err(CliError::Failed(format!("--video {}: ffmpeg ended with {status}", self.path.display())))
            }
        }
    }
}

/// BT.709 full-range planes Y, Cb, Cr.
fn to_ycbcr(frame: &Image8) -> Vec<u8> {
    let n = frame.width() * frame.height();
    let [r, g, b] = frame.planes();
    let mut out = vec![0u8; 3 * n];
    let round = |v: f32| (v + 0.5).clamp(0.0, 255.0) as u8;
    for p in 0..n {
        let (r, g, b) = (f32::from(r[p]), f32::from(g[p]), f32::from(b[p]));
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        out[p] = round(y);
        out[n + p] = round((b - y) / 1.8556 + 128.0);
        out[2 * n + p] = round((r - y) / 1.5748 + 128.0);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_has_no_chroma_and_primaries_have_the_standard_values() {
        let image = Image8::from_interleaved(2, 1, &[128, 128, 128, 255, 0, 0]).unwrap();
        assert_eq!(to_ycbcr(&image), [128, 54, 128, 99, 128, 255]);
    }
}
