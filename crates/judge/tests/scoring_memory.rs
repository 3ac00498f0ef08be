//! Measures the memory that scoring an image needs in addition to the images. It is the only test of its
//! process, because it reads the peak memory of the process.

use use3d_capture::Image;
use use3d_judge::scoring::Judges;

/// The peak memory of this process, bytes; `None` if the system does not report it.
fn peak() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| 1024 * kib)
}

/// Bands of colour with structure at every scale.
fn picture(width: usize, height: usize, shift: usize) -> Image {
    let mut image = Image::new(width, height);
    for c in 0..3 {
        for (i, v) in image.plane_mut(c).iter_mut().enumerate() {
            *v = (((i * 31 + i / width * 17 + shift) % 251) + 2 * c) as f32 / 257.0;
        }
    }
    image
}

#[test]
fn scoring_takes_a_few_bytes_a_pixel_beside_the_images() {
    let (width, height) = (3000, 2000);
    let judges = Judges::open(None);
    // Threads and tables that are made once exist before the measurement.
    let small = picture(64, 48, 3);
    judges.alone(&small, None);
    judges.against(&small, &picture(64, 48, 9), None);
    let (image, reference) = (picture(width, height, 3), picture(width, height, 9));
    let Some(before) = peak() else { return };
    let alone = judges.alone(&image, None);
    let between = peak().unwrap_or(0);
    let against = judges.against(&image, &reference, None);
    let after = peak().unwrap_or(0);
    for (scores, names) in [(&alone, ["uciqe", "uiqm"]), (&against, ["psnr", "ssim"])] {
        assert!(names.iter().all(|name| scores[*name].value().is_some()), "{scores:?}");
    }
    let pixels = (width * height) as f64;
    let per_pixel = |from: u64, to: u64| (to - from) as f64 / pixels;
    println!(
        "bytes a pixel beside the images: alone {:.1}, against a reference {:.1} more",
        per_pixel(before, between),
        per_pixel(between, after)
    );
    // Eight bits of each channel and of its CIELAB: six bytes. A comparison with a reference copies nothing.
    let allowed = |compared: bool| judges.bytes_per_pixel(compared) as f64 + 2.0;
    assert!(per_pixel(before, between) <= allowed(false), "{}", per_pixel(before, between));
    assert!(per_pixel(between, after) <= allowed(true), "{}", per_pixel(between, after));
    assert_eq!((judges.bytes_per_pixel(false), judges.bytes_per_pixel(true)), (6, 0));
}
