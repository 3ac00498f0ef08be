//! The enhancement written into spherical harmonics, for viewers that support only 3D Gaussian splatting.
//!
//! A Gaussian's enhanced radiance is `c⁺(ω) = M c(ω) + m` with one matrix per Gaussian, and
//! `c(ω) = max(SH(ω) + ½, 0)`. Where that clamp is inactive, `SH⁺ = M SH` in every band, plus
//! `(M ½ + m - ½)/C₀` in band 0, gives the same radiance exactly. Where it is active the baked colour
//! differs, because a viewer clamps after the matrix instead of before; [`BakeReport`] measures the
//! difference. [`bake`] writes the enhanced object radiance, without water; [`bake_in_water`] writes the
//! colours that cameras saw through the water.

mod in_water;

pub use in_water::{InWater, bake_in_water};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::{C0, bands, basis};
use use3d_numerics::sums::sums;
use use3d_scene::Scene;
use use3d_splat::Gaussians;

use crate::RenderError;
use crate::look::grades;

/// Number of directions, spread evenly over the sphere, in which the bake is checked.
const DIRECTIONS: usize = 48;

/// The difference between a baked scene and the enhanced one. Colours are those that a viewer shows,
/// `max(c, 0)`, display range; every Gaussian is weighted by its opacity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BakeReport {
    /// Share of (Gaussian, direction, channel) samples where the stage-1 clamp is active, so that the bake
    /// may differ.
    pub clamped_share: f64,
    /// Mean absolute colour error over all samples.
    pub mean_error: f64,
    /// Mean absolute colour error over the samples with an active clamp.
    pub mean_error_clamped: f64,
    /// Largest absolute colour error.
    pub max_error: f64,
    /// Largest absolute colour error where no channel is clamped: rounding only.
    pub max_error_unclamped: f64,
}

/// Gaussians whose plain spherical harmonics are the enhanced object radiance at `strength`, in the scene's
/// frame.
pub fn bake(scene: &Scene, strength: f32) -> Result<(Gaussians, BakeReport), RenderError> {
    let grades = grades(scene, strength)?;
    Ok(bake_maps(&scene.gaussians, |i| grades.matrix(i)))
}

/// Writes an affine colour map per Gaussian, rows `(M | m)`, into its harmonics.
fn bake_maps(
    gaussians: &Gaussians,
    matrix: impl Fn(usize) -> [[f32; 4]; 3] + Sync,
) -> (Gaussians, BakeReport) {
    let mut baked = gaussians.clone();
    let used = bands(baked.sh_degree.min(3));
    baked.sh.par_iter_mut().enumerate().with_min_len(1024).for_each(|(i, sh)| {
        let m = matrix(i);
        for (k, band) in sh.iter_mut().enumerate().take(used) {
            let old = *band;
            *band = std::array::from_fn(|c| {
                let turned = m[c][0] * old[0] + m[c][1] * old[1] + m[c][2] * old[2];
                if k > 0 {
                    return turned;
                }
                turned + (0.5 * (m[c][0] + m[c][1] + m[c][2]) + m[c][3] - 0.5) / C0
            });
        }
    });
    let report = compare(gaussians, &baked, matrix);
    (baked, report)
}

/// The colour of harmonics in a direction whose basis functions are `y`, not clamped.
fn color(sh: &[[f32; 3]; 16], y: &[f32; 16], degree: usize) -> [f32; 3] {
    std::array::from_fn(|c| 0.5 + (0..bands(degree)).map(|k| y[k] * sh[k][c]).sum::<f32>())
}

/// `M c + m` of rows `(M | m)`.
fn mapped(rows: &[[f32; 4]; 3], c: [f32; 3]) -> [f32; 3] {
    rows.map(|row| row[0] * c[0] + row[1] * c[1] + row[2] * c[2] + row[3])
}

fn compare(
    before: &Gaussians,
    after: &Gaussians,
    matrix: impl Fn(usize) -> [[f32; 4]; 3] + Sync,
) -> BakeReport {
    let degree = before.sh_degree.min(3);
    let directions: Vec<[f32; 16]> = (0..DIRECTIONS)
        .map(|k| {
            let z = 1.0 - (2.0 * k as f64 + 1.0) / DIRECTIONS as f64;
            let (r, phi) = ((1.0 - z * z).sqrt(), k as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt()));
            basis(degree, [(r * math::cos(phi)) as f32, (r * math::sin(phi)) as f32, z as f32])
        })
        .collect();
    // For each sample: the errors of the channels, true if the clamp of any channel is active, and the
    // number of clamped channels.
    let errors = |i: usize, y: &[f32; 16]| -> ([f64; 3], bool, usize) {
        let [raw, shown] = [&before.sh[i], &after.sh[i]].map(|sh| color(sh, y, degree));
        let exact = mapped(&matrix(i), raw.map(|v| v.max(0.0)));
        let error = std::array::from_fn(|c| f64::from((exact[c].max(0.0) - shown[c].max(0.0)).abs()));
        let clamped = raw.iter().filter(|&&v| v < 0.0).count();
        (error, clamped > 0, clamped)
    };
    let opacity = |i: usize| 1.0 / (1.0 + math::exp(f64::from(-before.opacity_logits[i])));
    // Weighted sums: weight, error, clamped samples, error of samples with a clamp, their weight.
    let n = before.len();
    let [weight, error, clamped, error_clamped, weight_clamped] = sums::<5>(n, |i, t| {
        let w = opacity(i) / 3.0;
        for y in &directions {
            let (e, any, count) = errors(i, y);
            let e: f64 = w * e.iter().sum::<f64>();
            t[0] += 3.0 * w;
            t[1] += e;
            t[2] += w * count as f64;
            if any {
                t[3] += e;
                t[4] += 3.0 * w;
            }
        }
    });
    let (max_error, max_error_unclamped) = (0..n)
        .into_par_iter()
        .map(|i| {
            directions.iter().fold((0.0f64, 0.0f64), |(all, free), y| {
                let (e, any, _) = errors(i, y);
                let worst = e.iter().fold(0.0f64, |m, v| m.max(*v));
                (all.max(worst), if any { free } else { free.max(worst) })
            })
        })
        .reduce(|| (0.0, 0.0), |a, b| (a.0.max(b.0), a.1.max(b.1)));
    let over = |sum: f64, weight: f64| if weight > 0.0 { sum / weight } else { 0.0 };
    BakeReport {
        clamped_share: over(clamped, weight),
        mean_error: over(error, weight),
        mean_error_clamped: over(error_clamped, weight_clamped),
        max_error,
        max_error_unclamped,
    }
}
