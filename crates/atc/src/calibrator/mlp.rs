//! The multilayer perceptron of a head: three linear layers with SiLU between, with hand-written forward
//! and backward passes.
//!
//! `h₁ = silu(W₁ x + b₁)`, `h₂ = silu(W₂ h₁ + b₂)`, `y = W₃ h₂ + b₃` with `silu(z) = z σ(z)` and
//! `silu'(z) = σ(z) (1 + z (1 − σ(z)))`. Rows of a batch are independent; weight gradients sum over the
//! batch in row order.

use rayon::prelude::*;
use use3d_numerics::functions::scalar::logistic;
use use3d_numerics::random::{Purpose, Stream};

use super::product::{Matrix, accumulate};
use crate::vectorized::vectorized;

/// A linear layer, `y = W x + b`.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear {
    /// `[outputs][inputs]`.
    pub weight: Vec<f32>,
    /// `[outputs]`.
    pub bias: Vec<f32>,
}

impl Linear {
    /// A layer of zeros.
    pub fn zeros(inputs: usize, outputs: usize) -> Self {
        Self { weight: vec![0.0; inputs * outputs], bias: vec![0.0; outputs] }
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.weight.len() / self.bias.len().max(1)
    }

    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// `out = x Wᵀ + b`, one row per sample.
    fn forward(&self, x: &[f32], out: &mut Vec<f32>, packed: &mut Vec<f32>) {
        let rows = x.len() / self.inputs();
        out.clear();
        for _ in 0..rows {
            out.extend_from_slice(&self.bias);
        }
        accumulate(
            Matrix::new(x, self.inputs()),
            Matrix::new(&self.weight, self.inputs()).transposed(),
            out,
            packed,
        );
    }

    /// Adds the parameter gradients of a batch, from its inputs `x` and the gradients `d_out` of its
    /// outputs.
    fn add_gradient(&mut self, x: &[f32], d_out: &[f32], packed: &mut Vec<f32>) {
        let (inputs, outputs) = (self.inputs(), self.outputs());
        accumulate(
            Matrix::new(d_out, outputs).transposed(),
            Matrix::new(x, inputs),
            &mut self.weight,
            packed,
        );
        for row in d_out.chunks_exact(outputs) {
            for (g, &o) in self.bias.iter_mut().zip(row) {
                *g += o;
            }
        }
    }

    /// `d_out W`: the gradients of the inputs.
    fn backward_of_inputs(&self, d_out: &[f32], d_x: &mut Vec<f32>, packed: &mut Vec<f32>) {
        d_x.clear();
        d_x.resize(d_out.len() / self.outputs() * self.inputs(), 0.0);
        accumulate(Matrix::new(d_out, self.outputs()), Matrix::new(&self.weight, self.inputs()), d_x, packed);
    }
}

/// Three linear layers with SiLU between.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    /// The layers, first to last.
    pub layers: [Linear; 3],
}

/// Values that a forward pass stores for the backward pass, and working memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Trace {
    hidden: [Vec<f32>; 2],
    slope: [Vec<f32>; 2],
    pub(super) output: Vec<f32>,
    d_hidden: [Vec<f32>; 2],
    packed: Vec<f32>,
}

