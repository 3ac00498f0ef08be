//! Measures the colours for a white balance: those of a place, or of all surfaces.
//!
//! **A place** (`patch`). The user states that a pixel of a photograph shows something grey or white. The
//! scene is drawn from that photograph's camera, at a size whose longer side is at most [`LONGEST`] pixels,
//! in `clear`, `enhanced` and `enhanced-clear`. The colour is the median, channel by channel, of the
//! [`PATCH`] × [`PATCH`] pixels around it, so a fleck does not count. Several places are averaged by their
//! casts `u`, one vote each.
//!
//! **All surfaces** (`reef`, `grey`). Pixels of small pictures, where the scene is solid, become points by
//! their depth. Points become voxels of side `0.012 ×` their median distance, each with one vote and its
//! mean colour. With `χ = (ln R/G, ln B/G)` of a voxel in linear light:
//!
//! ```text
//! reef:  m = mean χ − (0.27, −0.40)        u = (m/σ_a² + 0/σ_c²) / (1/σ_a² + 1/σ_c²)      σ_a = ½, σ_c = ¼
//! grey:  u = (ln ΣR/ΣG, ln ΣB/ΣG)
//! ```
//!
//! `reef` makes two assumptions: that surfaces have the mean colour of a reef, ± σ_a, and that there is no
//! cast, ± σ_c. Gains multiply display values, whose logarithm is that of linear light divided by 2.2, so
//! `u/2.2` is removed.
//!
//! Limits: a place is valid for its distance; both rules are wrong where the bottom differs from their
//! assumptions.

use std::collections::BTreeMap;

use glam::DVec3;
use use3d_capture::{Camera, Lattice};
use use3d_numerics::math;
use use3d_numerics::order::median;
use use3d_numerics::spherical_harmonics::C0;
use use3d_scene::white::{self, GAINS, Gains};
use use3d_splat::Gaussians;

use crate::RenderError;
use crate::modes::{Mode, Rendering, SceneRenderer};

/// Largest number of pixels along the longer side of a picture in which a place is looked up.
pub const LONGEST: usize = 1024;
/// Number of pixels along the side of a patch.
pub const PATCH: usize = 15;
/// Solid share of a patch below which it shows water and not a surface.
const SOLID: f32 = 0.5;
/// Value below which a channel is only noise.
const DARK: f64 = 0.02;
/// The looks that have gains, in the order of [`Gains::of_casts`].
const LOOKS: [Mode; 3] = [Mode::Clear, Mode::Enhanced, Mode::EnhancedClear];

/// The modes that measure a place: the looks, its distance and its solid share.
const MODES: [Mode; 5] = [LOOKS[0], LOOKS[1], LOOKS[2], Mode::Depth, Mode::Alpha];
/// Number of pixels along the longer side of a picture from which surfaces are taken.
const SMALL: usize = 160;
/// Largest number of views from which surfaces are taken.
const VIEWS: usize = 24;
/// Side of a voxel as a share of the median distance.
const VOXEL: f64 = 0.012;
/// Solid share of a pixel from which on it is a surface.
const SURFACE: f32 = 0.9;
/// Range of colours of surfaces that count, display range.
const RANGE: [f64; 2] = [0.03, 0.98];
/// Fewest surfaces that are enough for a measurement.
const FEWEST: usize = 50;
/// The mean colour of reefs, `(ln R/G, ln B/G)` in linear light, and its spread.
const REEF: [f64; 2] = [0.27, -0.40];
const REEF_SPREAD: f64 = 0.5;
/// The spread of the assumption that there is no cast.
const NO_CAST_SPREAD: f64 = 0.25;
/// The ratio of the logarithms of linear light and of display values.
const GAMMA: f64 = 2.2;

/// The colour of a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patch {
    /// Its median colour in `clear`, `enhanced` and `enhanced-clear`, display values, unclamped.
    pub colors: [[f64; 3]; 3],
    /// Its distance along the optical axis, scene units.
    pub depth: f64,
}

