//! Scores of images: formulas always, networks where their weights are there; what is missing says so.

use std::path::Path;

use use3d_capture::{Camera, Image, Map};
use use3d_metrics::{
    GeometricView, MetricError, UciqeVariant, geometric_warp, psnr, ssim, uciqe, uiqm, warped_delta_e,
    warped_ssim,
};

use crate::scores::{Score, Scores};

/// Relative difference of depths that counts as the same surface when warping by geometry.
const SAME_SURFACE: f64 = 0.02;
/// Inputs of the quality networks whose long side is longer are scaled down to it, as in the paper.
#[cfg(feature = "nets")]
const LONGEST_SIDE: usize = 1024;

/// The quality networks, each opened once, or why it is not there.
pub struct Judges {
    #[cfg(feature = "nets")]
    lpips: Result<use3d_nets::Lpips, String>,
    #[cfg(feature = "nets")]
    uranker: Result<use3d_nets::URanker, String>,
    #[cfg(feature = "nets")]
    musiq: Result<use3d_nets::Musiq, String>,
    #[cfg(feature = "nets")]
    raft: Result<use3d_nets::Raft, String>,
}

#[cfg(not(feature = "nets"))]
const WITHOUT: &str = "not available: this program was built without networks (cargo feature `nets`)";

fn measured(result: Result<f64, MetricError>) -> Score {
    result.map_or_else(|e| Score::NotAvailable(e.to_string()), Score::Value)
}

impl Judges {
    /// Opens what lies in the models folder.
    #[cfg(feature = "nets")]
    pub fn open(models: Option<&Path>) -> Self {
        let Some(dir) = models else {
            let none =
                || "not available: no models folder; name one with --models or USE3D_MODELS".to_string();
            return Self { lpips: Err(none()), uranker: Err(none()), musiq: Err(none()), raft: Err(none()) };
        };
        let models = use3d_nets::Models::open(dir);
        Self {
            lpips: models.lpips().map_err(|e| e.to_string()),
            uranker: models.uranker().map_err(|e| e.to_string()),
            musiq: models.musiq().map_err(|e| e.to_string()),
            raft: models.raft().map_err(|e| e.to_string()),
        }
    }

    /// A build without networks has none.
    #[cfg(not(feature = "nets"))]
    pub fn open(_: Option<&Path>) -> Self {
        Self {}
    }

    /// PSNR, SSIM and LPIPS of an image against a reference of the same size. Both are clamped to the display range.
    pub fn against(&self, image: &Image, reference: &Image) -> Scores {
        let (image, reference) = (clamped(image), clamped(reference));
        let mut scores = Scores::new();
        scores.insert("psnr".into(), measured(psnr(&image, &reference)));
        scores.insert("ssim".into(), measured(ssim(&image, &reference)));
        scores.insert("lpips".into(), self.lpips(&image, &reference));
        scores
    }

    /// UCIQE, UIQM, URanker and MUSIQ of an image.
    pub fn alone(&self, image: &Image) -> Scores {
        let image = clamped(image);
        let mut scores = Scores::new();
        scores.insert("uciqe".into(), measured(uciqe(&image, UciqeVariant::default()).map(|u| u.score)));
        scores.insert("uiqm".into(), measured(uiqm(&image).map(|u| u.score)));
        scores.insert("uranker".into(), self.uranker(&image));
        scores.insert("musiq".into(), self.musiq(&image));
        scores
    }

    #[cfg(feature = "nets")]
    fn lpips(&self, a: &Image, b: &Image) -> Score {
        network(&self.lpips, |net| net.distance(a, b))
    }

    #[cfg(feature = "nets")]
    fn uranker(&self, image: &Image) -> Score {
        network(&self.uranker, |net| net.score(&use3d_nets::limit_long_side(image, LONGEST_SIDE)))
    }

    #[cfg(feature = "nets")]
    fn musiq(&self, image: &Image) -> Score {
        network(&self.musiq, |net| net.score(&use3d_nets::limit_long_side(image, LONGEST_SIDE)))
    }

    #[cfg(not(feature = "nets"))]
    fn lpips(&self, _: &Image, _: &Image) -> Score {
        Score::NotAvailable(WITHOUT.into())
    }

    #[cfg(not(feature = "nets"))]
    fn uranker(&self, _: &Image) -> Score {
        Score::NotAvailable(WITHOUT.into())
    }

    #[cfg(not(feature = "nets"))]
    fn musiq(&self, _: &Image) -> Score {
        Score::NotAvailable(WITHOUT.into())
    }
}

