//! Nine numbers for the whole scene: the water of SeaSplat, for comparison.
//!
//! ```text
//! c_m = σ(v)      β_bs = max(b, 0)      β_attn = max(a, 0)
//! ```
//!
//! All nine are the same in every direction. The coefficients have no unit, because distances are
//! normalised in each view. At the start `c_m` is `(0.05, 0.25, 0.8)`, `b` is 0.5 and `a` is
//! `(1.1, 0.95, 0.95)`.
//!
//! A degree of 0 stands for the time before there is water. Then the colour `c_m` is the background behind
//! the scene, and the coefficients are zero. With any other degree the whole model holds.

use use3d_capture::{Camera, Formation, Lattice, MediumMaps};
use use3d_numerics::functions::scalar::sigmoid;
use use3d_numerics::math;
use use3d_numerics::sums::sum;

use crate::medium::{Medium, MediumStart, fill};
use crate::tensors::{self, Put, Tensors};
use crate::{MediumError, Role};

/// The names of the numbers in files.
const NAMES: [&str; 3] = ["far", "backscatter", "attenuation"];

/// Water that is the same in every direction.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumSeasplat {
    /// The numbers `v`, `b` and `a`, each RGB.
    pub numbers: [[f32; 3]; 3],
}

impl Default for MediumSeasplat {
    fn default() -> Self {
        let logit = |p: f64| math::ln(p / (1.0 - p)) as f32;
        Self { numbers: [[0.05, 0.25, 0.8].map(logit), [0.5; 3], [1.1, 0.95, 0.95]] }
    }
}

impl Medium for MediumSeasplat {
    fn start(_start: &MediumStart) -> Result<Self, MediumError> {
        Ok(Self::default())
    }

    fn maps(&self, _camera: &Camera, lattice: &Lattice, degree: usize, out: &mut MediumMaps) {
        if degree == 0 {
            out.formation = Formation::PerGaussian;
        }
        out.resize(lattice.width(), lattice.height());
        let [far, backscatter, attenuation] = self.numbers;
        let coefficient = |x: f32| if degree == 0 { 0.0 } else { x.max(0.0) };
        fill(&mut out.color, far.map(sigmoid));
        fill(&mut out.backscatter, backscatter.map(coefficient));
        fill(&mut out.attenuation, attenuation.map(coefficient));
    }

    fn backward(
        &self,
        _camera: &Camera,
        _lattice: &Lattice,
        degree: usize,
        _maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    ) {
        for (q, d_map) in [&d_maps.color, &d_maps.backscatter, &d_maps.attenuation].into_iter().enumerate() {
            for (c, plane) in d_map.planes().into_iter().enumerate() {
                let value = self.numbers[q][c];
                let slope = match q {
                    0 => sigmoid(value) * (1.0 - sigmoid(value)),
                    _ if degree > 0 && value >= 0.0 => 1.0,
                    _ => 0.0,
                };
                gradient.numbers[q][c] += slope * sum(plane.len(), |i| f64::from(plane[i])) as f32;
            }
        }
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        vec![(Role::Constant, self.numbers.as_flattened())]
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        vec![(Role::Constant, self.numbers.as_flattened_mut())]
    }

    fn write(&self, put: Put<'_>) {
        for (name, values) in NAMES.into_iter().zip(&self.numbers) {
            put(name, &[3], values);
        }
    }

    fn read(_top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let mut numbers = [[0.0; 3]; 3];
        for (name, values) in NAMES.into_iter().zip(&mut numbers) {
            values.copy_from_slice(tensors::get(tensors, name, &[3])?);
        }
        Ok(Self { numbers })
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Image, Intrinsics, Pose};

    use super::*;

    #[test]
    fn before_there_is_water_its_colour_is_the_background() {
        let intrinsics = Intrinsics { width: 3, height: 2, fx: 3.0, fy: 3.0, cx: 1.5, cy: 1.0 };
        let pose = Pose { rotation: glam::DMat3::IDENTITY, translation: glam::DVec3::ZERO };
        let (camera, lattice) = (Camera { intrinsics, pose }, Lattice::full(&intrinsics));
        let water = crate::MediumModel::Seasplat(MediumSeasplat::default());
        let mut maps = MediumMaps::zeros(0, 0);
        let near = |image: &Image, expected: [f32; 3]| {
            (0..6).all(|i| {
                let found = image.pixel(i % 3, i / 3);
                found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6)
            })
        };
        for (degree, formation, b, a) in [
            (0, Formation::PerGaussian, [0.0; 3], [0.0; 3]),
            (1, Formation::Normalised, [0.5; 3], [1.1, 0.95, 0.95]),
            (3, Formation::Normalised, [0.5; 3], [1.1, 0.95, 0.95]),
        ] {
            water.maps(&camera, &lattice, degree, &mut maps);
            assert_eq!(maps.formation, formation);
            assert!(near(&maps.color, [0.05, 0.25, 0.8]), "{:?}", maps.color.pixel(0, 0));
            assert!(near(&maps.backscatter, b) && near(&maps.attenuation, a));
        }
    }
}
