//! MediumRBF: water that varies with the camera's position and viewing direction.
//!
//! Anchors `k` with centre `p_k`, width `σ_k = max(e^{l_k}, 1e-4)` and spherical-harmonic coefficients `A_k`.
//! For a camera at `o`, clamped to `[-1.5, 1.5]` per axis of the normalised scene (R4), the `K` anchors of
//! highest affinity `ρ_k` share a softmax:
//!
//! ```text
//! ρ_k = -|o - p_k|² / (2 σ_k²)      w = softmax over the K largest ρ      A = Σ_k w_k A_k
//! ```
//!
//! `A` is then evaluated along every pixel's ray (`directional`). Among equal affinities the lower index
//! wins. The selection is not differentiated, so the medium jumps where the K-th and the next anchor change
//! places; the camera's position is not differentiated either. The maximum is subtracted before the
//! exponential, because affinities of narrow anchors lie far below the range of `exp`.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_numerics::math;

use crate::directional::{
    self, CoefficientGradients, Coefficients, initial_coefficients, numbers, numbers_mut,
};
use crate::medium::{Anchors, Harmonics, Medium, MediumStart};
use crate::tensors::{self, MOST_ANCHORS, Put, Tensors};
use crate::{MediumError, Role};

/// Smallest width, scene units.
const WIDTH_FLOOR: f64 = 1e-4;
/// Camera coordinates are clamped to ± this value, normalised scene units (R4).
const QUERY_LIMIT: f64 = 1.5;

/// The anchors of a MediumRBF.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumRbf {
    /// Anchor centres `p_k`, normalised scene units.
    pub centers: Vec<[f32; 3]>,
    /// `l_k = ln σ_k`.
    pub log_widths: Vec<f32>,
    /// `A_k`: `[c_m, β_bs, β_attn][band][RGB]`.
    pub coefficients: Vec<Coefficients>,
    /// Number `K` of anchors that share a view.
    pub top_k: usize,
}

impl MediumRbf {
    /// The initial state (R5): 8 anchors at the corners of the normalised cube, x slowest, σ = 0.85. Other
    /// numbers of anchors are spread evenly over the sphere through those corners (a Fibonacci lattice).
    /// All anchors are alike: `c_m = 0.5`, `β = softplus(-5 Y₀₀) = 0.218`.
    pub fn new(anchors: usize, top_k: usize) -> Self {
        let center = |k: usize| -> [f32; 3] {
            if anchors == 8 {
                return std::array::from_fn(|axis| if k >> (2 - axis) & 1 == 1 { 1.0 } else { -1.0 });
            }
            let z = 1.0 - (2.0 * k as f64 + 1.0) / anchors as f64;
            let (r, phi) = ((1.0 - z * z).sqrt(), k as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt()));
            [r * math::cos(phi), r * math::sin(phi), z].map(|v| (v * 3f64.sqrt()) as f32)
        };
        Self {
            centers: (0..anchors).map(center).collect(),
            log_widths: vec![math::ln(0.85f32); anchors],
            coefficients: vec![initial_coefficients(); anchors],
            top_k: top_k.clamp(1, anchors.max(1)),
        }
    }

    /// The aggregated coefficients `A` of a view.
    pub fn aggregate(&self, camera: &Camera) -> Coefficients {
        let mut sum = [[[0.0f64; 3]; 16]; 3];
        for (k, w) in self.selection(camera) {
            for (sum, &a) in numbers_mut(&mut sum).iter_mut().zip(numbers(&self.coefficients[k])) {
                *sum += w * f64::from(a);
            }
        }
        sum.map(|quantity| quantity.map(|band| band.map(|v| v as f32)))
    }

    /// Adds the gradients with respect to centres, log widths and coefficients, computed from those with
    /// respect to `A`.
    fn backward_of_coefficients(
        &self,
        camera: &Camera,
        aggregate: &CoefficientGradients,
        gradient: &mut Self,
    ) {
        let o = query(camera);
        let selection = self.selection(camera);
        // dL/dw_k, then through the softmax to dL/dρ_k.
        let d_weights: Vec<f64> = selection
            .iter()
            .map(|&(k, _)| {
                let pairs = numbers(aggregate).iter().zip(numbers(&self.coefficients[k]));
                pairs.fold(0.0, |dot, (d, &a)| dot + d * f64::from(a))
            })
            .collect();
        let mean: f64 = selection.iter().zip(&d_weights).map(|(&(_, w), d)| w * d).sum();
        for (&(k, w), d_weight) in selection.iter().zip(&d_weights) {
            for (gradient, d) in numbers_mut(&mut gradient.coefficients[k]).iter_mut().zip(numbers(aggregate))
            {
                *gradient += (w * d) as f32;
            }
            let d_affinity = w * (d_weight - mean);
            let (sigma, floored) = self.sigma(k);
            let offset: [f64; 3] = std::array::from_fn(|axis| o[axis] - f64::from(self.centers[k][axis]));
            for axis in 0..3 {
                gradient.centers[k][axis] += (d_affinity * offset[axis] / (sigma * sigma)) as f32;
            }
            if !floored {
                let squared: f64 = offset.iter().map(|v| v * v).sum();
                gradient.log_widths[k] += (d_affinity * squared / (sigma * sigma)) as f32;
            }
        }
    }

    /// `σ_k`, and true if it is held at its floor.
    fn sigma(&self, k: usize) -> (f64, bool) {
        let sigma = math::exp(f64::from(self.log_widths[k]));
        (sigma.max(WIDTH_FLOOR), sigma < WIDTH_FLOOR)
    }

    /// The `K` anchors of highest affinity with their softmax weights, best first.
    pub(crate) fn selection(&self, camera: &Camera) -> Vec<(usize, f64)> {
        let o = query(camera);
        let mut scored: Vec<(usize, f64)> = (0..self.centers.len())
            .map(|k| {
                let (sigma, _) = self.sigma(k);
                let squared: f64 = (0..3).map(|a| math::powi(o[a] - f64::from(self.centers[k][a]), 2)).sum();
                (k, -squared / (2.0 * sigma * sigma))
            })
            .collect();
        scored.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        scored.truncate(self.top_k.max(1));
        let best = scored.first().map_or(0.0, |s| s.1);
        let total: f64 = scored.iter().map(|s| math::exp(s.1 - best)).sum();
        for s in &mut scored {
            s.1 = math::exp(s.1 - best) / total;
        }
        scored
    }
}

