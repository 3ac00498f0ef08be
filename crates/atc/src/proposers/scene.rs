//! `scene`: an enhancement proposed from stage 1's description of a view, and not from a photograph.
//!
//! A photograph mixes surface and water, so a method that has only the photograph must guess which is
//! which. Stage 1 has separated them. For a training view it provides the clear radiance `J` (display
//! range, black where there is no surface), the accumulation `A`, and per channel the part of the surface's
//! light that arrives, `A t` with `t = e^{−β_attn s}`. A pixel is as *sure* as its least known channel,
//! `w = min_c A t_c`. The proposal is one grade for the whole scene, and one local rule:
//!
//! ```text
//! m    = weighted medians over all views of ln J_c − mean_c ln J_c              the scene's mean colour
//! d    = m − μ,   D² = (d_∥/σ_∥)² + (d_⊥/σ_⊥)²,   σ² = σ_0² + (error of m)²
//! ln g = −max(0, 1 − 1/D²) d,   scaled so that |ln g_c| ≤ ln 1.5                white balance
//! J̃    = Y (s C + (1 − s) C̄),   s = t²/(t² + t_0²),   t = min_c t_c             colour of far surfaces
//! ln C ← k ln C + (1 − k) m,   k = σ_C²/(σ_C² + ρ² Σ_c (τ_c − τ̄)²),   τ_c = −ln t_c
//! J⁺   = b (Y⁺/Y_95)^{p−1} g ⊙ J̃                                                brightness, contrast
//! ```
//!
//! * *White balance.* Surfaces under white light are on average not grey but slightly warm, `μ`: sand, rock
//!   and the growth on them reflect long waves more. A mean colour from grey to twice as warm as `μ` shows
//!   nothing about the light (`D ≤ 1`: gains of exactly one), and a clear cast is removed almost
//!   completely. This is the positive-part rule of James and Stein, with `d` split into its part along `μ`
//!   and across it, because warmth varies more from scene to scene than tint. Water found by the method's
//!   own formation leaves no cast; daylight that faded with depth, and a camera that balances
//!   automatically, do. The error of `m` has two parts: the differences between views, and the small number
//!   of kinds of surface, `n = 1 / P(two pixels of the scene look alike)`. The mean colour of a scene of
//!   fewer than two kinds (a tiled pool, a hull) depends on its paint as well as on its light, and the
//!   squared error gains `σ_s² (1/n − 1/2)`.
//! * *Far surfaces.* `J = (I − veil)/t` multiplies noise and errors of the water by `1/t`. Where `t` is
//!   below about `t_0`, the colour `C = J/Y` (Y: luminance) is replaced by `C̄`, that of the sure
//!   neighbourhood: `Σ w² J / Σ w² Y` blurred over a sixteenth of the image. The effect of a wrong
//!   attenuation grows with the distance: with a relative error ρ, colours are off by ρ times the
//!   differences of the optical depths `τ`. Log-colours (centred) are therefore drawn towards the scene's
//!   mean `m` as far as that error exceeds their own spread `σ_C`; luminance stays.
//! * *Brightness.* The bright end of the sure pixels (99th percentile of the largest channel) is brought to
//!   at least 0.85 and at most 0.97, by a gain `b` in [1/1.2, 1.5] that clips at most 0.3 % of the sure
//!   pixels; a gain above one also clips at most 0.3 % of the whole surface. `Y_95` is the 95th percentile
//!   of luminance after the balance.
//! * *Contrast.* It changes only if the scene's luminance spans less than 3 : 1 from the 5th to the 95th
//!   percentile: `p` widens it, by at most 1.15.
//! * *Air.* Without water nothing was removed from the scene: brightness and contrast stay as the camera
//!   set them.
//!
//! Medians and percentiles use at most 4096 pixels of each view, on an even grid. A standard error counts
//! every four views as one independent view, because neighbouring views see the same surfaces. The proposer
//! is deterministic; it has no weights and no randomness.
//!
//! Limits: it assumes one light for the whole scene. A reef that is mostly of one vivid colour is treated
//! as a cast, as by any such estimate, within the bounds of `g`. The constants describe everyday surfaces
//! and no particular capture.

