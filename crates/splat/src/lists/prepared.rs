//! The Gaussians of one view, prepared for composing: projected, sorted by depth, and listed per tile.
//!
//! A tile is 16×16 pixels *of the lattice* (of its columns and rows, not of the image's). `prepare` has
//! four steps:
//!
//! 1. project every Gaussian and drop those that cannot be seen (depth range, opacity below 1/255, outside
//!    the lattice);
//! 2. sort by depth, with equal depths in index order;
//! 3. make the *spans* of each tile row: for every Gaussian that touches it, the range of tiles that its
//!    1/255 contour meets;
//! 4. turn the spans of a tile row into one list per tile, in depth order.
//!
//! The contour is exact: `α ≥ 1/255` is `σ ≤ ln(255 opacity)`, an ellipse, and a tile is listed only if the
//! ellipse meets the tile's box of pixel centres along its row. Everything is a function of the data alone:
//! any number of threads makes the same lists.

use std::sync::atomic::{AtomicU64, Ordering};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::{Camera, Lattice};

use super::axis::Axis;
use super::bins::{Band, Span, TileRow, list};
use super::sort;
use super::weights::RowWeights;
use crate::project::{ColorSource, HIDDEN, Projecting, Splat};
use crate::{Colors, Gaussians};

/// Gaussians per parallel task.
const CHUNK: usize = 1024;

/// Projected Gaussians with their tile lists for one camera and lattice. They can be reused while the
/// geometry is frozen; the buffers are kept from one [`Prepared::prepare`] to the next.
#[derive(Clone, Debug, Default)]
pub struct Prepared {
    /// A number unique to one `prepare`; equal stamps mean equal geometry.
    pub(crate) stamp: u64,
    /// A number unique to one set of this view's colours.
    pub(crate) colors: u64,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Number of Gaussians it was prepared from.
    pub(crate) gaussians: usize,
    pub(crate) columns: Axis,
    pub(crate) rows: Axis,
    /// `((u − cx)/fx)²` of the columns and `((v − cy)/fy)²` of the rows, padded like the axes.
    pub(crate) ray_x2: Vec<f32>,
    pub(crate) ray_y2: Vec<f32>,
    pub(crate) color_source: ColorSource,
    /// Visible Gaussians in depth order.
    pub(crate) splats: Vec<Splat>,
    pub(crate) tile_rows: Vec<TileRow>,
    /// Position in depth order of every Gaussian, [`HIDDEN`] if it is not visible.
    pub(crate) ranks: Vec<u32>,
    /// The weights of each tile row, if the view keeps them; otherwise empty.
    pub(crate) weights: Vec<RowWeights>,
    projected: Vec<Splat>,
    keys: sort::Keys,
    bands: Vec<Band>,
}

static STAMP: AtomicU64 = AtomicU64::new(1);

impl Prepared {
    /// An empty view: a 0×0 lattice.
    pub fn new() -> Self {
        Self::default()
    }

    /// Width of the lattice that the view was prepared for.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height of the lattice that the view was prepared for.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Number of Gaussians that the view was prepared from.
    pub fn gaussians(&self) -> usize {
        self.gaussians
    }

    /// Indices of the Gaussians that reach the lattice, nearest first.
    pub fn visible(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.splats.iter().map(|s| s.index as usize)
    }

    /// Raises the radius of every visible Gaussian to the one in this view: three standard deviations along
    /// the longest axis of its ellipse, in pixels. One entry per Gaussian.
    pub fn raise_radii(&self, radii: &mut [f32]) {
        for splat in &self.splats {
            let radius = &mut radii[splat.index as usize];
            *radius = radius.max(3.0 * splat.deviation());
        }
    }

    /// Raises the size of every visible Gaussian to the one in this view: the geometric mean of the standard
    /// deviations of its ellipse, in pixels. One entry per Gaussian.
    pub fn raise_sizes(&self, sizes: &mut [f32]) {
        for splat in &self.splats {
            let size = &mut sizes[splat.index as usize];
            *size = size.max(splat.mean_deviation());
        }
    }

    /// Number of (tile, Gaussian) pairs in the lists.
    pub fn entries(&self) -> usize {
        self.tile_rows.iter().map(|r| r.entries.len()).sum()
    }

