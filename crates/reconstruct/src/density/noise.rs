//! Position noise: Plenodium moves Gaussians that are nearly transparent, after every ceiling.
//!
//! ```text
//! μ ← μ + Σ ε · rate · strength / (1 + e^{−100 ((1 − o) − 0.995)})        ε normal in three dimensions
//! ```
//!
//! `Σ` is the Gaussian's covariance, `o` its opacity and `rate` the learning rate of centres.

use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::Gaussians;

use super::rebuild::rotate;

/// The purpose of the random draws.
const NOISE: Purpose = Purpose::new("position noise");

/// Moves the Gaussians after `step`; `strength` contains the learning rate of centres.
pub(crate) fn scatter(gaussians: &mut Gaussians, strength: f64, seed: u64, step: u64) {
    let stream = Stream::new(seed, NOISE, step);
    for (i, mean) in gaussians.means.iter_mut().enumerate() {
        let open = 1.0 / (1.0 + math::exp(f64::from(gaussians.opacity_logits[i])));
        let gate = strength / (1.0 + math::exp(-100.0 * (open - 0.995)));
        let draw: [f64; 3] = std::array::from_fn(|axis| gate * stream.normal((3 * i + axis) as u64));
        // R S² Rᵀ ε
        let [w, x, y, z] = gaussians.quaternions[i];
        let local = rotate([w, -x, -y, -z], draw);
        let scaled: [f64; 3] = std::array::from_fn(|axis| {
            math::exp(2.0 * f64::from(gaussians.log_scales[i][axis])) * local[axis]
        });
        let moved = rotate([w, x, y, z], scaled);
        (0..3).for_each(|axis| mean[axis] += moved[axis] as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::zeros;

    #[test]
    fn only_transparent_gaussians_move_and_along_their_long_axes() {
        let mut scene = zeros(200, 0);
        for i in 0..200 {
            // A quarter turn about z: the long first axis lies along y.
            scene.quaternions[i] = [1.0, 0.0, 0.0, 1.0];
            scene.log_scales[i] = [math::ln(0.5), math::ln(0.01), math::ln(0.01)];
            scene.opacity_logits[i] = if i < 100 { -9.0 } else { 0.0 };
        }
        scatter(&mut scene, 1.0, 3, 500);
        let spread = |axis: usize| {
            let squares = scene.means[..100].iter().map(|m| f64::from(m[axis]) * f64::from(m[axis]));
            (squares.sum::<f64>() / 100.0).sqrt()
        };
        // The gate at o = 1.2e-4 is 0.62, and the covariance along the axis a quarter.
        assert!((spread(1) - 0.62 * 0.25).abs() < 0.03, "{}", spread(1));
        assert!(spread(0) < 1e-3 && spread(2) < 1e-3);
        assert!(scene.means[100..].iter().all(|m| m.iter().all(|v| v.abs() < 1e-9)));
    }
}
