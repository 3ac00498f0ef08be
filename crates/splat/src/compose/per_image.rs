//! Water applied to a composed image: the way in which SeaSplat and 3D-UIR form a photograph.
//!
//! The Gaussians are composed without water. A pixel is then one surface with their opacity `A = Σ w`,
//! their light `J = Σ w c`, and their expected distance `s = |d| Σ w z / Σ w`:
//!
//! ```text
//! I = J a + c_m (1 − A b)        a = e^{−β_a s}    b = e^{−β_b s}
//! ```
//!
//! Compositing per Gaussian uses each Gaussian's own distance instead. The two agree where all Gaussians of
//! a pixel are equally far away, and with `A = 1` this is the formula of those papers. A ray that hits
//! nothing shows open water, `c_m`.
//!
//! With `g = ∂I` the derivatives are `∂J = g a`, `∂A = −Σ g c_m b`, `∂s = Σ g (c_m A β_b b − J β_a a)`
//! (sums over channels), `∂c_m = g (1 − A b)`, `∂β_b = g c_m A s b` and `∂β_a = −g J s a`. The derivatives
//! with respect to clear image, depth and accumulation are the input of the compositor's backward pass.
//!
//! Distances that are normalised per view take the place of `s` in the same formula, with `A = 1`:
//! [`DepthRange`] has them. The image is then clamped to `[0, 1]`, and a clamped value has no derivative.

use fearless_simd::dispatch;
use use3d_capture::{DepthNetwork, Image, Map, MediumMaps};
use use3d_numerics::lanes::exp;

use super::depth_network;
use super::laid_over::Read;
use super::outputs::{ImagePlanes, LayerPlanes, MediumPlanes, image_planes, layer_planes, medium_planes};
use super::pixels::{each, get, put, ray_lengths};
use super::rasterizer::Kernels;
use super::strips::{PerRow, PlanesMut, for_each};
use super::tile::Lanes;
use crate::lists::{Prepared, TILE};
use crate::view::{Options, RenderGradients, Rendered};

/// A view composed without water, and the derivatives with respect to it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clear {
    geometry: u64,
    colors: u64,
    pub(super) composed: Rendered,
    pub(super) d_image: Image,
    pub(super) d_depth: Map,
    pub(super) d_accumulation: Map,
}

/// The strips that forming an image writes: the image, and the layers object, medium and far.
type Formed<'a> = (PlanesMut<'a, f32, 3>, LayerPlanes<'a>);
/// The strips that its derivative writes: the gradients of clear image, depth, accumulation and water.
type Derived<'a> = (ImagePlanes<'a>, MediumPlanes<'a>);

/// One row of a tile: the inputs of the formula for sixteen pixels that are the same in all channels.
struct Surface {
    accumulation: Lanes,
    ray: Lanes,
    distance: Lanes,
}

/// One row of a tile: the inputs of the formula that belong to one channel.
struct Channel {
    light: Lanes,
    color: Lanes,
    attenuation: Lanes,
    backscatter: Lanes,
    /// `e^{−β_a s}` and `e^{−β_b s}`.
    object: Lanes,
    veil: Lanes,
}

impl Read<'_> {
    #[inline(always)]
    fn surface(&self, y: usize, column: usize, n: usize) -> Surface {
        let x = column * TILE;
        let depth = get(self.composed.depth.row(0, y), x, n);
        let accumulation = get(self.composed.accumulation.row(0, y), x, n);
        if let Some(range) = self.range {
            let distance = each(|l| range.at(depth[l], accumulation[l]));
            return Surface { accumulation: [1.0; TILE], ray: [1.0; TILE], distance };
        }
        let ray = ray_lengths(self.prepared, y, column);
        Surface { accumulation, distance: each(|l| depth[l] * ray[l]), ray }
    }

    #[inline(always)]
    fn channel(&self, c: usize, y: usize, column: usize, n: usize, surface: &Surface) -> Channel {
        let pixels = |image: &Image| get(image.row(c, y), column * TILE, n);
        let (attenuation, backscatter) = (pixels(&self.water.attenuation), pixels(&self.water.backscatter));
        let s = &surface.distance;
        Channel {
            light: pixels(&self.composed.image),
            color: pixels(&self.water.color),
            object: each(|l| exp(-(attenuation[l] * s[l]))),
            veil: each(|l| exp(-(backscatter[l] * s[l]))),
            attenuation,
            backscatter,
        }
    }
}

