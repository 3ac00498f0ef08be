//! The field computed directly from the formulas, one Gaussian and one pixel at a time: the twin against
//! which the kernels are tested.
//!
//! [`raw`] repeats the kernel's operations in the same order (equal bits where multiply and add fuse);
//! [`Exact`] computes everything in f64, which is accurate enough for finite differences.

use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::C0;

use crate::OUTPUTS;
use crate::field::{Field, Shape};
use crate::field_box::FieldBox;
use crate::guide::locate;
use crate::water::ROWS;
use use3d_numerics::functions;

/// Computes the decoder's outputs at field coordinates `u` (x, y, z, γ), with the kernel's arithmetic.
pub(crate) fn raw(field: &Field, u: [f32; 4]) -> [f32; OUTPUTS] {
    let s = field.shape();
    let p = &field.parameters;
    let factors = &p[s.factors()];
    let z: Vec<f32> = (0..s.rank)
        .map(|r| {
            let f: [f32; 4] = std::array::from_fn(|axis| {
                let (node, t) = locate(u[axis], s.resolution);
                let low = factors[(axis * s.resolution + node) * s.rank + r];
                let high = factors[(axis * s.resolution + node + 1) * s.rank + r];
                low + t * (high - low)
            });
            f[0] * f[1] * f[2] * f[3]
        })
        .collect();
    let mut out: [f32; OUTPUTS] = std::array::from_fn(|o| p[s.output_bias()][o]);
    for unit in 0..s.width {
        let mut pre = p[s.hidden_bias()][unit];
        for r in 0..s.rank {
            pre = z[r].mul_add(p[s.hidden_weight()][unit * s.rank + r], pre);
        }
        let hidden = pre * functions::scalar::logistic(pre);
        for o in 0..OUTPUTS {
            out[o] = hidden.mul_add(p[s.output_weight()][o * s.width + unit], out[o]);
        }
    }
    out
}

/// The field in f64, whose parameters can change by less than the resolution of f32.
pub(crate) struct Exact {
    pub(crate) shape: Shape,
    pub(crate) bounds: FieldBox,
    pub(crate) parameters: Vec<f64>,
}

impl Exact {
    pub(crate) fn new(field: &Field) -> Self {
        let parameters = field.parameters.iter().map(|&p| f64::from(p)).collect();
        Self { shape: field.shape(), bounds: field.bounds, parameters }
    }

    fn coordinates(&self, position: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|a| {
            let (low, high) = (f64::from(self.bounds.low[a]), f64::from(self.bounds.high[a]));
            (2.0 * (f64::from(position[a]) - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
        })
    }

    fn gamma(&self, color: [f64; 3]) -> f64 {
        let g = &self.parameters[self.shape.guide()];
        let h = color.map(|c| math::ln_1p(c.abs()).copysign(c));
        math::tanh(g[0] * h[0] + g[1] * h[1] + g[2] * h[2] + g[3])
    }

    fn raw(&self, u: [f64; 4]) -> [f64; OUTPUTS] {
        let s = self.shape;
        let p = &self.parameters;
        let z: Vec<f64> = (0..s.rank)
            .map(|r| {
                (0..4)
                    .map(|axis| {
                        let at = (u[axis] + 1.0) * 0.5 * (s.resolution - 1) as f64;
                        let node = (at as usize).min(s.resolution - 2);
                        let f = |n: usize| p[(axis * s.resolution + n) * s.rank + r];
                        f(node) + (at - node as f64) * (f(node + 1) - f(node))
                    })
                    .product()
            })
            .collect();
        let mut out: [f64; OUTPUTS] = std::array::from_fn(|o| p[s.output_bias()][o]);
        for unit in 0..s.width {
            let weights = &p[s.hidden_weight()][unit * s.rank..];
            let pre = p[s.hidden_bias()][unit] + z.iter().zip(weights).map(|(z, w)| z * w).sum::<f64>();
            let hidden = pre / (1.0 + math::exp(-pre));
            for o in 0..OUTPUTS {
                out[o] += p[s.output_weight()][o * s.width + unit] * hidden;
            }
        }
        out
    }

    fn graded(&self, c: [f64; 3]) -> [f64; 3] {
        let a = &self.parameters[self.shape.affine()];
        std::array::from_fn(|r| {
            c[r] + a[4 * r] * c[0] + a[4 * r + 1] * c[1] + a[4 * r + 2] * c[2] + a[4 * r + 3]
        })
    }

    /// `c⁺` of all Gaussians.
    pub(crate) fn colors(&self, means: &[[f32; 3]], sh_dc: &[[f32; 3]], base: &[[f32; 3]]) -> Vec<[f64; 3]> {
        let raw: Vec<[f64; OUTPUTS]> = means
            .iter()
            .zip(sh_dc)
            .map(|(&m, dc)| {
                let [x, y, z] = self.coordinates(m);
                let guide = dc.map(|v| 0.5 + f64::from(C0) * f64::from(v));
                self.raw([x, y, z, self.gamma(guide)])
            })
            .collect();
        let mean: [f64; OUTPUTS] =
            std::array::from_fn(|o| raw.iter().map(|r| r[o]).sum::<f64>() / raw.len() as f64);
        raw.iter()
            .zip(base)
            .map(|(raw, c)| {
                let graded = self.graded(c.map(f64::from));
                std::array::from_fn(|o| math::exp(raw[o] - mean[o]) * graded[o] + raw[3 + o] - mean[3 + o])
            })
            .collect()
    }

    /// `c_m⁺` of pixels seen from `camera`.
    pub(crate) fn water(&self, camera: [f32; 3], c_m: &[[f32; 3]]) -> Vec<[f64; 3]> {
        let [x, y, z] = self.coordinates(camera);
        let mut table: Vec<[f64; OUTPUTS]> =
            (0..ROWS).map(|k| self.raw([x, y, z, 2.0 * k as f64 / (ROWS - 1) as f64 - 1.0])).collect();
        for o in 0..OUTPUTS {
            let mean = table.iter().map(|r| r[o]).sum::<f64>() / ROWS as f64;
            for row in &mut table {
                row[o] -= mean;
                row[o] = if o < 3 { math::exp(row[o]) } else { row[o] };
            }
        }
        c_m.iter()
            .map(|c| {
                let c = c.map(f64::from);
                let at = (self.gamma(c) + 1.0) * 0.5 * (ROWS - 1) as f64;
                let k = (at as usize).min(ROWS - 2);
                let row = |o: usize| table[k][o] + (at - k as f64) * (table[k + 1][o] - table[k][o]);
                let graded = self.graded(c);
                std::array::from_fn(|o| row(o) * graded[o] + row(3 + o))
            })
            .collect()
    }

    /// The ratios of β_bs and β_attn.
    pub(crate) fn ratios(&self) -> [f64; 2] {
        let u = &self.parameters[self.shape.transport()];
        [u[0], u[1]].map(|u| math::exp(math::ln(4f64) * math::tanh(u)))
    }

    /// Mean absolute first difference of the factors.
    pub(crate) fn variation(&self) -> f64 {
        let s = self.shape;
        let f = &self.parameters[s.factors()];
        let mut total = 0.0;
        for axis in f.chunks_exact(s.resolution * s.rank) {
            total += axis.iter().zip(&axis[s.rank..]).map(|(a, b)| (b - a).abs()).sum::<f64>();
        }
        total / (4 * (s.resolution - 1) * s.rank) as f64
    }
}
