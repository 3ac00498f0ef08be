//! Tests of films as cameras and consoles write them, with the real ffmpeg: what never moves, interlaced
//! films, a cover before the film, an uneven rate, a film without its index.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;

use super::{Choice, look, write};
use crate::footage::{FilmReader, known_frames};
use crate::process::StepWatch;
use crate::tools::Programs;
use crate::work::digest;

/// A film whose second half has every fourth frame; false if ffmpeg cannot make it.
fn uneven(at: &Path) -> bool {
    let picture = "-v error -f lavfi -i testsrc2=size=160x96:rate=25:duration=4";
    let words =
        format!("{picture} -vf select='lt(n,50)+not(mod(n,4))' -fps_mode vfr -c:v libx264 -pix_fmt yuv420p");
    let made = Command::new("ffmpeg").args(words.split(' ')).arg(at).stdin(Stdio::null()).status();
    made.is_ok_and(|status| status.success())
}

#[test]
fn film_vfr_times() {
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
    let mut choice = look(&ffmpeg, &film, (12, None), &log, &watch).unwrap();
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

/// The size and the number of the frames of a test film.
const W: usize = 320;
const H: usize = 180;
const COUNT: usize = 50;

/// The brightness of a sea floor below a camera that swims over it.
fn floor(x: usize, y: usize, frame: usize) -> u8 {
    let block = |side: usize| {
        let (u, v) = ((x + 5 * frame) / side, y / side);
        (u.wrapping_mul(7919) ^ v.wrapping_mul(104_729)).wrapping_mul(2_654_435_761) >> 16 & 0xFF
    };
    (70 + (block(5) + block(17) + block(41)) / 9) as u8
}

/// Writes a film of a swim with something over all frames; false if ffmpeg cannot.
fn swim(at: &Path, over: impl Fn(usize, usize) -> Option<u8>, words: &str) -> bool {
    let from = format!("-v error -y -f rawvideo -pix_fmt gray -s {W}x{H} -r 25 -i - {words}");
    let command = Command::new("ffmpeg").args(from.split(' ')).arg(at).stdin(Stdio::piped()).spawn();
    let Ok(mut child) = command else { return false };
    let pixels = |frame: usize| {
        let all = (0..W * H).map(move |i| (i % W, i / W));
        all.map(|(x, y)| over(x, y).unwrap_or_else(|| floor(x, y, frame))).collect::<Vec<u8>>()
    };
    let mut stdin = child.stdin.take().unwrap();
    let written = (0..COUNT).all(|frame| stdin.write_all(&pixels(frame)).is_ok());
    drop(stdin);
    written && child.wait().is_ok_and(|status| status.success())
}

const H264: &str = "-c:v libx264 -crf 14 -pix_fmt yuv420p";

/// The frames that are chosen of a film, written into a folder.
fn taken(film: &Path, dir: &Path) -> (Choice, Vec<PathBuf>) {
    let stop = AtomicBool::new(false);
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
    let (ffmpeg, log) = (Programs::default().film().unwrap(), dir.join("log.txt"));
    let mut choice = look(&ffmpeg, film, (200, Some(0.975)), &log, &watch).unwrap();
    let folder = dir.join(film.file_stem().unwrap());
    std::fs::create_dir(&folder).unwrap();
    let paths: Vec<PathBuf> =
        choice.frames.iter().map(|f| folder.join(format!("f_{:06}.jpg", f.number))).collect();
    write(&ffmpeg, &mut choice, (&folder, &paths), &log, &watch).unwrap();
    (choice, paths)
}

fn can_encode(dir: &Path) -> bool {
    let can = Programs::default().probe().is_ok() && swim(&dir.join("try.mp4"), |_, _| None, H264);
    if !can {
        println!("skipped: ffmpeg with libx264, or ffprobe, is not installed");
    }
    can
}

#[test]
fn film_static_parts() {
    let dir = tempfile::tempdir().unwrap();
    if !can_encode(dir.path()) {
        return;
    }
    let plain = taken(&dir.path().join("try.mp4"), dir.path()).0;
    assert!(plain.overlay.is_none() && plain.frames.len() > 5, "{}", plain.frames.len());
    type Over = fn(usize, usize) -> Option<u8>;
    // The size of the frames between the bars.
    let films: [(&str, Over, (usize, usize)); 4] = [
        ("bars", |_, y| (!(8..H - 8).contains(&y)).then_some(0), (W, H - 20)),
        ("upright", |x, _| (!(100..220).contains(&x)).then_some(0), (116, H)),
        ("banner", |x, y| (y < 24).then_some(if (x / 6 + y / 5) % 2 == 0 { 250 } else { 0 }), (W, H)),
        ("gripper", |x, y| ((130..190).contains(&x) && y > 110).then_some(230 - (x % 7) as u8), (W, H)),
    ];
    for (name, over, size) in films {
        let film = dir.path().join(format!("{name}.mp4"));
        assert!(swim(&film, over, H264));
        let (choice, paths) = taken(&film, dir.path());
        let (found, wanted) = (choice.frames.len(), plain.frames.len());
        assert!(10 * found >= 9 * wanted && !choice.stands, "{name}: {found} frames, and {wanted} without");
        let written = use3d_io_image::image_size(&paths[0]).unwrap();
        let near = written.0.abs_diff(size.0) <= 4 && written.1.abs_diff(size.1) <= 4;
        assert!(near && choice.overlay.is_some(), "{name}: {written:?} in place of {size:?}");
    }
    // A camera on a tripod gives hardly any frame, and is named.
    let still = dir.path().join("still.mp4");
    assert!(swim(&still, |x, y| Some(floor(x, y, 0)), H264));
    let choice = taken(&still, dir.path()).0;
    assert!(choice.stands && choice.why_few().contains("does not move"), "{}", choice.why_few());
}

#[test]
fn film_interlaced() {
    let dir = tempfile::tempdir().unwrap();
    if !can_encode(dir.path()) {
        return;
    }
    let film = dir.path().join("camcorder.mts");
    let words = "-vf tinterlace=mode=interleave_top,setfield=tff -c:v mpeg2video -flags +ildct+ilme -q:v 2";
    assert!(swim(&film, |_, _| None, words));
    let (choice, paths) = taken(&film, dir.path());
    assert!(choice.film.remarks()[0].contains("interlaced"));
    // In a frame of two half pictures, lines are more like the next but one than like the next.
    let image = use3d_io_image::read_image(paths.last().unwrap()).unwrap();
    let differs = |lines: usize| -> f32 {
        let green = image.plane(1);
        (0..W * (H - 4)).map(|i| (green[i] - green[i + lines * W]).abs()).sum()
    };
    assert!(differs(1) < 0.8 * differs(2), "{} {}", differs(1), differs(2));
}

#[test]
fn film_thumbnail_first() {
    let dir = tempfile::tempdir().unwrap();
    if !can_encode(dir.path()) {
        return;
    }
    let made = |words: String| {
        Command::new("ffmpeg")
            .args(words.split(' '))
            .current_dir(dir.path())
            .status()
            .is_ok_and(|s| s.success())
    };
    let first = "-v error -f lavfi -i testsrc2=size=120x68:rate=1:duration=1 -frames:v 1 cover.jpg";
    assert!(made(first.into()));
    let both = "-v error -framerate 90000 -i cover.jpg -i try.mp4 -map 0:v -map 1:v -c copy -video_track_timescale 90000";
    assert!(made(format!("{both} drone.mp4")));
    let [alone, with_cover] =
        ["try.mp4", "drone.mp4"].map(|name| taken(&dir.path().join(name), dir.path()).0);
    let numbers = |choice: &Choice| choice.frames.iter().map(|f| f.number).collect::<Vec<_>>();
    assert_eq!(numbers(&with_cover), numbers(&alone));
}

#[test]
fn film_no_index() {
    let dir = tempfile::tempdir().unwrap();
    if !can_encode(dir.path()) {
        return;
    }
    let bytes = std::fs::read(dir.path().join("try.mp4")).unwrap();
    let stop = AtomicBool::new(false);
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
    let (ffmpeg, log) = (Programs::default().film().unwrap(), dir.path().join("log.txt"));
    for (part, words) in [(bytes.len() * 7 / 10, "was not finished"), (0, "is empty")] {
        let film = dir.path().join("dive.mp4");
        std::fs::write(&film, &bytes[..part]).unwrap();
        let refused = look(&ffmpeg, &film, (12, None), &log, &watch).err().unwrap().to_string();
        assert!(refused.contains(words) && refused.contains("dive.mp4"), "{refused}");
    }
}
