//! The colour map of a block of Gaussians, `c⁺ = exp(a) ⊙ (c + δA c + b_g) + b`, and its derivative.
//!
//! These functions run inside a dispatched instruction-set level, so that everything here compiles to fused
//! vector or scalar code.

use fearless_simd::{Simd, f32x16, prelude::*};

use crate::OUTPUTS;
use crate::field::apply_affine;
use crate::sites::{BLOCK, LANES};
use use3d_numerics::lanes::exp_lanes;

/// The sums of a block: outputs or their gradients, and gradients of the affine.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct BlockSums {
    pub(crate) outputs: [f64; OUTPUTS],
    pub(crate) affine: [f64; 12],
}

/// `exp(raw - centre)` of the three log-gains of sixteen Gaussians of a block.
#[inline(always)]
fn gains<S: Simd>(simd: S, raw: &[f32], centre: &[f32; OUTPUTS], at: usize) -> [[f32; LANES]; 3] {
    let mut gains = [[0.0; LANES]; 3];
    for (c, gain) in gains.iter_mut().enumerate() {
        let raw = f32x16::from_slice(simd, &raw[c * BLOCK + at..c * BLOCK + at + LANES]);
        exp_lanes(simd, raw - f32x16::splat(simd, centre[c])).store_slice(gain);
    }
    gains
}

/// Computes the colours of a block: `raw` are its six planes, `base` and `out` its Gaussians' colours.
#[inline(always)]
pub(crate) fn forward<S: Simd>(
    simd: S,
    affine: &[[f32; 4]; 3],
    centre: &[f32; OUTPUTS],
    raw: &[f32],
    base: &[[f32; 3]],
    out: &mut [[f32; 3]],
) {
    for at in (0..base.len()).step_by(LANES) {
        let gain = gains(simd, raw, centre, at);
        for k in 0..LANES.min(base.len() - at) {
            let i = at + k;
            let graded = apply_affine(affine, base[i]);
            for c in 0..3 {
                let bias = raw[(3 + c) * BLOCK + i] - centre[3 + c];
                out[i][c] = gain[c][k].mul_add(graded[c], bias);
            }
        }
    }
}

/// Writes `∂L/∂local` to the six planes `d_raw`; returns its sums and those of the affine's gradient.
#[inline(always)]
pub(crate) fn backward<S: Simd>(
    simd: S,
    affine: &[[f32; 4]; 3],
    centre: &[f32; OUTPUTS],
    raw: &[f32],
    base: &[[f32; 3]],
    d_colors: &[[f32; 3]],
    d_raw: &mut [f32],
) -> BlockSums {
    let mut sums = BlockSums::default();
    for at in (0..base.len()).step_by(LANES) {
        let end = base.len().min(at + LANES);
        let d_colors = &d_colors[at..end];
        // Gaussians that a view does not see form long runs.
        if d_colors.iter().all(|d| *d == [0.0; 3]) {
            for plane in d_raw.chunks_exact_mut(BLOCK) {
                plane[at..at + LANES].fill(0.0);
            }
            continue;
        }
        let gain = gains(simd, raw, centre, at);
        for (k, d) in d_colors.iter().enumerate() {
            let c = base[at + k];
            let graded = apply_affine(affine, c);
            for o in 0..3 {
                let through = d[o] * gain[o][k];
                d_raw[o * BLOCK + at + k] = through * graded[o];
                d_raw[(3 + o) * BLOCK + at + k] = d[o];
                let row = &mut sums.affine[4 * o..4 * o + 4];
                for (a, x) in row.iter_mut().zip([c[0], c[1], c[2], 1.0]) {
                    *a += f64::from(through) * f64::from(x);
                }
            }
        }
    }
    sums.outputs = plane_sums(d_raw, base.len());
    sums
}

/// The sums of a block's six planes over its first `count` Gaussians.
#[inline(always)]
pub(crate) fn plane_sums(planes: &[f32], count: usize) -> [f64; OUTPUTS] {
    let mut sums = [0.0; OUTPUTS];
    for i in 0..count {
        for (o, s) in sums.iter_mut().enumerate() {
            *s += f64::from(planes[o * BLOCK + i]);
        }
    }
    sums
}

/// The sums of all blocks, in block order.
pub(crate) fn total(blocks: &[BlockSums]) -> BlockSums {
    let mut out = BlockSums::default();
    for block in blocks {
        for (t, s) in out.outputs.iter_mut().zip(block.outputs) {
            *t += s;
        }
        for (t, s) in out.affine.iter_mut().zip(block.affine) {
            *t += s;
        }
    }
    out
}
