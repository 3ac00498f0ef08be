//! The devices on which a scene is drawn.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_scene::{Compositor, Scene};
use use3d_splat::{Options, Rendered};

use crate::RenderError;

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

/// Composes the Gaussians of a scene on some device, and keeps there the data that all views share.
/// [`Renderer`](crate::Renderer) adds looks and shares of the water.
pub trait Composer: Send {
    /// Draws the composition into `out`, whose former contents do not matter.
    ///
    /// # Errors
    /// [`RenderError::Device`]; the composer must not be used afterwards.
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError>;
}

/// Composes on the processor. It is the reference: the same bytes on any number of threads.
pub struct Processor<'s> {
    scene: &'s Scene,
    compositor: Compositor,
}

impl<'s> Processor<'s> {
    /// A composer of a scene.
    pub fn new(scene: &'s Scene) -> Self {
        Self { scene, compositor: Compositor::default() }
    }
}

impl Composer for Processor<'_> {
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        let Composition { camera, lattice, recolor, medium, layers } = *view;
        self.compositor.prepare(self.scene, camera, lattice, |colors| {
            if let Some(recolor) = recolor {
                recolor(colors);
            }
        });
        self.compositor.draw(medium, &Options { layers, ..Options::default() }, out);
        Ok(())
    }
}
