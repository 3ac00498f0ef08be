//! A small network of the viewing direction: the medium of WaterSplatting, for comparison.
//!
//! ```text
//! h₁ = σ(W₁ Y(ω) + b₁)      h₂ = σ(W₂ h₁ + b₂)      raw = W₃ h₂ + b₃
//! c_m = σ(raw)              β = softplus(raw)
//! ```
//!
//! Here `Y` are the 16 spherical harmonics of the ray's direction; the network has two hidden layers of 128
//! sigmoids and nine outputs. The water is the same everywhere: it depends on the direction and not on the
//! position. The network is evaluated 64 pixels at a time, as products of matrices. The backward pass
//! computes the hidden layers again, so that 256 numbers per pixel need not be stored.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;
use use3d_capture::{Camera, Lattice, MediumMaps};
use use3d_numerics::functions;
use use3d_numerics::product::{self, tile};
use use3d_numerics::random::{Purpose, Stream};
use use3d_numerics::rows::{self, LANES};
use use3d_numerics::spherical_harmonics::basis_lanes;

use crate::directional::{Rays, STRIP, planes, strips};
use crate::medium::{Medium, MediumStart};
use crate::tensors::{self, Put, Tensors};
use crate::{MediumError, Role};

/// Numbers of inputs, hidden units and outputs (the kernels pad outputs to a multiple of [`ROWS`]).
const INPUTS: usize = 16;
const HIDDEN: usize = 128;
const OUTPUTS: usize = 9;
const PADDED: usize = 12;
/// Pixels per block.
const BLOCK: usize = 4 * LANES;
/// Number of strips whose gradients one task sums; it bounds the memory for partial sums.
const STRIPS_PER_TASK: usize = 8;

/// Weights of the network, row-major `[out][in]`.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumMlp {
    /// `[128][16]`, `[128][128]`, `[9][128]`.
    pub weights: [Vec<f32>; 3],
    /// `[128]`, `[128]`, `[9]`.
    pub biases: [Vec<f32>; 3],
}

/// Inputs and outputs per layer.
const SHAPES: [(usize, usize); 3] = [(INPUTS, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, OUTPUTS)];

impl MediumMlp {
    /// Uniform Xavier weights drawn from `seed`, zero biases.
    pub fn new(seed: u64) -> Self {
        let draw = |layer: usize| {
            let (inputs, outputs) = SHAPES[layer];
            let stream = Stream::new(seed, Purpose::new("medium network weights"), layer as u64);
            let bound = (6.0 / (inputs + outputs) as f64).sqrt();
            (0..inputs * outputs).map(|i| ((2.0 * stream.uniform(i as u64) - 1.0) * bound) as f32).collect()
        };
        Self { weights: [draw(0), draw(1), draw(2)], biases: SHAPES.map(|(_, outputs)| vec![0.0; outputs]) }
    }

    /// Zeros for the sums of one task, with the last layer padded.
    fn padded_zeros() -> Self {
        let outputs = [HIDDEN, HIDDEN, PADDED];
        Self {
            weights: std::array::from_fn(|l| vec![0.0; SHAPES[l].0 * outputs[l]]),
            biases: outputs.map(|n| vec![0.0; n]),
        }
    }

    /// Weights and biases of a layer.
    #[inline(always)]
    fn layer(&mut self, layer: usize) -> (&mut [f32], &mut [f32]) {
        (&mut self.weights[layer], &mut self.biases[layer])
    }

    /// Adds `other`, whose padding is left out if this network has none.
    fn add(&mut self, other: &Self) {
        let sums = self.weights.iter_mut().chain(&mut self.biases);
        for (sum, more) in sums.zip(other.weights.iter().chain(&other.biases)) {
            for (s, m) in sum.iter_mut().zip(more) {
                *s += m;
            }
        }
    }
}

