//! The distance of a rendered view from its reference, and its derivative: the part of a step that is the
//! same for every engine.
//!
//! The extractor solves its systems in f64, over means of a few thousand pixels. An engine on another
//! device passes a view's render in and gets the gradient back; both are as small as the lattice that steps
//! render. The table of [terms](crate::losses::TERMS) defines what is computed.

use use3d_atc::extractor::{Affine, Transition, Workspace};
use use3d_capture::Image;
use use3d_ubaf::{Field, Gradient};

use crate::losses::{COUNT, Operators, Pixels, Reads, Realised, StepLosses, TERMS};
use crate::params::PixelLoss;
use crate::views::{Guidance, Reference};
use crate::{EnhanceError, EnhanceParams};

/// The goals of all steps, except each view's own reference, and the weight of each term.
#[derive(Clone, Debug)]
pub struct Goals {
    pub(crate) operator: Affine,
    pub(crate) global_scales: [f64; 12],
    pub(crate) local_scales: [f64; 6],
    pub(crate) pixel_loss: PixelLoss,
    /// One weight per row of the table.
    pub(crate) weights: [f64; COUNT],
}

impl Goals {
    /// The goals that follow from guidance and parameters.
    pub fn new(guidance: Guidance<'_>, params: &EnhanceParams) -> Self {
        let none = ([0.0; 12], [1.0; 12], [1.0; 6]);
        let (operator, global_scales, local_scales) =
            guidance.targets().map_or(none, |t| (t.scene, t.global_scales, t.local_scales));
        let weights = TERMS.map(|row| (row.weight)(params));
        Self { operator, global_scales, local_scales, pixel_loss: params.pixel_loss, weights }
    }

    /// Adds the values of the terms that read the field itself.
    pub fn of_field(&self, field: &Field, losses: &mut StepLosses) {
        for (at, (row, &weight)) in TERMS.iter().zip(&self.weights).enumerate() {
            if let Reads::Field { value, .. } = row.reads {
                losses.put(at, weight, Realised { loss: value(field), error: 0.0 });
            }
        }
    }

    /// Adds the weighted gradients of the terms that read the field itself.
    pub fn field_backward(&self, field: &Field, gradient: &mut Gradient) {
        for (row, &weight) in TERMS.iter().zip(&self.weights) {
            if let Reads::Field { backward, .. } = row.reads {
                backward(field, weight, gradient);
            }
        }
    }
}

/// Compares renders with their references; its working memory is reused.
#[derive(Clone, Debug, Default)]
pub struct Measure {
    workspace: Workspace,
    d_operators: Transition,
    d_pixels: Image,
}

impl Measure {
    /// Computes the losses of `image`, a render on the lattice of its reference, and their gradient with
    /// respect to it if `d_image` is given. The terms that read the field are not included: see
    /// [`Goals::of_field`].
    pub fn losses(
        &mut self,
        reference: &Reference,
        goals: &Goals,
        image: &Image,
        d_image: Option<&mut Image>,
    ) -> Result<StepLosses, EnhanceError> {
        let mut losses = StepLosses::default();
        let terms = || TERMS.iter().zip(&goals.weights).enumerate();
        match reference {
            Reference::Transition(source, target) => {
                let realised = source.forward_on_lattice(image, &mut self.workspace)?;
                let Transition { global, local } = &mut self.d_operators;
                global.fill(0.0);
                local.clear();
                local.resize(realised.local.len(), [0.0; 6]);
                let seen = Operators { realised, target, goals };
                for (at, (row, &weight)) in terms() {
                    if let Reads::Operators(term) = row.reads {
                        losses.put(at, weight, term(&seen, weight, &mut self.d_operators));
                    }
                }
                if let Some(d_image) = d_image {
                    let Transition { global, local } = &self.d_operators;
                    d_image.resize(image.width(), image.height());
                    source.backward_on_lattice(global, local, &mut self.workspace, d_image)?;
                }
            }
            Reference::Label(label) => {
                let d_image = d_image.unwrap_or(&mut self.d_pixels);
                d_image.resize(image.width(), image.height());
                d_image.data_mut().fill(0.0);
                let seen = Pixels { image, label, compared: goals.pixel_loss };
                for (at, (row, &weight)) in terms() {
                    if let Reads::Pixels(term) = row.reads {
                        let loss = term(&seen, weight, d_image);
                        losses.put(at, weight, Realised { loss, error: 0.0 });
                    }
                }
            }
        }
        Ok(losses)
    }

    /// The transition that the last [`Measure::losses`] extracted from a render.
    #[cfg(test)]
    pub(crate) fn transition(&self) -> &Transition {
        &self.workspace.transition
    }
}