use serde::{Deserialize, Serialize};
use use3d_capture::{Image, Map, Raster};
use use3d_numerics::math;

use super::ProposerId;
use super::fusion::pyramid::{expand, reduce};
use crate::error::AtcError;
use crate::extractor::global::LUMINANCE;

/// The proposer's name.
pub const NAME: &str = "scene";
/// The version of the formula; it is raised when a constant or a step changes.
const VERSION: &str = "4";

/// Mean log-colour of surfaces under white light: between those of everyday photographs and of sand.
const WARMTH: [f64; 3] = [0.10, 0.03, -0.13];
/// The spread of the mean log-colours of scenes under white light around [`WARMTH`]: along it (grey is one
/// such distance away), and across it.
const SPREAD: [f64; 2] = [0.17, 0.10];
/// Largest gain of a channel.
const LARGEST_BALANCE: f64 = 1.5;
/// The root mean square distance per scene of the log-colour of one kind of surface, any paint, from the
/// mean of all kinds.
const PAINT: f64 = 1.3;
/// Number of kinds of surface from which on their mean is the usual one.
const KINDS: f64 = 2.0;
/// Distance of centred log-colours below which two pixels look alike.
const ALIKE: f64 = 0.1;
/// Largest number of pixels that are compared with each other.
const COMPARED: usize = 1024;
/// Number of views that count as one independent view of the scene.
const VIEWS_ALIKE: f64 = 4.0;
/// Transmittance at which half of the colour comes from the neighbourhood.
const HALF_TRUST: f32 = 0.05;
/// Relative error of an attenuation.
const WRONG: f64 = 0.15;
/// Spread of the surfaces' centred log-colours around the scene's mean.
const COLOURS: f64 = 0.3;
/// Smallest transmittance and radiance that are distinguished from zero.
const LEAST: f64 = 1e-3;
/// Range in which the bright end of the scene may lie, display range.
const BRIGHT_END: [f64; 2] = [0.85, 0.97];
/// Bounds of the brightness.
const BRIGHTNESS: [f64; 2] = [1.0 / 1.2, 1.5];
/// Fraction of arriving light above which, if it holds everywhere, there is no water.
const NO_LOSS: f32 = 0.999;
/// Share of the surface that a brighter scene may clip.
const CLIPPED: f64 = 0.003;
/// The smallest range of luminance, 95th over 5th percentile, that stays unchanged; and the largest
/// exponent that widens a smaller range.
const CONTRAST: (f64, f64) = (3.0, 1.15);
/// Largest number of sampled pixels in a view.
const SAMPLES: usize = 4096;
/// Smallest radiance whose colour is used; darker pixels are noise.
const DARK: f64 = 0.04;
/// Smallest sum of weights, in pixels, that is enough for an estimate.
const LEAST_WEIGHT: f64 = 20.0;

/// Stage 1's description of a view. All three images have one size.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneView {
    /// Clear radiance `J`, display range, unclamped, black where there is no surface.
    pub clear: Image,
    /// Accumulated opacity `A`, `[0, 1]`.
    pub accumulation: Map,
    /// The part of a white surface's light that arrives, `A t`, per channel, `[0, 1]`.
    pub arriving: Image,
}

impl SceneView {
    fn check(&self) -> Result<(), AtcError> {
        let wrong = |message: String| AtcError::Proposer { proposer: NAME.into(), message };
        let size = (self.clear.width(), self.clear.height());
        if size.0 == 0 || size.1 == 0 {
            return Err(AtcError::EmptyImage { role: "proposer's", width: size.0, height: size.1 });
        }
        let others = [
            (self.accumulation.width(), self.accumulation.height()),
            (self.arriving.width(), self.arriving.height()),
        ];
        if others != [size; 2] {
            return Err(wrong(format!(
                "clear radiance is {size:?}, accumulation and arriving light {others:?}"
            )));
        }
        let all = [self.clear.data(), self.accumulation.data(), self.arriving.data()];
        if !all.iter().all(|plane| plane.iter().all(|v| v.is_finite())) {
            return Err(wrong("a render of stage 1 has a value that is not finite".into()));
        }
        Ok(())
    }

