//! Draws a scene, as it was reconstructed or as it was enhanced, with all of its water, a share of it, or
//! none. It uses no 2D network.
//!
//! **The amount of water** `a` in `[0, 1]` scales both coefficients, and the open water that is seen where
//! no surface ends the ray:
//!
//! ```text
//! rgb(a) = Σ w c e^{−a β_attn s}  +  Σ w c_m (1 − e^{−a β_bs s})  +  a (1 − Σ w) c_m
//!          surfaces                  the veil before them            open water
//! ```
//!
//! `w`, `s` (scene units), `c_m`, `β` (per scene unit) are those of the compositor; this is the sum of its
//! intervals and far end in another order. `a = 1` is exactly the learnt picture, to the bit. `a = 0` is
//! the radiance of the Gaussians alone, `Σ w c`, black where nothing is hit: `clear`, or `enhanced-clear`
//! with the enhanced colours. As `a` falls, light from surfaces only grows and light from the water only
//! shrinks.
//!
//! Coefficients alone would not make open water fade: infinitely deep water has its colour `c_m` at any
//! density. Its factor `a` is a choice and not physics; it makes open water darken steadily and become
//! black at `a = 0`. It applies to the share of a ray that no surface ends, and not to the compositor's far
//! end. The far end begins at the last Gaussian, even a very faint one, and would show the edges of faint
//! Gaussians.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::Rendered;
use use3d_ubaf::enhancement::ObjectGrades;

use crate::RenderError;
use crate::composer::{Composer, Composition, Processor, Recolor};
use crate::look::{dim_open_water, grades, look_through, thin};

/// The appearance of a scene that is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Look {
    /// The appearance of stage 1.
    Reconstruction,
    /// The appearance of stage 2 at a strength in `[0, 1]`: 0 is the reconstruction exactly, 1 the trained
    /// enhancement. In between, log-gains, biases, the scene affine and the transport log-ratios are
    /// scaled, so the change is smooth and gains stay positive.
    Enhanced {
        /// The strength.
        strength: f32,
    },
}

/// Draws views of one scene in one look, composed on any device.
pub struct Renderer<'s> {
    scene: &'s Scene,
    /// Per-Gaussian grades and the strength, if enhanced.
    grades: Option<(ObjectGrades, f32)>,
    composer: Box<dyn Composer + 's>,
    /// The share of the water that is left, in `[0, 1]`.
    water: f32,
    /// The water in front of the last camera, in this look.
    maps: MediumMaps,
    /// `maps` with the coefficients of the remaining water.
    thinned: MediumMaps,
    /// The camera and the lattice of `maps`, which are costly to compute.
    seen: Option<(Camera, Lattice)>,
}

impl<'s> Renderer<'s> {
    /// A renderer for one look, on the processor.
    ///
    /// # Errors
    /// The strength is outside `[0, 1]`, or the scene is not enhanced.
    pub fn new(scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        Self::on(Box::new(Processor::new(scene)), scene, look)
    }

