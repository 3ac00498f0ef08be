//! RAFT's encoder: maps a picture to 256 features at ⅛ resolution.
//!
//! A 7×7 convolution with stride 2, then three stages of two residual blocks (64, 96, 128 channels; the
//! second and third stage halve the size), then a 1×1 convolution. A block is `ReLU(shortcut(x) +
//! ReLU(norm(conv(ReLU(norm(conv(x)))))))`. The feature encoder normalises each picture and channel
//! separately; the context encoder has batch norms with fixed statistics, folded into the convolutions.

use crate::engine::activation::{self, Activation};
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::normalise;
use crate::engine::planes::Planes;
use crate::error::NetError;
use crate::weights::{Layers, Weights};

const EPSILON: f64 = 1e-5;

/// The normalisation after every convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Norm {
    Instance,
    Batch,
}

/// An encoder with its weights.
#[derive(Clone, Debug)]
pub(crate) struct RaftEncoder {
    first: Normed,
    blocks: Vec<Residual>,
    last: Convolution,
}

/// A convolution with its normalisation.
#[derive(Clone, Debug)]
struct Normed {
    convolution: Convolution,
    norm: Norm,
}

#[derive(Clone, Debug)]
struct Residual {
    convolutions: [Normed; 2],
    shortcut: Option<Normed>,
}

impl RaftEncoder {
    pub(crate) fn read(name: &str, norm: Norm, weights: &mut dyn Weights) -> Result<Self, NetError> {
        let mut normed = |part: &str, shape: [usize; 4], stride: usize| {
            Normed::read(&format!("{name}.{part}"), norm, shape, stride, weights)
        };
        let first = normed("convnormrelu", [64, 3, 7, 7], 2)?;
        let mut blocks = Vec::new();
        let mut inputs = 64;
        for (stage, width) in [(1, 64), (2, 96), (3, 128)] {
            for block in 0..2 {
                let stride = if stage > 1 && block == 0 { 2 } else { 1 };
                let mut unit = |part: &str, shape, stride| {
                    normed(&format!("layer{stage}.{block}.{part}"), shape, stride)
                };
                let convolutions = [
                    unit("convnormrelu1", [width, inputs, 3, 3], stride)?,
                    unit("convnormrelu2", [width, width, 3, 3], 1)?,
                ];
                let shortcut = match stride {
                    1 => None,
                    _ => Some(unit("downsample", [width, inputs, 1, 1], stride)?),
                };
                blocks.push(Residual { convolutions, shortcut });
                inputs = width;
            }
        }
        let last = weights.same_convolution(&format!("{name}.conv"), [256, 128], 1)?;
        Ok(Self { first, blocks, last })
    }

    pub(crate) fn forward(&self, x: &Planes) -> Planes {
        let mut x = self.first.forward(x, Activation::Relu);
        for block in &self.blocks {
            let inner = block.convolutions[0].forward(&x, Activation::Relu);
            let mut y = block.convolutions[1].forward(&inner, Activation::Relu);
            drop(inner);
            match &block.shortcut {
                None => y.add(&x),
                Some(shortcut) => y.add(&shortcut.forward(&x, Activation::Identity)),
            }
            activation::apply(Activation::Relu, &mut y.data);
            x = y;
        }
        self.last.forward(&x, Activation::Identity)
    }
}

impl Normed {
    /// Reads the convolution `<part>.0` and, if it is a batch's, the normalisation `<part>.1`.
    fn read(
        part: &str,
        norm: Norm,
        shape: [usize; 4],
        stride: usize,
        weights: &mut dyn Weights,
    ) -> Result<Self, NetError> {
        let (name, norm_name, padding) =
            (format!("{part}.0"), format!("{part}.1"), Padding::same(shape[2] / 2));
        if norm == Norm::Instance {
            let convolution = weights.convolution(&name, shape, stride, padding)?;
            return Ok(Self { convolution, norm });
        }
        let (mut values, mut bias) = weights.parameters(&name, &shape)?;
        let affine = weights.affine(&norm_name, shape[0])?;
        let mean = weights.tensor(&format!("{norm_name}.running_mean"), &shape[..1])?;
        let variance = weights.tensor(&format!("{norm_name}.running_var"), &shape[..1])?;
        let per_output = shape[1..].iter().product();
        for (o, row) in values.chunks_exact_mut(per_output).enumerate() {
            let scale = f64::from(affine.scale[o]) / (f64::from(variance[o]) + EPSILON).sqrt();
            row.iter_mut().for_each(|w| *w = (f64::from(*w) * scale) as f32);
            let shifted = (f64::from(bias[o]) - f64::from(mean[o])) * scale + f64::from(affine.shift[o]);
            bias[o] = shifted as f32;
        }
        Ok(Self { convolution: Convolution::new(shape, &values, Some(bias), stride, padding), norm })
    }

    fn forward(&self, x: &Planes, activation: Activation) -> Planes {
        match self.norm {
            Norm::Batch => self.convolution.forward(x, activation),
            Norm::Instance => {
                let mut out = self.convolution.forward(x, Activation::Identity);
                normalise::instance(&mut out, EPSILON, activation);
                out
            }
        }
    }
}
