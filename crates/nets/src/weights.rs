//! The source of a network's tensors: a checkpoint file, or the reproducible stand-in rule that tests and
//! timings use.
//!
//! A network reads every tensor by its name in the official checkpoint, with the exact shape.

use use3d_numerics::random;

use crate::engine::convolution::{Convolution, Padding};
use crate::engine::normalise::Affine;
use crate::error::NetError;

/// A source of named tensors.
pub trait Weights {
    /// Returns the values of `name`, row-major. The tensor must have exactly this shape.
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError>;
}

/// Layers by their name in the checkpoint: `<name>.weight` and `<name>.bias`.
pub(crate) trait Layers: Weights {
    /// Weights of this shape, whose first side is the number of outputs, and one bias per output.
    fn parameters(&mut self, name: &str, shape: &[usize]) -> Result<(Vec<f32>, Vec<f32>), NetError> {
        let weights = self.tensor(&format!("{name}.weight"), shape)?;
        Ok((weights, self.tensor(&format!("{name}.bias"), &shape[..1])?))
    }

    fn convolution(
        &mut self,
        name: &str,
        shape: [usize; 4],
        stride: usize,
        padding: Padding,
    ) -> Result<Convolution, NetError> {
        let (weights, bias) = self.parameters(name, &shape)?;
        Ok(Convolution::new(shape, &weights, Some(bias), stride, padding))
    }

    /// A convolution with a square kernel of odd size that keeps the size of its input.
    fn same_convolution(
        &mut self,
        name: &str,
        [outputs, inputs]: [usize; 2],
        kernel: usize,
    ) -> Result<Convolution, NetError> {
        self.convolution(name, [outputs, inputs, kernel, kernel], 1, Padding::same(kernel / 2))
    }

    fn linear(&mut self, name: &str, outputs: usize, inputs: usize) -> Result<Convolution, NetError> {
        let (weights, bias) = self.parameters(name, &[outputs, inputs])?;
        Ok(Convolution::linear(outputs, inputs, &weights, Some(bias)))
    }

    /// A linear layer whose outputs are scaled by `scale` (a layer scale, folded into the weights).
    fn scaled_linear(
        &mut self,
        name: &str,
        outputs: usize,
        inputs: usize,
        scale: &[f32],
    ) -> Result<Convolution, NetError> {
        let (mut weights, mut bias) = self.parameters(name, &[outputs, inputs])?;
        for (o, row) in weights.chunks_exact_mut(inputs).enumerate() {
            row.iter_mut().for_each(|w| *w *= scale[o]);
            bias[o] *= scale[o];
        }
        Ok(Convolution::linear(outputs, inputs, &weights, Some(bias)))
    }

    fn affine(&mut self, name: &str, channels: usize) -> Result<Affine, NetError> {
        let (scale, shift) = self.parameters(name, &[channels])?;
        Ok(Affine { scale, shift })
    }
}

impl<W: Weights + ?Sized> Layers for W {}

/// Reproducible stand-in weights: a function only of the tensor's name and shape.
///
/// Uniform numbers in `[−1, 1)` from FNV-1a of the name and SplitMix64's finaliser, scaled so that
/// activations stay of order one. The golden cases of the networks are made with the same rule. The results
/// have no meaning; time and memory are those of the real weights.
#[derive(Clone, Copy, Debug, Default)]
pub struct StandIn;

impl Weights for StandIn {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        let hash = random::fnv1a(name);
        // The number `i` of the name's sequence, exact in f32.
        let unit = |i: u64| {
            let bits = random::mix(hash.wrapping_add(i).wrapping_add(random::GOLDEN));
            (bits >> 40) as f32 * (1.0 / 8_388_608.0) - 1.0
        };
        let last = name.rsplit('.').next().unwrap_or(name);
        let fan_in: usize = shape.iter().skip(1).product();
        let spread = (3.0 / fan_in as f64).sqrt() as f32;
        let embedding = ["pos_embed", "mask_token", "position_emb", "scale_emb", "cls"].contains(&last)
            || last.starts_with("cls_token");
        let value: Box<dyn Fn(f32) -> f32> = if embedding {
            Box::new(|u| 0.05 * u)
        } else if last == "running_var" {
            Box::new(|u| 1.0 + 0.1 * u.abs())
        } else if last == "running_mean" {
            Box::new(|u| 0.1 * u)
        } else if name == "depth_head.scratch.output_conv2.2.bias" {
            Box::new(|u| 1.0 + 0.1 * u)
        } else if shape.len() > 1 {
            // The LPIPS heads are non-negative.
            let head = name.starts_with("lin") && name.ends_with(".model.1.weight");
            Box::new(move |u| spread * if head { u.abs() } else { u })
        } else if last == "weight" || last == "gamma" {
            Box::new(|u| 1.0 + 0.1 * u)
        } else {
            Box::new(|u| 0.1 * u)
        };
        let n: usize = shape.iter().product();
        Ok((0..n as u64).map(|i| value(unit(i))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stand_in_weights_have_the_published_bits() {
        let rows: [(&str, &[usize], &[u32]); 10] = [
            ("encoder.e_stage1.0.weight", &[64, 3, 3, 3], &[0xbe1c6986, 0x3c96c4c0, 0xbe017e88]),
            ("features.0.bias", &[64], &[0xbd151b00, 0x3c9edfba, 0xbd992760]),
            ("pretrained.blocks.0.norm1.weight", &[384], &[0x3f68e200, 0x3f8423ec, 0x3f6b0971]),
            ("pretrained.pos_embed", &[1, 1370, 384], &[0x3cefc4e7, 0x3ba6f840, 0xbc87788a]),
            ("context_encoder.convnormrelu.1.running_var", &[64], &[0x3f818e2a, 0x3f81d68b, 0x3f85e8b7]),
            ("context_encoder.convnormrelu.1.running_mean", &[64], &[0x3daf282a, 0xbd86ff87, 0xbdb490aa]),
            ("lin0.model.1.weight", &[1, 64, 1, 1], &[0x3e5809d8, 0x3dcc9d77, 0x3d826f3f]),
            ("pretrained.blocks.3.ls1.gamma", &[384], &[0x3f7d90af, 0x3f7e3ae7, 0x3f72b9ce]),
            ("parallel_blocks.0.alpha1", &[1], &[0x3cced067]),
            ("depth_head.scratch.output_conv2.2.bias", &[1], &[0x3f8980e0]),
        ];
        for (name, shape, bits) in rows {
            let values = StandIn.tensor(name, shape).unwrap();
            let found: Vec<u32> = values.iter().take(3).map(|v| v.to_bits()).collect();
            assert_eq!(found, bits, "{name}");
        }
    }
}
