//! Spherical harmonics of the pixel's ray, for nine quantities at once: the part that `rbf` and `global`
//! share.
//!
//! For each pixel, with the unit world direction `ω` of the ray through the pixel centre (R3) and the basis
//! `Y` of 16 bands,
//!
//! ```text
//! raw[q] = Σ_b Y_b(ω) A[q][b]       q: c_m, β_bs, β_attn, each RGB
//! c_m    = max(raw + 0.5, 0)        β = softplus(raw)                  (R6)
//! ```
//!
//! The backward pass needs only the maps themselves: the clamp is inactive where `c_m > 0`, and
//! `softplus'(raw) = 1 - e^{-β}`. Rows are cut into strips of fixed height. Each strip sums its 144
//! products in sixteen lanes, and the strips are added in order in f64. So the result has the same bits on
//! any number of threads.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;
use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_numerics::functions;
use use3d_numerics::rows::{self, LANES};
use use3d_numerics::spherical_harmonics::{bands, basis_lanes};

use crate::Role;

/// Spherical-harmonic coefficients of the three quantities: `[c_m, β_bs, β_attn][band][RGB]`.
pub type Coefficients = [[[f32; 3]; 16]; 3];
/// Gradients with respect to [`Coefficients`], summed in f64.
pub(crate) type CoefficientGradients = [[[f64; 3]; 16]; 3];

/// `c_m = 0.5`, `β = softplus(-5 Y₀₀)` in every direction.
pub(crate) fn initial_coefficients() -> Coefficients {
    let mut coefficients = [[[0.0; 3]; 16]; 3];
    coefficients[1][0] = [-5.0; 3];
    coefficients[2][0] = [-5.0; 3];
    coefficients
}

/// All numbers of one set of coefficients, or of gradients with respect to them, in order.
pub(crate) fn numbers<T>(coefficients: &[[[T; 3]; 16]; 3]) -> &[T] {
    coefficients.as_flattened().as_flattened()
}

/// The mutable form of [`numbers`].
pub(crate) fn numbers_mut<T>(coefficients: &mut [[[T; 3]; 16]; 3]) -> &mut [T] {
    coefficients.as_flattened_mut().as_flattened_mut()
}

/// Number of floats in one quantity's 16 bands, and in its constant band.
const QUANTITY: usize = 48;
const CONSTANT: usize = 3;

/// Cuts coefficients into runs of one role: three constants, 45 directional, and so on.
pub(crate) fn runs(coefficients: &[f32]) -> Vec<(Role, &[f32])> {
    let split = coefficients.chunks_exact(QUANTITY).map(|q| q.split_at(CONSTANT));
    split.flat_map(|(constant, rest)| [(Role::Constant, constant), (Role::Directional, rest)]).collect()
}

/// The mutable form of [`runs`].
pub(crate) fn runs_mut(coefficients: &mut [f32]) -> Vec<(Role, &mut [f32])> {
    let split = coefficients.chunks_exact_mut(QUANTITY).map(|q| q.split_at_mut(CONSTANT));
    split.flat_map(|(constant, rest)| [(Role::Constant, constant), (Role::Directional, rest)]).collect()
}

/// Rows per strip.
pub(crate) const STRIP: usize = 8;
/// Pixels per block of the backward pass.
const BLOCK: usize = 8 * LANES;

/// The rays of a lattice: `d = ((u - cx)/fx, (v - cy)/fy, 1)` per column and row,
/// and the rotation into the world.
pub(crate) struct Rays {
    x: Vec<f32>,
    y: Vec<f32>,
    /// Columns of `R_cwᵀ`.
    to_world: [[f32; 3]; 3],
}

impl Rays {
    pub(crate) fn new(camera: &Camera, lattice: &Lattice) -> Self {
        let k = &camera.intrinsics;
        let r = camera.pose.rotation.transpose().as_mat3();
        Self {
            x: lattice.columns().iter().map(|&u| ((f64::from(u) - k.cx) / k.fx) as f32).collect(),
            y: lattice.rows().iter().map(|&v| ((f64::from(v) - k.cy) / k.fy) as f32).collect(),
            to_world: [r.x_axis.to_array(), r.y_axis.to_array(), r.z_axis.to_array()],
        }
    }

