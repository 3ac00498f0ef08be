//! The field at the water: the same field, queried at the camera, grades the medium's colour; the transport
//! ratios are bounded.
//!
//! * Guide table: the decoder at the camera centre for 16 guide values uniform in `[-1, 1]`, minus its own
//!   mean over the 16 rows (R22); a row is `(exp(log-gain), bias)`.
//! * For each pixel, `γ(c_m)` interpolates the table linearly, and
//!   `c_m⁺ = gain ⊙ (c_m + δA c_m + b_g) + bias`, not clamped.
//! * `β⁺ = β exp(ln 4 · tanh u)`, with one `u` for backscatter and one for attenuation (R24), so ratios
//!   stay in (¼, 4).
//!
//! Approximation: the table is linear between its 16 rows, as the field itself is linear between its guide
//! nodes. Limit: for a camera outside the field's box, the water is that of the box's face.

use std::ops::Range;

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;
use use3d_capture::{Image, MediumMaps};
use use3d_numerics::math;

use crate::OUTPUTS;
use crate::field::{Field, Gradient, apply_affine};
use crate::guide::{self, locate, signed_log};
use crate::kernel::{Accumulator, Lookups, PackedField, TILE, TileOutputs};
use crate::sites::LANES;
use use3d_numerics::lanes::exp;

/// Number of rows of the guide table.
pub const ROWS: usize = 16;
/// The largest log-ratio of the transport coefficients, ln 4.
pub const LOG_RATIO_BOUND: f32 = 2.0 * std::f32::consts::LN_2;
/// Pixels per block of parallel work and fixed-order sums.
const BLOCK: usize = 4096;

/// The constant part of one view's water: the maps of the frozen medium, and the signed logs of its colour.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewWater {
    /// The frozen medium's maps.
    pub maps: MediumMaps,
    /// `h(c_m)` of every pixel, the input of the guide.
    pub signed_logs: Image,
}

impl ViewWater {
    /// Prepares the frozen medium's maps of a view.
    pub fn new(maps: MediumMaps) -> Self {
        let signed_logs = maps.color.map(signed_log);
        Self { maps, signed_logs }
    }

    /// Number of bytes held.
    pub fn bytes(&self) -> usize {
        12 * size_of::<f32>() * self.maps.color.pixels()
    }
}

/// A guide table: gain RGB, bias RGB per row.
pub type Table = [[f32; OUTPUTS]; ROWS];

/// Reusable state of the water's forward and backward passes.
#[derive(Debug)]
pub struct WaterPass {
    pub(crate) level: Level,
    packed: PackedField,
    raw: Box<TileOutputs>,
    table: Table,
    sums: Accumulator,
    partials: Vec<PixelSums>,
}

/// The sums of a block of pixels.
#[derive(Clone, Copy, Debug)]
struct PixelSums {
    table: [[f64; OUTPUTS]; ROWS],
    affine: [f64; 12],
    guide: [f64; 4],
    /// `Σ ∂L/∂β⁺ · β` for backscatter and attenuation.
    transport: [f64; 2],
}

const ZERO_SUMS: PixelSums =
    PixelSums { table: [[0.0; OUTPUTS]; ROWS], affine: [0.0; 12], guide: [0.0; 4], transport: [0.0; 2] };

impl Default for WaterPass {
    /// A pass on the best instruction set of this machine.
    fn default() -> Self {
        Self {
            level: Level::new(),
            packed: PackedField::default(),
            raw: Box::new([[0.0; TILE]; OUTPUTS]),
            table: [[0.0; OUTPUTS]; ROWS],
            sums: Accumulator::default(),
            partials: Vec::new(),
        }
    }
}

/// Guide values of the table's rows, `-1 + 2k/15`.
pub fn rows() -> [f32; ROWS] {
    std::array::from_fn(|k| (2.0 * k as f64 / (ROWS - 1) as f64 - 1.0) as f32)
}

/// The position part of the table's lookups, equal in all rows: lower nodes on x, y, z and fractions
/// towards the next.
pub fn camera_site(field: &Field, camera: [f32; 3]) -> ([u8; 3], [f32; 3]) {
    let at = field.bounds.normalise(camera).map(|u| locate(u, field.shape().resolution));
    (at.map(|(node, _)| node as u8), at.map(|(_, fraction)| fraction))
}

impl WaterPass {
    /// Computes the guide table at a camera centre, with log-gains and biases scaled by `strength` (1 in
    /// training).
    pub fn table(&mut self, field: &Field, camera: [f32; 3], strength: f32) -> Table {
        self.packed.pack(field);
        let (nodes, fractions) = camera_site(field, camera);
        let lookups = Lookups { nodes: &[nodes; ROWS], fractions: &[fractions; ROWS], gamma: &rows() };
        self.packed.forward(self.level, lookups, &mut self.raw);
        for o in 0..OUTPUTS {
            let column = &self.raw[o][..ROWS];
            let mean = (column.iter().map(|&v| f64::from(v)).sum::<f64>() / ROWS as f64) as f32;
            for (row, &v) in self.table.iter_mut().zip(column) {
                let centred = strength * (v - mean);
                row[o] = if o < 3 { exp(centred) } else { centred };
            }
        }
        self.table
    }

