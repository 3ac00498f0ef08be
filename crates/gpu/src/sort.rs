//! A stable radix sort of (key, value) pairs of unsigned integers. Each pass of eight bits computes a
//! histogram of every block of items, the positions that follow from it, and moves the items.
//!
//! No pass waits for another workgroup (there is no look-back), and the order of threads does not matter:
//! the same input gives the same output everywhere. The values of the first pass are the items' numbers, so
//! a caller writes only keys.

use bytemuck::{Pod, Zeroable};
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::counts;
use crate::device::Gpu;
use crate::kernel::{Access, Binding, Constant, Kernel, Spec, U32S, bound};

/// Threads of a workgroup.
const THREADS: u32 = 256;
/// Number of items that a thread moves.
const ITEMS: usize = 16;
/// Number of items in a block.
const BLOCK: usize = ITEMS * THREADS as usize;
/// Number of digits in a pass.
const DIGITS: usize = 256;
/// Number of passes for the longest key.
const PASSES: usize = 4;

/// The data of one pass for its kernels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct SortPass {
    shift: u32,
    items: u32,
    blocks: u32,
    counted: u32,
}

const ORDER: Binding = (Access::Uniform, "order", "Pass");

fn spec(name: &'static str, body: &'static str, identity: bool, more: &[Binding]) -> Spec {
    Spec {
        name,
        threads: THREADS,
        bindings: [&[ORDER, counts::READ], more].concat(),
        constants: vec![("IDENTITY", Constant::Switch(identity)), ("ITEMS", Constant::Count(ITEMS as u32))],
        parts: vec![include_str!("scan.wgsl"), include_str!("sort/shared.wgsl"), body],
    }
}

fn histogram() -> Spec {
    let more = [(Access::Read, "keys", U32S), (Access::Write, "table", U32S)];
    spec("sort: histogram", include_str!("sort/histogram.wgsl"), false, &more)
}

fn spread() -> Spec {
    let more = [(Access::Write, "table", U32S), (Access::Write, "totals", U32S)];
    spec("sort: spread", include_str!("sort/spread.wgsl"), false, &more)
}

fn scatter(identity: bool) -> Spec {
    let more = [
        (Access::Read, "keys", U32S),
        (Access::Read, "values", U32S),
        (Access::Read, "table", U32S),
        (Access::Read, "totals", U32S),
        (Access::Write, "sorted_keys", U32S),
        (Access::Write, "sorted_values", U32S),
    ];
    spec("sort: scatter", include_str!("sort/scatter.wgsl"), identity, &more)
}

/// All kernels of the sort.
pub(crate) fn specs() -> [Spec; 4] {
    [histogram(), spread(), scatter(false), scatter(true)]
}

/// The kernels in the order of [`specs`]; shared by several sorts.
pub(crate) type SortKernels = [Kernel; 4];

/// The number of items of a sort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Items {
    /// This number.
    Fixed(usize),
    /// The number in the first word of the counts, at most this number.
    Counted(usize),
}

/// The buffers of one sort. The caller writes the keys; keys and values are in order afterwards.
#[derive(Debug)]
pub(crate) struct Sort {
    keys: [Array<u32>; 2],
    values: [Array<u32>; 2],
    table: Array<u32>,
    totals: Array<u32>,
    passes: Vec<Array<SortPass>>,
    written: [SortPass; PASSES],
}

impl Sort {
    /// A sort with room for `capacity` items.
    pub(crate) fn new(gpu: &Gpu, capacity: usize) -> Result<Self, EngineError> {
        let pair =
            |what| Ok::<_, EngineError>([Array::new(gpu, what, capacity)?, Array::new(gpu, what, capacity)?]);
        Ok(Self {
            keys: pair("sort keys")?,
            values: pair("sorted items")?,
            table: Array::new(gpu, "digit counts", DIGITS * capacity.div_ceil(BLOCK).max(1))?,
            totals: Array::new(gpu, "digit totals", DIGITS)?,
            passes: (0..PASSES).map(|_| Array::uniform(gpu, "sort pass")).collect::<Result<_, _>>()?,
            written: [SortPass::default(); PASSES],
        })
    }

    /// Makes room; the contents are discarded.
    pub(crate) fn grow(&mut self, gpu: &Gpu, capacity: usize) -> Result<(), EngineError> {
        for array in self.keys.iter_mut().chain(&mut self.values) {
            array.grow(gpu, capacity)?;
        }
        self.table.grow(gpu, DIGITS * capacity.div_ceil(BLOCK))?;
        Ok(())
    }

    /// The buffer for the caller's keys.
    pub(crate) fn input(&self) -> &Array<u32> {
        &self.keys[0]
    }

    /// Number of items for which there is room.
    pub(crate) fn capacity(&self) -> usize {
        self.keys[0].capacity()
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        let pairs: usize = self.keys.iter().chain(&self.values).map(Array::size).sum();
        pairs + self.table.size() + self.totals.size()
    }

    /// Number of passes for keys of this number of bits.
    fn passes(bits: u32) -> usize {
        (bits.div_ceil(8) as usize).clamp(1, PASSES)
    }

    /// Keys and values after sorting keys of this number of bits.
    pub(crate) fn output(&self, bits: u32) -> (&Array<u32>, &Array<u32>) {
        let side = Self::passes(bits) % 2;
        (&self.keys[side], &self.values[side])
    }

