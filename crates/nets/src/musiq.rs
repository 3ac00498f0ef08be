//! MUSIQ: image quality without reference, by a transformer on patches of several sizes of the picture.
//!
//! Tokens are the 32 × 32 patches of the picture at long sides of 224 and 384 (bicubic in both directions)
//! and at its own size, with an embedding for the position on a 10 × 10 grid and one for the scale. A small
//! residual network turns each patch into 384 numbers. 14 blocks of a transformer follow. The score is a
//! linear map of the class token, about 0 to 100 for the KonIQ weights. Ke et al., "MUSIQ: multi-scale image
//! quality transformer", ICCV 2021, in the form of the torch port of pyiqa: file
//! `musiq_koniq_ckpt-e95806b9.pth`.
//!
//! The two scaled pictures always give 49 and 144 tokens; missing ones are filled up with masked tokens.

use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::math;

use crate::engine::activation::{self, Activation};
use crate::engine::attention::attention;
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::normalise::{self, Affine};
use crate::engine::planes::Planes;
use crate::engine::pool;
use crate::engine::product::{Finish, LANES, Packed, product};
use crate::engine::resample::{Rule, resize};
use crate::error::NetError;
use crate::images;
use crate::weights::{Layers, Weights};

const NAME: &str = "MUSIQ";
const PATCH: usize = 32;
const GRID: usize = 10;
const WIDTH: usize = 384;
const HEADS: usize = 6;
const BLOCKS: usize = 14;
/// Long side and number of tokens of the scaled pictures.
const SCALES: [(usize, usize); 2] = [(224, 49), (384, 144)];
/// Features of a patch: 256 channels on an 8 × 8 grid.
const FEATURES: usize = 256 * 64;

/// The network with its weights.
#[derive(Clone, Debug)]
pub struct Musiq {
    patches: PatchNet,
    embedding: Packed,
    embedding_bias: Vec<f32>,
    class_token: Vec<f32>,
    positions: Vec<f32>,
    scales: Vec<f32>,
    blocks: Vec<EncoderBlock>,
    norm: Affine,
    head: Convolution,
}

/// The residual network on single patches.
#[derive(Clone, Debug)]
struct PatchNet {
    root: Convolution,
    root_norm: Affine,
    /// 1×1, 3×3, 1×1 and the shortcut, each with its group norm.
    unit: [(Convolution, Affine); 4],
}

#[derive(Clone, Debug)]
struct EncoderBlock {
    norm1: Affine,
    /// Query, key, value.
    qkv: [Convolution; 3],
    output: Convolution,
    norm2: Affine,
    mlp: [Convolution; 2],
}

/// One patch: 3 × 32 × 32 values, its position, its scale, and a flag that is false for a filler.
#[derive(Clone, Debug)]
struct Token {
    patch: Planes,
    position: usize,
    scale: usize,
    valid: bool,
}

impl Musiq {
    /// Reads the network, with tensors by the names of the torch port.
    pub fn from_weights(weights: &mut dyn Weights) -> Result<Self, NetError> {
        let patches = PatchNet::read(weights)?;
        let embedding = weights.tensor("embedding.weight", &[WIDTH, FEATURES])?;
        // The checkpoint flattens (row, column, channel); maps here are (channel, row, column).
        let embedding =
            Packed::new(WIDTH, FEATURES, |o, k| embedding[o * FEATURES + (k % 64) * 256 + k / 64]);
        let encoder = |part: &str| format!("transformer_encoder.{part}");
        Ok(Self {
            patches,
            embedding,
            embedding_bias: weights.tensor("embedding.bias", &[WIDTH])?,
            class_token: weights.tensor(&encoder("cls"), &[1, 1, WIDTH])?,
            positions: weights.tensor(&encoder("posembed_input.position_emb"), &[1, GRID * GRID, WIDTH])?,
            scales: weights.tensor(&encoder("scaleembed_input.scale_emb"), &[3, WIDTH])?,
            blocks: (0..BLOCKS).map(|i| EncoderBlock::read(i, weights)).collect::<Result<_, _>>()?,
            norm: weights.affine(&encoder("encoder_norm"), WIDTH)?,
            head: weights.linear("head", 1, WIDTH)?,
        })
    }

