//! MediumRBF and the media it is compared with.
//!
//! For a camera and a lattice of pixels, a medium model computes the water along each pixel's ray: its
//! colour at infinity `c_m` (display range) and the backscatter and attenuation coefficients `β_bs`,
//! `β_attn` (1 / scene unit), each per RGB channel. The compositor does the rest. Models are rows of one
//! table (`kinds`): [`MediumRbf`] (the method's), one set of spherical harmonics for the whole scene
//! ([`MediumGlobal`], as in Plenodium), a network of the direction ([`MediumMlp`], as in WaterSplatting), and
//! free numbers of every training view ([`MediumPerView`], as in MarineSTD-GS).
//! The kind `none` has no row and no parameters. The water of all of these lies in front of every Gaussian. A
//! further row applies the water of [`MediumGlobal`] to the finished image. [`MediumSeasplat`] is the water
//! of SeaSplat itself, and [`MediumUir`] that of 3D-UIR.
//!
//! `backward` is the exact adjoint of `maps` and adds to a gradient that has the model's own type.
//! For optimisers, every model is a flat vector of parameters in a fixed order with a [`Role`]
//! each ([`MediumModel::update`]).

mod directional;
mod global;
mod kinds;
mod medium;
mod mlp;
mod per_view;
mod rbf;
mod seasplat;
mod tensors;
mod uir;

pub use directional::Coefficients;
pub use global::MediumGlobal;
pub use kinds::{MediumKind, MediumModel};
pub use medium::{Anchors, Harmonics, MediumStart};
pub use mlp::MediumMlp;
pub use per_view::MediumPerView;
pub use rbf::MediumRbf;
pub use seasplat::MediumSeasplat;
pub use tensors::{MOST_ANCHORS, Tensor, Tensors};
pub use uir::MediumUir;

/// The role of a parameter, by which an optimiser chooses its learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A constant (band 0) spherical-harmonic coefficient.
    Constant,
    /// A coefficient of a higher band.
    Directional,
    /// An anchor's centre or log width.
    Anchor,
    /// A weight or bias of the network.
    Network,
}

/// An error in a medium's tensors.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MediumError {
    /// A tensor is missing.
    #[error("the medium has no tensor `{name}`")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape than expected.
    #[error("medium tensor `{name}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// Shape found.
        found: Vec<usize>,
        /// Shape expected.
        expected: Vec<usize>,
    },
    /// A value is not finite.
    #[error("medium tensor `{name}` is not finite at element {index}")]
    NotFinite {
        /// Its name.
        name: String,
        /// First bad element.
        index: usize,
    },
    /// Water of single views has no view.
    #[error("the medium has no training views; expected one or more, each with its own water")]
    Views,
    /// There are no anchors, or too many.
    #[error("the medium has {found} anchors; expected 1 to {most}")]
    Anchors {
        /// Number found.
        found: usize,
        /// Largest number accepted.
        most: usize,
    },
    /// `top_k` lies outside `1..=anchors`.
    #[error("the medium's top_k is {top_k}; expected 1 to {anchors}, its number of anchors")]
    TopK {
        /// Value found.
        top_k: usize,
        /// Number of anchors.
        anchors: usize,
    },
}

impl MediumModel {
    /// True if there is no water.
    pub fn is_none(&self) -> bool {
        matches!(self, Self::None)
    }

    /// A gradient accumulator of the same kind and size.
    pub fn zeros_like(&self) -> Self {
        let mut zeros = self.clone();
        zeros.clear();
        zeros
    }

    /// Sets every parameter to zero.
    pub fn clear(&mut self) {
        for (_, values) in self.groups_mut() {
            values.fill(0.0);
        }
    }

    /// Number of parameters.
    pub fn parameter_count(&self) -> usize {
        self.groups().iter().map(|(_, values)| values.len()).sum()
    }

    /// Walks through model and gradient together, in the fixed order of the flat parameter vector:
    /// `f(role, offset, parameters, gradient)` with slices of equal length; `offset` is the first
    /// parameter's index in the flat vector.
    pub fn update(&mut self, gradient: &Self, mut f: impl FnMut(Role, usize, &mut [f32], &[f32])) {
        let mut offset = 0;
        for ((role, values), (_, slopes)) in self.groups_mut().into_iter().zip(gradient.groups()) {
            let count = values.len();
            f(role, offset, values, slopes);
            offset += count;
        }
    }

    /// Scales the numbers of a role down to a joint norm of at most `most`: of a gradient, its clipping.
    pub fn clip(&mut self, role: Role, most: f64) {
        let of = |(own, values): &(Role, &[f32])| match *own == role {
            true => values.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>(),
            false => 0.0,
        };
        let norm = self.groups().iter().map(of).sum::<f64>().sqrt();
        if norm > most {
            let scale = (most / norm) as f32;
            let own = self.groups_mut().into_iter().filter(|(own, _)| *own == role);
            own.for_each(|(_, values)| values.iter_mut().for_each(|v| *v *= scale));
        }
    }

    /// The parameters one after another: the same order as [`MediumModel::update`].
    pub fn flat(&self) -> Vec<f32> {
        self.groups().iter().flat_map(|(_, values)| values.iter().copied()).collect()
    }

    /// Sets the parameters from the result of [`MediumModel::flat`]; returns `false` and changes nothing if
    /// the length differs.
    pub fn set_flat(&mut self, values: &[f32]) -> bool {
        if values.len() != self.parameter_count() {
            return false;
        }
        let mut rest = values;
        for (_, group) in self.groups_mut() {
            let (head, tail) = rest.split_at(group.len());
            group.copy_from_slice(head);
            rest = tail;
        }
        true
    }
}

#[cfg(test)]
mod tests;