    /// Sets up the passes. Called before [`Sort::record`], and again when one of these arguments changes.
    pub(crate) fn prepare(&mut self, gpu: &Gpu, items: Items, bits: u32) {
        let (count, counted) = match items {
            Items::Fixed(count) => (count, 0),
            Items::Counted(most) => (most, 1),
        };
        for (at, array) in self.passes.iter().enumerate().take(Self::passes(bits)) {
            let blocks = count.div_ceil(BLOCK) as u32;
            let pass = SortPass { shift: 8 * at as u32, items: count as u32, blocks, counted };
            if self.written[at] != pass {
                array.write(gpu, 0, &[pass]);
                self.written[at] = pass;
            }
        }
    }

    /// Records the prepared sort.
    pub(crate) fn record(
        &self,
        [histogram, spread, scatter, scatter_first]: &SortKernels,
        pass: &mut wgpu::ComputePass<'_>,
        counts: &Array<u32>,
        bits: u32,
    ) {
        let blocks = self.written[0].blocks as usize;
        for (at, order) in self.passes.iter().enumerate().take(Self::passes(bits)) {
            let (from, to) = (at % 2, (at + 1) % 2);
            let (keys, values) = (&self.keys[from], &self.values[from]);
            let (table, totals) = (&self.table, &self.totals);
            histogram.record_groups(pass, blocks, bound![*order, *counts, *keys, *table]);
            let digits = if blocks == 0 { 0 } else { DIGITS };
            spread.record_groups(pass, digits, bound![*order, *counts, *table, *totals]);
            let scatter = if at == 0 { scatter_first } else { scatter };
            let (to_keys, to_values) = (&self.keys[to], &self.values[to]);
            let buffers = bound![*order, *counts, *keys, *values, *table, *totals, *to_keys, *to_values];
            scatter.record_groups(pass, blocks, buffers);
        }
    }

    /// Fills everything with NaN.
    #[cfg(test)]
    pub(crate) fn poison(&self, gpu: &Gpu) {
        for array in self.keys.iter().chain(&self.values).chain([&self.table, &self.totals]) {
            array.poison(gpu);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::submit;

    /// Reproducible numbers from a small generator.
    fn keys(n: usize, bits: u32) -> Vec<u32> {
        let mut state = 0x2545_f491_4f6c_dd1du64 ^ n as u64;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 24) as u32
        };
        (0..n).map(|i| if i % 3 == 0 { 5 } else { next() & (u32::MAX >> (32 - bits)) }).collect()
    }

    fn expected(keys: &[u32]) -> (Vec<u32>, Vec<u32>) {
        let mut order: Vec<u32> = (0..keys.len() as u32).collect();
        order.sort_by_key(|&i| keys[i as usize]);
        (order.iter().map(|&i| keys[i as usize]).collect(), order)
    }

    /// More blocks than a workgroup has threads, so that sums go on from one round to the next.
    #[test]
    fn more_than_a_million_pairs_are_sorted() {
        let Some(gpu) = crate::test_support::software() else { return };
        let kernels = Kernel::all(&gpu, &specs()).unwrap();
        let counts = Array::from(&gpu, "counts", &[0u32; 64]).unwrap();
        for (n, bits) in [((1 << 20) + 1, 13), (2_100_000, 8)] {
            let mut sort = Sort::new(&gpu, n).unwrap();
            sort.poison(&gpu);
            let keys = keys(n, bits);
            sort.input().write(&gpu, 0, &keys);
            sort.prepare(&gpu, Items::Fixed(n), bits);
            submit(&gpu, "sort", |pass| sort.record(&kernels, pass, &counts, bits)).unwrap();
            let (sorted, order) = sort.output(bits);
            let found = (sorted.read(&gpu, n).unwrap(), order.read(&gpu, n).unwrap());
            assert!(found == expected(&keys), "{n} items of {bits} bits");
        }
    }

    #[test]
    fn pairs_are_sorted_and_ties_keep_their_order() {
        let Some(gpu) = crate::test_support::software() else { return };
        let kernels = Kernel::all(&gpu, &specs()).unwrap();
        let counts = Array::from(&gpu, "counts", &[0u32; 64]).unwrap();
        let mut sort = Sort::new(&gpu, 1).unwrap();
        for (n, bits) in
            [(0, 8), (1, 28), (255, 8), (256, 13), (257, 13), (4096, 8), (4097, 28), (70_000, 32)]
        {
            let keys = keys(n, bits);
            sort.grow(&gpu, n).unwrap();
            for items in [Items::Fixed(n), Items::Counted(n + 5000)] {
                if let Items::Counted(most) = items {
                    sort.grow(&gpu, most).unwrap();
                }
                sort.poison(&gpu);
                counts.write(&gpu, 0, &[n as u32]);
                sort.input().write(&gpu, 0, &keys);
                sort.prepare(&gpu, items, bits);
                submit(&gpu, "sort", |pass| sort.record(&kernels, pass, &counts, bits)).unwrap();
                let (sorted, order) = sort.output(bits);
                let found = (sorted.read(&gpu, n).unwrap(), order.read(&gpu, n).unwrap());
                assert!(found == expected(&keys), "{n} items of {bits} bits, {items:?}");
            }
        }
    }
}
