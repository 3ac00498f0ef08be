//! The worth of an additional Gaussian: several views must agree that it helps
//! (`densify.strategy = "frugal"`).
//!
//! A strong screen gradient shows that *something* is wrong under a Gaussian in the views drawn since the
//! last refinement; often it is a reflection or a fish in a single view. So some views are drawn again, in
//! groups of neighbours that move along the capture from refinement to refinement. For view v, with the
//! compositor's weights `w_iv(p) = T α` and the error `e_v(p)` of a pixel (the mean over the channels of
//! the absolute difference between picture and photograph, 0 where the mask excludes it):
//!
//! ```text
//! m_iv = Σ_p w_iv(p)              pixels that Gaussian i fills in view v
//! c_iv = Σ_p w_iv(p) e_v(p)       the error at the pixels that it fills
//! ē    = Σ_v Σ_p e_v(p) / Σ_v Σ_p 1
//!
//! view v has a large error at i   ⇔   m_iv ≥ 1/2  and  c_iv ≥ ē m_iv
//! worth_i = Σ_v c_iv  if at least two views have one (one where there is only one view), else 0
//! ```
//!
//! `m` and `c` are the adjoint `S_vᵀ` of the linear splat, applied to ones and to errors. Views are stored
//! and drawn at half their size, which is enough to locate errors. Everything is computed on the processor
//! from the engine's state, in the same way for every engine.

use rayon::prelude::*;
use use3d_capture::{Camera, Image8, Lattice, Map, MediumMaps};
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};

use crate::Target;
use crate::engine::{Degrees, TrainingState};
use crate::views::TrainingView;

/// The divisor of the views' sides.
const DIVISOR: usize = 2;
/// Number of neighbouring views in a group.
const GROUP: usize = 3;
/// Smallest and largest number of groups at a refinement.
const GROUPS: [usize; 2] = [4, 16];
/// Number of pixels that a Gaussian must fill in a view for the view to count.
const FILLED: f32 = 0.5;
/// Number of views that must have a large error.
const AGREEING: u32 = 2;

/// A training view at half its size.
struct HalfSizeView {
    camera: Camera,
    photograph: Image8,
    /// The pixels that count; `None` if all do.
    mask: Option<Map>,
}

/// The views used for the worth, and working memory.
#[derive(Default)]
pub(crate) struct WorthViews {
    views: Vec<HalfSizeView>,
    prepared: Prepared,
    rasterizer: Rasterizer,
    rendered: Rendered,
    maps: MediumMaps,
}

impl WorthViews {
    /// Stores the views at half their size.
    pub(crate) fn new(views: &[TrainingView]) -> Self {
        let views = views.iter().map(|view| {
            let mut target = Target::default();
            let camera = view.target(DIVISOR, &mut target);
            let mask = match (target.mask, target.alpha) {
                (Some(mut mask), Some(alpha)) => {
                    mask.data_mut().iter_mut().zip(alpha.data()).for_each(|(m, a)| *m *= a);
                    Some(mask)
                }
                (mask, alpha) => mask.or(alpha),
            };
            HalfSizeView { camera, photograph: target.image.to_8bit(), mask }
        });
        Self { views: views.collect(), ..Self::default() }
    }

