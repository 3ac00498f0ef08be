//! The truth beside a synthetic capture, and how far a scene is from it.
//!
//! `use3d synth capture` leaves `truth/clean/` (the same views without water), `truth/depth/` (z-depth) and `truth/water.json`
//! beside the images. Truth is for judging only: it is read when a finished scene is scored and never reaches training.
//!
//! Everything is measured where the truth shows a surface; open water has no clean colour and no depth.
//!
//! * `truth_psnr`, `truth_delta_e`: PSNR and mean CIEDE2000 of `clip(g x)` against the true clean image, `g = Σ x y / Σ x²`: one
//!   gain for the whole image, since the absolute brightness of a scene without its water is not determined.
//! * `depth_error`: the median of `|z - z*| / z*` of the expected depth, `z*` the true depth times the scale of the recorded frame.
//! * Water: the mean of a coefficient over all rays of the held-out views, in 1/metre. A length in the normalised frame is
//!   `scale` times that in COLMAP's, which is `units_per_metre` times metres; a coefficient per length goes the other way.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_capture::{Image, Map};
use use3d_io_colmap::{ImageSize, ImportError, ImportParams, Imported, SplitParams, import, is_prepared};
use use3d_metrics::{ExposureFit, MetricError, exposure_gain, mean_ciede2000, psnr_exposure_fitted};
use use3d_synth::CaptureTruth;

use crate::scores::{Score, Scores};

/// The true clean images, relative to the capture.
const CLEAN: &str = "truth/clean";
/// The true depths.
const DEPTH: &str = "truth/depth";
/// The true water.
const WATER: &str = "truth/water.json";

