//! The data of one 16×16 tile while it is composed, and the water in front of it.

use fearless_simd::{Simd, SimdBase, f32x16};
use use3d_numerics::lanes::SMALL;

use crate::lists::{Span, TILE};
use crate::project::{EntryGradient, Splat};

/// The 16 pixels of a cell, or of a row of a tile.
pub(crate) type Lanes = [f32; TILE];

/// Pixels along a cell's side. A tile has 4×4 cells, and a cell is one vector of lanes: a trained Gaussian
/// covers a few pixels in both directions, and a square of 16 pixels wastes fewer lanes on it than a row.
pub(crate) const CELL: usize = 4;
/// Number of cells of a tile.
pub(crate) const CELLS: usize = (TILE / CELL) * (TILE / CELL);

/// The cell and the lane of the pixel in row `r` and column `l` of a tile.
#[inline(always)]
pub(crate) const fn place(r: usize, l: usize) -> (usize, usize) {
    ((r / CELL) * (TILE / CELL) + l / CELL, (r % CELL) * CELL + l % CELL)
}

/// Compositing of a pixel stops before its transmittance would fall to this value or below.
pub(crate) const STOP: f32 = 1e-4;
/// Largest opacity of one Gaussian at one pixel.
pub(crate) const ALPHA_MAX: f32 = 0.999;
/// `α / (1 − α)` of the largest opacity, rounded as the kernels round it; the gradient with respect to `α` is
/// 0 from here on.
pub(crate) const RATIO_MAX: f32 = ALPHA_MAX * (1.0 / (1.0 - ALPHA_MAX));

/// The input of one tile: its Gaussians in depth order and its pixel centres.
#[derive(Clone, Copy)]
pub(crate) struct TileInput<'a> {
    /// The Gaussians of the tile row, one per span.
    pub(crate) splats: &'a [Splat],
    pub(crate) spans: &'a [Span],
    pub(crate) list: &'a [u32],
    pub(crate) columns: &'a Lanes,
    pub(crate) rows: &'a Lanes,
    /// Numbers of rows and columns that are pixels, not padding.
    pub(crate) filled_rows: usize,
    pub(crate) filled_columns: usize,
}

impl<'a> TileInput<'a> {
    /// The position of entry `k` among the spans, and its Gaussian.
    #[inline(always)]
    pub(crate) fn entry(&self, k: usize) -> (usize, &'a Splat) {
        let at = self.list[k] as usize;
        (at, &self.splats[at])
    }
}

/// The exponents of one cell, as deviations from the tile's centre: `−β |d| log₂e` is `centre + deviation`,
/// per unit of z-depth (R1: `s = z |d|`).
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct WaterCell {
    pub(crate) attenuation: [Lanes; 3],
    pub(crate) backscatter: [Lanes; 3],
}

impl WaterCell {
    #[inline(always)]
    fn quantity(&self, q: usize) -> &Lanes {
        if q < 3 { &self.attenuation[q] } else { &self.backscatter[q - 3] }
    }

    #[inline(always)]
    fn quantity_mut(&mut self, q: usize) -> &mut Lanes {
        if q < 3 { &mut self.attenuation[q] } else { &mut self.backscatter[q - 3] }
    }
}

/// The water of a tile. Over 16×16 pixels β hardly changes. So `e^{-β z}` is computed as a factor of the
/// tile times the exponential of a small number, which needs no range reduction. Where the number is not
/// small, the full exponential is computed. Both are exact to rounding.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct TileWater {
    pub(crate) cells: [WaterCell; CELLS],
    /// Attenuation rgb, backscatter rgb, padding.
    pub(crate) centre: Lanes,
    /// The depth up to which the deviations times depth stay within [`SMALL`].
    pub(crate) near: f32,
}

