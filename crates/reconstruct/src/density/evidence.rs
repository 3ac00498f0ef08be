//! Evidence of several training views for growth: errors, and sizes on the screen.
//!
//! Before a refinement some views `v` are rendered at a longer side of at most [`SIDE`] pixels. With the
//! compositor's weights `w_iv(p) = T α`, the photograph `I`, the render `Î` and the luminance's gradient `g`:
//!
//! ```text
//! score_i = Σ_v Σ_p w_iv(p) e_v(p)          e = mean over channels of |I − Î| · (1 + λ g/(g + ḡ))
//! size_i  = max_v of the geometric mean of its standard deviations on the screen, pixels at full size
//! ```
//!
//! `ḡ` is the mean of `g` over the view, so that an edge counts up to `1 + λ` times. The views are drawn by
//! seed and step, one from each of equal parts of the capture. Errors contain what a colour field adds to a
//! view. A Gaussian that no drawn view sees has no score, and counts as large.

use rayon::prelude::*;
use use3d_capture::{Camera, Image, Lattice, Map, MediumMaps, Raster};
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};

use super::Draws;
use crate::engine::{Degrees, TrainingState};
use crate::exposure::expose;
use crate::unknown::{MOST_VIEWS, SIDE};
use crate::views::{Target, TrainingView};
use crate::{Candidates, Densify};

/// The purpose of the draws of views.
const VIEWS: Purpose = Purpose::new("views of growth");

/// The evidence about every Gaussian; a list is empty if no rule reads it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Evidence {
    /// Shares of the error of the rendered views.
    pub scores: Vec<f32>,
    /// True if children would be smaller than the screen resolves.
    pub too_small: Vec<bool>,
}

/// The views of which some are drawn for a refinement.
#[derive(Default)]
pub(crate) struct GrowthViews(Vec<GrowthView>);

struct GrowthView {
    /// Its number among the training views.
    index: usize,
    camera: Camera,
    divisor: usize,
    photograph: Raster<u8, 3>,
    mask: Option<Map>,
}

impl Densify {
    /// True if a rule of growth looks at views.
    pub(crate) fn looks(&self) -> bool {
        self.candidates == Candidates::Error || self.split_floor > 0.0
    }
}

impl GrowthViews {
    /// Stores the views, smaller; nothing if no rule looks at them.
    pub(crate) fn new(views: &[TrainingView], densify: &Densify) -> Self {
        let count = if densify.looks() { views.len().min(MOST_VIEWS) } else { 0 };
        let mut target = Target::default();
        let mut small = |i: usize| {
            let index = i * views.len() / count;
            let lens = &views[index].camera.intrinsics;
            let divisor = lens.width.max(lens.height).div_ceil(SIDE);
            let camera = views[index].target(divisor, &mut target);
            GrowthView {
                index,
                camera,
                divisor,
                photograph: target.image.to_8bit(),
                mask: target.mask.clone(),
            }
        };
        Self((0..count).map(&mut small).collect())
    }

    /// The evidence about the Gaussians of a state.
    pub(crate) fn evidence(
        &self,
        state: &TrainingState,
        degrees: Degrees,
        densify: &Densify,
        draws: &Draws,
    ) -> Evidence {
        let (gaussians, n) = (&state.gaussians, state.gaussians.len());
        if self.0.is_empty() {
            return Evidence::default();
        }
        let scored = densify.candidates == Candidates::Error;
        let (mut rasterizer, mut prepared) = (Rasterizer::new(), Prepared::new());
        let (mut maps, mut rendered, mut exposed) =
            (MediumMaps::zeros(0, 0), Rendered::new(), Image::new(0, 0));
        let (mut errors, mut of_view) = (Vec::new(), vec![0.0f32; n]);
        let (mut scores, mut sizes) = (vec![0.0f32; n], vec![0.0f32; n]);
        for view in self.drawn(densify.views, draws) {
            let lattice = Lattice::full(&view.camera.intrinsics);
            prepared.prepare(gaussians, &view.camera, &lattice, Colors::Sh { degree: degrees.colors });
            of_view.fill(0.0);
            prepared.raise_sizes(&mut of_view);
            sizes.iter_mut().zip(&of_view).for_each(|(most, size)| {
                *most = most.max(at_full_size(*size, view.divisor));
            });
            if !scored {
                continue;
            }
            state.medium.maps(&view.camera, &lattice, degrees.water, &mut maps);
            let water = (!state.medium.is_none()).then_some(&maps);
            rasterizer.forward(&prepared, water, &Options::default(), &mut rendered);
            expose(&rendered.image, state.exposures.gain(view.index), &mut exposed);
            errors.clear();
            view.errors(&exposed, densify.edge_weight as f32, &mut errors);
            rasterizer.splat_adjoint(&prepared, 1, &errors, &mut of_view);
            scores.iter_mut().zip(&of_view).for_each(|(score, share)| *score += share);
        }
        let least = (densify.split_floor * draws.shrinkage()) as f32;
        Evidence {
            scores: if scored { scores } else { Vec::new() },
            too_small: match densify.split_floor > 0.0 {
                true => sizes.iter().map(|size| *size > 0.0 && *size < least).collect(),
                false => Vec::new(),
            },
        }
    }