/// A reason why something cannot be used as grey.
#[derive(Debug, thiserror::Error)]
pub enum WhiteError {
    /// The pixel lies outside the picture.
    #[error("the pixel {x},{y} is outside the picture of {width}x{height}")]
    Outside {
        /// Position from the left.
        x: f64,
        /// Position from the top.
        y: f64,
        /// The picture's width.
        width: usize,
        /// The picture's height.
        height: usize,
    },
    /// There is no surface.
    #[error("there is no surface, only water; choose a place on something solid")]
    NoSurface,
    /// The place is too dark.
    #[error("the place is too dark in `{look}` to tell its colour; choose a brighter one")]
    Dark {
        /// The look in which it is dark.
        look: &'static str,
    },
    /// The place is not grey.
    #[error("the place is far from grey in `{look}`: {color}; choose something grey or white")]
    Coloured {
        /// The look in which it is coloured.
        look: &'static str,
        /// Its colour.
        color: String,
    },
    /// There is nothing to measure.
    #[error("the views show only {0} surfaces, too few to tell a colour from; at least {FEWEST} are needed")]
    Surfaces(usize),
    /// The device failed.
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// The camera scaled so that its longer side has at most `longest` pixels.
fn at_most(camera: &Camera, longest: usize) -> Camera {
    let k = camera.intrinsics;
    let factor = longest as f64 / k.width.max(k.height) as f64;
    if factor >= 1.0 {
        return *camera;
    }
    let side = |n: usize| ((n as f64 * factor).round() as usize).max(1);
    let (width, height) = (side(k.width), side(k.height));
    let (sx, sy) = (width as f64 / k.width as f64, height as f64 / k.height as f64);
    Camera { intrinsics: k.scaled(sx, sy, width, height), pose: camera.pose }
}

/// The pixel indices of a patch along one side: the [`PATCH`] indices around `at` that lie inside.
fn around(at: f64, scale: f64, side: usize) -> Vec<usize> {
    let middle = ((at + 0.5) * scale).floor() as i64;
    let half = (PATCH / 2) as i64;
    (middle - half..=middle + half).filter(|v| (0..side as i64).contains(v)).map(|v| v as usize).collect()
}

/// Measures the colour of the pixel `(x, y)` of a camera's picture, counted from 0. The renderer must have
/// no white balance of its own.
///
/// # Errors
/// The pixel lies outside the picture or shows no surface, or the device failed.
pub fn patch(renderer: &mut SceneRenderer<'_>, camera: &Camera, x: f64, y: f64) -> Result<Patch, WhiteError> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if !((0.0..width as f64).contains(&x) && (0.0..height as f64).contains(&y)) {
        return Err(WhiteError::Outside { x, y, width, height });
    }
    let small = at_most(camera, LONGEST);
    let (w, h) = (small.intrinsics.width, small.intrinsics.height);
    let columns = around(x, w as f64 / width as f64, w);
    let rows = around(y, h as f64 / height as f64, h);
    let outside = WhiteError::Outside { x, y, width, height };
    let lattice = Lattice::subset(&columns, &rows).ok_or(outside)?;
    let frames = renderer.render_on(&small, &lattice, &MODES)?;
    let middle = |frame: &Rendering| -> [f64; 3] {
        let (data, pixels) = match frame {
            Rendering::Color(image) => (image.data(), image.pixels()),
            Rendering::Scalar(map) => (map.data(), map.pixels()),
        };
        let mut middle = [0.0; 3];
        for (value, channel) in middle.iter_mut().zip(data.chunks(pixels.max(1))) {
            *value = median(channel.iter().copied()).map_or(f64::NAN, f64::from);
        }
        middle
    };
    let [depth, _, _] = middle(&frames[3]);
    let [alpha, _, _] = middle(&frames[4]);
    if alpha.is_nan() || alpha < f64::from(SOLID) {
        return Err(WhiteError::NoSurface);
    }
    Ok(Patch { colors: [middle(&frames[0]), middle(&frames[1]), middle(&frames[2])], depth })
}