    /// `w = min_c A t_c`.
    fn sureness(&self) -> Map {
        let [r, g, b] = self.arriving.planes();
        let data = r.iter().zip(g).zip(b).map(|((r, g), b)| r.min(*g).min(*b).clamp(0.0, 1.0)).collect();
        let (w, h) = (self.clear.width(), self.clear.height());
        Map::from_planes(w, h, data).unwrap_or_else(|| Map::new(w, h))
    }
}

/// A sampled pixel of a surface.
#[derive(Clone, Copy, Debug)]
struct SurfaceSample {
    radiance: [f64; 3],
    weight: f64,
}

/// A centred log-colour and its weight.
type Coloured = ([f64; 3], f64);

/// Collects samples from the views of a scene, one after another, before anything is proposed for any view.
#[derive(Clone, Debug, Default)]
pub struct SceneSurvey {
    views: Vec<Vec<SurfaceSample>>,
    /// True if some light is lost in any view.
    water: bool,
}

/// The findings about a scene, for reports.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneFindings {
    /// The scene's mean colour `m`: log of each channel over their geometric mean.
    pub mean_colour: [f64; 3],
    /// Its standard error, over views and kinds of surface.
    pub standard_error: f64,
    /// Number of kinds of surface: one over the chance that two pixels look alike; at least 1.
    pub kinds: f64,
    /// Share of the difference from the usual mean colour that is removed, `[0, 1)`; 0 if no cast is
    /// certain.
    pub trusted: f64,
    /// White balance `g`.
    pub balance: [f64; 3],
    /// Brightness `b`.
    pub brightness: f64,
    /// Exponent `p` of the contrast.
    pub contrast: f64,
    /// Luminance that the contrast leaves unchanged, `Y_95`.
    pub pivot: f64,
    /// Share of the sampled surface that leaves the display range after grading.
    pub clipped: f64,
}

impl SceneFindings {
    /// A scene that is left unchanged.
    const NONE: Self = Self {
        mean_colour: [0.0; 3],
        standard_error: 0.0,
        kinds: 1.0,
        trusted: 0.0,
        balance: [1.0; 3],
        brightness: 1.0,
        contrast: 1.0,
        pivot: 1.0,
        clipped: 0.0,
    };
}

impl SceneSurvey {
    /// Adds one training view.
    pub fn add(&mut self, view: &SceneView) -> Result<(), AtcError> {
        view.check()?;
        let (w, h) = (view.clear.width(), view.clear.height());
        let sure = view.sureness();
        // The numbers of columns and rows keep the grid's cells square.
        let share = (SAMPLES as f64 / (w * h) as f64).sqrt().min(1.0);
        let axis = |n: usize| {
            let count = ((n as f64 * share) as usize).max(1);
            (0..count).map(move |i| (2 * i + 1) * n / (2 * count))
        };
        let mut samples = Vec::new();
        for y in axis(h) {
            for x in axis(w) {
                let [accumulation] = view.accumulation.pixel(x, y);
                if accumulation >= 0.5 {
                    let arriving = view.arriving.pixel(x, y);
                    self.water |= arriving.iter().any(|a| *a < NO_LOSS * accumulation);
                    let radiance = view.clear.pixel(x, y).map(|v| f64::from(v.max(0.0)));
                    samples.push(SurfaceSample { radiance, weight: f64::from(sure.pixel(x, y)[0]) });
                }
            }
        }
        self.views.push(samples);
        Ok(())
    }

    /// The scene's proposer.
    pub fn finish(self) -> SceneProposer {
        SceneProposer { findings: self.findings().unwrap_or(SceneFindings::NONE) }
    }

