//! Films that are read and written again by the real ffmpeg. Without it, or without libx264, the tests say
//! so.
#![cfg(unix)]

mod kept;
mod refused;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;

use use3d_prepare::{
    FilmChoices, FilmFrame, FilmReader, FilmWriter, FilmWritten, Fraction, PrepareError, Programs, StepWatch,
};

/// Runs a program with words, each separated by one space; the output if it ends well.
fn run(program: &str, words: &str, files: &[&Path]) -> Option<String> {
    let mut files = files.iter();
    let words = words.split(' ').map(|word| match word {
        "@" => files.next().unwrap().as_os_str().to_owned(),
        word => word.into(),
    });
    let output = Command::new(program).args(words).stdin(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    if !output.status.success() {
        println!("{program}: {}", String::from_utf8_lossy(&output.stderr));
    }
    output.status.success().then_some(text)
}

/// A folder for films; `None`, with a word, if ffmpeg cannot make them.
fn place() -> Option<tempfile::TempDir> {
    let encoders = run("ffmpeg", "-v error -encoders", &[]).unwrap_or_default();
    let there = encoders.contains(" libx264 ") && run("ffprobe", "-version", &[]).is_some();
    if !there {
        println!("skipped: ffmpeg with libx264, or ffprobe, is not installed");
    }
    there.then(|| tempfile::tempdir().unwrap())
}

fn film(at: PathBuf, words: &str) -> PathBuf {
    let words = format!("-v error -y {words} @");
    run("ffmpeg", &words, &[&at]).unwrap_or_else(|| panic!("ffmpeg makes {}: {words}", at.display()));
    at
}

/// A small moving picture in calm colours, with a tone.
const PICTURE: &str =
    "-f lavfi -i testsrc2=size=96x64:rate=30000/1001:duration=1.5,hue=s=0.3 -f lavfi -i sine=duration=1.7";
const ENCODED: &str = "-c:v libx264 -crf 8 -pix_fmt yuv420p -c:a aac";

fn open(film: &Path) -> Result<FilmReader, PrepareError> {
    let stop = AtomicBool::new(false);
    FilmReader::open(&Programs::default(), film, &StepWatch { stop: &stop, progress: &|_| (), note: &|_| () })
}

fn frames(film: &Path) -> Vec<FilmFrame> {
    open(film).unwrap().map(|frame| frame.unwrap()).collect()
}

/// Writes a film again, frame by frame as it is.
fn copy(from: &Path, to: &Path) -> Result<FilmWritten, PrepareError> {
    let reader = open(from)?;
    let choices = FilmChoices { quality: Some(8), ..FilmChoices::default() };
    let mut writer = FilmWriter::create(&Programs::default(), reader.info(), to, choices)?;
    for frame in reader {
        let frame = frame?;
        writer.write(&frame.rgb, frame.seconds)?;
    }
    writer.finish()
}

/// The digest of every audio packet.
fn audio(film: &Path) -> String {
    run("ffmpeg", "-v error -i @ -map 0:a -c copy -f streamhash -", &[film]).unwrap()
}

/// The words of ffprobe about the film in a file.
fn entries(film: &Path, names: &str) -> String {
    run(
        "ffprobe",
        &format!("-v error -select_streams v -show_entries {names} -of default=nk=1:nw=1 @"),
        &[film],
    )
    .unwrap()
}

/// The mean squared error as PSNR in dB, and the difference of the mean colours.
fn difference(a: &FilmFrame, b: &FilmFrame) -> (f64, [f64; 3]) {
    assert_eq!(a.rgb.len(), b.rgb.len());
    let (mut squares, mut means) = (0.0, [0.0; 3]);
    for (i, (&x, &y)) in a.rgb.iter().zip(&b.rgb).enumerate() {
        let d = f64::from(y) - f64::from(x);
        squares += d * d;
        means[i % 3] += d;
    }
    let n = a.rgb.len() as f64;
    let psnr = 10.0 * use3d_numerics::math::ln(255.0 * 255.0 * n / f64::max(squares, 1e-9))
        / std::f64::consts::LN_10;
    (psnr, means.map(|m| m / (n / 3.0)))
}

/// The same times and pictures nearly; the least PSNR.
fn same(a: &Path, b: &Path) -> f64 {
    let (a, b) = (frames(a), frames(b));
    assert_eq!(a.len(), b.len());
    let mut least = f64::INFINITY;
    for (x, y) in a.iter().zip(&b) {
        assert!((x.seconds - y.seconds).abs() < 1e-9, "{}: {} {}", x.number, x.seconds, y.seconds);
        let (psnr, means) = difference(x, y);
        assert!(means.iter().all(|m| m.abs() < 1.2), "{}: {means:?}", x.number);
        least = least.min(psnr);
    }
    least
}

/// The files in a folder.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