    pub(crate) fn width(&self) -> usize {
        self.x.len()
    }

    /// The unit world directions of 16 pixels of row `j`, starting at column `i`.
    #[inline(always)]
    pub(crate) fn directions<S: Simd>(&self, simd: S, i: usize, j: usize) -> [f32x16<S>; 3] {
        let x = rows::load(simd, &self.x, i);
        let y = self.y[j];
        let norm = x.mul_add(x, y * y + 1.0).sqrt();
        let inverse = f32x16::splat(simd, 1.0) / norm;
        let [cx, cy, cz] = self.to_world;
        std::array::from_fn(|k| x.mul_add(cx[k], cy[k] * y + cz[k]) * inverse)
    }
}

/// The nine planes of three maps, cut into strips of [`STRIP`] rows.
pub(crate) fn strips(maps: &mut MediumMaps) -> Vec<[&mut [f32]; 9]> {
    let (width, pixels) = (maps.color.width(), maps.color.pixels());
    let mut planes: Vec<_> = [&mut maps.color, &mut maps.backscatter, &mut maps.attenuation]
        .into_iter()
        .flat_map(|image| image.data_mut().chunks_mut(pixels.max(1)))
        .map(|plane| plane.chunks_mut((STRIP * width).max(1)))
        .collect();
    let count = pixels.div_ceil((STRIP * width).max(1));
    (0..count).map(|_| std::array::from_fn(|q| planes[q].next().unwrap_or_default())).collect()
}

/// The nine planes of three maps, read-only: `c_m` RGB, `β_bs` RGB, `β_attn` RGB.
pub(crate) fn planes(maps: &MediumMaps) -> [&[f32]; 9] {
    let (c, b, a) = (maps.color.planes(), maps.backscatter.planes(), maps.attenuation.planes());
    [c[0], c[1], c[2], b[0], b[1], b[2], a[0], a[1], a[2]]
}

/// Computes the maps of one view.
pub(crate) fn forward(
    coefficients: &Coefficients,
    camera: &Camera,
    lattice: &Lattice,
    degree: usize,
    out: &mut MediumMaps,
) {
    out.resize(lattice.width(), lattice.height());
    let rays = Rays::new(camera, lattice);
    let level = Level::new();
    strips(out).into_par_iter().enumerate().for_each(|(s, mut strip)| {
        dispatch!(level, simd => forward_strip(simd, coefficients, &rays, degree, s * STRIP, &mut strip));
    });
}

#[inline(always)]
fn forward_strip<S: Simd>(
    simd: S,
    coefficients: &Coefficients,
    rays: &Rays,
    degree: usize,
    first_row: usize,
    strip: &mut [&mut [f32]; 9],
) {
    let width = rays.width();
    let rows = strip[0].len() / width;
    for row in 0..rows {
        for i in (0..width).step_by(LANES) {
            let [x, y, z] = rays.directions(simd, i, first_row + row);
            let basis = basis_lanes(simd, degree, x, y, z);
            for q in 0..9 {
                let (quantity, channel) = (q / 3, q % 3);
                let mut raw = basis[0] * coefficients[quantity][0][channel];
                for b in 1..bands(degree) {
                    raw = basis[b].mul_add(coefficients[quantity][b][channel], raw);
                }
                let value = if quantity == 0 { (raw + 0.5).max(0.0) } else { functions::softplus(simd, raw) };
                rows::store(value, &mut strip[q][row * width..][..width], i);
            }
        }
    }
}

/// Converts gradients with respect to the maps into gradients with respect to the coefficients. `maps` must
/// be the result of [`forward`].
pub(crate) fn backward(
    camera: &Camera,
    lattice: &Lattice,
    degree: usize,
    maps: &MediumMaps,
    d_maps: &MediumMaps,
) -> CoefficientGradients {
    let rays = Rays::new(camera, lattice);
    let level = Level::new();
    let (maps, d_maps) = (planes(maps), planes(d_maps));
    let height = lattice.height();
    let partial: Vec<[f32; 144]> = (0..height.div_ceil(STRIP))
        .into_par_iter()
        .map(|s| {
            let rows = s * STRIP..((s + 1) * STRIP).min(height);
            dispatch!(level, simd => backward_strip(simd, &rays, degree, rows, &maps, &d_maps))
        })
        .collect();
    let mut gradient = [[[0.0f64; 3]; 16]; 3];
    for strip in &partial {
        for q in 0..9 {
            for b in 0..16 {
                gradient[q / 3][b][q % 3] += f64::from(strip[q * 16 + b]);
            }
        }
    }
    gradient
}