/// The cast of a colour that is assumed to be grey.
fn patch_cast(color: [f64; 3], look: &'static str) -> Result<[f64; 2], WhiteError> {
    if color.iter().any(|v| v.is_nan() || *v <= DARK) {
        return Err(WhiteError::Dark { look });
    }
    let u = white::cast(color).ok_or(WhiteError::Dark { look })?;
    let [least, most] = GAINS;
    if white::gains(u).iter().any(|gain| !(least..=most).contains(gain)) {
        let [r, g, b] = color;
        return Err(WhiteError::Coloured { look, color: format!("{r:.2}, {g:.2}, {b:.2}") });
    }
    Ok(u)
}

/// The mean cast of places in one look.
fn mean_cast(patches: &[Patch], look: usize) -> Result<[f64; 2], WhiteError> {
    let mut sum = [0.0; 2];
    for patch in patches {
        let u = patch_cast(patch.colors[look], LOOKS[look].name())?;
        sum.iter_mut().zip(u).for_each(|(sum, u)| *sum += u / patches.len() as f64);
    }
    Ok(sum)
}

/// The gains by which places become grey. In a scene that is not `enhanced` only those of `clear` are
/// measured. If the water hides a place in `enhanced`, that look stays unchanged.
///
/// # Errors
/// A place is too dark, or far from grey, without the water.
pub fn gains_of_patches(patches: &[Patch], enhanced: bool) -> Result<Gains, WhiteError> {
    let clear = mean_cast(patches, 0)?;
    if !enhanced {
        return Ok(Gains::of_casts([clear, [0.0; 2], clear]));
    }
    let behind_water = mean_cast(patches, 1).unwrap_or_default();
    Ok(Gains::of_casts([clear, behind_water, mean_cast(patches, 2)?]))
}

/// Converts the display value `v` to linear light, by sRGB's curve.
fn linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { math::powf((v + 0.055) / 1.055, 2.4) }
}

/// The surfaces of a scene: for each look, the linear colours of its voxels.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surfaces {
    colors: [Vec<[f64; 3]>; 3],
    /// True if the scene is enhanced, so that the last two looks differ from `clear`.
    enhanced: bool,
}

impl Surfaces {
    /// Collects the surfaces that `cameras`, or an even choice of them, see. The renderer must have no
    /// white balance of its own.
    ///
    /// # Errors
    /// The error of the device.
    pub fn seen_by(renderer: &mut SceneRenderer<'_>, cameras: &[Camera]) -> Result<Self, WhiteError> {
        let count = cameras.len().min(VIEWS);
        let mut points: Vec<(DVec3, f64, [[f64; 3]; 3])> = Vec::new();
        for k in 0..count {
            let camera = at_most(&cameras[k * cameras.len() / count], SMALL);
            let frames = renderer.render(&camera, &MODES)?;
            let [
                Rendering::Color(a),
                Rendering::Color(b),
                Rendering::Color(c),
                Rendering::Scalar(depth),
                Rendering::Scalar(alpha),
            ] = &frames[..]
            else {
                continue;
            };
            let intrinsics = camera.intrinsics;
            let to_world = camera.pose.rotation.transpose();
            for y in 0..intrinsics.height {
                for x in 0..intrinsics.width {
                    let ([z], [solid]) = (depth.pixel(x, y), alpha.pixel(x, y));
                    if !(solid >= SURFACE && z > 0.0) {
                        continue;
                    }
                    let z = f64::from(z);
                    let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                    let place = camera.pose.center() + to_world * (z * ray);
                    let colors = [a, b, c].map(|image| image.pixel(x, y).map(f64::from));
                    points.push((place, z * ray.length(), colors));
                }
            }
        }
        Ok(Self { enhanced: renderer.is_enhanced(), ..Self::of_points(&points) })
    }