    /// Number of bytes that its buffers hold.
    pub fn memory(&self) -> usize {
        let rows: usize = self
            .tile_rows
            .iter()
            .map(|r| {
                r.spans.capacity() * size_of::<Span>() + (r.entries.capacity() + r.offsets.capacity()) * 4
            })
            .sum();
        let bands: usize = self.bands.iter().map(Band::memory).sum();
        (self.splats.capacity() + self.projected.capacity()) * size_of::<Splat>()
            + self.ranks.capacity() * 4
            + self.keys.memory()
            + self.weights.iter().map(RowWeights::memory).sum::<usize>()
            + rows
            + bands
    }

    /// Projects, sorts and bins `gaussians` for `camera` at the pixels of `lattice`.
    ///
    /// Gaussians with parameters that are not finite are not drawn. The arrays of `gaussians` must have
    /// equal lengths ([`Gaussians::validate`]). An array of given colours that is too short causes a panic.
    pub fn prepare(&mut self, gaussians: &Gaussians, camera: &Camera, lattice: &Lattice, colors: Colors<'_>) {
        self.stamp = STAMP.fetch_add(1, Ordering::Relaxed);
        self.colors = self.stamp;
        self.width = lattice.width();
        self.height = lattice.height();
        self.gaussians = gaussians.len();
        self.columns.set(lattice.columns());
        self.rows.set(lattice.rows());
        self.color_source = match colors {
            Colors::Sh { degree } => ColorSource::Harmonics(degree.min(gaussians.sh_degree).min(3)),
            Colors::Given(_) => ColorSource::Given,
        };
        let k = &camera.intrinsics;
        for (out, axis, principal, focal) in
            [(&mut self.ray_x2, &self.columns, k.cx, k.fx), (&mut self.ray_y2, &self.rows, k.cy, k.fy)]
        {
            out.clear();
            out.extend(axis.centres().iter().map(|&v| {
                let slope = (f64::from(v) - principal) / focal;
                (slope * slope) as f32
            }));
        }
        self.weights.clear();
        self.project(gaussians, camera, colors);
        self.sort();
        list(&self.splats, [&self.columns, &self.rows], &mut self.bands, &mut self.tile_rows);
    }

    /// Replaces the colours of this view (one per Gaussian, in the order of the [`Gaussians`]); the
    /// geometry stays.
    pub fn set_colors(&mut self, colors: &[[f32; 3]]) {
        assert_eq!(colors.len(), self.gaussians, "one colour per Gaussian");
        self.colors = STAMP.fetch_add(1, Ordering::Relaxed);
        self.color_source = ColorSource::Given;
        self.splats.par_chunks_mut(CHUNK).for_each(|splats| {
            for splat in splats {
                splat.color = colors[splat.index as usize];
            }
        });
    }