impl Clear {
    /// True if it was composed from this view in these colours.
    pub(super) fn is_of(&self, prepared: &Prepared) -> bool {
        (self.geometry, self.colors) == (prepared.stamp, prepared.colors)
    }

    /// Marks `composed` as the image of this view.
    pub(super) fn mark(&mut self, prepared: &Prepared) {
        (self.geometry, self.colors) = (prepared.stamp, prepared.colors);
    }

    /// Number of bytes held.
    pub(super) fn memory(&self) -> usize {
        4 * 10 * self.composed.image.pixels()
    }

    /// Takes the view composed without water from `out`, and writes the image in water to `out`.
    pub(super) fn form(
        &mut self,
        kernels: Kernels,
        prepared: &Prepared,
        water: &MediumMaps,
        out: &mut Rendered,
    ) {
        self.composed.image.clone_from(&out.image);
        self.composed.depth.clone_from(&out.depth);
        self.composed.accumulation.clone_from(&out.accumulation);
        self.mark(prepared);
        let (w, h) = (prepared.width, prepared.height);
        let read = Read::new(prepared, water, &self.composed);
        let image = PlanesMut::of([out.image.data_mut()], w, h);
        let strips = (image, layer_planes(&mut out.layers, w));
        if let Some(network) = &water.network {
            for_each(0..prepared.rows.tiles(), strips, &|row, strips: Formed<'_>| match kernels {
                Kernels::Plain => depth_network::form_row(read, network, row, strips),
                Kernels::Lanes(level) => {
                    dispatch!(level, _simd => depth_network::form_row(read, network, row, strips));
                }
            });
            return;
        }
        for_each(0..prepared.rows.tiles(), strips, &|row, strips: Formed<'_>| match kernels {
            Kernels::Plain => form_row(read, row, strips),
            Kernels::Lanes(level) => dispatch!(level, _simd => form_row(read, row, strips)),
        });
    }

    /// Computes the derivatives with respect to clear image, depth and accumulation, from which the
    /// compositor's backward pass continues, and with respect to the water's maps.
    pub(super) fn differentiate(
        &mut self,
        kernels: Kernels,
        prepared: &Prepared,
        water: &MediumMaps,
        wanted: (&RenderGradients<'_>, &Options),
        grads: Option<&mut MediumMaps>,
    ) {
        let (w, h) = (prepared.width, prepared.height);
        self.d_image.resize(w, h);
        self.d_depth.resize(w, h);
        self.d_accumulation.resize(w, h);
        let read = Read::new(prepared, water, &self.composed);
        let images = image_planes(&mut self.d_image, &mut self.d_depth, &mut self.d_accumulation);
        if let Some(network) = &water.network {
            let mut sums = vec![DepthNetwork::default(); prepared.rows.tiles()];
            let mut grads = grads;
            let strips = (images, (medium_planes(grads.as_deref_mut(), prepared), PerRow(&mut sums)));
            type Derived<'a> = depth_network::Derived<'a>;
            for_each(0..prepared.rows.tiles(), strips, &|row, strips: Derived<'_>| match kernels {
                Kernels::Plain => depth_network::differentiate_row(read, network, row, wanted, strips),
                Kernels::Lanes(level) => dispatch!(level, _simd => {
                    depth_network::differentiate_row(read, network, row, wanted, strips);
                }),
            });
            if let Some(grads) = grads {
                grads.network = Some(Box::new(depth_network::total(&sums)));
            }
            return;
        }
        let strips = (images, medium_planes(grads, prepared));
        for_each(0..prepared.rows.tiles(), strips, &|row, strips: Derived<'_>| match kernels {
            Kernels::Plain => differentiate_row(read, row, wanted, strips),
            Kernels::Lanes(level) => dispatch!(level, _simd => differentiate_row(read, row, wanted, strips)),
        });
        if let Some(range) = read.range {
            range.backward(&self.composed.depth, &self.composed.accumulation, &mut self.d_depth);
            if let Some(own) = wanted.0.depth {
                self.d_depth.data_mut().iter_mut().zip(own.data()).for_each(|(sum, own)| *sum += own);
            }
        }
    }
}

