//! The end of a run on a plateau.
//!
//! With `stop = "plateau"` blocks of [`BLOCK`] × [`BLOCK`] pixels, one in [`ONE_IN`], are taken out of the
//! losses of every training view. After growth the scene is compared with the photographs there, once in
//! every [`CHECKS`]th of the run:
//!
//! ```text
//! q_k = mean over views v of PSNR(gain_v · render_v, photograph_v), over withheld pixels only
//! ```
//!
//! in dB at full size, in at most [`MOST_VIEWS`] views. The run has reached a plateau if the best of the last
//! [`PATIENCE`] values is less than [`LEAST_GAIN`] above the best one before them. Held-out views take no
//! part in this.
//!
//! Limits: the rates of a run are set for its full length, so a run that stops earlier ends with larger
//! steps. Pixels of several views that show the same surface are withheld independently, so an error that
//! all views share is not seen.

use use3d_capture::{Camera, Image, Raster};
use use3d_metrics::{mask_of, psnr};
use use3d_numerics::random::{Purpose, Stream};

use crate::Target;
use crate::report::LogEntry;
use crate::views::TrainingView;

/// Side of a block, pixels.
const BLOCK: usize = 16;
/// One block in this many is withheld.
const ONE_IN: usize = 64;
/// A run is divided into this many parts; a comparison ends each part after growth.
const CHECKS: u64 = 30;
/// Largest number of views compared, spread over the capture.
const MOST_VIEWS: usize = 16;
/// Number of comparisons without a gain after which a run stops.
const PATIENCE: usize = 3;
/// The gain, in dB, below which a comparison shows no progress.
const LEAST_GAIN: f64 = 0.02;

/// The views that are compared: the index of each, and the view with only its withheld pixels.
#[derive(Default)]
pub(crate) struct Withheld(Vec<(usize, TrainingView)>);

impl Withheld {
    /// Takes the blocks out of the views' masks, and keeps the views that are compared.
    pub(crate) fn take(views: &mut [TrainingView], seed: u64) -> Self {
        let count = views.len().min(MOST_VIEWS);
        let compared: Vec<usize> = (0..count).map(|i| i * views.len() / count).collect();
        let mut kept = Vec::new();
        for (index, view) in views.iter_mut().enumerate() {
            let blocks = Stream::new(seed, Purpose::new("withheld blocks"), index as u64);
            let intrinsics = &view.camera.intrinsics;
            let (width, height) = (intrinsics.width, intrinsics.height);
            let across = width.div_ceil(BLOCK);
            let withheld = |p: usize| {
                let (column, row) = (p % width / BLOCK, p / width / BLOCK);
                blocks.below((row * across + column) as u64, ONE_IN) == 0
            };
            let before = view.mask.clone().unwrap_or_else(|| Raster::filled(width, height, 255));
            let masked = |keep: &dyn Fn(usize) -> bool| {
                let mut mask = before.clone();
                let pixels = mask.data_mut().iter_mut().enumerate();
                pixels.for_each(|(p, value)| *value = if keep(p) { *value } else { 0 });
                mask
            };
            if compared.contains(&index) {
                let mut only = view.clone();
                only.mask = Some(masked(&withheld));
                kept.push((index, only));
            }
            view.mask = Some(masked(&|p| !withheld(p)));
        }
        Self(kept)
    }

    /// True if no pixels are withheld.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// True if a comparison is due after `done` steps of a run of `steps`, which grows until `grown`.
    pub(crate) fn is_due(&self, done: u64, steps: u64, grown: u64) -> bool {
        !self.is_empty() && done >= grown && done.is_multiple_of(steps.div_ceil(CHECKS))
    }

    /// The mean PSNR over withheld pixels, dB; `None` if no view has such pixels or all are exact.
    pub(crate) fn compare<E>(
        &self,
        gains: &[[f32; 3]],
        mut render: impl FnMut(&Camera, &mut Image) -> Result<(), E>,
    ) -> Result<Option<f64>, E> {
        let (mut target, mut rendered) = (Target::default(), Image::new(0, 0));
        let mut scores = Vec::new();
        for (index, view) in &self.0 {
            let camera = view.target(1, &mut target);
            render(&camera, &mut rendered)?;
            let gain = gains.get(*index).copied().unwrap_or([1.0; 3]);
            let pixels = rendered.width() * rendered.height();
            for (plane, gain) in rendered.data_mut().chunks_exact_mut(pixels).zip(gain) {
                plane.iter_mut().for_each(|v| *v = (*v * gain).clamp(0.0, 1.0));
            }
            let mask = target.mask.as_ref().map(mask_of);
            // A view without withheld pixels has no score.
            scores.extend(psnr(&rendered, &target.image, mask.as_ref()).ok().filter(|v| v.is_finite()));
        }
        let mean = scores.iter().sum::<f64>() / scores.len().max(1) as f64;
        Ok((!scores.is_empty()).then_some(mean))
    }
}

