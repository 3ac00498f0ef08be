//! The Gaussians of one view made ready to compose: projected, sorted by depth, and listed per tile.
//!
//! A tile is 16×16 pixels *of the lattice* (its columns and rows, not the image's). `prepare` goes through four steps:
//!
//! 1. project every Gaussian and drop what cannot be seen (depth range, opacity below 1/255, outside the lattice);
//! 2. sort by depth, equal depths in index order;
//! 3. give each tile row its *spans*: for every Gaussian that touches it, the range of tiles that its 1/255 contour meets;
//! 4. turn the spans of a tile row into one list per tile, in depth order.
//!
//! The contour is exact: `α ≥ 1/255` is `σ ≤ ln(255 opacity)`, an ellipse, and a tile is listed only if the ellipse meets
//! the tile's box of pixel centres along its row. Everything is a function of the data alone: any number of threads gives the same lists.

use std::sync::atomic::{AtomicU64, Ordering};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::{Camera, Lattice};

use super::axis::Axis;
use super::sort;
use crate::project::{ColorSource, HIDDEN, LOG2_255, Projecting, Splat};
use crate::{Colors, Gaussians};

/// Tile rows per band of the first binning level.
const BAND: usize = 8;
/// Gaussians per parallel task.
const CHUNK: usize = 1024;
/// The tiles of one tile row that one Gaussian meets.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Span {
    /// Position of the Gaussian in depth order.
    pub(crate) rank: u32,
    /// First tile and number of tiles.
    pub(crate) first: u32,
    pub(crate) count: u32,
    /// Where its entries start among the row's gradient records.
    pub(crate) start: u32,
}

/// One row of tiles.
#[derive(Clone, Debug, Default)]
pub(crate) struct TileRow {
    /// In depth order.
    pub(crate) spans: Vec<Span>,
    /// Lists of span positions, tile after tile.
    pub(crate) entries: Vec<u32>,
    /// Where each tile's list starts; one more than tiles.
    pub(crate) offsets: Vec<u32>,
}

impl TileRow {
    /// Span positions of tile `column`, in depth order.
    pub(crate) fn list(&self, column: usize) -> &[u32] {
        &self.entries[self.offsets[column] as usize..self.offsets[column + 1] as usize]
    }

    /// Makes the lists of `tiles` tiles from the spans.
    pub(crate) fn list_spans(&mut self, tiles: usize) {
        self.offsets.clear();
        self.offsets.resize(tiles + 1, 0);
        for span in &self.spans {
            for t in span.first..span.first + span.count {
                self.offsets[t as usize + 1] += 1;
            }
        }
        for t in 0..tiles {
            self.offsets[t + 1] += self.offsets[t];
        }
        // Fill with the offsets as cursors, then shift them back.
        self.entries.resize(self.offsets[tiles] as usize, 0);
        for (i, span) in self.spans.iter().enumerate() {
            for t in span.first..span.first + span.count {
                let cursor = &mut self.offsets[t as usize];
                self.entries[*cursor as usize] = i as u32;
                *cursor += 1;
            }
        }
        for t in (1..=tiles).rev() {
            self.offsets[t] = self.offsets[t - 1];
        }
        self.offsets[0] = 0;
    }
}

/// Projected Gaussians with their tile lists for one camera and lattice. Reusable while the geometry is frozen; the buffers
/// are kept from one [`Prepared::prepare`] to the next.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Unique to one `prepare`; equal stamps mean equal geometry.
    pub(crate) stamp: u64,
    /// The same for its colours.
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
    projected: Vec<Splat>,
    keys: sort::Keys,
    bands: Vec<Vec<u32>>,
}

impl Default for Prepared {
    fn default() -> Self {
        Self::new()
    }
}

static STAMP: AtomicU64 = AtomicU64::new(1);

impl Prepared {
    /// Nothing yet: a 0×0 lattice.
    pub fn new() -> Self {
        Self {
            stamp: 0,
            colors: 0,
            width: 0,
            height: 0,
            gaussians: 0,
            columns: Axis::default(),
            rows: Axis::default(),
            ray_x2: Vec::new(),
            ray_y2: Vec::new(),
            color_source: ColorSource::Given,
            splats: Vec::new(),
            tile_rows: Vec::new(),
            ranks: Vec::new(),
            projected: Vec::new(),
            keys: sort::Keys::default(),
            bands: Vec::new(),
        }
    }

