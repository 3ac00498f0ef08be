//! Enhances photographs with the classical proposer: `fusion OUT_DIR IMAGE...` writes each result beside
//! its original.

use std::path::Path;
use std::time::Instant;

use use3d_atc::consensus::side_by_side;
use use3d_atc::proposers::{Fusion, Proposer};
use use3d_io_image::{read_image, write_png};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = arguments.next().ok_or("usage: fusion OUT_DIR IMAGE...")?;
    std::fs::create_dir_all(&out)?;
    for path in arguments {
        let captured = read_image(Path::new(&path))?;
        let started = Instant::now();
        let enhanced = Fusion.propose(&captured)?;
        println!(
            "{path}: {}x{}, {:.0} ms",
            captured.width(),
            captured.height(),
            started.elapsed().as_secs_f64() * 1e3
        );
        let stem = Path::new(&path).file_stem().ok_or("no file name")?.to_string_lossy();
        write_png(&Path::new(&out).join(format!("{stem}.png")), &side_by_side(&[&captured, &enhanced]))?;
    }
    Ok(())
}