    /// The score of a picture, display RGB in [0, 1], at least 16 pixels a side. Higher is better.
    pub fn score(&self, image: &Image) -> Result<f64, NetError> {
        images::check(NAME, image, 16)?;
        let centred = images::scaled_planes(image, |_, v| 2.0 * v - 1.0);
        Ok(self.forward(&tokens(&centred), &mut |_, _| ()))
    }

    fn forward(&self, tokens: &[Token], probe: &mut dyn FnMut(&str, &Planes)) -> f64 {
        let n = tokens.len();
        let features: Vec<Planes> =
            tokens.par_iter().map(|token| self.patches.forward(&token.patch, &mut |_, _| ())).collect();
        let mut embedded = Planes::new(WIDTH, 1, n);
        let finish = Finish { bias: Some(&self.embedding_bias), ..Finish::default() };
        product(&self.embedding, n, finish, &mut embedded.data, |first, panel| {
            let (panel, _) = panel.as_chunks_mut::<LANES>();
            for i in 0..LANES {
                match features.get(first + i) {
                    Some(token) => panel.iter_mut().zip(&token.data).for_each(|(p, v)| p[i] = *v),
                    None => panel.iter_mut().for_each(|p| p[i] = 0.0),
                }
            }
        });
        drop(features);
        probe("embedding", &embedded);
        let mut x = Planes::new(WIDTH, 1, n + 1);
        for (c, row) in x.data.chunks_exact_mut(n + 1).enumerate() {
            row[0] = self.class_token[c];
            for ((v, e), token) in row[1..].iter_mut().zip(embedded.plane(c)).zip(tokens) {
                *v = e + self.positions[token.position * WIDTH + c] + self.scales[token.scale * WIDTH + c];
            }
        }
        let valid: Vec<bool> = std::iter::once(true).chain(tokens.iter().map(|t| t.valid)).collect();
        for (i, block) in self.blocks.iter().enumerate() {
            block.forward(&mut x, &valid);
            if i == 0 {
                probe("block0", &x);
            }
        }
        let x = normalise::layer(&x, 1e-6, &self.norm);
        probe("encoder_norm", &x);
        let class = Planes::from_data(WIDTH, 1, 1, (0..WIDTH).map(|c| x.plane(c)[0]).collect());
        f64::from(self.head.forward(&class, Activation::Identity).data[0])
    }
}

impl PatchNet {
    fn read(weights: &mut dyn Weights) -> Result<Self, NetError> {
        let mut unit = |conv: &str, norm: &str, outputs: usize, inputs: usize, kernel: usize| {
            let padding = Padding::same(kernel / 2);
            let shape = [outputs, inputs, kernel, kernel];
            let convolution = standardised(&format!("block1.{conv}.weight"), shape, 1, padding, weights)?;
            Ok((convolution, weights.affine(&format!("block1.{norm}"), outputs)?))
        };
        let unit = [
            unit("conv1", "gn1", 64, 64, 1)?,
            unit("conv2", "gn2", 64, 64, 3)?,
            unit("conv3", "gn3", 256, 64, 1)?,
            unit("conv_proj", "gn_proj", 256, 64, 1)?,
        ];
        // "SAME" with stride 2 on 32 pixels: two before, three after.
        let padding = Padding { top: 2, left: 2, bottom: 3, right: 3 };
        Ok(Self {
            root: standardised("conv_root.weight", [64, 3, 7, 7], 2, padding, weights)?,
            root_norm: weights.affine("gn_root", 64)?,
            unit,
        })
    }