    /// Width of the lattice it was prepared for.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height of the lattice it was prepared for.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Number of Gaussians it was prepared from.
    pub fn gaussians(&self) -> usize {
        self.gaussians
    }

    /// Indices of the Gaussians that reach the lattice, nearest first.
    pub fn visible(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.splats.iter().map(|s| s.index as usize)
    }

    /// How many (tile, Gaussian) pairs the lists hold.
    pub fn entries(&self) -> usize {
        self.tile_rows.iter().map(|r| r.entries.len()).sum()
    }

    /// Bytes held by its buffers.
    pub fn memory(&self) -> usize {
        let rows: usize = self
            .tile_rows
            .iter()
            .map(|r| {
                r.spans.capacity() * size_of::<Span>() + (r.entries.capacity() + r.offsets.capacity()) * 4
            })
            .sum();
        let bands: usize = self.bands.iter().map(|b| b.capacity() * 4).sum();
        (self.splats.capacity() + self.projected.capacity()) * size_of::<Splat>()
            + self.ranks.capacity() * 4
            + self.keys.memory()
            + rows
            + bands
    }

    /// Projects, sorts and bins `gaussians` for `camera` at the pixels of `lattice`.
    ///
    /// Gaussians with parameters that are not finite are not drawn. The arrays of `gaussians` must have one length
    /// ([`Gaussians::validate`]); a shorter array of given colours panics.
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
        self.project(gaussians, camera, colors);
        self.sort();
        self.bin();
    }

    /// Replaces the colours of this view (per Gaussian, in the order of the [`Gaussians`]); geometry stays.
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
            dispatch!(level, _simd => projecting.forward(chunk * CHUNK, out));
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

    fn bin(&mut self) {
        let tile_rows = self.rows.tiles();
        let (splats, rows, columns) = (&self.splats, &self.rows, &self.columns);
        self.bands.resize_with(tile_rows.div_ceil(BAND), Vec::new);
        self.bands.par_iter_mut().enumerate().for_each(|(band, ranks)| {
            let first = rows.tile(band * BAND).0;
            let last = rows.tile(((band + 1) * BAND).min(tile_rows) - 1).1;
            ranks.clear();
            ranks.extend((0..splats.len() as u32).filter(|&rank| {
                let s = &splats[rank as usize];
                s.y + s.reach_y >= first && s.y - s.reach_y <= last
            }));
        });
        let (bands, level) = (&self.bands, Level::new());
        self.tile_rows.resize_with(tile_rows, TileRow::default);
        self.tile_rows.par_iter_mut().enumerate().with_max_len(1).for_each(|(row, out)| {
            let ranks = &bands[row / BAND];
            dispatch!(level, _simd => fill_tile_row(out, row, ranks, splats, rows, columns));
        });
    }

    /// Other lists of the same Gaussians. Lets go of Gaussians without entries, and of the buffers that only another `prepare` needs.
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

    /// Puts every visible Gaussian into every tile: what culling must not differ from.
    #[cfg(test)]
    pub(crate) fn list_everything(&mut self) {
        let (tiles, n) = (self.columns.tiles(), self.splats.len());
        for row in &mut self.tile_rows {
            row.spans = (0..n)
                .map(|r| Span { rank: r as u32, first: 0, count: tiles as u32, start: (r * tiles) as u32 })
                .collect();
            row.entries = (0..tiles).flat_map(|_| 0..n as u32).collect();
            row.offsets = (0..=tiles).map(|t| (t * n) as u32).collect();
        }
        self.stamp = STAMP.fetch_add(1, Ordering::Relaxed);
    }
}