    /// The findings; `None` if hardly any pixel is sure.
    fn findings(&self) -> Option<SceneFindings> {
        let coloured: Vec<Vec<Coloured>> =
            self.views.iter().map(|v| v.iter().filter_map(log_colour).collect()).collect();
        let pooled = coloured.concat();
        let (mean_colour, _) = middle(&pooled)?;
        let kinds = kinds(&pooled);
        let few = PAINT * PAINT * (1.0 / kinds - 1.0 / KINDS).max(0.0);
        let standard_error = (math::powi(standard_error(&coloured, mean_colour), 2) + few).sqrt();
        let (balance, trusted) = balance(mean_colour, standard_error);

        let all: Vec<SurfaceSample> = self.views.iter().flatten().copied().collect();
        let graded = |s: &SurfaceSample| -> [f64; 3] { std::array::from_fn(|c| balance[c] * s.radiance[c]) };
        let light: Vec<(f64, f64)> = all.iter().map(|s| (luminance(graded(s)), s.weight)).collect();
        let pivot = quantile(&light, 0.95)?.max(1e-3);
        let range = pivot / quantile(&light, 0.05)?.max(1e-3);
        let widest = if self.water { CONTRAST.1 } else { 1.0 };
        let contrast = (math::ln(CONTRAST.0) / math::ln(range.max(1.0 + 1e-9))).clamp(1.0, widest);
        let largest = |s: &SurfaceSample| {
            let x = graded(s);
            curve(x, pivot, contrast) * x[0].max(x[1]).max(x[2])
        };
        let sure: Vec<(f64, f64)> = all.iter().map(|s| (largest(s), s.weight)).collect();
        let surface: Vec<(f64, f64)> = sure.iter().map(|(v, _)| (*v, 1.0)).collect();
        let bright = quantile(&sure, 0.99)?.max(1e-3);
        let sure_limit = quantile(&sure, 1.0 - CLIPPED)?.max(1e-3);
        let limit = quantile(&surface, 1.0 - CLIPPED)?.max(1e-3);
        let wanted =
            (bright.clamp(BRIGHT_END[0], BRIGHT_END[1]) / bright).clamp(BRIGHTNESS[0], BRIGHTNESS[1]);
        // Pixels that are not sure, for example noise far away, can limit a brightening of the scene but
        // never darken it.
        let bounded = wanted.min((1.0 / sure_limit).max(BRIGHTNESS[0])).min((1.0 / limit).max(1.0));
        let brightness = if self.water { bounded } else { 1.0 };
        let over = surface.iter().filter(|(v, _)| brightness * v > 1.0).count();
        Some(SceneFindings {
            mean_colour,
            standard_error,
            kinds,
            trusted,
            balance,
            brightness,
            contrast,
            pivot,
            clipped: over as f64 / surface.len().max(1) as f64,
        })
    }
}

/// The log of each channel over their geometric mean, and the weight; `None` for a pixel that is dark or
/// clipped.
fn log_colour(sample: &SurfaceSample) -> Option<Coloured> {
    let shown = |v: &f64| (DARK / 4.0..1.0).contains(v);
    let bright = luminance(sample.radiance) >= DARK;
    if !(bright && sample.weight > 0.0 && sample.radiance.iter().all(shown)) {
        return None;
    }
    let logs = sample.radiance.map(math::ln);
    Some((centred(logs), sample.weight))
}