    /// The views for a refinement, in their order.
    fn drawn(&self, count: usize, draws: &Draws) -> impl Iterator<Item = &GrowthView> {
        let (n, count) = (self.0.len(), count.min(self.0.len()));
        let stream = Stream::new(draws.seed, VIEWS, draws.step);
        (0..count).map(move |part| {
            let (first, end) = (part * n / count, (part + 1) * n / count);
            &self.0[first + stream.below(part as u64, end - first)]
        })
    }
}

impl GrowthView {
    /// Writes the weighted errors of a render, a plane of pixels.
    fn errors(&self, rendered: &Image, edge_weight: f32, out: &mut Vec<f32>) {
        let (w, h) = (self.photograph.width(), self.photograph.height());
        let photograph = self.photograph.planes();
        let light = |x: usize, y: usize| {
            photograph.iter().map(|plane| f32::from(plane[y * w + x])).sum::<f32>() / (3.0 * 255.0)
        };
        let edge = |p: usize| {
            let (x, y) = (p % w, p / w);
            let across = light((x + 1).min(w - 1), y) - light(x.saturating_sub(1), y);
            let down = light(x, (y + 1).min(h - 1)) - light(x, y.saturating_sub(1));
            (across * across + down * down).sqrt()
        };
        let edges: Vec<f32> = (0..w * h).into_par_iter().map(edge).collect();
        let mean = (edges.iter().map(|e| f64::from(*e)).sum::<f64>() / edges.len().max(1) as f64) as f32;
        let render = rendered.planes();
        out.par_extend(edges.par_iter().enumerate().map(|(p, edge)| {
            let difference =
                |c: usize| (render[c][p].clamp(0.0, 1.0) - f32::from(photograph[c][p]) / 255.0).abs();
            let error = (difference(0) + difference(1) + difference(2)) / 3.0;
            let strength = if *edge > 0.0 { edge / (edge + mean) } else { 0.0 };
            let counts = self.mask.as_ref().map_or(1.0, |mask| mask.data()[p]);
            counts * error * (1.0 + edge_weight * strength)
        }));
    }
}

