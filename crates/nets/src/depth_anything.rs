//! Depth Anything V2: disparity from one picture, by a DINOv2 vision transformer with the DPT head.
//!
//! The picture is scaled so that each side is a multiple of 14 and at least 518 pixels (cubic, without
//! antialiasing). It is cut into patches of 14 × 14, and every patch becomes a token. A class token is put in
//! front, and learned positions are added, resized bicubically from their 37 × 37 grid. Each block is `x +=
//! s₁·attention(LN(x)); x += s₂·MLP(LN(x))` (LN ε 1e-6, erf GELU). The tokens of four blocks, each through
//! the final norm, are the input of the head. The result is disparity-like: larger is nearer, never negative,
//! known up to a scale and a shift. Yang et al., "Depth Anything V2", NeurIPS 2024; files
//! `depth_anything_v2_vit{s,b,l}.pth`.

use use3d_capture::{Image, Map};

use crate::dpt::DptHead;
use crate::engine::activation::Activation;
use crate::engine::attention::attention;
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::normalise::{self, Affine};
use crate::engine::planes::Planes;
use crate::engine::resample::{ResampleAxis, Rule, resize, resize_by};
use crate::error::NetError;
use crate::images;
use crate::weights::{Layers, Weights};

const EPSILON: f64 = 1e-6;
const PATCH: usize = 14;
/// Side of the grid of learned positions.
const GRID: usize = 37;
const INPUT_SIZE: usize = 518;
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// The three published sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthAnythingSize {
    /// ViT-S, 24.8 million parameters, Apache-2.0.
    Small,
    /// ViT-B, 97.5 million parameters, CC BY-NC 4.0.
    Base,
    /// ViT-L, 335.3 million parameters, CC BY-NC 4.0.
    Large,
}

/// Widths of one size.
struct NetworkWidths {
    width: usize,
    heads: usize,
    /// The blocks whose tokens the head gets; the last one is the network's last.
    taken: [usize; 4],
    features: usize,
    channels: [usize; 4],
}

impl DepthAnythingSize {
    fn shape(self) -> NetworkWidths {
        match self {
            Self::Small => NetworkWidths {
                width: 384,
                heads: 6,
                taken: [2, 5, 8, 11],
                features: 64,
                channels: [48, 96, 192, 384],
            },
            Self::Base => NetworkWidths {
                width: 768,
                heads: 12,
                taken: [2, 5, 8, 11],
                features: 128,
                channels: [96, 192, 384, 768],
            },
            Self::Large => NetworkWidths {
                width: 1024,
                heads: 16,
                taken: [4, 11, 17, 23],
                features: 256,
                channels: [256, 512, 1024, 1024],
            },
        }
    }
}

/// The network with its weights.
#[derive(Clone, Debug)]
pub struct DepthAnythingV2 {
    heads: usize,
    taken: [usize; 4],
    patches: Convolution,
    class_token: Vec<f32>,
    class_position: Vec<f32>,
    positions: Planes,
    blocks: Vec<TransformerBlock>,
    norm: Affine,
    head: DptHead,
}

#[derive(Clone, Debug)]
struct TransformerBlock {
    norm1: Affine,
    qkv: Convolution,
    /// The layer scale is folded in.
    projection: Convolution,
    norm2: Affine,
    hidden: Convolution,
    /// The layer scale is folded in.
    output: Convolution,
}

