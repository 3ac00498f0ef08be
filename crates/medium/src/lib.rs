//! MediumRBF and the media it is compared with.
//!
//! A medium model says, for a camera and the pixels looked at, what the water does along each pixel's ray: its colour at infinity
//! `c_m` (display range) and the backscatter and attenuation coefficients `β_bs`, `β_attn` (1 / scene unit), each per RGB channel. The
//! compositor does the rest. Four models share one enum: [`MediumRbf`] (the method's), one set of spherical harmonics for the whole
//! scene ([`MediumGlobal`], as in Plenodium), a network of the direction ([`MediumMlp`], as in WaterSplatting), and no water at all.
//!
//! `backward` is the exact adjoint of `maps` and adds to a gradient that has the model's own type. For optimisers, every model is a
//! flat vector of parameters in a fixed order with a [`Role`] each ([`MediumModel::update`]).

mod directional;
mod lanes;
mod mlp;
mod rbf;
mod tensors;

use use3d_capture::{Camera, Lattice, MediumMaps};

pub use directional::Coefficients;
pub use mlp::MediumMlp;
pub use rbf::MediumRbf;
pub use tensors::{MOST_ANCHORS, Tensor, Tensors};

/// One set of spherical harmonics for the whole scene: water that varies with direction only.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumGlobal {
    /// `[c_m, β_bs, β_attn][band][RGB]`.
    pub coefficients: Coefficients,
}

impl MediumGlobal {
    /// The initial state of [`MediumRbf::new`], without anchors.
    pub fn new() -> Self {
        Self { coefficients: rbf::initial_coefficients() }
    }
}

impl Default for MediumGlobal {
    fn default() -> Self {
        Self::new()
    }
}

/// A model of the water.
#[allow(clippy::large_enum_variant, reason = "a scene has one, so its size on the stack does not matter")]
#[derive(Clone, Debug, PartialEq)]
pub enum MediumModel {
    /// No water: plain Gaussian splatting on black.
    None,
    /// The same water everywhere.
    Global(MediumGlobal),
    /// Anchored water, the method's own.
    Rbf(MediumRbf),
    /// A network of the direction.
    Mlp(MediumMlp),
}

/// Which model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MediumKind {
    /// [`MediumModel::None`]
    None,
    /// [`MediumModel::Global`]
    Global,
    /// [`MediumModel::Rbf`]
    Rbf,
    /// [`MediumModel::Mlp`]
    Mlp,
}

impl MediumKind {
    /// The name in files and parameters: `none`, `global`, `rbf`, `mlp`.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Global => "global",
            Self::Rbf => "rbf",
            Self::Mlp => "mlp",
        }
    }

    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::None, Self::Global, Self::Rbf, Self::Mlp].into_iter().find(|k| k.name() == name)
    }
}

/// What a parameter is, so that an optimiser can give it its learning rate.
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

/// What is wrong with a medium's tensors.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MediumError {
    /// A tensor is not there.
    #[error("the medium has no tensor `{name}`")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor of another shape.
    #[error("medium tensor `{name}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// Shape found.
        found: Vec<usize>,
        /// Shape expected.
        expected: Vec<usize>,
    },
    /// A value that is not finite.
    #[error("medium tensor `{name}` is not finite at element {index}")]
    NotFinite {
        /// Its name.
        name: String,
        /// First bad element.
        index: usize,
    },
    /// No anchors, or absurdly many.
    #[error("the medium has {found} anchors; expected 1 to {most}")]
    Anchors {
        /// Number found.
        found: usize,
        /// Largest number accepted.
        most: usize,
    },
    /// `top_k` outside `1..=anchors`.
    #[error("the medium's top_k is {top_k}; expected 1 to {anchors}, its number of anchors")]
    TopK {
        /// Value found.
        top_k: usize,
        /// Number of anchors.
        anchors: usize,
    },
}

impl MediumModel {
    /// Which model it is.
    pub fn kind(&self) -> MediumKind {
        match self {
            Self::None => MediumKind::None,
            Self::Global(_) => MediumKind::Global,
            Self::Rbf(_) => MediumKind::Rbf,
            Self::Mlp(_) => MediumKind::Mlp,
        }
    }

    /// Whether there is no water.
    pub fn is_none(&self) -> bool {
        matches!(self, Self::None)
    }

    /// The maps of one view on a lattice of its pixels. Spherical-harmonic bands above `active_degree` (0 to 3) are left out; the
    /// network knows no such limit. Without water all maps are zero.
    pub fn maps(&self, camera: &Camera, lattice: &Lattice, active_degree: usize, out: &mut MediumMaps) {
        let degree = active_degree.min(3);
        match self {
            Self::None => {
                out.resize(lattice.width(), lattice.height());
                for image in [&mut out.color, &mut out.backscatter, &mut out.attenuation] {
                    image.data_mut().fill(0.0);
                }
            }
            Self::Global(m) => directional::forward(&m.coefficients, camera, lattice, degree, out),
            Self::Rbf(m) => directional::forward(&m.aggregate(camera), camera, lattice, degree, out),
            Self::Mlp(m) => m.forward(camera, lattice, out),
        }
    }

