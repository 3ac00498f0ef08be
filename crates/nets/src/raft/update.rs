//! RAFT's recurrent update and the upsampling of its result.
//!
//! Motion: correlation and flow, each after two convolutions, are concatenated and reduced; the flow itself
//! is appended. Two gated units follow, one along rows (1×5), one along columns (5×1): `z, r = σ(conv[h,
//! x])`, `q = tanh(conv[r·h, x])`, `h ← (1 − z)·h + z·q`. Two convolutions turn h into a correction of the
//! flow in pixels of the ⅛ grid.

use rayon::prelude::*;
use use3d_numerics::lanes::exp;

use super::HIDDEN;
use super::correlation::CHANNELS;
use crate::engine::activation::Activation;
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::planes::Planes;
use crate::error::NetError;
use crate::weights::{Layers, Weights};

/// The update block with its weights.
#[derive(Clone, Debug)]
pub(crate) struct Update {
    correlation: [Convolution; 2],
    flow: [Convolution; 2],
    motion: Convolution,
    units: [Gated; 2],
    head: [Convolution; 2],
}

/// One gated recurrent unit. The context is the same in every update, so its part of the sums is computed
/// once.
#[derive(Clone, Debug)]
struct Gated {
    /// z and r in one convolution, because they have the same input.
    gates: Split,
    candidate: Split,
}

/// A convolution of `[h, context, motion]`, split into the context's part and the rest.
#[derive(Clone, Debug)]
struct Split {
    context: Convolution,
    rest: Convolution,
}

/// The context's part of the gates and the candidate of both units.
pub(crate) struct ContextPart([[Planes; 2]; 2]);

impl Update {
    pub(crate) fn read(weights: &mut dyn Weights) -> Result<Self, NetError> {
        let mut conv = |name: &str, outputs, inputs, kernel: usize| {
            weights.same_convolution(&format!("update_block.{name}"), [outputs, inputs], kernel)
        };
        let correlation = [
            conv("motion_encoder.convcorr1.0", 256, CHANNELS, 1)?,
            conv("motion_encoder.convcorr2.0", 192, 256, 3)?,
        ];
        let flow =
            [conv("motion_encoder.convflow1.0", 128, 2, 7)?, conv("motion_encoder.convflow2.0", 64, 128, 3)?];
        let motion = conv("motion_encoder.conv.0", 126, 256, 3)?;
        let head = [conv("flow_head.conv1", 256, 128, 3)?, conv("flow_head.conv2", 2, 256, 3)?];
        let units = [Gated::read("convgru1", (1, 5), weights)?, Gated::read("convgru2", (5, 1), weights)?];
        Ok(Self { correlation, flow, motion, units, head })
    }

    /// The motion features: 126 channels and the flow.
    pub(crate) fn motion(&self, found: &Planes, flow: &Planes) -> Planes {
        let relu = Activation::Relu;
        let correlation = self.correlation[1].forward(&self.correlation[0].forward(found, relu), relu);
        let encoded = self.flow[1].forward(&self.flow[0].forward(flow, relu), relu);
        let mut motion = self.motion.forward_joined(&[&correlation, &encoded], relu);
        motion.data.extend_from_slice(&flow.data);
        motion.channels += 2;
        motion
    }

    /// The context's contribution to every update.
    pub(crate) fn context_part(&self, context: &Planes) -> ContextPart {
        ContextPart([0, 1].map(|i| {
            let unit = &self.units[i];
            [&unit.gates, &unit.candidate].map(|c| c.context.forward(context, Activation::Identity))
        }))
    }

    /// Updates the hidden state.
    pub(crate) fn refine(&self, hidden: &mut Planes, context: &ContextPart, motion: &Planes) {
        for (unit, [for_gates, for_candidate]) in self.units.iter().zip(&context.0) {
            let gates = unit.gates.rest.forward_onto(&[hidden, motion], for_gates, Activation::Sigmoid);
            let (z, r) = gates.data.split_at(hidden.data.len());
            let mut reset = hidden.clone();
            reset.data.iter_mut().zip(r).for_each(|(h, r)| *h *= r);
            let q = unit.candidate.rest.forward_onto(&[&reset, motion], for_candidate, Activation::Tanh);
            for ((h, z), q) in hidden.data.iter_mut().zip(z).zip(&q.data) {
                *h = (1.0 - z) * *h + z * q;
            }
        }
    }

