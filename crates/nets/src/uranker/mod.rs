//! URanker: a score of underwater image quality without reference, from a co-scale transformer with a
//! histogram token.
//!
//! There are four stages at 1/4, 1/8, 1/16, 1/32 of the size. The tokens of a stage are `[class, histogram,
//! patches…]`; the histogram token is a linear map of the 3 × 64 counts of the padded picture. Each stage has
//! two serial blocks. Then come six parallel blocks in which stages 2 to 4 exchange resized tokens. The score
//! is the mean of three linear heads on the class tokens. Guo et al., "Underwater Ranker: learn which is
//! better and how to be better", AAAI 2023; file `URanker_ckpt.pth`. Higher is better; the scale is
//! arbitrary.

mod blocks;

use use3d_capture::Image;

use crate::engine::activation::Activation;
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::normalise::{self, Affine};
use crate::engine::planes::Planes;
use crate::engine::resample::{Rule, pillow_bilinear, resize};
use crate::error::NetError;
use crate::images;
use crate::weights::{Layers, Weights};
use blocks::{Attention, Mlp, PositionEncoding, RelativePosition, SerialBlock};

const NAME: &str = "URanker";
const WIDTHS: [usize; 4] = [152, 320, 320, 320];
/// ε of every norm except those of the patch embeddings, which have 1e-5.
const EPSILON: f64 = 1e-6;
const PATCH_EPSILON: f64 = 1e-5;
const BINS: usize = 64;
/// Tokens in front of the patches: class and histogram.
const EXTRA: usize = 2;

/// The size of the network's input; scores of different choices must not be mixed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RankerInput {
    /// The picture at its own size (as in pyiqa).
    #[default]
    Given,
    /// Half the width and height, 8 bits, Pillow's bilinear (as in the authors' demo).
    Half,
}

/// The network with its weights.
#[derive(Clone, Debug)]
pub struct URanker {
    stages: Vec<Stage>,
    parallel: Vec<ParallelBlock>,
    norms: Vec<Affine>,
    heads: Vec<Convolution>,
}

#[derive(Clone, Debug)]
struct Stage {
    embedding: Convolution,
    embedding_norm: Affine,
    class_token: Vec<f32>,
    histogram: Convolution,
    position: PositionEncoding,
    relative: RelativePosition,
    blocks: Vec<SerialBlock>,
}

/// One exchange between stages 2, 3 and 4.
#[derive(Clone, Debug)]
struct ParallelBlock {
    norm1: Vec<Affine>,
    attention: Vec<Attention>,
    alphas: [f32; 6],
    norm2: Vec<Affine>,
    mlp: Mlp,
}

/// Tokens `[channels, 1, EXTRA + height · width]` with the size of their grid.
#[derive(Clone, Debug)]
struct Tokens {
    planes: Planes,
    height: usize,
    width: usize,
}

impl URanker {
    /// Reads the network, with shared tensors by their canonical names.
    pub fn from_weights(weights: &mut dyn Weights) -> Result<Self, NetError> {
        let stages = (0..4).map(|i| Stage::read(i, weights)).collect::<Result<_, _>>()?;
        let parallel = (0..6).map(|i| ParallelBlock::read(i, weights)).collect::<Result<_, _>>()?;
        let mut norms = Vec::new();
        let mut heads = Vec::new();
        for stage in 2..=4 {
            norms.push(weights.affine(&format!("norm{stage}"), 320)?);
            heads.push(weights.linear(&format!("head{stage}"), 1, 320)?);
        }
        Ok(Self { stages, parallel, norms, heads })
    }

    /// The score of a picture at its own size, display RGB in [0, 1], at least 32 pixels a side. Higher is
    /// better.
    pub fn score(&self, image: &Image) -> Result<f64, NetError> {
        self.score_with(image, RankerInput::Given)
    }

    /// The score of a picture at the size that `input` selects.
    pub fn score_with(&self, image: &Image, input: RankerInput) -> Result<f64, NetError> {
        match input {
            RankerInput::Given => {
                images::check(NAME, image, 32)?;
                Ok(self.forward(&pad(image), &mut |_, _| ()))
            }
            RankerInput::Half => {
                images::check(NAME, image, 64)?;
                let half = pillow_bilinear(&image.to_8bit(), image.width() / 2, image.height() / 2);
                Ok(self.forward(&pad(&half.to_float()), &mut |_, _| ()))
            }
        }
    }