    fn forward(&self, patch: &Planes, probe: &mut dyn FnMut(&str, &Planes)) -> Planes {
        const GROUPS: usize = 32;
        const EPSILON: f64 = 1e-4;
        let mut root = self.root.forward(patch, Activation::Identity);
        probe("conv_root", &root);
        normalise::group(&mut root, GROUPS, 1e-6, &self.root_norm, Activation::Relu);
        // A row and a column of zeros are appended; they never change the maximum of values ≥ 0.
        let (height, width) = (root.height + 1, root.width + 1);
        let x = pool::maximum(&images::pad_zeros(&root, 0, 0, height, width), 3, 2);
        probe("root_pool", &x);
        let layer = |i: usize, input: &Planes, activation| {
            let (convolution, affine) = &self.unit[i];
            let mut out = convolution.forward(input, Activation::Identity);
            normalise::group(&mut out, GROUPS, EPSILON, affine, activation);
            out
        };
        let y = layer(1, &layer(0, &x, Activation::Relu), Activation::Relu);
        let mut y = layer(2, &y, Activation::Identity);
        y.add(&layer(3, &x, Activation::Identity));
        activation::apply(Activation::Relu, &mut y.data);
        probe("block1", &y);
        y
    }
}

/// Reads a convolution and standardises its kernels: mean 0, divided by (sample deviation + 1e-5).
fn standardised(
    name: &str,
    shape: [usize; 4],
    stride: usize,
    padding: Padding,
    weights: &mut dyn Weights,
) -> Result<Convolution, NetError> {
    let mut values = weights.tensor(name, &shape)?;
    for kernel in values.chunks_exact_mut(shape[1..].iter().product()) {
        let n = kernel.len() as f64;
        let mean = kernel.iter().map(|&w| f64::from(w)).sum::<f64>() / n;
        let squares = kernel.iter().map(|&w| math::powi(f64::from(w) - mean, 2)).sum::<f64>();
        let deviation = (squares / (n - 1.0)).sqrt() + 1e-5;
        kernel.iter_mut().for_each(|w| *w = ((f64::from(*w) - mean) / deviation) as f32);
    }
    Ok(Convolution::new(shape, &values, None, stride, padding))
}

impl EncoderBlock {
    fn read(index: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let name = |part: &str| format!("transformer_encoder.transformer.encoderblock_{index}.{part}");
        let mut linear = |part: &str, outputs, inputs| weights.linear(&name(part), outputs, inputs);
        let qkv = [
            linear("attention.query", WIDTH, WIDTH)?,
            linear("attention.key", WIDTH, WIDTH)?,
            linear("attention.value", WIDTH, WIDTH)?,
        ];
        let output = linear("attention.out", WIDTH, WIDTH)?;
        let mlp = [linear("mlp.fc1", 3 * WIDTH, WIDTH)?, linear("mlp.fc2", WIDTH, 3 * WIDTH)?];
        let (norm1, norm2) = (weights.affine(&name("norm1"), WIDTH)?, weights.affine(&name("norm2"), WIDTH)?);
        Ok(Self { norm1, qkv, output, norm2, mlp })
    }

    fn forward(&self, x: &mut Planes, valid: &[bool]) {
        let normed = normalise::layer(x, 1e-6, &self.norm1);
        let [q, k, v] = [0, 1, 2].map(|i| self.qkv[i].forward(&normed, Activation::Identity));
        let attended = attention(&q.data, &k.data, &v.data, HEADS, x.area(), Some(valid));
        self.output.add_to(&attended, x);
        let normed = normalise::layer(x, 1e-6, &self.norm2);
        self.mlp[1].add_to(&self.mlp[0].forward(&normed, Activation::Gelu), x);
    }
}

/// All tokens of a picture in [−1, 1].
fn tokens(image: &Planes) -> Vec<Token> {
    let mut out = Vec::new();
    for (scale, (long_side, count)) in SCALES.into_iter().enumerate() {
        let start = out.len();
        cut(&scaled(image, long_side), scale, &mut out);
        let empty = Token { patch: Planes::new(3, PATCH, PATCH), position: 0, scale: 0, valid: false };
        out.resize(start + count, empty);
    }
    cut(image, SCALES.len(), &mut out);
    out
}

/// The picture with another long side.
fn scaled(image: &Planes, long_side: usize) -> Planes {
    let ratio = long_side as f64 / image.height.max(image.width) as f64;
    let side = |n: usize| ((n as f64 * ratio).round_ties_even() as usize).max(1);
    resize(image, side(image.height), side(image.width), Rule::Bicubic)
}

