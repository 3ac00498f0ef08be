//! The water alone, along rays and at positions.

use use3d_capture::{Camera, Lattice, MediumMaps, Pose};
use use3d_medium::MediumModel;
use use3d_numerics::math;

/// The water along one ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterSample {
    /// The position: the angle from the optical axis in degrees (right is positive), or the camera's index
    /// in its list.
    pub at: f64,
    /// `c_m`.
    pub color: [f32; 3],
    /// `β_bs`, per normalised scene unit.
    pub backscatter: [f32; 3],
    /// `β_attn`, per normalised scene unit.
    pub attenuation: [f32; 3],
}

impl WaterSample {
    /// The water in the first row of `maps`.
    fn of(maps: &MediumMaps, column: usize, at: f64) -> Self {
        let [color, backscatter, attenuation] =
            [&maps.color, &maps.backscatter, &maps.attenuation].map(|map| map.pixel(column, 0));
        Self { at, color, backscatter, attenuation }
    }
}

/// The water along the rays of the row through an image's middle; `None` for a scene without water.
pub fn medium_profile(medium: &MediumModel, degree: usize, camera: &Camera) -> Option<Vec<WaterSample>> {
    if medium.is_none() {
        return None;
    }
    let k = &camera.intrinsics;
    let mut columns: Vec<usize> = (0..64).map(|i| i * k.width / 64).collect();
    columns.dedup();
    let lattice = Lattice::subset(&columns, &[k.height / 2])?;
    let mut maps = MediumMaps::zeros(0, 0);
    medium.maps(camera, &lattice, degree, &mut maps);
    let angle = |u: f32| math::atan((f64::from(u) - k.cx) / k.fx).to_degrees();
    let samples = lattice.columns().iter().enumerate().map(|(i, &u)| WaterSample::of(&maps, i, angle(u)));
    Some(samples.collect())
}

/// The water at the positions of cameras, along the optical axis of the first; `None` for a scene without
/// water or without cameras.
pub fn medium_along(medium: &MediumModel, degree: usize, cameras: &[Camera]) -> Option<Vec<WaterSample>> {
    let first = cameras.first()?;
    if medium.is_none() {
        return None;
    }
    let k = &first.intrinsics;
    let lattice = Lattice::subset(&[k.width / 2], &[k.height / 2])?;
    let mut maps = MediumMaps::zeros(0, 0);
    let samples = cameras.iter().enumerate().map(|(i, camera)| {
        let pose = Pose::from_center(first.pose.rotation, camera.pose.center());
        medium.maps(&Camera { intrinsics: *k, pose }, &lattice, degree, &mut maps);
        WaterSample::of(&maps, 0, i as f64)
    });
    Some(samples.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::Intrinsics;
    use use3d_medium::MediumRbf;

    #[test]
    fn the_water_changes_along_the_cameras_as_its_anchors_do() {
        let mut rbf = MediumRbf::new(8, 4);
        for (i, anchor) in rbf.coefficients.iter_mut().enumerate() {
            anchor[2][0] = [0.2 * i as f32 - 1.0; 3];
        }
        let intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
        let at = |x: f64| {
            let mut pose = Pose::IDENTITY;
            pose.translation.x = -x;
            Camera { intrinsics, pose }
        };
        let cameras = [at(-0.9), at(0.9), at(-0.9)];
        let samples = medium_along(&MediumModel::Rbf(rbf), 3, &cameras).expect("water");
        assert_eq!(samples[0].attenuation, samples[2].attenuation);
        assert_ne!(samples[0].attenuation, samples[1].attenuation, "MediumRBF depends on the position");
        assert!(medium_along(&MediumModel::None, 3, &cameras).is_none());
    }
}