    /// Merges points, each with its distance and display colours, into voxels.
    fn of_points(points: &[(DVec3, f64, [[f64; 3]; 3])]) -> Self {
        let Some(median) = median(points.iter().map(|point| point.1)) else { return Self::default() };
        let side = VOXEL * median;
        let mut voxels: BTreeMap<[i64; 3], (f64, [[f64; 3]; 3])> = BTreeMap::new();
        for (place, _, colors) in points {
            let key = (*place / side).floor().to_array().map(|v| v as i64);
            let (count, sums) = voxels.entry(key).or_default();
            *count += 1.0;
            for (sum, color) in sums.iter_mut().zip(colors) {
                sum.iter_mut().zip(color).for_each(|(sum, v)| *sum += v);
            }
        }
        let mut surfaces = Self::default();
        for (count, sums) in voxels.values() {
            for (list, sum) in surfaces.colors.iter_mut().zip(sums) {
                let color = sum.map(|v| v / count);
                let [least, most] = RANGE;
                if color.iter().all(|v| (least..=most).contains(v)) {
                    list.push(color.map(linear));
                }
            }
        }
        surfaces
    }

    /// The gains of all looks, with casts computed by a rule.
    fn gains(&self, rule: impl Fn(&[[f64; 3]]) -> [f64; 2]) -> Result<Gains, WhiteError> {
        let [least, most] = GAINS.map(|gain| math::ln(f64::from(gain)));
        let display = |u: [f64; 2]| u.map(|v| (v / GAMMA).clamp(least, most));
        let cast = |colors: &Vec<[f64; 3]>| match colors.len() {
            few if few < FEWEST => Err(WhiteError::Surfaces(few)),
            _ => Ok(display(rule(colors))),
        };
        let [clear, enhanced, enhanced_clear] = &self.colors;
        let clear = cast(clear)?;
        if !self.enhanced {
            return Ok(Gains::of_casts([clear, [0.0; 2], clear]));
        }
        Ok(Gains::of_casts([clear, cast(enhanced).unwrap_or_default(), cast(enhanced_clear)?]))
    }

    /// The gains by which all surfaces together are grey.
    ///
    /// # Errors
    /// There are too few surfaces.
    pub fn grey(&self) -> Result<Gains, WhiteError> {
        self.gains(|colors| {
            let sum = colors.iter().fold([0.0; 3], |sum, color| std::array::from_fn(|c| sum[c] + color[c]));
            white::cast(sum).unwrap_or_default()
        })
    }

    /// The gains under the assumptions that surfaces have the mean colour of a reef, and that there is no
    /// cast.
    ///
    /// # Errors
    /// There are too few surfaces.
    pub fn reef(&self) -> Result<Gains, WhiteError> {
        self.gains(|colors| {
            let casts = colors.iter().filter_map(|color| white::cast(*color));
            let sum = casts.fold([0.0; 2], |sum, u| std::array::from_fn(|k| sum[k] + u[k]));
            let mean = sum.map(|v| v / colors.len() as f64);
            half_believed(mean)
        })
    }
}

/// The cast of a mean colour under `reef`'s two assumptions, linear light.
fn half_believed(mean: [f64; 2]) -> [f64; 2] {
    let (reef, none) = (1.0 / (REEF_SPREAD * REEF_SPREAD), 1.0 / (NO_CAST_SPREAD * NO_CAST_SPREAD));
    std::array::from_fn(|k| (mean[k] - REEF[k]) * reef / (reef + none))
}

