//! The rasterizer: forward and backward passes over all tiles, in strips of one tile row, without atomics.
//!
//! A tile row is one task; it writes its own strip of every image. The gradients of a tile are stored as
//! one record per (tile, Gaussian) entry, in a buffer that is cut by tile rows. The records of a Gaussian
//! are then added in the order of tiles. The buffer is bounded (see `groups`).

use fearless_simd::{Level, dispatch};
use use3d_capture::{Formation, Image, MediumMaps};

use super::groups::in_groups;
use super::inputs::BackwardRead;
use super::outputs::{MediumPlanes, Saved, image_planes, layer_planes, medium_planes};
use super::per_image::Clear;
use super::rows::{ForwardStrips, backward_row, forward_row};
use super::strips::{PlanesMut, for_each};
use super::sums::scatter;
use super::weighted::Weighted;
use super::{lanes, plain};
use crate::lists::Prepared;
use crate::project::{EntryGradient, SplatGradient, VisibleSplats, backward};
use crate::view::{Gradients, Options, RenderGradients, Rendered, ViewOf};

/// The code that composes a tile. All variants compute the same bits where multiply-add is fused.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Kernels {
    /// Scalar code, the reference for correct results.
    Plain,
    /// Vector code at an instruction-set level.
    Lanes(Level),
}

/// Composes [`Prepared`] Gaussians. It owns the scratch memory, which grows to the size that the largest
/// view needs and is then reused.
#[derive(Clone, Debug)]
pub struct Rasterizer {
    pub(crate) kernels: Kernels,
    saved: Saved,
    clear: Clear,
    pub(crate) records: Vec<EntryGradient>,
    pub(crate) sums: Vec<EntryGradient>,
    weighted: Weighted,
}

impl Default for Rasterizer {
    fn default() -> Self {
        Self::new()
    }
}

impl Rasterizer {
    /// A rasterizer for the best instruction set of this machine.
    pub fn new() -> Self {
        Self::with_level(Level::new())
    }

    /// A rasterizer for a given instruction set.
    pub fn with_level(level: Level) -> Self {
        Self::with_kernels(Kernels::Lanes(level))
    }

    /// A rasterizer with plain scalar code: the reference for correct results, and slow.
    pub fn plain() -> Self {
        Self::with_kernels(Kernels::Plain)
    }

    fn with_kernels(kernels: Kernels) -> Self {
        Self {
            kernels,
            saved: Saved::default(),
            clear: Clear::default(),
            records: Vec::new(),
            sums: Vec::new(),
            weighted: Weighted::default(),
        }
    }

    /// Number of bytes of scratch memory held.
    pub fn memory(&self) -> usize {
        (self.records.capacity() + self.sums.capacity()) * size_of::<EntryGradient>()
            + self.saved.memory()
            + self.clear.memory()
            + self.weighted.memory()
    }

    /// Renders the prepared view. `medium` has the size of the lattice and defines how images are formed in
    /// it; `None` composes without water, on black.
    pub fn forward(
        &mut self,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        options: &Options,
        out: &mut Rendered,
    ) {
        check_medium(prepared, medium);
        out.resize(prepared.width, prepared.height, options.layers);
        if let Some(water) = over_the_image(medium) {
            self.forward(prepared, None, options, out);
            self.clear.form(self.kernels, prepared, water, out);
            return;
        }
        if let Some(level) = self.weighted_level(prepared).filter(|_| !options.layers) {
            match medium {
                Some(_) => self.weighted.forward::<true>(level, prepared, medium, out),
                None => self.weighted.forward::<false>(level, prepared, medium, out),
            }
            return;
        }
        match (medium.is_some(), options.layers) {
            (false, false) => self.forward_tiles::<false, false>(prepared, medium, Some(out)),
            (false, true) => self.forward_tiles::<false, true>(prepared, medium, Some(out)),
            (true, false) => self.forward_tiles::<true, false>(prepared, medium, Some(out)),
            (true, true) => self.forward_tiles::<true, true>(prepared, medium, Some(out)),
        }
    }

    /// The instruction set with which a view that keeps its weights is composed from them.
    fn weighted_level(&self, prepared: &Prepared) -> Option<Level> {
        match self.kernels {
            Kernels::Lanes(level) if !prepared.weights.is_empty() => Some(level),
            _ => None,
        }
    }

