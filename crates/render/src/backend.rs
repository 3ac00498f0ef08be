//! Where a scene is drawn.

use std::fmt;

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

/// Changes the colours of all Gaussians of a view, in their order, in place.
pub type Recolor<'r> = dyn Fn(&mut [[f32; 3]]) + 'r;

/// What a [`Composer`] is asked for: the Gaussians of its scene in front of a camera.
#[derive(Clone, Copy)]
pub struct Composition<'r> {
    /// The camera, in the scene's frame.
    pub camera: &'r Camera,
    /// Which of its pixels.
    pub lattice: &'r Lattice,
    /// What the scene's stage-1 colours in this view go through before they are drawn.
    pub recolor: Option<&'r Recolor<'r>>,
    /// The water on the lattice; `None`: there is none.
    pub medium: Option<&'r MediumMaps>,
    /// Whether the image's parts are wanted.
    pub layers: bool,
}

impl fmt::Debug for Composition<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = (self.lattice.width(), self.lattice.height());
        let (recolored, wet, layers) = (self.recolor.is_some(), self.medium.is_some(), self.layers);
        write!(f, "Composition {{ {size:?}, recolored: {recolored}, wet: {wet}, layers: {layers} }}")
    }
}

/// Composes the Gaussians of a scene on some device: what is left of a [`Backend`] when looks and shares of
/// the water are taken care of, as [`Looking`](crate::Looking) does for it.
pub trait Composer: Send {
    /// Draws what is asked for into `out`, whose former contents count for nothing.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the composer may then be used no more.
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError>;
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
