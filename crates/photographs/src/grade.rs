//! The colours of one photograph from what the scene knows of its view.
//!
//! All pictures have the size of the small grid and are in display range: the photograph `P`, the stage-1
//! render `R`, the look `E`, and the look's answer to light `N`, `τ` ([`use3d_render::Response`]).
//! `Δ = P − R`.
//!
//! **The light of the single shot** is the low frequency of `Δ` that is not an object: with
//! `v = k / (1 + (|Δ| / 0.15)²)`, where `k` is how well the scene knows a pixel (`known.rs`),
//!
//! ```text
//! L = blur(v Δ) / blur(v),      blur: two box means of radius 0.7 % of the width, at least 4 pixels
//! ```
//!
//! A share `κ` (`keep_light`) of it stays. Fish and divers differ much, so they weigh little and keep their
//! place before the light.
//!
//! **The photograph in the look:**
//!
//! ```text
//! P⁺ = E + M (Δ − (1 − κ) L),       M_ij = s_j N_ij / τ_j + (1 − s_j) V_ij,       s_j = τ_j² / (τ_j² + σ²)
//! ```
//!
//! `V` is the linear part of the view's own map, which stands where little light arrives and noise would
//! rule. `M` and `E − M R` are smoothed by a guided filter whose guide is the photograph, so that no texture
//! of the render is left in them. A photograph equal to its render gives the look; `E = R`, `M = 1`, `κ = 1`
//! gives the photograph. Without water and enhancement between them, `E = J` and `M = 1 / t`: the inversion
//! of the water by the scene's own distances.
//!
//! **Where the scene knows nothing it has no say.** There the view's own map counts, the affine map of least
//! squares `E ≈ V R + v` over the known pixels, without the mean light of the shot,
//!
//! ```text
//! P⁺ = V (P − (1 − κ) L̄) + v,       L̄ = Σ k L / Σ (k + [`FEW`])
//! ```
//!
//! Both are mixed by `k`, which is smooth, so there is no seam.
//!
//! A second form was measured and gained nothing: detail from a 2D enhancer's picture of the photograph,
//! carried to the scene's light by a smooth factor (docs/science/results.md, "Photographs").

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_render::Response;

use crate::boxes::{Guide, means, symmetric_inverse};
use crate::highlights::lowering;
use crate::known::{known, radius};
use crate::map::{AFFINE, ColourMap};
use crate::quiet::quiet;
use crate::structure::Structure;

/// Scale of the light of a shot, as a share of the width.
const LIGHT: f64 = 0.007;
/// Share of known pixels at which half of the mean light of a shot is believed.
const FEW: f32 = 0.02;
/// Sum over the channels of the difference at which a pixel counts half for the light of a shot.
const OBJECT: f32 = 0.15;
/// The same for the smooth factors.
const STRANGER: f32 = 0.2;
/// Transmission at which noise and signal count alike.
const SIGMA: f32 = 0.12;
/// Radius of the windows of the smooth factors, as a share of the width, and the ridge of their fits.
const SMOOTH: (f64, f32) = (0.01, 1e-2);

/// The pictures of one view, at the size of the small grid.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// The photograph `P`.
    pub photograph: &'a Image,
    /// The stage-1 render `R`, unclamped.
    pub render: &'a Image,
    /// The look `E`, unclamped.
    pub look: &'a Image,
    /// The share by which training views saw each surface, `[0, 1]`; `None` if all of it counts.
    pub coverage: Option<&'a Map>,
    /// The look's answer to light.
    pub response: &'a Response,
    /// True if highlights run to white, for eyes; false where colours are measured.
    pub soft: bool,
}

/// The change of colours of a photograph, and what it is worth.
#[derive(Clone, Debug)]
pub struct Grade {
    /// The change.
    pub map: ColourMap,
    /// The scene's knowledge of each pixel, `[0, 1]`.
    pub known: Map,
    /// The change of the whole view.
    pub own: ViewMap,
}

/// The change of colours of a view as a whole, which stands for photographs that no camera was found for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewMap {
    /// Rows `V_i0 V_i1 V_i2 v_i`.
    pub rows: [[f32; 4]; 3],
}

impl ViewMap {
    /// The mean over views; the default for none.
    pub fn mean(views: &[Self]) -> Self {
        let share = 1.0 / views.len().max(1) as f32;
        let mut mean = Self::default();
        for view in views {
            let sums = mean.rows.as_flattened_mut().iter_mut().zip(view.rows.as_flattened());
            sums.for_each(|(sum, v)| *sum += share * v);
        }
        mean
    }

