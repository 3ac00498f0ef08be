//! The devices on which a scene is drawn.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_splat::Rendered;

use crate::RenderError;

/// One drawing requested from a backend.
#[derive(Clone, Copy, Debug)]
pub struct Request<'r> {
    /// The camera, in the scene's frame.
    pub camera: &'r Camera,
    /// The pixels of it to draw.
    pub lattice: &'r Lattice,
    /// The share of the water that is left, in `[0, 1]`. `None` draws the radiance of the Gaussians on
    /// black, without evaluating the water, so that [`Backend::medium`] stays unchanged.
    pub water: Option<f32>,
    /// True if object, medium and clear layers are requested besides the picture.
    pub layers: bool,
}

/// Changes the colours of all Gaussians of a view, in their order, in place.
pub type Recolor<'r> = dyn Fn(&mut [[f32; 3]]) + 'r;

/// The input of a [`Composer`]: the Gaussians of its scene in front of a camera.
#[derive(Clone, Copy)]
pub struct Composition<'r> {
    /// The camera, in the scene's frame.
    pub camera: &'r Camera,
    /// The pixels of it to draw.
    pub lattice: &'r Lattice,
    /// A function that changes the scene's stage-1 colours in this view before they are drawn.
    pub recolor: Option<&'r Recolor<'r>>,
    /// The water on the lattice; `None` if there is none.
    pub medium: Option<&'r MediumMaps>,
    /// True if the image's parts are requested.
    pub layers: bool,
}

/// Composes the Gaussians of a scene on some device: the part of a [`Backend`] without looks and shares of
/// the water, which [`Looking`](crate::Looking) adds.
pub trait Composer: Send {
    /// Draws the composition into `out`, whose former contents do not matter.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the composer must not be used afterwards.
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError>;
}

/// Draws views of the scene and the [`Look`](crate::Look) for which it was made, and keeps on its device
/// the data that all views share.
///
/// [`Renderer`](crate::Renderer) describes what a drawing must show, and [`Cpu`](crate::Cpu) defines it.
pub trait Backend: Send {
    /// Draws the request into `out`, whose former contents do not matter.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the backend must not be used afterwards.
    fn draw(&mut self, request: &Request<'_>, out: &mut Rendered) -> Result<(), RenderError>;

    /// Draws the light of surfaces alone, without a veil: the answer of this look to a unit of stage-1
    /// radiance on every Gaussian, `Σ w t g`. With `channel`, the unit is light of that channel and `g` is
    /// the graded column of each Gaussian; without, `g = 1`, which is the share of light that arrives. Only
    /// camera, lattice and water of the request count.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the backend must not be used afterwards.
    fn respond(
        &mut self,
        request: &Request<'_>,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError>;

    /// The full water of the last drawing with water, for any share that was drawn: `c_m`, `β_bs`, `β_attn`
    /// on its lattice. `None` in a scene without water.
    fn medium(&self) -> Option<&MediumMaps>;
}