/// Multiplies the colours of Gaussians, channel by channel: in every direction `max(SH + ½, 0)` becomes
/// exactly `g` times its former value.
pub fn balanced(mut gaussians: Gaussians, gains: [f32; 3]) -> Gaussians {
    for sh in &mut gaussians.sh {
        for (k, band) in sh.iter_mut().enumerate() {
            for (v, gain) in band.iter_mut().zip(gains) {
                // SH + ½ is multiplied, so the change of the ½ moves into the first band.
                let shift = if k == 0 { 0.5 * (gain - 1.0) / C0 } else { 0.0 };
                *v = gain * *v + shift;
            }
        }
    }
    gaussians
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame, Intrinsics, Pose};
    use use3d_medium::MediumModel;
    use use3d_scene::Scene;
    use use3d_splat::view_colors;

    /// A wall of one colour two units ahead, only in the left half of the picture.
    fn wall(color: [f32; 3]) -> (Scene, Camera) {
        let grid = |i: usize| [-2.0 + 0.1 * (i % 21) as f32, -1.5 + 0.1 * (i / 21) as f32, 2.0];
        let n = 21 * 31;
        let mut sh = [[0.0; 3]; 16];
        sh[0] = color.map(|v| (v - 0.5) / C0);
        let gaussians = Gaussians {
            sh_degree: 0,
            means: (0..n).map(grid).collect(),
            log_scales: vec![[-2.3, -2.3, -5.0]; n],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![6.0; n],
            sh: vec![sh; n],
        };
        let medium = MediumModel::None;
        let scene = Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 0, enhancement: None };
        let intrinsics = Intrinsics { width: 120, height: 80, fx: 100.0, fy: 100.0, cx: 60.0, cy: 40.0 };
        (scene, Camera { intrinsics, pose: Pose::IDENTITY })
    }

    #[test]
    fn a_click_makes_its_place_grey_in_every_look() {
        let color = [0.3, 0.6, 0.5];
        let (scene, camera) = wall(color);
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
        let found = patch(&mut renderer, &camera, 30.0, 40.0).unwrap();
        assert!((found.depth - 2.0).abs() < 0.05, "{found:?}");
        for (seen, color) in found.colors[0].iter().zip(color) {
            assert!((seen - f64::from(color)).abs() < 0.01, "{found:?}");
        }
        let gains = gains_of_patches(&[found], true).unwrap();
        let mut white = SceneRenderer::new(&scene, 1.0).unwrap().with_white(gains);
        let after = patch(&mut white, &camera, 30.0, 40.0).unwrap();
        for [r, g, b] in after.colors {
            assert!((r / g - 1.0).abs() < 1e-4 && (b / g - 1.0).abs() < 1e-4, "{r} {g} {b}");
        }
    }

    #[test]
    fn a_fleck_under_the_click_does_not_count() {
        let (mut scene, camera) = wall([0.5; 3]);
        // A small red Gaussian in front of the wall, at the middle of the patch.
        let middle = |m: &[f32; 3]| (m[0] + 0.2).abs() < 0.05 && m[1].abs() < 0.05;
        let fleck = scene.gaussians.means.iter().position(middle).unwrap();
        scene.gaussians.means[fleck][2] = 1.9;
        scene.gaussians.log_scales[fleck] = [-4.0; 3];
        scene.gaussians.sh[fleck][0] = [1.5, -1.5, -1.5];
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
        let [[r, g, b], ..] = patch(&mut renderer, &camera, 50.0, 40.0).unwrap().colors;
        assert!((r - 0.5).abs() < 0.02 && (g - 0.5).abs() < 0.02 && (b - 0.5).abs() < 0.02, "{r} {g} {b}");
    }

    #[test]
    fn balanced_gaussians_have_the_balanced_colours_from_every_side() {
        let (mut scene, camera) = wall([0.3, 0.6, 0.5]);
        scene.gaussians.sh_degree = 3;
        for (i, sh) in scene.gaussians.sh.iter_mut().enumerate() {
            for (k, band) in sh.iter_mut().enumerate().skip(1) {
                *band = std::array::from_fn(|c| 0.4 * ((7 * i + 3 * k + c) % 11) as f32 / 11.0 - 0.2);
            }
        }
        let gains = [1.7, 1.0, 0.6];
        let (mut before, mut after) = (Vec::new(), Vec::new());
        view_colors(&scene.gaussians, &camera, 3, &mut before);
        view_colors(&balanced(scene.gaussians.clone(), gains), &camera, 3, &mut after);
        assert!(before.as_flattened().contains(&0.0), "some colour is clamped");
        for (before, after) in before.iter().zip(&after) {
            for c in 0..3 {
                assert!((gains[c] * before[c] - after[c]).abs() < 2e-6, "{before:?} {after:?}");
            }
        }
    }

    #[test]
    fn several_clicks_are_averaged_by_their_casts() {
        let patch = |r: f64, b: f64| Patch { colors: [[r, 0.5, b]; 3], depth: 1.0 };
        let gains = gains_of_patches(&[patch(0.25, 0.5), patch(1.0, 0.5)], true).unwrap();
        assert_eq!(gains.clear, [1.0; 3], "half and double cancel");
    }

    #[test]
    fn what_is_no_grey_is_refused_by_name() {
        let (scene, camera) = wall([0.5; 3]);
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
        assert!(matches!(patch(&mut renderer, &camera, 115.0, 40.0), Err(WhiteError::NoSurface)));
        assert!(matches!(patch(&mut renderer, &camera, 120.0, 40.0), Err(WhiteError::Outside { .. })));
        assert!(matches!(patch(&mut renderer, &camera, f64::NAN, 40.0), Err(WhiteError::Outside { .. })));
        let of = |color: [f64; 3]| gains_of_patches(&[Patch { colors: [color; 3], depth: 1.0 }], true);
        assert!(matches!(of([0.5, 0.5, 0.001]), Err(WhiteError::Dark { .. })));
        assert!(matches!(of([0.9, 0.1, 0.5]), Err(WhiteError::Coloured { .. })));
        // Behind much water the place is black; the looks without water are balanced nevertheless.
        let hidden = Patch { colors: [[0.4, 0.5, 0.5], [0.0, 0.1, 0.2], [0.5; 3]], depth: 9.0 };
        let gains = gains_of_patches(&[hidden], true).unwrap();
        assert_eq!((gains.clear[0] > 1.2, gains.enhanced, gains.enhanced_clear), (true, [1.0; 3], [1.0; 3]));
        let gains = gains_of_patches(&[hidden], false).unwrap();
        assert_eq!((gains.enhanced, gains.enhanced_clear), ([1.0; 3], gains.clear));
    }

    #[test]
    fn the_reef_s_belief_is_the_formula_s() {
        // (m/¼) / (1/¼ + 1/(1/16)) = m/5, with m = mean − (0.27, −0.40).
        let u = half_believed([0.58, 0.14]);
        assert!((u[0] - 0.062).abs() < 1e-12 && (u[1] - 0.108).abs() < 1e-12, "{u:?}");
        assert_eq!(half_believed(REEF), [0.0; 2]);
    }

    #[test]
    fn the_rules_see_the_colour_of_the_surfaces_with_one_vote_for_each_voxel() {
        let display =
            |v: f64| if v <= 0.0031308 { 12.92 * v } else { 1.055 * math::powf(v, 1.0 / 2.4) - 0.055 };
        let color = [0.2, 0.4, 0.3];
        let (scene, camera) = wall(color.map(|v| display(v) as f32));
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
        let surfaces = Surfaces::seen_by(&mut renderer, &[camera]).unwrap();
        assert!(surfaces.colors[0].len() > FEWEST);
        let grey = surfaces.grey().unwrap().clear;
        let expected = [math::powf(0.4f64 / 0.2, 1.0 / GAMMA), 1.0, math::powf(0.4f64 / 0.3, 1.0 / GAMMA)];
        for (gain, expected) in grey.iter().zip(expected) {
            assert!((f64::from(*gain) - expected).abs() < 0.02, "{grey:?} {expected:?}");
        }
        // Reefs are yellow: on a wall that is bluer, blue is lowered, by a fifth in the logarithm.
        let reef = surfaces.reef().unwrap().clear;
        let u = half_believed([math::ln(0.2f64 / 0.4), math::ln(0.3f64 / 0.4)]);
        assert!((math::ln(f64::from(reef[0])) + u[0] / GAMMA).abs() < 0.01, "{reef:?} {u:?}");
        // A hundred points in one voxel have a single vote.
        let point = |x: f64, v: f64| (DVec3::new(x, 0.0, 2.0), 2.0, [[v; 3]; 3]);
        let crowd: Vec<_> = (0..100).map(|_| point(0.001, 0.5)).chain([point(1.0, 0.7)]).collect();
        assert_eq!(Surfaces::of_points(&crowd).colors[0].len(), 2);
        assert!(matches!(Surfaces::of_points(&crowd).grey(), Err(WhiteError::Surfaces(2))));
        assert!(matches!(Surfaces::default().reef(), Err(WhiteError::Surfaces(0))));
    }
}
