//! Water as a network of the inverse depth, applied to a composed image: the formation of 3D-UIR.
//!
//! The Gaussians are composed without water, to light `J`, expected depth `D` and opacity `A` of a pixel.
//! With the numbers of a [`DepthNetwork`] and its share `ρ` of the water, per channel:
//!
//! ```text
//! q = A / D, 0 if D ≤ 1e-6         z = 1 / (q + 1e-5)
//! h_j = σ(w_j q + b_j)            u = σ(o + Σ_j V_j h_j)            a = σ(u)
//! I = J + ρ (J (a − 1) + c_m (1 − e^{−k z}) + R e^{−r z})
//! ```
//!
//! A ray that hits nothing shows open water, `c_m`. With `g = ρ ∂I`, `t = g J a (1 − a) u (1 − u)` and
//! `τ_j = h_j (1 − h_j) Σ V_j t` the derivatives are (sums over channels, and over pixels for numbers)
//! `∂J = ∂I (1 + ρ (a − 1))`, `∂o = t`, `∂V_j = h_j t`, `∂w_j = q τ_j`, `∂b_j = τ_j`,
//! `∂c_m = g (1 − e^{−k z})`, `∂k = g c_m z e^{−k z}`, `∂R = g e^{−r z}`, `∂r = −g R z e^{−r z}`,
//! `∂q = Σ_j w_j τ_j − z² Σ g (c_m k e^{−k z} − R r e^{−r z})`, `∂A = ∂q / D` and `∂D = −∂q q / D`.

use use3d_capture::{DEPTH_UNITS, DepthNetwork, Image, Map};
use use3d_numerics::lanes::{exp, sum};

use super::laid_over::Read;
use super::outputs::{ImagePlanes, LayerPlanes, MediumPlanes};
use super::pixels::{each, get, put};
use super::strips::{PerRow, PlanesMut};
use super::tile::Lanes;
use crate::lists::TILE;
use crate::view::{Options, RenderGradients};

/// Below this depth nothing is hit.
const NEAREST: f32 = 1e-6;
/// The inverse depth of open water.
const FARTHEST: f32 = 1e-5;

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// One row of a tile: the values of the formula for sixteen pixels that are the same in all channels.
struct DepthPixels {
    accumulation: Lanes,
    depth: Lanes,
    inverse: Lanes,
    distance: Lanes,
    hidden: [Lanes; DEPTH_UNITS],
}

/// One row of a tile: the values of the formula that belong to one channel.
struct ChannelPixels {
    light: Lanes,
    color: Lanes,
    /// `u` and `a`.
    inner: Lanes,
    object: Lanes,
    /// `e^{−k z}` and `e^{−r z}`.
    veil: Lanes,
    residual: Lanes,
}

#[inline(always)]
fn surface(read: &Read<'_>, network: &DepthNetwork, y: usize, x: usize, n: usize) -> DepthPixels {
    let accumulation = get(read.composed.accumulation.row(0, y), x, n);
    let depth = get(read.composed.depth.row(0, y), x, n);
    let inverse = each(|l| if depth[l] > NEAREST { accumulation[l] / depth[l] } else { 0.0 });
    let mut hidden = [[0.0; TILE]; DEPTH_UNITS];
    for ((h, slope), bias) in hidden.iter_mut().zip(&network.slopes).zip(&network.biases) {
        *h = each(|l| sigmoid(slope.mul_add(inverse[l], *bias)));
    }
    DepthPixels { accumulation, depth, inverse, distance: each(|l| 1.0 / (inverse[l] + FARTHEST)), hidden }
}

