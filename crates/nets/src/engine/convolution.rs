//! Convolutions: `out[o, y, x] = bias[o] + Σ_{c,i,j} w[o, c, i, j] · in[c, s·y + i − top, s·x + j − left]`,
//! zeros outside.
//!
//! A dense convolution is one [`product`] whose panels are gathered windows. A depthwise one (one kernel per
//! channel) has too few operations per value for that and is a direct loop. A transposed convolution whose
//! stride equals its kernel is a 1×1 convolution to `kernel²` times the channels, whose results are arranged
//! as blocks of pixels.

use rayon::prelude::*;

use super::activation::Activation;
use super::planes::Planes;
use super::product::{Finish, LANES, Packed, fill_from_rows, product};

/// Zeros added around a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Padding {
    pub(crate) top: usize,
    pub(crate) left: usize,
    pub(crate) bottom: usize,
    pub(crate) right: usize,
}

impl Padding {
    pub(crate) const fn same(pad: usize) -> Self {
        Self { top: pad, left: pad, bottom: pad, right: pad }
    }

    pub(crate) const fn of(vertical: usize, horizontal: usize) -> Self {
        Self { top: vertical, left: horizontal, bottom: vertical, right: horizontal }
    }
}

/// A dense convolution, also a linear layer (kernel 1×1 on tokens).
#[derive(Clone, Debug)]
pub(crate) struct Convolution {
    weights: Packed,
    bias: Option<Vec<f32>>,
    inputs: usize,
    kernel: (usize, usize),
    stride: usize,
    padding: Padding,
}

impl Convolution {
    /// `weights` is `[outputs, inputs, kernel.0, kernel.1]`, row-major.
    pub(crate) fn new(
        shape: [usize; 4],
        weights: &[f32],
        bias: Option<Vec<f32>>,
        stride: usize,
        padding: Padding,
    ) -> Self {
        let [outputs, inputs, high, wide] = shape;
        Self {
            weights: Packed::from_row_major(outputs, inputs * high * wide, weights),
            bias,
            inputs,
            kernel: (high, wide),
            stride,
            padding,
        }
    }

    /// A linear layer: `weights` is `[outputs, inputs]`.
    pub(crate) fn linear(outputs: usize, inputs: usize, weights: &[f32], bias: Option<Vec<f32>>) -> Self {
        Self::new([outputs, inputs, 1, 1], weights, bias, 1, Padding::same(0))
    }

    /// Output channels.
    pub(crate) fn outputs(&self) -> usize {
        self.weights.rows
    }

    /// Height and width of the output for an input of `height × width`.
    pub(crate) fn output_size(&self, height: usize, width: usize) -> (usize, usize) {
        let p = self.padding;
        (
            (height + p.top + p.bottom - self.kernel.0) / self.stride + 1,
            (width + p.left + p.right - self.kernel.1) / self.stride + 1,
        )
    }

    /// The convolution of one picture.
    pub(crate) fn forward(&self, input: &Planes, activation: Activation) -> Planes {
        self.forward_joined(&[input], activation)
    }

    /// The convolution of the channels of several pictures of one size, concatenated.
    pub(crate) fn forward_joined(&self, inputs: &[&Planes], activation: Activation) -> Planes {
        let (height, width) = self.output_size(inputs[0].height, inputs[0].width);
        let mut out = Planes::new(self.outputs(), height, width);
        self.run(inputs, Finish { activation, ..Finish::default() }, &mut out);
        out
    }

    /// Like [`forward_joined`](Self::forward_joined), with maps of the output's size added before the
    /// activation: the part of a convolution whose inputs do not change from call to call.
    pub(crate) fn forward_onto(&self, inputs: &[&Planes], addend: &Planes, activation: Activation) -> Planes {
        let mut out = Planes::new(addend.channels, addend.height, addend.width);
        let finish = Finish { addend: Some(&addend.data), activation, ..Finish::default() };
        self.run(inputs, finish, &mut out);
        out
    }

    /// Adds the convolution to `out`.
    pub(crate) fn add_to(&self, input: &Planes, out: &mut Planes) {
        self.run(&[input], Finish { accumulate: true, ..Finish::default() }, out);
    }

