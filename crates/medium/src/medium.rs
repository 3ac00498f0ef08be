//! The interface of a model of the water, and the types that it shares with its users.

use use3d_capture::{Camera, Image, Lattice, MediumMaps, Pose};

use crate::tensors::{Put, Tensors};
use crate::{Coefficients, MediumError, Role};

/// The settings from which models start; each model uses those that it needs.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumStart {
    /// Anchors of an anchored model, 1 to [`MOST_ANCHORS`](crate::MOST_ANCHORS).
    pub anchors: usize,
    /// Number of anchors that share a view, 1 to `anchors`.
    pub top_k: usize,
    /// Seed of a model that starts at random.
    pub seed: u64,
    /// The training cameras, for water of single views.
    pub views: Vec<Pose>,
}

/// A model that consists of spherical harmonics of the direction, around a camera.
#[derive(Clone, Copy, Debug)]
pub struct Harmonics<'a> {
    /// `[c_m, β_bs, β_attn][band][RGB]`, one set per anchor; a single one without anchors.
    pub coefficients: &'a [Coefficients],
    /// The positions of the sets; `None` if one set holds everywhere.
    pub anchors: Option<Anchors<'a>>,
}

/// Positions in the scene to which coefficients belong. [`MediumRbf`](crate::MediumRbf) defines how cameras
/// share them.
#[derive(Clone, Copy, Debug)]
pub struct Anchors<'a> {
    /// Centres, normalised scene units.
    pub centers: &'a [[f32; 3]],
    /// Logarithms of widths.
    pub log_widths: &'a [f32],
    /// Number of anchors that share a view.
    pub top_k: usize,
}

/// Gives all pixels of a map one colour.
pub(crate) fn fill(map: &mut Image, color: [f32; 3]) {
    color.into_iter().enumerate().for_each(|(c, value)| map.plane_mut(c).fill(value));
}

/// A model of the water: the interface of one row of the table. Degrees of spherical harmonics are 0 to 3.
pub(crate) trait Medium: Sized {
    /// True if the model can start from given spherical harmonics.
    const FROM_HARMONICS: bool = false;

    /// The initial state.
    fn start(start: &MediumStart) -> Result<Self, MediumError>;

    /// Sets the same harmonics everywhere, if the model consists of harmonics.
    fn set_harmonics(&mut self, _coefficients: &Coefficients) {}

    /// See [`MediumModel::maps`](crate::MediumModel::maps).
    fn maps(&self, camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps);

    /// See [`MediumModel::backward`](crate::MediumModel::backward).
    fn backward(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        degree: usize,
        maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    );

    /// See [`MediumModel::groups`](crate::MediumModel::groups).
    fn groups(&self) -> Vec<(Role, &[f32])>;

    /// The mutable form of `groups`.
    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])>;

    /// Passes all its tensors to `put`.
    fn write(&self, put: Put<'_>);

    /// Makes the model from its tensors; only anchored models use `top_k`.
    fn read(top_k: usize, tensors: &Tensors) -> Result<Self, MediumError>;

    /// Returns its harmonics, if it consists of harmonics. Viewers assume that water without them varies
    /// with the direction alone.
    fn harmonics(&self) -> Option<Harmonics<'_>> {
        None
    }
}
