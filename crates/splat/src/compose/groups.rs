//! Tile rows whose gradients are computed together.
//!
//! A group has at most [`GROUP`] entries, or is a single row. This bounds the buffer of gradient records.
//! After each group, every Gaussian adds its records in the order of tiles. Groups follow one another, so
//! additions always run in the order of tiles, for any grouping and any number of threads.

use super::strips::{Strips, for_each};
use super::sums::add;
use crate::lists::{Prepared, TileRow};

/// Most entries whose records are in memory at once (one tile row alone may have more).
const GROUP: usize = 1 << 19;

/// The records of consecutive tile rows.
pub(super) struct Records<'a, const N: usize> {
    rows: &'a [TileRow],
    pub(super) records: &'a mut [[f32; N]],
}

impl<'a, const N: usize> Records<'a, N> {
    /// One record per entry of a view, in a buffer that grows when it has to.
    pub(super) fn of(buffer: &'a mut Vec<[f32; N]>, prepared: &'a Prepared) -> Self {
        let entries = prepared.entries();
        if buffer.len() < entries {
            buffer.resize(entries, [0.0; N]);
        }
        Self { rows: &prepared.tile_rows, records: &mut buffer[..entries] }
    }
}

impl<const N: usize> Strips for Records<'_, N> {
    fn cut(self, tile_rows: usize) -> (Self, Self) {
        let (first, second) = self.rows.split_at(tile_rows);
        let entries = first.iter().map(|row| row.entries.len()).sum();
        let (a, b) = self.records.split_at_mut(entries);
        (Self { rows: first, records: a }, Self { rows: second, records: b })
    }
}

/// Runs `work(tile row, its records, its strips)` over all tile rows and sums the records of each visible
/// Gaussian into `sums` (indexed by rank). `work` must write every record.
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
        let (mut last, mut entries) = (first, 0);
        while last < rows.len() && (last == first || entries + rows[last].entries.len() <= GROUP) {
            entries += rows[last].entries.len();
            last += 1;
        }
        if records.len() < entries {
            // At once for any group, because a buffer that grows leaves holes in memory.
            records.reserve_exact(GROUP.max(entries) - records.len());
            records.resize(entries, [0.0; N]);
        }
        let Some(rest) = strips.take() else { break };
        let (here, rest) = rest.cut(last - first);
        strips = Some(rest);
        let group = Records { rows: &rows[first..last], records: &mut records[..entries] };
        for_each(first..last, (group, here), &|row, (group, strips): (Records<'_, N>, T)| {
            work(row, group.records, strips);
        });
        add(&rows[first..last], &records[..entries], sums);
        first = last;
    }
}
