//! One source image with everything that depends on it alone, and the extractor's value and gradient.

use std::sync::Arc;

use rayon::prelude::*;
use use3d_capture::{Image, Map};

use super::descriptors::describe;
use super::global::{Ridge, pixel_weights};
use super::local::{Band, SIDE};
use super::resize::Resize;
use super::{Affine, Descriptors, ExtractorSettings, Geometry, Transition};
use crate::error::AtcError;
use crate::vectorized::vectorized;

/// A source image prepared for the extractor: resized, weighted, with its inverted moments and pooled
/// samples.
///
/// It takes about 20 bytes per working pixel, 2 MB at 384 × 256.
#[derive(Clone, Debug)]
pub struct SourceImage {
    /// The geometry.
    pub geometry: Arc<Geometry>,
    /// The source at the working resolution.
    pub image: Image,
    weights: Map,
    ridge: Ridge,
    /// `[8 rows][3][8 columns]` means of the resized source.
    samples: Vec<f64>,
}

/// Working memory of [`SourceImage::forward`] and [`SourceImage::backward_on_lattice`], and the last
/// transition. One workspace can be used for many steps.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    /// The transition of the last [`SourceImage::forward`].
    pub transition: Transition,
    target: Image,
    samples: Vec<f64>,
    d_samples: Vec<f64>,
    column_sums: Vec<f64>,
    row_sums: Vec<Affine>,
    band_sums: Vec<Affine>,
    wide: Vec<f32>,
    d_target: Image,
    resize_scratch: Vec<f32>,
}

fn check_size(image: &Image, (width, height): (usize, usize)) -> Result<(), AtcError> {
    if (image.width(), image.height()) == (width, height) {
        return Ok(());
    }
    Err(AtcError::Size { found_width: image.width(), found_height: image.height(), width, height })
}

impl SourceImage {
    /// Makes a source from a whole image, with a geometry of its own.
    pub fn from_image(image: &Image, settings: &ExtractorSettings) -> Result<Self, AtcError> {
        let geometry = Geometry::new(image.width(), image.height(), settings)?;
        Self::new(&Arc::new(geometry), image)
    }

    /// Makes a source from a whole image of the geometry's size.
    pub fn new(geometry: &Arc<Geometry>, image: &Image) -> Result<Self, AtcError> {
        check_size(image, geometry.size)?;
        Self::resized(geometry, &geometry.resize, image)
    }

    /// Makes a source from an image that holds only the geometry's lattice ([`Geometry::columns`] ×
    /// [`Geometry::rows`]).
    pub fn on_lattice(geometry: &Arc<Geometry>, image: &Image) -> Result<Self, AtcError> {
        check_size(image, geometry.lattice_resize.source_size())?;
        Self::resized(geometry, &geometry.lattice_resize, image)
    }

    fn resized(geometry: &Arc<Geometry>, resize: &Resize, image: &Image) -> Result<Self, AtcError> {
        let mut working = Image::new(0, 0);
        resize.forward(image, &mut working);
        if !working.data().par_iter().all(|v| v.is_finite()) {
            return Err(AtcError::NonFiniteSource);
        }
        let weights = pixel_weights(&working);
        let ridge = Ridge::new(&working, &weights).ok_or(AtcError::NonFiniteSource)?;
        let mut samples = vec![0.0; 3 * SIDE * SIDE * geometry.grid.0 * geometry.grid.1];
        geometry.samples.forward(3, working.data(), &mut samples, &mut Vec::new());
        Ok(Self { geometry: geometry.clone(), image: working, weights, ridge, samples })
    }

    /// The descriptors of the source. They are computed on every call, which takes tens of milliseconds.
    pub fn descriptors(&self) -> Descriptors {
        describe(&self.image, &self.geometry.cells)
    }