impl TileWater {
    /// Centres the exponents; on entry they are absolute. Padding repeats a pixel.
    #[inline(always)]
    pub(crate) fn centre<S: Simd>(&mut self, simd: S) {
        let mut largest = 0.0f32;
        self.centre = [0.0; TILE];
        for q in 0..6 {
            let (mut low, mut high) =
                (f32x16::splat(simd, f32::INFINITY), f32x16::splat(simd, f32::NEG_INFINITY));
            for cell in &self.cells {
                let lanes = f32x16::load_array_ref(simd, cell.quantity(q));
                (low, high) = (low.min(lanes), high.max(lanes));
            }
            let low = low.to_array().into_iter().fold(f32::INFINITY, f32::min);
            let high = high.to_array().into_iter().fold(f32::NEG_INFINITY, f32::max);
            let centre = 0.5 * low + 0.5 * high;
            self.centre[q] = centre;
            for cell in &mut self.cells {
                let lanes = f32x16::load_array_ref(simd, cell.quantity(q));
                (lanes - f32x16::splat(simd, centre)).store_array(cell.quantity_mut(q));
            }
            largest = largest.max((high - centre).max(centre - low));
        }
        // NaN and infinite coefficients leave `near` at a value that no depth lies below.
        self.near = if largest > 0.0 {
            SMALL / largest
        } else if largest == 0.0 {
            f32::INFINITY
        } else {
            0.0
        };
    }
}

/// One cell during the forward pass.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct ForwardCell {
    /// The transmittance; negative once the pixel has stopped.
    pub(crate) transmittance: Lanes,
    /// `Σ w c e^{-β_a s}`.
    pub(crate) object: [Lanes; 3],
    /// `Σ w e^{-β_b s}`.
    pub(crate) veil: [Lanes; 3],
    /// `Σ w z`, `Σ w`.
    pub(crate) depth: Lanes,
    pub(crate) accumulation: Lanes,
    /// `Σ w c`, and the depth of the last contributor.
    pub(crate) clear: [Lanes; 3],
    pub(crate) last: Lanes,
    /// The entry at which the pixel stopped; this entry and all later ones do not contribute.
    pub(crate) stop: [i32; TILE],
}

impl ForwardCell {
    /// Nothing is composed, and every pixel has stopped.
    const STOPPED: Self = {
        let zero = [0.0; TILE];
        Self {
            transmittance: [-1.0; TILE],
            object: [zero; 3],
            veil: [zero; 3],
            depth: zero,
            accumulation: zero,
            clear: [zero; 3],
            last: zero,
            stop: [0; TILE],
        }
    };
}

/// The stop of a pixel that did not stop.
pub(crate) const NEVER: i32 = i32::MAX;

/// A tile during the forward pass.
#[derive(Clone, Copy)]
pub(crate) struct ForwardTile {
    pub(crate) cells: [ForwardCell; CELLS],
}

impl ForwardTile {
    /// The state before the first Gaussian; padding pixels have stopped.
    #[inline(always)]
    pub(crate) fn new(filled_rows: usize, filled_columns: usize) -> Self {
        let mut tile = Self { cells: [ForwardCell::STOPPED; CELLS] };
        for r in 0..filled_rows {
            for l in 0..filled_columns {
                let (cell, lane) = place(r, l);
                tile.cells[cell].transmittance[lane] = 1.0;
                tile.cells[cell].stop[lane] = NEVER;
            }
        }
        tile
    }
}

/// One cell during the backward pass, which runs from the farthest Gaussian to the nearest.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct BackwardCell {
    pub(crate) stop: [i32; TILE],
    /// The transmittance behind the Gaussian that was undone last.
    pub(crate) transmittance: Lanes,
    /// `−Σ w v` over the Gaussians already undone (those behind); `v` is the loss per unit of weight.
    pub(crate) behind: Lanes,
    /// The gradient `g` of the image; `−g c_m`.
    pub(crate) image: [Lanes; 3],
    pub(crate) veiled: [Lanes; 3],
    /// The gradient of the clear image.
    pub(crate) clear: [Lanes; 3],
    /// `v` contains the term `depth z + weight`.
    pub(crate) depth: Lanes,
    pub(crate) weight: Lanes,
    /// `Σ w z g c e^{-β_a s}`, `−Σ w z g c_m e^{-β_b s}`, `Σ w e^{-β_b s}`.
    pub(crate) object_moment: [Lanes; 3],
    pub(crate) veil_moment: [Lanes; 3],
    pub(crate) veil: [Lanes; 3],
}

