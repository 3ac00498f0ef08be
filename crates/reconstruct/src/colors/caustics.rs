//! Light that waves focus on the scene and that changes from view to view, as in MarineSTD-GS.
//!
//! ```text
//! h'_i = h_i + Δ_i / C₀            Δ = relu(W₂ relu(W₁ [φ(u_i), c_i, z_v] + b))         R = mean Δ²
//! u = (s(x) + 2) / 4               s(x) = x if m ≤ 1,  else (2 − 1/m) x/m          m = max |x|
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | Δ | light that is added to a Gaussian's colour, at least 0 | N × 3 |
//! | φ | features of three grids over the scene, interpolated linearly along each axis | 3 × 2 |
//! | c | the Gaussian's constant colour `½ + C₀ h`, without a gradient | 3 |
//! | z | code of the view | 16 |
//! | W₁, b, W₂ | weights of the network | 64 × 25, 64, 3 × 64 |
//!
//! No gradient flows to the Gaussians' centres. Values lie in the order grids, W₁ over [φ, c], W₁ over z, b,
//! W₂, codes. A node of a grid has its two features one after another, and x runs fastest.

use rayon::prelude::*;
use use3d_numerics::random::{Purpose, Stream};
use use3d_numerics::spherical_harmonics::C0;

use super::{ColorModel, ColorRole};

/// Number of grids.
const GRIDS: usize = 3;
/// Features of a node.
const FEATURES: usize = 2;
/// Numbers of a Gaussian that enter the network: features and colour.
const INPUTS: usize = GRIDS * FEATURES + 3;
const CODE: usize = 16;
const HIDDEN: usize = 64;
/// Gaussians of a task.
const CHUNK: usize = 1024;

/// The field. Its parameters lie outside.
pub(super) struct Caustics {
    /// Nodes along a side of each grid.
    sides: [usize; GRIDS],
}

/// The field in use.
pub(super) const CAUSTICS: Caustics = Caustics { sides: [16, 32, 64] };

/// The field's values for one view.
struct Parts<'a> {
    sides: [usize; GRIDS],
    grids: &'a [f32],
    /// W₁ over features and colour, row by row.
    inner: &'a [f32],
    /// b + W₁ z of the view.
    offset: [f32; HIDDEN],
    outer: &'a [f32],
}

/// The eight nodes around a place on a grid, with their weights.
fn nodes(u: [f32; 3], side: usize) -> [(usize, f32); 8] {
    let places = u.map(|u| {
        let at = u.clamp(0.0, 1.0) * (side - 1) as f32;
        let low = (at as usize).min(side - 2);
        (low, at - low as f32)
    });
    std::array::from_fn(|corner| {
        let of = |axis: usize| {
            let (low, part) = places[axis];
            if corner >> axis & 1 == 1 { (low + 1, part) } else { (low, 1.0 - part) }
        };
        let [(x, wx), (y, wy), (z, wz)] = [of(0), of(1), of(2)];
        (FEATURES * (x + side * (y + side * z)), wx * wy * wz)
    })
}

/// u of a centre.
fn place(x: [f32; 3]) -> [f32; 3] {
    let m = x.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let scale = if m > 1.0 { (2.0 - 1.0 / m) / m } else { 1.0 };
    x.map(|v| (scale * v + 2.0) / 4.0)
}

/// The hidden units and the light of a Gaussian.
struct Lit {
    input: [f32; INPUTS],
    hidden: [f32; HIDDEN],
    light: [f32; 3],
}

impl Caustics {
    /// The first value of each run but the grids: of W₁ over features and colour, W₁ over the code, b, W₂,
    /// codes.
    fn starts(&self) -> [usize; 5] {
        let inner = self.sides.iter().map(|side| FEATURES * side * side * side).sum();
        let code = inner + HIDDEN * INPUTS;
        let bias = code + HIDDEN * CODE;
        [inner, code, bias, bias + HIDDEN, bias + HIDDEN + 3 * HIDDEN]
    }

