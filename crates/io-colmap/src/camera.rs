//! A camera of a model.

use use3d_survey::Lens;

use crate::lens::LensModel;

/// A camera: a lens model with parameters, and the size of its images.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelCamera {
    /// The id that images refer to.
    pub id: u32,
    /// The lens model.
    pub model: LensModel,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Parameters in COLMAP's order.
    pub parameters: Vec<f64>,
}

impl ModelCamera {
    /// A pinhole camera (`PINHOLE`) of these intrinsics.
    pub fn pinhole(id: u32, k: &use3d_capture::Intrinsics) -> Self {
        Self {
            id,
            model: LensModel::Pinhole,
            width: k.width,
            height: k.height,
            parameters: vec![k.fx, k.fy, k.cx, k.cy],
        }
    }

    /// The lens; `None` if the number of parameters is wrong (never for a model that was read).
    pub fn lens(&self) -> Option<Lens> {
        self.model.lens(&self.parameters)
    }
}