    fn run<'a>(&'a self, inputs: &[&Planes], finish: Finish<'a>, out: &mut Planes) {
        let (height, width) = (inputs[0].height, inputs[0].width);
        assert!(inputs.iter().all(|p| p.height == height && p.width == width));
        assert_eq!(inputs.iter().map(|p| p.channels).sum::<usize>(), self.inputs, "input channels");
        assert_eq!(
            (self.output_size(height, width), out.channels),
            ((out.height, out.width), self.outputs())
        );
        let finish = Finish { bias: self.bias.as_deref(), ..finish };
        let columns = out.area();
        let pointwise = self.kernel == (1, 1) && self.stride == 1 && self.padding == Padding::same(0);
        if let (true, [input]) = (pointwise, inputs) {
            product(&self.weights, columns, finish, &mut out.data, |first, panel| {
                fill_from_rows(&input.data, columns, first, panel);
            });
            return;
        }
        let channels: Vec<&[f32]> =
            inputs.iter().flat_map(|p| (0..p.channels).map(move |c| p.plane(c))).collect();
        let out_width = out.width;
        product(&self.weights, columns, finish, &mut out.data, |first, panel| {
            self.gather(&channels, height, width, out_width, columns, first, panel);
        });
    }

    /// Fills one panel, `[channel][ky][kx][LANES]`, with the windows of the output pixels from `first` on.
    fn gather(
        &self,
        channels: &[&[f32]],
        height: usize,
        width: usize,
        out_width: usize,
        columns: usize,
        first: usize,
        panel: &mut [f32],
    ) {
        let last = (first + LANES).min(columns);
        let one_row = first / out_width == (last - 1) / out_width && last - first == LANES;
        let (panel, _) = panel.as_chunks_mut::<LANES>();
        for (plane, taps) in channels.iter().zip(panel.chunks_exact_mut(self.kernel.0 * self.kernel.1)) {
            for (ky, row) in taps.chunks_exact_mut(self.kernel.1).enumerate() {
                for (kx, at_k) in row.iter_mut().enumerate() {
                    if one_row && self.stride == 1 {
                        let y = (first / out_width + ky).wrapping_sub(self.padding.top);
                        let x = (first % out_width + kx).wrapping_sub(self.padding.left);
                        if y >= height {
                            at_k.fill(0.0);
                            continue;
                        }
                        if x < width && x + LANES <= width {
                            at_k.copy_from_slice(&plane[y * width + x..][..LANES]);
                            continue;
                        }
                    }
                    let mut p = first;
                    let mut filled = 0;
                    while p < last {
                        // One run of output pixels of one row.
                        let (oy, ox) = (p / out_width, p % out_width);
                        let run = (out_width - ox).min(last - p);
                        let out = &mut at_k[filled..filled + run];
                        let y = (self.stride * oy + ky).wrapping_sub(self.padding.top);
                        if y >= height {
                            out.fill(0.0);
                        } else {
                            let row = &plane[y * width..][..width];
                            self.gather_run(row, ox, kx, out);
                        }
                        p += run;
                        filled += run;
                    }
                    at_k[filled..].fill(0.0);
                }
            }
        }
    }

    /// One run of a row: `out[i] = row[stride·(x + i) + kx − left]`, zeros outside.
    fn gather_run(&self, row: &[f32], x: usize, kx: usize, out: &mut [f32]) {
        let start = (self.stride * x + kx) as isize - self.padding.left as isize;
        if self.stride == 1 {
            let before = (-start).clamp(0, out.len() as isize) as usize;
            let inside = (row.len() as isize - start).clamp(before as isize, out.len() as isize) as usize;
            out[..before].fill(0.0);
            if before < inside {
                let from = (start + before as isize) as usize;
                out[before..inside].copy_from_slice(&row[from..from + inside - before]);
            }
            out[inside..].fill(0.0);
        } else {
            for (i, o) in out.iter_mut().enumerate() {
                let at = start + (self.stride * i) as isize;
                *o = if at >= 0 { row.get(at as usize).copied().unwrap_or(0.0) } else { 0.0 };
            }
        }
    }
}

/// One square kernel of odd size per channel, stride 1, padded to keep the size.
#[derive(Clone, Debug)]
pub(crate) struct Depthwise {
    weights: Vec<f32>,
    bias: Vec<f32>,
    kernel: usize,
}

impl Depthwise {
    /// `weights` is `[channels, 1, kernel, kernel]`.
    pub(crate) fn new(kernel: usize, weights: Vec<f32>, bias: Vec<f32>) -> Self {
        assert_eq!(weights.len(), bias.len() * kernel * kernel);
        Self { weights, bias, kernel }
    }

    pub(crate) fn channels(&self) -> usize {
        self.bias.len()
    }

