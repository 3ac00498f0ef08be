//! Overlays that are drawn into real photographs are found, and nothing is found in the photographs
//! themselves. Needs real captures, with one folder `images` in each:
//!
//! ```text
//! USE3D_DATA=captures/ cargo test --workspace --test overlays -- --nocapture
//! ```

use std::path::{Path, PathBuf};

use image::codecs::jpeg::JpegEncoder;
use use3d_capture::Image8;
use use3d_io_image::{read_image, shrunk};
use use3d_overlay::{Still, find};

/// The photographs of a capture that are used, at most, and their longer side.
const MOST: usize = 30;
const SIDE: usize = 640;
const QUALITY: u8 = 88;

/// The colour of an overlay at a place, in shares of the sides, of a picture with this number.
type Over = fn(f64, f64, usize) -> Option<[u8; 3]>;

/// A line of blocks like letters that are 2.4 % of the height, and a clock behind them.
fn letters(x: f64, y: f64, picture: usize) -> bool {
    let (column, row) = ((x * 240.0) as usize, (y * 170.0) as usize);
    let clock = if x > 0.24 { picture } else { 0 };
    (5..68).contains(&column)
        && (5..9).contains(&row)
        && !(column / 2 * 7 + row * 5 + clock).is_multiple_of(3)
}

/// The overlays, with the smallest share of each that must be found.
const OVERLAYS: [(&str, f64, Over); 6] = [
    ("text", 0.8, |x, y, i| letters(x, y, i).then_some([255; 3])),
    ("text in a box", 0.95, |x, y, i| {
        let inside = (0.015..0.29).contains(&x) && (0.02..0.065).contains(&y);
        inside.then(|| [if letters(x, y, i) { 255 } else { 0 }; 3])
    }),
    ("bars of 4 %", 0.98, |_, y, _| (!(0.04..0.96).contains(&y)).then_some([0; 3])),
    ("bars of 12 %", 0.98, |_, y, _| (!(0.12..0.88).contains(&y)).then_some([0; 3])),
    ("gripper and frame", 0.95, |x, y, _| {
        let jaw = |from: f64| (from..from + 0.08).contains(&(x + 0.2 * (y - 0.7))) && y > 0.7;
        let frame = (y > 0.93).then_some([60, 60, 66]);
        frame.or_else(|| (jaw(0.3) || jaw(0.56)).then_some([190, 160, 40]))
    }),
    ("sharp rim", 0.95, |x, y, _| {
        let away = (x - 0.5) * (x - 0.5) + (y - 0.5) * (y - 0.5);
        (away > 0.86 * 0.86 * 0.5).then_some([2; 3])
    }),
];

/// A picture with an overlay, as a JPEG keeps it.
fn drawn(picture: &Image8, over: Over, number: usize) -> Still {
    let (w, h) = (picture.width(), picture.height());
    let mut pixels = picture.to_interleaved();
    for (i, pixel) in pixels.chunks_exact_mut(3).enumerate() {
        let (x, y) = ((i % w) as f64 / w as f64, (i / w) as f64 / h as f64);
        if let Some(color) = over(x, y, number) {
            pixel.copy_from_slice(&color);
        }
    }
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, QUALITY);
    encoder.encode(&pixels, w as u32, h as u32, image::ExtendedColorType::Rgb8).unwrap();
    let decoded = image::load_from_memory(&bytes).unwrap().to_rgb8();
    Still::of(&Image8::from_interleaved(w, h, &decoded).unwrap())
}

/// The photographs of a capture, shrunk.
fn photographs(folder: &Path) -> Vec<Image8> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.iter().take(MOST).map(|file| shrunk(&read_image(file).unwrap(), SIDE)).collect()
}

#[test]
fn overlays_in_real_photographs_are_found_and_nothing_else() {
    let Some(data) = std::env::var_os("USE3D_DATA") else {
        println!("SKIPPED, no real photograph was looked at: USE3D_DATA is not set");
        return;
    };
    for name in ["reef_deepreefmap", "vent_sucre", "iui3", "fern"] {
        let folder = Path::new(&data).join(name).join("images");
        if !folder.is_dir() {
            println!("SKIPPED: {} is not there", folder.display());
            continue;
        }
        let pictures = photographs(&folder);
        let sound: Vec<Still> = pictures.iter().map(Still::of).collect();
        assert_eq!(find(&sound), None, "{name}");
        for (what, least, over) in OVERLAYS {
            let stills: Vec<Still> = (0..).zip(&pictures).map(|(i, p)| drawn(p, over, i)).collect();
            let found = find(&stills).unwrap_or_else(|| panic!("{name}: {what} is not found"));
            let (w, h) = (found.width, found.height);
            let (mut right, mut wrong, mut all) = (0.0, 0.0, 0.0);
            for (i, hidden) in found.hidden.iter().enumerate() {
                let over = over((i % w) as f64 / w as f64, (i / w) as f64 / h as f64, 0).is_some();
                all += f64::from(u8::from(over));
                right += f64::from(u8::from(over && *hidden));
                wrong += f64::from(u8::from(!over && *hidden));
            }
            let (share, more) = (right / all, wrong / found.hidden.len() as f64);
            println!("{name}: {what}: {:.0} % found, {:.1} % more is hidden", 100.0 * share, 100.0 * more);
            assert!(share >= least && more < 0.02, "{name}: {what}: {share} {more}");
        }
    }
}