#[inline(always)]
fn backward_strip<S: Simd>(
    simd: S,
    rays: &Rays,
    degree: usize,
    rows: std::ops::Range<usize>,
    maps: &[&[f32]; 9],
    d_maps: &[&[f32]; 9],
) -> [f32; 144] {
    let width = rays.width();
    let zero = f32x16::splat(simd, 0.0);
    // A block's basis and raw gradients fit into the L1 cache; twelve accumulators sum the products at a
    // time.
    let mut basis = [[0.0f32; BLOCK]; 16];
    let mut raw = [[0.0f32; BLOCK]; 9];
    let mut totals = [zero; 144];
    let band_groups = bands(degree).div_ceil(4);
    for row in rows {
        for start in (0..width).step_by(BLOCK) {
            let vectors = (width - start).min(BLOCK).div_ceil(LANES);
            for v in 0..vectors {
                let i = start + v * LANES;
                let [x, y, z] = rays.directions(simd, i, row);
                let at_pixels = basis_lanes(simd, degree, x, y, z);
                for b in 0..4 * band_groups {
                    at_pixels[b].store_slice(&mut basis[b][v * LANES..][..LANES]);
                }
                for q in 0..9 {
                    let value = rows::load(simd, &maps[q][row * width..][..width], i);
                    let d_map = rows::load(simd, &d_maps[q][row * width..][..width], i);
                    let gradient = if q < 3 {
                        value.simd_gt(zero).select(d_map, zero)
                    } else {
                        d_map * functions::softplus_slope(simd, value)
                    };
                    gradient.store_slice(&mut raw[q][v * LANES..][..LANES]);
                }
            }
            for quantity in 0..3 {
                for group in 0..band_groups {
                    let mut sums = [zero; 12];
                    for v in 0..vectors {
                        let at = v * LANES;
                        for b in 0..4 {
                            let y = f32x16::from_slice(simd, &basis[group * 4 + b][at..at + LANES]);
                            for c in 0..3 {
                                let g = f32x16::from_slice(simd, &raw[quantity * 3 + c][at..at + LANES]);
                                sums[b * 3 + c] = y.mul_add(g, sums[b * 3 + c]);
                            }
                        }
                    }
                    for b in 0..4 {
                        for c in 0..3 {
                            totals[(quantity * 3 + c) * 16 + group * 4 + b] += sums[b * 3 + c];
                        }
                    }
                }
            }
        }
    }
    let mut out = [0.0; 144];
    for (o, t) in out.iter_mut().zip(&totals) {
        *o = t.as_slice().iter().sum();
    }
    out
}

/// The plain form of [`forward`], pixel by pixel, for tests.
#[cfg(test)]
pub(crate) fn forward_plain(
    coefficients: &Coefficients,
    camera: &Camera,
    lattice: &Lattice,
    degree: usize,
) -> MediumMaps {
    use use3d_numerics::math;
    use use3d_numerics::spherical_harmonics::basis;
    let mut out = MediumMaps::zeros(lattice.width(), lattice.height());
    for (j, &v) in lattice.rows().iter().enumerate() {
        for (i, &u) in lattice.columns().iter().enumerate() {
            let direction = use3d_capture::world_direction(camera, f64::from(u), f64::from(v));
            let y = basis(degree, direction);
            let raw = |quantity: usize| -> [f64; 3] {
                std::array::from_fn(|c| {
                    (0..16).map(|b| f64::from(y[b]) * f64::from(coefficients[quantity][b][c])).sum()
                })
            };
            let softplus = |x: f64| (x.max(0.0) + math::ln_1p(math::exp(-x.abs()))) as f32;
            out.color.set_pixel(i, j, raw(0).map(|x| (x + 0.5).max(0.0) as f32));
            out.backscatter.set_pixel(i, j, raw(1).map(softplus));
            out.attenuation.set_pixel(i, j, raw(2).map(softplus));
        }
    }
    out
}