    /// `out[c] = bias[c] + w[c] ∗ in[c]` for the planes of `input` (`[channels][height × width]`).
    pub(crate) fn forward(&self, input: &[f32], height: usize, width: usize, out: &mut [f32]) {
        let (k, pad, area) = (self.kernel, self.kernel / 2, height * width);
        assert_eq!((input.len(), out.len()), (self.channels() * area, self.channels() * area));
        out.par_chunks_mut(area).zip(input.par_chunks(area)).enumerate().for_each(|(c, (out, plane))| {
            let weights = &self.weights[c * k * k..(c + 1) * k * k];
            for y in 0..height {
                let row = &mut out[y * width..(y + 1) * width];
                row.fill(self.bias[c]);
                for ky in 0..k {
                    let iy = (y + ky).wrapping_sub(pad);
                    if iy >= height {
                        continue;
                    }
                    let source = &plane[iy * width..(iy + 1) * width];
                    for kx in 0..k {
                        let w = weights[ky * k + kx];
                        // Output x reads source x + kx − pad.
                        let from = pad.saturating_sub(kx).min(width);
                        let to = (width + pad).saturating_sub(kx).min(width).max(from);
                        if from < to {
                            let source = &source[from + kx - pad..to + kx - pad];
                            row[from..to].iter_mut().zip(source).for_each(|(o, s)| *o += w * s);
                        }
                    }
                }
            }
        });
    }
}

/// A transposed convolution whose stride equals its kernel: every input pixel becomes a block of `kernel ×
/// kernel`.
#[derive(Clone, Debug)]
pub(crate) struct BlockUpsampling {
    weights: Convolution,
    kernel: usize,
}

impl BlockUpsampling {
    /// `weights` is `[inputs, outputs, kernel, kernel]`.
    pub(crate) fn new(inputs: usize, outputs: usize, kernel: usize, weights: &[f32], bias: &[f32]) -> Self {
        let block = kernel * kernel;
        let rows = outputs * block;
        let packed = Packed::new(rows, inputs, |row, k| weights[k * rows + row]);
        let bias = (0..rows).map(|row| bias[row / block]).collect();
        let (bias, padding) = (Some(bias), Padding::same(0));
        let weights = Convolution { weights: packed, bias, inputs, kernel: (1, 1), stride: 1, padding };
        Self { weights, kernel }
    }

