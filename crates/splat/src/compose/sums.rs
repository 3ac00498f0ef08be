//! Sums the gradient records of spans for each Gaussian, in the order of tile rows and without atomics.

use std::ops::Range;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use crate::lists::{Prepared, TileRow};
use crate::project::HIDDEN;

/// Gaussians per parallel task.
const CHUNK: usize = 512;

/// Adds the records of some tile rows to the sums.
pub(super) fn add<const N: usize>(rows: &[TileRow], records: &[[f32; N]], sums: &mut [[f32; N]]) {
    let level = Level::new();
    sums.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, sums)| {
        dispatch!(level, _simd => add_chunk(rows, records, (chunk * CHUNK) as u32, sums));
    });
}

/// Adds the records of the Gaussians whose ranks begin at `base`.
#[inline(always)]
fn add_chunk<const N: usize>(rows: &[TileRow], records: &[[f32; N]], base: u32, sums: &mut [[f32; N]]) {
    let ranks: Range<u32> = base..base + sums.len() as u32;
    let mut start = 0;
    for row in rows {
        let from = row.spans.partition_point(|s| s.rank < ranks.start);
        let records = &records[start..start + row.spans.len()];
        for (span, record) in row.spans[from..].iter().zip(&records[from..]) {
            if span.rank >= ranks.end {
                break;
            }
            for (s, r) in sums[(span.rank - base) as usize].iter_mut().zip(record) {
                *s += r;
            }
        }
        start += row.spans.len();
    }
}

/// `out[index] = value(sum)` for every Gaussian; zero (the default) where it is not visible.
pub(crate) fn scatter<T: Copy + Default + Send, const N: usize>(
    prepared: &Prepared,
    sums: &[[f32; N]],
    out: &mut [T],
    value: impl Fn(&[f32; N]) -> T + Sync,
) {
    out.par_chunks_mut(CHUNK).zip(prepared.ranks.par_chunks(CHUNK)).for_each(|(out, ranks)| {
        for (out, &rank) in out.iter_mut().zip(ranks) {
            *out = if rank == HIDDEN { T::default() } else { value(&sums[rank as usize]) };
        }
    });
}
