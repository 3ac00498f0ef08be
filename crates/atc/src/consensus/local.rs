//! Computes one local target per Gaussian from one map of local operators per view.
//!
//! The centred map of a view is resized to its camera and lifted to the Gaussians by the exact adjoint of
//! the splat, `v_i = [S_vᵀ Δ]_i / max(ω_i, 10⁻⁸)` with `ω_i = [S_vᵀ 1]_i` in pixels: object weights only,
//! no water (R21). Views are fused one by one in a fixed order. A Gaussian has the state `(μ, W, k)`, which
//! is zero at first. An observation with `ω > 10⁻⁸` updates it by
//!
//! ```text
//! q = 1 for k < 2,  else 1 / (1 + mean_j ((v − μ)_j / s_j)²)     (a Cauchy factor, in units of paired data)
//! W ← W + ω q,   μ ← μ + (ω q / max(W, 10⁻⁸)) (v − μ),   k ← k + 1
//! ```
//!
//! The Gaussian is supported once `k ≥ 2`. The result depends on the order of the views;
//! [`super::order_effect`] measures by how much.

use rayon::prelude::*;
use use3d_capture::{Camera, Lattice};
use use3d_numerics::math;
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

use crate::calibrator::SCALE_FLOOR;
use crate::error::AtcError;
use crate::extractor::resize::Resize;

/// Number of channels lifted together: six of the operator, and a channel of ones.
const CHANNELS: usize = 7;
/// Smallest visibility that counts, pixels.
const VISIBLE: f64 = 1e-8;
/// Number of views from which on a Gaussian is supported.
pub const SUPPORTING_VIEWS: u32 = 2;

/// The fused state of every Gaussian.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalConsensus {
    /// `μ`: the fused local operator.
    pub mean: Vec<[f32; 6]>,
    /// `W`: accumulated visibility times Cauchy factor, pixels.
    pub weight: Vec<f32>,
    /// `k`: number of views that saw it.
    pub count: Vec<u32>,
}

/// The adjoint of a scene's linear splat, `S_vᵀ`, on any device.
pub trait Adjoint {
    /// Number of Gaussians in the scene.
    fn gaussians(&self) -> usize;

    /// Lifts `planes` (`[channels][height][width]`, of the camera's size) to the Gaussians; overwrites
    /// `out` (`[N][channels]`).
    ///
    /// # Errors
    /// [`AtcError::Device`].
    fn lift(
        &mut self,
        camera: &Camera,
        channels: usize,
        planes: &[f32],
        out: &mut [f32],
    ) -> Result<(), AtcError>;
}

/// The adjoint on the processor.
struct OnProcessor<'a> {
    gaussians: &'a Gaussians,
    rasterizer: Rasterizer,
    prepared: Prepared,
}

impl Adjoint for OnProcessor<'_> {
    fn gaussians(&self) -> usize {
        self.gaussians.len()
    }

    fn lift(
        &mut self,
        camera: &Camera,
        channels: usize,
        planes: &[f32],
        out: &mut [f32],
    ) -> Result<(), AtcError> {
        let lattice = Lattice::size(camera.intrinsics.width, camera.intrinsics.height);
        // Splatting attributes needs no colours.
        self.prepared.prepare(self.gaussians, camera, &lattice, Colors::Sh { degree: 0 });
        self.rasterizer.splat_adjoint(&self.prepared, channels, planes, out);
        Ok(())
    }
}

/// One view's observation of every Gaussian, and its working memory.
pub struct Lift<'a> {
    adjoint: Box<dyn Adjoint + 'a>,
    maps: Vec<f32>,
    sums: Vec<f32>,
}

impl<'a> Lift<'a> {
    /// A lift on the processor. Its memory grows on first use (seven planes of the camera's size and seven
    /// numbers per Gaussian).
    pub fn new(gaussians: &'a Gaussians) -> Self {
        let (rasterizer, prepared) = (Rasterizer::new(), Prepared::new());
        Self::by(Box::new(OnProcessor { gaussians, rasterizer, prepared }))
    }