    /// Computes `E(source, target)` for a target of the geometry's size, of the working size, or of any
    /// other size (which is resized to the working size in the same way).
    pub fn forward<'w>(
        &self,
        target: &Image,
        workspace: &'w mut Workspace,
    ) -> Result<&'w Transition, AtcError> {
        let size = (target.width(), target.height());
        if size.0 == 0 || size.1 == 0 {
            return Err(AtcError::EmptyImage { role: "target", width: size.0, height: size.1 });
        }
        if size == self.geometry.size {
            self.geometry.resize.forward(target, &mut workspace.target);
        } else {
            Resize::between(size, self.geometry.working).forward(target, &mut workspace.target);
        }
        self.fit(workspace);
        Ok(&workspace.transition)
    }

    /// Like [`SourceImage::forward`], for a target that holds only the geometry's lattice, with the same
    /// bits.
    pub fn forward_on_lattice<'w>(
        &self,
        target: &Image,
        workspace: &'w mut Workspace,
    ) -> Result<&'w Transition, AtcError> {
        check_size(target, self.geometry.lattice_resize.source_size())?;
        self.geometry.lattice_resize.forward(target, &mut workspace.target);
        self.fit(workspace);
        Ok(&workspace.transition)
    }

    fn fit(&self, ws: &mut Workspace) {
        let (columns, rows) = self.geometry.grid;
        ws.transition.global = self.ridge.forward(&self.image, &self.weights, &ws.target, &mut ws.row_sums);
        ws.samples.resize(self.samples.len(), 0.0);
        self.geometry.samples.forward(3, ws.target.data(), &mut ws.samples, &mut ws.column_sums);
        ws.transition.local.resize(columns * rows, [0.0; 6]);
        let (global, form) = (ws.transition.global, self.geometry.settings.form);
        ws.transition
            .local
            .par_chunks_mut(columns)
            .zip(self.bands(&ws.samples))
            .for_each(|(out, band)| vectorized!(band.forward(&global, form, out)));
    }

    /// The bands of cells, over the pooled source and the pooled target.
    fn bands<'a>(&'a self, target: &'a [f64]) -> impl IndexedParallelIterator<Item = Band<'a>> {
        let columns = SIDE * self.geometry.grid.0;
        let length = 3 * SIDE * columns;
        self.samples.par_chunks(length).zip(target.par_chunks(length)).map(move |(source, target)| Band {
            source,
            target,
            columns,
        })
    }

    /// The weight of each cell in calibration, `[0, 1]`, for the target of the last forward call.
    pub fn confidence(&self, workspace: &Workspace) -> Vec<f64> {
        let (columns, rows) = self.geometry.grid;
        let mut out = vec![0.0; columns * rows];
        out.par_chunks_mut(columns)
            .zip(self.bands(&workspace.samples))
            .for_each(|(out, band)| band.confidence(&workspace.transition.global, out));
        out
    }

    /// Computes the gradient with respect to the target of the last [`SourceImage::forward`], on the
    /// geometry's lattice, from the gradients of the global operator and of the local ones (not centred: see
    /// [`super::center`]). `gradient` is overwritten.
    pub fn backward_on_lattice(
        &self,
        global: &Affine,
        local: &[[f64; 6]],
        ws: &mut Workspace,
        gradient: &mut Image,
    ) -> Result<(), AtcError> {
        let (w, h) = self.geometry.working;
        let (columns, rows) = self.geometry.grid;
        check_size(&ws.target, (w, h))?;
        if local.len() != columns * rows {
            return Err(AtcError::artifact(
                "gradient with respect to the local operators",
                format!("{} cells, the grid has {columns}x{rows}", local.len()),
            ));
        }
        let operator = ws.transition.global;
        let form = self.geometry.settings.form;
        let sample_columns = SIDE * columns;

        ws.d_samples.resize(self.samples.len(), 0.0);
        ws.band_sums.resize(rows, [0.0; 12]);
        ws.d_samples
            .par_chunks_mut(3 * SIDE * sample_columns)
            .zip(&mut ws.band_sums)
            .zip(local.par_chunks(columns))
            .zip(self.bands(&ws.samples))
            .for_each(|(((out, sum), d_cells), band)| {
                *sum = vectorized!(band.backward(&operator, form, d_cells, out));
            });
        let mut d_operator = *global;
        for sum in &ws.band_sums {
            for (o, s) in d_operator.iter_mut().zip(sum) {
                *o += s;
            }
        }
        let k = self.ridge.times_inverse(&d_operator).map(|v| v as f32);

        let pooling = &self.geometry.samples;
        ws.wide.resize(3 * SIDE * rows * w, 0.0);
        pooling.spread(3, &ws.d_samples, &mut ws.wide);
        ws.d_target.resize(w, h);
        let wide = &ws.wide;
        ws.d_target.data_mut().par_chunks_mut(w).enumerate().for_each(|(row, out)| {
            let (c, y) = (row / h, row % h);
            let x: [&[f32]; 3] = std::array::from_fn(|j| self.image.row(j, y));
            let k = [k[4 * c], k[4 * c + 1], k[4 * c + 2], k[4 * c + 3]];
            vectorized!(affine_row(out, x, self.weights.row(0, y), k));
            for band in pooling.y.covering[y].clone() {
                let spread = &wide[(band * 3 + c) * w..][..w];
                vectorized!(add_row(out, spread));
            }
        });
        self.geometry.lattice_resize.backward(&ws.d_target, gradient, &mut ws.resize_scratch);
        Ok(())
    }
}

/// `w K x̃` for one channel of one row.
#[inline(always)]
fn affine_row(out: &mut [f32], x: [&[f32]; 3], w: &[f32], k: [f32; 4]) {
    let n = out.len();
    let (r, g, b, w) = (&x[0][..n], &x[1][..n], &x[2][..n], &w[..n]);
    for p in 0..n {
        out[p] = w[p] * (k[0] * r[p] + k[1] * g[p] + k[2] * b[p] + k[3]);
    }
}

#[inline(always)]
fn add_row(out: &mut [f32], row: &[f32]) {
    for (o, &v) in out.iter_mut().zip(row) {
        *o += v;
    }
}
