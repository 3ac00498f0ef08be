//! How far a rendered view is from what it is compared with, and the derivative of that: the part of a step that every engine does alike.
//!
//! The extractor solves its systems in f64, over means of a few thousand pixels. An engine on another device hands a view's render over
//! and takes the derivative back; both are as small as the lattice that steps render.

use use3d_atc::extractor::{Affine, Workspace};
use use3d_capture::Image;

use super::StepLosses;
use crate::losses::{global_loss, local_loss};
use crate::params::PixelLoss;
use crate::views::{Guidance, Reference};
use crate::{EnhanceError, EnhanceParams};

/// What steps aim at, apart from each view's own reference.
#[derive(Clone, Debug)]
pub struct Goals {
    pub(crate) operator: Affine,
    pub(crate) global_scales: [f64; 12],
    pub(crate) local_scales: [f64; 6],
    pub(crate) lambda_global: f64,
    pub(crate) lambda_local: f64,
    pub(crate) lambda_variation: f64,
    pub(crate) pixel_loss: PixelLoss,
}

impl Goals {
    /// As guidance and parameters say.
    pub fn new(guidance: Guidance<'_>, params: &EnhanceParams) -> Self {
        let (lambda_global, lambda_local) = params.transition_weights();
        let (operator, global_scales, local_scales) = match guidance {
            Guidance::Targets(t) => (t.scene, t.global_scales, t.local_scales),
            Guidance::Labels(_) => ([0.0; 12], [1.0; 12], [1.0; 6]),
        };
        Self {
            operator,
            global_scales,
            local_scales,
            lambda_global,
            lambda_local,
            lambda_variation: params.lambda_variation,
            pixel_loss: params.pixel_loss,
        }
    }
}

/// Compares renders with their references; keeps its working memory from one to the next.
#[derive(Clone, Debug, Default)]
pub struct Measure {
    workspace: Workspace,
    cells: Vec<[f64; 6]>,
    d_cells: Vec<[f64; 6]>,
}

impl Measure {
    /// Losses of `image`, a render on the lattice of its reference, and their derivative in it if `d_image` is given. The field's total
    /// variation is not among them.
    pub fn losses(
        &mut self,
        reference: &Reference,
        goals: &Goals,
        image: &Image,
        d_image: Option<&mut Image>,
    ) -> Result<StepLosses, EnhanceError> {
        let mut losses = StepLosses::default();
        match reference {
            Reference::Transition(source, target) => {
                let realised = source.forward_on_lattice(image, &mut self.workspace)?;
                let mut d_operator = [0.0; 12];
                losses.global = global_loss(
                    &realised.global,
                    &goals.operator,
                    &goals.global_scales,
                    goals.lambda_global,
                    &mut d_operator,
                );
                self.cells.clear();
                self.cells.extend_from_slice(&realised.local);
                losses.local = local_loss(
                    &mut self.cells,
                    &target.local,
                    &target.weight,
                    &goals.local_scales,
                    goals.lambda_local,
                    &mut self.d_cells,
                );
                if let Some(d_image) = d_image {
                    d_image.resize(image.width(), image.height());
                    source.backward_on_lattice(&d_operator, &self.d_cells, &mut self.workspace, d_image)?;
                }
            }
            Reference::Label(label) => {
                let scale = 1.0 / image.data().len().max(1) as f64;
                let mut total = 0.0;
                let mut slopes = d_image.map(|d_image| {
                    d_image.resize(image.width(), image.height());
                    d_image.data_mut().iter_mut()
                });
                for (&value, &wanted) in image.data().iter().zip(label.data()) {
                    let e = f64::from(value) - f64::from(wanted) / 65535.0;
                    let (term, slope) = match goals.pixel_loss {
                        PixelLoss::L1 => (e.abs(), if e == 0.0 { 0.0 } else { e.signum() }),
                        PixelLoss::L2 => (e * e, 2.0 * e),
                    };
                    total += term;
                    if let Some(d) = slopes.as_mut().and_then(Iterator::next) {
                        *d = (slope * scale) as f32;
                    }
                }
                losses.pixels = total * scale;
            }
        }
        losses.total =
            goals.lambda_global * losses.global.loss + goals.lambda_local * losses.local.loss + losses.pixels;
        Ok(losses)
    }

    /// The transition that the last [`Measure::losses`] read off a render.
    #[cfg(test)]
    pub(crate) fn transition(&self) -> &use3d_atc::extractor::Transition {
        self.workspace.transition()
    }
}