    fn parts<'a>(&self, values: &'a [f32], view: usize) -> Parts<'a> {
        let [inner, code, bias, outer, codes] = self.starts();
        let z = &values[codes + view * CODE..][..CODE];
        let offset = std::array::from_fn(|j| {
            let row = &values[code + j * CODE..][..CODE];
            row.iter().zip(z).fold(values[bias + j], |sum, (w, z)| sum + w * z)
        });
        let (grids, inner) = values[..code].split_at(inner);
        Parts { sides: self.sides, grids, inner, offset, outer: &values[outer..codes] }
    }

    /// Adds the gradient of interpolated features to the nodes of the grids.
    fn spread(&self, u: [f32; 3], features: &[f32; INPUTS - 3], grids: &mut [f32]) {
        if features.iter().all(|d| *d == 0.0) {
            return;
        }
        let mut from = 0;
        for (level, side) in self.sides.into_iter().enumerate() {
            for (node, weight) in nodes(u, side) {
                for k in 0..FEATURES {
                    grids[from + node + k] += weight * features[level * FEATURES + k];
                }
            }
            from += FEATURES * side * side * side;
        }
    }
}

impl Parts<'_> {
    /// Evaluates the network for a Gaussian.
    fn light(&self, mean: [f32; 3], constant: [f32; 3]) -> Lit {
        let (u, mut input, mut from) = (place(mean), [0.0; INPUTS], 0);
        for (level, side) in self.sides.into_iter().enumerate() {
            for (node, weight) in nodes(u, side) {
                for k in 0..FEATURES {
                    input[level * FEATURES + k] += weight * self.grids[from + node + k];
                }
            }
            from += FEATURES * side * side * side;
        }
        for c in 0..3 {
            input[INPUTS - 3 + c] = C0.mul_add(constant[c], 0.5);
        }
        let hidden = std::array::from_fn(|j| {
            let row = &self.inner[j * INPUTS..][..INPUTS];
            row.iter().zip(&input).fold(self.offset[j], |sum, (w, v)| sum + w * v).max(0.0)
        });
        let light = std::array::from_fn(|c| {
            let row = &self.outer[c * HIDDEN..][..HIDDEN];
            row.iter().zip(&hidden).fold(0.0f32, |sum, (w, h)| sum + w * h).max(0.0)
        });
        Lit { input, hidden, light }
    }
}

/// Sums of a task's gradients, and its part of R.
struct Sums {
    inner: Vec<f32>,
    offset: [f32; HIDDEN],
    outer: Vec<f32>,
    squares: f64,
    /// Gradients of the features of each Gaussian.
    features: Vec<[f32; INPUTS - 3]>,
}

impl ColorModel for Caustics {
    fn groups(&self, views: usize) -> Vec<(ColorRole, usize)> {
        let [inner, .., codes] = self.starts();
        vec![(ColorRole::Grid, inner), (ColorRole::Network, codes - inner), (ColorRole::Code, views * CODE)]
    }

    /// Grids and codes are small and random, W₁ is Xavier's, and the bias is 0. W₂ is small and positive, so
    /// that every channel begins with some light and has a gradient.
    fn start(&self, views: usize, seed: u64) -> Vec<f32> {
        let [inner, _, bias, outer, codes] = self.starts();
        let stream = Stream::new(seed, Purpose::new("caustics"), 0);
        let range = |from: usize| match from {
            i if i < inner => (-1e-4, 1e-4),
            i if i < bias => {
                let bound = (6.0 / (INPUTS + CODE + HIDDEN) as f64).sqrt();
                (-bound, bound)
            }
            i if i < outer => (0.0, 0.0),
            i if i < codes => (0.0, 3e-3),
            _ => (-0.1, 0.1),
        };
        let value = |i: usize| {
            let (low, high) = range(i);
            (low + (high - low) * stream.uniform(i as u64)) as f32
        };
        (0..codes + views * CODE).map(value).collect()
    }

    fn show(&self, values: &[f32], view: Option<usize>, means: &[[f32; 3]], constants: &mut [[f32; 3]]) {
        let Some(view) = view else { return };
        let parts = self.parts(values, view);
        constants.par_iter_mut().zip(means).with_min_len(CHUNK).for_each(|(constant, mean)| {
            let light = parts.light(*mean, *constant).light;
            *constant = std::array::from_fn(|c| constant[c] + light[c] / C0);
        });
    }

