//! The appearance network of 3D-UIR: photographs of one scene differ in light and white balance.
//!
//! ```text
//! [g, b] = W₂ σ(W₁ [c_i, z_v] + b₁) + b₂          c'_i = c_i (1 + g) + b          R = 0
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | c, c' | a Gaussian's constant colour `½ + C₀ h`, of the scene and as a view shows it | 3 |
//! | g, b | change of its gain, and its bias | 3, 3 |
//! | z | code of the view; their mean for views that are not trained, and for the scene at the end | 16 |
//! | W₁, b₁, W₂, b₂ | weights of the network | 32 × 19, 32, 6 × 32, 6 |
//!
//! Values lie in the order W₁ over c, W₁ over z, b₁, W₂, b₂, codes. W₂ starts at zero, so all views begin
//! with the scene's own colours.

use rayon::prelude::*;
use use3d_numerics::functions::scalar::sigmoid;
use use3d_numerics::random::{Purpose, Stream};
use use3d_numerics::spherical_harmonics::C0;

use super::{ColorModel, ColorRole};

const CODE: usize = 16;
const HIDDEN: usize = 32;
const OUTPUTS: usize = 6;
/// The first value of each run but W₁ over c: of W₁ over z, b₁, W₂, b₂, codes.
const STARTS: [usize; 5] = {
    let (code, bias) = (3 * HIDDEN, (3 + CODE) * HIDDEN);
    let outer = bias + HIDDEN;
    [code, bias, outer, outer + OUTPUTS * HIDDEN, outer + OUTPUTS * HIDDEN + OUTPUTS]
};
/// Gaussians of a task.
const CHUNK: usize = 1024;

/// The field. Its parameters lie outside.
pub(super) struct AppearanceNetwork;

/// The network for one view.
struct Seen<'a> {
    inner: &'a [f32],
    /// b₁ + W₁ z of the view.
    offset: [f32; HIDDEN],
    outer: &'a [f32],
    bias: &'a [f32],
}

impl<'a> Seen<'a> {
    fn new(values: &'a [f32], z: &[f32]) -> Self {
        let [code, bias, outer, last, codes] = STARTS;
        let offset = std::array::from_fn(|j| {
            let row = values[code + j * CODE..][..CODE].iter().zip(z);
            row.fold(values[bias + j], |sum, (w, z)| sum + w * z)
        });
        Self { inner: &values[..code], offset, outer: &values[outer..last], bias: &values[last..codes] }
    }

    /// Hidden units, and gain and bias of a colour.
    #[inline(always)]
    fn change(&self, color: [f32; 3]) -> ([f32; HIDDEN], [f32; OUTPUTS]) {
        let mut hidden = self.offset;
        for (h, row) in hidden.iter_mut().zip(self.inner.chunks_exact(3)) {
            *h = sigmoid(row.iter().zip(color).fold(*h, |sum, (w, c)| sum + w * c));
        }
        let mut out = [0.0; OUTPUTS];
        for ((out, row), bias) in out.iter_mut().zip(self.outer.chunks_exact(HIDDEN)).zip(self.bias) {
            *out = row.iter().zip(&hidden).fold(*bias, |sum, (w, h)| sum + w * h);
        }
        (hidden, out)
    }
}

/// The colour of constant coefficients.
#[inline(always)]
fn color(constant: [f32; 3]) -> [f32; 3] {
    constant.map(|h| C0 * h + 0.5)
}

/// The gradient of a task: W₁ over c, the hidden units' offsets, W₂ and b₂.
#[derive(Clone)]
struct NetworkSums {
    inner: [f32; 3 * HIDDEN],
    offset: [f32; HIDDEN],
    outer: [f32; OUTPUTS * HIDDEN],
    bias: [f32; OUTPUTS],
}

