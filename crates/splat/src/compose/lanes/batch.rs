//! The loop over a tile's list of Gaussians, in either direction, in batches.
//!
//! A trained Gaussian meets about four of the 16 cells of a tile. A loop over so few cells ends at a place
//! that the processor cannot predict, and each time it throws away the work it had begun. So a batch
//! collects consecutive entries of the list until they meet some tens of cells. An *item* is one entry in
//! one cell that it meets; a pass loops over all items of a batch at once, in the order of entries, and so
//! in each cell in the order of depth.
//!
//! For each (tile, Gaussian) entry, four vectors of the 16 rows compute which cells the 1/255 contour meets.
//! The test is exact in each row: it evaluates `α` at the point of the cell's columns that is nearest to the
//! row's peak, with the same formula as for the pixels. Cells that are not met cost nothing.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x16};

use super::load;
use crate::compose::tile::{CELL, CELLS, Lanes, TileInput};
use crate::lists::TILE;
use crate::project::{LOG2_255, Splat};

/// Most entries of a batch.
pub(super) const ENTRIES: usize = TILE;
/// A batch takes no further entry once it has this many items.
const FULL: usize = 32;
/// Most items of a batch.
const ITEMS: usize = FULL + CELLS;

/// The work that is done for each batch in turn.
pub(super) trait Pass<S: Simd> {
    /// True if every entry of the list needs a record, including entries that contribute to no pixel.
    const RECORDS: bool;

    /// The cells in which some pixel may still receive entry `k`, as bits.
    fn open(&self, simd: S, k: usize) -> u32;

    /// Handles a batch.
    fn batch(&mut self, simd: S, batch: &EntryBatch<'_, S>);
}

/// One vector of lanes for each item of a batch.
#[repr(C, align(64))]
pub(super) struct Items([Lanes; ITEMS]);

impl Items {
    pub(super) const ZERO: Self = Self([[0.0; TILE]; ITEMS]);

    /// The lanes of an item.
    #[inline(always)]
    pub(super) fn get<S: Simd>(&self, simd: S, item: usize) -> f32x16<S> {
        load(simd, &self.0[item])
    }

