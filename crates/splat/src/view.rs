//! The inputs and outputs of a rendered view.

use use3d_capture::{Camera, Image, Map, MediumMaps};

use crate::{GaussianGradients, Gaussians};

/// The source of colours when a view is prepared.
#[derive(Clone, Copy, Debug)]
pub enum Colors<'a> {
    /// The Gaussians' spherical harmonics with bands up to `degree` (at most the stored degree):
    /// `max(SH + ½, 0)`.
    Sh {
        /// Highest degree evaluated.
        degree: usize,
    },
    /// One colour per Gaussian for this view, used unchanged and not clamped.
    Given(&'a [[f32; 3]]),
}

/// The choice of what is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// True if the gradient flows through the distance `s_i` in the medium's terms (R2); expected depth is
    /// always differentiable.
    pub depth_gradient: bool,
    /// True if [`Rendered::layers`] is filled.
    pub layers: bool,
    /// True if [`GaussianGradients::signed_screen`] is filled: there opposite gradients cancel.
    pub signed_screen: bool,
    /// True if the gradients of the Gaussians are not needed. Then they may keep old values, and a pass over
    /// the Gaussians is left out where it can be.
    pub water_only: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { depth_gradient: true, layers: false, signed_screen: false, water_only: false }
    }
}

/// A rendered view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendered {
    /// The underwater image (without a medium: the Gaussians on black), display range, unclamped.
    pub image: Image,
    /// Expected depth along the optical axis, `Σ w z / max(Σ w, 1e-6)`; 0 where nothing is hit.
    pub depth: Map,
    /// `Σ w`, in `[0, 1)`.
    pub accumulation: Map,
    /// The parts of the image, if requested.
    pub layers: Option<Layers>,
}

/// The parts of an underwater image: `image = object + medium + far`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layers {
    /// Attenuated object radiance, `Σ w c e^{-β_a s}`.
    pub object: Image,
    /// Backscatter of the intervals up to the last Gaussian.
    pub medium: Image,
    /// Backscatter behind the last Gaussian.
    pub far: Image,
    /// Object radiance without water, `J = Σ w c`.
    pub clear: Image,
    /// Expected distance along the ray, `Σ w s / max(Σ w, 1e-6)`.
    pub distance: Map,
}

impl Rendered {
    /// An empty view; [`Rasterizer::forward`](crate::Rasterizer::forward) sets the sizes.
    pub fn new() -> Self {
        Self::default()
    }

    pub(crate) fn resize(&mut self, width: usize, height: usize, layers: bool) {
        self.image.resize(width, height);
        self.depth.resize(width, height);
        self.accumulation.resize(width, height);
        if !layers {
            self.layers = None;
            return;
        }
        let layers = self.layers.get_or_insert_default();
        for image in [&mut layers.object, &mut layers.medium, &mut layers.far, &mut layers.clear] {
            image.resize(width, height);
        }
        layers.distance.resize(width, height);
    }
}

/// The loss's gradients with respect to the results of [`Rasterizer::forward`](crate::Rasterizer::forward).
#[derive(Clone, Copy, Debug)]
pub struct RenderGradients<'a> {
    /// Gradient with respect to the image.
    pub image: &'a Image,
    /// Gradient with respect to expected depth.
    pub depth: Option<&'a Map>,
    /// Gradient with respect to accumulation.
    pub accumulation: Option<&'a Map>,
    /// Gradient with respect to the clear image.
    pub clear: Option<&'a Image>,
}

/// The Gaussians and the camera from which a view was prepared.
#[derive(Clone, Copy, Debug)]
pub struct ViewOf<'a> {
    /// The Gaussians seen.
    pub gaussians: &'a Gaussians,
    /// The camera that sees them.
    pub camera: &'a Camera,
}

/// The buffers to which [`Rasterizer::backward`](crate::Rasterizer::backward) writes its gradients.
#[derive(Debug)]
pub struct Gradients<'a> {
    /// Gradients of the Gaussians' parameters.
    pub gaussians: &'a mut GaussianGradients,
    /// Gradients of the medium's maps, if they are wanted.
    pub medium: Option<&'a mut MediumMaps>,
}
