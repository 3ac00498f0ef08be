//! What stage 1 knows of a view beside its picture: clear radiance, accumulation, and how much of a surface's light arrives.
//!
//! ```text
//! J = Σ wᵢ cᵢ        A = Σ wᵢ        A t = Σ wᵢ e^{−β_attn sᵢ}
//! ```
//!
//! with weights `wᵢ` and ray distances `sᵢ` of the compositor. The last is the picture of a white scene in water without a veil; through the
//! same kernel, so nothing is approximated. Without water `t = 1`.

use use3d_atc::proposers::SceneView;
use use3d_capture::{Camera, Image, Lattice, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered, view_colors};

/// Draws what is known of the views of a scene. Keeps its buffers from one to the next.
pub struct KnownViews<'s> {
    scene: &'s Scene,
    prepared: Prepared,
    rasterizer: Rasterizer,
    rendered: Rendered,
    colors: Vec<[f32; 3]>,
    maps: MediumMaps,
}

impl<'s> KnownViews<'s> {
    /// Of a scene of stage 1; an enhancement does not count.
    pub fn new(scene: &'s Scene) -> Self {
        Self {
            scene,
            prepared: Prepared::new(),
            rasterizer: Rasterizer::new(),
            rendered: Rendered::new(),
            colors: Vec::new(),
            maps: MediumMaps::zeros(0, 0),
        }
    }

    /// What is known from a camera in the scene's frame, at its size.
    pub fn view(&mut self, camera: &Camera) -> SceneView {
        let (scene, lattice) = (self.scene, Lattice::full(&camera.intrinsics));
        view_colors(&scene.gaussians, camera, scene.gaussians.sh_degree, &mut self.colors);
        self.prepared.prepare(&scene.gaussians, camera, &lattice, Colors::Given(&self.colors));
        let options = Options::default();
        self.rasterizer.forward(&self.prepared, None, &options, &mut self.rendered);
        let (clear, accumulation) = (self.rendered.image.clone(), self.rendered.accumulation.clone());
        if scene.medium.is_none() {
            let (w, h) = (accumulation.width(), accumulation.height());
            let grey = accumulation.data().repeat(3);
            let arriving = Image::from_planes(w, h, grey).unwrap_or_else(|| Image::new(w, h));
            return SceneView { clear, accumulation, arriving };
        }
        scene.medium.maps(camera, &lattice, scene.medium_degree, &mut self.maps);
        self.maps.color.data_mut().fill(0.0);
        self.colors.fill([1.0; 3]);
        self.prepared.set_colors(&self.colors);
        self.rasterizer.forward(&self.prepared, Some(&self.maps), &options, &mut self.rendered);
        SceneView { clear, accumulation, arriving: self.rendered.image.clone() }
    }
}