impl DepthAnythingV2 {
    /// Reads the network of one size.
    pub fn from_weights(size: DepthAnythingSize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let shape = size.shape();
        let width = shape.width;
        let patches = weights.convolution(
            "pretrained.patch_embed.proj",
            [width, 3, PATCH, PATCH],
            PATCH,
            Padding::same(0),
        )?;
        let class_token = weights.tensor("pretrained.cls_token", &[1, 1, width])?;
        let embedding = weights.tensor("pretrained.pos_embed", &[1, GRID * GRID + 1, width])?;
        let mut positions = Planes::new(width, GRID, GRID);
        for (t, token) in embedding[width..].chunks_exact(width).enumerate() {
            for (c, v) in token.iter().enumerate() {
                positions.data[c * GRID * GRID + t] = *v;
            }
        }
        let blocks = (0..=shape.taken[3])
            .map(|i| TransformerBlock::read(i, width, weights))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            heads: shape.heads,
            taken: shape.taken,
            patches,
            class_token,
            class_position: embedding[..width].to_vec(),
            positions,
            blocks,
            norm: weights.affine("pretrained.norm", width)?,
            head: DptHead::read(width, shape.features, shape.channels, weights)?,
        })
    }

    /// Disparity of a picture of any size, display RGB in [0, 1]. The result has the same size and values ≥
    /// 0; larger is nearer.
    pub fn disparity(&self, image: &Image) -> Result<Map, NetError> {
        self.disparity_at(image, INPUT_SIZE)
    }

    /// Like [`disparity`](Self::disparity), with another lower bound of the sides than 518 pixels.
    pub fn disparity_at(&self, image: &Image, input_size: usize) -> Result<Map, NetError> {
        images::check("Depth Anything V2", image, 1)?;
        let fed = prepare(image, input_size);
        let out = self.forward(&fed, &mut |_, _| ());
        images::map(resize(&out, image.height(), image.width(), Rule::BilinearCorners))
    }

    /// The network alone; height and width are multiples of 14.
    fn forward(&self, x: &Planes, probe: &mut dyn FnMut(&str, &Planes)) -> Planes {
        let patches = self.patches.forward(x, Activation::Identity);
        probe("patch_embed", &patches);
        let (rows, columns) = (patches.height, patches.width);
        let mut tokens = with_class(&patches, &self.class_token);
        let positions = with_class(&self.positions_for(rows, columns), &self.class_position);
        probe("pos_embed", &positions);
        tokens.add(&positions);
        let mut taken: [Planes; 4] = std::array::from_fn(|_| Planes::new(0, 0, 0));
        for (i, block) in self.blocks.iter().enumerate() {
            block.forward(&mut tokens, self.heads);
            if i == 0 {
                probe("block0", &tokens);
            }
            if let Some(level) = self.taken.iter().position(|&taken| taken == i) {
                taken[level] = without_class(&normalise::layer(&tokens, EPSILON, &self.norm), rows, columns);
            }
        }
        probe("block_last", &tokens);
        drop(tokens);
        self.head.forward(taken, (PATCH * rows, PATCH * columns), probe)
    }

    /// The learned positions for another grid. The step between source coordinates is 37/(n + 0.1): the
    /// original code passes a scale factor with that offset to its resampler, which uses the factor as given.
    fn positions_for(&self, rows: usize, columns: usize) -> Planes {
        if (rows, columns) == (GRID, GRID) {
            return self.positions.clone();
        }
        let axis = |n: usize| ResampleAxis::new(Rule::BicubicStep(GRID as f64 / (n as f64 + 0.1)), GRID, n);
        resize_by(&self.positions, &axis(rows), &axis(columns))
    }
}

impl TransformerBlock {
    fn read(index: usize, width: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let name = |part: &str| format!("pretrained.blocks.{index}.{part}");
        let scale1 = weights.tensor(&name("ls1.gamma"), &[width])?;
        let scale2 = weights.tensor(&name("ls2.gamma"), &[width])?;
        Ok(Self {
            norm1: weights.affine(&name("norm1"), width)?,
            qkv: weights.linear(&name("attn.qkv"), 3 * width, width)?,
            projection: weights.scaled_linear(&name("attn.proj"), width, width, &scale1)?,
            norm2: weights.affine(&name("norm2"), width)?,
            hidden: weights.linear(&name("mlp.fc1"), 4 * width, width)?,
            output: weights.scaled_linear(&name("mlp.fc2"), width, 4 * width, &scale2)?,
        })
    }

    fn forward(&self, x: &mut Planes, heads: usize) {
        let qkv = self.qkv.forward(&normalise::layer(x, EPSILON, &self.norm1), Activation::Identity);
        let part = x.data.len();
        let (q, k, v) = (&qkv.data[..part], &qkv.data[part..2 * part], &qkv.data[2 * part..]);
        self.projection.add_to(&attention(q, k, v, heads, x.area(), None), x);
        let hidden = self.hidden.forward(&normalise::layer(x, EPSILON, &self.norm2), Activation::Gelu);
        self.output.add_to(&hidden, x);
    }
}

