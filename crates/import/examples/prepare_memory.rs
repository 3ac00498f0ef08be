//! Measures the memory and the time that the preparation of a large capture needs: 300 JPEGs of 1920x1080
//! taken with a distorting lens.
//!
//! `cargo run --release -p use3d-import --example prepare_memory [VIEWS] [THREADS]` makes the capture in a
//! temporary folder, prepares it, and prints the peak resident memory (on Linux) before and after, and the
//! time.

use std::time::Instant;

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Image, NameError, Pose};
use use3d_import::{ImportParams, import, prepare};
use use3d_io_colmap::{LensModel, Model, ModelCamera, ModelImage, write_model_binary};
use use3d_numerics::math;

const SIZE: (usize, usize) = (1920, 1080);

/// The peak resident memory so far, MiB.
fn peak() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM"))?;
    Some(line.split_ascii_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let views: usize = arguments.next().map_or(Ok(300), |v| v.parse())?;
    let threads: usize = arguments.next().map_or(Ok(0), |v| v.parse())?;
    let dir = tempfile::tempdir()?;
    let (capture, out) = (dir.path().join("capture"), dir.path().join("out"));

    // One textured picture. Every view is a link to it, so that making the capture is quick, but reading it
    // is not.
    let mut picture = Image::new(SIZE.0, SIZE.1);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            let (u, v) = (x as f32 * 0.02, y as f32 * 0.02);
            let speckle = ((x * 7919 + y * 104_729) % 61) as f32 / 600.0;
            picture.set_pixel(x, y, [0.2 + 0.1 * math::sin(u), 0.45 + 0.2 * math::cos(u + v), 0.5 + speckle]);
        }
    }
    std::fs::create_dir_all(capture.join("images"))?;
    let first = capture.join("images/f0000.jpg");
    let rgb = image::RgbImage::from_raw(SIZE.0 as u32, SIZE.1 as u32, picture.to_8bit().to_interleaved());
    rgb.ok_or("the picture has its own size")?.save(&first)?;
    for i in 1..views {
        std::fs::hard_link(&first, capture.join(format!("images/f{i:04}.jpg")))?;
    }
    let parameters = vec![1300.0, 960.0, 540.0, 0.12, 0.03];
    let camera = ModelCamera { id: 1, model: LensModel::Radial, width: SIZE.0, height: SIZE.1, parameters };
    let pose = |i: usize| Pose::from_center(DMat3::IDENTITY, DVec3::new(i as f64, 0.0, 0.0));
    let images = (0..views)
        .map(|i| Ok(ModelImage::at(i as u32 + 1, FileName::new(&format!("f{i:04}.jpg"))?, 1, &pose(i))));
    let model = Model {
        cameras: vec![camera],
        images: images.collect::<Result<_, NameError>>()?,
        points: Vec::new(),
    };
    write_model_binary(&capture.join("sparse/0"), &model)?;
    drop(picture);

    let started = Instant::now();
    let imported = import(&capture, &ImportParams::default())?;
    print!("{}", imported.report);
    println!(
        "import: {:.2} s, peak memory so far {:.0} MiB",
        started.elapsed().as_secs_f64(),
        peak().unwrap_or(f64::NAN)
    );
    let started = Instant::now();
    prepare(&imported, &out, threads, &|_, _| true)?;
    let seconds = started.elapsed().as_secs_f64();
    println!(
        "prepare: {seconds:.1} s ({:.0} ms per view), peak memory {:.0} MiB",
        1000.0 * seconds / views as f64,
        peak().unwrap_or(f64::NAN)
    );
    Ok(())
}
