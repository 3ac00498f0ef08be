//! Compares the loss of a view with the processor's.

use use3d_capture::{Image, Map};
use use3d_numerics::{math, sums};
use use3d_reconstruct::losses::{DepthPriorLoss, PhotometricLoss};
use use3d_reconstruct::{ExposureStep, Exposures};
use use3d_training::EngineError;

use super::{Agreement, draws, poison};
use crate::buffer::Array;
use crate::constants::counts;
use crate::device::Gpu;
use crate::kernel::submit;
use crate::losses::{LossInput, LossOutput, LossPlan, Losses, TOLD};
use crate::per_view::PerView;

/// A view to compare losses on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LossCase {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// The seed of its draws.
    pub seed: u64,
    /// True if some pixels do not count.
    pub mask: bool,
    /// True if it has a depth prior.
    pub prior: bool,
    /// True if views have gains.
    pub gains: bool,
}

const WEIGHTS: [f64; 3] = [0.8, 0.2, 0.1];
const VIEWS: usize = 5;
const ROW: usize = 2;
const STEP: ExposureStep = ExposureStep { rate: 2e-3, weight: 0.01 };

/// A smooth picture with noise, a photograph near it, a mask, depths, and a similar depth prior.
struct Inputs {
    rendered: Image,
    photograph: Image,
    mask: Option<Map>,
    depth: Map,
    prior: Option<Map>,
    exposures: Exposures,
}

fn inputs(case: &LossCase) -> Option<Inputs> {
    let LossCase { width, height, seed, .. } = *case;
    let (n, stream) = (width * height, draws("twin of the losses", seed));
    let noise = |run: u64, i: usize| stream.uniform(run * 100_000_000 + i as u64) as f32;
    let smooth = |i: usize| {
        let (x, y) = ((i % width) as f32, (i % n / width) as f32);
        0.45 + 0.3 * math::sin(0.21 * x + (i / n.max(1)) as f32) * math::cos(0.17 * y)
    };
    // Some values are below zero or above one, where the weight and the squared error have kinks.
    let rendered = (0..3 * n).map(|i| smooth(i) + 0.9 * math::powi(noise(0, i) - 0.5, 3) * 6.0).collect();
    let photograph = (0..3 * n).map(|i| (smooth(i) + 0.2 * (noise(1, i) - 0.5)).clamp(0.0, 1.0)).collect();
    let mask = (0..n).map(|i| if i % width < width / 5 { 0.0 } else { noise(2, i).max(0.5) }).collect();
    let depth: Vec<f32> = (0..n).map(|i| if i % 13 == 0 { 0.0 } else { 0.2 + 2.0 * noise(3, i) }).collect();
    let like = |i: usize| 1.0 / (depth[i] + 0.3) + 0.3 * noise(4, i);
    let prior = (0..n).map(|i| if i % 7 == 0 { 0.0 } else { like(i) }).collect();
    let gains: Vec<[f64; 3]> =
        (0..VIEWS).map(|v| std::array::from_fn(|c| 0.8 + 0.4 * stream.uniform((9 * v + c) as u64))).collect();
    Some(Inputs {
        rendered: Image::from_planes(width, height, rendered)?,
        photograph: Image::from_planes(width, height, photograph)?,
        mask: case.mask.then(|| Map::from_planes(width, height, mask)).flatten(),
        prior: case.prior.then(|| Map::from_planes(width, height, prior)).flatten(),
        depth: Map::from_planes(width, height, depth)?,
        exposures: Exposures::new(&gains),
    })
}