impl Medium for MediumRbf {
    const FROM_HARMONICS: bool = true;

    fn start(start: &MediumStart) -> Result<Self, MediumError> {
        check(start.anchors, start.top_k)?;
        Ok(Self::new(start.anchors, start.top_k))
    }

    fn set_harmonics(&mut self, coefficients: &Coefficients) {
        self.coefficients.fill(*coefficients);
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps) {
        directional::forward(&self.aggregate(camera), camera, lattice, degree, out);
    }

    fn backward(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        degree: usize,
        maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    ) {
        let sums = directional::backward(camera, lattice, degree, maps, d_maps);
        self.backward_of_coefficients(camera, &sums, gradient);
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        let mut groups = vec![
            (Role::Anchor, bytemuck::cast_slice(&self.centers)),
            (Role::Anchor, self.log_widths.as_slice()),
        ];
        groups.extend(directional::runs(bytemuck::cast_slice(&self.coefficients)));
        groups
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        let mut groups = vec![
            (Role::Anchor, bytemuck::cast_slice_mut(&mut self.centers)),
            (Role::Anchor, self.log_widths.as_mut_slice()),
        ];
        groups.extend(directional::runs_mut(bytemuck::cast_slice_mut(&mut self.coefficients)));
        groups
    }

    fn write(&self, put: Put<'_>) {
        let anchors = self.centers.len();
        put("centers", &[anchors, 3], bytemuck::cast_slice(&self.centers));
        put("log_widths", &[anchors], &self.log_widths);
        put("coefficients", &[anchors, 3, 16, 3], bytemuck::cast_slice(&self.coefficients));
    }

    fn read(top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let widths = tensors.get("log_widths");
        let anchors = widths.ok_or_else(|| MediumError::Missing { name: "log_widths".into() })?.values.len();
        check(anchors, top_k)?;
        let centers = tensors::get(tensors, "centers", &[anchors, 3])?;
        let log_widths = tensors::get(tensors, "log_widths", &[anchors])?.to_vec();
        let coefficients = tensors::get(tensors, "coefficients", &[anchors, 3, 16, 3])?;
        Ok(Self {
            centers: centers.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
            log_widths,
            coefficients: tensors::coefficients(coefficients),
            top_k,
        })
    }

    fn harmonics(&self) -> Option<Harmonics<'_>> {
        let anchors = Anchors { centers: &self.centers, log_widths: &self.log_widths, top_k: self.top_k };
        Some(Harmonics { coefficients: &self.coefficients, anchors: Some(anchors) })
    }
}

/// Checks that the number of anchors is allowed, and that `top_k` is at most that number.
fn check(anchors: usize, top_k: usize) -> Result<(), MediumError> {
    if anchors == 0 || anchors > MOST_ANCHORS {
        return Err(MediumError::Anchors { found: anchors, most: MOST_ANCHORS });
    }
    if top_k == 0 || top_k > anchors {
        return Err(MediumError::TopK { top_k, anchors });
    }
    Ok(())
}

/// The camera's position, clamped (R4).
fn query(camera: &Camera) -> [f64; 3] {
    camera.pose.center().to_array().map(|v| v.clamp(-QUERY_LIMIT, QUERY_LIMIT))
}
