//! The field at the Gaussians: removal of the constant mode, and enhanced radiance.
//!
//! `local_i = raw_i - (1/N) Σ_j raw_j` over the N Gaussians that define the mean (R22), so that the global
//! grade belongs to the affine alone, and `c_i⁺ = exp(a_i) ⊙ (c_i + δA c_i + b_g) + b_i` with
//! `(a_i, b_i) = local_i`. Here `c_i` is the clamped view-dependent stage-1 colour; `c_i⁺` is not clamped.
//! Gradients flow through the mean: with `g_i = ∂L/∂local_i`, `∂L/∂raw_i = g_i - (1/N) Σ_j g_j` for these N
//! Gaussians, where j runs over all listed Gaussians. So they matter in every step, visible or not. For the
//! others it is `g_i` alone.
//!
//! Training takes the mean over some Gaussians, evenly chosen, and looks the others up only in views that
//! see them ([`ObjectPass::move_to`]); a drawing of the scene uses that mean.
//!
//! Work is cut into blocks of 2048 Gaussians. Their sums are added in block order, so the bits do not
//! depend on the number of threads. Nothing is allocated after the largest list of Gaussians has occurred.

use std::sync::{Arc, Mutex, PoisonError};

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;

use crate::OUTPUTS;
use crate::field::{Field, Gradient};
use crate::guide;
use crate::kernel::{Accumulator, Lookups, PackedField, TILE, TileOutputs};
use crate::recolor::{self, BlockSums, plane_sums, total};
use crate::sites::{BLOCK, LANES, Sites, guide_color};

/// The field evaluated at the listed Gaussians of a frozen scene, forward and backward.
#[derive(Debug)]
pub struct ObjectPass {
    pub(crate) level: Level,
    sites: Arc<Sites>,
    packed: PackedField,
    /// For each block, six planes of [`BLOCK`] raw outputs.
    raw: Vec<f32>,
    /// The removed mean, which [`crate::Enhancement`] stores when training ends.
    pub mean: [f32; OUTPUTS],
    /// `∂L/∂local`, then `∂L/∂raw`, in the layout of `raw`.
    d_raw: Vec<f32>,
    sums: Vec<BlockSums>,
    /// For each block, a flat gradient.
    partials: Vec<f64>,
    scratch: Vec<Mutex<ObjectScratch>>,
}

#[derive(Debug)]
struct ObjectScratch {
    outputs: TileOutputs,
    gamma: [f32; TILE],
    d_gamma: [f32; TILE],
    sums: Accumulator,
}

impl Default for ObjectScratch {
    fn default() -> Self {
        Self {
            outputs: [[0.0; TILE]; OUTPUTS],
            gamma: [0.0; TILE],
            d_gamma: [0.0; TILE],
            sums: Accumulator::default(),
        }
    }
}

impl ObjectPass {
    /// A pass for Gaussians at `means` with guide colours from their SH band 0 (`sh_dc`, equal length), on
    /// the best instruction set.
    pub fn new(field: &Field, means: &[[f32; 3]], sh_dc: impl ExactSizeIterator<Item = [f32; 3]>) -> Self {
        Self::with_guides(field, means, sh_dc.map(guide_color))
    }

    /// Like [`ObjectPass::new`], with the guide colours `c̄` themselves.
    pub(crate) fn with_guides(
        field: &Field,
        means: &[[f32; 3]],
        guides: impl ExactSizeIterator<Item = [f32; 3]>,
    ) -> Self {
        assert_eq!(means.len(), guides.len(), "one guide colour per Gaussian");
        let points = means.iter().copied().zip(guides);
        let sites = Arc::new(Sites::new(points, &field.bounds, field.shape().resolution));
        let blocks = sites.blocks();
        Self {
            level: Level::new(),
            raw: vec![0.0; blocks * OUTPUTS * BLOCK],
            d_raw: Vec::new(),
            sums: vec![BlockSums::default(); blocks],
            partials: Vec::new(),
            scratch: Vec::new(),
            mean: [0.0; OUTPUTS],
            packed: PackedField::default(),
            sites,
        }
    }

    /// The sites at which the field is looked up.
    pub fn sites(&self) -> &Arc<Sites> {
        &self.sites
    }

    /// Changes the sites at which the field is looked up; [`ObjectPass::forward`] must be called next.
    pub fn move_to(&mut self, sites: &Arc<Sites>) {
        if Arc::ptr_eq(&self.sites, sites) {
            return;
        }
        self.sites = Arc::clone(sites);
        self.raw.resize(sites.blocks() * OUTPUTS * BLOCK, 0.0);
        self.sums.resize(sites.blocks(), BlockSums::default());
    }

