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

use crate::RenderError;
use crate::backend::{Backend, Request};
use crate::cpu::Cpu;

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

/// Draws views of one scene in one look.
pub struct Renderer<'s> {
    backend: Box<dyn Backend + 's>,
    /// The share of the water that is left, in `[0, 1]`.
    water: f32,
}

impl<'s> Renderer<'s> {
    /// A renderer for one look, on the processor.
    ///
    /// # Errors
    /// The strength is outside `[0, 1]`, or the scene is not enhanced.
    pub fn new(scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        Ok(Self::on(Box::new(Cpu::new(scene, look)?)))
    }

    /// A renderer on any backend, for the scene and look of that backend.
    pub fn on(backend: Box<dyn Backend + 's>) -> Self {
        Self { backend, water: 1.0 }
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
    /// The error of the backend's device.
    pub fn render(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        layers: bool,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.backend.draw(&Request { camera, lattice, water: Some(self.water), layers }, out)
    }

    /// Like [`Renderer::render`] with no water left, but cheaper: the radiance of the Gaussians on black.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn render_clear(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.backend.draw(&Request { camera, lattice, water: None, layers: false }, out)
    }

    /// The answer of this look to a unit of stage-1 radiance, in its own share of the water or without
    /// water: see [`Backend::respond`].
    pub(crate) fn respond(
        &mut self,
        (camera, lattice): (&Camera, &Lattice),
        dry: bool,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        let water = (!dry).then_some(self.water);
        self.backend.respond(&Request { camera, lattice, water, layers: false }, channel, out)
    }

    /// The share of light that arrives through all of this look's water.
    pub(crate) fn arriving(
        &mut self,
        (camera, lattice): (&Camera, &Lattice),
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        let request = Request { camera, lattice, water: Some(1.0), layers: false };
        self.backend.respond(&request, None, out)
    }

    /// The full water of the last [`Renderer::render`], for any share that was drawn: c_m, β_bs, β_attn.
    /// `None` in a scene without water.
    pub fn medium(&self) -> Option<&MediumMaps> {
        self.backend.medium()
    }
}