    /// A lift with a given adjoint.
    pub fn by(adjoint: Box<dyn Adjoint + 'a>) -> Self {
        Self { adjoint, maps: Vec::new(), sums: Vec::new() }
    }

    /// Number of Gaussians in the scene.
    pub fn gaussians(&self) -> usize {
        self.adjoint.gaussians()
    }

    /// Lifts a view's map of local operators (`grid` = columns, rows; row-major) to the Gaussians.
    ///
    /// # Errors
    /// [`AtcError::Device`].
    pub fn run(&mut self, camera: &Camera, grid: (usize, usize), cells: &[[f64; 6]]) -> Result<(), AtcError> {
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        let planes: Vec<f32> = (0..6).flat_map(|k| cells.iter().map(move |cell| cell[k] as f32)).collect();
        self.maps.resize(CHANNELS * w * h, 0.0);
        let (operators, ones) = self.maps.split_at_mut(6 * w * h);
        Resize::between(grid, (w, h)).forward_planes(&planes, operators);
        ones.fill(1.0);
        self.sums.resize(CHANNELS * self.gaussians(), 0.0);
        self.adjoint.lift(camera, CHANNELS, &self.maps, &mut self.sums)
    }

    /// The visibility `ω` of a Gaussian in the last view, pixels, and its observation `v`.
    pub fn observation(&self, gaussian: usize) -> (f32, [f32; 6]) {
        let row = &self.sums[CHANNELS * gaussian..CHANNELS * (gaussian + 1)];
        let (omega, v) = observation(row);
        (omega as f32, v.map(|v| v as f32))
    }
}

#[inline(always)]
fn observation(row: &[f32]) -> (f64, [f64; 6]) {
    let omega = f64::from(row[6]);
    (omega, std::array::from_fn(|k| f64::from(row[k]) / omega.max(VISIBLE)))
}

impl LocalConsensus {
    /// The state before any view, for `gaussians` Gaussians.
    pub fn new(gaussians: usize) -> Self {
        Self { mean: vec![[0.0; 6]; gaussians], weight: vec![0.0; gaussians], count: vec![0; gaussians] }
    }

    /// Fuses the last view of `lift`; `scales` are the `s_ℓ` of the calibrator, floored at 10⁻⁴ here too.
    pub fn fuse(&mut self, lift: &Lift<'_>, scales: &[f64; 6]) {
        let inverse = scales.map(|s| 1.0 / s.max(SCALE_FLOOR));
        const CHUNK: usize = 4096;
        self.mean
            .par_chunks_mut(CHUNK)
            .zip(self.weight.par_chunks_mut(CHUNK))
            .zip(self.count.par_chunks_mut(CHUNK))
            .zip(lift.sums.par_chunks(CHUNK * CHANNELS))
            .for_each(|(((means, weights), counts), rows)| {
                for (i, row) in rows.chunks_exact(CHANNELS).enumerate() {
                    let (omega, v) = observation(row);
                    if omega <= VISIBLE {
                        continue;
                    }
                    let mean = means[i].map(f64::from);
                    let factor = if counts[i] < SUPPORTING_VIEWS {
                        1.0
                    } else {
                        let square: f64 =
                            (0..6).map(|k| math::powi((v[k] - mean[k]) * inverse[k], 2)).sum::<f64>() / 6.0;
                        1.0 / (1.0 + square)
                    };
                    let evidence = omega * factor;
                    let weight = f64::from(weights[i]) + evidence;
                    let step = evidence / weight.max(VISIBLE);
                    means[i] = std::array::from_fn(|k| (mean[k] + step * (v[k] - mean[k])) as f32);
                    weights[i] = weight as f32;
                    counts[i] += 1;
                }
            });
    }

    /// True if the Gaussian has a target.
    #[inline]
    pub fn supported(&self, gaussian: usize) -> bool {
        self.count[gaussian] >= SUPPORTING_VIEWS
    }
}