    /// Computes the worth of every Gaussian at the refinement with this number.
    pub(crate) fn worth(&mut self, state: &TrainingState, degrees: Degrees, refinement: u64) -> Vec<f32> {
        let n = state.gaussians.len();
        let asked = asked(self.views.len(), refinement);
        let (mut errors, mut pixels) = (0.0f64, 0.0f64);
        let mut of_views = Vec::with_capacity(asked.len());
        for &view in &asked {
            let half = &self.views[view];
            let lattice = Lattice::full(&half.camera.intrinsics);
            let water = !state.medium.is_none();
            if water {
                state.medium.maps(&half.camera, &lattice, degrees.water, &mut self.maps);
            }
            let colors = Colors::Sh { degree: degrees.colors };
            self.prepared.prepare(&state.gaussians, &half.camera, &lattice, colors);
            let options = Options { depth_gradient: false, layers: false };
            let maps = water.then_some(&self.maps);
            self.rasterizer.forward(&self.prepared, maps, &options, &mut self.rendered);
            let planes = half.planes(&self.rendered, state.exposures.gain(view));
            let count = planes.len() / 2;
            errors += planes[..count].iter().map(|e| f64::from(*e)).sum::<f64>();
            pixels += planes[count..].iter().map(|e| f64::from(*e)).sum::<f64>();
            let mut sums = vec![0.0; 2 * n];
            self.rasterizer.splat_adjoint(&self.prepared, 2, &planes, &mut sums);
            of_views.push(sums);
        }
        let mean = (errors / pixels.max(1.0)) as f32;
        let agreeing = AGREEING.min(self.views.len() as u32);
        (0..n)
            .into_par_iter()
            .map(|i| {
                let (mut large, mut sum) = (0, 0.0);
                for sums in &of_views {
                    let (error, filled) = (sums[2 * i], sums[2 * i + 1]);
                    large += u32::from(filled >= FILLED && error >= mean * filled);
                    sum += error;
                }
                if large >= agreeing { sum } else { 0.0 }
            })
            .collect()
    }
}

impl HalfSizeView {
    /// Two planes: the error of every pixel, and its weight in the mask.
    fn planes(&self, rendered: &Rendered, gain: [f32; 3]) -> Vec<f32> {
        let count = self.photograph.pixels();
        let mut planes = vec![1.0; 2 * count];
        let (errors, counts) = planes.split_at_mut(count);
        if let Some(mask) = &self.mask {
            counts.copy_from_slice(mask.data());
        }
        errors.fill(0.0);
        for c in 0..3 {
            let pairs = rendered.image.plane(c).iter().zip(self.photograph.plane(c));
            for (error, (drawn, photographed)) in errors.iter_mut().zip(pairs) {
                let shown = (gain[c] * drawn).clamp(0.0, 1.0);
                *error += (shown - f32::from(*photographed) / 255.0).abs() / 3.0;
            }
        }
        for (error, counts) in errors.iter_mut().zip(counts.iter()) {
            *error *= counts;
        }
        planes
    }
}