/// Forms a row of tiles. Always inlined, so that it is compiled for the instruction set.
#[inline(always)]
fn form_row(read: Read<'_>, row: usize, (mut image, mut layers): Formed<'_>) {
    read.for_each(
        row,
        #[inline(always)]
        |y, r, column, columns| {
            let surface = read.surface(y, column, columns.len());
            let weight = &surface.accumulation;
            for c in 0..3 {
                let Channel { light, color, object: a, veil: b, .. } =
                    read.channel(c, y, column, columns.len(), &surface);
                let shown = each(|l| light[l] * a[l]);
                let hidden = each(|l| weight[l] * b[l]);
                let mut formed = each(|l| color[l].mul_add(1.0 - hidden[l], shown[l]));
                if read.range.is_some() {
                    formed = each(|l| formed[l].clamp(0.0, 1.0));
                }
                put(image.row(c, r, columns.clone()), &formed);
                if layers.present() {
                    let behind = each(|l| (1.0 - weight[l]) * color[l] * b[l]);
                    let medium = each(|l| color[l].mul_add(1.0 - hidden[l], -behind[l]));
                    for (k, lanes) in [shown, medium, behind].iter().enumerate() {
                        put(layers.row(3 * k + c, r, columns.clone()), lanes);
                    }
                }
            }
        },
    );
}

/// Differentiates a row of tiles.
#[inline(always)]
fn differentiate_row(
    read: Read<'_>,
    row: usize,
    (d_rendered, options): (&RenderGradients<'_>, &Options),
    (mut d_images, mut d_water): Derived<'_>,
) {
    read.for_each(
        row,
        #[inline(always)]
        |y, r, column, columns| {
            let (x, n) = (columns.start, columns.len());
            let own = |map: Option<&Map>| map.map_or([0.0; TILE], |map| get(map.row(0, y), x, n));
            let surface = read.surface(y, column, n);
            let Surface { accumulation: weight, ray, distance: s } = &surface;
            let (mut d_weight, mut d_distance) = (own(d_rendered.accumulation), [0.0; TILE]);
            for c in 0..3 {
                let channel = read.channel(c, y, column, n, &surface);
                let Channel { light, color, attenuation, backscatter, object: a, veil: b } = &channel;
                let mut g = get(d_rendered.image.row(c, y), x, n);
                if read.range.is_some() {
                    let formed = each(|l| color[l].mul_add(1.0 - weight[l] * b[l], light[l] * a[l]));
                    g = each(|l| if (0.0..=1.0).contains(&formed[l]) { g[l] } else { 0.0 });
                }
                let shown = each(|l| g[l] * a[l]);
                let lit = each(|l| shown[l] * light[l]);
                let veiled = each(|l| g[l] * color[l] * b[l]);
                if read.range.is_none() {
                    d_weight = each(|l| d_weight[l] - veiled[l]);
                }
                d_distance = each(|l| {
                    d_distance[l] + (weight[l] * backscatter[l] * veiled[l] - attenuation[l] * lit[l])
                });
                put(d_images.row(c, r, columns.clone()), &shown);
                if d_water.present() {
                    put(d_water.row(c, r, columns.clone()), &each(|l| g[l] * (1.0 - weight[l] * b[l])));
                    put(d_water.row(3 + c, r, columns.clone()), &each(|l| weight[l] * s[l] * veiled[l]));
                    put(d_water.row(6 + c, r, columns.clone()), &each(|l| -(s[l] * lit[l])));
                }
            }
            // A normalised distance is not the depth whose gradient the loss may also have.
            let mut depth = own(d_rendered.depth.filter(|_| read.range.is_none()));
            if options.depth_gradient {
                depth = each(|l| depth[l] + ray[l] * d_distance[l]);
            }
            put(d_images.row(3, r, columns.clone()), &depth);
            put(d_images.row(4, r, columns), &d_weight);
        },
    );
}
