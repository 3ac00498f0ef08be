//! The truth that comes with a capture, and the distance of a scene from it.
//!
//! `use3d synth capture` writes `truth/clean/` (the same views without water), `truth/depth/` (z-depth) and
//! `truth/water.json` next to the images. Any other capture may bring the same: `truth/clean/` with images of
//! the views' names is enough; depth and water are also measured if they are present. A `truth/` folder of
//! another form belongs to other software: it is ignored, with a notice. Truth is for judging only: it is
//! read when a finished scene is scored and never reaches training.
//!
//! Everything is measured where the truth shows a surface; open water has no clean colour and no depth. If no
//! depth is known, open water is where the clean image is black.
//!
//! * `truth_psnr`, `truth_delta_e`: PSNR and mean CIEDE2000 of `clip(g x)` against the true clean image, `g =
//!   Σ x y / Σ x²`: one gain for the whole image, since the absolute brightness of a scene without its water
//!   is not determined.
//! * `truth_delta_e_1976`: likewise with the colour difference of 1976, which older work gives.
//! * `truth_psnr_raw`, `truth_delta_e_raw`: the same of `clip(x)`, with nothing fitted. `…_channel`: after
//!   one such gain per channel, as for a camera with another white balance. `…_affine`: after the
//!   least-squares affine map of colours (3×4) per image; it leaves only errors that no
//!   adjustment of a whole picture can correct. Gains and maps are fitted to values in `[0, 1]` before they
//!   are clipped.
//! * `grey_near`, `grey_far`: if `truth/greys/` marks grey patches, the angle in degrees between grey and the
//!   sum of their colours (linear light, each of length 1): nearer than 3 m, and from 4 m on. Clipped and
//!   nearly black pixels do not count.
//! * `depth_error`: the median of `|z - z*| / z*` of the expected depth, `z*` the true depth times the scale
//!   of the recorded frame.
//! * `holes`: the share of surface where the accumulation is below one half: there the image shows mostly
//!   water.
//! * Water: the mean of a coefficient over all rays of the held-out views, in 1/metre. A length in the
//!   normalised frame is `scale` times the length in COLMAP's frame, which is `units_per_metre` times metres;
//!   a coefficient per length is converted the other way.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_capture::{Image, Map};
use use3d_import::{ImageSize, ImportError, ImportParams, Imported, SplitParams, import, is_prepared};
use use3d_metrics::{
    ExposureFit, Mask, MetricError, affine_fit, exposure_gain, map_colours, mean_cie1976, mean_ciede2000,
    psnr, psnr_exposure_fitted,
};
use use3d_numerics::math;
use use3d_numerics::order::median;
use use3d_synth::CaptureTruth;

use crate::scores::{Score, Scores};

/// The true clean images, relative to the capture.
const CLEAN: &str = "truth/clean";
/// The folder with the maps of grey patches.
const GREYS: &str = "truth/greys";
/// Grey patches up to the first distance are near, those from the second on are far, metres.
const NEAR_AND_FAR: [f64; 2] = [3.0, 4.0];
/// Fewest pixels of grey patches for a score.
const FEWEST_GREYS: usize = 12;
/// Range of display values in which a grey patch counts, in all channels: neither clipped nor nearly black.
const READABLE: [f32; 2] = [0.04, 0.96];
/// The true depths.
const DEPTH: &str = "truth/depth";
/// The true water.
const WATER: &str = "truth/water.json";

/// Accumulation from which a pixel shows a surface rather than the water in front of it.
const SEEN: f32 = 0.5;

/// Largest value of a black pixel of a clean image, display range: two steps of eight bits, to allow for
/// lossy files.
const BLACK: f32 = 2.5 / 255.0;

