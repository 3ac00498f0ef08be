//! Measures the memory that `evaluate --images` takes, for each file format.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use use3d_capture::Image;
use use3d_io_image::{ImageError, write_exr, write_png, write_png16};

const SIZE: (usize, usize) = (2400, 1600);

/// The most memory that the process has held so far, in bytes; `None` after its end.
fn peak(process: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| 1024 * kib)
}

/// The most memory that scoring a folder takes.
fn scored(images: &Path, reference: &Path) -> u64 {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(["--threads", "2", "evaluate", "--json", "--images"]).arg(images);
    command.arg("--reference").arg(reference).env_remove("USE3D_MODELS").current_dir(images);
    let mut child = command.stdout(Stdio::null()).spawn().expect("the command starts");
    let mut most = 0;
    loop {
        most = most.max(peak(child.id()).unwrap_or(0));
        if let Some(status) = child.try_wait().expect("a state") {
            assert!(status.success(), "{status}");
            return most;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Bands of colour; another shift gives a slightly different picture.
fn picture((width, height): (usize, usize), shift: usize) -> Image {
    let mut image = Image::new(width, height);
    for c in 0..3 {
        for (i, v) in image.plane_mut(c).iter_mut().enumerate() {
            *v = ((i / 7 + i / width * 3 + shift) % 251 + 2 * c) as f32 / 257.0;
        }
    }
    image
}

type Write = fn(&Path, &Image) -> Result<(), ImageError>;

#[test]
fn two_pictures_and_what_decoding_one_takes_are_all_there_is() {
    let dir = tempfile::tempdir().expect("a folder");
    let folders = |kind: &str| ["a", "b"].map(|name| dir.path().join(kind).join(name));
    let made = |kind: &str, extension: &str, size, write: Write| {
        for (i, folder) in folders(kind).iter().enumerate() {
            std::fs::create_dir_all(folder).expect("a folder");
            write(&folder.join(format!("one.{extension}")), &picture(size, 5 * i)).expect("written");
        }
        let [images, reference] = folders(kind);
        scored(&images, &reference)
    };
    let alone = made("tiny", "png", (64, 48), write_png);
    for (kind, extension, write, most) in [
        ("8 bits", "png", write_png as Write, 31.0),
        ("16 bits", "png", |path, image| write_png16(path, &image.map(|v| (v * 65535.0) as u16)), 34.0),
        ("floats", "exr", write_exr, 40.0),
    ] {
        let taken = made(kind, extension, SIZE, write).saturating_sub(alone);
        let per_pixel = taken as f64 / (SIZE.0 * SIZE.1) as f64;
        println!("{kind}: {per_pixel:.1} bytes a pixel");
        // The command's own estimate is 40: two pictures, and four floats.
        assert!(per_pixel < most, "{kind}: {per_pixel} bytes a pixel");
        // At least the two pictures, or nothing was measured.
        assert!(per_pixel > 23.0, "{kind}: {per_pixel} bytes a pixel");
    }
}