    /// The change of a photograph by this map alone. `photograph` gives the size of the grid and the places
    /// that are bright.
    pub fn grade(&self, photograph: &Image) -> ColourMap {
        let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
        let row = |i: usize| &self.rows[i][..3];
        let values = [row(0), row(1), row(2), &[0, 1, 2].map(|i| self.rows[i][3])].concat();
        let first = values.iter().flat_map(|v| std::iter::repeat_n(*v, n)).collect();
        let mut map = ColourMap { width: w, height: h, first, quiet: None, soft: true, development: None };
        lower_highlights(&mut map, photograph);
        map
    }
}

/// The change of colours of a photograph. `keep_light` is the share `κ` in `[0, 1]` of the shot's own light
/// that stays.
///
/// Images of other sizes than the photograph's give a map that changes nothing.
pub fn grade(seen: &Seen<'_>, keep_light: f32) -> Grade {
    let photograph = seen.photograph;
    let (w, h) = (photograph.width(), photograph.height());
    let structure = Structure::of(photograph, seen.render);
    let known = known(photograph, seen.render, &structure, seen.coverage);
    let mut rows = own_map(seen.render, seen.look, &known);
    let light = light(photograph, seen.render, &known);
    let mean = mean_light(&light, &known);
    for row in &mut rows {
        row[3] -= (1.0 - keep_light) * (0..3).map(|j| row[j] * mean[j]).sum::<f32>();
    }
    let basis = (&known[..], &rows, &light[..]);
    let mut map = through_scene(seen, basis, keep_light);
    let own = ViewMap { rows };
    if seen.soft {
        lower_highlights(&mut map, photograph);
    }
    map.quiet = quiet(photograph, &structure, &seen.response.arriving);
    let known = Map::from_planes(w, h, known).unwrap_or_else(|| Map::new(w, h));
    Grade { map, known, own }
}

/// Lowers bright places: see `highlights.rs`.
fn lower_highlights(map: &mut ColourMap, photograph: &Image) {
    let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
    let p = photograph.data();
    let mut changed = vec![0.0f32; 3 * n];
    for i in 0..n {
        for c in 0..3 {
            let sum: f32 = (0..3).map(|j| map.first[(3 * c + j) * n + i] * p[j * n + i]).sum();
            changed[c * n + i] = sum + map.first[(9 + c) * n + i];
        }
    }
    let shift = lowering(changed, p, (w, h));
    map.first[9 * n..].iter_mut().zip(&shift).for_each(|(v, s)| *v += s);
}

/// A weight that halves where three differences sum to `half`.
fn robust(apart: f32, half: f32) -> f32 {
    let t = apart / half;
    1.0 / (1.0 + t * t)
}

/// The sum over the channels of the absolute difference of two pixels.
fn apart(a: &Image, b: &Image, i: usize) -> f32 {
    let n = a.pixels();
    (0..3).map(|c| (a.data()[c * n + i] - b.data()[c * n + i]).abs()).sum()
}

/// The low frequencies of `P − R`: three planes. See the [module](self).
fn light(photograph: &Image, render: &Image, known: &[f32]) -> Vec<f32> {
    let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
    let mut sums = vec![0.0f32; 4 * n];
    for i in 0..n {
        let weight = (known[i] + 1e-3) * robust(apart(photograph, render, i), OBJECT);
        sums[3 * n + i] = weight;
        for c in 0..3 {
            sums[c * n + i] = weight * (photograph.data()[c * n + i] - render.data()[c * n + i]);
        }
    }
    let r = radius(w, LIGHT, 4);
    means(&mut sums, w, h, r);
    means(&mut sums, w, h, r);
    let (light, weights) = sums.split_at_mut(3 * n);
    for plane in light.chunks_exact_mut(n.max(1)) {
        plane.iter_mut().zip(weights.iter()).for_each(|(v, weight)| *v /= weight.max(1e-9));
    }
    light.to_vec()
}

/// The mean light of the shot over the known pixels; it fades where hardly any is known.
fn mean_light(light: &[f32], known: &[f32]) -> [f32; 3] {
    let n = known.len();
    let weight: f64 = known.iter().map(|k| f64::from(*k)).sum::<f64>() + f64::from(FEW) * n as f64;
    std::array::from_fn(|c| {
        let plane = &light[c * n..(c + 1) * n];
        let sum: f64 = plane.iter().zip(known).map(|(l, k)| f64::from(*l) * f64::from(*k)).sum();
        (sum / weight.max(1e-9)) as f32
    })
}

