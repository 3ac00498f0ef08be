//! Drawing a scene, as it was reconstructed or as it was enhanced, with all of its water, a share of it, or none; without any 2D
//! network.
//!
//! **The amount of water** `a` in `[0, 1]` scales both coefficients, and the open water that is seen where nothing ends the ray:
//!
//! ```text
//! rgb(a) = Σ w c e^{−a β_attn s}  +  Σ w c_m (1 − e^{−a β_bs s})  +  a (1 − Σ w) c_m
//!          surfaces                  the veil before them            open water
//! ```
//!
//! `w`, `s` (scene units), `c_m`, `β` (per scene unit) as in the compositor, whose intervals and far end this is in other order. `a = 1` is
//! the picture as it was learnt, to the bit; `a = 0` is the radiance of the Gaussians alone, `Σ w c`, black where nothing is: `clear`,
//! or `enhanced-clear` with the enhanced colours. In between light that comes from surfaces only grows and light that comes from
//! the water only shrinks as `a` falls.
//!
//! Open water would not fade by its coefficients: infinitely deep, it has its colour `c_m` however thin it is. Its factor `a` is a choice,
//! not physics; it makes open water darken steadily and meet the black of `a = 0`. It takes the share of a ray that no surface ends and
//! not the compositor's far end, which begins at the last Gaussian however faint that is, and so shows the edges of faint Gaussians.

use use3d_capture::{Camera, Image, Lattice, MediumMaps};
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
    /// How much of the water is left, in `[0, 1]`.
    water: f32,
    prepared: Prepared,
    rasterizer: Rasterizer,
    colors: Vec<[f32; 3]>,
    maps: MediumMaps,
    /// `maps` with the coefficients of the water that is left.
    thinned: MediumMaps,
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
            water: 1.0,
            prepared: Prepared::new(),
            rasterizer: Rasterizer::new(),
            colors: Vec::new(),
            maps: MediumMaps::zeros(0, 0),
            thinned: MediumMaps::zeros(0, 0),
        })
    }

    /// Leaves only `water` of the water, in `[0, 1]`; 1 at first.
    ///
    /// # Errors
    /// An amount outside that range.
    pub fn with_water(self, water: f32) -> Result<Self, EnhanceError> {
        if !(0.0..=1.0).contains(&water) {
            return Err(EnhanceError::Water(water));
        }
        Ok(Self { water, ..self })
    }

    /// Draws the pixels of `lattice` seen by `camera` (in the scene's frame), with object, medium and clear layers if asked for.
    /// The layers are those of the picture: `image = object + medium + far`.
    pub fn render(&mut self, camera: &Camera, lattice: &Lattice, layers: bool, out: &mut Rendered) {
        self.look_through(camera, lattice);
        self.draw(camera, lattice, self.water, layers, out);
    }

    /// As [`Renderer::render`] with no water left, and at less cost: the radiance of the Gaussians on black.
    pub fn render_clear(&mut self, camera: &Camera, lattice: &Lattice, out: &mut Rendered) {
        self.draw(camera, lattice, 0.0, false, out);
    }

    fn draw(&mut self, camera: &Camera, lattice: &Lattice, water: f32, layers: bool, out: &mut Rendered) {
        let g = &self.scene.gaussians;
        view_colors(g, camera, g.sh_degree, &mut self.colors);
        if let Some((grades, _)) = &self.grades {
            grades.apply(&mut self.colors);
        }
        self.prepared.prepare(g, camera, lattice, Colors::Given(&self.colors));
        let thinned = water > 0.0 && water < 1.0 && !self.scene.medium.is_none();
        let medium = if self.scene.medium.is_none() || water == 0.0 {
            None
        } else if thinned {
            thin(&self.maps, water, &mut self.thinned);
            Some(&self.thinned)
        } else {
            Some(&self.maps)
        };
        let options = Options { layers, ..Options::default() };
        self.rasterizer.forward(&self.prepared, medium, &options, out);
        if thinned {
            dim_open_water(&self.maps.color, water, out);
        }
    }

    /// The water in front of a camera, as this look has it, all of it.
    fn look_through(&mut self, camera: &Camera, lattice: &Lattice) {
        if self.scene.medium.is_none() {
            return;
        }
        self.scene.medium.maps(camera, lattice, self.scene.medium_degree, &mut self.maps);
        if let (Some((_, strength)), Some(enhancement)) = (&self.grades, &self.scene.enhancement) {
            let center = camera.pose.center().as_vec3().to_array();
            let frozen = std::mem::replace(&mut self.maps, MediumMaps::zeros(0, 0));
            self.maps = enhancement.water(center, frozen, *strength);
        }
    }

    /// The water of the last [`Renderer::render`], all of it, however little was left in the picture: c_m, β_bs, β_attn. `None` in a
    /// scene without water.
    pub fn medium(&self) -> Option<&MediumMaps> {
        (!self.scene.medium.is_none()).then_some(&self.maps)
    }
}

/// Water of the same colour with `share` of its coefficients.
fn thin(maps: &MediumMaps, share: f32, out: &mut MediumMaps) {
    out.resize(maps.color.width(), maps.color.height());
    out.color.data_mut().copy_from_slice(maps.color.data());
    let scaled = |from: &Image, to: &mut Image| {
        to.data_mut().iter_mut().zip(from.data()).for_each(|(to, from)| *to = share * from);
    };
    scaled(&maps.backscatter, &mut out.backscatter);
    scaled(&maps.attenuation, &mut out.attenuation);
}

/// Gives open water its factor, in the picture and in its layers: of the water's light `(1 − Σ w) c_m` belongs to rays that no surface
/// ends, part of it to the intervals before the last Gaussian and part to the far end.
fn dim_open_water(color: &Image, share: f32, out: &mut Rendered) {
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
pub(crate) fn grades(scene: &Scene, strength: f32) -> Result<ObjectGrades, EnhanceError> {
    if !(0.0..=1.0).contains(&strength) {
        return Err(EnhanceError::Strength(strength));
    }
    let enhancement = scene.enhancement.as_ref().ok_or(EnhanceError::NotEnhanced)?;
    let g = &scene.gaussians;
    Ok(enhancement.objects(&g.means, g.sh.iter().map(|sh| sh[0]), strength))
}
