//! The loop over a tile's list of Gaussians, in either direction.
//!
//! For each (tile, Gaussian) entry one vector holds the 16 rows and computes which of them the 1/255
//! contour meets. The test is exact: it evaluates `α` at the row's pixel centre nearest to the peak, with
//! the same formula as for the pixels. Rows that are not met cost nothing.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x16};

use super::load;
use crate::compose::tile::{Lanes, TileInput};
use crate::lists::{Span, TILE};
use crate::project::{LOG2_255, Splat};

/// The work that is done for each Gaussian of a tile in turn.
pub(super) trait Pass<S: Simd> {
    /// True if every entry of the list needs a record, including entries that contribute to no pixel.
    const RECORDS: bool;

    /// The rows in which some pixel may still receive entry `k`, as bits.
    fn open(&self, simd: S, k: usize) -> u32;

    /// Handles a Gaussian that meets open rows.
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>);

    /// Handles a Gaussian that meets no open row; called only if [`RECORDS`](Self::RECORDS).
    #[inline(always)]
    fn miss(&mut self, _span: &Span) {}
}

/// One Gaussian of a tile's list.
pub(super) struct Entry<'a, S: Simd> {
    /// Its position in the tile's list.
    pub(super) k: usize,
    pub(super) span: &'a Span,
    pub(super) splat: &'a Splat,
    /// Pixel centres of the tile's columns.
    columns: f32x16<S>,
    rows: RowsOf,
}

impl<S: Simd> Entry<'_, S> {
    /// The open rows that its contour meets.
    #[inline(always)]
    pub(super) fn rows(&self) -> Bits {
        Bits(self.rows.live)
    }

    /// Returns `log₂ α` before the clamp, and `t`, of row `r`; every lane of `steepness` holds the
    /// Gaussian's.
    #[inline(always)]
    pub(super) fn log2_alpha(&self, simd: S, steepness: f32x16<S>, r: usize) -> (f32x16<S>, f32x16<S>) {
        let t = self.columns - f32x16::splat(simd, self.rows.peak[r]);
        ((t * steepness).mul_add(-t, f32x16::splat(simd, self.rows.power[r])), t)
    }
}

/// One Gaussian evaluated on the 16 rows of a tile.
struct RowsOf {
    /// Rows that the contour meets.
    live: u32,
    peak: Lanes,
    power: Lanes,
}

#[inline(always)]
fn rows_of<S: Simd>(simd: S, splat: &Splat, rows: f32x16<S>, columns: &Lanes) -> RowsOf {
    let c = |v: f32| f32x16::splat(simd, v);
    let dy = rows - c(splat.y);
    let peak = c(splat.shear).mul_add(-dy, c(splat.x));
    let power = c(splat.steepness_y).mul_add(-(dy * dy), c(splat.log2_opacity));
    // The pixel centre nearest to the peak, if the peak lies between the first and the last centre;
    // otherwise a point at least as near as any pixel.
    let t = peak.max(c(columns[0])).min(c(columns[TILE - 1])) - peak;
    let best = (t * c(splat.steepness)).mul_add(-t, power);
    let live = best.simd_ge(c(-LOG2_255)).to_bitmask() as u32;
    RowsOf { live, peak: peak.to_array(), power: power.to_array() }
}

/// The rows' bit mask as an iterator.
pub(super) struct Bits(u32);

impl Iterator for Bits {
    type Item = usize;

    #[inline(always)]
    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let bit = self.0.trailing_zeros() as usize;
        self.0 &= self.0 - 1;
        // The mask shows the compiler that the row is in range.
        Some(bit & (TILE - 1))
    }
}

/// Runs the pass over the list, from the nearest Gaussian to the farthest or, if `BACK`, the other way
/// round.
///
/// The loop looks one entry ahead: the number of rows of the next entry is then known before its turn, so a
/// wrongly predicted branch does not stall the processor.
#[inline(always)]
pub(super) fn walk<S: Simd, const BACK: bool, P: Pass<S>>(simd: S, input: &TileInput<'_>, pass: &mut P) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let count = input.list.len();
    if count == 0 {
        return;
    }
    let place = |step: usize| if BACK { count - 1 - step } else { step };
    let (mut span, mut splat) = input.entry(place(0));
    let mut of = rows_of(simd, splat, rows, input.columns);
    for step in 0..count {
        let k = place(step);
        let (next_span, next_splat) = input.entry(place((step + 1).min(count - 1)));
        let next = rows_of(simd, next_splat, rows, input.columns);
        let open = pass.open(simd, k);
        if !P::RECORDS && open == 0 {
            break;
        }
        of.live &= open;
        if of.live != 0 {
            pass.meet(simd, &Entry { k, span, splat, columns, rows: of });
        } else if P::RECORDS {
            pass.miss(span);
        }
        (span, splat, of) = (next_span, next_splat, next);
    }
}