    fn backward(
        &self,
        values: &[f32],
        view: usize,
        means: &[[f32; 3]],
        constants: &[[f32; 3]],
        weight: f64,
        d_sh: &mut [[[f32; 3]; 16]],
        gradient: &mut [f32],
    ) -> f64 {
        let parts = self.parts(values, view);
        let share = 1.0 / (3 * means.len()).max(1) as f64;
        let slope = (2.0 * weight * share) as f32;
        let tasks: Vec<Sums> = (means.par_chunks(CHUNK))
            .zip(constants.par_chunks(CHUNK).zip(d_sh.par_chunks(CHUNK)))
            .map(|(means, (constants, d_sh))| {
                let mut sums = Sums {
                    inner: vec![0.0; HIDDEN * INPUTS],
                    offset: [0.0; HIDDEN],
                    outer: vec![0.0; 3 * HIDDEN],
                    squares: 0.0,
                    features: Vec::with_capacity(means.len()),
                };
                for ((mean, constant), d_sh) in means.iter().zip(constants).zip(d_sh) {
                    sums.add(&parts, *mean, *constant, d_sh[0], slope);
                }
                sums
            })
            .collect();
        let [inner, code, bias, outer, codes] = self.starts();
        let mut offset = [0.0f32; HIDDEN];
        let mut squares = 0.0;
        let mut places = means.iter();
        for task in &tasks {
            squares += task.squares;
            add(&mut gradient[inner..code], &task.inner);
            add(&mut gradient[outer..codes], &task.outer);
            add(&mut offset, &task.offset);
            for (features, mean) in task.features.iter().zip(places.by_ref()) {
                self.spread(place(*mean), features, &mut gradient[..inner]);
            }
        }
        add(&mut gradient[bias..outer], &offset);
        let z = codes + view * CODE;
        for (j, d) in offset.iter().enumerate() {
            for k in 0..CODE {
                gradient[code + j * CODE + k] += d * values[z + k];
                gradient[z + k] += d * values[code + j * CODE + k];
            }
        }
        squares * share
    }
}

impl Sums {
    /// Adds a Gaussian with this gradient of its shown coefficients and `slope · Δ` of the regulariser.
    fn add(&mut self, parts: &Parts<'_>, mean: [f32; 3], constant: [f32; 3], d: [f32; 3], slope: f32) {
        let Lit { input, hidden, light } = parts.light(mean, constant);
        let mut d_hidden = [0.0f32; HIDDEN];
        for c in 0..3 {
            self.squares += f64::from(light[c]) * f64::from(light[c]);
            if light[c] <= 0.0 {
                continue;
            }
            let d_light = d[c] / C0 + slope * light[c];
            for j in 0..HIDDEN {
                self.outer[c * HIDDEN + j] += d_light * hidden[j];
                d_hidden[j] += d_light * parts.outer[c * HIDDEN + j];
            }
        }
        let mut d_input = [0.0f32; INPUTS];
        for j in (0..HIDDEN).filter(|j| hidden[*j] > 0.0) {
            self.offset[j] += d_hidden[j];
            for k in 0..INPUTS {
                self.inner[j * INPUTS + k] += d_hidden[j] * input[k];
                d_input[k] += d_hidden[j] * parts.inner[j * INPUTS + k];
            }
        }
        self.features.push(std::array::from_fn(|k| d_input[k]));
    }
}

fn add(sum: &mut [f32], own: &[f32]) {
    for (sum, own) in sum.iter_mut().zip(own) {
        *sum += own;
    }
}

#[cfg(test)]
mod tests {
    use use3d_golden::Part;

    use super::*;

    /// A field on grids that a golden can hold.
    const SMALL: Caustics = Caustics { sides: [2, 3, 4] };