    #[allow(clippy::needless_pass_by_value, reason = "the optional borrow is cut into strips")]
    fn forward_tiles<const WATER: bool, const LAYERS: bool>(
        &mut self,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        out: Option<&mut Rendered>,
    ) {
        let (kernels, w) = (self.kernels, prepared.width);
        let saved = self.saved.planes(prepared);
        let (images, layers) = match out {
            Some(Rendered { image, depth, accumulation, layers }) => {
                (image_planes(image, depth, accumulation), layer_planes(layers, w))
            }
            None => (PlanesMut::absent(w), PlanesMut::absent(w)),
        };
        let strips = (saved, (images, layers));
        for_each(0..prepared.rows.tiles(), strips, &|row, strips: ForwardStrips<'_>| match kernels {
            Kernels::Plain => dispatch!(Level::new(), simd => forward_row::<_, WATER>(
                simd, prepared, medium, row, strips, plain::forward::<WATER, LAYERS>
            )),
            Kernels::Lanes(level) => dispatch!(level, simd => forward_row::<_, WATER>(
                simd,
                prepared,
                medium,
                row,
                strips,
                #[inline(always)]
                |input, water, tile| lanes::forward::<_, WATER, LAYERS>(simd, input, water, tile),
            )),
        });
    }

    /// For each pixel of the lattice, the list entry at which compositing stops.
    pub(crate) fn stops(&mut self, prepared: &Prepared) -> &[i32] {
        if !self.saved.is_of(prepared) {
            self.forward_tiles::<false, false>(prepared, None, None);
        }
        &self.saved.stop
    }

    /// Computes the gradient of a loss with respect to every parameter of the Gaussians and to the medium's
    /// maps. `prepared` must have been prepared from the Gaussians and camera in `of`. `grads` are resized
    /// and overwritten, not added to.
    pub fn backward(
        &mut self,
        prepared: &Prepared,
        of: ViewOf<'_>,
        medium: Option<&MediumMaps>,
        options: &Options,
        d_rendered: &RenderGradients<'_>,
        grads: Gradients<'_>,
    ) {
        check_medium(prepared, medium);
        check_size(
            prepared,
            "gradient with respect to the image",
            d_rendered.image.width(),
            d_rendered.image.height(),
        );
        if let Some(water) = over_the_image(medium) {
            let mut clear = self.clear_of(prepared);
            clear.differentiate(self.kernels, prepared, water, (d_rendered, options), grads.medium);
            if options.water_only {
                self.clear = clear;
                return;
            }
            let d_rendered = RenderGradients {
                image: &clear.d_image,
                depth: Some(&clear.d_depth),
                accumulation: Some(&clear.d_accumulation),
                clear: d_rendered.clear,
            };
            let grads = Gradients { gaussians: grads.gaussians, medium: None };
            self.backward(prepared, of, None, options, &d_rendered, grads);
            self.clear = clear;
            return;
        }
        let ViewOf { gaussians, camera } = of;
        assert_eq!(gaussians.len(), prepared.gaussians, "the view was prepared from other Gaussians");
        if !self.saved.is_of(prepared) {
            self.forward_tiles::<false, false>(prepared, None, None);
        }
        let extras =
            d_rendered.depth.is_some() || d_rendered.accumulation.is_some() || d_rendered.clear.is_some();
        let s_gradient = if options.depth_gradient { 1.0 } else { 0.0 };
        let run = match (medium.is_some(), extras) {
            (false, false) => Self::backward_tiles::<false, false>,
            (false, true) => Self::backward_tiles::<false, true>,
            (true, false) => Self::backward_tiles::<true, false>,
            (true, true) => Self::backward_tiles::<true, true>,
        };
        let read = BackwardRead { prepared, medium, d_rendered, saved: None };
        run(self, read, s_gradient, grads.medium);
        let drawn = VisibleSplats {
            splats: &prepared.splats,
            ranks: &prepared.ranks,
            source: prepared.color_source,
            signed: options.signed_screen,
        };
        backward(&drawn, &self.sums, gaussians, camera, grads.gaussians);
    }

    /// The view composed without water: kept from the last forward pass, or composed again.
    fn clear_of(&mut self, prepared: &Prepared) -> Clear {
        let mut clear = std::mem::take(&mut self.clear);
        if !clear.is_of(prepared) {
            self.forward(prepared, None, &Options::default(), &mut clear.composed);
            clear.mark(prepared);
        }
        clear
    }

    fn backward_tiles<const WATER: bool, const EXTRAS: bool>(
        &mut self,
        read: BackwardRead<'_>,
        s_gradient: f32,
        medium_grads: Option<&mut MediumMaps>,
    ) {
        let kernels = self.kernels;
        let read = BackwardRead { saved: Some(&self.saved), ..read };
        let planes = medium_planes(medium_grads, read.prepared);
        in_groups(
            read.prepared,
            &mut self.records,
            &mut self.sums,
            planes,
            &|row, records, strips: MediumPlanes<'_>| match kernels {
                Kernels::Plain => dispatch!(Level::new(), simd => backward_row::<_, WATER>(
                    simd,
                    &read,
                    row,
                    records,
                    strips,
                    |input, water, tile, sink| {
                        plain::backward::<WATER, EXTRAS>(input, water, tile, s_gradient, sink);
                    },
                )),
                Kernels::Lanes(level) => dispatch!(level, simd => backward_row::<_, WATER>(
                    simd,
                    &read,
                    row,
                    records,
                    strips,
                    #[inline(always)]
                    |input, water, tile, sink| {
                        lanes::backward::<_, WATER, EXTRAS>(simd, input, water, tile, s_gradient, sink);
                    },
                )),
            },
        );
    }

    /// Stage 2: computes the gradients with respect to this view's colours and the medium's maps, with
    /// frozen geometry. Both are overwritten.
    pub fn backward_colors(
        &mut self,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        d_image: &Image,
        color_grads: &mut [[f32; 3]],
        medium_grads: &mut MediumMaps,
    ) {
        check_medium(prepared, medium);
        check_size(prepared, "gradient with respect to the image", d_image.width(), d_image.height());
        assert_eq!(color_grads.len(), prepared.gaussians, "one colour gradient per Gaussian");
        match (medium, over_the_image(medium)) {
            (None, _) => self.color_tiles::<false>(prepared, medium, d_image, Some(medium_grads)),
            (Some(_), None) => {
                self.color_tiles::<true>(prepared, medium, d_image, Some(medium_grads));
            }
            (_, Some(water)) => {
                let mut clear = self.clear_of(prepared);
                let d_rendered =
                    RenderGradients { image: d_image, depth: None, accumulation: None, clear: None };
                let wanted = (&d_rendered, &Options::default());
                clear.differentiate(self.kernels, prepared, water, wanted, Some(medium_grads));
                self.color_tiles::<false>(prepared, None, &clear.d_image, None);
                self.clear = clear;
            }
        }
        match self.weighted_level(prepared) {
            Some(_) => scatter(prepared, &self.weighted.d_colors, color_grads, |&[r, g, b, _]| [r, g, b]),
            None => scatter(prepared, &self.sums, color_grads, |sum| SplatGradient::of(sum).color),
        }
    }

    fn color_tiles<const WATER: bool>(
        &mut self,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        image: &Image,
        medium_grads: Option<&mut MediumMaps>,
    ) {
        if let Some(level) = self.weighted_level(prepared) {
            self.weighted.backward::<WATER>(level, prepared, medium, image, medium_grads);
            return;
        }
        let kernels = self.kernels;
        let d_rendered = RenderGradients { image, depth: None, accumulation: None, clear: None };
        let read = BackwardRead { prepared, medium, d_rendered: &d_rendered, saved: None };
        let planes = medium_planes(medium_grads, prepared);
        in_groups(
            prepared,
            &mut self.records,
            &mut self.sums,
            planes,
            &|row, records, strips: MediumPlanes<'_>| match kernels {
                Kernels::Plain => dispatch!(Level::new(), simd => backward_row::<_, WATER>(
                    simd, &read, row, records, strips, plain::backward_colors::<WATER>
                )),
                Kernels::Lanes(level) => dispatch!(level, simd => backward_row::<_, WATER>(
                    simd,
                    &read,
                    row,
                    records,
                    strips,
                    #[inline(always)]
                    |input, water, tile, sink| {
                        lanes::backward_colors::<_, WATER>(simd, input, water, tile, sink);
                    },
                )),
            },
        );
    }
}

fn check_size(prepared: &Prepared, what: &str, width: usize, height: usize) {
    assert_eq!(
        (width, height),
        (prepared.width, prepared.height),
        "{what} must have the size of the lattice"
    );
}

/// The water, if it is applied to the composed image.
fn over_the_image(medium: Option<&MediumMaps>) -> Option<&MediumMaps> {
    medium.filter(|water| water.formation != Formation::PerGaussian)
}

fn check_medium(prepared: &Prepared, medium: Option<&MediumMaps>) {
    if let Some(m) = medium {
        for image in [&m.color, &m.backscatter, &m.attenuation] {
            check_size(prepared, "the medium's maps", image.width(), image.height());
        }
    }
}
