//! White balance for water: first restore weak channels from green, then equalise the means.
//!
//! Water absorbs red first, and turbid water also blue. Grey-world alone would then multiply almost nothing
//! and amplify red noise. So red is first compensated, `r ← r + (ḡ − r̄)(1 − r) g`: the green channel
//! supplies the detail, and pixels that are already red are unchanged; blue likewise if its mean is below
//! green's. Grey-world gains follow, bounded, because a frame full of blue water *is* blue.

use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::sums::sums;

/// Share of the difference of the means by which red and blue are compensated.
const COMPENSATION: [f64; 2] = [0.85, 0.5];
/// The strength of the grey-world step; 1 would make the means equal.
const STRENGTH: f64 = 0.85;
/// Smallest and largest gain of a channel.
const GAIN: (f64, f64) = (0.6, 1.8);

fn means(image: &Image) -> [f64; 3] {
    let planes = image.planes();
    let count = image.pixels().max(1) as f64;
    sums::<3>(image.pixels(), |p, t| {
        for c in 0..3 {
            t[c] += f64::from(planes[c][p]);
        }
    })
    .map(|s| s / count)
}

/// The white-balanced image. `image` and the result are in `[0, 1]`.
pub(super) fn balance(image: &Image) -> Image {
    let mut out = image.clone();
    let mean = means(image);
    let green = image.plane(1);
    for (channel, share) in [(0, COMPENSATION[0]), (2, COMPENSATION[1])] {
        let missing = (share * (mean[1] - mean[channel])).max(0.0) as f32;
        for (v, &g) in out.plane_mut(channel).iter_mut().zip(green) {
            *v += missing * (1.0 - *v) * g;
        }
    }
    let mean = means(&out);
    let grey = (mean[0] + mean[1] + mean[2]) / 3.0;
    for c in 0..3 {
        let gain = math::powf(grey / mean[c].max(1e-3), STRENGTH).clamp(GAIN.0, GAIN.1) as f32;
        for v in out.plane_mut(c) {
            *v = (*v * gain).clamp(0.0, 1.0);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blue_cast_shrinks_and_grey_stays_grey() {
        let mut image = Image::new(32, 16);
        for p in 0..32 * 16 {
            let v = 0.2 + 0.6 * math::sin(p as f32 * 0.11).abs();
            for (c, tint) in [0.25, 0.7, 0.9].into_iter().enumerate() {
                image.plane_mut(c)[p] = v * tint;
            }
        }
        let spread =
            |m: [f64; 3]| m.iter().fold(0.0f64, |a, &b| a.max(b)) / m.iter().fold(1.0f64, |a, &b| a.min(b));
        assert!(spread(means(&balance(&image))) < 0.5 * spread(means(&image)));
        let grey = Image::filled(8, 8, 0.4);
        assert!(balance(&grey).data().iter().all(|&v| (v - 0.4).abs() < 1e-6));
    }
}
