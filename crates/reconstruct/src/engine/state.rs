//! An engine's state as plain arrays: what a checkpoint holds. On the way out they are the engine's own, borrowed.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};
use use3d_splat::Gaussians;

use crate::exposure::ExposureArrays;

/// The five arrays of [`Gaussians`], flat.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GaussianArrays<'a> {
    sh_degree: usize,
    means: Cow<'a, [f32]>,
    log_scales: Cow<'a, [f32]>,
    quaternions: Cow<'a, [f32]>,
    opacity_logits: Cow<'a, [f32]>,
    sh: Cow<'a, [f32]>,
}

impl<'a> From<&'a Gaussians> for GaussianArrays<'a> {
    fn from(g: &'a Gaussians) -> Self {
        Self {
            sh_degree: g.sh_degree,
            means: g.means.as_flattened().into(),
            log_scales: g.log_scales.as_flattened().into(),
            quaternions: g.quaternions.as_flattened().into(),
            opacity_logits: (&g.opacity_logits).into(),
            sh: g.sh.as_flattened().as_flattened().into(),
        }
    }
}

impl GaussianArrays<'_> {
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
            opacity_logits: self.opacity_logits.to_vec(),
            sh: bytemuck::cast_slice(&self.sh).to_vec(),
        })
    }
}

/// Parameters, moments and statistics of a run between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EngineState<'a> {
    pub(crate) gaussians: GaussianArrays<'a>,
    pub(crate) first: GaussianArrays<'a>,
    pub(crate) second: GaussianArrays<'a>,
    pub(crate) norms: Cow<'a, [f32]>,
    pub(crate) renders: Cow<'a, [u32]>,
    /// The water's flat parameters and moments.
    pub(crate) medium: [Cow<'a, [f32]>; 3],
    /// The views' gains.
    pub(crate) exposures: ExposureArrays<'a>,
}