/// Truth that cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum TruthError {
    /// Its images do not fit the capture.
    #[error(
        "the truth beside the capture: {0}; make the capture again with `use3d synth capture`, or remove its truth/ folder"
    )]
    Images(#[from] ImportError),
    /// Its description is missing or damaged.
    #[error("{}: {reason}; make the capture again with `use3d synth capture`, or remove its truth/ folder", path.display())]
    Water {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// How the true images are read: as the capture's images are, lenses, sizes and all.
fn parameters(size: Option<ImageSize>) -> ImportParams {
    ImportParams {
        image_dir: Some(CLEAN.into()),
        depth_dir: Some(DEPTH.into()),
        size,
        split: SplitParams { every: 0, lists: false, ..SplitParams::default() },
        ..ImportParams::default()
    }
}

/// Whether a capture folder has its truth beside it.
fn is_there(capture: &Path) -> bool {
    capture.join(CLEAN).is_dir() && !is_prepared(capture)
}

/// The files of a capture that hold its truth, relative to it: none for a real capture.
pub fn files(capture: &Path) -> Result<Vec<PathBuf>, TruthError> {
    if !is_there(capture) {
        return Ok(Vec::new());
    }
    let model = import(capture, &parameters(None))?.report.model;
    Ok([CLEAN, DEPTH, WATER, &model].map(PathBuf::from).to_vec())
}

/// A capture's truth.
pub struct Truth {
    imported: Imported,
    water: CaptureTruth,
}

impl Truth {
    /// Opens the truth of a capture folder whose views are scored at `size`; `None` where there is none.
    pub fn open(capture: &Path, (width, height): (usize, usize)) -> Result<Option<Self>, TruthError> {
        if !is_there(capture) {
            return Ok(None);
        }
        let imported = import(capture, &parameters(Some(ImageSize { width, height })))?;
        let path = capture.join(WATER);
        let bad = |reason: String| TruthError::Water { path: path.clone(), reason };
        let text = std::fs::read(&path).map_err(|e| bad(e.to_string()))?;
        let water: CaptureTruth = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        if !(water.units_per_metre.is_finite() && water.units_per_metre > 0.0) {
            return Err(bad(format!(
                "units_per_metre is {}; expected a positive number",
                water.units_per_metre
            )));
        }
        Ok(Some(Self { imported, water }))
    }

    /// The truth of the view whose name has this stem; `None` where it was not kept.
    pub fn view(&self, stem: &str) -> Result<Option<TrueView>, TruthError> {
        let views = &self.imported.capture.views;
        let Some(index) = views.iter().position(|v| v.stem() == stem) else { return Ok(None) };
        let prepared = self.imported.view(index)?;
        Ok(Some(TrueView { clean: prepared.pixels.to_image(), depth: prepared.depth_prior }))
    }

    /// The recovered water beside the true one. `attenuation` and `backscatter` are means in 1/normalised unit, `scale` is the
    /// recorded frame's.
    pub fn water(&self, attenuation: [f64; 3], backscatter: [f64; 3], scale: f64) -> WaterScores {
        let per_metre = |means: [f64; 3]| means.map(|v| v * scale * self.water.units_per_metre);
        WaterScores {
            attenuation: per_metre(attenuation),
            backscatter: per_metre(backscatter),
            true_attenuation: self.water.attenuation_per_metre.map(f64::from),
            true_backscatter: self.water.backscatter_per_metre.map(f64::from),
        }
    }
}

/// Recovered and true coefficients of the water, red, green, blue, 1/metre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WaterScores {
    /// Mean `β_attn` over the rays of the held-out views.
    pub attenuation: [f64; 3],
    /// Mean `β_bs` over the rays of the held-out views.
    pub backscatter: [f64; 3],
    /// `β_attn` as it was.
    pub true_attenuation: [f64; 3],
    /// `β_bs` as it was.
    pub true_backscatter: [f64; 3],
}

/// The truth of one view.
pub struct TrueView {
    clean: Image,
    /// z-depth, COLMAP units; 0 is open water.
    depth: Option<Map>,
}

impl TrueView {
    fn shows_surface(&self, pixel: usize) -> bool {
        self.depth.as_ref().is_none_or(|depth| depth.data().get(pixel).is_some_and(|z| *z > 0.0))
    }

    /// The pixels of an image where the truth shows a surface, in a row, clamped to the display range.
    fn surface(&self, image: &Image) -> Image {
        let shown: Vec<usize> = (0..image.pixels()).filter(|p| self.shows_surface(*p)).collect();
        let mut row = Image::new(shown.len(), 1);
        for c in 0..3 {
            let plane = image.plane(c);
            for (out, p) in row.plane_mut(c).iter_mut().zip(&shown) {
                *out = plane[*p].clamp(0.0, 1.0);
            }
        }
        row
    }

    /// `truth_psnr` and `truth_delta_e` of an image.
    pub fn scores(&self, image: &Image) -> Scores {
        let sizes = [(image.width(), image.height()), (self.clean.width(), self.clean.height())];
        let (psnr, delta_e) = if sizes[0] == sizes[1] {
            let (x, y) = (self.surface(image), self.surface(&self.clean));
            let text = |e: MetricError| e.to_string();
            let fitted = psnr_exposure_fitted(&x, &y, ExposureFit::Global).map(|(psnr, _)| psnr);
            let exposed = exposure_gain(&x, &y, ExposureFit::Global)
                .map(|[gain, ..]| x.map(|v| (gain as f32 * v).clamp(0.0, 1.0)));
            (fitted.map_err(text), exposed.and_then(|x| mean_ciede2000(&x, &y)).map_err(text))
        } else {
            let [(w, h), (tw, th)] = sizes;
            let reason = format!("the true image is {tw}x{th}, the view {w}x{h}");
            (Err(reason.clone()), Err(reason))
        };
        let score = |r: Result<f64, String>| r.map_or_else(Score::NotAvailable, Score::Value);
        Scores::from([("truth_psnr".into(), score(psnr)), ("truth_delta_e".into(), score(delta_e))])
    }

    /// `depth_error` of a rendered z-depth in normalised units; `scale` is the recorded frame's.
    pub fn depth_error(&self, depth: &Map, scale: f64) -> Score {
        let truth = match &self.depth {
            Some(truth) if (truth.width(), truth.height()) == (depth.width(), depth.height()) => truth,
            _ => {
                return Score::NotAvailable(format!("the capture has no true depth of this view in {DEPTH}"));
            }
        };
        let pairs = depth.data().iter().zip(truth.data());
        let mut errors: Vec<f64> = pairs
            .map(|(z, t)| (f64::from(*z), scale * f64::from(*t)))
            .filter(|(z, t)| *t > 0.0 && *z > 0.0 && z.is_finite())
            .map(|(z, t)| (z - t).abs() / t)
            .collect();
        errors.sort_unstable_by(f64::total_cmp);
        match errors.get(errors.len() / 2) {
            Some(median) => Score::Value(*median),
            None => Score::NotAvailable("no pixel has both a rendered and a true depth".into()),
        }
    }
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

    fn close(score: &Score, wanted: f64, tolerance: f64) {
        let value = score.value().expect("a number");
        assert!((value - wanted).abs() <= tolerance, "{value} is not {wanted}");
    }

    #[test]
    fn exposure_is_forgiven_open_water_ignored_and_depth_scaled() {
        let mut depth = Map::filled(8, 4, 2.0);
        depth.set_pixel(0, 0, [0.0]);
        let truth = TrueView { clean: ramp(1.0), depth: Some(depth) };
        let mut darker = ramp(0.5);
        darker.set_pixel(0, 0, [1.0, 0.0, 1.0]); // open water: whatever is there does not count
        let scores = truth.scores(&darker);
        assert!(scores["truth_psnr"].value().unwrap() > 100.0);
        close(&scores["truth_delta_e"], 0.0, 1e-2);
        // Another hue is not an exposure.
        let mut tinted = ramp(0.5);
        tinted.plane_mut(0).fill(0.3);
        let scores = truth.scores(&tinted);
        assert!(scores["truth_psnr"].value().unwrap() < 25.0);
        assert!(scores["truth_delta_e"].value().unwrap() > 5.0);
        // z* = 0.5 · 2 = 1, rendered 1.1.
        close(&truth.depth_error(&Map::filled(8, 4, 1.1), 0.5), 0.1, 1e-6);
        assert!(truth.depth_error(&Map::new(8, 4), 0.5).value().is_none());
        assert!(truth.scores(&Image::filled(3, 3, 0.5))["truth_psnr"].value().is_none());
    }

    #[test]
    fn a_synthetic_capture_brings_its_truth_at_any_size_and_others_have_none() {
        let dir = tempfile::tempdir().unwrap();
        let capture = dir.path().join("reef");
        let params =
            CaptureParams { views: 2, width: 48, height: 32, detail: 0.2, ..CaptureParams::default() };
        let made = write_capture(&params, &capture, &mut |_, _| {}).unwrap();
        let listed = files(&capture).unwrap();
        assert!(listed.contains(&PathBuf::from("truth/water.json")), "{listed:?}");

        let truth = Truth::open(&capture, (24, 16)).unwrap().expect("truth");
        let view = truth.view("frame_0001").unwrap().expect("a view");
        assert_eq!((view.clean.width(), view.clean.height()), (24, 16));
        assert_eq!(view.depth.as_ref().map(|d| (d.width(), d.height())), Some((24, 16)));
        assert!(truth.view("frame_0099").unwrap().is_none());
        assert!(view.scores(&view.clean)["truth_delta_e"].value().unwrap() < 1e-2);

        // A coefficient of 1/m is 1/(scale · units) per normalised unit; going back gives the truth.
        let scale = 0.37;
        let normalised = made.attenuation_per_metre.map(|k| f64::from(k) / (scale * made.units_per_metre));
        let water = truth.water(normalised, normalised, scale);
        for (found, wanted) in water.attenuation.iter().zip(water.true_attenuation) {
            assert!((found - wanted).abs() < 1e-9 * wanted.max(1.0));
        }

        std::fs::write(capture.join(WATER), "{}").unwrap();
        let error = Truth::open(&capture, (24, 16)).err().expect("damaged").to_string();
        assert!(error.contains("water.json") && error.contains("use3d synth capture"), "{error}");
        std::fs::remove_dir_all(capture.join("truth")).unwrap();
        assert!(files(&capture).unwrap().is_empty());
        assert!(Truth::open(&capture, (24, 16)).unwrap().is_none());
    }
}