    /// Adds to `gradient` the gradient of `<cotangent, maps>` with respect to every parameter. `maps` are those that
    /// [`MediumModel::maps`] made with the same arguments; `gradient` has this model's kind and size ([`MediumModel::zeros_like`]).
    pub fn backward(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        active_degree: usize,
        maps: &MediumMaps,
        cotangent: &MediumMaps,
        gradient: &mut Self,
    ) {
        let degree = active_degree.min(3);
        match (self, gradient) {
            (Self::Global(_), Self::Global(gradient)) => {
                let sums = directional::backward(camera, lattice, degree, maps, cotangent);
                for (q, quantity) in sums.iter().enumerate() {
                    for (b, band) in quantity.iter().enumerate() {
                        for (c, &value) in band.iter().enumerate() {
                            gradient.coefficients[q][b][c] += value as f32;
                        }
                    }
                }
            }
            (Self::Rbf(m), Self::Rbf(gradient)) => {
                let sums = directional::backward(camera, lattice, degree, maps, cotangent);
                m.backward(camera, &sums, gradient);
            }
            (Self::Mlp(m), Self::Mlp(gradient)) => m.backward(camera, lattice, maps, cotangent, gradient),
            (this, gradient) => {
                debug_assert_eq!(this.kind(), gradient.kind(), "a gradient has its model's kind");
            }
        }
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

    /// Walks model and gradient in step, in the fixed order of the flat parameter vector: `f(role, offset, parameters, gradient)`
    /// with slices of equal length; `offset` is the first parameter's index in the flat vector.
    pub fn update(&mut self, gradient: &Self, mut f: impl FnMut(Role, usize, &mut [f32], &[f32])) {
        let mut offset = 0;
        for ((role, values), (_, pulls)) in self.groups_mut().into_iter().zip(gradient.groups()) {
            let count = values.len();
            f(role, offset, values, pulls);
            offset += count;
        }
    }

    /// The parameters one after another: the same order as [`MediumModel::update`].
    pub fn flat(&self) -> Vec<f32> {
        self.groups().iter().flat_map(|(_, values)| values.iter().copied()).collect()
    }

    /// Takes back what [`MediumModel::flat`] gave; `false` (and nothing changed) if the length differs.
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

    /// Runs of parameters of one role, in order.
    pub fn groups(&self) -> Vec<(Role, &[f32])> {
        match self {
            Self::None => Vec::new(),
            Self::Global(m) => runs(bytemuck::cast_slice(&m.coefficients)),
            Self::Rbf(m) => {
                let mut groups = vec![
                    (Role::Anchor, bytemuck::cast_slice(&m.centers)),
                    (Role::Anchor, m.log_widths.as_slice()),
                ];
                groups.extend(runs(bytemuck::cast_slice(&m.coefficients)));
                groups
            }
            Self::Mlp(m) => {
                let layers = m.weights.iter().zip(&m.biases);
                layers
                    .flat_map(|(w, b)| [(Role::Network, w.as_slice()), (Role::Network, b.as_slice())])
                    .collect()
            }
        }
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        match self {
            Self::None => Vec::new(),
            Self::Global(m) => runs_mut(bytemuck::cast_slice_mut(&mut m.coefficients)),
            Self::Rbf(m) => {
                let mut groups = vec![
                    (Role::Anchor, bytemuck::cast_slice_mut(&mut m.centers)),
                    (Role::Anchor, m.log_widths.as_mut_slice()),
                ];
                groups.extend(runs_mut(bytemuck::cast_slice_mut(&mut m.coefficients)));
                groups
            }
            Self::Mlp(m) => {
                let layers = m.weights.iter_mut().zip(m.biases.iter_mut());
                layers
                    .flat_map(|(w, b)| [(Role::Network, w.as_mut_slice()), (Role::Network, b.as_mut_slice())])
                    .collect()
            }
        }
    }
}

/// Floats of one quantity's 16 bands, and of its constant band.
const QUANTITY: usize = 48;
const CONSTANT: usize = 3;

/// Coefficients as runs: three constants, 45 directional, and so on.
fn runs(coefficients: &[f32]) -> Vec<(Role, &[f32])> {
    let split = coefficients.chunks_exact(QUANTITY).map(|q| q.split_at(CONSTANT));
    split.flat_map(|(constant, rest)| [(Role::Constant, constant), (Role::Directional, rest)]).collect()
}

fn runs_mut(coefficients: &mut [f32]) -> Vec<(Role, &mut [f32])> {
    let split = coefficients.chunks_exact_mut(QUANTITY).map(|q| q.split_at_mut(CONSTANT));
    split.flat_map(|(constant, rest)| [(Role::Constant, constant), (Role::Directional, rest)]).collect()
}

#[cfg(test)]
mod tests;