/// A size on the screen of a view divided by `divisor`, in pixels of the whole view. The compositor's blur
/// is the same number of pixels at every size.
fn at_full_size(size: f32, divisor: usize) -> f32 {
    let blur = use3d_splat::BLUR as f32;
    match size > 0.0 {
        true => ((size * size - blur).max(0.0) * (divisor * divisor) as f32 + blur).sqrt(),
        false => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Intrinsics, Pixels, Pose, View};
    use use3d_medium::MediumModel;
    use use3d_numerics::math;

    use super::*;
    use crate::LoadedView;
    use crate::engine::zeros;

    /// Three grey discs at columns 14, 32 and 50, the last one far, and a fourth behind the camera.
    fn discs() -> TrainingState {
        let mut g = zeros(4, 0);
        g.means = vec![[-0.6, 0.0, 2.0], [0.0, 0.0, 2.0], [1.8, 0.0, 6.0], [0.0, 0.0, -5.0]];
        g.log_scales = [0.05f32, 0.05, 0.15, 0.05].map(|s| [math::ln(s); 3]).to_vec();
        g.quaternions = vec![[1.0, 0.0, 0.0, 0.0]; 4];
        g.opacity_logits = vec![3.0; 4];
        g.sh = vec![[[0.0; 3]; 16]; 4];
        TrainingState::new(g, MediumModel::None, &[])
    }

    /// A view of 64 × 48 pixels with this photograph and mask.
    fn view(image: &Image, mask: Option<Map>) -> TrainingView {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let camera =
            Camera { intrinsics, pose: Pose::look_at(glam::DVec3::ZERO, glam::DVec3::Z, -glam::DVec3::Y) };
        let name = FileName::numbered(0);
        let view = View { name, id: 0, image: "".into(), mask: None, depth_prior: None, camera };
        let pixels = Pixels::Eight(image.to_8bit());
        TrainingView::new(&view, LoadedView { pixels, mask, depth_prior: None }).unwrap().0
    }

    fn found(views: &[TrainingView], state: &TrainingState, densify: &Densify) -> Evidence {
        let degrees = Degrees { colors: 0, water: 0 };
        let draws = Draws { shrink: 1.3, ..Draws::default() };
        GrowthViews::new(views, densify).evidence(state, degrees, densify, &draws)
    }

    fn rendered(state: &TrainingState, camera: &Camera) -> Image {
        let (lattice, mut prepared) = (Lattice::full(&camera.intrinsics), Prepared::new());
        prepared.prepare(&state.gaussians, camera, &lattice, Colors::Sh { degree: 0 });
        let mut out = Rendered::new();
        Rasterizer::new().forward(&prepared, None, &Options::default(), &mut out);
        out.image
    }

    #[test]
    fn errors_belong_to_the_gaussians_that_made_them_and_count_more_at_edges() {
        let by_error =
            |edge_weight| Densify { candidates: Candidates::Error, edge_weight, ..Densify::default() };
        let state = discs();
        let camera = view(&Image::new(64, 48), None).camera;
        // The photograph has the first disc as it is rendered, and not the other two.
        let mut photograph = rendered(&state, &camera);
        for c in 0..3 {
            photograph.plane_mut(c).iter_mut().enumerate().for_each(|(p, v)| *v *= f32::from(p % 64 < 24));
        }
        let plain = found(&[view(&photograph, None)], &state, &by_error(0.0));
        assert!(plain.scores[0] < 0.02 * plain.scores[1] && plain.scores[3] == 0.0, "{:?}", plain.scores);
        // Σ w |I − Î| of a grey disc with peak opacity a, whose w is its colour share: ½ Σ α² by hand.
        let covered: f32 = rendered(&state, &camera)
            .plane(1)
            .iter()
            .enumerate()
            .filter(|(p, _)| (24..42).contains(&(p % 64)))
            .map(|(_, v)| 2.0 * v * v)
            .sum();
        assert!((plain.scores[1] - covered).abs() < 0.02 * covered, "{} for {covered}", plain.scores[1]);
        assert!(plain.too_small.is_empty());
        // Edges of the photograph: the first disc alone has some.
        let mut brighter = photograph.clone();
        brighter.data_mut().iter_mut().for_each(|v| *v *= 0.5);
        let [flat, edged] = [0.0, 2.0].map(|w| found(&[view(&brighter, None)], &state, &by_error(w)).scores);
        assert!(
            edged[0] > 1.5 * flat[0] && edged[0] < 3.0 * flat[0] && edged[1] == flat[1],
            "{flat:?} {edged:?}"
        );
        // A mask takes the error away.
        let mask =
            Some(Map::from_planes(64, 48, (0..64 * 48).map(|p| f32::from(p % 64 < 42)).collect()).unwrap());
        let masked = found(&[view(&photograph, mask)], &state, &by_error(0.0)).scores;
        assert!(masked[2] < 1e-3 * plain.scores[2] && masked[1] == plain.scores[1], "{masked:?}");
    }

    #[test]
    fn an_edge_counts_by_its_gradient_against_the_mean_one() {
        // A step of light after two of four columns: the gradient is 1 in the middle columns, ½ in the mean.
        let step = Image::from_planes(4, 3, (0..36).map(|p| f32::from(p % 4 > 1)).collect()).unwrap();
        let photograph = step.to_8bit();
        let camera = view(&Image::new(64, 48), None).camera;
        let errors = |mask: Option<Map>| {
            let view = GrowthView { index: 0, camera, divisor: 1, photograph: photograph.clone(), mask };
            let mut out = Vec::new();
            view.errors(&Image::new(4, 3), 3.0, &mut out);
            out
        };
        for (p, error) in errors(None).into_iter().enumerate() {
            assert!((error - [0.0, 0.0, 3.0, 1.0][p % 4]).abs() < 1e-6, "pixel {p}: {error}");
        }
        assert_eq!(errors(Some(Map::new(4, 3))), [0.0; 12]);
    }

    #[test]
    fn small_gaussians_are_left() {
        let state = discs();
        let views = [view(&Image::new(64, 48), None)];
        // Standard deviations are 1.5 pixels, with the blur 1.6; children are smaller by 1.3.
        let small =
            |split_floor| found(&views, &state, &Densify { split_floor, ..Densify::default() }).too_small;
        assert_eq!(small(1.15), [false; 4]);
        assert_eq!(small(1.35), [true, true, true, false]);
        assert!(found(&views, &state, &Densify::default()) == Evidence::default());
        // The blur has one size on screens of all sizes.
        assert!((at_full_size(1.6, 2) - (4.0f32 * (1.6 * 1.6 - 0.3) + 0.3).sqrt()).abs() < 1e-6);
    }

    #[test]
    fn views_are_drawn_from_every_part_of_the_capture() {
        let densify = Densify { candidates: Candidates::Error, ..Densify::default() };
        let views: Vec<_> = (0..20).map(|_| view(&Image::new(64, 48), None)).collect();
        let pool = GrowthViews::new(&views, &densify);
        let drawn = |step| -> Vec<usize> {
            let draws = Draws { seed: 7, step, ..Draws::default() };
            pool.drawn(8, &draws).map(|view| view.index).collect()
        };
        let first = drawn(300);
        assert_eq!(first.len(), 8);
        for (part, index) in first.iter().enumerate() {
            assert!((part * 20 / 8..(part + 1) * 20 / 8).contains(index), "{first:?}");
        }
        assert!(first == drawn(300) && first != drawn(350));
        assert_eq!(GrowthViews::new(&views[..3], &densify).drawn(8, &Draws::default()).count(), 3);
        assert!(GrowthViews::new(&views, &Densify::default()).0.is_empty());
    }
}