/// Tokens `[class, patches…]`.
fn with_class(patches: &Planes, class: &[f32]) -> Planes {
    let n = patches.area();
    let mut out = Planes::new(patches.channels, 1, n + 1);
    for (c, row) in out.data.chunks_exact_mut(n + 1).enumerate() {
        row[0] = class[c];
        row[1..].copy_from_slice(patches.plane(c));
    }
    out
}

fn without_class(tokens: &Planes, rows: usize, columns: usize) -> Planes {
    let mut out = Planes::new(tokens.channels, rows, columns);
    for (c, plane) in out.data.chunks_exact_mut(rows * columns).enumerate() {
        plane.copy_from_slice(&tokens.plane(c)[1..]);
    }
    out
}

/// The size of the network's input: the picture is scaled so that both sides are at least `input_size`, and
/// the sides are rounded to multiples of 14.
fn fed_size(height: usize, width: usize, input_size: usize) -> (usize, usize) {
    let bound = input_size as f64;
    let scale = (bound / height as f64).max(bound / width as f64);
    let side = |n: usize| {
        let steps = scale * n as f64 / PATCH as f64;
        let rounded = steps.round_ties_even() * PATCH as f64;
        let fitted = if rounded < bound { steps.ceil() * PATCH as f64 } else { rounded };
        fitted as usize
    };
    (side(height), side(width))
}

fn prepare(image: &Image, input_size: usize) -> Planes {
    let (height, width) = fed_size(image.height(), image.width(), input_size);
    let mut fed = resize(&images::planes(image), height, width, Rule::Bicubic);
    for (c, plane) in fed.data.chunks_exact_mut(height * width).enumerate() {
        plane.iter_mut().for_each(|v| *v = (*v - MEAN[c]) / DEVIATION[c]);
    }
    fed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, every_channel, token_rows};
    use crate::weights::StandIn;

    fn check(size: DepthAnythingSize, name: &str) {
        let golden = Golden::network(name);
        let net = DepthAnythingV2::from_weights(size, &mut StandIn).unwrap();
        let out = net.forward(&golden.planes("in"), &mut |name, planes| match name {
            "pos_embed" => {
                let mut sampled = Planes::new(planes.channels / 4, 1, planes.area());
                sampled.data = every_channel(planes, 4);
                golden.check("pos_embed", &token_rows(&sampled, 1));
            }
            "patch_embed" | "block0" | "block_last" => {
                golden.check(&format!("mid.{name}"), &token_rows(planes, 2));
            }
            "refinenet4" => golden.check("mid.refinenet4", &every_channel(planes, 4)),
            _ => golden.check(&format!("mid.{name}"), &every_channel(planes, 16)),
        });
        golden.check("out", &out.data);
        let raw = golden.image8("raw_u8").to_float();
        let input_size = golden.meta("input_size").parse().unwrap();
        let fed = prepare(&raw, input_size);
        golden.close("in", &fed.data, &golden.values("in"), 3e-5);
        golden.check("out_full", net.disparity_at(&raw, input_size).unwrap().data());
        if golden.names().iter().any(|n| n == "flat.in") {
            let flat = net.forward(&golden.planes("flat.in"), &mut |name, planes| {
                if name == "block0" {
                    let step = planes.area().div_ceil(golden.shape("flat.block0")[1]);
                    golden.check("flat.block0", &token_rows(planes, step));
                }
            });
            golden.check("flat.out", &flat.data);
        }
    }

    #[test]
    fn golden_small() {
        check(DepthAnythingSize::Small, "da2_vits");
    }

    #[test]
    #[cfg_attr(not(feature = "golden-networks"), ignore = "large; run with --features golden-networks")]
    fn golden_base() {
        check(DepthAnythingSize::Base, "da2_vitb");
    }

    #[test]
    #[cfg_attr(not(feature = "golden-networks"), ignore = "large; run with --features golden-networks")]
    fn golden_large() {
        check(DepthAnythingSize::Large, "da2_vitl");
    }

    #[test]
    fn fed_sizes_follow_the_official_rule() {
        assert_eq!(fed_size(933, 1400, 518), (518, 784));
        assert_eq!(fed_size(518, 518, 518), (518, 518));
        assert_eq!(fed_size(1080, 1920, 518), (518, 924));
        assert_eq!(fed_size(150, 200, 70), (70, 98));
    }
}
