//! The parts of a look at a scene: graded colours, and water of which a share is left.

use use3d_capture::{Camera, Image, KeptWater, Lattice, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::Rendered;
use use3d_ubaf::enhancement::ObjectGrades;

use crate::RenderError;

/// Computes the water in front of a camera: that of the enhanced look at `strength`, or without a strength
/// that of stage 1. Returns `false` and leaves `maps` unchanged in a scene without water.
pub(crate) fn look_through(
    scene: &Scene,
    strength: Option<f32>,
    camera: &Camera,
    lattice: &Lattice,
    maps: &mut MediumMaps,
) -> bool {
    if !scene.look_through(camera, lattice, maps) {
        return false;
    }
    if let (Some(strength), Some(enhancement)) = (strength, &scene.enhancement) {
        let center = camera.pose.center().as_vec3().to_array();
        let frozen = std::mem::replace(maps, MediumMaps::zeros(0, 0));
        *maps = enhancement.water(center, frozen, strength);
    }
    true
}

/// Water of the same colour with `share` of its coefficients.
pub(crate) fn thin(maps: &MediumMaps, share: f32, out: &mut MediumMaps) {
    out.resize(maps.color.width(), maps.color.height());
    out.color.data_mut().copy_from_slice(maps.color.data());
    out.backscatter.data_mut().copy_from_slice(maps.backscatter.data());
    out.attenuation.data_mut().copy_from_slice(maps.attenuation.data());
    out.formation = maps.formation;
    out.network.clone_from(&maps.network);
    KeptWater([share; 3]).thin(out);
}

/// Multiplies open water by its factor, in the picture and in its layers. Of the water's light,
/// `(1 − Σ w) c_m` belongs to rays that no surface ends; a part of it is in the intervals before the last
/// Gaussian and a part at the far end.
pub(crate) fn dim_open_water(color: &Image, share: f32, out: &mut Rendered) {
    let pixels = out.accumulation.pixels();
    let open = |i: usize| (1.0 - out.accumulation.data()[i % pixels]) * color.data()[i];
    if let Some(layers) = &mut out.layers {
        let parts = layers.medium.data_mut().iter_mut().zip(layers.far.data_mut());
        for (i, (intervals, far)) in parts.enumerate() {
            *intervals -= (1.0 - share) * (open(i) - *far);
            *far *= share;
        }
    }
    for (i, pixel) in out.image.data_mut().iter_mut().enumerate() {
        *pixel -= (1.0 - share) * open(i);
    }
}

/// The grades of a scene's Gaussians at a strength.
pub(crate) fn grades(scene: &Scene, strength: f32) -> Result<ObjectGrades, RenderError> {
    if !(0.0..=1.0).contains(&strength) {
        return Err(RenderError::Strength(strength));
    }
    let enhancement = scene.enhancement.as_ref().ok_or(RenderError::NotEnhanced)?;
    let g = &scene.gaussians;
    Ok(enhancement.objects(&g.means, g.sh.iter().map(|sh| sh[0]), strength))
}
