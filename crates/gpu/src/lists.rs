//! A view's Gaussians prepared for composing: projected, ordered by depth, and listed per tile.
//!
//! ```text
//! project ─▶ order by depth ─▶ reduce, total, offsets ─▶ emit ─▶ order by tile ─▶ starts
//! ```
//!
//! Entries are numbered in the order of depth, with those of a Gaussian one after another. The number is
//! the position of an entry's gradient record, so a Gaussian finds its records side by side. The order by
//! tile is stable and keeps the depth order within a tile. Hidden Gaussians are sorted with the largest key
//! instead of being removed before: this saves a dispatch and makes the sort slightly longer.

use use3d_capture::Lattice;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::chunks::CHUNK;
use crate::constants::{CONSTANTS, CONSTANTS_BINDING, StepConstants, TILE, counts};
use crate::device::Gpu;
use crate::kernel::{Access, Binding, Constant, Kernel, ROWS, Spec, U32S, bound, read};
use crate::rows::{Float4, SPLAT};
use crate::scene::Parameters;
use crate::sort::{self, Items, Sort, SortKernels};

/// Threads of a workgroup.
const THREADS: u32 = 256;
/// Number of Gaussians per thread of the sums.
const ITEMS: u32 = 8;
/// Number of bits of a depth's key.
const DEPTH_BITS: u32 = 28;

pub(crate) const HARMONICS: &str = include_str!("view/harmonics.wgsl");
pub(crate) const PROJECTION: &str = include_str!("view/projection.wgsl");
const CONTOUR: &str = include_str!("view/contour.wgsl");
const SCAN: &str = include_str!("scan.wgsl");

fn spec(name: &'static str, bindings: &[Binding], parts: &[&'static str], records: bool) -> Spec {
    let mut constants = counts::constants();
    constants.push(("ITEMS", Constant::Count(ITEMS)));
    constants.push(("RECORDS", Constant::Switch(records)));
    Spec {
        name,
        threads: THREADS,
        bindings: [&[CONSTANTS_BINDING], bindings].concat(),
        constants,
        parts: [&[CONSTANTS], parts].concat(),
    }
}

fn project() -> Spec {
    let bindings = [
        CHUNK,
        read("axes"),
        (Access::Read, "geometry", ROWS),
        (Access::Read, "colors", ROWS),
        (Access::Write, "splats", ROWS),
        (Access::Write, "keys", U32S),
        (Access::Write, "tiles", U32S),
    ];
    spec("project", &bindings, &[HARMONICS, PROJECTION, CONTOUR, include_str!("view/project.wgsl")], false)
}

fn reduce() -> Spec {
    let bindings =
        [(Access::Read, "order", U32S), (Access::Read, "tiles", U32S), (Access::Write, "partial", U32S)];
    spec("reduce", &bindings, &[SCAN, include_str!("view/reduce.wgsl")], false)
}

fn total() -> Spec {
    let bindings = [counts::WRITE, (Access::Write, "partial", U32S)];
    spec("total", &bindings, &[SCAN, include_str!("view/total.wgsl")], false)
}

fn offsets() -> Spec {
    let bindings = [
        counts::READ,
        (Access::Read, "order", U32S),
        (Access::Read, "tiles", U32S),
        (Access::Read, "partial", U32S),
        (Access::Write, "offsets", U32S),
        (Access::Write, "runs", "array<vec2<u32>>"),
    ];
    spec("offsets", &bindings, &[SCAN, include_str!("view/offsets.wgsl")], false)
}

fn emit(records: bool) -> Spec {
    let bindings = [
        counts::READ,
        read("axes"),
        (Access::Read, "splats", ROWS),
        (Access::Read, "order", U32S),
        (Access::Read, "offsets", U32S),
        (Access::Write, "keys", U32S),
        (Access::Write, "owners", U32S),
        (Access::Write, "records", ROWS),
    ];
    const LOG2_255: &str = "const LOG2_255: f32 = 7.9943533f;";
    spec("emit", &bindings, &[LOG2_255, CONTOUR, include_str!("view/emit.wgsl")], records)
}

fn starts() -> Spec {
    let bindings = [counts::READ, (Access::Read, "keys", U32S), (Access::Write, "starts", U32S)];
    spec("starts", &bindings, &[include_str!("view/starts.wgsl")], false)
}

/// All kernels of this module.
pub(crate) fn specs() -> [Spec; 7] {
    [project(), reduce(), total(), offsets(), emit(false), emit(true), starts()]
}