impl Medium for MediumMlp {
    fn start(start: &MediumStart) -> Result<Self, MediumError> {
        Ok(Self::new(start.seed))
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, _degree: usize, out: &mut MediumMaps) {
        out.resize(lattice.width(), lattice.height());
        let rays = Rays::new(camera, lattice);
        let level = Level::new();
        let network = Padded::new(self);
        strips(out).into_par_iter().enumerate().for_each_init(PixelBlock::new, |block, (s, mut strip)| {
            let width = rays.width();
            for row in 0..strip[0].len() / width {
                for start in (0..width).step_by(BLOCK) {
                    dispatch!(level, simd => {
                        network.evaluate(simd, &rays, s * STRIP + row, start, block);
                        for v in (0..(width - start).min(BLOCK)).step_by(LANES) {
                            for q in 0..9 {
                                let raw = f32x16::from_slice(simd, &block.raw[q * BLOCK + v..][..LANES]);
                                let value = if q < 3 { functions::sigmoid(simd, raw) } else { functions::softplus(simd, raw) };
                                rows::store(value, &mut strip[q][row * width..][..width], start + v);
                            }
                        }
                    });
                }
            }
        });
    }

    fn backward(
        &self,
        camera: &Camera,
        lattice: &Lattice,
        _degree: usize,
        maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    ) {
        let rays = Rays::new(camera, lattice);
        let level = Level::new();
        let network = Padded::new(self);
        let (maps, d_maps) = (planes(maps), planes(d_maps));
        let rows_per_task = STRIP * STRIPS_PER_TASK;
        let partial: Vec<Self> = (0..lattice.height().div_ceil(rows_per_task))
            .into_par_iter()
            .map(|task| {
                let mut sums = Self::padded_zeros();
                let mut block = PixelBlock::new();
                let width = rays.width();
                for row in task * rows_per_task..((task + 1) * rows_per_task).min(lattice.height()) {
                    for start in (0..width).step_by(BLOCK) {
                        let views = (
                            maps.map(|m| &m[row * width..][..width]),
                            d_maps.map(|m| &m[row * width..][..width]),
                        );
                        dispatch!(level, simd => {
                            network.evaluate(simd, &rays, row, start, &mut block);
                            network.backward_of_block(simd, start, &views.0, &views.1, &mut block, &mut sums);
                        });
                    }
                }
                sums
            })
            .collect();
        let mut total = Self::padded_zeros();
        for task in &partial {
            total.add(task);
        }
        gradient.add(&total);
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        let layers = self.weights.iter().zip(&self.biases);
        layers.flat_map(|(w, b)| [(Role::Network, w.as_slice()), (Role::Network, b.as_slice())]).collect()
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        let layers = self.weights.iter_mut().zip(self.biases.iter_mut());
        layers
            .flat_map(|(w, b)| [(Role::Network, w.as_mut_slice()), (Role::Network, b.as_mut_slice())])
            .collect()
    }

    fn write(&self, put: Put<'_>) {
        for (layer, &(inputs, outputs)) in SHAPES.iter().enumerate() {
            put(&format!("layer{layer}.weight"), &[outputs, inputs], &self.weights[layer]);
            put(&format!("layer{layer}.bias"), &[outputs], &self.biases[layer]);
        }
    }

    fn read(_top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let mut network = Self::new(0);
        for (layer, &(inputs, outputs)) in SHAPES.iter().enumerate() {
            let weight = tensors::get(tensors, &format!("layer{layer}.weight"), &[outputs, inputs])?;
            network.weights[layer] = weight.to_vec();
            network.biases[layer] =
                tensors::get(tensors, &format!("layer{layer}.bias"), &[outputs])?.to_vec();
        }
        Ok(network)
    }
}

/// The network with its last layer padded, and the transposed weights that the backward pass uses.
struct Padded {
    weights: [Vec<f32>; 3],
    biases: [Vec<f32>; 3],
    transposed: [Vec<f32>; 3],
}

