//! Colours that the water hid.
//!
//! A photograph shows only the part `T c` of a Gaussian's colour `c`, with the transmission
//! `T = e^{−β_attn s}`. Where `T` is small, training hardly determines the colour: noise and errors of the
//! water are divided by `T`. Red is hidden first. So far Gaussians, and those that stand for haze in open
//! water, end with a red that no photograph contradicts, and the scene without its water shows red fog. Here
//! such channels fade into those that are known. Over training views `v`, with the visibility
//! `ω_v = Σ_pixels w` of the Gaussian:
//!
//! ```text
//! k_c  = Σ_v ω_v T_vc² / Σ_v ω_v                              how much arrived
//! κ_c  = k_c / (k_c + τ²),          r_c = κ_c / max_j κ_j      how much is known; against the best channel
//! c'_c = r_c c_c + (1 − r_c) Σ_j κ_j c_j / Σ_j κ_j
//! ```
//!
//! `c'` is the mean of `c` given the photographs, if a photograph's error is `σ` and colours differ between
//! channels by `σ/τ`. The weights of a channel sum to one, so harmonics are mixed band by band. `τ` is
//! `unknown_below`.
//!
//! Pictures through the water change by `T (c' − c)`, less than a grey value where the channel is unknown.
//! Gaussians that no training view sees, and scenes without water, stay as they are.
//!
//! Limits: grey is assumed where nothing is known; far red things turn grey. At most [`MOST_VIEWS`] views are
//! used, at a longer side of at most [`SIDE`] pixels.

use rayon::prelude::*;
use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_medium::MediumModel;
use use3d_numerics::math;
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

/// Largest number of views used, spread over the capture.
pub(crate) const MOST_VIEWS: usize = 64;
/// The longest side, in pixels, at which visibility is measured.
pub(crate) const SIDE: usize = 400;
/// Number of planes that are lifted together: attenuation in three channels, and ones.
const PLANES: usize = 4;

/// `Σ_v ω_v T_vc²` per channel, and `Σ_v ω_v`.
type Arrived = [f32; 4];

/// Fades unknown colour channels of Gaussians behind this water, whose bands up to `degree` are in use.
/// `below` is `τ`, the transmission at which half of a channel is known; 0 changes nothing.
pub(crate) fn fade(
    gaussians: &mut Gaussians,
    water: &MediumModel,
    degree: usize,
    cameras: &[Camera],
    below: f64,
) {
    if below > 0.0 && !matches!(water, MediumModel::None) {
        let arrived = arrived(gaussians, water, degree, cameras);
        let tau = below as f32;
        gaussians.sh.par_iter_mut().zip(&arrived).for_each(|(sh, arrived)| {
            if let Some(mix) = mix(*arrived, tau) {
                for band in sh {
                    *band = mix.map(|row| row[0] * band[0] + row[1] * band[1] + row[2] * band[2]);
                }
            }
        });
    }
}

/// The rows by which `c'` follows from `c`; `None` if no view saw the Gaussian.
fn mix(arrived: Arrived, tau: f32) -> Option<[[f32; 3]; 3]> {
    let weight = arrived[3];
    if weight.is_nan() || weight <= 0.0 {
        return None;
    }
    let known: [f32; 3] = std::array::from_fn(|c| {
        let k = arrived[c] / weight;
        k / (k + tau * tau)
    });
    let best = known.iter().copied().fold(0.0, f32::max);
    let sum: f32 = known.iter().sum();
    if sum.is_nan() || sum <= 0.0 {
        return None;
    }
    Some(std::array::from_fn(|c| {
        let own = known[c] / best;
        std::array::from_fn(|j| (1.0 - own) * known[j] / sum + if j == c { own } else { 0.0 })
    }))
}