#[cfg(test)]
impl Lists {
    /// Records the sums over blocks of Gaussians alone.
    pub(crate) fn record_total(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        counts: &Array<u32>,
        partial: &Array<u32>,
    ) {
        let [_, _, total, ..] = &self.kernels;
        total.record_groups(pass, 1, bound![*constants, *counts, *partial]);
    }
}

/// A view's lists as the compositor reads them, from any source.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewLists<'a> {
    /// See [`Lists::axes`].
    pub(crate) axes: &'a Array<f32>,
    pub(crate) starts: &'a Array<u32>,
    /// Entries by tile, and by depth within a tile.
    pub(crate) lists: &'a Array<u32>,
    pub(crate) owners: &'a Array<u32>,
    pub(crate) splats: &'a Array<Float4>,
}

impl ViewLists<'_> {
    /// The buffers of a view that a kernel binds, the constants first.
    pub(crate) fn buffers(&self, constants: &Array<StepConstants>) -> Vec<wgpu::Buffer> {
        bound![*constants, *self.axes, *self.starts, *self.lists, *self.owners, *self.splats]
    }
}

/// The buffers of a view's lists, and the kernels that fill them.
#[derive(Debug)]
pub(crate) struct Lists {
    sort: SortKernels,
    /// In the order of [`specs`].
    kernels: [Kernel; 7],
    /// Pixel centres of columns, then of rows, each padded to whole tiles with the last centre.
    pub(crate) axes: Array<f32>,
    /// The lattice of the axes.
    lattice: Option<Lattice>,
    pub(crate) splats: Array<Float4>,
    tiles: Array<u32>,
    by_depth: Sort,
    partial: Array<u32>,
    offsets: Array<u32>,
    pub(crate) runs: Array<[u32; 2]>,
    pub(crate) owners: Array<u32>,
    by_tile: Sort,
    tile_bits: u32,
    pub(crate) starts: Array<u32>,
    nothing: Array<Float4>,
}

/// Number of entries for which there is room at first.
const FIRST_ENTRIES: usize = 1 << 14;