    /// Evaluates the field at every site, and computes its mean.
    pub fn forward(&mut self, field: &Field) {
        self.packed.pack(field);
        let threads = rayon::current_num_threads();
        if self.scratch.len() < threads {
            self.scratch.resize_with(threads, Mutex::default);
        }
        let (level, sites, packed, scratch) = (self.level, &self.sites, &self.packed, &self.scratch);
        let guide = field.guide();
        self.raw.par_chunks_mut(OUTPUTS * BLOCK).zip(&mut self.sums).enumerate().for_each(
            |(block, (raw, sums))| {
                with_scratch(scratch, |scratch| {
                    for tile in tiles(sites, block) {
                        dispatch!(level, simd => gammas(simd, &guide, sites, &tile, &mut scratch.gamma));
                        let lookups = tile.lookups(sites, &scratch.gamma);
                        packed.forward(level, lookups, &mut scratch.outputs);
                        for (plane, values) in raw.chunks_exact_mut(BLOCK).zip(&scratch.outputs) {
                            plane[tile.offset..tile.offset + tile.padded]
                                .copy_from_slice(&values[..tile.padded]);
                        }
                    }
                });
                let centred = sites.centred.saturating_sub(block * BLOCK).min(BLOCK);
                sums.outputs = plane_sums(raw, centred);
            },
        );
        let n = self.sites.centred.max(1) as f64;
        let totals = total(&self.sums);
        self.mean = totals.outputs.map(|t| (t / n) as f32);
    }

    /// `raw - centre` of each Gaussian: log-gain RGB, bias RGB. With `centre = self.mean` this is the
    /// field's local part.
    pub fn locals(&self, centre: [f32; OUTPUTS]) -> Vec<[f32; OUTPUTS]> {
        (0..self.sites.len())
            .map(|i| {
                let (block, at) = (i / BLOCK, i % BLOCK);
                std::array::from_fn(|o| self.raw[(block * OUTPUTS + o) * BLOCK + at] - centre[o])
            })
            .collect()
    }

    /// Enhanced colours `c⁺` of Gaussians whose Stage-1 colours in a view are `base`.
    pub fn colors(&self, field: &Field, base: &[[f32; 3]], out: &mut Vec<[f32; 3]>) {
        assert_eq!(base.len(), self.sites.len(), "one colour per Gaussian");
        out.resize(base.len(), [0.0; 3]);
        let (level, affine, centre) = (self.level, field.affine(), self.mean);
        out.par_chunks_mut(BLOCK)
            .zip(base.par_chunks(BLOCK))
            .zip(self.raw.par_chunks(OUTPUTS * BLOCK))
            .for_each(|((out, base), raw)| {
                dispatch!(level, simd => recolor::forward(simd, &affine, &centre, raw, base, out));
            });
    }

    /// Adds the gradient of everything on which `c⁺` depends, from `∂L/∂c⁺`. The last
    /// [`ObjectPass::forward`] must have been for this field.
    pub fn backward(
        &mut self,
        field: &Field,
        base: &[[f32; 3]],
        d_colors: &[[f32; 3]],
        gradient: &mut Gradient,
    ) {
        let n = self.sites.len();
        assert_eq!((base.len(), d_colors.len()), (n, n), "one colour per Gaussian");
        let (level, affine, centre) = (self.level, field.affine(), self.mean);
        self.d_raw.resize(self.raw.len(), 0.0);
        self.d_raw
            .par_chunks_mut(OUTPUTS * BLOCK)
            .zip(&mut self.sums)
            .zip(self.raw.par_chunks(OUTPUTS * BLOCK))
            .zip(base.par_chunks(BLOCK).zip(d_colors.par_chunks(BLOCK)))
            .for_each(|(((d_raw, sums), raw), (base, d))| {
                *sums = dispatch!(level, simd => recolor::backward(
                    simd, &affine, &centre, raw, base, d, d_raw
                ));
            });
        gradient.add(field.shape().affine(), &total(&self.sums).affine);
        self.backward_raw(field, gradient);
    }

    /// Like [`ObjectPass::backward`], from `∂L/∂local` directly.
    #[cfg(test)]
    pub(crate) fn backward_locals(
        &mut self,
        field: &Field,
        d_locals: &[[f32; OUTPUTS]],
        gradient: &mut Gradient,
    ) {
        assert_eq!(d_locals.len(), self.sites.len(), "one local per Gaussian");
        self.d_raw.resize(self.raw.len(), 0.0);
        let blocks = self.d_raw.chunks_exact_mut(OUTPUTS * BLOCK).zip(d_locals.chunks(BLOCK));
        for ((d_raw, d_locals), sums) in blocks.zip(&mut self.sums) {
            for (i, d) in d_locals.iter().enumerate() {
                for o in 0..OUTPUTS {
                    d_raw[o * BLOCK + i] = d[o];
                }
            }
            sums.outputs = plane_sums(d_raw, d_locals.len());
        }
        self.backward_raw(field, gradient);
    }

