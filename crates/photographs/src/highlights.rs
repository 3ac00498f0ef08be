//! Highlights that run to white.
//!
//! A factor above 1 lifts bright pixels out of the display range, and clipping each channel gives white sand
//! a cast. So the brightest channel `u` of a changed pixel is compressed above `k`, which is [`KNEE`] or the
//! brightest channel of the pixel before, whichever is more:
//!
//! ```text
//! u' = k + (1 − k) (1 − e^{−(u − k) / (1 − k)}),      z = x u' / u
//! z' = z + s (u' − z),                               s = [`WHITE`] (1 − e^{−(u − k) / [`FADE`]})
//! ```
//!
//! Before that, places that are bright as a whole are lowered as a whole, so that their texture stays. On the
//! small grid, with the mean colour `m` of the changed photograph over windows, the brightest channel `u` of
//! a pixel, and `e = mean(u) + 1.5 sd(u)`,
//!
//! ```text
//! l = h(e) / e,       h(e) = k' + (1 − k') (1 − e^{−(e − k') / (1 − k')})      above k' = [`PLACE`]
//! m' = l m,           m'' = m' + s' (max m' − m'),     s' = min([`WHITE`], [`BLEACH`] (1 − l))
//! ```
//!
//! and `p (m'' − m)` is added to the changed photograph: detail keeps its size. `p` rises from 0 to 1 while
//! the brightest channel of the pixel rises from [`DARK`] to [`BRIGHT`] of `e`: dark things beside a bright
//! one are no part of its place.
//!
//! Looks for measuring are left as they are.
//!
//! A pixel that was not lifted stays as it is, to the bit, and so does one of a float file that was above 1
//! before. All values are in display range.

use use3d_numerics::lanes::exp;

use crate::boxes::{mean, means};
use crate::known::radius;

/// Display value above which bright places are lowered.
const PLACE: f32 = 0.72;
/// Standard deviations of a place that count as its brightness.
const SPREAD: f32 = 1.5;
/// Share of white of a lowered place, per share that it is lowered.
const BLEACH: f32 = 2.5;
/// Brightness over that of its place below which a pixel is no part of it, and above which it is one.
const DARK: f32 = 0.4;
/// See [`DARK`].
const BRIGHT: f32 = 0.75;
/// Radius of the windows of places, as a share of the width.
const WINDOW: f64 = 0.012;
/// Display value above which lifted pixels are compressed.
const KNEE: f32 = 0.85;
/// Largest share of white.
const WHITE: f32 = 0.7;
/// Excess over the knee at which 63 % of that share are reached.
const FADE: f32 = 0.3;

/// The change `m'' − m` (three planes) for a changed photograph (three planes) of this size. `before` is the
/// photograph: a place is not lowered below its own brightness.
pub(crate) fn lowering(changed: Vec<f32>, before: &[f32], size: (usize, usize)) -> Vec<f32> {
    let (width, height) = size;
    let (n, window) = (width * height, radius(width, WINDOW, 2));
    let top = |planes: &[f32], i: usize| planes[i].max(planes[n + i]).max(planes[2 * n + i]);
    let smooth = |mut plane: Vec<f32>| {
        mean(&mut plane, width, window);
        plane
    };
    let tops: Vec<f32> = (0..n).map(|i| top(&changed, i)).collect();
    let own = smooth((0..n).map(|i| top(before, i)).collect());
    let middle = smooth(tops.clone());
    let spread = smooth(tops.iter().zip(&middle).map(|(u, m)| (u - m) * (u - m)).collect());
    let room = 1.0 - PLACE;
    let brightness = |i: usize| middle[i] + SPREAD * spread[i].max(0.0).sqrt();
    let factor = |i: usize| {
        let e = brightness(i);
        if e <= PLACE {
            return 1.0;
        }
        let lowered = PLACE + room * (1.0 - exp(-(e - PLACE) / room));
        (lowered / e).max((own[i] / middle[i].max(1e-3)).min(1.0))
    };
    let factors = smooth((0..n).map(factor).collect());
    let mut shift = changed;
    means(&mut shift, width, height, window);
    for (i, factor) in factors.into_iter().enumerate() {
        let place: [f32; 3] = std::array::from_fn(|c| shift[c * n + i]);
        let lowered = place.map(|v| factor * v);
        let white = lowered[0].max(lowered[1]).max(lowered[2]);
        let share = (BLEACH * (1.0 - factor)).clamp(0.0, WHITE);
        let part = ((tops[i] / brightness(i).max(1e-3) - DARK) / (BRIGHT - DARK)).clamp(0.0, 1.0);
        (0..3).for_each(|c| {
            shift[c * n + i] = part * (lowered[c] + share * (white - lowered[c]) - place[c]);
        });
    }
    shift
}

/// A changed pixel whose highlights run to white; `before` is the pixel before the change.
#[inline(always)]
pub(crate) fn calm(changed: [f32; 3], before: [f32; 3]) -> [f32; 3] {
    let top = changed[0].max(changed[1]).max(changed[2]);
    let had = before[0].max(before[1]).max(before[2]);
    let knee = had.clamp(KNEE, 1.0);
    if top <= knee || had > 1.0 {
        return changed;
    }
    let room = 1.0 - knee;
    let over = top - knee;
    let lowered = if room < 1e-4 { 1.0 } else { knee + room * (1.0 - exp(-over / room)) };
    let white = WHITE * (1.0 - exp(-over / FADE));
    let scale = lowered / top;
    changed.map(|v| {
        let z = v * scale;
        z + white * (lowered - z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_cast_fades_and_nothing_leaves_the_range() {
        let before = [0.8, 0.7, 0.6];
        let pink = calm([1.5, 1.2, 1.1], before);
        assert!(pink.iter().all(|v| (0.0..=1.0).contains(v)), "{pink:?}");
        let cast = |p: [f32; 3]| p[0] / p[1];
        assert!(cast(pink) < 1.1, "{pink:?}");
        // Brighter stays brighter.
        assert!(calm([1.6, 1.3, 1.2], before)[0] > pink[0]);
        // What was white stays white, and a pixel that is not lifted is untouched.
        assert_eq!(calm([1.0, 1.0, 1.0], [1.0; 3]), [1.0; 3]);
        assert_eq!(calm([0.84, 0.2, 0.1], [0.3; 3]), [0.84, 0.2, 0.1]);
        assert_eq!(calm([0.97, 0.95, 0.9], [0.97, 0.95, 0.9]), [0.97, 0.95, 0.9]);
    }

    proptest! {
        #[test]
        fn grey_stays_grey_and_the_curve_rises(a in 0.0f32..2.0, step in 0.0f32..0.5, before in 0.0f32..1.0) {
            let [low, high] = [a, a + step].map(|v| calm([v; 3], [before; 3]));
            prop_assert!((low[0] - low[1]).abs() < 1e-6 && (low[1] - low[2]).abs() < 1e-6);
            prop_assert!(high[0] >= low[0] - 1e-6);
        }
    }
}
