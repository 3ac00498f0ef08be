//! One set of spherical harmonics for the whole scene: water that varies with direction only, as in
//! Plenodium.

use use3d_capture::{Camera, Lattice, MediumMaps};

use crate::directional::{self, initial_coefficients, numbers, numbers_mut};
use crate::medium::{Harmonics, Medium, MediumStart};
use crate::tensors::{self, Put, Tensors};
use crate::{Coefficients, MediumError, Role};

/// Water that varies with direction only.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumGlobal {
    /// `[c_m, β_bs, β_attn][band][RGB]`.
    pub coefficients: Coefficients,
}

impl Default for MediumGlobal {
    /// The initial state of [`MediumRbf::new`](crate::MediumRbf::new), without anchors.
    fn default() -> Self {
        Self { coefficients: initial_coefficients() }
    }
}

impl Medium for MediumGlobal {
    const FROM_HARMONICS: bool = true;

    fn start(_start: &MediumStart) -> Result<Self, MediumError> {
        Ok(Self::default())
    }

    fn set_harmonics(&mut self, coefficients: &Coefficients) {
        self.coefficients = *coefficients;
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps) {
        directional::forward(&self.coefficients, camera, lattice, degree, out);
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
        for (gradient, &sum) in numbers_mut(&mut gradient.coefficients).iter_mut().zip(numbers(&sums)) {
            *gradient += sum as f32;
        }
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        directional::runs(numbers(&self.coefficients))
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        directional::runs_mut(numbers_mut(&mut self.coefficients))
    }

    fn write(&self, put: Put<'_>) {
        put("coefficients", &[3, 16, 3], numbers(&self.coefficients));
    }

    fn read(_top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let values = tensors::coefficients(tensors::get(tensors, "coefficients", &[3, 16, 3])?);
        Ok(Self { coefficients: values[0] })
    }

    fn harmonics(&self) -> Option<Harmonics<'_>> {
        Some(Harmonics { coefficients: std::slice::from_ref(&self.coefficients), anchors: None })
    }
}