    /// The network alone; the sides are multiples of 32.
    fn forward(&self, x: &Planes, probe: &mut dyn FnMut(&str, &Planes)) -> f64 {
        let histogram = histogram(x);
        probe("histogram", &histogram);
        let mut stages: Vec<Tokens> = Vec::with_capacity(4);
        for (i, stage) in self.stages.iter().enumerate() {
            let patches = stages.last().map(Tokens::patches);
            stages.push(stage.forward(patches.as_ref().unwrap_or(x), &histogram, i, probe));
            if i > 0 {
                stages[i - 1].planes.data.shrink_to_fit();
            }
        }
        // The first stage takes no part in the exchange.
        let mut coarse = stages.split_off(1);
        drop(stages);
        for (i, block) in self.parallel.iter().enumerate() {
            for (tokens, stage) in coarse.iter_mut().zip(&self.stages[1..]) {
                stage.position.apply(tokens);
            }
            block.forward(&mut coarse, &self.stages[1..]);
            probe(&format!("parallel{i}_x2"), &coarse[0].planes);
            probe(&format!("parallel{i}_x3"), &coarse[1].planes);
        }
        let mut total = 0.0;
        for (i, tokens) in coarse.iter().enumerate() {
            let normed = normalise::layer(&tokens.planes, EPSILON, &self.norms[i]);
            probe(&format!("norm{}", i + 2), &normed);
            let class = Planes::from_data(320, 1, 1, (0..320).map(|c| normed.plane(c)[0]).collect());
            total += f64::from(self.heads[i].forward(&class, Activation::Identity).data[0]);
        }
        total / 3.0
    }
}

impl Stage {
    fn read(index: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let (n, width) = (index + 1, WIDTHS[index]);
        let (inputs, kernel) = if index == 0 { (3, 4) } else { (WIDTHS[index - 1], 2) };
        Ok(Self {
            embedding: weights.convolution(
                &format!("patch_embed{n}.proj"),
                [width, inputs, kernel, kernel],
                kernel,
                Padding::same(0),
            )?,
            embedding_norm: weights.affine(&format!("patch_embed{n}.norm"), width)?,
            class_token: weights.tensor(&format!("cls_token{n}"), &[1, 1, width])?,
            // The spelling is that of the checkpoint.
            histogram: weights.linear(&format!("historgram_embed{n}"), width, 3 * BINS)?,
            position: PositionEncoding::read(n, width, weights)?,
            relative: RelativePosition::read(n, width, weights)?,
            blocks: (0..2)
                .map(|i| SerialBlock::read(&format!("serial_blocks{n}.{i}"), width, weights))
                .collect::<Result<_, _>>()?,
        })
    }

    fn forward(
        &self,
        input: &Planes,
        histogram: &Planes,
        index: usize,
        probe: &mut dyn FnMut(&str, &Planes),
    ) -> Tokens {
        let embedded = self.embedding.forward(input, Activation::Identity);
        let patches = normalise::layer(&embedded, PATCH_EPSILON, &self.embedding_norm);
        drop(embedded);
        probe(&format!("patch_embed{}", index + 1), &patches);
        let histogram = self.histogram.forward(histogram, Activation::Identity);
        let mut tokens = Tokens::assemble(&patches, &[&self.class_token, &histogram.data]);
        drop(patches);
        for block in &self.blocks {
            self.position.apply(&mut tokens);
            block.forward(&mut tokens, &self.relative);
        }
        probe(&format!("serial{}", index + 1), &tokens.planes);
        tokens
    }
}

impl ParallelBlock {
    fn read(index: usize, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let name = |part: &str| format!("parallel_blocks.{index}.{part}");
        let mut alphas = [0.0; 6];
        for (i, alpha) in alphas.iter_mut().enumerate() {
            *alpha = weights.tensor(&name(&format!("alpha{}", i + 1)), &[1])?[0];
        }
        let (mut norm1, mut attention, mut norm2) = (Vec::new(), Vec::new(), Vec::new());
        for stage in 2..=4 {
            norm1.push(weights.affine(&name(&format!("norm1{stage}")), 320)?);
            attention.push(Attention::read(&name(&format!("factoratt_crpe{stage}")), 320, weights)?);
            norm2.push(weights.affine(&name(&format!("norm2{stage}")), 320)?);
        }
        Ok(Self { norm1, attention, alphas, norm2, mlp: Mlp::read(&name("mlp2"), 320, weights)? })
    }

    fn forward(&self, x: &mut [Tokens], stages: &[Stage]) {
        let attended: Vec<Tokens> = (0..3)
            .map(|i| {
                let normed = x[i].with(normalise::layer(&x[i].planes, EPSILON, &self.norm1[i]));
                let planes = self.attention[i].forward(&normed, &stages[i].relative);
                x[i].with(planes)
            })
            .collect();
        // (target, alpha, source): all resizes start from the values before the exchange.
        let exchange = [(0, 0, 1), (0, 1, 2), (1, 2, 2), (1, 3, 0), (2, 4, 1), (2, 5, 0)];
        for (i, tokens) in x.iter_mut().enumerate() {
            let mut sum = attended[i].planes.clone();
            for (_, alpha, source) in exchange.iter().filter(|(target, ..)| *target == i) {
                let moved = attended[*source].resized(attended[i].height, attended[i].width);
                let alpha = self.alphas[*alpha];
                sum.data.iter_mut().zip(&moved.data).for_each(|(s, m)| *s += alpha * m);
            }
            tokens.planes.add(&sum);
            let normed = normalise::layer(&tokens.planes, EPSILON, &self.norm2[i]);
            self.mlp.add_to(&normed, &mut tokens.planes);
        }
    }
}

