//! The drawing of a scene: the one place where its Gaussians, their colours and its water are passed to the
//! compositor.
//!
//! camera → [`Scene::project`] (projection, tile lists, stage-1 colours) and [`Scene::look_through`] (the
//! water's maps) → [`Compositor::draw`]. Code that draws a scene in another look changes colours or maps in
//! between.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered, view_colors};

use crate::Scene;

impl Scene {
    /// Projects the Gaussians for the pixels of `lattice` seen by `camera` (in the scene's frame). `colors`
    /// receives their stage-1 colours in this view, changed by `recolor`.
    pub fn project(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        recolor: impl FnOnce(&mut Vec<[f32; 3]>),
        colors: &mut Vec<[f32; 3]>,
        prepared: &mut Prepared,
    ) {
        view_colors(&self.gaussians, camera, self.gaussians.sh_degree, colors);
        recolor(colors);
        prepared.prepare(&self.gaussians, camera, lattice, Colors::Given(colors));
    }

    /// Computes the stage-1 water in front of a camera: `c_m`, `β_bs`, `β_attn` on the lattice. In a scene
    /// without water, returns `false` and leaves `maps` unchanged.
    pub fn look_through(&self, camera: &Camera, lattice: &Lattice, maps: &mut MediumMaps) -> bool {
        let water = !self.medium.is_none();
        if water {
            self.medium.maps(camera, lattice, self.medium_degree, maps);
        }
        water
    }
}

/// Draws scenes, and reuses its buffers for all views.
pub struct Compositor {
    prepared: Prepared,
    rasterizer: Rasterizer,
    colors: Vec<[f32; 3]>,
}

impl Default for Compositor {
    fn default() -> Self {
        Self { prepared: Prepared::new(), rasterizer: Rasterizer::new(), colors: Vec::new() }
    }
}

impl Compositor {
    /// Prepares a view for drawing, in stage-1 colours changed by `recolor`.
    pub fn prepare(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        lattice: &Lattice,
        recolor: impl FnOnce(&mut Vec<[f32; 3]>),
    ) {
        scene.project(camera, lattice, recolor, &mut self.colors, &mut self.prepared);
    }

    /// Changes the colours of the prepared view.
    pub fn recolor(&mut self, recolor: impl FnOnce(&mut [[f32; 3]])) {
        recolor(&mut self.colors);
        self.prepared.set_colors(&self.colors);
    }

    /// Draws the prepared view, in water with these maps of its lattice, or without water.
    pub fn draw(&mut self, medium: Option<&MediumMaps>, options: &Options, out: &mut Rendered) {
        self.rasterizer.forward(&self.prepared, medium, options, out);
    }
}