/// A file of the truth cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("the truth of the capture: {0}; write that file again, or rename the truth/ folder")]
pub struct TruthError(#[from] ImportError);

/// The parameters for reading the true images: like the capture's images, with lenses and sizes.
fn parameters(capture: &Path, size: Option<ImageSize>) -> ImportParams {
    ImportParams {
        image_dir: Some(CLEAN.into()),
        mask_dir: capture.join(GREYS).is_dir().then(|| GREYS.into()),
        depth_dir: capture.join(DEPTH).is_dir().then(|| DEPTH.into()),
        size,
        split: SplitParams { every: 0, lists: false, ..SplitParams::default() },
        ..ImportParams::default()
    }
}

/// True if a capture folder contains its truth.
fn is_there(capture: &Path) -> bool {
    capture.join(CLEAN).is_dir() && !is_prepared(capture)
}

/// The files of a capture that hold its truth, relative to it; none for a real capture.
pub fn files(capture: &Path) -> Vec<PathBuf> {
    if !is_there(capture) {
        return Vec::new();
    }
    let mut files = [CLEAN, DEPTH, WATER, GREYS].map(PathBuf::from).to_vec();
    files.retain(|file| file != Path::new(GREYS) || capture.join(file).is_dir());
    files.extend(import(capture, &parameters(capture, None)).ok().map(|i| PathBuf::from(i.report.model)));
    files
}

/// Reads all files of a capture's truth, and returns them and their folders, relative to the capture. A truth
/// of another form than this program's does not count as the truth of a capture, and nothing of it is read.
///
/// # Errors
/// The first file that cannot be read, and the reason.
pub fn check_readable(capture: &Path) -> Result<Vec<PathBuf>, ImportError> {
    if !is_there(capture) {
        return Ok(Vec::new());
    }
    let Ok(imported) = import(capture, &parameters(capture, None)) else { return Ok(Vec::new()) };
    let views = &imported.capture.views;
    (0..views.len()).try_for_each(|i| imported.view(i).map(|_| ()))?;
    if let Some((name, reason)) = imported.report.unusable.first_key_value() {
        let source = std::io::Error::new(std::io::ErrorKind::InvalidData, reason.clone());
        return Err(ImportError::File { path: capture.join(CLEAN).join(name), source });
    }
    Ok(sources(&imported))
}

/// The files and folders that decide which images a truth has, and its images. Folders count because their
/// times change when a file is added or removed.
fn sources(imported: &Imported) -> Vec<PathBuf> {
    let views = &imported.capture.views;
    let images = views.iter().flat_map(|v| [Some(&v.image), v.mask.as_ref(), v.depth_prior.as_ref()]);
    let mut sources: BTreeSet<PathBuf> = images.flatten().cloned().collect();
    let folders: Vec<PathBuf> =
        sources.iter().filter_map(|path| Some(path.parent()?.to_path_buf())).collect();
    sources.extend(folders);
    sources.extend(imported.model_files.iter().cloned());
    sources.extend(["truth", CLEAN, DEPTH, GREYS].map(PathBuf::from));
    sources.into_iter().collect()
}

/// A capture's truth.
pub struct Truth {
    imported: Imported,
    water: Option<CaptureTruth>,
    /// True if there are true depths.
    pub knows_depth: bool,
    /// True if grey patches are marked; otherwise the masks are the capture's own.
    knows_greys: bool,
}

impl Truth {
    /// Opens the truth of a capture folder whose views are scored at `size`; `None` if there is none of the
    /// form above. `say` is called with a notice for each part that is ignored.
    pub fn open(
        capture: &Path,
        (width, height): (usize, usize),
        say: &mut dyn FnMut(String),
    ) -> Option<Self> {
        const FORM: &str = "expected truth/clean/ with images of the views' names, and, if known, \
             truth/depth/ and truth/water.json as `use3d synth capture` writes them (docs/reference/captures.md)";
        if !is_there(capture) {
            if capture.join("truth").is_dir() && !is_prepared(capture) {
                say(format!("the capture's truth/ folder has no clean/ and is not used; {FORM}"));
            }
            return None;
        }
        let imported = import(capture, &parameters(capture, Some(ImageSize { width, height })));
        let imported = imported
            .inspect_err(|error| say(format!("the capture's truth/ folder is not used: {error}; {FORM}")))
            .ok()?;
        let water = read_water(&capture.join(WATER)).unwrap_or_else(|reason| {
            say(format!("{WATER} of the capture is not used: {reason}; {FORM}"));
            None
        });
        let [knows_depth, knows_greys] = [DEPTH, GREYS].map(|folder| capture.join(folder).is_dir());
        Some(Self { imported, water, knows_depth, knows_greys })
    }

    /// The truth of the view whose name has this stem; `None` if there is none.
    pub fn view(&self, stem: &str) -> Result<Option<TrueView>, TruthError> {
        let views = &self.imported.capture.views;
        let Some(index) = views.iter().position(|v| v.stem() == stem) else { return Ok(None) };
        let prepared = self.imported.view(index)?;
        // If the truth has no depths, the depth found here is the capture's own prior, and is dropped.
        let depth = prepared.depth_prior.filter(|_| self.knows_depth);
        let greys = prepared.mask.filter(|_| self.knows_greys);
        let metres = self.water.as_ref().map(|water| 1.0 / water.units_per_metre);
        Ok(Some(TrueView { clean: prepared.pixels.to_image(), depth, greys, metres }))
    }

    /// The recovered and the true water, if the truth is known (spectral water has no single true
    /// coefficient). `attenuation` and `backscatter` are means in 1/normalised unit, `scale` is the recorded
    /// frame's.
    pub fn water(&self, attenuation: [f64; 3], backscatter: [f64; 3], scale: f64) -> Option<WaterScores> {
        let truth = self.water.as_ref()?;
        let per_metre = |means: [f64; 3]| means.map(|v| v * scale * truth.units_per_metre);
        let scores = WaterScores {
            attenuation: per_metre(attenuation),
            backscatter: per_metre(backscatter),
            true_attenuation: truth.attenuation_per_metre?.map(f64::from),
            true_backscatter: truth.backscatter_per_metre?.map(f64::from),
        };
        let all = [scores.attenuation, scores.backscatter, scores.true_attenuation, scores.true_backscatter];
        all.as_flattened().iter().all(|v| v.is_finite()).then_some(scores)
    }
}

/// Reads the description of the water, if the file exists.
fn read_water(path: &Path) -> io::Result<Option<CaptureTruth>> {
    let text = match std::fs::read(path) {
        Ok(text) => text,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e),
    };
    let water: CaptureTruth = serde_json::from_slice(&text)?;
    if !(water.units_per_metre.is_finite() && water.units_per_metre > 0.0) {
        let reason = format!("units_per_metre is {}; expected a positive number", water.units_per_metre);
        return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
    }
    Ok(Some(water))
}