    /// Computes the gradient of the parameters from `∂L/∂local` in `d_raw` and its sums: through the mean,
    /// the decoder, the factors and the guide.
    fn backward_raw(&mut self, field: &Field, gradient: &mut Gradient) {
        let shape = field.shape();
        let parameters = shape.parameters();
        let n = self.sites.centred.max(1) as f64;
        let mean = total(&self.sums).outputs.map(|t| (t / n) as f32);
        self.partials.clear();
        self.partials.resize(self.sites.blocks() * parameters, 0.0);
        let (level, sites, packed, scratch) = (self.level, &self.sites, &self.packed, &self.scratch);
        let guide = field.guide();
        self.partials
            .par_chunks_mut(parameters)
            .zip(self.d_raw.par_chunks(OUTPUTS * BLOCK))
            .enumerate()
            .for_each(|(block, (partial, d_raw))| {
                with_scratch(scratch, |scratch| {
                    let ObjectScratch { outputs, gamma, d_gamma, sums } = scratch;
                    sums.clear(packed);
                    let mut d_guide = [0.0f64; 4];
                    for tile in tiles(sites, block) {
                        dispatch!(level, simd => gammas(simd, &guide, sites, &tile, gamma));
                        for (o, (values, plane)) in
                            outputs.iter_mut().zip(d_raw.chunks_exact(BLOCK)).enumerate()
                        {
                            values[..tile.padded]
                                .copy_from_slice(&plane[tile.offset..tile.offset + tile.padded]);
                            let centred = sites.centred.saturating_sub(tile.first).min(tile.padded);
                            values[..centred].iter_mut().for_each(|v| *v -= mean[o]);
                            values[tile.real..tile.padded].fill(0.0);
                        }
                        let lookups = tile.lookups(sites, gamma);
                        packed.backward(level, lookups, outputs, sums, d_gamma);
                        for i in 0..tile.real {
                            let d = f64::from(d_gamma[i] * (1.0 - gamma[i] * gamma[i]));
                            for (g, h) in d_guide.iter_mut().zip(&sites.signed_logs) {
                                *g += d * f64::from(h[tile.first + i]);
                            }
                            d_guide[3] += d;
                        }
                    }
                    sums.add_to(packed, partial);
                    partial[shape.guide()].copy_from_slice(&d_guide);
                });
            });
        for partial in self.partials.chunks_exact(parameters) {
            for (g, p) in gradient.values.iter_mut().zip(partial) {
                *g += p;
            }
        }
    }
}

/// Runs `work` with the scratch memory of the calling thread. Its content is not used after one block, so a
/// poisoned one is still usable.
fn with_scratch(scratch: &[Mutex<ObjectScratch>], work: impl FnOnce(&mut ObjectScratch)) {
    let mine = rayon::current_thread_index().unwrap_or(0) % scratch.len();
    work(&mut scratch[mine].lock().unwrap_or_else(PoisonError::into_inner));
}

/// A range of at most [`TILE`] Gaussians inside a block.
struct Tile {
    /// Index of the first Gaussian.
    first: usize,
    /// Index of the first Gaussian, counted from the block's start.
    offset: usize,
    real: usize,
    /// `real` rounded up to whole lanes.
    padded: usize,
}

impl Tile {
    fn lookups<'a>(&self, sites: &'a Sites, gamma: &'a [f32; TILE]) -> Lookups<'a> {
        let range = self.first..self.first + self.padded;
        Lookups {
            nodes: &sites.nodes[range.clone()],
            fractions: &sites.fractions[range],
            gamma: &gamma[..self.padded],
        }
    }
}

fn tiles(sites: &Sites, block: usize) -> impl Iterator<Item = Tile> {
    let count = BLOCK.min(sites.len() - block * BLOCK);
    (0..count).step_by(TILE).map(move |offset| {
        let real = TILE.min(count - offset);
        Tile { first: block * BLOCK + offset, offset, real, padded: real.div_ceil(LANES) * LANES }
    })
}

#[inline(always)]
fn gammas<S: Simd>(simd: S, guide: &[f32; 4], sites: &Sites, tile: &Tile, out: &mut [f32; TILE]) {
    for at in (0..tile.padded).step_by(LANES) {
        let i = tile.first + at;
        let [r, g, b] = &sites.signed_logs;
        let load = |plane: &[f32]| f32x16::from_slice(simd, &plane[i..i + LANES]);
        guide::gamma(simd, guide, [load(r), load(g), load(b)]).store_slice(&mut out[at..at + LANES]);
    }
}
