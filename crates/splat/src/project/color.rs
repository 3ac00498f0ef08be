//! The colour of a Gaussian seen from a camera, and its derivative.
//!
//! `c(ω) = max(0, Σ_k Y_k(ω) sh_k + ½)` per channel, `ω` the unit vector from the camera centre to the
//! Gaussian's centre in the world frame. The direction is detached: no gradient flows from colour into
//! position through `ω` (R28). Where the clamp is active the gradient is 0.

use crate::Gaussians;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::spherical_harmonics::{bands, basis};

/// Gaussians per parallel task.
const CHUNK: usize = 1024;

/// The unit direction from `center` to `mean`; `(0, 0, 1)` where they coincide.
#[inline(always)]
pub(crate) fn direction(center: [f32; 3], mean: [f32; 3]) -> [f32; 3] {
    let d = [mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]];
    let norm = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    if norm > 0.0 { d.map(|v| v / norm) } else { [0.0, 0.0, 1.0] }
}

/// The camera centre in f32.
pub(crate) fn center(camera: &Camera) -> [f32; 3] {
    camera.pose.center().as_vec3().to_array()
}

/// The colour before the clamp, `Σ_k Y_k sh_k + ½`, and the basis.
#[inline(always)]
pub(crate) fn raw_color(degree: usize, direction: [f32; 3], sh: &[[f32; 3]; 16]) -> ([f32; 3], [f32; 16]) {
    let y = basis(degree, direction);
    let mut raw = [0.5f32; 3];
    for k in 0..bands(degree) {
        for c in 0..3 {
            raw[c] = y[k].mul_add(sh[k][c], raw[c]);
        }
    }
    (raw, y)
}

/// The colour.
#[inline(always)]
pub(crate) fn color(degree: usize, center: [f32; 3], mean: [f32; 3], sh: &[[f32; 3]; 16]) -> [f32; 3] {
    raw_color(degree, direction(center, mean), sh).0.map(|v| v.max(0.0))
}

/// The derivative: `∂L/∂sh` from `∂L/∂c`, which is zero where the clamp is active.
#[inline(always)]
pub(crate) fn color_backward(
    degree: usize,
    center: [f32; 3],
    mean: [f32; 3],
    d_color: [f32; 3],
    gradient: &mut [[f32; 3]; 16],
) {
    for (g, y) in gradient.iter_mut().zip(basis(degree, direction(center, mean))) {
        *g = d_color.map(|v| y * v);
    }
}

/// Computes the colours of all Gaussians in this view, with bands up to `degree` (at most the stored
/// degree): `max(0, SH + ½)`.
pub fn view_colors(gaussians: &Gaussians, camera: &Camera, degree: usize, out: &mut Vec<[f32; 3]>) {
    let (degree, center) = (degree.min(gaussians.sh_degree).min(3), center(camera));
    out.resize(gaussians.len(), [0.0; 3]);
    let level = Level::new();
    out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
        dispatch!(level, _simd => color_chunk(gaussians, degree, center, chunk * CHUNK, out));
    });
}

#[inline(always)]
fn color_chunk(gaussians: &Gaussians, degree: usize, center: [f32; 3], first: usize, out: &mut [[f32; 3]]) {
    for (out, i) in out.iter_mut().zip(first..) {
        *out = color(degree, center, gaussians.means[i], &gaussians.sh[i]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};
    use use3d_capture::{Intrinsics, Pose};
    use use3d_golden::Part;

    #[test]
    fn golden_colours_and_their_gradients() {
        for case in Part::math("sh").cases() {
            let degree = case.count("degree");
            let (means, sh) = (case.rows::<3>("in.means"), case.rows::<48>("in.sh"));
            let sh: Vec<[[f32; 3]; 16]> = sh
                .iter()
                .map(|row| std::array::from_fn(|k| std::array::from_fn(|c| row[3 * k + c])))
                .collect();
            let pose = Pose::from_center(DMat3::IDENTITY, DVec3::from_slice(&case.f64("in.cam_center")));
            let camera = Camera {
                intrinsics: Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 },
                pose,
            };
            let center = center(&camera);
            let (mut raw, mut basis) = (vec![], vec![]);
            for (mean, sh) in means.iter().zip(&sh) {
                let (value, y) = raw_color(degree, direction(center, *mean), sh);
                raw.extend(value);
                basis.extend_from_slice(&y[..bands(degree)]);
            }
            case.check("out.raw", &raw);
            case.check("out.basis", &basis);
            let n = means.len();
            let gaussians = Gaussians {
                sh_degree: 3,
                log_scales: vec![[0.0; 3]; n],
                quaternions: vec![[1.0, 0.0, 0.0, 0.0]; n],
                opacity_logits: vec![0.0; n],
                means,
                sh,
            };
            let mut colors = vec![];
            view_colors(&gaussians, &camera, degree, &mut colors);
            case.check("out.color", colors.as_flattened());
            let mut gradient = vec![[[1.0; 3]; 16]; n];
            for (i, d_color) in case.rows::<3>("cot.color").into_iter().enumerate() {
                let d_color = std::array::from_fn(|c| if colors[i][c] > 0.0 { d_color[c] } else { 0.0 });
                color_backward(degree, center, gaussians.means[i], d_color, &mut gradient[i]);
            }
            case.check("grad.color.sh", gradient.as_flattened().as_flattened());
        }
    }
}
