//! The extractor `E(source, target)`: the transition from the appearance of one image to that of another.
//!
//! An appearance transition has a *global operator*, one affine `c ↦ (I + ΔA) c + Δb` for the image, and a
//! *local operator* per cell of a coarse grid: a gain and a bias per channel that act on the result of the
//! global one: `I_b(p) ≈ exp(a_p) ⊙ T(I_a(p)) + b_p`. Both come from ridge fits that shrink to the identity
//! (`global`, `local`), so `E(I, I)` is exactly zero. Colours are display-encoded and unclamped.
//!
//! All quantities that depend on the source alone are in [`SourceImage`] (per image) and [`Geometry`] (per
//! size). [`SourceImage::forward`] and [`SourceImage::backward_on_lattice`] compute the rest, value and exact
//! gradient with respect to the target, without allocating. The source is a constant of the method (R15).
//! The gradient passes through the resize, through the local fit and, because the local fit uses `M x̃`,
//! through the global fit.
//!
//! Both images are resized to a long side of at most 384 pixels (R17) by a bilinear resize that reads at
//! most four pixels per output pixel. Only the pixels at [`Geometry::columns`] and [`Geometry::rows`] are
//! read; a caller that can render just those uses [`SourceImage::forward_on_lattice`] and gets the same bits.

pub(crate) mod descriptors;
pub(crate) mod global;
mod local;
mod pooling;
pub(crate) mod resize;
mod source;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Lattice;
use use3d_numerics::range::{OutOfRange, within};

use crate::error::AtcError;
use local::SIDE;
use pooling::Pooling;
use resize::Resize;

pub use descriptors::{Descriptors, GLOBAL_DESCRIPTOR, LOCAL_DESCRIPTOR};
pub use source::{SourceImage, Workspace};

/// A global operator minus the identity, row-major 3 × 4: `(a00, a01, a02, b0, a10, …, b2)`.
pub type Affine = [f64; 12];

/// `(I + ΔA) c + Δb`.
#[inline(always)]
pub fn affine_apply(operator: &Affine, colour: [f64; 3]) -> [f64; 3] {
    let t = operator;
    std::array::from_fn(|c| {
        colour[c]
            + (t[4 * c] * colour[0] + t[4 * c + 1] * colour[1] + t[4 * c + 2] * colour[2] + t[4 * c + 3])
    })
}

/// The meaning of the first three numbers of a local operator (R16).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// `ln max(gain, 0.05)`: the paper's form.
    #[default]
    Log,
    /// `gain − 1`: the form of the calibrator that the paper's authors released.
    Linear,
}

/// The extractor's settings. A calibrator records those it was fitted with, and the scene follows (R17).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExtractorSettings {
    /// Images are resized to at most this long side, pixels; at least 8.
    pub long_side: usize,
    /// Cells along the long side of the grid of local operators; 2 to 256.
    pub cells: usize,
    /// Form of the local gain.
    pub form: Form,
}

impl Default for ExtractorSettings {
    fn default() -> Self {
        Self { long_side: 384, cells: 16, form: Form::Log }
    }
}

impl ExtractorSettings {
    /// Checks the ranges.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        within("long_side", self.long_side, 8, 8192)?;
        within("cells", self.cells, 2, 256)
    }

    /// The working size `(width, height)` for an image of some size: the long side is at most
    /// [`Self::long_side`], an image is enlarged only up to the floor of 8 pixels, and halves are rounded
    /// to even.
    pub fn working_size(&self, width: usize, height: usize) -> (usize, usize) {
        let long = width.max(height);
        let side = |side: usize| {
            if long <= self.long_side {
                return side.max(8);
            }
            ((side as f64 * self.long_side as f64 / long as f64).round_ties_even() as usize).max(8)
        };
        (side(width), side(height))
    }

    /// The grid `(columns, rows)` for an image of some size.
    pub fn grid(&self, width: usize, height: usize) -> (usize, usize) {
        let (w, h) = self.working_size(width, height);
        let long = w.max(h) as f64;
        let side = |side: usize| ((self.cells as f64 * side as f64 / long).round_ties_even() as usize).max(2);
        (side(w), side(h))
    }
}

