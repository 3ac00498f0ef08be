//! Drawing a scene, as it was reconstructed or as it was enhanced, without any 2D network.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered, view_colors};
use use3d_ubaf::enhancement::ObjectGrades;

use crate::EnhanceError;

/// Which appearance of a scene is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Look {
    /// Stage 1's.
    Reconstruction,
    /// Stage 2's at a strength in `[0, 1]`: 0 is the reconstruction exactly, 1 the trained enhancement. In between log-gains,
    /// biases, the scene affine and the transport log-ratios are scaled, so the change is smooth and gains stay positive.
    Enhanced {
        /// How much.
        strength: f32,
    },
}

/// Draws views of one scene. Keeps what is the same for all of them, and its buffers.
pub struct Renderer<'s> {
    scene: &'s Scene,
    /// Per-Gaussian grades and the strength, if enhanced.
    grades: Option<(ObjectGrades, f32)>,
    prepared: Prepared,
    rasterizer: Rasterizer,
    colors: Vec<[f32; 3]>,
    maps: MediumMaps,
}

impl<'s> Renderer<'s> {
    /// For one look. The field is evaluated here, once; a view then costs one affine per Gaussian more than the reconstruction.
    pub fn new(scene: &'s Scene, look: Look) -> Result<Self, EnhanceError> {
        let grades = match look {
            Look::Reconstruction => None,
            Look::Enhanced { strength } => Some((grades(scene, strength)?, strength)),
        };
        Ok(Self {
            scene,
            grades,
            prepared: Prepared::new(),
            rasterizer: Rasterizer::new(),
            colors: Vec::new(),
            maps: MediumMaps::zeros(0, 0),
        })
    }

    /// Draws the pixels of `lattice` seen by `camera` (in the scene's frame), with object, medium and clear layers if asked for.
    pub fn render(&mut self, camera: &Camera, lattice: &Lattice, layers: bool, out: &mut Rendered) {
        let g = &self.scene.gaussians;
        view_colors(g, camera, g.sh_degree, &mut self.colors);
        if let Some((grades, _)) = &self.grades {
            grades.apply(&mut self.colors);
        }
        self.prepared.prepare(g, camera, lattice, Colors::Given(&self.colors));
        let medium = (!self.scene.medium.is_none()).then(|| {
            self.scene.medium.maps(camera, lattice, self.scene.medium_degree, &mut self.maps);
            if let (Some((_, strength)), Some(enhancement)) = (&self.grades, &self.scene.enhancement) {
                let center = camera.pose.center().as_vec3().to_array();
                let frozen = std::mem::replace(&mut self.maps, MediumMaps::zeros(0, 0));
                self.maps = enhancement.water(center, frozen, *strength);
            }
            &self.maps
        });
        let options = Options { layers, ..Options::default() };
        self.rasterizer.forward(&self.prepared, medium, &options, out);
    }

    /// The water of the last view: c_m, β_bs, β_attn. `None` in a scene without water.
    pub fn medium(&self) -> Option<&MediumMaps> {
        (!self.scene.medium.is_none()).then_some(&self.maps)
    }
}

/// The grades of a scene's Gaussians at a strength.
pub(crate) fn grades(scene: &Scene, strength: f32) -> Result<ObjectGrades, EnhanceError> {
    if !(0.0..=1.0).contains(&strength) {
        return Err(EnhanceError::Strength(strength));
    }
    let enhancement = scene.enhancement.as_ref().ok_or(EnhanceError::NotEnhanced)?;
    let g = &scene.gaussians;
    Ok(enhancement.objects(&g.means, g.sh.iter().map(|sh| sh[0]), strength))
}
