//! The clear view as the authors of a method show it, from the clear render `J = Σ w c`.
//!
//! The balanced one is 3D-UIR's: every channel is limited to the middle 98 % of its values, multiplied by the
//! mean over its own one, and all channels are then stretched together.
//!
//! ```text
//! v_c = clamp(J_c, p_c(1 %), p_c(99 %)) · m / m_c         m_c: mean of the channel, m: mean of the m_c
//! shown = (v − p(1 %)) / (p(99 %) − p(1 %)), limited      p: percentile of v over all channels
//! ```

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Image;

/// The way in which the authors of a method show its clear view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PublishedClear {
    /// They show none.
    #[default]
    None,
    /// `J`, limited to the display range: the clear render itself.
    Clamped,
    /// `J / (1 + J)`.
    ToneMapped,
    /// `J` after a balance of its colours: equal means of the channels, stretched.
    Balanced,
}

impl PublishedClear {
    /// The picture that they show.
    pub(crate) fn shown(self, clear: &Image) -> Option<Image> {
        match self {
            Self::None => None,
            Self::Clamped => Some(clear.map(|j| j.clamp(0.0, 1.0))),
            Self::ToneMapped => Some(clear.map(|j| j / (1.0 + j))),
            Self::Balanced => Some(balanced(clear)),
        }
    }
}

/// Share of the pixels on either side of the limits.
const BEYOND: f64 = 0.01;
/// The smallest mean by which a channel is divided.
const DARK: f32 = 1e-6;

/// The limits within which the middle 98 % of these values lie.
fn limits(values: &[f32]) -> (f32, f32) {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let last = sorted.len().saturating_sub(1);
    let at = |share: f64| sorted.get((share * last as f64).round() as usize).copied().unwrap_or_default();
    (at(BEYOND), at(1.0 - BEYOND))
}

fn balanced(clear: &Image) -> Image {
    let mut out = clear.map(|j| j.clamp(0.0, 1.0));
    let mut means = [0.0f32; 3];
    for (c, mean) in means.iter_mut().enumerate() {
        let plane = out.plane_mut(c);
        let (low, high) = limits(plane);
        plane.iter_mut().for_each(|v| *v = v.max(low).min(high));
        *mean = (plane.iter().map(|v| f64::from(*v)).sum::<f64>() / plane.len().max(1) as f64) as f32;
    }
    let grey = means.iter().sum::<f32>() / 3.0;
    for (c, mean) in means.into_iter().enumerate() {
        out.plane_mut(c).iter_mut().for_each(|v| *v *= grey / mean.max(DARK));
    }
    let (low, high) = limits(out.data());
    let width = high - low;
    out.map(|v| if width > DARK { ((v - low) / width).clamp(0.0, 1.0) } else { v.clamp(0.0, 1.0) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clear_views_are_clamped_or_mapped() {
        let clear = Image::from_planes(1, 1, vec![0.25, 1.0, 3.0]).expect("a pixel");
        let shown = |by: PublishedClear| by.shown(&clear).map(|image| image.data().to_vec());
        assert_eq!(shown(PublishedClear::None), None);
        assert_eq!(shown(PublishedClear::Clamped), Some(vec![0.25, 1.0, 1.0]));
        assert_eq!(shown(PublishedClear::ToneMapped), Some(vec![0.2, 0.5, 0.75]));
    }

    #[test]
    fn a_balanced_view_has_equal_means_and_the_whole_range() {
        // A ramp under blue light, with one white pixel and one black one.
        let n = 1000;
        let ramp = |i: usize| 0.2 + 0.5 * (i % n) as f32 / n as f32;
        let mut planes: Vec<f32> = (0..3 * n).map(|i| [0.2, 0.6, 1.0][i / n] * ramp(i)).collect();
        (0..3).for_each(|c| (planes[c * n], planes[c * n + 1]) = (1.0, 0.0));
        let clear = Image::from_planes(n, 1, planes).expect("pixels");
        let shown = PublishedClear::Balanced.shown(&clear).expect("a view");
        let mean = |c: usize| shown.plane(c).iter().sum::<f32>() / n as f32;
        assert!((mean(0) - mean(2)).abs() < 2e-3 && (mean(1) - mean(2)).abs() < 2e-3);
        assert!((mean(0) - 0.5).abs() < 5e-3, "{}", mean(0));
        let (first, last) = (shown.pixel(12, 0), shown.pixel(n - 12, 0));
        assert!(first.iter().all(|v| *v < 0.01) && last.iter().all(|v| *v > 0.99), "{first:?} {last:?}");
        // A quarter of the ramp, between 1 % and 99 % of it.
        assert!((shown.pixel(n / 4, 0)[1] - 0.245).abs() < 3e-3, "{:?}", shown.pixel(n / 4, 0));
        let grey = Image::filled(4, 4, 0.25);
        assert_eq!(PublishedClear::Balanced.shown(&grey), Some(grey));
    }
}