impl Tokens {
    fn assemble(patches: &Planes, extra: &[&[f32]; EXTRA]) -> Self {
        let (height, width, n) = (patches.height, patches.width, patches.area());
        let mut planes = Planes::new(patches.channels, 1, n + EXTRA);
        for (c, row) in planes.data.chunks_exact_mut(n + EXTRA).enumerate() {
            for (e, token) in extra.iter().enumerate() {
                row[e] = token[c];
            }
            row[EXTRA..].copy_from_slice(patches.plane(c));
        }
        Self { planes, height, width }
    }

    /// The same grid with other values.
    fn with(&self, planes: Planes) -> Self {
        Self { planes, height: self.height, width: self.width }
    }

    /// The patches as maps.
    fn patches(&self) -> Planes {
        patches_of(&self.planes.data, self.planes.channels, self.height, self.width)
    }

    /// The patches resized (bilinear), the other tokens unchanged.
    fn resized(&self, height: usize, width: usize) -> Planes {
        let patches = resize(&self.patches(), height, width, Rule::Bilinear);
        let extra: [Vec<f32>; EXTRA] =
            std::array::from_fn(|e| (0..self.planes.channels).map(|c| self.planes.plane(c)[e]).collect());
        Self::assemble(&patches, &[&extra[0], &extra[1]]).planes
    }
}

/// The patch part of `[channels][EXTRA + height · width]`.
fn patches_of(rows: &[f32], channels: usize, height: usize, width: usize) -> Planes {
    let n = height * width;
    let mut out = Planes::new(channels, height, width);
    for (plane, row) in out.data.chunks_exact_mut(n).zip(rows.chunks_exact(n + EXTRA)) {
        plane.copy_from_slice(&row[EXTRA..]);
    }
    out
}

/// Pads the picture with zeros to multiples of 32, as evenly as possible.
fn pad(image: &Image) -> Planes {
    let (height, width) = (image.height().next_multiple_of(32), image.width().next_multiple_of(32));
    let (top, left) = ((height - image.height()) / 2, (width - image.width()) / 2);
    images::pad_zeros(&images::planes(image), top, left, height, width)
}

/// Counts of 64 bins over [0, 1] per channel, as one token; the value 1 is in the last bin, values outside
/// are not counted.
fn histogram(x: &Planes) -> Planes {
    let mut counts = vec![0u32; 3 * BINS];
    for c in 0..3 {
        for v in x.plane(c).iter().filter(|v| (0.0..=1.0).contains(*v)) {
            counts[c * BINS + ((v * BINS as f32) as usize).min(BINS - 1)] += 1;
        }
    }
    Planes::from_data(3 * BINS, 1, 1, counts.into_iter().map(|n| n as f32).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, picture, token_rows};
    use crate::weights::StandIn;

    #[test]
    fn golden_score_and_intermediates() {
        let golden = Golden::network("uranker");
        let net = URanker::from_weights(&mut StandIn).unwrap();
        let image = golden.image("in");
        let padded = pad(&image);
        golden.check("padded", &padded.data);
        let score = net.forward(&padded, &mut |name, planes| {
            let first = |n: usize| token_rows(planes, 1)[..n * planes.channels].to_vec();
            match name {
                "histogram" => golden.check(name, &planes.data),
                "patch_embed1" => golden.check("mid.patch_embed1", &token_rows(planes, 7)),
                "serial1" => golden.check("mid.serial1", &first(64)),
                "serial4" => golden.check("mid.serial4", &token_rows(planes, 1)),
                "parallel0_x2" => golden.check("mid.parallel0_x2", &token_rows(planes, 3)),
                "parallel5_x3" => golden.check("mid.parallel5_x3", &token_rows(planes, 1)),
                "norm4" => golden.check("mid.norm4", &first(4)),
                _ => {}
            }
        });
        golden.check("out", &[score as f32]);
        golden.check("out", &[net.score(&image).unwrap() as f32]);
    }

    #[test]
    fn golden_half_size_and_flat_input() {
        let golden = Golden::network("uranker");
        let net = URanker::from_weights(&mut StandIn).unwrap();
        let raw = golden.image8("raw_u8");
        assert_eq!(pillow_bilinear(&raw, raw.width() / 2, raw.height() / 2), golden.image8("half_u8"));
        let half = net.score_with(&raw.to_float(), RankerInput::Half).unwrap();
        golden.check("out_half", &[half as f32]);
        let flat = net.forward(&golden.planes("flat.in"), &mut |name, planes| {
            if name == "patch_embed1" {
                let rows = golden.shape("flat.patch_embed1")[1];
                golden.check("flat.patch_embed1", &token_rows(planes, planes.area().div_ceil(rows)));
            }
        });
        golden.check("flat.out", &[flat as f32]);
    }

    #[test]
    fn small_pictures_are_refused() {
        let net = URanker::from_weights(&mut StandIn).unwrap();
        assert!(net.score(&picture(1, 31, 40)).is_err());
        assert!(net.score_with(&picture(1, 40, 40), RankerInput::Half).is_err());
    }
}
