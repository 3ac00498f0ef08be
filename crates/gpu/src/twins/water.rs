//! Compares the water of a view: maps, gradients, Adam.

use use3d_capture::{Camera, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_medium::{MediumGlobal, MediumModel, MediumRbf, Role};
use use3d_numerics::adam::Adam;
use use3d_training::EngineError;

use super::{Agreement, draws, poison};
use crate::buffer::Array;
use crate::constants::counts;
use crate::device::Gpu;
use crate::kernel::submit;
use crate::raster::WATER_PLANES;
use crate::water::DeviceWater;

/// A view and its water to compare.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WaterCase {
    /// Number of pixels across.
    pub width: usize,
    /// Number of pixels down.
    pub height: usize,
    /// The seed of its draws.
    pub seed: u64,
    /// Number of anchors; 0 for one set of harmonics.
    pub anchors: usize,
    /// Number of anchors that share the view.
    pub top_k: usize,
    /// Active degree.
    pub degree: usize,
}

const STEP: u64 = 11;
const RATES: [f64; 2] = [2.5e-3, 1.25e-4];

/// Compares maps, derivatives and one step of Adam.
pub fn water(gpu: &Gpu, case: &WaterCase) -> Result<Vec<Agreement>, EngineError> {
    let WaterCase { width, height, seed, anchors, top_k, degree } = *case;
    let stream = draws("twin of the water", seed);
    let normal = |run: u64, i: usize| stream.normal(run * 100_000_000 + i as u64) as f32;
    let mut model = match anchors {
        0 => MediumModel::Global(MediumGlobal::default()),
        n => MediumModel::Rbf(MediumRbf::new(n, top_k)),
    };
    let start: Vec<f32> = model.flat().iter().enumerate().map(|(i, v)| v + 0.2 * normal(0, i)).collect();
    model.set_flat(&start);
    let turn = |k: u64| 0.6 * (stream.uniform(77 + k) - 0.5);
    let rotation = glam::DMat3::from_euler(glam::EulerRot::XYZ, turn(0), turn(1), turn(2));
    let here = glam::DVec3::new(turn(3), turn(4), 3.0 * turn(5));
    let (w, h) = (width as f64, height as f64);
    let intrinsics = Intrinsics { width, height, fx: 0.9 * w, fy: 0.95 * w, cx: 0.51 * w, cy: 0.48 * h };
    let camera = Camera { intrinsics, pose: Pose::from_center(rotation, here) };
    let (lattice, n) = (Lattice::full(&camera.intrinsics), width * height);

    let mut maps = MediumMaps::zeros(0, 0);
    model.maps(&camera, &lattice, degree, &mut maps);
    let length: Vec<f32> = (0..n)
        .map(|i| {
            let x = ((i % width) as f64 + 0.5 - intrinsics.cx) / intrinsics.fx;
            let y = ((i / width) as f64 + 0.5 - intrinsics.cy) / intrinsics.fy;
            (x * x + y * y + 1.0).sqrt() as f32
        })
        .collect();
    let exponent = |map: &[f32]| -> Vec<f32> {
        map.iter().enumerate().map(|(i, b)| b * std::f32::consts::LOG2_E * length[i % n]).collect()
    };
    let random = |run: u64| -> Vec<f32> { (0..3 * n).map(|i| normal(run, i)).collect() };
    // The gradients are mostly of one sign, like those of a picture that is too bright.
    let slopes: Vec<f32> = random(1).iter().map(|v| (v + 0.5) / (3 * n) as f32).collect();
    let veil: Vec<f32> = random(2).iter().map(|v| v.abs().min(1.0)).collect();
    let (light, veil_depth): (Vec<f32>, Vec<f32>) =
        random(3).iter().zip(&random(4)).map(|(a, b)| (a.abs(), b.abs())).unzip();
    let mut cotangent = MediumMaps::zeros(width, height);
    for i in 0..3 * n {
        let g = slopes[i];
        cotangent.color.data_mut()[i] = g * (1.0 - veil[i]);
        cotangent.backscatter.data_mut()[i] = g * maps.color.data()[i] * veil_depth[i] * length[i % n];
        cotangent.attenuation.data_mut()[i] = -g * light[i] * length[i % n];
    }
    let mut gradient = model.zeros_like();
    model.backward(&camera, &lattice, degree, &maps, &cotangent, &mut gradient);

    let count = model.parameter_count();
    let mut first: Vec<f32> = (0..count).map(|i| 1e-3 * normal(5, i)).collect();
    let mut second: Vec<f32> = (0..count).map(|i| 1e-5 * normal(6, i).abs()).collect();
    let mut device = DeviceWater::new(gpu, &model, [&first, &second])?.ok_or_else(|| {
        EngineError::Request { engine: crate::device::NAME, what: "a twin of no water".into() }
    })?;
    let mut learnt = model.clone();
    learnt.update(&gradient, |role, offset, values, pulls| {
        let rate = if role == Role::Constant { RATES[0] } else { RATES[1] };
        let range = offset..offset + values.len();
        Adam::SPLATTING.update(STEP + 1, rate, values, pulls, &mut first[range.clone()], &mut second[range]);
    });

    device.prepare(gpu, &camera, degree, STEP, RATES)?;
    device.maps.write(gpu, 0, &poison(WATER_PLANES * n));
    let image_slope = Array::from(gpu, "slopes", &slopes)?;
    // The values that the forward pass keeps begin with the accumulation, which the water does not read.
    let bits = [poison(n), veil, light, veil_depth].concat().into_iter().map(f32::to_bits);
    let kept = Array::from(gpu, "sums along rays", &bits.collect::<Vec<u32>>())?;
    let counts = Array::from(gpu, "counts", &[0u32; counts::WORDS])?;
    submit(gpu, "water", |pass| {
        device.record_maps(pass);
        device.record_backward(pass, &image_slope, &kept);
    })?;
    let found = device.maps.read(gpu, WATER_PLANES * n)?;
    let [attenuation, backscatter] = [&maps.attenuation, &maps.backscatter].map(|map| exponent(map.data()));
    let mut all = vec![
        Agreement::of("c_m", &found[..3 * n], maps.color.data(), 1e-5),
        Agreement::of("exponents of attenuation", &found[3 * n..6 * n], &attenuation, 1e-5),
        Agreement::of("exponents of backscatter", &found[6 * n..], &backscatter, 1e-5),
    ];
    let (on_device, ours) = (device.slopes(gpu)?, gradient.flat());
    let parts = [("centres", 0, 3 * anchors), ("log widths", 3 * anchors, 4 * anchors)];
    for (what, from, to) in parts.into_iter().chain([("coefficients", 4 * anchors, count)]) {
        if from < to {
            let what = format!("slopes of the water's {what}");
            all.push(Agreement::of(what, &on_device[from..to], &ours[from..to], 1e-5));
        }
    }
    submit(gpu, "water", |pass| device.record_update(pass, &counts))?;
    let (model, [m, v]) = device.read(gpu)?;
    all.push(Agreement::of("the water's parameters", &model.flat(), &learnt.flat(), 1e-6));
    all.push(Agreement::of("the water's first moments", &m, &first, 1e-5));
    all.push(Agreement::of("the water's second moments", &v, &second, 1e-5));
    Ok(all)
}