/// The view's own map: the affine map of least squares from render to look over the known pixels, with a
/// ridge towards the mean gain.
pub(crate) fn own_map(render: &Image, look: &Image, known: &[f32]) -> [[f32; 4]; 3] {
    let n = render.pixels();
    let (r, e) = (render.data(), look.data());
    let mut weight = 1e-9f64;
    let (mut mean_r, mut mean_e) = ([0.0f64; 3], [0.0f64; 3]);
    let at = |data: &[f32], c: usize, i: usize| f64::from(data[c * n + i]);
    for (i, k) in known.iter().enumerate() {
        let k = f64::from(*k) + 1e-6;
        weight += k;
        for c in 0..3 {
            mean_r[c] += k * at(r, c, i);
            mean_e[c] += k * at(e, c, i);
        }
    }
    mean_r.iter_mut().chain(&mut mean_e).for_each(|v| *v /= weight);
    let (mut rr, mut er) = ([[0.0f64; 3]; 3], [[0.0f64; 3]; 3]);
    for (i, k) in known.iter().enumerate() {
        let k = (f64::from(*k) + 1e-6) / weight;
        let dr: [f64; 3] = std::array::from_fn(|c| at(r, c, i) - mean_r[c]);
        let de: [f64; 3] = std::array::from_fn(|c| at(e, c, i) - mean_e[c]);
        for a in 0..3 {
            for b in 0..3 {
                rr[a][b] += k * dr[a] * dr[b];
                er[a][b] += k * de[a] * dr[b];
            }
        }
    }
    let ridge = 1e-4;
    (0..3).for_each(|c| rr[c][c] += ridge);
    let inverse = symmetric_inverse(&rr);
    std::array::from_fn(|i| {
        let gain = (mean_e[i] / mean_r[i].max(0.02)).clamp(0.2, 5.0);
        let k: [f64; 3] = std::array::from_fn(|j| er[i][j] + if i == j { ridge * gain } else { 0.0 });
        let row: [f64; 3] = std::array::from_fn(|j| (0..3).map(|l| k[l] * inverse[l][j]).sum());
        let constant = mean_e[i] - (0..3).map(|j| row[j] * mean_r[j]).sum::<f64>();
        [row[0] as f32, row[1] as f32, row[2] as f32, constant as f32]
    })
}

/// The knowledge of each pixel, the view's own map, and the light of the shot.
type Basis<'a> = (&'a [f32], &'a [[f32; 4]; 3], &'a [f32]);

/// The photograph in the look, before highlights and noise.
fn through_scene(seen: &Seen<'_>, basis: Basis<'_>, keep: f32) -> ColourMap {
    let response = seen.response;
    let (known, own, light) = basis;
    let (w, h, n) = (seen.photograph.width(), seen.photograph.height(), seen.photograph.pixels());
    let mut first = vec![0.0f32; AFFINE * n];
    for p in 0..n {
        let render: [f32; 3] = std::array::from_fn(|j| seen.render.data()[j * n + p]);
        for i in 0..3 {
            let mut constant = seen.look.data()[i * n + p];
            for j in 0..3 {
                let (tau, answer) =
                    (response.arriving.data()[j * n + p], response.columns[j].data()[i * n + p]);
                // s N / τ = N τ / (τ² + σ²), which needs no division by τ.
                let trust = tau * tau / (tau * tau + SIGMA * SIGMA);
                let slope = answer * tau / (tau * tau + SIGMA * SIGMA) + (1.0 - trust) * own[i][j];
                first[(3 * i + j) * n + p] = slope;
                constant -= slope * render[j];
            }
            first[(9 + i) * n + p] = constant;
        }
    }
    smooth(&mut first, seen, known);
    // The light of the shot goes, and where nothing is known the view's own map stands.
    for p in 0..n {
        let k = known[p];
        for i in 0..3 {
            let gone: f32 = (0..3).map(|j| first[(3 * i + j) * n + p] * light[j * n + p]).sum();
            let constant = first[(9 + i) * n + p] - (1.0 - keep) * gone;
            first[(9 + i) * n + p] = k * constant + (1.0 - k) * own[i][3];
            for j in 0..3 {
                let slope = &mut first[(3 * i + j) * n + p];
                *slope = k * *slope + (1.0 - k) * own[i][j];
            }
        }
    }
    ColourMap { width: w, height: h, first, quiet: None, soft: seen.soft, development: None }
}

/// Smooths the factors with the photograph as guide.
fn smooth(first: &mut [f32], seen: &Seen<'_>, known: &[f32]) {
    let (w, h, n) = (seen.photograph.width(), seen.photograph.height(), seen.photograph.pixels());
    let weights: Vec<f32> = (0..n)
        .map(|p| (known[p] + 1e-3) * robust(apart(seen.photograph, seen.render, p), STRANGER))
        .collect();
    let guide = Guide::new((w, h), seen.photograph.planes(), &weights, (radius(w, SMOOTH.0, 1), SMOOTH.1));
    first.par_chunks_exact_mut(n.max(1)).for_each(|plane| guide.smooth(plane));
}

#[cfg(test)]
#[path = "grade_tests.rs"]
mod tests;
