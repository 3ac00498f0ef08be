//! Resampling a picture to another size, by the rules of the tools that the networks were trained with.
//!
//! Every rule is separable: one output coordinate is a weighted sum of a short run of input coordinates.
//! [`ResampleAxis`] holds the runs and weights of one direction (computed in f64); [`resize`] applies two of
//! them. Pillow's 8-bit bilinear is a separate function because it rounds to whole levels after each pass, in
//! fixed point.

use rayon::prelude::*;
use use3d_capture::Image8;

use super::planes::Planes;

/// A resampling rule for one direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Rule {
    /// Linear between pixel centres: source = (i + ½)·in/out − ½, clamped at the first centre.
    Bilinear,
    /// Linear with the corner pixels at the corners: source = i·(in − 1)/(out − 1).
    BilinearCorners,
    /// A triangle filter as wide as the shrink factor (plain [`Rule::Bilinear`] when enlarging).
    BilinearAntialiased,
    /// Keys' cubic with a = −¾ between pixel centres, border pixels repeated.
    Bicubic,
    /// Like [`Rule::Bicubic`], but with a given step between source coordinates instead of in/out.
    BicubicStep(f64),
}

/// For each output coordinate, the first input coordinate and the weights from there on.
pub(crate) struct ResampleAxis {
    first: Vec<usize>,
    /// The start of each output's weights in `weights`, with one more entry at the end.
    offsets: Vec<usize>,
    weights: Vec<f32>,
}

impl ResampleAxis {
    pub(crate) fn new(rule: Rule, input: usize, output: usize) -> Self {
        let mut axis = Self { first: Vec::new(), offsets: vec![0], weights: Vec::new() };
        for i in 0..output {
            let mut taps = rule.taps(i, input, output);
            let last = input as isize - 1;
            // Coordinates outside the picture use the border pixel.
            let first = taps.0.clamp(0, last);
            let end = (taps.0 + taps.1.len() as isize - 1).clamp(0, last);
            let mut merged = vec![0.0f64; (end - first + 1) as usize];
            for (j, w) in taps.1.drain(..).enumerate() {
                merged[((taps.0 + j as isize).clamp(0, last) - first) as usize] += w;
            }
            axis.first.push(first as usize);
            axis.weights.extend(merged.iter().map(|&w| w as f32));
            axis.offsets.push(axis.weights.len());
        }
        axis
    }

    fn len(&self) -> usize {
        self.first.len()
    }

    fn weights(&self, i: usize) -> &[f32] {
        &self.weights[self.offsets[i]..self.offsets[i + 1]]
    }
}

impl Rule {
    /// The first coordinate (possibly outside) and the weights for output `i`.
    fn taps(self, i: usize, input: usize, output: usize) -> (isize, Vec<f64>) {
        let scale = input as f64 / output as f64;
        match self {
            Self::Bilinear => linear((((i as f64) + 0.5) * scale - 0.5).max(0.0)),
            Self::BilinearCorners => {
                let step = if output > 1 { (input - 1) as f64 / (output - 1) as f64 } else { 0.0 };
                linear(i as f64 * step)
            }
            Self::BilinearAntialiased => {
                let (centre, half) = ((i as f64 + 0.5) * scale, scale.max(1.0));
                let first = ((centre - half + 0.5).max(0.0)) as usize;
                let end = ((centre + half + 0.5) as usize).min(input).max(first + 1);
                let raw: Vec<f64> =
                    (first..end).map(|x| (1.0 - ((x as f64 - centre + 0.5) / half).abs()).max(0.0)).collect();
                let total: f64 = raw.iter().sum();
                (first as isize, raw.iter().map(|w| w / total).collect())
            }
            Self::Bicubic => cubic((i as f64 + 0.5) * scale - 0.5),
            Self::BicubicStep(step) => cubic((i as f64 + 0.5) * step - 0.5),
        }
    }
}

fn linear(x: f64) -> (isize, Vec<f64>) {
    let t = x - x.floor();
    (x.floor() as isize, vec![1.0 - t, t])
}

fn cubic(x: f64) -> (isize, Vec<f64>) {
    const A: f64 = -0.75;
    let kernel = |d: f64| {
        let d = d.abs();
        if d <= 1.0 {
            ((A + 2.0) * d - (A + 3.0)) * d * d + 1.0
        } else if d < 2.0 {
            ((A * d - 5.0 * A) * d + 8.0 * A) * d - 4.0 * A
        } else {
            0.0
        }
    };
    let t = x - x.floor();
    (x.floor() as isize - 1, vec![kernel(1.0 + t), kernel(t), kernel(1.0 - t), kernel(2.0 - t)])
}

/// Resamples every plane by the rules of both directions.
pub(crate) fn resize_by(input: &Planes, vertical: &ResampleAxis, horizontal: &ResampleAxis) -> Planes {
    let (height, width) = (vertical.len(), horizontal.len());
    let mut out = Planes::new(input.channels, height, width);
    if out.data.is_empty() {
        return out;
    }
    out.data.par_chunks_mut(width).enumerate().for_each_init(
        || vec![0.0f32; input.width],
        |blend, (row, out)| {
            let (plane, y) = (input.plane(row / height), row % height);
            blend.fill(0.0);
            for (j, &w) in vertical.weights(y).iter().enumerate() {
                let source = &plane[(vertical.first[y] + j) * input.width..][..input.width];
                blend.iter_mut().zip(source).for_each(|(b, s)| *b += w * s);
            }
            for (x, o) in out.iter_mut().enumerate() {
                let weights = horizontal.weights(x);
                let source = &blend[horizontal.first[x]..][..weights.len()];
                *o = weights.iter().zip(source).map(|(w, s)| w * s).sum();
            }
        },
    );
    out
}

