//! Sixteen pixels of an image row, as tiles read and write them.
//!
//! These functions are always inlined, so that the lane code's instruction set applies to these loops too.

use fearless_simd::{Simd, SimdBase, f32x4, f32x16};

use super::tile::{CELL, CELLS, Lanes, place};
use crate::lists::{Prepared, TILE};

/// Returns 16 pixels of a row from `start`; beyond the last of the `n` pixels, repeats it.
#[inline(always)]
pub(super) fn get(row: &[f32], start: usize, n: usize) -> Lanes {
    match row[start..].first_chunk() {
        Some(lanes) => *lanes,
        None => each(|l| row[start + l.min(n - 1)]),
    }
}

/// Writes the first `pixels.len()` of the lanes.
#[inline(always)]
pub(super) fn put<T: Copy>(pixels: &mut [T], lanes: &[T; TILE]) {
    match pixels.first_chunk_mut() {
        Some(out) => *out = *lanes,
        None => pixels.copy_from_slice(&lanes[..pixels.len()]),
    }
}

/// [`get`] as a vector.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, row: &[f32], start: usize, n: usize) -> f32x16<S> {
    f32x16::load_array_ref(simd, &get(row, start, n))
}

/// [`put`] of a vector.
#[inline(always)]
pub(super) fn store<S: Simd>(pixels: &mut [f32], lanes: f32x16<S>) {
    match pixels.first_chunk_mut() {
        Some(out) => lanes.store_array(out),
        None => pixels.copy_from_slice(&lanes.to_array()[..pixels.len()]),
    }
}

/// [`row_of`] as a vector.
#[inline(always)]
pub(super) fn load_row<S: Simd, C>(
    simd: S,
    cells: &[C; CELLS],
    r: usize,
    plane: impl Fn(&C) -> &Lanes,
) -> f32x16<S> {
    let four = |l: usize| {
        let (cell, lane) = place(r, l);
        f32x4::from_slice(simd, &plane(&cells[cell])[lane..lane + CELL])
    };
    let (low, high) = (simd.combine_f32x4(four(0), four(4)), simd.combine_f32x4(four(8), four(12)));
    simd.combine_f32x8(low, high)
}

/// [`set_row`] of a vector.
#[inline(always)]
pub(super) fn store_row<S: Simd, C>(
    simd: S,
    cells: &mut [C; CELLS],
    r: usize,
    lanes: f32x16<S>,
    plane: impl Fn(&mut C) -> &mut Lanes,
) {
    let (low, high) = simd.split_f32x16(lanes);
    let ((a, b), (c, d)) = (simd.split_f32x8(low), simd.split_f32x8(high));
    for (four, l) in [a, b, c, d].into_iter().zip((0..TILE).step_by(CELL)) {
        let (cell, lane) = place(r, l);
        four.store_slice(&mut plane(&mut cells[cell])[lane..lane + CELL]);
    }
}

/// Row `r` of a tile from its cells, of which `plane` picks one array.
#[inline(always)]
pub(super) fn row_of<C, T: Copy + Default>(
    cells: &[C; CELLS],
    r: usize,
    plane: impl Fn(&C) -> &[T; TILE],
) -> [T; TILE] {
    let mut row = [T::default(); TILE];
    for (l, four) in (0..TILE).step_by(CELL).zip(row.as_chunks_mut::<CELL>().0) {
        let (cell, lane) = place(r, l);
        four.copy_from_slice(&plane(&cells[cell])[lane..lane + CELL]);
    }
    row
}

/// Sets row `r` of a tile in its cells: the inverse of [`row_of`].
#[inline(always)]
pub(super) fn set_row<C, T: Copy>(
    cells: &mut [C; CELLS],
    r: usize,
    row: &[T; TILE],
    plane: impl Fn(&mut C) -> &mut [T; TILE],
) {
    for (l, four) in (0..TILE).step_by(CELL).zip(row.as_chunks::<CELL>().0) {
        let (cell, lane) = place(r, l);
        plane(&mut cells[cell])[lane..lane + CELL].copy_from_slice(four);
    }
}

/// Fills the lanes in a loop, because `array::from_fn` is a call that is not compiled for the instruction
/// set.
#[inline(always)]
pub(super) fn each(mut f: impl FnMut(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; TILE];
    for (l, lane) in lanes.iter_mut().enumerate() {
        *lane = f(l);
    }
    lanes
}

/// `|d(p)|` of the 16 pixels of a tile's row.
#[inline(always)]
pub(super) fn ray_lengths(prepared: &Prepared, y: usize, column: usize) -> Lanes {
    let across = get(&prepared.ray_x2, column * TILE, TILE);
    let down = prepared.ray_y2[y];
    each(|l| (1.0 + (across[l] + down)).sqrt())
}

/// [`ray_lengths`] as a vector.
#[inline(always)]
pub(super) fn rays<S: Simd>(simd: S, prepared: &Prepared, y: usize, column: usize) -> f32x16<S> {
    f32x16::load_array_ref(simd, &ray_lengths(prepared, y, column))
}