impl Padded {
    fn new(network: &MediumMlp) -> Self {
        let mut weights = network.weights.clone();
        let mut biases = network.biases.clone();
        weights[2].resize(PADDED * HIDDEN, 0.0);
        biases[2].resize(PADDED, 0.0);
        let transposed = std::array::from_fn(|layer| {
            let inputs = SHAPES[layer].0;
            let outputs = biases[layer].len();
            (0..inputs * outputs).map(|i| weights[layer][(i % outputs) * inputs + i / outputs]).collect()
        });
        Self { weights, biases, transposed }
    }

    /// Computes hidden layers and raw outputs of one block of pixels.
    #[inline(always)]
    fn evaluate<S: Simd>(&self, simd: S, rays: &Rays, row: usize, start: usize, block: &mut PixelBlock) {
        for v in (0..BLOCK).step_by(LANES) {
            // Beyond the row's end the direction does not matter, because its derivative is zero.
            let i = (start + v).min(rays.width() - 1);
            let [x, y, z] = rays.directions(simd, i, row);
            for (b, value) in basis_lanes(simd, 3, x, y, z).iter().enumerate() {
                value.store_slice(&mut block.input[b * BLOCK + v..][..LANES]);
            }
        }
        product(simd, &self.weights[0], Some(&self.biases[0]), &block.input, &mut block.first);
        activate(simd, &mut block.first);
        product(simd, &self.weights[1], Some(&self.biases[1]), &block.first, &mut block.second);
        activate(simd, &mut block.second);
        product(simd, &self.weights[2], Some(&self.biases[2]), &block.second, &mut block.raw);
    }

    /// Adds the gradients of one block to `sums`; `block` holds the results of [`Padded::evaluate`].
    #[inline(always)]
    fn backward_of_block<S: Simd>(
        &self,
        simd: S,
        start: usize,
        maps: &[&[f32]; 9],
        d_maps: &[&[f32]; 9],
        block: &mut PixelBlock,
        sums: &mut MediumMlp,
    ) {
        let zero = f32x16::splat(simd, 0.0);
        for v in (0..BLOCK).step_by(LANES) {
            for q in 0..PADDED {
                let mut gradient = zero;
                if q < OUTPUTS && start + v < maps[q].len() {
                    let value = rows::load(simd, maps[q], start + v);
                    let d_map = rows::load(simd, d_maps[q], start + v);
                    let slope = if q < 3 {
                        value * (f32x16::splat(simd, 1.0) - value)
                    } else {
                        functions::softplus_slope(simd, value)
                    };
                    gradient = d_map * slope;
                }
                gradient.store_slice(&mut block.raw[q * BLOCK + v..][..LANES]);
            }
        }
        accumulate(simd, &block.raw, &block.second, &mut block.turned, sums.layer(2));
        product(simd, &self.transposed[2], None, &block.raw, &mut block.d_hidden);
        through_activation(simd, &block.second, &mut block.d_hidden);
        accumulate(simd, &block.d_hidden, &block.first, &mut block.turned, sums.layer(1));
        product(simd, &self.transposed[1], None, &block.d_hidden, &mut block.second);
        through_activation(simd, &block.first, &mut block.second);
        accumulate(simd, &block.second, &block.input, &mut block.turned, sums.layer(0));
    }
}

/// Values of one block, `[unit][pixel]`.
struct PixelBlock {
    input: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    raw: Vec<f32>,
    d_hidden: Vec<f32>,
    /// A layer's input as `[pixel][unit]`.
    turned: Vec<f32>,
}

impl PixelBlock {
    fn new() -> Self {
        let zeros = |units: usize| vec![0.0; units * BLOCK];
        Self {
            input: zeros(INPUTS),
            first: zeros(HIDDEN),
            second: zeros(HIDDEN),
            raw: zeros(PADDED),
            d_hidden: zeros(HIDDEN),
            turned: zeros(HIDDEN),
        }
    }
}

/// Number of outputs whose sums one pass of a matrix product holds in registers: as pairs of vectors where
/// registers hold a whole vector, otherwise as single vectors.
const ROWS: usize = 4;

