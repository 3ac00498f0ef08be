//! The walk over a tile's list of Gaussians, in either direction.
//!
//! For each (tile, Gaussian) entry one vector holds the 16 rows and says which of them the 1/255
//! contour meets (exactly: the row's nearest pixel centre is put to the test that the pixels face),
//! so that dead rows cost nothing.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x16};

use super::load;
use crate::compose::tile::{Input, Lanes};
use crate::lists::{Span, TILE};
use crate::project::{LOG2_255, Splat};

/// What is done with the Gaussians of a tile, one after another.
pub(super) trait Pass<S: Simd> {
    /// Whether every entry of the list is owed a record, also those that no pixel takes.
    const RECORDS: bool;

    /// Rows in which some pixel may still take entry `k`, as bits.
    fn open(&self, simd: S, k: usize) -> u32;

    /// A Gaussian that meets open rows.
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>);

    /// A Gaussian that meets none; called only where entries are owed [`RECORDS`](Self::RECORDS).
    #[inline(always)]
    fn miss(&mut self, _span: &Span) {}
}

/// One Gaussian in its turn.
pub(super) struct Entry<'a, S: Simd> {
    /// Its place in the tile's list.
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

    /// `log₂ α` before the clamp and `t` of row `r`; `steepness` is the Gaussian's, in every lane.
    #[inline(always)]
    pub(super) fn log2_alpha(&self, simd: S, steepness: f32x16<S>, r: usize) -> (f32x16<S>, f32x16<S>) {
        let t = self.columns - f32x16::splat(simd, self.rows.peak[r]);
        ((t * steepness).mul_add(-t, f32x16::splat(simd, self.rows.power[r])), t)
    }
}

/// One Gaussian against the 16 rows of a tile.
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
    // The pixel centre nearest to the peak, if the peak were between the first and the last:
    // at least as near as any pixel.
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
        // The mask tells the compiler that rows are in range.
        Some(bit & (TILE - 1))
    }
}

/// Takes the pass through the list, from the nearest Gaussian to the farthest or,
/// if `BACK`, the other way round.
///
/// It looks one entry ahead: how many rows the next entry has is then known before its turn, and the
/// processor does not stall where it guessed wrong.
#[inline(always)]
pub(super) fn walk<S: Simd, const BACK: bool, P: Pass<S>>(simd: S, input: &Input<'_>, pass: &mut P) {
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