fn centred(v: [f64; 3]) -> [f64; 3] {
    let mean = (v[0] + v[1] + v[2]) / 3.0;
    v.map(|x| x - mean)
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn luminance(x: [f64; 3]) -> f64 {
    dot(LUMINANCE, x)
}

/// `(Y/Y_95)^{p−1}`.
fn curve(x: [f64; 3], pivot: f64, exponent: f64) -> f64 {
    if exponent > 1.0 { math::powf((luminance(x) / pivot).max(1e-6), exponent - 1.0) } else { 1.0 }
}

/// The weighted median of each channel, centred, and the sum of the weights; `None` if that sum is too
/// small.
fn middle(colours: &[Coloured]) -> Option<([f64; 3], f64)> {
    let total: f64 = colours.iter().map(|(_, w)| w).sum();
    if total < LEAST_WEIGHT {
        return None;
    }
    let mut medians = [0.0; 3];
    for (c, median) in medians.iter_mut().enumerate() {
        let values: Vec<(f64, f64)> = colours.iter().map(|(v, w)| (v[c], *w)).collect();
        *median = quantile(&values, 0.5)?;
    }
    Some((centred(medians), total))
}

/// The smallest value up to which a share of the weight lies; `None` without weight.
fn quantile(values: &[(f64, f64)], share: f64) -> Option<f64> {
    let mut sorted: Vec<(f64, f64)> = values.iter().copied().filter(|(_, w)| *w > 0.0).collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = sorted.iter().map(|(_, w)| w).sum();
    let mut below = 0.0;
    for (value, weight) in &sorted {
        below += weight;
        if below >= share * total {
            return Some(*value);
        }
    }
    sorted.last().map(|(value, _)| *value)
}

/// The error of the mean colour from the differences between views: root mean square over channels.
fn standard_error(views: &[Vec<Coloured>], mean: [f64; 3]) -> f64 {
    let (mut weights, mut squares, mut spread) = (0.0, 0.0, 0.0);
    for (own, weight) in views.iter().filter_map(|v| middle(v)) {
        weights += weight;
        squares += weight * weight;
        let apart: [f64; 3] = std::array::from_fn(|c| own[c] - mean[c]);
        spread += weight * dot(apart, apart) / 3.0;
    }
    if weights <= 0.0 {
        return 0.0;
    }
    let independent = (weights * weights / squares / VIEWS_ALIKE).max(1.0);
    (spread / weights / independent).sqrt()
}

/// One over the chance that two pixels, drawn by their weights, look alike; 1 without pixels.
fn kinds(colours: &[Coloured]) -> f64 {
    let some: Vec<&Coloured> = colours.iter().step_by(colours.len().div_ceil(COMPARED).max(1)).collect();
    let (mut alike, mut all) = (0.0, 0.0);
    for (i, (one, weight)) in some.iter().enumerate() {
        for (other, other_weight) in &some[..i] {
            let apart: [f64; 3] = std::array::from_fn(|c| one[c] - other[c]);
            let pair = weight * other_weight;
            all += pair;
            if dot(apart, apart) < ALIKE * ALIKE {
                alike += pair;
            }
        }
    }
    if alike > 0.0 { all / alike } else { (some.len() as f64).max(1.0) }
}

/// The gains that remove the certain part of a colour cast, and the share of the cast that they remove.
fn balance(mean: [f64; 3], error: f64) -> ([f64; 3], f64) {
    let apart: [f64; 3] = std::array::from_fn(|c| mean[c] - WARMTH[c]);
    let length = dot(WARMTH, WARMTH).sqrt();
    let along = dot(apart, WARMTH) / length;
    let across = (dot(apart, apart) - along * along).max(0.0);
    let [own, other] = SPREAD.map(|s| s * s + error * error);
    let distance = along * along / own + across / other;
    let trusted = if distance > 1.0 { 1.0 - 1.0 / distance } else { 0.0 };
    let most = apart.iter().fold(0.0f64, |m, d| m.max((trusted * d).abs()));
    let bound = math::ln(LARGEST_BALANCE);
    let trusted = if most > bound { trusted * bound / most } else { trusted };
    (apart.map(|d| math::exp(-trusted * d)), trusted)
}

/// The grade of one scene, to be applied to each of its views.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneProposer {
    /// The findings about the scene.
    pub findings: SceneFindings,
}

impl SceneProposer {
    /// The proposer's identity, which depends on its formula and not on the scene.
    pub fn id() -> ProposerId {
        ProposerId { name: NAME.into(), digest: VERSION.into() }
    }