/// Recovered and true coefficients of the water, red, green, blue, 1/metre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WaterScores {
    /// Mean `β_attn` over the rays of the held-out views.
    pub attenuation: [f64; 3],
    /// Mean `β_bs` over the rays of the held-out views.
    pub backscatter: [f64; 3],
    /// The true `β_attn`.
    pub true_attenuation: [f64; 3],
    /// The true `β_bs`.
    pub true_backscatter: [f64; 3],
}

/// The correction that is fitted to the true image before an image is compared with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fit {
    /// No correction.
    Raw,
    /// Exposure gains.
    Gain(ExposureFit),
    /// An affine map of colours.
    Affine,
}

/// The suffixes of the scores' names, each with the fit before the comparison.
pub const FITS: [(&str, Fit); 4] = [
    ("_raw", Fit::Raw),
    ("", Fit::Gain(ExposureFit::Global)),
    ("_channel", Fit::Gain(ExposureFit::PerChannel)),
    ("_affine", Fit::Affine),
];

impl Fit {
    /// PSNR, mean CIEDE2000 and mean ΔE of 1976 of `x` against `y`, values in `[0, 1]`.
    fn compare(self, x: &Image, y: &Image) -> [Score; 3] {
        let (psnr, fitted) = match self {
            Self::Raw => (psnr(x, y, None), Ok(x.clone())),
            Self::Gain(fit) => {
                let exposed = exposure_gain(x, y, fit).map(|gains| {
                    let mut exposed = x.clone();
                    for (c, gain) in gains.into_iter().enumerate() {
                        exposed.plane_mut(c).iter_mut().for_each(|v| *v = (gain as f32 * *v).clamp(0.0, 1.0));
                    }
                    exposed
                });
                (psnr_exposure_fitted(x, y, fit).map(|(psnr, _)| psnr), exposed)
            }
            Self::Affine => {
                let mapped = affine_fit(x, y).map(|map| map_colours(x, &map).map(|v| v.clamp(0.0, 1.0)));
                let against = |x: &Image| psnr(x, y, None);
                (mapped.as_ref().map_err(MetricError::clone).and_then(against), mapped)
            }
        };
        let delta_e = |of: fn(&Image, &Image) -> Result<f64, MetricError>| {
            Score::measured(fitted.as_ref().map_err(MetricError::clone).and_then(|x| of(x, y)))
        };
        [Score::measured(psnr), delta_e(mean_ciede2000), delta_e(mean_cie1976)]
    }
}

