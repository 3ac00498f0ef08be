//! Measures a scene's targets at full size: 40 views of 1400 × 933 and 500,000 Gaussians, including the
//! classical proposer. One run, in seconds.

use std::time::Instant;

use glam::DVec3;
use use3d_atc::calibrator::Calibrator;
use use3d_atc::consensus::{Lift, Proposals, Recorder, TargetsParams, ViewInput, targets_from_records};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::progress::unwatched;
use use3d_atc::proposers::{Fusion, Proposer};
use use3d_capture::{Appearance, Camera, Image, Intrinsics, KeptWater, Pose};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::Gaussians;

const VIEWS: usize = 40;
const GAUSSIANS: usize = 500_000;
const SIZE: (usize, usize) = (1400, 933);

fn scene() -> Gaussians {
    let draw = Stream::new(1, Purpose::new("consensus bench"), 0);
    let u = |i: usize, k: usize| draw.uniform((i * 12 + k) as u64) as f32;
    let mut gaussians = Gaussians::empty(0);
    for i in 0..GAUSSIANS {
        gaussians.means.push([2.4 * u(i, 0) - 1.2, 1.6 * u(i, 1) - 0.8, 0.5 * u(i, 2)]);
        gaussians.log_scales.push(std::array::from_fn(|k| -5.8 + u(i, 3 + k)));
        gaussians.quaternions.push([1.0, u(i, 6), u(i, 7), u(i, 8)]);
        gaussians.opacity_logits.push(5.0 * u(i, 9) - 1.0);
        gaussians.sh.push([[0.4 * u(i, 10) - 0.2; 3]; 16]);
    }
    gaussians
}

fn view(index: usize) -> ViewInput {
    let (width, height) = SIZE;
    let side = 0.6 * (index as f64 / (VIEWS - 1) as f64 - 0.5);
    let eye = DVec3::new(side, 0.1 * math::sin(index as f64), -1.6);
    let pose = Pose::look_at(eye, DVec3::new(0.3 * side, 0.0, 0.3), DVec3::NEG_Y);
    let intrinsics = Intrinsics { width, height, fx: 1000.0, fy: 1000.0, cx: 700.0, cy: 466.0 };
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let t = |k: f32| {
                0.5 + 0.4 * math::sin(0.013 * x as f32 + k + 0.2 * index as f32) * math::cos(0.011 * y as f32)
            };
            image.set_pixel(x, y, [0.3 * t(0.0), 0.8 * t(1.0), t(2.0)]);
        }
    }
    ViewInput { name: format!("{index:04}"), camera: Camera { intrinsics, pose }, image, proposal: None }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let calibrator = Calibrator::identity(ExtractorSettings::default(), Fusion.id());
    let gaussians = scene();
    let (mut recorder, mut records) = (Recorder::default(), Vec::new());
    let mut proposing = 0.0;
    for index in 0..VIEWS {
        let view = view(index);
        let started = Instant::now();
        records.push(recorder.record(&view, Proposals::From(&Fusion), &calibrator)?);
        proposing += started.elapsed().as_secs_f64();
    }
    let started = Instant::now();
    let params = TargetsParams::default();
    let (_, report) = targets_from_records(
        &mut Lift::new(&gaussians),
        &records,
        (Appearance::Water, KeptWater::ALL),
        Fusion.id(),
        &calibrator,
        &params,
        &mut unwatched,
    )?;
    println!(
        "{VIEWS} views of {}x{}, {GAUSSIANS} Gaussians ({} supported): proposals and transitions {proposing:.1} s, consensus {:.1} s",
        SIZE.0,
        SIZE.1,
        report.supported,
        started.elapsed().as_secs_f64()
    );
    Ok(())
}