    fn project(&mut self, gaussians: &Gaussians, camera: &Camera, colors: Colors<'_>) {
        let lattice = [self.columns.range(), self.rows.range()];
        let projecting = Projecting::new(gaussians, camera, colors, self.color_source, lattice);
        self.projected.resize(gaussians.len(), Splat::default());
        let level = Level::new();
        self.projected.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
            dispatch!(level, simd => projecting.forward(simd, chunk * CHUNK, out));
        });
    }

    fn sort(&mut self) {
        self.keys.sort(self.projected.iter().map(|s| s.z));
        let (projected, order) = (&self.projected, self.keys.order());
        self.splats.resize(order.len(), Splat::default());
        self.splats.par_chunks_mut(CHUNK).zip(order.par_chunks(CHUNK)).for_each(|(out, order)| {
            for (out, &i) in out.iter_mut().zip(order) {
                *out = projected[i as usize];
            }
        });
        self.ranks.clear();
        self.ranks.resize(self.gaussians, HIDDEN);
        for (rank, &i) in order.iter().enumerate() {
            self.ranks[i as usize] = rank as u32;
        }
    }

    /// Sets other lists of the same Gaussians. Drops Gaussians without entries, and frees the buffers that
    /// only another `prepare` needs.
    pub(crate) fn replace_lists(&mut self, tile_rows: Vec<TileRow>) {
        self.tile_rows = tile_rows;
        let mut ranks = vec![HIDDEN; self.splats.len()];
        for span in self.tile_rows.iter().flat_map(|row| &row.spans) {
            ranks[span.rank as usize] = 0;
        }
        for (rank, next) in ranks.iter_mut().filter(|rank| **rank != HIDDEN).zip(0..) {
            *rank = next;
        }
        let mut old = ranks.iter();
        self.splats.retain(|_| old.next().is_some_and(|&rank| rank != HIDDEN));
        self.splats.shrink_to_fit();
        for span in self.tile_rows.iter_mut().flat_map(|row| &mut row.spans) {
            span.rank = ranks[span.rank as usize];
        }
        for rank in self.ranks.iter_mut().filter(|rank| **rank != HIDDEN) {
            *rank = ranks[*rank as usize];
        }
        (self.projected, self.bands, self.keys) = (Vec::new(), Vec::new(), sort::Keys::default());
        self.stamp = STAMP.fetch_add(1, Ordering::Relaxed);
    }

    /// Puts every visible Gaussian into every tile: the reference that culling must reproduce.
    #[cfg(test)]
    pub(crate) fn list_everything(&mut self) {
        let (tiles, n) = (self.columns.tiles(), self.splats.len());
        for row in &mut self.tile_rows {
            row.spans = (0..n).map(|r| Span { rank: r as u32, first: 0, count: tiles as u32 }).collect();
            row.entries = (0..tiles).flat_map(|_| 0..n as u32).collect();
            row.offsets = (0..=tiles).map(|t| (t * n) as u32).collect();
        }
        self.stamp = STAMP.fetch_add(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use use3d_numerics::math;

    use super::*;

    /// Random Gaussians in front of a camera at the origin, around a log-scale and an opacity logit.
    pub(crate) fn cloud(n: u64, log_scale: f32, logit: f32) -> Gaussians {
        use use3d_numerics::random::{Purpose, Stream};

        let s = Stream::new(4, Purpose::new("culling"), 0);
        let mut gaussians = Gaussians::empty(0);
        for i in 0..n {
            let z = |k: u64| s.normal(i * 32 + k) as f32;
            gaussians.means.push([z(0), z(1), 3.0 + 0.8 * z(2)]);
            gaussians.log_scales.push([log_scale + z(3), log_scale + z(4), log_scale + z(5)]);
            gaussians.quaternions.push([z(6), z(7), z(8), z(9)]);
            gaussians.opacity_logits.push(logit + 2.0 * z(10));
            gaussians.sh.push([[z(11), z(12), z(13)]; 16]);
        }
        gaussians
    }

    /// Culling must lose nothing: with every Gaussian in every tile, the images and gradients are the same,
    /// bit for bit.
    #[test]
    fn culling_changes_nothing() {
        use crate::{GaussianGradients, Options, Rasterizer, RenderGradients, Rendered};
        use use3d_capture::{Image, Intrinsics, Pose};

        let gaussians = cloud(500, -3.0, 0.0);
        let intrinsics = Intrinsics { width: 75, height: 58, fx: 60.0, fy: 62.0, cx: 35.0, cy: 30.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let mut view = Prepared::new();
        view.prepare(&gaussians, &camera, &Lattice::full(&intrinsics), Colors::Sh { degree: 0 });
        let mut uncut = view.clone();
        uncut.list_everything();
        assert!(view.entries() * 3 < uncut.entries() && view.entries() > 1000);
        let data = (0..3 * 75 * 58).map(|i| math::sin(i as f32)).collect();
        let image = Image::from_planes(75, 58, data).unwrap();
        let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
        for mut rasterizer in [Rasterizer::plain(), Rasterizer::new()] {
            let mut run = |view: &Prepared| {
                let (mut out, mut grads) = (Rendered::new(), GaussianGradients::default());
                let options = Options::default();
                rasterizer.forward(view, None, &options, &mut out);
                let of = crate::ViewOf { gaussians: &gaussians, camera: &camera };
                let into = crate::Gradients { gaussians: &mut grads, medium: None };
                rasterizer.backward(view, of, None, &options, &d_rendered, into);
                (out, grads)
            };
            assert!(run(&view) == run(&uncut));
        }
        let (pairs, all) = (view.pairs(), uncut.pairs());
        assert_eq!((pairs.contributing, pairs.tested), (all.contributing, all.tested));
    }
}