    /// Computes the enhanced maps of a view at `strength` in `[0, 1]`. The strength scales log-gain, bias,
    /// affine and log-ratios, so 0 gives exactly the frozen maps and 1 exactly the trained ones.
    pub fn forward(
        &mut self,
        field: &Field,
        camera: [f32; 3],
        water: &ViewWater,
        strength: f32,
        out: &mut MediumMaps,
    ) {
        let table = self.table(field, camera, strength);
        let guide = field.guide();
        let affine = field.affine().map(|row| row.map(|v| strength * v));
        let (w, h) = (water.maps.color.width(), water.maps.color.height());
        out.resize(w, h);
        out.formation = water.maps.formation;
        out.network.clone_from(&water.maps.network);
        let level = self.level;
        let logs = water.signed_logs.planes();
        let color = water.maps.color.planes();
        let n = w * h;
        let (red, rest) = out.color.data_mut().split_at_mut(n);
        let (green, blue) = rest.split_at_mut(n);
        red.par_chunks_mut(BLOCK)
            .zip(green.par_chunks_mut(BLOCK))
            .zip(blue.par_chunks_mut(BLOCK))
            .enumerate()
            .for_each(|(block, ((red, green), blue))| {
                let first = block * BLOCK;
                let pixels = first..first + red.len();
                let view =
                    Recolouring { guide: &guide, affine: &affine, table: &table, logs: &logs, color: &color };
                dispatch!(level, simd => view.recolor(simd, pixels, [red, green, blue]));
            });
        let [bs, attn] = ratios(field, strength);
        for (out, maps, ratio) in [
            (&mut out.backscatter, &water.maps.backscatter, bs),
            (&mut out.attenuation, &water.maps.attenuation, attn),
        ] {
            out.data_mut()
                .par_chunks_mut(BLOCK)
                .zip(maps.data().par_chunks(BLOCK))
                .for_each(|(o, m)| o.iter_mut().zip(m).for_each(|(o, m)| *o = m * ratio));
        }
    }

    /// Adds the gradient of everything on which the enhanced maps depend, from `∂L/∂` the three maps. The
    /// last [`WaterPass::forward`] must have been for this field, camera and water, at strength 1.
    pub fn backward(
        &mut self,
        field: &Field,
        camera: [f32; 3],
        water: &ViewWater,
        d_maps: &MediumMaps,
        gradient: &mut Gradient,
    ) {
        let n = water.maps.color.pixels();
        let (level, guide, affine, table) = (self.level, field.guide(), field.affine(), &self.table);
        let logs = water.signed_logs.planes();
        let (color, d_color) = (water.maps.color.planes(), d_maps.color.planes());
        self.partials.clear();
        self.partials.resize(n.div_ceil(BLOCK), ZERO_SUMS);
        self.partials.par_iter_mut().enumerate().for_each(|(block, sums)| {
            let first = block * BLOCK;
            let count = BLOCK.min(n - first);
            let view = Recolouring { guide: &guide, affine: &affine, table, logs: &logs, color: &color };
            dispatch!(level, simd => view.differentiate(simd, first..first + count, &d_color, sums));
            let pairs = [
                (&water.maps.backscatter, &d_maps.backscatter),
                (&water.maps.attenuation, &d_maps.attenuation),
            ];
            for (total, (beta, d)) in sums.transport.iter_mut().zip(pairs) {
                for c in 0..3 {
                    let (beta, d) = (&beta.plane(c)[first..first + count], &d.plane(c)[first..first + count]);
                    *total += beta.iter().zip(d).map(|(b, d)| f64::from(b * d)).sum::<f64>();
                }
            }
        });
        let sums = total(&self.partials);
        let shape = field.shape();
        gradient.add(shape.affine(), &sums.affine);
        gradient.add(shape.guide(), &sums.guide);
        let at = shape.transport().start;
        for (k, (u, ratio)) in field.transport().into_iter().zip(ratios(field, 1.0)).enumerate() {
            let tanh = math::tanh(f64::from(u));
            let slope = f64::from(ratio) * f64::from(LOG_RATIO_BOUND) * (1.0 - tanh * tanh);
            gradient.values[at + k] += sums.transport[k] * slope;
        }
        self.table_backward(field, camera, &sums.table, gradient);
    }

    /// Like [`WaterPass::backward`], for `∂L/∂table` alone.
    fn table_backward(
        &mut self,
        field: &Field,
        camera: [f32; 3],
        d_table: &[[f64; OUTPUTS]; ROWS],
        gradient: &mut Gradient,
    ) {
        for o in 0..OUTPUTS {
            let d: [f64; ROWS] = std::array::from_fn(|k| {
                d_table[k][o] * if o < 3 { f64::from(self.table[k][o]) } else { 1.0 }
            });
            let mean = d.iter().sum::<f64>() / ROWS as f64;
            for (raw, d) in self.raw[o].iter_mut().zip(d) {
                *raw = (d - mean) as f32;
            }
        }
        let (nodes, fractions) = camera_site(field, camera);
        let lookups = Lookups { nodes: &[nodes; ROWS], fractions: &[fractions; ROWS], gamma: &rows() };
        self.sums.clear(&self.packed);
        let mut unused = [0.0; TILE];
        self.packed.backward(self.level, lookups, &self.raw, &mut self.sums, &mut unused);
        self.sums.add_to(&self.packed, &mut gradient.values);
    }
}

