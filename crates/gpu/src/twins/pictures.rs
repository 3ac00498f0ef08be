//! Compares pictures, and the linear splat with its adjoint, with those of the processor's rasterizer.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};
use use3d_training::EngineError;

use super::{Agreement, SceneSize, draws};
use crate::device::Gpu;
use crate::drawing::{Drawing, DrawnView};
use crate::linear::LinearSplat;

/// Number of channels of the linear splat here: two rounds, of which the second is not full.
const CHANNELS: usize = 5;

/// Compares the first view of a packed scene, drawn through its water with every layer, and random values
/// splatted and lifted.
///
/// # Errors
/// The device's driver failed.
pub fn pictures(gpu: &Gpu, scene: &SceneSize) -> Result<Vec<Agreement>, EngineError> {
    let cameras = scene.cameras()?;
    let Some(camera) = cameras.first() else { return Ok(Vec::new()) };
    let packed = scene.scene();
    let gaussians = &packed.gaussians;
    let lattice = Lattice::full(&camera.intrinsics);
    let mut maps = MediumMaps::zeros(0, 0);
    let wet = packed.look_through(camera, &lattice, &mut maps);
    let mut prepared = Prepared::new();

    let mut expected = Rendered::new();
    prepared.prepare(gaussians, camera, &lattice, Colors::Sh { degree: gaussians.sh_degree });
    let options = Options { layers: true, ..Options::default() };
    Rasterizer::new().forward(&prepared, wet.then_some(&maps), &options, &mut expected);
    let mut found = Rendered::new();
    let drawn =
        DrawnView { camera, lattice: &lattice, colors: None, medium: wet.then_some(&maps), layers: true };
    Drawing::new(gpu, gaussians)?.draw(&drawn, &mut found)?;
    let mut all = compare(&found, &expected);

    linear(gpu, scene, camera, &lattice, &prepared, &mut all)?;
    Ok(all)
}

/// Compares every array of both drawings; without layers if one of them has none.
pub(crate) fn compare(found: &Rendered, expected: &Rendered) -> Vec<Agreement> {
    let mut all = Vec::new();
    let mut push = |what: &str, device: &[f32], ours: &[f32]| {
        all.push(Agreement::of(format!("picture: {what}"), device, ours, 1e-5));
    };
    push("image", found.image.data(), expected.image.data());
    push("depth", found.depth.data(), expected.depth.data());
    push("accumulation", found.accumulation.data(), expected.accumulation.data());
    let (Some(found), Some(expected)) = (&found.layers, &expected.layers) else { return all };
    push("object", found.object.data(), expected.object.data());
    push("medium", found.medium.data(), expected.medium.data());
    push("far", found.far.data(), expected.far.data());
    push("clear", found.clear.data(), expected.clear.data());
    push("distance", found.distance.data(), expected.distance.data());
    all
}

fn linear(
    gpu: &Gpu,
    scene: &SceneSize,
    camera: &Camera,
    lattice: &Lattice,
    prepared: &Prepared,
    all: &mut Vec<Agreement>,
) -> Result<(), EngineError> {
    let gaussians = scene.state().gaussians;
    let (n, pixels) = (gaussians.len(), lattice.width() * lattice.height());
    let stream = draws("linear splat", scene.seed);
    let drawn =
        |from: usize, count: usize| (from..from + count).map(|i| stream.normal(i as u64) as f32).collect();
    let (x, y): (Vec<f32>, Vec<f32>) = (drawn(0, CHANNELS * n), drawn(CHANNELS * n, CHANNELS * pixels));
    let (mut splatted, mut lifted) = (vec![f32::NAN; y.len()], vec![f32::NAN; x.len()]);
    let mut linear = LinearSplat::new(gpu, &gaussians)?;
    linear.view(camera, lattice)?;
    linear.splat(CHANNELS, &x, &mut splatted)?;
    linear.adjoint(CHANNELS, &y, &mut lifted)?;
    let mut rasterizer = Rasterizer::new();
    let (mut splat, mut lift) = (vec![0.0; y.len()], vec![0.0; x.len()]);
    rasterizer.splat(prepared, CHANNELS, &x, &mut splat);
    rasterizer.splat_adjoint(prepared, CHANNELS, &y, &mut lift);
    all.push(Agreement::of("linear splat", &splatted, &splat, 1e-5));
    all.push(Agreement::of("its adjoint", &lifted, &lift, 1e-5));
    Ok(())
}
