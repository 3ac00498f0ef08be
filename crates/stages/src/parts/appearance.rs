//! The way photographs are shown: a look of the scene, with its strength, its water and its white balance.

use use3d_capture::Camera;
use use3d_photographs::{PhotographError, Photographer};
use use3d_render::Mode;
use use3d_scene::white::Gains;

use crate::engines::Drawn;

/// The way the photographs are shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Appearance {
    /// The look: `Reconstruction`, `Clear`, `Enhanced` or `EnhancedClear`.
    pub mode: Mode,
    /// Strength of the enhancement, 0 to 1.
    pub strength: f32,
    /// Share of the water that is left, 0 to 1.
    pub water: f32,
    /// The white balance.
    pub gains: Gains,
    /// Share of each shot's own light that stays, 0 to 1.
    pub keep_light: f32,
}

impl Appearance {
    /// A photographer for this appearance of a scene. `training` are the cameras that the scene was learnt
    /// from; with them, only surfaces that they saw count as known.
    ///
    /// # Errors
    /// A share is outside `[0, 1]`, or the scene cannot be drawn.
    pub fn photographer<'s>(
        &self,
        drawn: &Drawn<'s>,
        training: &[Camera],
    ) -> Result<Photographer<'s>, PhotographError> {
        let look = drawn.renderer(self.strength)?.with_water(self.water)?.with_white(self.gains);
        let photographer = Photographer::new(drawn.renderer(1.0)?, look, self.mode);
        photographer.with_light(self.keep_light)?.covered_by(training)
    }
}