    /// The correction of the flow.
    pub(crate) fn step(&self, hidden: &Planes) -> Planes {
        self.head[1].forward(&self.head[0].forward(hidden, Activation::Relu), Activation::Identity)
    }
}

impl Gated {
    fn read(name: &str, kernel: (usize, usize), weights: &mut dyn Weights) -> Result<Self, NetError> {
        let part = |gate: &str| format!("update_block.recurrent_block.{name}.{gate}");
        Ok(Self {
            gates: Split::read(&[part("convz"), part("convr")], kernel, weights)?,
            candidate: Split::read(&[part("convq")], kernel, weights)?,
        })
    }
}

impl Split {
    /// Reads several convolutions of the same inputs as one.
    fn read(names: &[String], kernel: (usize, usize), weights: &mut dyn Weights) -> Result<Self, NetError> {
        let area = kernel.0 * kernel.1;
        let padding = Padding::of(kernel.0 / 2, kernel.1 / 2);
        let (mut context, mut rest, mut bias) = (Vec::new(), Vec::new(), Vec::new());
        for name in names {
            let (values, biases) = weights.parameters(name, &[HIDDEN, 3 * HIDDEN, kernel.0, kernel.1])?;
            for output in values.chunks_exact(3 * HIDDEN * area) {
                let (hidden, others) = output.split_at(HIDDEN * area);
                let (of_context, motion) = others.split_at(HIDDEN * area);
                context.extend_from_slice(of_context);
                rest.extend_from_slice(hidden);
                rest.extend_from_slice(motion);
            }
            bias.extend(biases);
        }
        let conv = |inputs, values: &[f32], bias| {
            Convolution::new([names.len() * HIDDEN, inputs, kernel.0, kernel.1], values, bias, 1, padding)
        };
        Ok(Self { context: conv(HIDDEN, &context, Some(bias)), rest: conv(2 * HIDDEN, &rest, None) })
    }
}

/// The weights of the convex combinations.
#[derive(Clone, Debug)]
pub(crate) struct Upsampler {
    hidden: Convolution,
    output: Convolution,
}

impl Upsampler {
    pub(crate) fn read(weights: &mut dyn Weights) -> Result<Self, NetError> {
        Ok(Self {
            hidden: weights.same_convolution("mask_predictor.convrelu.0", [256, HIDDEN], 3)?,
            output: weights.same_convolution("mask_predictor.conv", [576, 256], 1)?,
        })
    }

    /// `[9 · 64, height, width]`: for each of 9 neighbours, the scores for the 8 × 8 fine pixels.
    pub(crate) fn mask(&self, hidden: &Planes) -> Planes {
        let mut mask =
            self.output.forward(&self.hidden.forward(hidden, Activation::Relu), Activation::Identity);
        mask.data.iter_mut().for_each(|m| *m *= 0.25);
        mask
    }
}

/// Every fine pixel is the softmax-weighted sum of 8·flow over the 3 × 3 coarse neighbourhood, zeros outside.
pub(crate) fn upsample(flow: &Planes, mask: &Planes) -> Planes {
    let (height, width) = (flow.height, flow.width);
    let area = flow.area();
    let mut out = Planes::new(2, 8 * height, 8 * width);
    let out_area = out.area();
    let (plane_x, plane_y) = out.data.split_at_mut(out_area);
    plane_x.par_chunks_mut(8 * width).zip(plane_y.par_chunks_mut(8 * width)).enumerate().for_each(
        |(fine_y, (row_x, row_y))| {
            let y = fine_y / 8;
            for fine_x in 0..8 * width {
                let x = fine_x / 8;
                let score =
                    |k: usize| mask.data[((k * 8 + fine_y % 8) * 8 + fine_x % 8) * area + y * width + x];
                let largest = (0..9).map(score).fold(f32::NEG_INFINITY, f32::max);
                let (mut total, mut sum) = (0.0f32, [0.0f32; 2]);
                for k in 0..9 {
                    let weight = exp(score(k) - largest);
                    total += weight;
                    let (ny, nx) = ((y + k / 3).wrapping_sub(1), (x + k % 3).wrapping_sub(1));
                    if ny < height && nx < width {
                        sum[0] += weight * 8.0 * flow.data[ny * width + nx];
                        sum[1] += weight * 8.0 * flow.data[area + ny * width + nx];
                    }
                }
                row_x[fine_x] = sum[0] / total;
                row_y[fine_x] = sum[1] / total;
            }
        },
    );
    out
}
