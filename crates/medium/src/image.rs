//! Water applied to the finished image: the clear image seen through water at its expected depth. SeaSplat
//! and 3D-UIR form a photograph in this way.
//!
//! The water is that of [`MediumGlobal`], one set of spherical harmonics. With the constant band alone it
//! is SeaSplat's: three numbers each for the colour of infinitely deep water, backscatter and attenuation.
//! The difference from `MediumGlobal` is its position: this water lies in front of each pixel
//! ([`Formation::PerImage`]) and not in front of every Gaussian.

use use3d_capture::{Camera, Formation, Lattice, MediumMaps};

use crate::medium::{Harmonics, Medium, MediumStart};
use crate::tensors::{Put, Tensors};
use crate::{Coefficients, MediumError, MediumGlobal, Role};

/// Water that varies with direction only, applied to finished images.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MediumImage(pub MediumGlobal);

impl Medium for MediumImage {
    const FROM_HARMONICS: bool = true;
    const FORMATION: Formation = Formation::PerImage;

    fn start(start: &MediumStart) -> Result<Self, MediumError> {
        Ok(Self(Medium::start(start)?))
    }

    fn set_harmonics(&mut self, coefficients: &Coefficients) {
        self.0.set_harmonics(coefficients);
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps) {
        self.0.maps(camera, lattice, degree, out);
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
        self.0.backward(camera, lattice, degree, maps, d_maps, &mut gradient.0);
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        self.0.groups()
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        self.0.groups_mut()
    }

    fn write(&self, put: Put<'_>) {
        self.0.write(put);
    }

    fn read(top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        Ok(Self(Medium::read(top_k, tensors)?))
    }

    fn harmonics(&self) -> Option<Harmonics<'_>> {
        self.0.harmonics()
    }
}