/// Cuts a picture, zero-padded to multiples of 32, into patches.
fn cut(image: &Planes, scale: usize, out: &mut Vec<Token>) {
    let (height, width) = (image.height.next_multiple_of(PATCH), image.width.next_multiple_of(PATCH));
    let (top, left) = ((height - image.height) / 2, (width - image.width) / 2);
    let padded = images::pad_zeros(image, top, left, height, width);
    let (rows, columns) = (height / PATCH, width / PATCH);
    for row in 0..rows {
        for column in 0..columns {
            let patch = images::crop(&padded, row * PATCH, column * PATCH, PATCH, PATCH);
            let position = (GRID * row / rows) * GRID + GRID * column / columns;
            out.push(Token { patch, position, scale, valid: true });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, every_channel, picture, token_rows};
    use crate::weights::StandIn;

    fn centred(planes: &Planes) -> Planes {
        let data = planes.data.iter().map(|v| 2.0 * v - 1.0).collect();
        Planes::from_data(3, planes.height, planes.width, data)
    }

    fn check_patches(golden: &Golden, net: &Musiq, tokens: &[Token], name: &str, stage: &str, step: usize) {
        let mut sampled = Vec::new();
        for token in tokens.iter().step_by(step) {
            net.patches.forward(&token.patch, &mut |at, planes| {
                if at == stage {
                    sampled.extend(every_channel(planes, 1));
                }
            });
        }
        golden.check(name, &sampled);
    }

    #[test]
    fn golden_tokens_and_patch_network() {
        let golden = Golden::network("musiq");
        let image = centred(&golden.planes("in"));
        let small = scaled(&image, 224);
        let sampled = golden.shape("resized224");
        let step = small.height.div_ceil(sampled[2]);
        let mut values = Vec::new();
        for c in 0..3 {
            for y in (0..small.height).step_by(step) {
                values.extend(small.plane(c)[y * small.width..][..small.width].iter().step_by(step));
            }
        }
        golden.check("resized224", &values);
        let tokens = tokens(&image);
        let index: Vec<f32> = tokens
            .iter()
            .flat_map(|t| [t.position as f32, t.scale as f32, f32::from(u8::from(t.valid))])
            .collect();
        golden.check("tokens.index", &index);
        let patches: Vec<f32> = tokens.iter().step_by(29).flat_map(|t| t.patch.data.clone()).collect();
        golden.check("tokens.patches", &patches);
        let net = Musiq::from_weights(&mut StandIn).unwrap();
        check_patches(&golden, &net, &tokens, "mid.conv_root", "conv_root", 58);
        check_patches(&golden, &net, &tokens, "mid.root_pool", "root_pool", 58);
        check_patches(&golden, &net, &tokens, "mid.block1", "block1", 116);
        let flat = super::tokens(&centred(&golden.planes("flat.in")));
        check_patches(&golden, &net, &flat, "flat.root_pool", "root_pool", 58);
    }

    #[test]
    fn golden_transformer_and_score() {
        let golden = Golden::network("musiq");
        let net = Musiq::from_weights(&mut StandIn).unwrap();
        let score = net.forward(&tokens(&centred(&golden.planes("in"))), &mut |name, planes| {
            golden.check(&format!("mid.{name}"), &token_rows(planes, 3));
        });
        golden.check("out", &[score as f32]);
        golden.check("out", &[net.score(&golden.image("in")).unwrap() as f32]);
        let flat = net.forward(&tokens(&centred(&golden.planes("flat.in"))), &mut |name, planes| {
            if name == "embedding" {
                let step = planes.area().div_ceil(golden.shape("flat.embedding")[0]);
                golden.check("flat.embedding", &token_rows(planes, step));
            }
        });
        golden.check("flat.out", &[flat as f32]);
    }

    #[test]
    fn a_tiny_picture_has_a_score_and_a_smaller_one_is_refused() {
        let net = Musiq::from_weights(&mut StandIn).unwrap();
        assert!(net.score(&picture(1, 16, 40)).unwrap().is_finite());
        assert!(net.score(&picture(1, 15, 40)).is_err());
    }
}