/// The truth of one view.
pub struct TrueView {
    /// The true clean image.
    pub clean: Image,
    /// z-depth, COLMAP units; 0 is open water.
    depth: Option<Map>,
    /// 1 inside grey patches.
    greys: Option<Map>,
    /// Metres per COLMAP unit.
    metres: Option<f64>,
}

impl TrueView {
    fn shows_surface(&self, pixel: usize) -> bool {
        match &self.depth {
            Some(depth) => depth.data().get(pixel).is_some_and(|z| *z > 0.0),
            None => self.clean.planes().iter().any(|plane| plane.get(pixel).is_some_and(|v| *v > BLACK)),
        }
    }

    /// The pixels of an image inside the mask where the truth shows a surface, in one row, clamped to the
    /// display range.
    fn surface(&self, image: &Image, mask: Option<&Mask>) -> Image {
        let counts = |p: &usize| self.shows_surface(*p) && mask.is_none_or(|m| m.data().get(*p) != Some(&0));
        let shown: Vec<usize> = (0..image.pixels()).filter(counts).collect();
        let mut row = Image::new(shown.len(), 1);
        for c in 0..3 {
            let plane = image.plane(c);
            for (out, p) in row.plane_mut(c).iter_mut().zip(&shown) {
                *out = plane[*p].clamp(0.0, 1.0);
            }
        }
        row
    }

    /// `truth_psnr`, `truth_delta_e` and `truth_delta_e_1976` of an image after each of the
    /// [`FITS`], over the pixels of the mask.
    pub fn scores(&self, image: &Image, mask: Option<&Mask>) -> Scores {
        let sizes = [(image.width(), image.height()), (self.clean.width(), self.clean.height())];
        let surfaces =
            (sizes[0] == sizes[1]).then(|| (self.surface(image, mask), self.surface(&self.clean, mask)));
        let mut scores = Scores::new();
        for (suffix, fit) in FITS {
            let compared = if let Some((x, y)) = &surfaces {
                fit.compare(x, y)
            } else {
                let [(w, h), (tw, th)] = sizes;
                let reason = Score::NotAvailable(format!("the true image is {tw}x{th}, the view {w}x{h}"));
                [reason.clone(), reason.clone(), reason]
            };
            let names = ["truth_psnr", "truth_delta_e", "truth_delta_e_1976"];
            scores.extend(names.iter().zip(compared).map(|(name, score)| (format!("{name}{suffix}"), score)));
        }
        scores
    }