    /// Sets the lanes of an item.
    #[inline(always)]
    pub(super) fn set<S: Simd>(&mut self, item: usize, lanes: f32x16<S>) {
        lanes.store_array(&mut self.0[item]);
    }
}

/// Consecutive entries of a tile's list, and the cells that they meet. The lanes of its arrays are entries.
pub(super) struct EntryBatch<'a, S: Simd> {
    centres: Centres<S>,
    /// The Gaussians' values, as [`Splat`] names them.
    x: Lanes,
    y: Lanes,
    shear: Lanes,
    steepness: Lanes,
    steepness_y: Lanes,
    log2_opacity: Lanes,
    pub(super) z: Lanes,
    pub(super) color: [Lanes; 3],
    /// Positions in the tile's list, and the entries there: positions among the spans, and Gaussians.
    pub(super) places: [i32; ENTRIES],
    pub(super) entries: [(usize, &'a Splat); ENTRIES],
    /// Number of entries.
    count: usize,
    /// The cell and the entry of each item. Eight more items may be written than are counted.
    cells: [u8; ITEMS + 8],
    owners: [u8; ITEMS + 8],
    /// Position of each entry's first item, with one element more than there are entries.
    starts: [usize; ENTRIES + 1],
}

/// An item: its number, its cell, and its entry.
#[derive(Clone, Copy)]
pub(super) struct BatchItem {
    pub(super) number: usize,
    pub(super) cell: usize,
    pub(super) entry: usize,
}

impl<'a, S: Simd> EntryBatch<'a, S> {
    #[inline(always)]
    fn new(simd: S, input: &TileInput<'a>, first: (usize, &'a Splat)) -> Self {
        let zero = [0.0; TILE];
        Self {
            centres: Centres::of(simd, input),
            x: zero,
            y: zero,
            shear: zero,
            steepness: zero,
            steepness_y: zero,
            log2_opacity: zero,
            z: zero,
            color: [zero; 3],
            places: [0; ENTRIES],
            entries: [first; ENTRIES],
            count: 0,
            cells: [0; ITEMS + 8],
            owners: [0; ITEMS + 8],
            starts: [0; ENTRIES + 1],
        }
    }

    #[inline(always)]
    fn is_full(&self) -> bool {
        self.count == ENTRIES || self.starts[self.count] >= FULL
    }

    /// Adds the entry at `place`, which meets these cells.
    #[inline(always)]
    fn push(&mut self, place: usize, (at, splat): (usize, &'a Splat), met: u32) {
        let e = self.count & (ENTRIES - 1);
        (self.x[e], self.y[e], self.z[e]) = (splat.x, splat.y, splat.z);
        (self.shear[e], self.log2_opacity[e]) = (splat.shear, splat.log2_opacity);
        (self.steepness[e], self.steepness_y[e]) = (splat.steepness, splat.steepness_y);
        for (lanes, value) in self.color.iter_mut().zip(splat.color) {
            lanes[e] = value;
        }
        (self.places[e], self.entries[e]) = (place as i32, (at, splat));
        // Without a branch: eight cells are written for each half of the mask, and those it has are counted.
        let mut end = self.starts[e];
        for half in 0..2 {
            let bits = (met >> (8 * half)) as usize & 0xff;
            let cells = u64::from_le_bytes(CELLS_OF[bits]) + half as u64 * 0x0808_0808_0808_0808;
            self.cells[end..end + 8].copy_from_slice(&cells.to_le_bytes());
            self.owners[end..end + 8].fill(e as u8);
            end += bits.count_ones() as usize;
        }
        self.count += 1;
        self.starts[e + 1] = end;
    }

    /// Number of entries.
    #[inline(always)]
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// All items, in the order of entries, then of cells.
    #[inline(always)]
    pub(super) fn items(&self) -> impl Iterator<Item = BatchItem> + '_ {
        self.between(0..self.starts[self.count])
    }

    /// The items of entry `e`.
    #[inline(always)]
    pub(super) fn items_of(&self, e: usize) -> impl Iterator<Item = BatchItem> + '_ {
        self.between(self.starts[e]..self.starts[e + 1])
    }

    #[inline(always)]
    fn between(&self, numbers: Range<usize>) -> impl Iterator<Item = BatchItem> + '_ {
        let cells = self.cells[numbers.clone()].iter().zip(&self.owners[numbers.clone()]);
        // The masks show the compiler that the indices are in range.
        numbers.zip(cells).map(|(number, (&cell, &entry))| BatchItem {
            number: number.min(ITEMS - 1),
            cell: usize::from(cell) & (CELLS - 1),
            entry: usize::from(entry) & (ENTRIES - 1),
        })
    }

    /// Returns `t` and `dy` of the pixels of an item.
    #[inline(always)]
    pub(super) fn offsets(&self, simd: S, item: BatchItem) -> [f32x16<S>; 2] {
        let c = |lanes: &Lanes| f32x16::splat(simd, lanes[item.entry]);
        let dy = self.centres.rows[item.cell / CELL] - c(&self.y);
        let peak = c(&self.shear).mul_add(-dy, c(&self.x));
        [self.centres.columns[item.cell % CELL] - peak, dy]
    }

    /// Returns `log₂ α` of the pixels of an item, before the clamp.
    #[inline(always)]
    pub(super) fn log2_alpha(&self, simd: S, item: BatchItem) -> f32x16<S> {
        let c = |lanes: &Lanes| f32x16::splat(simd, lanes[item.entry]);
        let [t, dy] = self.offsets(simd, item);
        let power = c(&self.steepness_y).mul_add(-(dy * dy), c(&self.log2_opacity));
        (t * c(&self.steepness)).mul_add(-t, power)
    }
}

