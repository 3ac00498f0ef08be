//! The answer of a look to a change of light.
//!
//! A photograph differs from the stage-1 render of its camera by `Δ = P − R`. If all surfaces of a pixel
//! were brighter by `δc`, the render and the look would change by
//!
//! ```text
//! δR_j = τ_j δc_j,    τ_j  = Σ w t_j           (light that arrives through the water of stage 1)
//! δE_i = Σ_j N_ij δc_j,   N_ij = Σ w t'_i G_ij     (G: the 3 × 3 colour map of each Gaussian in the look)
//! ```
//!
//! with weights `w` and transmissions `t`, `t'` of the compositor. So the look of the photograph's own
//! difference is `M Δ` with `M_ij = N_ij / τ_j`. Both sums come from the compositor itself and are exact.
//! `N` and `τ` have no unit; `τ` is in `[0, 1]`. Where nothing arrives, `M` has no meaning: callers bound it.

use use3d_capture::{Camera, Image, Lattice};

use crate::RenderError;
use crate::modes::{Mode, SceneRenderer};

/// The answer of a look to light, for every pixel of a lattice.
#[derive(Clone, Debug, PartialEq)]
pub struct Response {
    /// `N`: plane `i` of `columns[j]` is `N_ij`.
    pub columns: [Image; 3],
    /// `τ`, per channel.
    pub arriving: Image,
}

impl SceneRenderer<'_> {
    /// The answer of `mode` (a look: `Reconstruction`, `Clear`, `Enhanced` or `EnhancedClear`) from a camera,
    /// with the renderer's strength, water and white balance.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn response(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        mode: Mode,
    ) -> Result<Response, RenderError> {
        let place = (camera, lattice);
        let arriving = self.arriving(camera, lattice)?;
        let dry = matches!(mode, Mode::Clear | Mode::EnhancedClear);
        let gains = mode.gains(&self.gains).unwrap_or([1.0; 3]);
        let mut columns = [const { None }; 3];
        for (j, column) in columns.iter_mut().enumerate() {
            let image = self.column(place, mode.is_enhanced(), dry, j)?;
            let pixels = image.pixels().max(1);
            for (plane, gain) in image.data_mut().chunks_mut(pixels).zip(gains) {
                plane.iter_mut().for_each(|v| *v *= gain);
            }
            *column = Some(image.clone());
        }
        let columns = columns.map(Option::unwrap_or_default);
        Ok(Response { columns, arriving })
    }
}