    /// A renderer with a composer of the same scene. The field is evaluated here, once; a view then costs one
    /// more affine per Gaussian than the reconstruction.
    ///
    /// # Errors
    /// The strength is outside `[0, 1]`, or the scene is not enhanced.
    pub fn on(composer: Box<dyn Composer + 's>, scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        let grades = match look {
            Look::Reconstruction => None,
            Look::Enhanced { strength } => Some((grades(scene, strength)?, strength)),
        };
        let (maps, thinned) = (MediumMaps::zeros(0, 0), MediumMaps::zeros(0, 0));
        Ok(Self { scene, grades, composer, water: 1.0, maps, thinned, seen: None })
    }

    /// Leaves only the share `water` of the water, in `[0, 1]`; it is 1 at first.
    ///
    /// # Errors
    /// The amount is outside that range.
    pub fn with_water(self, water: f32) -> Result<Self, RenderError> {
        if !(0.0..=1.0).contains(&water) {
            return Err(RenderError::Water(water));
        }
        Ok(Self { water, ..self })
    }

    /// Draws the pixels of `lattice` seen by `camera` (in the scene's frame), with object, medium and clear
    /// layers if requested. The layers belong to the picture: `image = object + medium + far`.
    ///
    /// # Errors
    /// The error of the composer's device.
    pub fn render(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        layers: bool,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.look_through(camera, lattice);
        let dry = self.scene.medium.is_none() || self.water == 0.0;
        let thinned = !dry && self.water < 1.0;
        let medium = if dry {
            None
        } else if thinned {
            thin(&self.maps, self.water, &mut self.thinned);
            Some(&self.thinned)
        } else {
            Some(&self.maps)
        };
        compose(&mut *self.composer, self.grades.as_ref(), (camera, lattice), medium, layers, out)?;
        if thinned && self.maps.network.is_none() {
            dim_open_water(&self.maps.color, self.water, out);
        }
        Ok(())
    }

    /// Like [`Renderer::render`] with no water left, but cheaper: the radiance of the Gaussians on black. The
    /// water is not evaluated, so that [`Renderer::medium`] stays unchanged.
    ///
    /// # Errors
    /// The error of the composer's device.
    pub fn render_clear(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        compose(&mut *self.composer, self.grades.as_ref(), (camera, lattice), None, false, out)
    }

    /// Draws the light of surfaces alone, without a veil: the answer of this look to a unit of stage-1
    /// radiance on every Gaussian, `Σ w t g`, in its own share of the water or without water. With `channel`,
    /// the unit is light of that channel and `g` is the graded column of each Gaussian; without, `g = 1`,
    /// which is the share of light that arrives.
    pub(crate) fn respond(
        &mut self,
        at: (&Camera, &Lattice),
        dry: bool,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        let share = if dry { 0.0 } else { self.water };
        self.respond_through(at, share, channel, out)
    }

    /// The share of light that arrives through all of this look's water.
    pub(crate) fn arriving(
        &mut self,
        at: (&Camera, &Lattice),
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.respond_through(at, 1.0, None, out)
    }

    fn respond_through(
        &mut self,
        (camera, lattice): (&Camera, &Lattice),
        share: f32,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        let wet = share > 0.0 && !self.scene.medium.is_none();
        if wet {
            self.look_through(camera, lattice);
            thin(&self.maps, share, &mut self.thinned);
            self.thinned.darken();
        }
        let grades = self.grades.as_ref().map(|(grades, _)| grades);
        let recolor = |colors: &mut [[f32; 3]]| match (channel, grades) {
            (None, _) => colors.fill([1.0; 3]),
            (Some(j), None) => colors.fill(std::array::from_fn(|i| if i == j { 1.0 } else { 0.0 })),
            (Some(j), Some(grades)) => {
                colors.iter_mut().enumerate().for_each(|(i, c)| *c = grades.matrix(i).map(|row| row[j]));
            }
        };
        let medium = wet.then_some(&self.thinned);
        let view = Composition { camera, lattice, recolor: Some(&recolor), medium, layers: false };
        self.composer.compose(&view, out)
    }

    /// Computes `maps` for a camera, unless they are there.
    fn look_through(&mut self, camera: &Camera, lattice: &Lattice) {
        if self.seen.as_ref().is_some_and(|(c, l)| c == camera && l == lattice) {
            return;
        }
        let strength = self.grades.as_ref().map(|(_, strength)| *strength);
        look_through(self.scene, strength, camera, lattice, &mut self.maps);
        self.seen = Some((*camera, lattice.clone()));
    }

    /// The full water of the last [`Renderer::render`], for any share that was drawn: c_m, β_bs, β_attn.
    /// `None` in a scene without water.
    pub fn medium(&self) -> Option<&MediumMaps> {
        (!self.scene.medium.is_none()).then_some(&self.maps)
    }
}

/// Composes a view in graded colours, if there are grades.
fn compose(
    composer: &mut dyn Composer,
    grades: Option<&(ObjectGrades, f32)>,
    (camera, lattice): (&Camera, &Lattice),
    medium: Option<&MediumMaps>,
    layers: bool,
    out: &mut Rendered,
) -> Result<(), RenderError> {
    let graded = grades.map(|(grades, _)| move |colors: &mut [[f32; 3]]| grades.apply(colors));
    let recolor = graded.as_ref().map(|graded| graded as &Recolor<'_>);
    composer.compose(&Composition { camera, lattice, recolor, medium, layers }, out)
}