fn arrived(gaussians: &Gaussians, water: &MediumModel, degree: usize, cameras: &[Camera]) -> Vec<Arrived> {
    let n = gaussians.len();
    let mut sums = vec![[0.0; 4]; n];
    let mut maps = MediumMaps::zeros(0, 0);
    let (mut rasterizer, mut prepared) = (Rasterizer::new(), Prepared::new());
    let (mut planes, mut lifted) = (Vec::new(), vec![0.0f32; PLANES * n]);
    let count = cameras.len().min(MOST_VIEWS);
    for camera in (0..count).map(|i| cameras[i * cameras.len() / count].no_larger_than(SIDE)) {
        let lattice = Lattice::full(&camera.intrinsics);
        water.maps(&camera, &lattice, degree, &mut maps);
        planes.clear();
        planes.extend_from_slice(maps.attenuation.data());
        planes.resize(PLANES * lattice.width() * lattice.height(), 1.0);
        prepared.prepare(gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
        rasterizer.splat_adjoint(&prepared, PLANES, &planes, &mut lifted);
        let center = camera.pose.center().as_vec3().to_array();
        sums.par_iter_mut().zip(lifted.par_chunks_exact(PLANES)).zip(&gaussians.means).for_each(
            |((sum, lifted), at)| {
                let visible = lifted[PLANES - 1];
                if visible > 0.0 {
                    let s = (0..3).map(|k| (at[k] - center[k]) * (at[k] - center[k])).sum::<f32>().sqrt();
                    for c in 0..3 {
                        sum[c] += visible * math::exp(-2.0 * lifted[c] / visible * s);
                    }
                    sum[3] += visible;
                }
            },
        );
    }
    sums
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use use3d_capture::{Intrinsics, Pose};
    use use3d_medium::MediumKind;

    use super::*;
    use crate::engine::zeros;
    use crate::{FoundWater, ReconstructParams};

    const TAU: f64 = 0.05;
    const ATTENUATION: [f64; 3] = [1.5, 0.4, 0.3];

    fn water() -> MediumModel {
        let found = FoundWater {
            attenuation: ATTENUATION,
            backscatter: [0.3; 3],
            veil: [0.1, 0.3, 0.4],
            veil_slope: [[0.0; 3]; 3],
            radiances: Vec::new(),
        };
        let params = ReconstructParams { medium: MediumKind::Rbf, ..ReconstructParams::default() };
        found.model(&params).expect("this water starts from harmonics")
    }

    fn camera() -> Camera {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 80.0, fy: 80.0, cx: 40.0, cy: 30.0 };
        Camera { intrinsics, pose: Pose::look_at(DVec3::ZERO, DVec3::Z, -DVec3::Y) }
    }

    /// A near, a far and a hidden Gaussian, all red.
    fn scene() -> Gaussians {
        let mut g = zeros(3, 1);
        g.means = vec![[-0.2, 0.0, 0.6], [1.0, 0.0, 4.0], [0.0, 0.0, -3.0]];
        g.log_scales = vec![[math::ln(0.05); 3]; 3];
        g.quaternions = vec![[1.0, 0.0, 0.0, 0.0]; 3];
        g.opacity_logits = vec![2.0; 3];
        for sh in &mut g.sh {
            sh[0] = [1.5, -0.5, -0.2];
            sh[2] = [0.1, 0.02, 0.03];
        }
        g
    }

    #[test]
    fn near_colours_stay_far_red_fades_and_hidden_gaussians_are_left_alone() {
        let before = scene();
        let mut after = before.clone();
        fade(&mut after, &water(), 1, &[camera()], TAU);
        let change = |i: usize, c: usize| (after.sh[i][0][c] - before.sh[i][0][c]).abs();
        assert!((0..3).all(|c| change(0, c) < 0.05), "{:?}", after.sh[0][0]);
        assert!(after.sh[1][0][0] < 0.2 && change(1, 1) < 0.1 && change(1, 2) < 0.1, "{:?}", after.sh[1][0]);
        assert_eq!(after.sh[2], before.sh[2]);
        // Nothing but the colours changes.
        assert_eq!((&after.means, &after.log_scales), (&before.means, &before.log_scales));
        assert_eq!(
            (&after.quaternions, &after.opacity_logits),
            (&before.quaternions, &before.opacity_logits)
        );
    }

    #[test]
    fn harmonics_are_mixed_as_the_formula_says() {
        // By hand, for the far Gaussian: κ from its distance, then the formula in f64.
        let before = scene();
        let mut after = before.clone();
        fade(&mut after, &water(), 1, &[camera()], TAU);
        let s = (1.0f64 + 16.0).sqrt();
        let known: Vec<f64> = ATTENUATION.iter().map(|b| math::exp(-2.0 * b * s)).collect();
        let known: Vec<f64> = known.iter().map(|k| k / (k + TAU * TAU)).collect();
        let (best, sum) = (known.iter().copied().fold(0.0, f64::max), known.iter().sum::<f64>());
        for band in [0, 2] {
            let own: [f64; 3] = before.sh[1][band].map(f64::from);
            let mean = (0..3).map(|j| known[j] * own[j]).sum::<f64>() / sum;
            for c in 0..3 {
                let r = known[c] / best;
                let expected = r * own[c] + (1.0 - r) * mean;
                let found = f64::from(after.sh[1][band][c]);
                assert!((found - expected).abs() < 2e-3, "band {band}, channel {c}: {found} for {expected}");
            }
        }
    }

    #[test]
    fn pictures_through_the_water_hardly_change() {
        let before = scene();
        let mut after = before.clone();
        fade(&mut after, &water(), 1, &[camera()], TAU);
        for i in 0..2 {
            let s = before.means[i].iter().map(|v| v * v).sum::<f32>().sqrt();
            for c in 0..3 {
                let t = math::exp(-(ATTENUATION[c] as f32) * s);
                let change = 0.282_1 * t * (after.sh[i][0][c] - before.sh[i][0][c]).abs();
                assert!(change < 1.0 / 255.0, "Gaussian {i}, channel {c}: {change}");
            }
        }
    }

    #[test]
    fn zero_and_scenes_without_water_change_nothing_and_grey_stays_grey() {
        let before = scene();
        for (water, below) in [(water(), 0.0), (MediumModel::None, TAU)] {
            let mut after = before.clone();
            fade(&mut after, &water, 1, &[camera()], below);
            assert_eq!(after.sh, before.sh);
        }
        let mut grey = before;
        grey.sh.iter_mut().for_each(|sh| sh[0] = [0.7; 3]);
        fade(&mut grey, &water(), 1, &[camera()], TAU);
        assert!(grey.sh.iter().flat_map(|sh| sh[0]).all(|v| (v - 0.7).abs() < 1e-6));
    }
}