/// True if the comparisons in a log show a plateau.
pub(crate) fn reached(log: &[LogEntry]) -> bool {
    let value = |entry: &LogEntry| match entry {
        LogEntry::Withheld { psnr, .. } => *psnr,
        _ => None,
    };
    let values: Vec<f64> = log.iter().filter_map(value).collect();
    let Some(earlier) = values.len().checked_sub(PATIENCE).filter(|n| *n > 0) else { return false };
    let best = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    best(&values[earlier..]) < best(&values[..earlier]) + LEAST_GAIN
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Intrinsics, Map, Pixels, Pose, View};

    use super::*;
    use crate::LoadedView;

    fn view(name: usize, mask: Option<Map>) -> TrainingView {
        let intrinsics = Intrinsics { width: 160, height: 96, fx: 90.0, fy: 90.0, cx: 80.0, cy: 48.0 };
        let pose = Pose::look_at(glam::DVec3::ZERO, glam::DVec3::Z, -glam::DVec3::Y);
        let camera = Camera { intrinsics, pose };
        let name = FileName::numbered(name);
        let view = View { name, id: 0, image: "".into(), mask: None, depth_prior: None, camera };
        let pixels = Pixels::Eight(Image::filled(160, 96, 0.5).to_8bit());
        TrainingView::new(&view, LoadedView { pixels, alpha: None, mask, depth_prior: None }).unwrap().0
    }

    #[test]
    fn withheld_pixels_are_compared_and_not_learnt() {
        let mut half = Map::filled(160, 96, 1.0);
        half.data_mut()[..160 * 48].fill(0.0);
        let mut views: Vec<_> = (0..40).map(|i| view(i, (i == 0).then(|| half.clone()))).collect();
        let held = Withheld::take(&mut views, 7);
        assert_eq!(held.0.len(), MOST_VIEWS);
        let mut blocks = 0;
        for (index, kept) in &held.0 {
            let pairs =
                kept.mask.as_ref().unwrap().data().iter().zip(views[*index].mask.as_ref().unwrap().data());
            let upper_half = |p: usize| *index == 0 && p < 160 * 48;
            for (p, pair) in pairs.enumerate() {
                match pair {
                    (255, 0) => blocks += 1,
                    (0, 255) => {}
                    (0, 0) if upper_half(p) => {}
                    other => panic!("pixel {p} of view {index}: {other:?}"),
                }
            }
        }
        let share = blocks as f64 / (16 * 160 * 96) as f64;
        assert!((0.005..0.03).contains(&share), "{share}");

        // An error outside the withheld pixels does not count, and one inside does.
        let compare = |inside: f32| {
            held.compare(&[], |camera, out| {
                *out = Image::filled(camera.intrinsics.width, camera.intrinsics.height, inside);
                Ok::<_, ()>(())
            })
        };
        let (near, far) = (compare(0.6).unwrap().unwrap(), compare(0.7).unwrap().unwrap());
        assert!((near - 20.0).abs() < 0.3 && far < near - 5.0, "{near} {far}");
        // A gain of the view applies to the render.
        let gains = vec![[128.0 / 255.0 / 0.6; 3]; 40];
        let exact = held.compare(&gains, |camera, out| {
            *out = Image::filled(camera.intrinsics.width, camera.intrinsics.height, 0.6);
            Ok::<_, ()>(())
        });
        assert!(exact.unwrap().is_none_or(|psnr| psnr > 100.0));
    }

    #[test]
    fn a_plateau_is_three_comparisons_without_a_gain() {
        let log = |values: &[f64]| -> Vec<LogEntry> {
            let entry = |(i, v): (usize, &f64)| LogEntry::Withheld { step: i as u64, psnr: Some(*v) };
            values.iter().enumerate().map(entry).collect()
        };
        assert!(!reached(&log(&[])));
        assert!(!reached(&log(&[25.0, 25.0, 25.0])), "there is nothing before the last three");
        assert!(reached(&log(&[25.0, 25.01, 24.9, 25.015])));
        assert!(!reached(&log(&[25.0, 25.01, 24.9, 25.03])));
        assert!(!reached(&log(&[25.0, 25.1, 25.1, 25.1])), "the gain is within the last three");
        assert!(reached(&log(&[25.0, 25.1, 25.1, 25.1, 25.1])));
    }

    #[test]
    fn comparisons_are_spread_over_the_part_after_growth() {
        let held = Withheld::take(&mut [view(0, None)], 1);
        let due: Vec<u64> = (1..=3000).filter(|&done| held.is_due(done, 3000, 2000)).collect();
        assert_eq!((due.len(), due[0], due[10]), (11, 2000, 3000));
        assert!(!Withheld::default().is_due(3000, 3000, 0), "a run without withheld pixels");
    }
}
