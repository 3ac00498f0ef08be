//! Tile rows whose gradients are computed together.
//!
//! A group has at most [`GROUP`] spans, or is a single row. This bounds the buffer of gradient records.
//! After each group, every Gaussian adds its records in the order of tile rows. Groups follow one another,
//! so additions always run in that order, for any grouping and any number of threads.

use super::strips::{Strips, for_each};
use super::sums::add;
use crate::lists::{Prepared, TileRow};

/// Most spans whose records are in memory at once (one tile row alone may have more).
const GROUP: usize = 1 << 19;

/// The records of consecutive tile rows.
pub(super) struct Records<'a, const N: usize> {
    rows: &'a [TileRow],
    /// Number of records of a row.
    of_row: fn(&TileRow) -> usize,
    pub(super) records: &'a mut [[f32; N]],
}

impl<'a, const N: usize> Records<'a, N> {
    /// One record per entry of a view, in a buffer that grows when it has to.
    pub(super) fn per_entry(buffer: &'a mut Vec<[f32; N]>, prepared: &'a Prepared) -> Self {
        let entries = prepared.entries();
        if buffer.len() < entries {
            buffer.resize(entries, [0.0; N]);
        }
        let of_row = |row: &TileRow| row.entries.len();
        Self { rows: &prepared.tile_rows, of_row, records: &mut buffer[..entries] }
    }
}

impl<const N: usize> Strips for Records<'_, N> {
    fn cut(self, tile_rows: usize) -> (Self, Self) {
        let Self { rows, of_row, records } = self;
        let (first, second) = rows.split_at(tile_rows);
        let (a, b) = records.split_at_mut(first.iter().map(of_row).sum());
        (Self { rows: first, of_row, records: a }, Self { rows: second, of_row, records: b })
    }
}

/// Runs `work(tile row, its records, its strips)` over all tile rows and sums the records of each visible
/// Gaussian into `sums` (indexed by rank). `work` must write the record of every span.
pub(crate) fn in_groups<T: Strips, const N: usize>(
    prepared: &Prepared,
    records: &mut Vec<[f32; N]>,
    sums: &mut Vec<[f32; N]>,
    strips: T,
    work: &(impl Fn(usize, &mut [[f32; N]], T) + Sync),
) {
    let rows = &prepared.tile_rows;
    sums.clear();
    sums.resize(prepared.splats.len(), [0.0; N]);
    let mut strips = Some(strips);
    let mut first = 0;
    while first < rows.len() {
        let (mut last, mut spans) = (first, 0);
        while last < rows.len() && (last == first || spans + rows[last].spans.len() <= GROUP) {
            spans += rows[last].spans.len();
            last += 1;
        }
        if records.len() < spans {
            // At once for any group, because a buffer that grows leaves holes in memory.
            records.reserve_exact(GROUP.max(spans) - records.len());
            records.resize(spans, [0.0; N]);
        }
        let Some(rest) = strips.take() else { break };
        let (here, rest) = rest.cut(last - first);
        strips = Some(rest);
        let of_row = |row: &TileRow| row.spans.len();
        let group = Records { rows: &rows[first..last], of_row, records: &mut records[..spans] };
        for_each(first..last, (group, here), &|row, (group, strips): (Records<'_, N>, T)| {
            work(row, group.records, strips);
        });
        add(&rows[first..last], &records[..spans], sums);
        first = last;
    }
}
