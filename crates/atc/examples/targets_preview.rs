//! Computes targets of a capture without a reconstruction: its sparse points become Gaussians.
//! `targets_preview CAPTURE_DIR CALIBRATOR OUT_DIR [GAUSSIANS]` writes side-by-side pictures (captured,
//! proposal, calibrated view by view, consensus) and support maps of a few views, and prints dispersion,
//! order effects and times.

use std::cell::Cell;
use std::path::Path;
use std::time::{Duration, Instant};

use use3d_atc::AtcError;
use use3d_atc::calibrator::Calibrator;
use use3d_atc::consensus::{
    Lift, Preview, Proposals, Recorder, TargetsParams, ViewInput, ViewRecord, targets_from_records,
};
use use3d_atc::progress::unwatched;
use use3d_atc::proposers::{Fusion, Proposer};
use use3d_capture::{Appearance, KeptWater, SparsePoint, View};
use use3d_import::{ImportParams, import, load_pixels};
use use3d_io_image::{write_png, write_png_map};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Gaussians, Rasterizer};

/// Isotropic Gaussians of the size of the gaps between the points. Jittered copies make up the number if it
/// exceeds the number of points.
fn gaussians(points: &[SparsePoint], count: usize) -> Gaussians {
    let stream = Stream::new(1, Purpose::new("jittered points"), 0);
    let copies = count.div_ceil(points.len().max(1)).max(1);
    let mut out = Gaussians::empty(0);
    for (i, point) in points.iter().enumerate() {
        let mut nearest = [f64::INFINITY; 3];
        for (j, other) in points.iter().enumerate() {
            let d = (other.position - point.position).length_squared();
            if j != i && d < nearest[2] {
                nearest[2] = d;
                nearest.sort_unstable_by(f64::total_cmp);
            }
        }
        let gap = (nearest.iter().sum::<f64>() / 3.0).sqrt().clamp(1e-4, 0.1);
        for copy in 0..copies {
            let index = (i * copies + copy) as u64;
            let spread = if copy == 0 { 0.0 } else { gap };
            out.means.push(std::array::from_fn(|k| {
                (point.position[k] + spread * stream.normal(3 * index + k as u64)) as f32
            }));
            out.log_scales.push([math::ln(gap * 0.8 / math::cbrt(copies as f64)) as f32; 3]);
            out.quaternions.push([1.0, 0.0, 0.0, 0.0]);
            out.opacity_logits.push(1.0);
            out.sh.push([[0.0; 3]; 16]);
        }
    }
    out
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [capture, calibrator, out, rest @ ..] = arguments.as_slice() else {
        return Err("usage: targets_preview CAPTURE_DIR CALIBRATOR OUT_DIR [GAUSSIANS]".into());
    };
    let calibrator = Calibrator::from_bytes(&std::fs::read(calibrator)?)?;
    let capture = import(Path::new(capture), &ImportParams::default())?.capture;
    let count = rest.first().map_or(Ok(capture.points.len()), |n| n.parse())?;
    let scene = gaussians(&capture.points, count);
    let views: Vec<&View> = capture.split.train.iter().map(|&i| &capture.views[i]).collect();
    let loading = Cell::new(Duration::ZERO);
    let load = |view: &View| -> Result<ViewInput, AtcError> {
        let started = Instant::now();
        let pixels = load_pixels(view)
            .map_err(|e| AtcError::View { view: view.name.to_string(), problem: e.to_string() })?;
        let input = ViewInput {
            name: view.stem().to_string(),
            camera: view.camera,
            image: pixels.to_image(),
            proposal: None,
        };
        loading.set(loading.get() + started.elapsed());
        Ok(input)
    };
    let started = Instant::now();
    let proposals = Proposals::From(&Fusion);
    let mut recorder = Recorder::default();
    let mut records: Vec<ViewRecord> = Vec::new();
    for view in &views {
        records.push(recorder.record(&load(view)?, proposals, &calibrator)?);
    }
    let extracted = started.elapsed();
    let params = TargetsParams::default();
    let (targets, report) = targets_from_records(
        &mut Lift::new(&scene),
        &records,
        (Appearance::Water, KeptWater::ALL),
        Fusion.id(),
        &calibrator,
        &params,
        &mut unwatched,
    )?;
    println!(
        "{} views, {} Gaussians, {} supported: {:.1} s (loading images {:.1} s, extraction {:.1} s, lifting {:.1} s)",
        views.len(),
        report.gaussians,
        report.supported,
        started.elapsed().as_secs_f64(),
        loading.get().as_secs_f64(),
        (extracted - loading.get()).as_secs_f64(),
        (started.elapsed() - extracted).as_secs_f64()
    );
    println!("dispersion {:.4} (norm over 30 responses)", report.dispersion);
    println!("scene operator {:.3?}", targets.scene);
    let params = TargetsParams { measure_order: true, ..params };
    let (_, shuffled) = targets_from_records(
        &mut Lift::new(&scene),
        &records,
        (Appearance::Water, KeptWater::ALL),
        Fusion.id(),
        &calibrator,
        &params,
        &mut unwatched,
    )?;
    println!("shuffled views: {:?}", shuffled.order);

    std::fs::create_dir_all(out)?;
    let mut rasterizer = Rasterizer::new();
    for v in (0..views.len()).step_by(views.len().div_ceil(4)) {
        let input = load(views[v])?;
        let preview =
            Preview::new(&scene, &input, &records[v], proposals, &calibrator, &targets, &mut rasterizer)?;
        let name = input.name.replace('/', "_");
        write_png(&Path::new(out).join(format!("{name}.png")), &preview.sheet())?;
        write_png_map(&Path::new(out).join(format!("{name}_support.png")), &preview.support)?;
    }
    Ok(())
}