/// The views used at a refinement: groups of neighbours, spread over the capture, that move by the length
/// of a group from one refinement to the next. In ascending order, each once.
fn asked(views: usize, refinement: u64) -> Vec<usize> {
    let groups = (views / (4 * GROUP)).clamp(GROUPS[0], GROUPS[1]);
    let stride = views.div_ceil(groups).max(1);
    let shift = (refinement as usize).wrapping_mul(GROUP) % stride;
    let mut asked: Vec<usize> = (0..groups)
        .flat_map(|group| (0..GROUP).map(move |k| group * stride + shift + k))
        .map(|view| view % views.max(1))
        .collect();
    asked.sort_unstable();
    asked.dedup();
    asked
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Intrinsics, Pixels, Pose, View};
    use use3d_medium::MediumModel;
    use use3d_numerics::math;
    use use3d_splat::Gaussians;

    use super::*;
    use crate::LoadedView;
    use crate::engine::zeros;

    const DEGREES: Degrees = Degrees { colors: 0, water: 0 };

    fn camera(i: usize) -> Camera {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let eye = glam::DVec3::new(0.05 * i as f64, 0.0, 0.0);
        Camera { intrinsics, pose: Pose::look_at(eye, eye + glam::DVec3::Z, -glam::DVec3::Y) }
    }

    /// Two grey discs side by side.
    fn discs() -> Gaussians {
        let mut g = zeros(2, 0);
        g.means = vec![[-0.55, 0.0, 2.0], [0.55, 0.0, 2.0]];
        g.log_scales = vec![[math::ln(0.2f32); 3]; 2];
        g.quaternions = vec![[1.0, 0.0, 0.0, 0.0]; 2];
        g.opacity_logits = vec![3.0; 2];
        g
    }

    /// The worths if the photographs of the views in `wrong` show a brighter first disc than the scene has,
    /// and the photograph of view 0 a brighter second one.
    fn worths(views: usize, wrong: &[usize], masked: bool) -> Vec<f32> {
        let state = TrainingState::new(discs(), MediumModel::None, &[]);
        let (mut prepared, mut rasterizer, mut rendered) =
            (Prepared::new(), Rasterizer::new(), Rendered::new());
        let loaded = (0..views).map(|i| {
            let mut shown = discs();
            let bright = [[1.5f32; 3]; 16];
            if wrong.contains(&i) {
                shown.sh[0] = bright;
            }
            if i == 0 {
                shown.sh[1] = bright;
            }
            let (camera, name) = (camera(i), FileName::numbered(i));
            let lattice = Lattice::full(&camera.intrinsics);
            prepared.prepare(&shown, &camera, &lattice, Colors::Sh { degree: 0 });
            rasterizer.forward(&prepared, None, &Options::default(), &mut rendered);
            let view = View { name, id: 0, image: "".into(), mask: None, depth_prior: None, camera };
            let pixels = Pixels::Eight(rendered.image.map(|v| v.clamp(0.0, 1.0)).to_8bit());
            let mask = masked.then(|| Map::filled(64, 48, 0.0));
            TrainingView::new(&view, LoadedView { pixels, alpha: None, mask, depth_prior: None }).unwrap().0
        });
        let loaded: Vec<TrainingView> = loaded.collect();
        WorthViews::new(&loaded).worth(&state, DEGREES, 0)
    }

    #[test]
    fn what_several_views_miss_is_worth_a_gaussian_and_what_one_shows_is_not() {
        let worth = worths(6, &[1, 2, 3], false);
        assert!(worth[0] > 1.0 && worth[1] == 0.0, "{worth:?}");
        // With a single view, one is enough; otherwise two must agree.
        assert!(worths(1, &[0], false)[1] > 0.0);
        assert_eq!(worths(2, &[], false)[1], 0.0);
        assert_eq!(worths(6, &[1, 2, 3], true), [0.0, 0.0], "nothing counts");
    }

    #[test]
    fn worth_is_the_error_under_a_gaussian_times_its_weight() {
        // Compared with a plain sum over the pixels of every view.
        let state = TrainingState::new(discs(), MediumModel::None, &[]);
        let worth = worths(6, &[1, 2, 3], false)[0];
        let (mut prepared, mut rasterizer) = (Prepared::new(), Rasterizer::new());
        let mut expected = 0.0;
        for i in [1, 2, 3] {
            let camera = camera(i).downscaled(DIVISOR);
            let lattice = Lattice::full(&camera.intrinsics);
            prepared.prepare(&state.gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
            let mut weights = vec![0.0; lattice.width() * lattice.height()];
            rasterizer.splat(&prepared, 1, &[1.0, 0.0], &mut weights);
            // The scene is grey, 0.5 w; the photograph is brighter by 1.5 C0 w, up to white.
            expected += weights.iter().map(|w| w * (1.5 * 0.282_094_8 * w).min(1.0 - 0.5 * w)).sum::<f32>();
        }
        assert!((worth - expected).abs() < 0.1 * expected, "{worth}, not {expected}");
    }

    #[test]
    fn every_view_is_asked_in_turn() {
        for views in [1, 2, 7, 42, 48, 300, 1000] {
            let mut seen = vec![false; views];
            for refinement in 0..40 {
                let asked = asked(views, refinement);
                assert!(asked.windows(2).all(|w| w[0] < w[1]) && asked.len() <= GROUP * GROUPS[1]);
                asked.iter().for_each(|v| seen[*v] = true);
            }
            assert!(seen.iter().all(|s| *s), "{views}");
        }
    }
}