impl NetworkSums {
    /// Adds a Gaussian with the gradient of its shown coefficients, which becomes that of its own.
    #[inline(always)]
    fn add(&mut self, seen: &Seen<'_>, constant: [f32; 3], d: &mut [f32; 3]) {
        let color = color(constant);
        let (hidden, out) = seen.change(color);
        let d_shown = d.map(|d| d / C0);
        let mut d_color: [f32; 3] = std::array::from_fn(|c| d_shown[c] * (1.0 + out[c]));
        let mut d_hidden = [0.0f32; HIDDEN];
        for k in 0..OUTPUTS {
            let d_out = if k < 3 { d_shown[k] * color[k] } else { d_shown[k - 3] };
            self.bias[k] += d_out;
            for j in 0..HIDDEN {
                self.outer[k * HIDDEN + j] += d_out * hidden[j];
                d_hidden[j] += d_out * seen.outer[k * HIDDEN + j];
            }
        }
        for j in 0..HIDDEN {
            let d_unit = d_hidden[j] * hidden[j] * (1.0 - hidden[j]);
            self.offset[j] += d_unit;
            for c in 0..3 {
                self.inner[3 * j + c] += d_unit * color[c];
                d_color[c] += d_unit * seen.inner[3 * j + c];
            }
        }
        *d = d_color.map(|d| d * C0);
    }
}

impl ColorModel for AppearanceNetwork {
    fn groups(&self, views: usize) -> Vec<(ColorRole, usize)> {
        vec![(ColorRole::Network, STARTS[4]), (ColorRole::Code, views * CODE)]
    }

    fn start(&self, views: usize, seed: u64) -> Vec<f32> {
        let [_, bias, _, _, codes] = STARTS;
        let stream = Stream::new(seed, Purpose::new("appearance"), 0);
        let bound = |i: usize| match i {
            i if i < bias => (6.0 / (3 + CODE + HIDDEN) as f64).sqrt(),
            i if i < codes => 0.0,
            _ => 0.1,
        };
        (0..codes + views * CODE)
            .map(|i| ((2.0 * stream.uniform(i as u64) - 1.0) * bound(i)) as f32)
            .collect()
    }

    fn show(&self, values: &[f32], view: Option<usize>, _means: &[[f32; 3]], constants: &mut [[f32; 3]]) {
        let codes = values[STARTS[4]..].chunks_exact(CODE);
        let code = match view {
            Some(view) => codes.skip(view).take(1).flatten().copied().collect::<Vec<_>>(),
            None => {
                let each = 1.0 / codes.len().max(1) as f32;
                (0..CODE).map(|k| codes.clone().map(|code| code[k]).sum::<f32>() * each).collect()
            }
        };
        let seen = Seen::new(values, &code);
        constants.par_iter_mut().with_min_len(CHUNK).for_each(|constant| {
            let color = color(*constant);
            let (_, out) = seen.change(color);
            *constant = std::array::from_fn(|c| constant[c] + (color[c] * out[c] + out[3 + c]) / C0);
        });
    }