    /// The enhanced clear radiance of a view, in its size; display range, not clamped.
    pub fn propose(&self, view: &SceneView) -> Result<Image, AtcError> {
        view.check()?;
        let SceneFindings { mean_colour, balance, brightness, contrast, pivot, .. } = self.findings;
        let mut out = calmed(view);
        if self.findings != SceneFindings::NONE {
            draw_to_mean(&mut out, view, mean_colour);
        }
        for p in 0..out.pixels() {
            let x: [f64; 3] = std::array::from_fn(|c| balance[c] * f64::from(out.plane(c)[p]));
            let curve = curve(x, pivot, contrast);
            for (c, x) in x.into_iter().enumerate() {
                out.plane_mut(c)[p] = (brightness * curve * x) as f32;
            }
        }
        Ok(out)
    }
}

/// `J̃`: where little of the surface's light arrives, its colour is that of the sure neighbourhood.
fn calmed(view: &SceneView) -> Image {
    let (w, h) = (view.clear.width(), view.clear.height());
    let sure = view.sureness();
    let mut out = view.clear.map(|v| v.max(0.0));
    let luminance =
        |x: [f32; 3]| LUMINANCE[0] as f32 * x[0] + LUMINANCE[1] as f32 * x[1] + LUMINANCE[2] as f32 * x[2];
    // w² J and w² Y, blurred.
    let mut sums = Raster::<f32, 4>::new(w, h);
    for p in 0..w * h {
        let x: [f32; 3] = std::array::from_fn(|c| out.plane(c)[p]);
        let weight = sure.data()[p] * sure.data()[p];
        for (c, v) in [x[0], x[1], x[2], luminance(x)].into_iter().enumerate() {
            sums.plane_mut(c)[p] = weight * v;
        }
    }
    let around = blurred(sums);
    for p in 0..w * h {
        let x: [f32; 3] = std::array::from_fn(|c| out.plane(c)[p]);
        let (y, accumulation, around_y) = (luminance(x), view.accumulation.data()[p], around.plane(3)[p]);
        if y <= 1e-3 || accumulation <= 1e-3 || around_y <= 1e-7 {
            continue;
        }
        let t = sure.data()[p] / accumulation;
        let own = t * t / (t * t + HALF_TRUST * HALF_TRUST);
        for c in 0..3 {
            let near = y * around.plane(c)[p] / around_y;
            out.plane_mut(c)[p] = own * x[c] + (1.0 - own) * near;
        }
    }
    out
}

/// Draws colours towards the scene's mean log-colour as far as a wrong attenuation may have caused them.
fn draw_to_mean(image: &mut Image, view: &SceneView, mean: [f64; 3]) {
    for p in 0..image.pixels() {
        let accumulation = f64::from(view.accumulation.data()[p]);
        if accumulation <= LEAST {
            continue;
        }
        let depths: [f64; 3] = std::array::from_fn(|c| {
            -math::ln((f64::from(view.arriving.plane(c)[p]) / accumulation).clamp(LEAST, 1.0))
        });
        let apart = centred(depths);
        let wrong = WRONG * WRONG * dot(apart, apart);
        let x: [f64; 3] = std::array::from_fn(|c| f64::from(image.plane(c)[p]));
        if wrong <= 0.0 || luminance(x) <= LEAST {
            continue;
        }
        let own = COLOURS * COLOURS / (COLOURS * COLOURS + wrong);
        let colour = centred(x.map(|v| math::ln(v.max(LEAST))));
        let drawn: [f64; 3] = std::array::from_fn(|c| math::exp(own * colour[c] + (1.0 - own) * mean[c]));
        let scale = luminance(x) / luminance(drawn);
        for (c, v) in drawn.into_iter().enumerate() {
            image.plane_mut(c)[p] = (scale * v) as f32;
        }
    }
}

/// Blurs over about a sixteenth of the long side: the image is reduced to about twenty pixels and expanded
/// again.
fn blurred<const C: usize>(image: Raster<f32, C>) -> Raster<f32, C> {
    let (w, h) = (image.width(), image.height());
    if w.max(h) <= 20 {
        return image;
    }
    expand(&blurred(reduce(&image)), w, h)
}

#[cfg(test)]
mod tests;