    /// `grey_near` and `grey_far` of an image; empty if the truth marks no grey patches.
    pub fn greys(&self, image: &Image) -> Scores {
        let mut scores = Scores::new();
        let (Some(greys), Some(depth), Some(metres)) = (&self.greys, &self.depth, self.metres) else {
            return scores;
        };
        let same = [greys.pixels(), depth.pixels()].iter().all(|n| *n == image.pixels());
        let near = |z: f64| z > 0.0 && z < NEAR_AND_FAR[0];
        let far = |z: f64| z >= NEAR_AND_FAR[1];
        let ranges: [(&str, &dyn Fn(f64) -> bool); 2] = [("grey_near", &near), ("grey_far", &far)];
        for (name, within) in ranges {
            let counts = |p: &usize| greys.data()[*p] > 0.999 && within(f64::from(depth.data()[*p]) * metres);
            let pixels = (0..image.pixels()).filter(|p| same && counts(p));
            let colors = pixels.map(|p| image.planes().map(|plane| plane[p]));
            scores.insert(name.into(), angle_to_grey(colors));
        }
        scores
    }

    /// The true depth, if it is known and has the size of `map`.
    fn depth_as(&self, map: &Map) -> Option<&Map> {
        self.depth.as_ref().filter(|truth| (truth.width(), truth.height()) == (map.width(), map.height()))
    }

    /// `holes` of a rendered accumulation.
    pub fn holes(&self, accumulation: &Map) -> Score {
        let Some(truth) = self.depth_as(accumulation) else { return no_depth() };
        let surface = accumulation.data().iter().zip(truth.data()).filter(|(_, z)| **z > 0.0);
        let surface: Vec<f32> = surface.map(|(a, _)| *a).collect();
        if surface.is_empty() {
            return Score::Undefined("the view shows no surface".into());
        }
        let holes = surface.iter().filter(|a| **a < SEEN).count();
        Score::of(holes as f64 / surface.len() as f64)
    }

    /// `depth_error` of a rendered z-depth in normalised units; `scale` is the recorded frame's.
    pub fn depth_error(&self, depth: &Map, scale: f64) -> Score {
        let Some(truth) = self.depth_as(depth) else { return no_depth() };
        let pairs = depth.data().iter().zip(truth.data());
        let errors = pairs
            .map(|(z, t)| (f64::from(*z), scale * f64::from(*t)))
            .filter(|(z, t)| *t > 0.0 && *z > 0.0 && z.is_finite())
            .map(|(z, t)| (z - t).abs() / t);
        match median(errors) {
            Some(median) => Score::of(median),
            None => Score::Undefined("no pixel has both a rendered and a true depth".into()),
        }
    }
}

/// The score of a view whose true depth is not known.
fn no_depth() -> Score {
    Score::NotAvailable(format!("the capture has no true depth of this view in {DEPTH}"))
}

