//! Where a scene is drawn.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_splat::Rendered;

use crate::RenderError;

/// One drawing that a backend is asked for.
#[derive(Clone, Copy, Debug)]
pub struct Request<'r> {
    /// The camera, in the scene's frame.
    pub camera: &'r Camera,
    /// Which of its pixels.
    pub lattice: &'r Lattice,
    /// The share of the water that is left, in `[0, 1]`; `None`: the radiance of the Gaussians on black,
    /// without a look at the water, so that [`Backend::medium`] stays as it was.
    pub water: Option<f32>,
    /// Whether object, medium and clear layers are wanted beside the picture.
    pub layers: bool,
}

/// Draws views of the scene and the [`Look`](crate::Look) that it was made for, and keeps on its device what
/// is the same for all of them.
///
/// What a drawing must show is said in [`Renderer`](crate::Renderer) and defined by [`Cpu`](crate::Cpu).
pub trait Backend: Send {
    /// Draws what is asked for into `out`, whose former contents count for nothing.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the backend may then be used no more.
    fn draw(&mut self, request: &Request<'_>, out: &mut Rendered) -> Result<(), RenderError>;

    /// The water of the last drawing with some, all of it, however little was left in the picture: `c_m`,
    /// `β_bs`, `β_attn` on its lattice. `None` in a scene without water.
    fn medium(&self) -> Option<&MediumMaps>;
}