/// The x range of the contour between two heights (relative to the centre), as offsets from the centre.
#[inline(always)]
fn contour_range(s: &Splat, low: f32, high: f32) -> Option<[f32; 2]> {
    let (low, high) = (low.max(-s.reach_y), high.min(s.reach_y));
    if low > high {
        return None;
    }
    let level = s.log2_opacity + LOG2_255;
    // x(dy) = −shear dy ± √((level − steepness_y dy²)/steepness) peaks where the ellipse has a vertical tangent.
    let (a, d) = (s.steepness, s.steepness_y);
    let tangent = s.shear * (level * a / (d * (d + a * s.shear * s.shear))).sqrt();
    let half_width = |dy: f32| ((level - d * dy * dy).max(0.0) / a).sqrt();
    let clamp = |dy: f32| if dy.is_nan() { low } else { dy.max(low).min(high) };
    let (right, left) = (clamp(-tangent), clamp(tangent));
    let margin = |x: f32| 1e-3 + 1e-5 * x.abs();
    let (x0, x1) = (-s.shear * left - half_width(left), -s.shear * right + half_width(right));
    Some([x0 - margin(x0), x1 + margin(x1)])
}

#[inline(always)]
fn fill_tile_row(
    out: &mut TileRow,
    row: usize,
    ranks: &[u32],
    splats: &[Splat],
    rows: &Axis,
    columns: &Axis,
) {
    let (first, last) = rows.tile(row);
    let tiles = columns.tiles();
    out.spans.clear();
    let mut start = 0u32;
    for &rank in ranks {
        let s = &splats[rank as usize];
        let Some([x0, x1]) = contour_range(s, first - s.y, last - s.y) else { continue };
        let (t0, t1) = columns.tiles_meeting(s.x + x0, s.x + x1);
        if t0 >= t1 {
            continue;
        }
        out.spans.push(Span { rank, first: t0 as u32, count: (t1 - t0) as u32, start });
        start += (t1 - t0) as u32;
    }
    out.list_spans(tiles);
}

#[cfg(test)]
pub(crate) mod tests {
    use use3d_numerics::math;

    use super::*;

    /// The tangent formula against a dense walk around the contour.
    #[test]
    fn the_contour_range_is_exact() {
        let s = Splat {
            shear: -0.8,
            steepness: 0.02,
            steepness_y: 0.01,
            log2_opacity: -1.0,
            reach_y: ((LOG2_255 - 1.0) / 0.01f32).sqrt(),
            ..Splat::default()
        };
        for (low, high) in [(-100.0, 100.0), (3.0, 18.0), (-30.0, -15.0), (20.0, 40.0)] {
            let [x0, x1] = contour_range(&s, low, high).unwrap();
            let (mut w0, mut w1) = (f32::INFINITY, f32::NEG_INFINITY);
            for i in 0..=100_000 {
                let dy = low + (high - low) * i as f32 / 1e5;
                let rest = (LOG2_255 - 1.0 - 0.01 * dy * dy) / 0.02;
                if rest >= 0.0 {
                    w0 = w0.min(0.8 * dy - rest.sqrt());
                    w1 = w1.max(0.8 * dy + rest.sqrt());
                }
            }
            assert!((x0 - w0).abs() < 5e-3 && (x1 - w1).abs() < 5e-3, "{x0} {w0} {x1} {w1}");
            assert!(x0 <= w0 && x1 >= w1);
        }
        assert!(contour_range(&s, 30.0, 40.0).is_none());
    }

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

    /// Culling must lose nothing: with every Gaussian in every tile the pictures and gradients are the same, bit for bit.
    #[test]
    fn culling_changes_nothing() {
        use crate::{Cotangents, GaussianGradients, Options, Rasterizer, Rendered};
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
        let cotangents = Cotangents { image: &image, depth: None, accumulation: None, clear: None };
        for mut rasterizer in [Rasterizer::plain(), Rasterizer::new()] {
            let mut run = |view: &Prepared| {
                let (mut out, mut grads) = (Rendered::new(), GaussianGradients::default());
                let options = Options::default();
                rasterizer.forward(view, None, &options, &mut out);
                let of = crate::ViewOf { gaussians: &gaussians, camera: &camera };
                let into = crate::Gradients { gaussians: &mut grads, medium: None };
                rasterizer.backward(view, of, None, &options, &cotangents, into);
                (out, grads)
            };
            assert!(run(&view) == run(&uncut));
        }
        let (pairs, all) = (view.pairs(), uncut.pairs());
        assert_eq!((pairs.contributing, pairs.tested), (all.contributing, all.tested));
    }
}