impl BackwardCell {
    const ZERO: Self = {
        let zero = [0.0; TILE];
        Self {
            stop: [0; TILE],
            transmittance: [1.0; TILE],
            behind: zero,
            image: [zero; 3],
            veiled: [zero; 3],
            clear: [zero; 3],
            depth: zero,
            weight: zero,
            object_moment: [zero; 3],
            veil_moment: [zero; 3],
            veil: [zero; 3],
        }
    };
}

/// A tile during the backward pass.
#[derive(Clone, Copy)]
pub(crate) struct BackwardTile {
    pub(crate) cells: [BackwardCell; CELLS],
}

impl BackwardTile {
    pub(crate) const ZERO: Self = Self { cells: [BackwardCell::ZERO; CELLS] };
}

/// The place for the records of a tile row: one for each span, to which all its tiles are added.
pub(crate) struct Sink<'a, const N: usize> {
    pub(crate) spans: &'a [Span],
    pub(crate) records: &'a mut [[f32; N]],
    /// The tile's column.
    pub(crate) column: u32,
}

impl<const N: usize> Sink<'_, N> {
    /// Adds the record of the entry at a position among the spans. The span's first tile comes first, and
    /// replaces what was there.
    #[inline(always)]
    pub(crate) fn put(&mut self, at: usize, record: [f32; N]) {
        let out = &mut self.records[at];
        let before = if self.spans[at].first == self.column { [0.0; N] } else { *out };
        for (out, (before, record)) in out.iter_mut().zip(before.iter().zip(record)) {
            *out = before + record;
        }
    }
}

/// The records of (tile, Gaussian) entries.
pub(crate) type EntrySink<'a> = Sink<'a, { size_of::<EntryGradient>() / size_of::<f32>() }>;

/// Number of channels that the linear splat and its adjoint compute at once.
pub(crate) const CHANNELS: usize = 8;

/// A Gaussian's scalars for one row of a tile.
#[derive(Clone, Copy)]
pub(crate) struct RowTerms {
    /// The position of the peak of the row's parabola, pixels.
    pub(crate) peak: f32,
    /// `log₂ α` at the peak.
    pub(crate) power: f32,
    /// The row's centre minus the Gaussian's centre.
    pub(crate) dy: f32,
}

impl Splat {
    /// The terms of the row at height `y`.
    #[inline(always)]
    pub(crate) fn row(&self, y: f32) -> RowTerms {
        let dy = y - self.y;
        RowTerms {
            peak: self.shear.mul_add(-dy, self.x),
            power: self.steepness_y.mul_add(-(dy * dy), self.log2_opacity),
            dy,
        }
    }

    /// `conic_xy` and `1 / cov_yy`: the vertical derivative `v_y` of σ is `conic_xy t + dy / cov_yy`.
    #[inline(always)]
    pub(crate) fn conic_terms(&self) -> (f32, f32) {
        let twice = 2.0 * std::f32::consts::LN_2;
        (self.shear * (self.steepness * twice), self.steepness_y * twice)
    }
}

/// A Gaussian's gradient summed over the cells of a tile, lane by lane: the sums of
/// [`SplatGradient`](crate::project::SplatGradient) before the lanes are added.
#[derive(Clone, Copy)]
pub(crate) struct LaneSums<V> {
    /// `ΣG`, `ΣG t`, `ΣG dy`.
    pub(crate) weight: V,
    pub(crate) t: V,
    pub(crate) dy: V,
    /// `ΣG t²`, `ΣG t dy`, `ΣG dy²`.
    pub(crate) t_t: V,
    pub(crate) t_dy: V,
    pub(crate) dy_dy: V,
    /// `∂L/∂z / ln 2`.
    pub(crate) z: V,
    /// `∂L/∂c`.
    pub(crate) color: [V; 3],
    /// `Σ|G t|` and `Σ|G v_y|`, for density control.
    pub(crate) screen: [V; 2],
}

impl<V: Copy> LaneSums<V> {
    #[inline(always)]
    pub(crate) fn zeros(v: V) -> Self {
        let (color, screen) = ([v; 3], [v; 2]);
        Self { weight: v, t: v, dy: v, t_t: v, t_dy: v, dy_dy: v, z: v, color, screen }
    }
}