/// The transport ratios for β_bs and β_attn, `exp(strength ln 4 tanh u)`.
pub fn ratios(field: &Field, strength: f32) -> [f32; 2] {
    field.transport().map(|u| math::exp(strength * LOG_RATIO_BOUND * math::tanh(u)))
}

/// The inputs of the colours of a view's pixels.
struct Recolouring<'a> {
    guide: &'a [f32; 4],
    affine: &'a [[f32; 4]; 3],
    table: &'a Table,
    logs: &'a [&'a [f32]; 3],
    color: &'a [&'a [f32]; 3],
}

impl Recolouring<'_> {
    /// `γ` of up to sixteen pixels, starting at `at`.
    #[inline(always)]
    fn gammas<S: Simd>(&self, simd: S, at: usize, count: usize) -> [f32; LANES] {
        let h = self.logs.map(|plane| {
            let mut lanes = [0.0f32; LANES];
            lanes[..count].copy_from_slice(&plane[at..at + count]);
            f32x16::from_slice(simd, &lanes)
        });
        let mut out = [0.0; LANES];
        guide::gamma(simd, self.guide, h).store_slice(&mut out);
        out
    }

    /// Computes `c_m⁺` of a range of pixels.
    #[inline(always)]
    #[expect(clippy::needless_pass_by_value, reason = "the planes are lent for this run only")]
    fn recolor<S: Simd>(&self, simd: S, pixels: Range<usize>, out: [&mut [f32]; 3]) {
        for at in pixels.clone().step_by(LANES) {
            let count = LANES.min(pixels.end - at);
            let gammas = self.gammas(simd, at, count);
            for k in 0..count {
                let graded = apply_affine(self.affine, self.color.map(|plane| plane[at + k]));
                let (row, t) = locate(gammas[k], ROWS);
                let (low, high) = (&self.table[row], &self.table[row + 1]);
                for o in 0..3 {
                    let gain = low[o] + t * (high[o] - low[o]);
                    let bias = low[3 + o] + t * (high[3 + o] - low[3 + o]);
                    out[o][at + k - pixels.start] = gain.mul_add(graded[o], bias);
                }
            }
        }
    }

    /// Adds the gradients of a range of pixels to `sums`, except those of the transport.
    #[inline(always)]
    fn differentiate<S: Simd>(
        &self,
        simd: S,
        pixels: Range<usize>,
        d_color: &[&[f32]; 3],
        sums: &mut PixelSums,
    ) {
        for at in pixels.clone().step_by(LANES) {
            let count = LANES.min(pixels.end - at);
            let gammas = self.gammas(simd, at, count);
            for k in 0..count {
                let p = at + k;
                let d = d_color.map(|plane| plane[p]);
                if d == [0.0; 3] {
                    continue;
                }
                let c = self.color.map(|plane| plane[p]);
                let graded = apply_affine(self.affine, c);
                let gamma = gammas[k];
                let (row, t) = locate(gamma, ROWS);
                let (low, high) = (&self.table[row], &self.table[row + 1]);
                let mut rise = 0.0;
                for o in 0..3 {
                    let gain = low[o] + t * (high[o] - low[o]);
                    let d_gain = d[o] * graded[o];
                    rise += d_gain * (high[o] - low[o]) + d[o] * (high[3 + o] - low[3 + o]);
                    for (q, d) in [(o, d_gain), (3 + o, d[o])] {
                        sums.table[row][q] += f64::from((1.0 - t) * d);
                        sums.table[row + 1][q] += f64::from(t * d);
                    }
                    let through = f64::from(d[o] * gain);
                    for (a, x) in sums.affine[4 * o..4 * o + 4].iter_mut().zip([c[0], c[1], c[2], 1.0]) {
                        *a += through * f64::from(x);
                    }
                }
                let d_gamma = rise * (0.5 * (ROWS - 1) as f32);
                let d_pre = f64::from(d_gamma * (1.0 - gamma * gamma));
                for (g, plane) in sums.guide.iter_mut().zip(self.logs) {
                    *g += d_pre * f64::from(plane[p]);
                }
                sums.guide[3] += d_pre;
            }
        }
    }
}

fn total(blocks: &[PixelSums]) -> PixelSums {
    let mut out = ZERO_SUMS;
    for block in blocks {
        let pairs = out.table.as_flattened_mut().iter_mut().zip(block.table.as_flattened());
        let rest = out.affine.iter_mut().zip(&block.affine);
        let guide = out.guide.iter_mut().zip(&block.guide);
        let transport = out.transport.iter_mut().zip(&block.transport);
        pairs.chain(rest).chain(guide).chain(transport).for_each(|(t, s)| *t += s);
    }
    out
}
