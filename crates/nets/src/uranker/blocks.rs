//! The parts of URanker's blocks: factorised attention with convolutional relative positions, and the
//! perceptron.
//!
//! Factorised attention is linear in the number of tokens: `A = d^−½ · q (softmax(k)ᵀ v)`, with the softmax
//! over the tokens. On the patches, `q ⊙ (w ∗ v)` is added, with one depthwise convolution for each group of
//! heads (3×3 for two heads, 5×5 and 7×7 for three each).

use rayon::prelude::*;
use use3d_numerics::lanes::exp;

use super::{EPSILON, EXTRA, Tokens, patches_of};
use crate::engine::activation::Activation;
use crate::engine::convolution::{Convolution, Depthwise};
use crate::engine::normalise::{self, Affine};
use crate::engine::planes::Planes;
use crate::engine::product::{Finish, Packed, fill_from_rows, product};
use crate::error::NetError;
use crate::weights::{Layers, Weights};

const HEADS: usize = 8;
/// Heads and kernel of each relative-position convolution.
const GROUPS: [(usize, usize); 3] = [(2, 3), (3, 5), (3, 7)];

/// A depthwise convolution added to the patches; it encodes the positions of the tokens.
#[derive(Clone, Debug)]
pub(crate) struct PositionEncoding(Depthwise);

impl PositionEncoding {
    pub(crate) fn read(stage: usize, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        depthwise(&format!("cpe{stage}.proj"), width, 3, weights).map(Self)
    }

    pub(crate) fn apply(&self, tokens: &mut Tokens) {
        let patches = tokens.patches();
        let n = patches.area();
        let mut encoded = vec![0.0; patches.data.len()];
        self.0.forward(&patches.data, tokens.height, tokens.width, &mut encoded);
        for (row, encoded) in tokens.planes.data.chunks_exact_mut(n + EXTRA).zip(encoded.chunks_exact(n)) {
            row[EXTRA..].iter_mut().zip(encoded).for_each(|(t, e)| *t += e);
        }
    }
}

/// The convolutions of the relative positions of one stage.
#[derive(Clone, Debug)]
pub(crate) struct RelativePosition(Vec<Depthwise>);

impl RelativePosition {
    pub(crate) fn read(stage: usize, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let groups = GROUPS.iter().enumerate().map(|(i, (heads, kernel))| {
            depthwise(&format!("crpe{stage}.conv_list.{i}"), heads * width / HEADS, *kernel, weights)
        });
        groups.collect::<Result<_, _>>().map(Self)
    }

    /// Adds `q ⊙ (w ∗ v)` to the patches of `out`.
    fn add_to(&self, q: &[f32], v: &Planes, out: &mut Planes) {
        let n = v.area();
        let mut first = 0;
        for group in &self.0 {
            let end = first + group.channels();
            let mut filtered = vec![0.0; group.channels() * n];
            group.forward(&v.data[first * n..end * n], v.height, v.width, &mut filtered);
            let stride = n + EXTRA;
            let rows = first * stride..end * stride;
            let pairs = out.data[rows.clone()].chunks_exact_mut(stride).zip(q[rows].chunks_exact(stride));
            for ((out, q), f) in pairs.zip(filtered.chunks_exact(n)) {
                for i in 0..n {
                    out[EXTRA + i] += q[EXTRA + i] * f[i];
                }
            }
            first = end;
        }
    }
}

fn depthwise(
    name: &str,
    channels: usize,
    kernel: usize,
    weights: &mut dyn Weights,
) -> Result<Depthwise, NetError> {
    let (values, bias) = weights.parameters(name, &[channels, 1, kernel, kernel])?;
    Ok(Depthwise::new(kernel, values, bias))
}

/// Factorised attention.
#[derive(Clone, Debug)]
pub(crate) struct Attention {
    qkv: Convolution,
    projection: Convolution,
}

impl Attention {
    pub(crate) fn read(name: &str, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        Ok(Self {
            qkv: weights.linear(&format!("{name}.qkv"), 3 * width, width)?,
            projection: weights.linear(&format!("{name}.proj"), width, width)?,
        })
    }

    pub(crate) fn forward(&self, tokens: &Tokens, relative: &RelativePosition) -> Planes {
        let (width, n) = (tokens.planes.channels, tokens.planes.area());
        let mut qkv = self.qkv.forward(&tokens.planes, Activation::Identity);
        let (q, kv) = qkv.data.split_at_mut(width * n);
        let (k, v) = kv.split_at_mut(width * n);
        k.par_chunks_mut(n).for_each(softmax);
        let mut out = factorised(q, k, v, width, n);
        relative.add_to(q, &patches_of(v, width, tokens.height, tokens.width), &mut out);
        drop(qkv);
        self.projection.forward(&out, Activation::Identity)
    }
}

