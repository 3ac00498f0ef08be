//! Drawing a scene, as it was reconstructed or as it was enhanced, with all of its water, a share of it, or
//! none; without any 2D network.
//!
//! **The amount of water** `a` in `[0, 1]` scales both coefficients, and the open water that is seen where
//! nothing ends the ray:
//!
//! ```text
//! rgb(a) = Σ w c e^{−a β_attn s}  +  Σ w c_m (1 − e^{−a β_bs s})  +  a (1 − Σ w) c_m
//!          surfaces                  the veil before them            open water
//! ```
//!
//! `w`, `s` (scene units), `c_m`, `β` (per scene unit) as in the compositor, whose intervals and far end this
//! is in other order. `a = 1` is the picture as it was learnt, to the bit; `a = 0` is the radiance of the
//! Gaussians alone, `Σ w c`, black where nothing is: `clear`, or `enhanced-clear` with the enhanced colours.
//! In between light that comes from surfaces only grows and light that comes from the water only shrinks as
//! `a` falls.
//!
//! Open water would not fade by its coefficients: infinitely deep, it has its colour `c_m` however thin it
//! is. Its factor `a` is a choice, not physics; it makes open water darken steadily and meet the black of `a
//! = 0`. It takes the share of a ray that no surface ends and not the compositor's far end, which begins at
//! the last Gaussian however faint that is, and so shows the edges of faint Gaussians.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::Rendered;

use crate::RenderError;
use crate::backend::{Backend, Request};
use crate::cpu::Cpu;

/// Which appearance of a scene is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Look {
    /// Stage 1's.
    Reconstruction,
    /// Stage 2's at a strength in `[0, 1]`: 0 is the reconstruction exactly, 1 the trained enhancement. In
    /// between log-gains, biases, the scene affine and the transport log-ratios are scaled, so the change
    /// is smooth and gains stay positive.
    Enhanced {
        /// How much.
        strength: f32,
    },
}

/// Draws views of one scene in one look.
pub struct Renderer<'s> {
    backend: Box<dyn Backend + 's>,
    /// How much of the water is left, in `[0, 1]`.
    water: f32,
}

impl<'s> Renderer<'s> {
    /// For one look, on the processor.
    ///
    /// # Errors
    /// A strength outside `[0, 1]`, or a scene that is not enhanced.
    pub fn new(scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        Ok(Self::on(Box::new(Cpu::new(scene, look)?)))
    }

    /// On any backend, for the scene and look that it was made for.
    pub fn on(backend: Box<dyn Backend + 's>) -> Self {
        Self { backend, water: 1.0 }
    }

    /// Leaves only `water` of the water, in `[0, 1]`; 1 at first.
    ///
    /// # Errors
    /// An amount outside that range.
    pub fn with_water(self, water: f32) -> Result<Self, RenderError> {
        if !(0.0..=1.0).contains(&water) {
            return Err(RenderError::Water(water));
        }
        Ok(Self { water, ..self })
    }

    /// Draws the pixels of `lattice` seen by `camera` (in the scene's frame), with object, medium and clear
    /// layers if asked for. The layers are those of the picture: `image = object + medium + far`.
    ///
    /// # Errors
    /// What the backend's device says.
    pub fn render(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        layers: bool,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.backend.draw(&Request { camera, lattice, water: Some(self.water), layers }, out)
    }

    /// As [`Renderer::render`] with no water left, and at less cost: the radiance of the Gaussians on black.
    ///
    /// # Errors
    /// What the backend's device says.
    pub fn render_clear(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.backend.draw(&Request { camera, lattice, water: None, layers: false }, out)
    }

    /// The water of the last [`Renderer::render`], all of it, however little was left in the picture: c_m,
    /// β_bs, β_attn. `None` in a scene without water.
    pub fn medium(&self) -> Option<&MediumMaps> {
        self.backend.medium()
    }
}
