//! How a scene is drawn: the one place where its Gaussians, their colours and its water meet the compositor.
//!
//! camera → [`Scene::project`] (projection, tile lists, stage-1 colours) and [`Scene::look_through`] (the
//! water's maps) → [`Compositor::draw`]. Whoever draws a scene in another look changes colours or maps in
//! between.

use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered, view_colors};

use crate::Scene;

impl Scene {
    /// Projects the Gaussians for the pixels of `lattice` seen by `camera` (in the scene's frame). `colors`
    /// becomes their stage-1 colours in this view, passed through `recolor`.
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

    /// The stage-1 water in front of a camera: `c_m`, `β_bs`, `β_attn` on the lattice. `false`, and `maps` as
    /// they were, in a scene without water.
    pub fn look_through(&self, camera: &Camera, lattice: &Lattice, maps: &mut MediumMaps) -> bool {
        let water = !self.medium.is_none();
        if water {
            self.medium.maps(camera, lattice, self.medium_degree, maps);
        }
        water
    }
}

/// Draws scenes, and keeps its buffers from one view to the next.
pub struct Compositor {
    prepared: Prepared,
    rasterizer: Rasterizer,
    colors: Vec<[f32; 3]>,
}

impl Default for Compositor {
    fn default() -> Self {
        Self::new()
    }
}

impl Compositor {
    /// With empty buffers.
    pub fn new() -> Self {
        Self { prepared: Prepared::new(), rasterizer: Rasterizer::new(), colors: Vec::new() }
    }

    /// Makes a view ready to be drawn, in stage-1 colours passed through `recolor`.
    pub fn prepare(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        lattice: &Lattice,
        recolor: impl FnOnce(&mut Vec<[f32; 3]>),
    ) {
        scene.project(camera, lattice, recolor, &mut self.colors, &mut self.prepared);
    }

    /// Changes the colours of the view that is ready.
    pub fn recolor(&mut self, recolor: impl FnOnce(&mut [[f32; 3]])) {
        recolor(&mut self.colors);
        self.prepared.set_colors(&self.colors);
    }

    /// Draws the view that is ready, in water with these maps of its lattice, or in none.
    pub fn draw(&mut self, medium: Option<&MediumMaps>, options: &Options, out: &mut Rendered) {
        self.rasterizer.forward(&self.prepared, medium, options, out);
    }
}