impl Mlp {
    /// A network of zeros: a head with it changes nothing.
    pub fn zeros(inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            layers: [
                Linear::zeros(inputs, hidden),
                Linear::zeros(hidden, hidden),
                Linear::zeros(hidden, outputs),
            ],
        }
    }

    /// Weights and biases uniform in `±1/√inputs` of each layer, drawn under `seed` and `purpose`.
    pub fn random(inputs: usize, hidden: usize, outputs: usize, seed: u64, purpose: Purpose) -> Self {
        let mut mlp = Self::zeros(inputs, hidden, outputs);
        for (index, layer) in mlp.layers.iter_mut().enumerate() {
            let stream = Stream::new(seed, purpose, index as u64);
            let bound = 1.0 / (layer.inputs() as f64).sqrt();
            for (i, v) in layer.weight.iter_mut().chain(&mut layer.bias).enumerate() {
                *v = ((2.0 * stream.uniform(i as u64) - 1.0) * bound) as f32;
            }
        }
        mlp
    }

    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.layers[2].outputs()
    }

    /// The parameter slices, in a fixed order.
    pub(super) fn parameters_mut(&mut self) -> impl Iterator<Item = &mut Vec<f32>> {
        self.layers.iter_mut().flat_map(|l| [&mut l.weight, &mut l.bias])
    }

    /// The parameter slices, in the same order.
    pub(super) fn parameters(&self) -> impl Iterator<Item = &Vec<f32>> {
        self.layers.iter().flat_map(|l| [&l.weight, &l.bias])
    }

    /// Computes the outputs for rows of inputs, into `trace.output`.
    pub(super) fn forward(&self, x: &[f32], trace: &mut Trace) {
        let Trace { hidden, slope, output, packed, .. } = trace;
        let [first, second] = hidden;
        self.layers[0].forward(x, first, packed);
        activate(first, &mut slope[0]);
        self.layers[1].forward(first, second, packed);
        activate(second, &mut slope[1]);
        self.layers[2].forward(second, output, packed);
    }

    /// Adds to `gradients` those of the batch whose forward pass stored `trace`, from the gradients of its
    /// outputs.
    pub(super) fn backward(&self, x: &[f32], d_output: &[f32], trace: &mut Trace, gradients: &mut Mlp) {
        let Trace { hidden, slope, d_hidden, packed, .. } = trace;
        let [one, two] = d_hidden;
        gradients.layers[2].add_gradient(&hidden[1], d_output, packed);
        self.layers[2].backward_of_inputs(d_output, two, packed);
        multiply(two, &slope[1]);
        gradients.layers[1].add_gradient(&hidden[0], two, packed);
        self.layers[1].backward_of_inputs(two, one, packed);
        multiply(one, &slope[0]);
        gradients.layers[0].add_gradient(x, one, packed);
    }
}

const CHUNK: usize = 8192;

/// Applies SiLU in place and writes its derivative to `slope`.
fn activate(values: &mut [f32], slope: &mut Vec<f32>) {
    slope.resize(values.len(), 0.0);
    values.par_chunks_mut(CHUNK).zip(slope.par_chunks_mut(CHUNK)).for_each(|(values, slope)| {
        vectorized!({
            for (v, s) in values.iter_mut().zip(slope) {
                let z = *v;
                let sigma = logistic(z);
                *v = z * sigma;
                *s = sigma * (1.0 + z * (1.0 - sigma));
            }
        });
    });
}

fn multiply(values: &mut [f32], by: &[f32]) {
    values.par_chunks_mut(CHUNK).zip(by.par_chunks(CHUNK)).for_each(|(values, by)| {
        vectorized!({
            for (v, b) in values.iter_mut().zip(by) {
                *v *= b;
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_agree_with_finite_differences() {
        let mut mlp = Mlp::random(7, 11, 5, 3, Purpose::new("test"));
        let stream = Stream::new(1, Purpose::new("inputs"), 0);
        let rows = 9;
        let x: Vec<f32> = (0..7 * rows).map(|i| stream.normal(i as u64) as f32).collect();
        let d_output: Vec<f32> = (0..5 * rows).map(|i| stream.normal(1000 + i as u64) as f32).collect();
        let mut trace = Trace::default();
        mlp.forward(&x, &mut trace);
        let mut gradients = Mlp::zeros(7, 11, 5);
        mlp.backward(&x, &d_output, &mut trace, &mut gradients);
        let mut value = |mlp: &Mlp| -> f64 {
            mlp.forward(&x, &mut trace);
            trace.output.iter().zip(&d_output).map(|(&o, &d)| f64::from(o) * f64::from(d)).sum()
        };
        for which in 0..6 {
            for index in 0..3 {
                let step = 1.0 / 256.0;
                let at = |mlp: &mut Mlp, delta: f32| {
                    let slice = mlp.parameters_mut().nth(which).unwrap();
                    let i = index * 5 % slice.len();
                    slice[i] += delta;
                    i
                };
                let i = at(&mut mlp, step);
                let up = value(&mlp);
                at(&mut mlp, -2.0 * step);
                let down = value(&mlp);
                at(&mut mlp, step);
                let numeric = (up - down) / (2.0 * f64::from(step));
                let analytic = f64::from(gradients.parameters().nth(which).unwrap()[i]);
                assert!(
                    (numeric - analytic).abs() < 2e-3 * analytic.abs().max(1.0),
                    "parameter {which}[{i}]: {analytic} against {numeric}"
                );
            }
        }
    }
}