/// Everything in the extractor that depends on the image size alone. All views of one size share it.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// The settings.
    pub settings: ExtractorSettings,
    /// `(width, height)` of the images, pixels.
    pub size: (usize, usize),
    /// `(width, height)` at which operators are fitted.
    pub working: (usize, usize),
    /// `(columns, rows)` of the grid of local operators.
    pub grid: (usize, usize),
    /// The pixel columns that the resize reads, ascending.
    pub columns: Vec<usize>,
    /// The pixel rows that the resize reads, ascending.
    pub rows: Vec<usize>,
    resize: Resize,
    lattice_resize: Resize,
    samples: Pooling,
    cells: Pooling,
}

impl Geometry {
    /// The geometry for images of `width × height` pixels.
    pub fn new(width: usize, height: usize, settings: &ExtractorSettings) -> Result<Self, AtcError> {
        settings.validate()?;
        if width == 0 || height == 0 {
            return Err(AtcError::EmptyImage { role: "source", width, height });
        }
        let working = settings.working_size(width, height);
        let grid = settings.grid(width, height);
        let resize = Resize::between((width, height), working);
        Ok(Self {
            settings: settings.clone(),
            size: (width, height),
            working,
            grid,
            columns: resize.x.support(),
            rows: resize.y.support(),
            lattice_resize: Resize::new(resize.x.compact(), resize.y.compact()),
            resize,
            samples: Pooling::new(working, (SIDE * grid.0, SIDE * grid.1)),
            cells: Pooling::new(working, grid),
        })
    }

    /// A sampled form of the same view: the pixels nearest to those of an image of at most `long_side`
    /// pixels, and the geometry that extracts operators over the same grid from them. `None` if pixels
    /// would repeat or the grid would differ (very small images).
    pub fn sampled(&self, long_side: usize) -> Result<Option<(Lattice, Self)>, AtcError> {
        let settings =
            ExtractorSettings { long_side: long_side.min(self.settings.long_side), ..self.settings.clone() };
        settings.validate()?;
        let (width, height) = settings.working_size(self.size.0, self.size.1);
        let axis = |n: usize, samples: usize| -> Vec<usize> {
            (0..samples).map(|i| (2 * i + 1) * n / (2 * samples)).collect()
        };
        let lattice = Lattice::subset(&axis(self.size.0, width), &axis(self.size.1, height));
        let geometry = Self::new(width, height, &settings)?;
        Ok(lattice.filter(|_| geometry.grid == self.grid).map(|lattice| (lattice, geometry)))
    }

    /// The pixels that the resize reads, as the lattice that a renderer takes.
    pub fn lattice(&self) -> Lattice {
        Lattice::subset(&self.columns, &self.rows).unwrap_or_else(|| Lattice::size(self.size.0, self.size.1))
    }
}

/// An appearance transition: the value of `E(source, target)`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Transition {
    /// The global operator minus the identity.
    pub global: Affine,
    /// For each cell, row-major over the grid: log-gain (or gain − 1) of R, G, B, then bias of R, G, B.
    pub local: Vec<[f64; 6]>,
}

/// Subtracts from the local operators their plain mean over the cells, so that they cannot repeat the
/// global one. The map is a symmetric projection: the gradient with respect to the operators is the
/// gradient with respect to the centred operators, centred.
pub fn center(cells: &mut [[f64; 6]]) {
    let count = cells.len().max(1) as f64;
    for k in 0..6 {
        let mean = cells.iter().map(|c| c[k]).sum::<f64>() / count;
        for cell in cells.iter_mut() {
            cell[k] -= mean;
        }
    }
}