/// The positions of the bits of a byte, in ascending order; the rest is 0.
const CELLS_OF: [[u8; 8]; 256] = {
    let mut table = [[0; 8]; 256];
    let mut bits = 0;
    while bits < 256 {
        let (mut n, mut bit) = (0, 0);
        while bit < 8 {
            if bits >> bit & 1 == 1 {
                table[bits][n] = bit as u8;
                n += 1;
            }
            bit += 1;
        }
        bits += 1;
    }
    table
};

/// Pixel centres as the lanes of cells: the columns of a cell by its place in a row of cells, and the rows
/// by its row of cells.
struct Centres<S: Simd> {
    columns: [f32x16<S>; CELL],
    rows: [f32x16<S>; CELL],
}

impl<S: Simd> Centres<S> {
    #[inline(always)]
    fn of(simd: S, input: &TileInput<'_>) -> Self {
        let zero = f32x16::splat(simd, 0.0);
        let (mut columns, mut rows) = ([zero; CELL], [zero; CELL]);
        for part in 0..CELL {
            let (mut x, mut y) = ([0.0; TILE], [0.0; TILE]);
            for lane in 0..TILE {
                x[lane] = input.columns[part * CELL + lane % CELL];
                y[lane] = input.rows[part * CELL + lane / CELL];
            }
            (columns[part], rows[part]) = (load(simd, &x), load(simd, &y));
        }
        Self { columns, rows }
    }
}

/// The cells that the contour of a Gaussian meets, as bits.
#[inline(always)]
fn cells_met<S: Simd>(simd: S, splat: &Splat, rows: f32x16<S>, columns: &Lanes) -> u32 {
    let c = |v: f32| f32x16::splat(simd, v);
    let dy = rows - c(splat.y);
    let peak = c(splat.shear).mul_add(-dy, c(splat.x));
    let power = c(splat.steepness_y).mul_add(-(dy * dy), c(splat.log2_opacity));
    let steepness = c(splat.steepness);
    // One bit for each row of the tile, 16 bits for each column of cells.
    let mut rows_met = 0u64;
    for part in 0..CELL {
        // The pixel centre nearest to the peak, if the peak lies outside the cell's columns; otherwise a
        // point at least as near as any pixel.
        let t = peak.max(c(columns[part * CELL])).min(c(columns[part * CELL + CELL - 1])) - peak;
        let best = (t * steepness).mul_add(-t, power);
        rows_met |= best.simd_ge(c(-LOG2_255)).to_bitmask() << (part * TILE);
    }
    // A cell is met if one of its four rows is.
    let pairs = rows_met | rows_met >> 1;
    let met = (pairs | pairs >> 2) & 0x1111_1111_1111_1111;
    ((met | met >> 15 | met >> 30 | met >> 45) & 0xffff) as u32
}

/// Runs the pass over the list, from the nearest Gaussian to the farthest or, if `BACK`, the other way
/// round. No batch has Gaussians on both sides of the depth `cut`.
#[inline(always)]
pub(super) fn walk<S: Simd, const BACK: bool, P: Pass<S>>(
    simd: S,
    input: &TileInput<'_>,
    cut: f32,
    pass: &mut P,
) {
    let last = match input.list.len() {
        0 => return,
        count => count - 1,
    };
    let rows = load(simd, input.rows);
    let mut batch = EntryBatch::new(simd, input, input.entry(0));
    let mut step = 0;
    while step <= last && (P::RECORDS || pass.open(simd, step) != 0) {
        batch.count = 0;
        let mut beyond = None;
        while step <= last && !batch.is_full() {
            let k = if BACK { last - step } else { step };
            let entry = input.entry(k);
            let far = entry.1.z > cut;
            if *beyond.get_or_insert(far) != far {
                break;
            }
            let met = cells_met(simd, entry.1, rows, input.columns) & pass.open(simd, k);
            batch.push(k, entry, met);
            step += 1;
        }
        pass.batch(simd, &batch);
    }
}