#[inline(always)]
fn channel(
    read: &Read<'_>,
    network: &DepthNetwork,
    c: usize,
    (y, x, n): (usize, usize, usize),
    surface: &DepthPixels,
) -> ChannelPixels {
    let pixels = |image: &Image| get(image.row(c, y), x, n);
    let mut raw = [network.offsets[c]; TILE];
    for (h, output) in surface.hidden.iter().zip(&network.outputs) {
        raw = each(|l| output[c].mul_add(h[l], raw[l]));
    }
    let inner = each(|l| sigmoid(raw[l]));
    let fading = |rate: f32| each(|l| exp(-(rate * surface.distance[l])));
    ChannelPixels {
        light: pixels(&read.composed.image),
        color: pixels(&read.water.color),
        object: each(|l| sigmoid(inner[l])),
        inner,
        veil: fading(network.veil[c]),
        residual: fading(network.residual_rate[c]),
    }
}

/// Forms a row of tiles. Always inlined, so that it is compiled for the instruction set.
#[inline(always)]
pub(super) fn form_row(
    read: Read<'_>,
    network: &DepthNetwork,
    row: usize,
    (mut image, mut layers): (PlanesMut<'_, f32, 3>, LayerPlanes<'_>),
) {
    read.for_each(
        row,
        #[inline(always)]
        |y, r, _, columns| {
            let (x, n) = (columns.start, columns.len());
            let surface = surface(&read, network, y, x, n);
            for c in 0..3 {
                let ChannelPixels { light, color, object: a, veil, residual, .. } =
                    channel(&read, network, c, (y, x, n), &surface);
                let (share, glow) = (network.share[c], network.residual[c]);
                let shown = each(|l| light[l] * share.mul_add(a[l] - 1.0, 1.0));
                let water = each(|l| share * color[l].mul_add(1.0 - veil[l], glow * residual[l]));
                put(image.row(c, r, columns.clone()), &each(|l| shown[l] + water[l]));
                if layers.present() {
                    let behind = each(|l| (1.0 - surface.accumulation[l]) * water[l]);
                    let medium = each(|l| water[l] - behind[l]);
                    for (k, lanes) in [shown, medium, behind].iter().enumerate() {
                        put(layers.row(3 * k + c, r, columns.clone()), lanes);
                    }
                }
            }
        },
    );
}

/// Sums over the pixels of a row of tiles: a [`DepthNetwork`] of lanes.
struct LaneSums {
    veil: [Lanes; 3],
    residual: [Lanes; 3],
    residual_rate: [Lanes; 3],
    slopes: [Lanes; DEPTH_UNITS],
    biases: [Lanes; DEPTH_UNITS],
    outputs: [[Lanes; 3]; DEPTH_UNITS],
    offsets: [Lanes; 3],
}

impl LaneSums {
    fn new() -> Self {
        let (three, units) = ([[0.0; TILE]; 3], [[0.0; TILE]; DEPTH_UNITS]);
        Self {
            veil: three,
            residual: three,
            residual_rate: three,
            slopes: units,
            biases: units,
            outputs: [three; DEPTH_UNITS],
            offsets: three,
        }
    }

    fn total(&self) -> DepthNetwork {
        let three = |lanes: &[Lanes; 3]| lanes.each_ref().map(sum);
        DepthNetwork {
            share: [0.0; 3],
            veil: three(&self.veil),
            residual: three(&self.residual),
            residual_rate: three(&self.residual_rate),
            slopes: self.slopes.each_ref().map(sum),
            biases: self.biases.each_ref().map(sum),
            outputs: self.outputs.each_ref().map(three),
            offsets: three(&self.offsets),
        }
    }
}

/// The strips that the derivative writes: the gradients of clear image, depth and accumulation, of the maps,
/// and the sums of the network's gradient.
pub(super) type Derived<'a> = (ImagePlanes<'a>, (MediumPlanes<'a>, PerRow<'a, DepthNetwork>));

/// Adds the lanes of a product to a sum.
#[inline(always)]
fn add(into: &mut Lanes, a: &Lanes, b: &Lanes) {
    *into = each(|l| a[l].mul_add(b[l], into[l]));
}

