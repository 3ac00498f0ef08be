//! Sums of the gradient records of (tile, Gaussian) entries over each Gaussian, in a fixed order and without atomics.
//!
//! Tile rows are handled in groups of at most [`GROUP`] entries (or one row), so that the records' buffer is bounded; after a
//! group, each Gaussian adds its records in the order of tiles. Groups follow one another, so the order of additions
//! is the order of tiles whatever the grouping and the number of threads.

use std::ops::Range;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::strips::{Strips, for_each};
use crate::lists::{Prepared, TileRow};
use crate::project::{HIDDEN, Record};

/// Entries whose records are held at once (unless one tile row alone has more).
const GROUP: usize = 1 << 20;
/// Gaussians per parallel task.
const CHUNK: usize = 512;

/// The records of consecutive tile rows.
struct Records<'a> {
    rows: &'a [TileRow],
    records: &'a mut [Record],
}

impl Strips for Records<'_> {
    fn cut(self, tile_rows: usize, _at: usize) -> (Self, Self) {
        let (first, second) = self.rows.split_at(tile_rows);
        let entries = first.iter().map(|row| row.entries.len()).sum();
        let (a, b) = self.records.split_at_mut(entries);
        (Self { rows: first, records: a }, Self { rows: second, records: b })
    }
}

/// Runs `work(tile row, its records, its strips)` over all tile rows and sums the records of each visible Gaussian into `sums` (by
/// rank). `work` must write every record.
pub(crate) fn in_groups<T: Strips>(
    prepared: &Prepared,
    records: &mut Vec<Record>,
    sums: &mut Vec<Record>,
    strips: T,
    work: &(impl Fn(usize, &mut [Record], T) + Sync),
) {
    let rows = &prepared.tile_rows;
    sums.clear();
    sums.resize(prepared.splats.len(), [0.0; 12]);
    let mut strips = Some(strips);
    let mut first = 0;
    while first < rows.len() {
        let (mut last, mut entries) = (first, 0);
        while last < rows.len() && (last == first || entries + rows[last].entries.len() <= GROUP) {
            entries += rows[last].entries.len();
            last += 1;
        }
        if records.len() < entries {
            records.resize(entries, [0.0; 12]);
        }
        let Some(rest) = strips.take() else { break };
        let (here, rest) = rest.cut(last - first, last);
        strips = Some(rest);
        let group = Records { rows: &rows[first..last], records: &mut records[..entries] };
        for_each(first..last, (group, here), &|row, (group, strips): (Records<'_>, T)| {
            work(row, group.records, strips);
        });
        add(&rows[first..last], &records[..entries], sums);
        first = last;
    }
}

/// Adds the records of some tile rows to the sums.
fn add(rows: &[TileRow], records: &[Record], sums: &mut [Record]) {
    let level = Level::new();
    sums.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, sums)| {
        dispatch!(level, _simd => add_chunk(rows, records, (chunk * CHUNK) as u32, sums));
    });
}

/// Adds the records of the Gaussians whose ranks begin at `base`.
#[inline(always)]
fn add_chunk(rows: &[TileRow], records: &[Record], base: u32, sums: &mut [Record]) {
    let ranks: Range<u32> = base..base + sums.len() as u32;
    let mut start = 0;
    for row in rows {
        let from = row.spans.partition_point(|s| s.rank < ranks.start);
        for span in row.spans[from..].iter().take_while(|s| s.rank < ranks.end) {
            let sum = &mut sums[(span.rank - base) as usize];
            let first = start + span.start as usize;
            for record in &records[first..first + span.count as usize] {
                for (s, r) in sum.iter_mut().zip(record) {
                    *s += r;
                }
            }
        }
        start += row.entries.len();
    }
}

/// `out[index] = value(sum)` for every Gaussian; zero (the default) where it is not visible.
pub(crate) fn scatter<T: Copy + Default + Send>(
    prepared: &Prepared,
    sums: &[Record],
    out: &mut [T],
    value: impl Fn(&Record) -> T + Sync,
) {
    out.par_chunks_mut(CHUNK).zip(prepared.ranks.par_chunks(CHUNK)).for_each(|(out, ranks)| {
        for (out, &rank) in out.iter_mut().zip(ranks) {
            *out = if rank == HIDDEN { T::default() } else { value(&sums[rank as usize]) };
        }
    });
}