#[cfg(feature = "nets")]
fn network<N>(net: &Result<N, String>, score: impl FnOnce(&N) -> Result<f64, use3d_nets::NetError>) -> Score {
    match net.as_ref().map(score) {
        Ok(Ok(value)) => Score::Value(value),
        Ok(Err(error)) => Score::NotAvailable(error.to_string()),
        Err(reason) => Score::NotAvailable(reason.clone()),
    }
}

fn clamped(image: &Image) -> Image {
    image.map(|v| v.clamp(0.0, 1.0))
}

/// How one view's pixels are found in the next: by the reconstructed depth, and by optical flow of the photographs where the
/// network for it is there. Shared by all methods.
pub struct Pairing {
    geometry: Result<(use3d_metrics::Flow, use3d_metrics::Mask), String>,
    flow: Result<(use3d_metrics::Flow, use3d_metrics::Mask), String>,
}

impl Pairing {
    /// Of two views with their photographs and rendered depths.
    pub fn new(
        judges: &Judges,
        photographs: (&Image, &Image),
        cameras: (&Camera, &Camera),
        depths: (&Map, &Map),
    ) -> Self {
        let first = GeometricView { camera: cameras.0, depth: depths.0 };
        let second = GeometricView { camera: cameras.1, depth: depths.1 };
        Self {
            geometry: geometric_warp(first, second, SAME_SURFACE).map_err(|e| e.to_string()),
            flow: judges.flow(photographs.0, photographs.1),
        }
    }

    /// wLPIPS, wΔE and wSSIM of one method's images of the two views.
    pub fn scores(&self, judges: &Judges, first: &Image, second: &Image) -> Scores {
        let (first, second) = (clamped(first), clamped(second));
        let mut scores = Scores::new();
        let nothing = || Score::NotAvailable("the two views see nothing in common".into());
        match &self.geometry {
            Ok((flow, mask)) => {
                let of = |c: Result<use3d_metrics::Consistency, MetricError>| match c.map(|c| c.value) {
                    Ok(Some(value)) => Score::Value(value),
                    Ok(None) => nothing(),
                    Err(e) => Score::NotAvailable(e.to_string()),
                };
                scores.insert("w_delta_e".into(), of(warped_delta_e(&first, &second, flow, mask)));
                scores.insert("w_ssim".into(), of(warped_ssim(&first, &second, flow, mask)));
            }
            Err(reason) => {
                scores.insert("w_delta_e".into(), Score::NotAvailable(reason.clone()));
                scores.insert("w_ssim".into(), Score::NotAvailable(reason.clone()));
            }
        }
        let wlpips = match &self.flow {
            Ok((flow, mask)) => judges.warped_lpips(&first, &second, flow, mask),
            Err(reason) => Score::NotAvailable(reason.clone()),
        };
        scores.insert("wlpips".into(), wlpips);
        scores
    }
}

#[cfg(feature = "nets")]
impl Judges {
    fn flow(&self, a: &Image, b: &Image) -> Result<(use3d_metrics::Flow, use3d_metrics::Mask), String> {
        let raft = self.raft.as_ref().map_err(Clone::clone)?;
        let forward = raft.flow(a, b).map_err(|e| e.to_string())?;
        let backward = raft.flow(b, a).map_err(|e| e.to_string())?;
        let both = use3d_metrics::forward_backward(&forward, &backward).map_err(|e| e.to_string())?;
        let mask = both.relative_mask(0.01, 0.5);
        Ok((forward, mask))
    }

    fn warped_lpips(
        &self,
        a: &Image,
        b: &Image,
        flow: &use3d_metrics::Flow,
        mask: &use3d_metrics::Mask,
    ) -> Score {
        let lpips = match &self.lpips {
            Ok(lpips) => lpips,
            Err(reason) => return Score::NotAvailable(reason.clone()),
        };
        let distance = use3d_metrics::warped_distance(a, b, flow, mask, |x, y| {
            lpips.distance(x, y).map_err(|e| Reason(e.to_string()))
        });
        distance.map_or_else(|e| Score::NotAvailable(e.0), Score::Value)
    }
}

#[cfg(not(feature = "nets"))]
impl Judges {
    fn flow(&self, _: &Image, _: &Image) -> Result<(use3d_metrics::Flow, use3d_metrics::Mask), String> {
        Err(WITHOUT.into())
    }

    fn warped_lpips(&self, _: &Image, _: &Image, _: &use3d_metrics::Flow, _: &use3d_metrics::Mask) -> Score {
        Score::NotAvailable(WITHOUT.into())
    }
}

/// An error as its message, whichever crate it came from.
#[cfg(feature = "nets")]
struct Reason(String);

#[cfg(feature = "nets")]
impl From<MetricError> for Reason {
    fn from(error: MetricError) -> Self {
        Self(error.to_string())
    }
}