/// Differentiates a row of tiles.
#[inline(always)]
pub(super) fn differentiate_row(
    read: Read<'_>,
    network: &DepthNetwork,
    row: usize,
    (d_rendered, options): (&RenderGradients<'_>, &Options),
    (mut d_images, (mut d_water, d_network)): Derived<'_>,
) {
    let mut sums = LaneSums::new();
    read.for_each(
        row,
        #[inline(always)]
        |y, r, _, columns| {
            let (x, n) = (columns.start, columns.len());
            let own = |map: Option<&Map>| map.map_or([0.0; TILE], |map| get(map.row(0, y), x, n));
            let surface = surface(&read, network, y, x, n);
            let DepthPixels { depth, inverse: q, distance: z, hidden, .. } = &surface;
            let mut d_hidden = [[0.0; TILE]; DEPTH_UNITS];
            let mut d_distance = [0.0; TILE];
            for c in 0..3 {
                let ChannelPixels { light, color, inner, object: a, veil, residual } =
                    channel(&read, network, c, (y, x, n), &surface);
                let (share, glow) = (network.share[c], network.residual[c]);
                let d_pixel = get(d_rendered.image.row(c, y), x, n);
                let shown = each(|l| d_pixel[l] * share.mul_add(a[l] - 1.0, 1.0));
                put(d_images.row(c, r, columns.clone()), &shown);
                // Lanes beyond the row's end repeat its last pixel, which counts once.
                let g = each(|l| if l < n { share * d_pixel[l] } else { 0.0 });
                let d_raw = each(|l| g[l] * light[l] * (a[l] * (1.0 - a[l])) * (inner[l] * (1.0 - inner[l])));
                sums.offsets[c] = each(|l| sums.offsets[c][l] + d_raw[l]);
                for (j, h) in hidden.iter().enumerate() {
                    add(&mut sums.outputs[j][c], h, &d_raw);
                    let output = network.outputs[j][c];
                    d_hidden[j] = each(|l| output.mul_add(d_raw[l], d_hidden[j][l]));
                }
                let veiled = each(|l| g[l] * color[l] * veil[l]);
                let faded = each(|l| g[l] * residual[l]);
                add(&mut sums.veil[c], &veiled, z);
                sums.residual[c] = each(|l| sums.residual[c][l] + faded[l]);
                let lit = each(|l| -(glow * faded[l]));
                add(&mut sums.residual_rate[c], &lit, z);
                let (veil_rate, rate) = (network.veil[c], network.residual_rate[c]);
                d_distance = each(|l| d_distance[l] + veil_rate.mul_add(veiled[l], rate * lit[l]));
                if d_water.present() {
                    put(d_water.row(c, r, columns.clone()), &each(|l| g[l] * (1.0 - veil[l])));
                    put(d_water.row(3 + c, r, columns.clone()), &[0.0; TILE]);
                    put(d_water.row(6 + c, r, columns.clone()), &[0.0; TILE]);
                }
            }
            let mut d_inverse = each(|l| -(d_distance[l] * z[l]) * z[l]);
            for (j, h) in hidden.iter().enumerate() {
                let d_unit = each(|l| d_hidden[j][l] * (h[l] * (1.0 - h[l])));
                add(&mut sums.slopes[j], &d_unit, q);
                sums.biases[j] = each(|l| sums.biases[j][l] + d_unit[l]);
                let slope = network.slopes[j];
                d_inverse = each(|l| slope.mul_add(d_unit[l], d_inverse[l]));
            }
            let (mut d_depth, mut d_weight) = (own(d_rendered.depth), own(d_rendered.accumulation));
            let per_depth = each(|l| if depth[l] > NEAREST { d_inverse[l] / depth[l] } else { 0.0 });
            if options.depth_gradient {
                d_depth = each(|l| d_depth[l] - per_depth[l] * q[l]);
            }
            d_weight = each(|l| d_weight[l] + per_depth[l]);
            put(d_images.row(3, r, columns.clone()), &d_depth);
            put(d_images.row(4, r, columns), &d_weight);
        },
    );
    if let [total] = d_network.0 {
        *total = sums.total();
    }
}

/// The network's gradient from those of all rows of tiles, in their order.
pub(super) fn total(rows: &[DepthNetwork]) -> DepthNetwork {
    let mut total = DepthNetwork::default();
    let mut sums = vec![0.0f64; total.values().count()];
    for row in rows {
        sums.iter_mut().zip(row.values()).for_each(|(sum, value)| *sum += f64::from(*value));
    }
    total.values_mut().zip(sums).for_each(|(value, sum)| *value = sum as f32);
    total
}

#[cfg(test)]
mod tests {
    use fearless_simd::Level;
    use use3d_capture::{Camera, Formation, Intrinsics, Lattice, MediumMaps, Pose};
    use use3d_golden::{Case, Part};

    use super::super::per_image::Clear;
    use super::super::rasterizer::Kernels;
    use super::*;
    use crate::lists::Prepared;
    use crate::view::Rendered;
    use crate::{Colors, Gaussians};

    fn network(case: &Case<'_>) -> DepthNetwork {
        let mut network = DepthNetwork { share: [1.0; 3], ..DepthNetwork::default() };
        network.values_mut().zip(case.f32("in.network")).for_each(|(value, given)| *value = given);
        network
    }

    #[test]
    fn golden_formation_and_every_gradient() {
        let part = Part::math("uir");
        let case = part.cases().into_iter().find(|case| case.name() == "formation").unwrap();
        let image = |name: &str| {
            let (w, h, data) = case.planes(name);
            Image::from_planes(w, h, data).unwrap()
        };
        let map = |name: &str| {
            let (w, h, data) = case.planes(name);
            Map::from_planes(w, h, data).unwrap()
        };
        let light = image("in.light");
        let (width, height) = (light.width(), light.height());
        let intrinsics = Intrinsics { width, height, fx: 20.0, fy: 20.0, cx: 11.0, cy: 9.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let mut prepared = Prepared::new();
        let colors = Colors::Sh { degree: 0 };
        prepared.prepare(&Gaussians::empty(0), &camera, &Lattice::full(&intrinsics), colors);
        let water = MediumMaps {
            color: image("in.color"),
            formation: Formation::DepthNetwork,
            network: Some(Box::new(network(&case))),
            ..MediumMaps::zeros(width, height)
        };
        let d_image = image("cot.image");
        let d_rendered = RenderGradients { image: &d_image, depth: None, accumulation: None, clear: None };
        for kernels in [Kernels::Plain, Kernels::Lanes(Level::new())] {
            let mut out = Rendered::new();
            out.resize(width, height, true);
            out.image.clone_from(&light);
            (out.depth, out.accumulation) = (map("in.depth"), map("in.opacity"));
            let (mut clear, mut grads) = (Clear::default(), MediumMaps::zeros(0, 0));
            clear.form(kernels, &prepared, &water, &mut out);
            case.check_planes("out.image", out.image.data());
            let layers = out.layers.unwrap();
            let parts = layers.object.data().iter().zip(layers.medium.data()).zip(layers.far.data());
            for (((object, medium), far), whole) in parts.zip(out.image.data()) {
                assert!((object + medium + far - whole).abs() < 1e-6);
            }
            let wanted = (&d_rendered, &Options::default());
            clear.differentiate(kernels, &prepared, &water, wanted, Some(&mut grads));
            case.check_planes("grad.all.light", clear.d_image.data());
            case.check_planes("grad.all.depth", clear.d_depth.data());
            case.check_planes("grad.all.opacity", clear.d_accumulation.data());
            case.check_planes("grad.all.color", grads.color.data());
            let numbers: Vec<f32> = grads.network.unwrap().values().copied().collect();
            case.check("grad.all.network", &numbers);
        }
    }
}