    #[test]
    fn golden_caustics() {
        let part = Part::math("marinestd");
        let case = part.cases().into_iter().find(|case| case.name() == "caustics").unwrap();
        let (values, view) = (case.f32("in.values"), case.count("view"));
        let (means, constants) = (case.rows::<3>("in.means"), case.rows::<3>("in.constants"));
        let groups = SMALL.groups(case.count("views"));
        assert_eq!(groups.iter().map(|(_, count)| count).sum::<usize>(), values.len());
        let mut shown = constants.clone();
        SMALL.show(&values, Some(view), &means, &mut shown);
        case.check("out.shown", shown.as_flattened());
        for (pull, weight) in [("shown", 0.0), ("squares", case.f64("cot.squares")[0])] {
            let mut d_sh = vec![[[0.0; 3]; 16]; means.len()];
            if pull == "shown" {
                let d: Vec<[f32; 3]> = case.rows("cot.shown");
                d_sh.iter_mut().zip(d).for_each(|(sh, d)| sh[0] = d);
            }
            let mut gradient = vec![0.0; values.len()];
            let squares = SMALL.backward(&values, view, &means, &constants, weight, &mut d_sh, &mut gradient);
            case.check_f64("out.squares", &[squares]);
            case.check(&format!("grad.{pull}.values"), &gradient);
        }
        // A view that is not trained shows the scene's own colours.
        let mut untrained = constants.clone();
        SMALL.show(&values, None, &means, &mut untrained);
        assert_eq!(untrained, constants);
    }

    #[test]
    fn gradients_are_those_of_differences() {
        let n = 1500;
        let stream = Stream::new(5, Purpose::new("caustics test"), 0);
        let rows = |from: u64, scale: f32| -> Vec<[f32; 3]> {
            (0..n).map(|i| [0, 1, 2].map(|c| scale * stream.normal(from + 3 * i + c) as f32)).collect()
        };
        let (means, constants, d) = (rows(0, 1.2), rows(10_000, 0.5), rows(20_000, 1.0));
        let mut values = SMALL.start(3, 4);
        values.iter_mut().enumerate().for_each(|(i, v)| *v += 0.1 * stream.normal(30_000 + i as u64) as f32);
        let loss = |values: &[f32]| -> f64 {
            let mut shown = constants.clone();
            SMALL.show(values, Some(1), &means, &mut shown);
            let products = shown.as_flattened().iter().zip(d.as_flattened());
            products.map(|(h, d)| f64::from(*h) * f64::from(*d)).sum()
        };
        let mut d_sh = vec![[[0.0; 3]; 16]; n as usize];
        d_sh.iter_mut().zip(&d).for_each(|(sh, d)| sh[0] = *d);
        let mut gradient = vec![0.0; values.len()];
        SMALL.backward(&values, 1, &means, &constants, 0.0, &mut d_sh, &mut gradient);
        // Along the gradient of each run, where kinks of the units weigh least.
        let [inner, code, bias, outer, codes] = SMALL.starts();
        for run in [0..inner, inner..code, code..bias, bias..outer, outer..codes, codes..values.len()] {
            let expected = gradient[run.clone()].iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>();
            let at = |by: f64| {
                let mut moved = values.clone();
                let step = (by / expected.sqrt()) as f32;
                run.clone().for_each(|i| moved[i] += step * gradient[i]);
                loss(&moved)
            };
            let numeric = (at(2e-3) - at(-2e-3)) / 4e-3;
            assert!((numeric / expected.sqrt() - 1.0).abs() < 4e-2, "{run:?}: {numeric} {}", expected.sqrt());
        }
    }

    #[test]
    fn places_outside_the_cube_lie_on_the_grids_too() {
        assert_eq!(place([0.5, -1.0, 0.0]), [0.625, 0.25, 0.5]);
        assert_eq!(place([0.0, 4.0, -2.0]), [0.5, 0.937_5, 0.281_25]);
        for u in [[0.0; 3], [1.0; 3], place([1e9, -1e9, 3.0])] {
            let around = nodes(u, 4);
            assert!((around.iter().map(|n| n.1).sum::<f32>() - 1.0).abs() < 1e-6);
            assert!(around.iter().all(|n| n.0 + FEATURES <= FEATURES * 64));
        }
    }
}
