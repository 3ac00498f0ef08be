//! Noise that is not made visible.
//!
//! A look multiplies the little light that arrives from far away, and with it the grain and the blocks of a
//! photograph with it. There the detail of the photograph is shown only as far as it is structure:
//!
//! ```text
//! P' = B + f (P − B),     B = mean_m(P)
//! f  = 1 − (1 − a) (1 − c²) g
//! a  = τ² / (τ² + σ²)                    light arrives (the least of the channels that matter: green, blue)
//! c  = mean(f_P f_R) / √(mean f_P² mean f_R²)     the render shows the same structure
//! g  = 1 / (1 + (e / 4 ν)²)              the detail is as weak as noise: energy e = mean f_P², noise ν
//! ```
//!
//! `ν` is the tenth part, by size, of the energies of the photograph itself. So a faint far wall that the
//! scene knows stays, and empty water becomes calm. Display range; radii as in [`mod@crate::known`].

use use3d_capture::Image;

use crate::boxes::{mean, means};
use crate::known::{DETAIL, radius};
use crate::structure::Structure;

/// Transmission at which noise and signal count alike.
const SIGMA: f32 = 0.35;
/// The least noise of a photograph, as the square of a display value.
const LEAST: f32 = 0.5 / 255.0 * 0.5 / 255.0;

/// The calm picture `B` (three planes) and the share of detail `f` (one plane).
#[derive(Clone, Debug)]
pub(crate) struct Quiet {
    pub(crate) base: Vec<f32>,
    pub(crate) share: Vec<f32>,
}

/// The share of detail for each pixel; `None` where all of it stays.
pub(crate) fn quiet(photograph: &Image, structure: &Structure, arriving: &Image) -> Option<Quiet> {
    let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
    let detail = radius(w, DETAIL, 2);
    let mut energies: Vec<f32> = structure.photograph().iter().step_by(7).map(|e| e.max(0.0)).collect();
    if energies.is_empty() {
        return None;
    }
    let tenth = energies.len() / 10;
    let noise = energies.select_nth_unstable_by(tenth, f32::total_cmp).1.max(LEAST);
    let mut share = vec![1.0f32; n];
    for i in 0..n {
        let (pp, rr, pr) = structure.at(i);
        let pr = pr.max(0.0);
        let tau = arriving.data()[n + i].min(arriving.data()[2 * n + i]).max(0.0);
        let light = tau * tau / (tau * tau + SIGMA * SIGMA);
        let shown = pr * pr / ((pp + LEAST) * (rr + LEAST));
        let weak = pp / (4.0 * noise);
        share[i] = 1.0 - (1.0 - light) * (1.0 - shown) / (1.0 + weak * weak);
    }
    mean(&mut share, w, detail);
    if share.iter().all(|f| *f > 0.97) {
        return None;
    }
    let mut base = photograph.data().to_vec();
    means(&mut base, w, h, detail);
    Some(Quiet { base, share })
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    #[test]
    fn grain_in_dark_water_fades_and_what_the_scene_shows_stays() {
        let (w, h) = (200, 120);
        let draw = Stream::new(3, Purpose::new("grain"), 0);
        let (mut photograph, mut render) = (Image::filled(w, h, 0.3), Image::filled(w, h, 0.3));
        for y in 0..h {
            for x in 0..w {
                // A faint wall on the right, which the render shows.
                let wall = if x >= 110 && (x / 4 + y / 4).is_multiple_of(2) { 0.02 } else { 0.0 };
                let grain = 0.006 * draw.normal((y * w + x) as u64) as f32;
                photograph.set_pixel(x, y, [0.3 + wall + grain; 3]);
                render.set_pixel(x, y, [0.3 + wall; 3]);
            }
        }
        let structure = Structure::of(&photograph, &render);
        let dark = Image::filled(w, h, 0.05);
        let found = quiet(&photograph, &structure, &dark).expect("there is noise");
        assert!(found.share[60 * w + 40] < 0.3, "{}", found.share[60 * w + 40]);
        assert!(found.share[60 * w + 160] > 0.7, "{}", found.share[60 * w + 160]);
        // Where light arrives, all of the photograph is shown.
        assert!(quiet(&photograph, &structure, &Image::filled(w, h, 3.0)).is_none());
    }
}
