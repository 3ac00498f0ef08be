//! The pixels of a camera that are rendered, and the water in front of each of them.

use crate::{Camera, Image, Intrinsics};

/// A tensor-product subset of a camera's pixel centres: every combination of some columns and some rows.
///
/// A whole image is `columns = 0.5, 1.5, …`, `rows = 0.5, 1.5, …`. Stage 2 renders only the columns and rows
/// that the extractor's resize reads. They form a lattice too, so one renderer serves both. Coordinates are
/// strictly ascending.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    columns: Vec<f32>,
    rows: Vec<f32>,
}

impl Lattice {
    /// Every pixel of an image.
    pub fn full(intrinsics: &Intrinsics) -> Self {
        Self::size(intrinsics.width, intrinsics.height)
    }

    /// Every pixel of a `width × height` image.
    pub fn size(width: usize, height: usize) -> Self {
        let centres = |n: usize| (0..n).map(|i| i as f32 + 0.5).collect();
        Self { columns: centres(width), rows: centres(height) }
    }

    /// The pixels at some columns and rows (indices, strictly ascending); `None` if they are not ascending or
    /// a list is empty.
    pub fn subset(columns: &[usize], rows: &[usize]) -> Option<Self> {
        let centres = |indices: &[usize]| {
            (!indices.is_empty() && indices.windows(2).all(|w| w[0] < w[1]))
                .then(|| indices.iter().map(|&i| i as f32 + 0.5).collect())
        };
        Some(Self { columns: centres(columns)?, rows: centres(rows)? })
    }

    /// Number of columns in the subset.
    pub fn width(&self) -> usize {
        self.columns.len()
    }

    /// Number of rows in the subset.
    pub fn height(&self) -> usize {
        self.rows.len()
    }

    /// Pixel-centre x coordinates, ascending.
    pub fn columns(&self) -> &[f32] {
        &self.columns
    }

    /// Pixel-centre y coordinates, ascending.
    pub fn rows(&self) -> &[f32] {
        &self.rows
    }
}

/// The formation of an image from Gaussians and water.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Formation {
    /// Every Gaussian is seen through the water in front of it, at its own distance.
    #[default]
    PerGaussian,
    /// Gaussians are composed without water, and each pixel is then seen through the water at its expected
    /// distance.
    PerImage,
    /// The same with distances that are normalised in each view, 0 for the nearest and 1 for the farthest
    /// pixel. Coefficients then have no unit, and colours lie in `[0, 1]`.
    Normalised,
    /// As per image, with the [`DepthNetwork`] of the view in place of coefficients.
    DepthNetwork,
}

/// Number of hidden units of a [`DepthNetwork`].
pub const DEPTH_UNITS: usize = 32;

/// The water of one view as a function of the inverse depth `q` of a pixel, per channel: 3D-UIR's water.
///
/// ```text
/// h_j = σ(slope_j q + bias_j)      a_c = σ(σ(offset_c + Σ_j output_jc h_j))      z = 1 / (q + 1e-5)
/// I_c = J_c + share_c (J_c (a_c − 1) + c_m,c (1 − e^{−veil_c z}) + residual_c e^{−residual_rate_c z})
/// ```
///
/// `c_m` is [`MediumMaps::color`]. It also holds gradients with respect to its own numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthNetwork {
    /// Share of the water that is left, in `[0, 1]`. It has no gradient.
    pub share: [f32; 3],
    /// Backscatter coefficient, 1 / scene unit.
    pub veil: [f32; 3],
    /// Light at distance 0 of the term that fades with the distance.
    pub residual: [f32; 3],
    /// Rate at which it fades, 1 / scene unit.
    pub residual_rate: [f32; 3],
    /// Weight of the inverse depth in every hidden unit.
    pub slopes: [f32; DEPTH_UNITS],
    /// Bias of every hidden unit.
    pub biases: [f32; DEPTH_UNITS],
    /// Weights of every hidden unit in the three outputs.
    pub outputs: [[f32; 3]; DEPTH_UNITS],
    /// Biases of the outputs.
    pub offsets: [f32; 3],
}

impl DepthNetwork {
    /// All numbers that have gradients.
    pub fn values(&self) -> impl Iterator<Item = &f32> {
        let Self { share: _, veil, residual, residual_rate, slopes, biases, outputs, offsets } = self;
        let before = veil.iter().chain(residual).chain(residual_rate).chain(slopes).chain(biases);
        before.chain(outputs.as_flattened()).chain(offsets)
    }

    /// The mutable form of [`values`](Self::values).
    pub fn values_mut(&mut self) -> impl Iterator<Item = &mut f32> {
        let Self { share: _, veil, residual, residual_rate, slopes, biases, outputs, offsets } = self;
        let before = veil.iter_mut().chain(residual).chain(residual_rate).chain(slopes).chain(biases);
        before.chain(outputs.as_flattened_mut()).chain(offsets)
    }
}

/// The water seen through each pixel of a lattice: the output of a medium model and an input of the
/// compositor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MediumMaps {
    /// `c_m`, the colour of infinitely deep water along the ray, display range, ≥ 0.
    pub color: Image,
    /// `β_bs`, backscatter coefficient, 1 / scene unit, ≥ 0.
    pub backscatter: Image,
    /// `β_attn`, attenuation coefficient, 1 / scene unit, ≥ 0.
    pub attenuation: Image,
    /// The formation of images in this water. It has no meaning in gradients.
    pub formation: Formation,
    /// The network of [`Formation::DepthNetwork`]; `None` in other water.
    pub network: Option<Box<DepthNetwork>>,
}

impl MediumMaps {
    /// Zeros (no water); also the initial value of gradients with respect to the three maps.
    pub fn zeros(width: usize, height: usize) -> Self {
        Self {
            color: Image::new(width, height),
            backscatter: Image::new(width, height),
            attenuation: Image::new(width, height),
            formation: Formation::default(),
            network: None,
        }
    }

    /// Removes the water's own light. What it lets through stays.
    pub fn darken(&mut self) {
        self.color.data_mut().fill(0.0);
        if let Some(network) = &mut self.network {
            network.residual = [0.0; 3];
        }
    }

    /// Changes the size, keeping allocations; contents are unspecified afterwards.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.color.resize(width, height);
        self.backscatter.resize(width, height);
        self.attenuation.resize(width, height);
    }
}

/// The unit world-space direction of the ray through pixel coordinates `(u, v)` (R3), f32.
#[inline]
pub fn world_direction(camera: &Camera, u: f64, v: f64) -> [f32; 3] {
    let d = (camera.pose.rotation.transpose() * camera.ray(u, v)).normalize();
    [d.x as f32, d.y as f32, d.z as f32]
}