/// Angle in degrees between grey and the sum of display colours, each converted to linear light and to length
/// 1.
fn angle_to_grey(colors: impl Iterator<Item = [f32; 3]>) -> Score {
    let readable = |color: &[f32; 3]| color.iter().all(|v| (READABLE[0]..=READABLE[1]).contains(v));
    let (mut sum, mut count) = ([0.0f64; 3], 0);
    for color in colors.filter(readable) {
        let light = color.map(|v| math::powf((f64::from(v) + 0.055) / 1.055, 2.4));
        let length = light.iter().map(|v| v * v).sum::<f64>().sqrt();
        sum.iter_mut().zip(light).for_each(|(s, v)| *s += v / length);
        count += 1;
    }
    if count < FEWEST_GREYS {
        return Score::Undefined(format!(
            "{count} pixels of grey patches can be read; {FEWEST_GREYS} are needed"
        ));
    }
    let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    let cosine = sum.iter().sum::<f64>() / (length * 3.0f64.sqrt());
    Score::of(math::acos(cosine.clamp(-1.0, 1.0)).to_degrees())
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_synth::{CaptureParams, write_capture};

    fn ramp(gain: f32) -> Image {
        let mut image = Image::new(8, 4);
        for y in 0..4 {
            for x in 0..8 {
                image.set_pixel(x, y, [0.1, 0.2, 0.05 * (x + y) as f32].map(|v| gain * v));
            }
        }
        image
    }

    #[test]
    fn what_a_clean_image_without_depth_leaves_black_is_no_surface() {
        let mut clean = ramp(1.0);
        (0..8).for_each(|x| clean.set_pixel(x, 0, [0.005; 3]));
        let view = TrueView { clean, depth: None, greys: None, metres: None };
        let mut image = ramp(1.01);
        (0..8).for_each(|x| image.set_pixel(x, 0, [0.9; 3]));
        assert!(view.scores(&image, None)["truth_psnr_raw"].value().is_some_and(|v| v > 40.0));
    }

    #[test]
    fn holes_are_counted_where_there_is_a_surface() {
        let mut depth = Map::filled(8, 4, 2.0);
        (0..8).for_each(|x| depth.set_pixel(x, 0, [0.0]));
        let view = TrueView { clean: ramp(1.0), depth: Some(depth), greys: None, metres: None };
        let mut accumulation = Map::filled(8, 4, 0.9);
        (0..8).for_each(|x| accumulation.set_pixel(x, 0, [0.1]));
        assert_eq!(view.holes(&accumulation).value(), Some(0.0), "open water is no hole");
        (0..6).for_each(|x| accumulation.set_pixel(x, 1, [0.4]));
        close(&view.holes(&accumulation), 6.0 / 24.0, 1e-9);
        assert!(view.holes(&Map::new(4, 4)).value().is_none(), "another size");
        let open = TrueView { clean: ramp(1.0), depth: Some(Map::new(8, 4)), greys: None, metres: None };
        assert!(open.holes(&accumulation).value().is_none(), "no surface at all");
    }

    fn close(score: &Score, wanted: f64, tolerance: f64) {
        let value = score.value().expect("a number");
        assert!((value - wanted).abs() <= tolerance, "{value} is not {wanted}");
    }

    #[test]
    fn exposure_is_forgiven_open_water_ignored_and_depth_scaled() {
        let mut depth = Map::filled(8, 4, 2.0);
        depth.set_pixel(0, 0, [0.0]);
        let truth = TrueView { clean: ramp(1.0), depth: Some(depth), greys: None, metres: None };
        let mut darker = ramp(0.5);
        darker.set_pixel(0, 0, [1.0, 0.0, 1.0]); // open water does not count, whatever its colour
        let scores = truth.scores(&darker, None);
        // Half the brightness is equal after the gain.
        assert!(scores["truth_psnr"].value().is_none_or(|psnr| psnr > 100.0), "{scores:?}");
        close(&scores["truth_delta_e"], 0.0, 1e-2);
        // Another hue cannot be corrected by an exposure.
        let mut tinted = ramp(0.5);
        tinted.plane_mut(0).fill(0.3);
        let scores = truth.scores(&tinted, None);
        assert!(scores["truth_psnr"].value().unwrap() < 25.0);
        assert!(scores["truth_delta_e"].value().unwrap() > 5.0);
        // z* = 0.5 · 2 = 1, rendered 1.1.
        close(&truth.depth_error(&Map::filled(8, 4, 1.1), 0.5), 0.1, 1e-6);
        assert!(truth.depth_error(&Map::new(8, 4), 0.5).value().is_none());
        assert!(truth.scores(&Image::filled(3, 3, 0.5), None)["truth_psnr"].value().is_none());
    }

    #[test]
    fn each_fit_forgives_what_it_can_and_nothing_else() {
        let clean = {
            let mut image = ramp(1.0);
            // Colours that vary in three dimensions, away from the ends of the range.
            for (i, v) in image.data_mut().iter_mut().enumerate() {
                *v = 0.3 + 0.4 * ((7 * i + i * i / 3) % 32) as f32 / 32.0;
            }
            image
        };
        let truth = TrueView { clean: clean.clone(), depth: None, greys: None, metres: None };
        let equal = |score: &Score| score.value().is_none_or(|psnr| psnr > 90.0);
        // Each distortion, and the fits that undo it.
        let channels = |gains: [f32; 3]| {
            let mut image = clean.clone();
            for (c, gain) in gains.into_iter().enumerate() {
                image.plane_mut(c).iter_mut().for_each(|v| *v *= gain);
            }
            image
        };
        let mixed = map_colours(&clean, &[[0.6, 0.2, 0.0, 0.05], [0.1, 0.7, 0.1, 0.0], [0.0, 0.2, 0.5, 0.1]]);
        for (image, undone) in [
            (clean.clone(), ["_raw", "", "_channel", "_affine"].as_slice()),
            (channels([0.6; 3]), &["", "_channel", "_affine"]),
            (channels([0.4, 0.8, 0.9]), &["_channel", "_affine"]),
            (mixed, &["_affine"]),
        ] {
            let scores = truth.scores(&image, None);
            for (suffix, _) in FITS {
                let (psnr, delta_e) =
                    (&scores[&format!("truth_psnr{suffix}")], &scores[&format!("truth_delta_e{suffix}")]);
                let delta_e = delta_e.value().unwrap();
                assert_eq!(equal(psnr), undone.contains(&suffix), "{suffix}: {scores:?}");
                let older = scores[&format!("truth_delta_e_1976{suffix}")].value().unwrap();
                assert_eq!(older < 0.04, undone.contains(&suffix), "{suffix}: {scores:?}");
                assert_eq!(delta_e < 0.02, undone.contains(&suffix), "{suffix}: {scores:?}");
            }
        }
        // A different image cannot be corrected by any fit, but a fit with more freedom comes closer.
        let scores = truth.scores(&ramp(1.0), None);
        let psnr = |suffix: &str| scores[&format!("truth_psnr{suffix}")].value().unwrap();
        assert!(psnr("_affine") > psnr("_channel") && psnr("_channel") > psnr("") && psnr("") > psnr("_raw"));
        assert!(psnr("_affine") < 30.0, "{scores:?}");
    }

    #[test]
    fn a_synthetic_capture_brings_its_truth_at_any_size_and_others_have_none() {
        let dir = tempfile::tempdir().unwrap();
        let capture = dir.path().join("reef");
        let params =
            CaptureParams { views: 2, width: 48, height: 32, detail: 0.2, ..CaptureParams::default() };
        let made = write_capture(&params, &capture, &mut |_, _| {}).unwrap();
        let listed = files(&capture);
        assert!(listed.contains(&PathBuf::from("truth/water.json")), "{listed:?}");

        let truth = open(&capture).0.expect("truth");
        let view = truth.view("frame_0001").unwrap().expect("a view");
        assert_eq!((view.clean.width(), view.clean.height()), (24, 16));
        assert_eq!(view.depth.as_ref().map(|d| (d.width(), d.height())), Some((24, 16)));
        assert!(truth.view("frame_0099").unwrap().is_none());
        assert!(view.scores(&view.clean, None)["truth_delta_e"].value().unwrap() < 1e-2);

        // A coefficient of 1/m is 1/(scale · units) per normalised unit; the conversion back gives the truth.
        let scale = 0.37;
        let per_metre = made.attenuation_per_metre.expect("the method's own water");
        let normalised = per_metre.map(|k| f64::from(k) / (scale * made.units_per_metre));
        let water = truth.water(normalised, normalised, scale).expect("water");
        for (found, wanted) in water.attenuation.iter().zip(water.true_attenuation) {
            assert!((found - wanted).abs() < 1e-9 * wanted.max(1.0));
        }

        std::fs::write(capture.join(WATER), "{}").unwrap();
        let (truth, notices) = open(&capture);
        assert!(truth.expect("the images").water(normalised, normalised, scale).is_none());
        assert!(notices[0].contains("water.json"), "{notices:?}");
        std::fs::remove_dir_all(capture.join("truth")).unwrap();
        assert!(files(&capture).is_empty());
        assert!(open(&capture).0.is_none());
    }

    fn open(capture: &Path) -> (Option<Truth>, Vec<String>) {
        let mut notices = Vec::new();
        let truth = Truth::open(capture, (24, 16), &mut |notice| notices.push(notice));
        (truth, notices)
    }

    #[test]
    fn clean_images_are_enough_and_what_belongs_to_others_is_left_alone_and_said() {
        let dir = tempfile::tempdir().unwrap();
        let capture = dir.path().join("reef");
        let params =
            CaptureParams { views: 2, width: 48, height: 32, detail: 0.2, ..CaptureParams::default() };
        write_capture(&params, &capture, &mut |_, _| {}).unwrap();
        std::fs::remove_file(capture.join(WATER)).unwrap();
        std::fs::remove_dir_all(capture.join(DEPTH)).unwrap();
        let (truth, notices) = open(&capture);
        let truth = truth.expect("clean images are enough");
        assert!(notices.is_empty() && truth.water([0.1; 3], [0.1; 3], 1.0).is_none(), "{notices:?}");
        let view = truth.view("frame_0001").unwrap().expect("a view");
        assert!(view.scores(&Image::filled(24, 16, 0.3), None)["truth_delta_e"].value().is_some());
        assert!(view.depth_error(&Map::filled(24, 16, 1.0), 1.0).value().is_none());

        // Folders of other software with the same name: poses, or images of other names.
        std::fs::rename(capture.join(CLEAN), capture.join("truth/poses")).unwrap();
        let (truth, notices) = open(&capture);
        assert!(truth.is_none() && notices[0].contains("truth/"), "{notices:?}");
        assert!(files(&capture).is_empty());
        std::fs::create_dir(capture.join(CLEAN)).unwrap();
        std::fs::write(capture.join(CLEAN).join("notes.txt"), "1 2 3").unwrap();
        let (truth, notices) = open(&capture);
        assert!(truth.is_none() && notices[0].contains("not used"), "{notices:?}");
        assert!(!files(&capture).is_empty(), "a change there is noticed");
    }

    #[test]
    fn greys_are_judged_by_their_angle_near_and_far() {
        let mut depth = Map::new(8, 4);
        depth.data_mut().iter_mut().enumerate().for_each(|(p, z)| *z = if p < 16 { 1.0 } else { 2.0 });
        let truth = TrueView {
            clean: Image::filled(8, 4, 0.5),
            depth: Some(depth),
            greys: Some(Map::filled(8, 4, 1.0)),
            metres: Some(2.5),
        };
        let mut image = Image::filled(8, 4, 0.5);
        // The far patches have twice the red light: linear (2, 1, 1) / √6 is at acos(4 / √18) from grey.
        let red = 1.055 * math::powf(2.0 * math::powf((0.5f32 + 0.055) / 1.055, 2.4), 1.0 / 2.4) - 0.055;
        image.plane_mut(0)[16..].fill(red);
        let scores = truth.greys(&image);
        assert!(scores["grey_near"].value().unwrap() < 0.01);
        let far = math::acos(4.0 / 18f64.sqrt()).to_degrees();
        assert!((scores["grey_far"].value().unwrap() - far).abs() < 1e-3, "{scores:?}");
        // Clipped pixels give no score, and neither does a truth without patches.
        image.plane_mut(2)[16..].fill(1.0);
        assert!(truth.greys(&image)["grey_far"].value().is_none());
        assert!(TrueView { greys: None, ..truth }.greys(&image).is_empty());
    }
}
