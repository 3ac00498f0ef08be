//! Gaussians that masks hide.
//!
//! Pixels that a mask excludes are not part of the loss. Gaussians behind them are free, and some grow into
//! coloured spikes that no photograph contradicts. Over training views `v` with the compositor's weights
//! `w_iv(p) = T α` and the mask `k_v(p)` (1 counts, 0 does not; 1 without a mask)
//!
//! ```text
//! share_i = Σ_v Σ_p k_v(p) w_iv(p) / Σ_v Σ_p w_iv(p)
//! ```
//!
//! is the share of a Gaussian that some photograph showed. Gaussians with a share below `hidden_below` are
//! removed after the last step. Where they were, the water remains.
//!
//! A Gaussian that no training view sees stays: it may stand beside the pictures. In a capture without masks
//! nothing is removed. At most [`MOST_VIEWS`] views are used, at a longer side of at most [`SIDE`] pixels.

use rayon::prelude::*;
use use3d_capture::{Camera, Lattice, Map};
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

use crate::Target;
use crate::density::Origin;
use crate::unknown::{MOST_VIEWS, SIDE};
use crate::views::TrainingView;

/// The masks of a capture's training views.
#[derive(Default)]
pub(crate) struct Masks(Vec<(Camera, Option<Map>)>);

impl Masks {
    /// Stores the masks, smaller; nothing if no view has one.
    pub(crate) fn new(views: &[TrainingView]) -> Self {
        if views.iter().all(|view| view.mask.is_none()) {
            return Self::default();
        }
        let count = views.len().min(MOST_VIEWS);
        let mut target = Target::default();
        let small = |view: &TrainingView| {
            let intrinsics = &view.camera.intrinsics;
            let divisor = intrinsics.width.max(intrinsics.height).div_ceil(SIDE);
            (view.target(divisor, &mut target), target.mask.clone())
        };
        Self((0..count).map(|i| &views[i * views.len() / count]).map(small).collect())
    }

    /// True if no view has a mask.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The rows of the Gaussians of which at least the share `below` was shown.
    pub(crate) fn shown(&self, gaussians: &Gaussians, below: f64) -> Vec<Origin> {
        let n = gaussians.len();
        let (mut rasterizer, mut prepared) = (Rasterizer::new(), Prepared::new());
        let (mut planes, mut lifted, mut sums) = (Vec::new(), vec![0.0f32; 2 * n], vec![[0.0f64; 2]; n]);
        for (camera, mask) in &self.0 {
            let lattice = Lattice::full(&camera.intrinsics);
            let pixels = lattice.width() * lattice.height();
            planes.clear();
            planes.resize(2 * pixels, 1.0);
            if let Some(mask) = mask {
                planes[..pixels].copy_from_slice(mask.data());
            }
            prepared.prepare(gaussians, camera, &lattice, Colors::Sh { degree: 0 });
            rasterizer.splat_adjoint(&prepared, 2, &planes, &mut lifted);
            sums.par_iter_mut().zip(lifted.par_chunks_exact(2)).for_each(|(sum, lifted)| {
                (0..2).for_each(|k| sum[k] += f64::from(lifted[k]));
            });
        }
        (0..n).filter(|&i| sums[i][0] >= below * sums[i][1]).map(Origin::Kept).collect()
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Image, Intrinsics, Pixels, Pose, View};
    use use3d_numerics::math;

    use super::*;
    use crate::LoadedView;
    use crate::engine::zeros;

    /// Three discs side by side, and a fourth behind the cameras.
    fn discs() -> Gaussians {
        let mut g = zeros(4, 0);
        g.means = vec![[-0.6, 0.0, 2.0], [0.0, 0.0, 2.0], [0.6, 0.0, 2.0], [0.0, 0.0, -5.0]];
        g.log_scales = vec![[math::ln(0.05f32); 3]; 4];
        g.quaternions = vec![[1.0, 0.0, 0.0, 0.0]; 4];
        g.opacity_logits = vec![3.0; 4];
        g
    }

    /// Views whose masks hide the columns of each range.
    fn masks(hidden: &[std::ops::Range<usize>]) -> Masks {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let camera =
            Camera { intrinsics, pose: Pose::look_at(glam::DVec3::ZERO, glam::DVec3::Z, -glam::DVec3::Y) };
        let view = |(i, columns): (usize, &std::ops::Range<usize>)| {
            let name = FileName::numbered(i);
            let view = View { name, id: 0, image: "".into(), mask: None, depth_prior: None, camera };
            let mut mask = Map::filled(64, 48, 1.0);
            let counts = |x: usize| if columns.contains(&x) { 0.0 } else { 1.0 };
            mask.data_mut().iter_mut().enumerate().for_each(|(p, value)| *value = counts(p % 64));
            let pixels = Pixels::Eight(Image::new(64, 48).to_8bit());
            TrainingView::new(&view, LoadedView { pixels, mask: Some(mask), depth_prior: None }).unwrap().0
        };
        Masks::new(&hidden.iter().enumerate().map(view).collect::<Vec<_>>())
    }

    #[test]
    fn what_masks_hide_from_every_view_is_removed_and_what_one_view_shows_is_not() {
        use Origin::Kept;
        let scene = discs();
        // The discs stand at columns 14, 32 and 50. Both views hide the first, one view the second.
        let rows = masks(&[0..24, 0..42]).shown(&scene, 0.1);
        assert_eq!(rows, [Kept(1), Kept(2), Kept(3)]);
        // One of two views shows the second disc, so its share is a half.
        assert_eq!(masks(&[0..24, 0..42]).shown(&scene, 0.6), [Kept(2), Kept(3)]);
        assert!(masks(&[0..0, 0..0]).is_empty(), "a mask in which every pixel counts is none");
    }
}
