//! Quantities of a view that stage 1 knows in addition to its picture: clear radiance, accumulation, and the
//! share of a surface's light that reaches the camera.
//!
//! ```text
//! J = Σ wᵢ cᵢ        A = Σ wᵢ        A t = Σ wᵢ e^{−β_attn sᵢ}
//! ```
//!
//! with weights `wᵢ` and ray distances `sᵢ` of the compositor. The last is the picture of a white scene in
//! water without a veil. It is computed by the same kernel, so there is no approximation. Without water `t =
//! 1`.

use use3d_capture::{Camera, Image, KeptWater, Lattice, Map, MediumMaps};
use use3d_splat::{Options, Rendered};

use crate::{Compositor, Scene};

/// The quantities of a view that stage 1 knows. All three have the camera's size.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownView {
    /// Clear radiance `J`, display range, unclamped, black where there is no object.
    pub clear: Image,
    /// Accumulated opacity `A`, `[0, 1]`.
    pub accumulation: Map,
    /// The share of a white surface's light that reaches the camera, `A t`, per channel, `[0, 1]`.
    pub arriving: Image,
}

/// Computes the known quantities of the views of a scene. It reuses its buffers for all views.
pub struct KnownViews<'s> {
    scene: &'s Scene,
    compositor: Compositor,
    rendered: Rendered,
    maps: MediumMaps,
}

impl<'s> KnownViews<'s> {
    /// Uses a scene of stage 1; an enhancement is ignored.
    pub fn new(scene: &'s Scene) -> Self {
        Self {
            scene,
            compositor: Compositor::default(),
            rendered: Rendered::new(),
            maps: MediumMaps::zeros(0, 0),
        }
    }

    /// The scene from a camera in its frame, as stage 1 learnt it but through thinner water; open water keeps
    /// its colour. Display range, unclamped.
    pub fn through(&mut self, camera: &Camera, kept: KeptWater) -> Image {
        let (scene, lattice) = (self.scene, Lattice::full(&camera.intrinsics));
        self.compositor.prepare(scene, camera, &lattice, |_| ());
        let water = scene.look_through(camera, &lattice, &mut self.maps);
        kept.thin(&mut self.maps);
        let maps = water.then_some(&self.maps);
        self.compositor.draw(maps, &Options::default(), &mut self.rendered);
        self.rendered.image.clone()
    }

    /// The known quantities of a view from a camera in the scene's frame, at its size.
    pub fn view(&mut self, camera: &Camera) -> KnownView {
        let (scene, lattice) = (self.scene, Lattice::full(&camera.intrinsics));
        self.compositor.prepare(scene, camera, &lattice, |_| ());
        let options = Options::default();
        self.compositor.draw(None, &options, &mut self.rendered);
        let (clear, accumulation) = (self.rendered.image.clone(), self.rendered.accumulation.clone());
        if !scene.look_through(camera, &lattice, &mut self.maps) {
            let (w, h) = (accumulation.width(), accumulation.height());
            let grey = accumulation.data().repeat(3);
            let arriving = Image::from_planes(w, h, grey).unwrap_or_else(|| Image::new(w, h));
            return KnownView { clear, accumulation, arriving };
        }
        self.maps.darken();
        self.compositor.recolor(|colors| colors.fill([1.0; 3]));
        self.compositor.draw(Some(&self.maps), &options, &mut self.rendered);
        KnownView { clear, accumulation, arriving: self.rendered.image.clone() }
    }
}