/// `out = weights · input (+ bias)`: `[out][in] × [in][BLOCK]`.
#[inline(always)]
fn product<S: Simd>(simd: S, weights: &[f32], bias: Option<&[f32]>, input: &[f32], out: &mut [f32]) {
    if product::is_wide::<S>() {
        product_tiles::<S, 2>(simd, weights, bias, input, out);
    } else {
        product_tiles::<S, 1>(simd, weights, bias, input, out);
    }
}

#[inline(always)]
fn product_tiles<S: Simd, const V: usize>(
    simd: S,
    weights: &[f32],
    bias: Option<&[f32]>,
    input: &[f32],
    out: &mut [f32],
) {
    let inputs = input.len() / BLOCK;
    // The outer loop runs over pixels: their columns of the input stay in the first-level cache while the
    // weights stream through.
    for start in (0..BLOCK).step_by(V * LANES) {
        for (group, rows) in out.chunks_exact_mut(ROWS * BLOCK).enumerate() {
            let mut sums = [[f32x16::splat(simd, 0.0); V]; ROWS];
            if let Some(bias) = bias {
                for r in 0..ROWS {
                    sums[r] = [f32x16::splat(simd, bias[group * ROWS + r]); V];
                }
            }
            let weights = &weights[group * ROWS * inputs..][..ROWS * inputs];
            tile(
                simd,
                &product::Rows::<ROWS>::new(weights, inputs, inputs),
                (input, BLOCK),
                start,
                &mut sums,
            );
            for r in 0..ROWS {
                for v in 0..V {
                    sums[r][v].store_slice(&mut rows[r * BLOCK + start + v * LANES..][..LANES]);
                }
            }
        }
    }
}

/// `weights += d_out · inputᵀ`, `bias += Σ d_out`, over one block of pixels. The input is first transposed
/// to `[pixel][in]`, so that vectors run along the inputs and no sum crosses lanes.
#[inline(always)]
fn accumulate<S: Simd>(
    simd: S,
    d_out: &[f32],
    input: &[f32],
    turned: &mut [f32],
    (weights, bias): (&mut [f32], &mut [f32]),
) {
    let inputs = input.len() / BLOCK;
    let turned = &mut turned[..input.len()];
    for (p, pixel) in turned.chunks_exact_mut(inputs).enumerate() {
        for (unit, value) in pixel.iter_mut().enumerate() {
            *value = input[unit * BLOCK + p];
        }
    }
    // The first layer has only one vector of inputs.
    if product::is_wide::<S>() && inputs > LANES {
        accumulate_tiles::<S, 2>(simd, d_out, turned, inputs, weights);
    } else {
        accumulate_tiles::<S, 1>(simd, d_out, turned, inputs, weights);
    }
    for (bias, d_out) in bias.iter_mut().zip(d_out.chunks_exact(BLOCK)) {
        let mut sum = f32x16::splat(simd, 0.0);
        for v in d_out.chunks_exact(LANES) {
            sum += f32x16::from_slice(simd, v);
        }
        *bias += sum.reduce_sum();
    }
}

#[inline(always)]
fn accumulate_tiles<S: Simd, const V: usize>(
    simd: S,
    d_out: &[f32],
    turned: &[f32],
    inputs: usize,
    weights: &mut [f32],
) {
    for start in (0..inputs).step_by(V * LANES) {
        let outputs = d_out.chunks_exact(ROWS * BLOCK).zip(weights.chunks_exact_mut(ROWS * inputs));
        for (d_out, weights) in outputs {
            let mut sums = [[f32x16::splat(simd, 0.0); V]; ROWS];
            tile(simd, &product::Rows::<ROWS>::new(d_out, BLOCK, BLOCK), (turned, inputs), start, &mut sums);
            for r in 0..ROWS {
                for v in 0..V {
                    let out = &mut weights[r * inputs + start + v * LANES..][..LANES];
                    (f32x16::from_slice(simd, out) + sums[r][v]).store_slice(out);
                }
            }
        }
    }
}