impl Lists {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            sort: Kernel::all(gpu, &sort::specs())?,
            kernels: Kernel::all(gpu, &specs())?,
            axes: Array::new(gpu, "pixel centres", 1)?,
            lattice: None,
            splats: Array::new(gpu, "splats", 1)?,
            tiles: Array::new(gpu, "tiles per Gaussian", 1)?,
            by_depth: Sort::new(gpu, 1)?,
            partial: Array::new(gpu, "partial sums", 1)?,
            offsets: Array::new(gpu, "offsets", 1)?,
            runs: Array::new(gpu, "runs", 1)?,
            owners: Array::new(gpu, "owners", FIRST_ENTRIES)?,
            by_tile: Sort::new(gpu, FIRST_ENTRIES)?,
            tile_bits: 8,
            starts: Array::new(gpu, "list starts", 1)?,
            nothing: Array::new(gpu, "no records", 1)?,
        })
    }

    /// Number of entries for which there is room.
    pub(crate) fn capacity(&self) -> usize {
        self.by_tile.capacity()
    }

    /// Makes room for this number of entries.
    pub(crate) fn grow(&mut self, gpu: &Gpu, entries: usize) -> Result<(), EngineError> {
        self.owners.grow(gpu, entries)?;
        self.by_tile.grow(gpu, entries)
    }

    /// Waits, and returns true if every entry of the last view recorded with these counts had room.
    /// Otherwise it makes room for one and a half times as many entries as needed, and the view must be
    /// recorded again.
    ///
    /// # Errors
    /// The driver failed.
    pub(crate) fn had_room(&mut self, gpu: &Gpu, counts: &Array<u32>) -> Result<bool, EngineError> {
        let told = counts.read(gpu, counts::WORDS)?;
        if told[counts::STOP] == 0 {
            return Ok(true);
        }
        let most = told[counts::MOST] as usize;
        self.grow(gpu, most + most / 2)?;
        Ok(false)
    }

    /// Prepares a view of a lattice with these constants. Called before [`Lists::record`], and again when
    /// one of them changes.
    pub(crate) fn prepare(
        &mut self,
        gpu: &Gpu,
        constants: &StepConstants,
        lattice: &Lattice,
    ) -> Result<(), EngineError> {
        let n = constants.gaussians();
        self.splats.grow(gpu, SPLAT * n)?;
        self.tiles.grow(gpu, n)?;
        self.by_depth.grow(gpu, n)?;
        self.partial.grow(gpu, n.div_ceil((ITEMS * THREADS) as usize))?;
        self.offsets.grow(gpu, n)?;
        self.runs.grow(gpu, n)?;
        self.starts.grow(gpu, constants.tiles() + 1)?;
        if self.lattice.as_ref() != Some(lattice) {
            let padded = |centres: &'_ [f32]| {
                let more = centres.len().next_multiple_of(TILE as usize) - centres.len();
                let last = centres.last().copied().unwrap_or_default();
                [centres, &vec![last; more]].concat()
            };
            let axes = [padded(lattice.columns()), padded(lattice.rows())].concat();
            self.axes.grow(gpu, axes.len())?;
            self.axes.write(gpu, 0, &axes);
            self.lattice = Some(lattice.clone());
        }
        // One number more than there are tiles: that of entries that no tile draws.
        self.tile_bits = usize::BITS - constants.tiles().leading_zeros();
        self.by_depth.prepare(gpu, Items::Fixed(n), DEPTH_BITS);
        self.by_tile.prepare(gpu, Items::Counted(self.capacity()), self.tile_bits);
        Ok(())
    }

    /// Records the computation of the lists. With `records`, the records of entries that no tile draws are
    /// zeroed.
    pub(crate) fn record(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        n: usize,
        tiles: usize,
        scene: &Parameters,
        counts: &Array<u32>,
        records: Option<&Array<Float4>>,
    ) {
        let Self { axes, splats, tiles: met, by_depth, partial, offsets, runs, owners, by_tile, .. } = self;
        let Parameters { geometry, colors } = scene;
        let [project, reduce, total, set_offsets, emit, emit_records, find_starts] = &self.kernels;
        let keys = by_depth.input();
        for (chunk, count) in colors.over(n) {
            let floats = &chunk.floats;
            let buffers = bound![*constants, chunk.place, *axes, *geometry, *floats, *splats, *keys, *met];
            project.record(pass, count, buffers);
        }
        by_depth.record(&self.sort, pass, counts, DEPTH_BITS);
        let (_, order) = by_depth.output(DEPTH_BITS);
        let blocks = n.div_ceil((ITEMS * THREADS) as usize);
        reduce.record_groups(pass, blocks, bound![*constants, *order, *met, *partial]);
        total.record_groups(pass, 1, bound![*constants, *counts, *partial]);
        let buffers = bound![*constants, *counts, *order, *met, *partial, *offsets, *runs];
        set_offsets.record_groups(pass, blocks, buffers);
        let emit = if records.is_some() { emit_records } else { emit };
        let (keys, records) = (by_tile.input(), records.unwrap_or(&self.nothing));
        let places = if n == 0 { 0 } else { self.capacity() };
        let buffers = bound![*constants, *counts, *axes, *splats, *order, *offsets, *keys, *owners, *records];
        emit.record(pass, places, buffers);
        by_tile.record(&self.sort, pass, counts, self.tile_bits);
        let (keys, _) = by_tile.output(self.tile_bits);
        find_starts.record(pass, tiles + 1, bound![*constants, *counts, *keys, self.starts]);
    }

    /// The lists as the compositor reads them, after [`Lists::record`].
    pub(crate) fn drawn(&self) -> ViewLists<'_> {
        let Self { axes, starts, owners, splats, .. } = self;
        ViewLists { axes, starts, lists: self.entries(), owners, splats }
    }

    /// Entries by tile, and by depth within a tile.
    pub(crate) fn entries(&self) -> &Array<u32> {
        self.by_tile.output(self.tile_bits).1
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        let words = [&self.tiles, &self.partial, &self.offsets, &self.owners, &self.starts];
        let rows = self.axes.size() + self.splats.size() + self.runs.size();
        rows + words.map(Array::size).iter().sum::<usize>() + self.by_depth.size() + self.by_tile.size()
    }

    /// Waits and returns the Gaussians that reach the lattice, nearest first.
    #[cfg(test)]
    pub(crate) fn visible(&self, gpu: &Gpu, n: usize) -> Vec<usize> {
        if n == 0 {
            return Vec::new();
        }
        let read = |array: &Array<u32>| array.read(gpu, n).expect("the device answers");
        let (keys, order) = self.by_depth.output(DEPTH_BITS);
        let hidden = (1 << DEPTH_BITS) - 1;
        read(keys).iter().zip(read(order)).filter(|(k, _)| **k != hidden).map(|(_, i)| i as usize).collect()
    }

    /// Fills everything that a view writes with NaN.
    #[cfg(test)]
    pub(crate) fn poison(&self, gpu: &Gpu) {
        self.by_depth.poison(gpu);
        self.by_tile.poison(gpu);
        self.splats.poison(gpu);
        self.runs.poison(gpu);
        for array in [&self.tiles, &self.partial, &self.offsets, &self.owners, &self.starts] {
            array.poison(gpu);
        }
    }
}