/// The softmax of one row, in place.
fn softmax(row: &mut [f32]) {
    let largest = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0f64;
    for v in row.iter_mut() {
        *v = exp(*v - largest);
        sum += f64::from(*v);
    }
    let scale = (1.0 / sum) as f32;
    row.iter_mut().for_each(|v| *v *= scale);
}

/// Computes `d^−½ · q (kᵀ v)`, head by head.
fn factorised(q: &[f32], k: &[f32], v: &[f32], width: usize, n: usize) -> Planes {
    const BLOCK: usize = 1024;
    let depth = width / HEADS;
    let scale = 1.0 / (depth as f64).sqrt();
    let mut out = Planes::new(width, 1, n);
    for (head, out) in out.data.chunks_exact_mut(depth * n).enumerate() {
        let part = head * depth * n..(head + 1) * depth * n;
        let (q, k, v) = (&q[part.clone()], &k[part.clone()], &v[part]);
        // factor[d][c] = Σ_t k[c][t] v[d][t], in blocks of tokens whose sums are added in f64.
        let mut factor = vec![0.0f64; depth * depth];
        factor.par_chunks_mut(depth).zip(v.par_chunks(n)).for_each(|(row, v)| {
            for start in (0..n).step_by(BLOCK) {
                let v = &v[start..(start + BLOCK).min(n)];
                for (c, f) in row.iter_mut().enumerate() {
                    *f += f64::from(dot(&k[c * n + start..][..v.len()], v));
                }
            }
        });
        let packed = Packed::new(depth, depth, |d, c| (factor[d * depth + c] * scale) as f32);
        product(&packed, n, Finish::default(), out, |first, panel| fill_from_rows(q, n, first, panel));
    }
    out
}

/// The product of two vectors, in 16 interleaved partial sums.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 16];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    for (a, b) in a.iter().zip(b) {
        for i in 0..16 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

/// Linear, GELU, linear; the hidden layer is four times as wide.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    hidden: Convolution,
    output: Convolution,
}

impl Mlp {
    pub(crate) fn read(name: &str, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        Ok(Self {
            hidden: weights.linear(&format!("{name}.fc1"), 4 * width, width)?,
            output: weights.linear(&format!("{name}.fc2"), width, 4 * width)?,
        })
    }

    pub(crate) fn add_to(&self, x: &Planes, out: &mut Planes) {
        self.output.add_to(&self.hidden.forward(x, Activation::Gelu), out);
    }
}

/// `x += attention(LN(x)); x += MLP(LN(x))`.
#[derive(Clone, Debug)]
pub(crate) struct SerialBlock {
    norm1: Affine,
    attention: Attention,
    norm2: Affine,
    mlp: Mlp,
}

impl SerialBlock {
    pub(crate) fn read(name: &str, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        Ok(Self {
            norm1: weights.affine(&format!("{name}.norm1"), width)?,
            attention: Attention::read(&format!("{name}.factoratt_crpe"), width, weights)?,
            norm2: weights.affine(&format!("{name}.norm2"), width)?,
            mlp: Mlp::read(&format!("{name}.mlp"), width, weights)?,
        })
    }

    pub(crate) fn forward(&self, tokens: &mut Tokens, relative: &RelativePosition) {
        let normed = tokens.with(normalise::layer(&tokens.planes, EPSILON, &self.norm1));
        tokens.planes.add(&self.attention.forward(&normed, relative));
        let normed = normalise::layer(&tokens.planes, EPSILON, &self.norm2);
        self.mlp.add_to(&normed, &mut tokens.planes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;

    #[test]
    fn factorised_attention_equals_its_definition() {
        let (width, n, depth) = (16, 37, 2);
        let [q, k, v] = [1, 2, 3].map(|s| noise(s, width * n));
        let out = factorised(&q, &k, &v, width, n);
        for c in 0..width {
            let head = c / depth * depth;
            for t in 0..n {
                let expected: f64 = (head..head + depth)
                    .map(|j| {
                        let factor: f64 =
                            (0..n).map(|s| f64::from(k[j * n + s]) * f64::from(v[c * n + s])).sum();
                        f64::from(q[j * n + t]) * factor / 2f64.sqrt()
                    })
                    .sum();
                assert!((f64::from(out.plane(c)[t]) - expected).abs() < 1e-5);
            }
        }
    }
}
