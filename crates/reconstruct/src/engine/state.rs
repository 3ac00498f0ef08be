//! An engine's state as plain arrays: what a checkpoint holds.

use serde::{Deserialize, Serialize};
use use3d_splat::Gaussians;

/// The five arrays of [`Gaussians`], flat.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GaussianArrays {
    sh_degree: usize,
    means: Vec<f32>,
    log_scales: Vec<f32>,
    quaternions: Vec<f32>,
    opacity_logits: Vec<f32>,
    sh: Vec<f32>,
}

impl From<&Gaussians> for GaussianArrays {
    fn from(g: &Gaussians) -> Self {
        Self {
            sh_degree: g.sh_degree,
            means: g.means.as_flattened().to_vec(),
            log_scales: g.log_scales.as_flattened().to_vec(),
            quaternions: g.quaternions.as_flattened().to_vec(),
            opacity_logits: g.opacity_logits.clone(),
            sh: g.sh.as_flattened().as_flattened().to_vec(),
        }
    }
}

impl GaussianArrays {
    /// The Gaussians, if the lengths agree.
    pub fn to_gaussians(&self) -> Option<Gaussians> {
        let n = self.opacity_logits.len();
        let fits = self.means.len() == 3 * n
            && self.log_scales.len() == 3 * n
            && self.quaternions.len() == 4 * n
            && self.sh.len() == 48 * n
            && self.sh_degree <= 3;
        fits.then(|| Gaussians {
            sh_degree: self.sh_degree,
            means: bytemuck::cast_slice(&self.means).to_vec(),
            log_scales: bytemuck::cast_slice(&self.log_scales).to_vec(),
            quaternions: bytemuck::cast_slice(&self.quaternions).to_vec(),
            opacity_logits: self.opacity_logits.clone(),
            sh: bytemuck::cast_slice(&self.sh).to_vec(),
        })
    }
}

/// Parameters, moments and statistics of a run between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EngineState {
    pub(crate) gaussians: GaussianArrays,
    pub(crate) first: GaussianArrays,
    pub(crate) second: GaussianArrays,
    pub(crate) norms: Vec<f32>,
    pub(crate) renders: Vec<u32>,
    /// The water's flat parameters and moments.
    pub(crate) medium: [Vec<f32>; 3],
}