/// Compares the losses of a view.
pub fn losses(gpu: &Gpu, case: &LossCase) -> Result<Vec<Agreement>, EngineError> {
    let Some(inputs) = inputs(case) else { return Ok(Vec::new()) };
    let n = case.width * case.height;

    let gain = if case.gains { inputs.exposures.gain(ROW) } else { [1.0; 3] };
    let mut shown = inputs.rendered.clone();
    for c in 0..3 {
        shown.plane_mut(c).iter_mut().for_each(|v| *v *= gain[c]);
    }
    let mut slope = Image::new(1, 1);
    let mut photometric = PhotometricLoss::new(WEIGHTS[1]);
    let value = photometric.evaluate(&shown, &inputs.photograph, inputs.mask.as_ref(), &mut slope);
    let by_gain: [f64; 3] = std::array::from_fn(|c| {
        let (seen, pulled) = (shown.plane(c), slope.plane(c));
        sums::sum(n, |i| f64::from(seen[i]) * f64::from(pulled[i]))
    });
    for c in 0..3 {
        slope.plane_mut(c).iter_mut().for_each(|v| *v *= gain[c]);
    }
    let mut depth_slope = Map::new(case.width, case.height);
    let depth_loss = match &inputs.prior {
        Some(prior) => DepthPriorLoss.evaluate(&inputs.depth, prior, WEIGHTS[2], &mut depth_slope),
        None => 0.0,
    };
    let mut exposures = inputs.exposures.clone();
    if case.gains {
        exposures.update(ROW, by_gain, &STEP);
    }

    let mut losses = Losses::new(gpu)?;
    losses.resize(gpu, case.width, case.height)?;
    #[cfg(test)]
    losses.poison(gpu);
    let array = |what, values: &[f32]| Array::from(gpu, what, values);
    let (image, depth) = (array("image", inputs.rendered.data())?, array("depth", inputs.depth.data())?);
    let photograph = array("photograph", inputs.photograph.data())?;
    let mask = inputs.mask.as_ref().map(|m| array("mask", m.data())).transpose()?;
    let prior = inputs.prior.as_ref().map(|p| array("prior", p.data())).transpose()?;
    let (by_image, by_depth) = (array("slopes", &poison(3 * n))?, array("depth slopes", &poison(n))?);
    let reports = array("reports", &poison(32))?;
    let counts = Array::from(gpu, "counts", &[0u32; counts::WORDS])?;
    let mut gains = PerView::new(gpu, "the views' gains", &inputs.exposures.log_gains)?;
    let seen = LossInput {
        image: &image,
        depth: &depth,
        photograph: &photograph,
        mask: mask.as_ref(),
        prior: prior.as_ref(),
    };
    let told = LossOutput { image: &by_image, depth: &by_depth, reports: &reports, counts: &counts };
    let plan = LossPlan { step: 7, report: 1, weights: WEIGHTS, gains: case.gains.then_some((ROW, STEP)) };
    losses.prepare(gpu, &plan, &seen, Some(&mut gains));
    submit(gpu, "losses", |pass| {
        losses.record(pass, &seen, Some(&gains), &told);
        if case.gains {
            losses.learn_gains(pass, &gains, &counts);
        }
    })?;
    let values = reports.read(gpu, 32)?[16..16 + TOLD].to_vec();
    let total = value.total + WEIGHTS[2] * depth_loss;
    let mut all: Vec<Agreement> = [
        ("loss", total),
        ("reg_l1", value.reg_l1),
        ("reg_ms_ssim", value.reg_ms_ssim),
        ("depth_loss", depth_loss),
        ("squared error", value.squared_error),
    ]
    .into_iter()
    .zip(&values)
    .map(|((what, ours), device)| {
        Agreement::of_values(what, f64::from(*device), ours, 1e-5 * ours.abs().max(1.0))
    })
    .collect();
    all.push(Agreement::of("slopes of the image", &by_image.read(gpu, 3 * n)?, slope.data(), 1e-5));
    all.push(Agreement::of("slopes of depth", &by_depth.read(gpu, n)?, depth_slope.data(), 1e-5));
    if case.gains {
        let (learnt, ours) = (gains.read(gpu)?, &exposures.log_gains);
        for (what, device, ours) in [
            ("log-gains", &learnt.values, &ours.values),
            ("first moments of gains", &learnt.first, &ours.first),
            ("second moments of gains", &learnt.second, &ours.second),
        ] {
            all.push(Agreement::of(what, device, ours, 1e-5));
        }
    }
    Ok(all)
}