/// Resamples every plane to `height × width` by one rule.
pub(crate) fn resize(input: &Planes, height: usize, width: usize, rule: Rule) -> Planes {
    resize_by(
        input,
        &ResampleAxis::new(rule, input.height, height),
        &ResampleAxis::new(rule, input.width, width),
    )
}

/// Pillow's bilinear resampling of 8-bit pictures (releases before 13): triangle filter widened when
/// shrinking, horizontal pass then vertical pass, each rounded to 8 bits from coefficients of 22 fractional
/// bits; a pass that keeps the size is skipped.
pub(crate) fn pillow_bilinear(image: &Image8, width: usize, height: usize) -> Image8 {
    let (in_width, in_height) = (image.width(), image.height());
    let mut current = image.clone();
    if width != in_width {
        let runs = pillow_runs(in_width, width);
        let mut next = Image8::new(width, in_height);
        for c in 0..3 {
            let source = image.plane(c);
            next.plane_mut(c).par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                let source = &source[y * in_width..(y + 1) * in_width];
                for (o, (first, weights)) in row.iter_mut().zip(&runs) {
                    *o = fixed_point(weights, source[*first..].iter());
                }
            });
        }
        current = next;
    }
    if height != in_height {
        let runs = pillow_runs(in_height, height);
        let mut next = Image8::new(width, height);
        for c in 0..3 {
            let source = current.plane(c);
            next.plane_mut(c).par_chunks_mut(width).zip(&runs).for_each(|(row, (first, weights))| {
                for (x, o) in row.iter_mut().enumerate() {
                    *o = fixed_point(weights, source[first * width + x..].iter().step_by(width));
                }
            });
        }
        current = next;
    }
    current
}

const FRACTION_BITS: u32 = 22;

fn pillow_runs(input: usize, output: usize) -> Vec<(usize, Vec<i64>)> {
    let one = f64::from(1u32 << FRACTION_BITS);
    let run = |i| {
        let (first, weights) = Rule::BilinearAntialiased.taps(i, input, output);
        (first as usize, weights.into_iter().map(|w| (w * one + 0.5).floor() as i64).collect())
    };
    (0..output).map(run).collect()
}

fn fixed_point<'a>(weights: &[i64], values: impl Iterator<Item = &'a u8>) -> u8 {
    let half = 1i64 << (FRACTION_BITS - 1);
    let sum: i64 = weights.iter().zip(values).map(|(w, &v)| w * i64::from(v)).sum();
    ((sum + half) >> FRACTION_BITS).clamp(0, 255) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Golden;

    #[test]
    fn golden_resamplers() {
        let golden = Golden::network("resize");
        let input = golden.planes("in");
        let mut checked = 0;
        for name in golden.names() {
            let Some((rule, size)) = name.split_once('.') else { continue };
            let (height, width) = size.split_once('x').expect("HxW");
            let (height, width) = (height.parse().expect("height"), width.parse().expect("width"));
            let (rule, tolerance) = match rule {
                "torch_bilinear" => (Rule::Bilinear, 2e-5),
                "torch_bilinear_ac" => (Rule::BilinearCorners, 2e-5),
                "torch_bilinear_aa" => (Rule::BilinearAntialiased, 2e-5),
                "torch_bicubic" => (Rule::Bicubic, 2e-5),
                "cv2_cubic_f64" => (Rule::Bicubic, 5e-6),
                "pil_bilinear_u8" => {
                    let out = pillow_bilinear(&golden.image8("raw_u8"), width, height);
                    assert_eq!(out, golden.image8(&name), "{name}");
                    checked += 1;
                    continue;
                }
                other => panic!("no resampler {other}"),
            };
            let expected =
                if name.starts_with("cv2") { golden.interleaved(&name) } else { golden.planes(&name).data };
            let source = input.clone();
            golden.close(&name, &resize(&source, height, width, rule).data, &expected, tolerance);
            checked += 1;
        }
        assert!(checked >= 6);
    }

    #[test]
    fn every_axis_has_weights_that_sum_to_one() {
        let rules = [
            Rule::Bilinear,
            Rule::BilinearCorners,
            Rule::BilinearAntialiased,
            Rule::Bicubic,
            Rule::BicubicStep(0.9),
        ];
        for rule in rules {
            for (input, output) in [(1, 1), (1, 5), (7, 1), (7, 7), (9, 4), (4, 31)] {
                let axis = ResampleAxis::new(rule, input, output);
                for i in 0..output {
                    let sum: f32 = axis.weights(i).iter().sum();
                    assert!((sum - 1.0).abs() < 1e-6, "{rule:?} {input} {output}");
                    assert!(axis.first[i] + axis.weights(i).len() <= input);
                }
            }
        }
    }
}