    pub(crate) fn forward(&self, input: &Planes) -> Planes {
        let k = self.kernel;
        let blocks = self.weights.forward(input, Activation::Identity);
        let mut out = Planes::new(blocks.channels / (k * k), input.height * k, input.width * k);
        let (area, width) = (out.area(), out.width);
        out.data.par_chunks_mut(area).enumerate().for_each(|(c, plane)| {
            for (y, row) in plane.chunks_exact_mut(width).enumerate() {
                for j in 0..k {
                    let source =
                        &blocks.plane((c * k + y % k) * k + j)[(y / k) * input.width..][..input.width];
                    for (x, v) in source.iter().enumerate() {
                        row[x * k + j] = *v;
                    }
                }
            }
        });
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;

    /// The definition, in f64.
    fn plain(
        shape: [usize; 4],
        w: &[f32],
        bias: &[f32],
        stride: usize,
        p: Padding,
        input: &Planes,
    ) -> Vec<f64> {
        let [outputs, inputs, kh, kw] = shape;
        let height = (input.height + p.top + p.bottom - kh) / stride + 1;
        let width = (input.width + p.left + p.right - kw) / stride + 1;
        let mut out = Vec::new();
        for o in 0..outputs {
            for y in 0..height {
                for x in 0..width {
                    let mut sum = f64::from(bias[o]);
                    for c in 0..inputs {
                        for i in 0..kh {
                            for j in 0..kw {
                                let (iy, ix) = (
                                    (y * stride + i).wrapping_sub(p.top),
                                    (x * stride + j).wrapping_sub(p.left),
                                );
                                if iy < input.height && ix < input.width {
                                    let v = input.plane(c)[iy * input.width + ix];
                                    sum += f64::from(w[((o * inputs + c) * kh + i) * kw + j]) * f64::from(v);
                                }
                            }
                        }
                    }
                    out.push(sum);
                }
            }
        }
        out
    }

    fn close(actual: &[f32], expected: &[f64]) {
        assert_eq!(actual.len(), expected.len());
        for (a, e) in actual.iter().zip(expected) {
            assert!((f64::from(*a) - e).abs() < 2e-5 * e.abs().max(1.0), "{a} instead of {e}");
        }
    }

    #[test]
    fn equals_the_definition_for_every_kernel_stride_and_padding_in_use() {
        let uneven = Padding { top: 2, left: 2, bottom: 3, right: 3 };
        let cases: [([usize; 4], usize, Padding, usize, usize); 12] = [
            ([9, 3, 3, 3], 1, Padding::same(1), 7, 113),
            ([4, 5, 3, 3], 1, Padding::same(1), 5, 6),
            ([4, 2, 3, 3], 1, Padding::same(1), 1, 1),
            ([4, 2, 3, 3], 1, Padding::same(1), 2, 200),
            ([8, 3, 11, 11], 4, Padding::same(2), 40, 51),
            ([8, 3, 7, 7], 2, Padding::same(3), 19, 30),
            ([6, 3, 7, 7], 2, uneven, 32, 32),
            ([6, 4, 1, 5], 1, Padding::of(0, 2), 6, 60),
            ([6, 4, 5, 1], 1, Padding::of(2, 0), 6, 60),
            ([6, 4, 1, 1], 2, Padding::same(0), 9, 11),
            ([6, 4, 1, 1], 1, Padding::same(0), 9, 11),
            ([5, 3, 14, 14], 14, Padding::same(0), 28, 42),
        ];
        for (n, (shape, stride, padding, height, width)) in cases.into_iter().enumerate() {
            let input =
                Planes::from_data(shape[1], height, width, noise(n as u64, shape[1] * height * width));
            let w = noise(100 + n as u64, shape.iter().product());
            let bias = noise(200 + n as u64, shape[0]);
            let conv = Convolution::new(shape, &w, Some(bias.clone()), stride, padding);
            let expected = plain(shape, &w, &bias, stride, padding, &input);
            close(&conv.forward(&input, Activation::Identity).data, &expected);
            // The same channels as two separate inputs.
            let (first, second) = (input.slice(0..1), input.slice(1..shape[1]));
            close(&conv.forward_joined(&[&first, &second], Activation::Identity).data, &expected);
            // One of the two inputs as a part computed in advance.
            let kernel = shape[2] * shape[3];
            let part = |channels: std::ops::Range<usize>, bias: Option<Vec<f32>>| {
                let picked: Vec<f32> = w
                    .chunks_exact(shape[1] * kernel)
                    .flat_map(|o| o[channels.start * kernel..channels.end * kernel].to_vec())
                    .collect();
                Convolution::new(
                    [shape[0], channels.len(), shape[2], shape[3]],
                    &picked,
                    bias,
                    stride,
                    padding,
                )
            };
            let before = part(0..1, Some(bias.clone())).forward(&first, Activation::Identity);
            let rest = part(1..shape[1], None).forward_onto(&[&second], &before, Activation::Identity);
            close(&rest.data, &expected);
        }
    }

    #[test]
    fn depthwise_equals_the_definition() {
        for (kernel, height, width) in [(3, 5, 7), (5, 1, 1), (7, 4, 60), (7, 2, 2)] {
            let input = Planes::from_data(3, height, width, noise(1, 3 * height * width));
            let (w, bias) = (noise(2, 3 * kernel * kernel), noise(3, 3));
            let mut out = vec![0.0; input.data.len()];
            Depthwise::new(kernel, w.clone(), bias.clone()).forward(&input.data, height, width, &mut out);
            for c in 0..3 {
                let one = input.slice(c..c + 1);
                let w = &w[c * kernel * kernel..(c + 1) * kernel * kernel];
                let expected =
                    plain([1, 1, kernel, kernel], w, &bias[c..=c], 1, Padding::same(kernel / 2), &one);
                close(&out[c * height * width..(c + 1) * height * width], &expected);
            }
        }
    }

    #[test]
    fn block_upsampling_is_a_transposed_convolution() {
        let (inputs, outputs, k) = (3, 2, 4);
        let input = Planes::from_data(inputs, 5, 6, noise(1, inputs * 30));
        let (w, bias) = (noise(2, inputs * outputs * k * k), noise(3, outputs));
        let out = BlockUpsampling::new(inputs, outputs, k, &w, &bias).forward(&input);
        let mut expected = vec![0.0; out.data.len()];
        for o in 0..outputs {
            for y in 0..5 * k {
                for x in 0..6 * k {
                    let mut sum = f64::from(bias[o]);
                    for c in 0..inputs {
                        let v = input.plane(c)[(y / k) * 6 + x / k];
                        sum += f64::from(w[((c * outputs + o) * k + y % k) * k + x % k]) * f64::from(v);
                    }
                    expected[(o * 5 * k + y) * 6 * k + x] = sum;
                }
            }
        }
        close(&out.data, &expected);
    }
}
