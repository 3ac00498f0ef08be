//! Tests of the times of frames that are taken out of a film of variable rate, with the real ffmpeg.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;

use super::{look, write};
use crate::footage::{FilmReader, known_frames};
use crate::prepare::digest;
use crate::process::StepWatch;
use crate::tools::Programs;

/// A film whose second half has every fourth frame; false if ffmpeg cannot make it.
fn uneven(at: &Path) -> bool {
    let picture = "-v error -f lavfi -i testsrc2=size=160x96:rate=25:duration=4";
    let words =
        format!("{picture} -vf select='lt(n,50)+not(mod(n,4))' -fps_mode vfr -c:v libx264 -pix_fmt yuv420p");
    let made = Command::new("ffmpeg").args(words.split(' ')).arg(at).stdin(Stdio::null()).status();
    made.is_ok_and(|status| status.success())
}

#[test]
fn chosen_frames_have_the_time_stamps_of_the_whole_film() {
    let dir = tempfile::tempdir().unwrap();
    let film = dir.path().join("uneven.mp4");
    let programs = Programs::default();
    if !uneven(&film) || programs.probe().is_err() {
        println!("skipped: ffmpeg with libx264, or ffprobe, is not installed");
        return;
    }
    let stop = AtomicBool::new(false);
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
    let frames = FilmReader::open(&programs, &film, &watch).unwrap();
    let times: Vec<f64> = frames.map(|frame| frame.unwrap().seconds).collect();
    let (ffmpeg, log) = (programs.film().unwrap(), dir.path().join("log.txt"));
    let mut choice = look(&ffmpeg, &film, 12, &log, &watch).unwrap();
    let folder = dir.path().join("images");
    std::fs::create_dir(&folder).unwrap();
    let name = |number: u64| format!("f_{number:06}.jpg");
    let paths: Vec<PathBuf> = choice.frames.iter().map(|f| folder.join(name(f.number))).collect();
    write(&ffmpeg, &mut choice, (&folder, &paths), &log, &watch).unwrap();
    assert!(choice.frames.len() > 2 && choice.frames.iter().any(|f| f.number > 52), "{:?}", choice.frames);
    for frame in &choice.frames {
        let stamp = times[frame.number as usize];
        assert!(frame.stamped && (frame.seconds - stamp).abs() < 2e-6, "{frame:?} {stamp}");
    }
    assert!(paths.iter().all(|path| path.is_file()));
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), paths.len(), "only frames are in the folder");

    // The record of an older version has computed times, which are wrong for this film.
    let images = choice.frames.iter().map(|f| {
        serde_json::json!({ "image": name(f.number), "film": "uneven.mp4", "frame": f.number, "seconds": 0.01 })
    });
    let bytes = std::fs::metadata(&film).unwrap().len();
    let digest = digest(&film, &watch).unwrap();
    let input = serde_json::json!({ "name": "uneven.mp4", "bytes": bytes, "modified": 1, "digest": digest });
    let record = serde_json::json!({ "inputs": [input], "images": images.collect::<Vec<_>>() });
    std::fs::write(dir.path().join("prepare.json"), record.to_string()).unwrap();
    let known = known_frames(&programs, dir.path(), &film, &watch).unwrap();
    assert_eq!(known.len(), choice.frames.len());
    for (known, frame) in known.iter().zip(&choice.frames) {
        assert_eq!((known.number, known.photograph.as_str()), (Some(frame.number), &*name(frame.number)));
        assert!((known.seconds - frame.seconds).abs() < 2e-6, "{known:?} {frame:?}");
    }
}