#[inline(always)]
fn activate<S: Simd>(simd: S, values: &mut [f32]) {
    for chunk in values.chunks_exact_mut(LANES) {
        functions::sigmoid(simd, f32x16::from_slice(simd, chunk)).store_slice(chunk);
    }
}

/// `d_out *= h (1 - h)`.
#[inline(always)]
fn through_activation<S: Simd>(simd: S, hidden: &[f32], d_out: &mut [f32]) {
    for (chunk, h) in d_out.chunks_exact_mut(LANES).zip(hidden.chunks_exact(LANES)) {
        let h = f32x16::from_slice(simd, h);
        let slope = h * (f32x16::splat(simd, 1.0) - h);
        (f32x16::from_slice(simd, chunk) * slope).store_slice(chunk);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `start + Σ_k left[k] right(k)`, in the tiles' order.
    fn plain(left: &[f32], right: impl Fn(usize) -> f32, start: f32) -> f32 {
        left.iter().enumerate().fold(start, |sum, (k, &l)| right(k).mul_add(l, sum))
    }

    /// Compares tiles of one and of two vectors (a processor uses only one of the two kinds): they have the
    /// same bits, and agree with plain loops.
    #[test]
    fn tiles_of_either_width_are_plain_products() {
        let close = |found: f32, expected: f32, what: &str, j: usize, i: usize| {
            assert!((found - expected).abs() < 1e-4, "{what} {j}, {i}: {found} for {expected}");
        };
        let stream = Stream::new(7, Purpose::new("products"), 0);
        let draw = |from: usize, n: usize| -> Vec<f32> {
            (0..n).map(|i| stream.normal((from + i) as u64) as f32).collect()
        };
        let weights = draw(0, PADDED * HIDDEN);
        let bias = draw(10_000, PADDED);
        let input = draw(20_000, HIDDEN * BLOCK);
        let d_out = draw(40_000, PADDED * BLOCK);
        let turned: Vec<f32> = (0..HIDDEN * BLOCK).map(|i| input[i % HIDDEN * BLOCK + i / HIDDEN]).collect();

        let mut products = [vec![0.0; PADDED * BLOCK], vec![0.0; PADDED * BLOCK]];
        let mut sums = [weights.clone(), weights.clone(), weights.clone()];
        let mut bias_sums = bias.clone();
        let [one, two] = &mut products;
        let [sums_one, sums_two, sums_turned] = &mut sums;
        dispatch!(Level::new(), simd => {
            product_tiles::<_, 1>(simd, &weights, Some(&bias), &input, one);
            product_tiles::<_, 2>(simd, &weights, Some(&bias), &input, two);
            accumulate_tiles::<_, 1>(simd, &d_out, &turned, HIDDEN, sums_one);
            accumulate_tiles::<_, 2>(simd, &d_out, &turned, HIDDEN, sums_two);
            accumulate(simd, &d_out, &input, &mut vec![0.0; HIDDEN * BLOCK], (sums_turned, &mut bias_sums));
        });
        for j in 0..PADDED {
            for p in 0..BLOCK {
                let expected = plain(&weights[j * HIDDEN..][..HIDDEN], |k| input[k * BLOCK + p], bias[j]);
                close(one[j * BLOCK + p], expected, "output", j, p);
            }
            let d_row = &d_out[j * BLOCK..][..BLOCK];
            for k in 0..HIDDEN {
                let at = j * HIDDEN + k;
                let expected = weights[at] + plain(d_row, |p| input[k * BLOCK + p], 0.0);
                close(sums_one[at], expected, "weight", j, k);
            }
            let expected = bias[j] + d_row.iter().sum::<f32>();
            close(bias_sums[j], expected, "bias", j, 0);
        }
        assert!(one == two && sums_one == sums_two && sums_one == sums_turned);
    }
}