    fn backward(
        &self,
        values: &[f32],
        view: usize,
        _means: &[[f32; 3]],
        constants: &[[f32; 3]],
        _weight: f64,
        d_sh: &mut [[[f32; 3]; 16]],
        gradient: &mut [f32],
    ) -> f64 {
        let [code, bias, outer, last, codes] = STARTS;
        let z = codes + view * CODE..codes + (view + 1) * CODE;
        let seen = Seen::new(values, &values[z.clone()]);
        let tasks: Vec<NetworkSums> = (constants.par_chunks(CHUNK))
            .zip(d_sh.par_chunks_mut(CHUNK))
            .map(|(constants, d_sh)| {
                let mut sums = NetworkSums {
                    inner: [0.0; 3 * HIDDEN],
                    offset: [0.0; HIDDEN],
                    outer: [0.0; OUTPUTS * HIDDEN],
                    bias: [0.0; OUTPUTS],
                };
                for (constant, d_sh) in constants.iter().zip(d_sh) {
                    sums.add(&seen, *constant, &mut d_sh[0]);
                }
                sums
            })
            .collect();
        let mut offset = [0.0f32; HIDDEN];
        let add = |sum: &mut [f32], own: &[f32]| sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
        for task in &tasks {
            add(&mut gradient[..code], &task.inner);
            add(&mut gradient[outer..last], &task.outer);
            add(&mut gradient[last..codes], &task.bias);
            add(&mut offset, &task.offset);
        }
        add(&mut gradient[bias..outer], &offset);
        for (j, d) in offset.iter().enumerate() {
            for k in 0..CODE {
                gradient[code + j * CODE + k] += d * values[z.start + k];
                gradient[z.start + k] += d * values[code + j * CODE + k];
            }
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use use3d_golden::Part;

    use super::*;

    #[test]
    fn golden_appearance() {
        let part = Part::math("uir");
        let case = part.cases().into_iter().find(|case| case.name() == "appearance").unwrap();
        let (values, view) = (case.f32("in.values"), case.count("view"));
        let constants: Vec<[f32; 3]> = case.rows("in.constants");
        let count: usize = AppearanceNetwork.groups(case.count("views")).iter().map(|(_, count)| count).sum();
        assert_eq!(count, values.len());
        let (mut shown, mut mean) = (constants.clone(), constants.clone());
        AppearanceNetwork.show(&values, Some(view), &[], &mut shown);
        AppearanceNetwork.show(&values, None, &[], &mut mean);
        case.check("out.shown", shown.as_flattened());
        case.check("out.mean", mean.as_flattened());
        let mut d_sh = vec![[[0.0; 3]; 16]; constants.len()];
        let d: Vec<[f32; 3]> = case.rows("cot.shown");
        d_sh.iter_mut().zip(d).for_each(|(sh, d)| sh[0] = d);
        let mut gradient = vec![0.0; values.len()];
        AppearanceNetwork.backward(&values, view, &[], &constants, 0.0, &mut d_sh, &mut gradient);
        case.check("grad.shown.values", &gradient);
        let d_constants: Vec<f32> = d_sh.iter().flat_map(|sh| sh[0]).collect();
        case.check("grad.shown.constants", &d_constants);
    }

    #[test]
    fn all_views_begin_with_the_scenes_colours_and_gradients_are_those_of_differences() {
        let n = 1500;
        let stream = Stream::new(8, Purpose::new("appearance test"), 0);
        let rows = |from: u64| -> Vec<[f32; 3]> {
            (0..n).map(|i| [0, 1, 2].map(|c| stream.normal(from + 3 * i + c) as f32)).collect()
        };
        let (constants, d) = (rows(0), rows(10_000));
        let mut values = AppearanceNetwork.start(3, 4);
        let show = |values: &[f32], constants: &[[f32; 3]]| {
            let mut shown = constants.to_vec();
            AppearanceNetwork.show(values, Some(1), &[], &mut shown);
            shown
        };
        assert_eq!(show(&values, &constants), constants);
        values.iter_mut().enumerate().for_each(|(i, v)| *v += 0.3 * stream.normal(20_000 + i as u64) as f32);
        let loss = |values: &[f32], constants: &[[f32; 3]]| -> f64 {
            let shown = show(values, constants);
            let products = shown.as_flattened().iter().zip(d.as_flattened());
            products.map(|(h, d)| f64::from(*h) * f64::from(*d)).sum()
        };
        let mut d_sh = vec![[[0.0; 3]; 16]; n as usize];
        d_sh.iter_mut().zip(&d).for_each(|(sh, d)| sh[0] = *d);
        let mut gradient = vec![0.0; values.len()];
        AppearanceNetwork.backward(&values, 1, &[], &constants, 0.0, &mut d_sh, &mut gradient);
        let close = |what: &str, numeric: f64, norm: f64| {
            assert!((numeric / norm - 1.0).abs() < 5e-3, "{what}: {numeric} {norm}");
        };
        let norm = |g: &[f32]| g.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt();
        let [code, bias, outer, last, codes] = STARTS;
        for run in [0..code, code..bias, bias..outer, outer..last, last..codes, codes..values.len()] {
            let size = norm(&gradient[run.clone()]);
            let at = |by: f64| {
                let mut moved = values.clone();
                run.clone().for_each(|i| moved[i] += (by / size) as f32 * gradient[i]);
                loss(&moved, &constants)
            };
            close(&format!("{run:?}"), (at(5e-3) - at(-5e-3)) / 1e-2, size);
        }
        let d_constants: Vec<f32> = d_sh.iter().flat_map(|sh| sh[0]).collect();
        let size = norm(&d_constants);
        let at = |by: f64| {
            let mut moved = constants.clone();
            let pairs = moved.as_flattened_mut().iter_mut().zip(&d_constants);
            pairs.for_each(|(h, g)| *h += (by / size) as f32 * g);
            loss(&values, &moved)
        };
        close("constants", (at(5e-2) - at(-5e-2)) / 1e-1, size);
    }
}
