//! Scores of images: formulas always, networks if their weights are present; a missing network gives its
//! reason.
//!
//! With a mask, only the pixels inside it count ([`use3d_metrics::Mask`]): PSNR and UCIQE use these pixels,
//! SSIM the windows that contain no others. UIQM, URanker and MUSIQ judge whole pictures; the pixels outside
//! the mask are black, in the pictures of all methods alike. LPIPS gets the same pictures and is divided by
//! the share of pixels inside the mask, because its mean runs over all pixels.

use std::borrow::Cow;
use std::path::Path;

use use3d_capture::{Camera, Image, Map};
use use3d_metrics::{
    Flow, GeometricView, Mask, MetricError, UciqeVariant, blacked_out, counted, geometric_warp, only_counted,
    psnr, ssim, uciqe, uiqm, warped_delta_e, warped_ssim,
};

use crate::judge::scores::{Score, Scores};

/// Relative difference of depths that counts as the same surface when warping by geometry.
const SAME_SURFACE: f64 = 0.02;
/// Inputs of the quality networks are scaled down to this long side if theirs is longer, as in the paper.
#[cfg(feature = "nets")]
const LONGEST_SIDE: usize = 1024;

/// The quality networks, each opened once, or the reason why it is missing.
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

impl Judges {
    /// Opens the networks that are in the models folder.
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

    /// A build without networks opens none.
    #[cfg(not(feature = "nets"))]
    pub fn open(_: Option<&Path>) -> Self {
        Self {}
    }

    /// Fails if a network is missing, with its reason.
    ///
    /// # Errors
    /// Returns the reason why the first missing network is missing.
    #[cfg(feature = "nets")]
    pub fn complete(&self) -> Result<(), String> {
        let missing = [
            self.lpips.as_ref().err(),
            self.uranker.as_ref().err(),
            self.musiq.as_ref().err(),
            self.raft.as_ref().err(),
        ];
        missing.into_iter().flatten().next().map_or(Ok(()), |reason| Err(reason.clone()))
    }

    /// A build without networks is never complete.
    ///
    /// # Errors
    /// Always fails.
    #[cfg(not(feature = "nets"))]
    pub fn complete(&self) -> Result<(), String> {
        Err(WITHOUT.into())
    }

    /// Approximate memory, in bytes per pixel, that [`alone`](Self::alone) or (with `compared`)
    /// [`against`](Self::against) needs in addition to the images. It holds without masks, and for images
    /// within display range. The memory of networks that scale a picture down to at most 1024 pixels is the
    /// same for any size, and is not included.
    pub fn bytes_per_pixel(&self, compared: bool) -> u64 {
        /// Eight bits of every channel, and of its CIELAB (UCIQE).
        const COLOURS: u64 = 6;
        match compared {
            false => COLOURS,
            true => self.lpips_bytes_per_pixel(),
        }
    }

    /// PSNR, SSIM and LPIPS of an image against a reference of the same size, over the pixels of the mask.
    /// Both are clamped to the display range.
    pub fn against(&self, image: &Image, reference: &Image, mask: Option<&Mask>) -> Scores {
        let (image, reference) = (clamped(image), clamped(reference));
        let mut scores = Scores::new();
        scores.insert("psnr".into(), Score::measured(psnr(&image, &reference, mask)));
        scores.insert("ssim".into(), Score::measured(ssim(&image, &reference, mask)));
        let lpips = match (whole(&image, mask), whole(&reference, mask)) {
            (Ok(image), Ok(reference)) => {
                let share = mask.map_or(1.0, |m| counted(m) as f64 / m.pixels().max(1) as f64);
                match self.lpips(&image, &reference) {
                    Score::Value(distance) => Score::of(distance.get() / share),
                    reason => reason,
                }
            }
            (Err(e), _) | (_, Err(e)) => Score::measured(Err(e)),
        };
        scores.insert("lpips".into(), lpips);
        scores
    }

    /// UCIQE, UIQM, URanker and MUSIQ of an image, over the pixels of the mask.
    pub fn alone(&self, image: &Image, mask: Option<&Mask>) -> Scores {
        let image = clamped(image);
        let variant = UciqeVariant::default();
        let uciqe = match mask {
            None => uciqe(&image, variant),
            Some(mask) => only_counted(&image, mask).and_then(|colours| uciqe(&colours, variant)),
        };
        let mut scores = Scores::from([("uciqe".to_string(), Score::measured(uciqe.map(|u| u.score)))]);
        let whole = whole(&image, mask);
        let of = |measure: &dyn Fn(&Image) -> Score| match &whole {
            Ok(image) => measure(image),
            Err(e) => Score::measured(Err(e.clone())),
        };
        scores.insert("uiqm".into(), of(&|image| Score::measured(uiqm(image).map(|u| u.score))));
        scores.insert("uranker".into(), of(&|image| self.uranker(image)));
        scores.insert("musiq".into(), of(&|image| self.musiq(image)));
        scores
    }

    /// Measured memory that LPIPS needs for two images (docs/science/networks.md).
    #[cfg(feature = "nets")]
    fn lpips_bytes_per_pixel(&self) -> u64 {
        if self.lpips.is_ok() { 92 } else { 0 }
    }

    #[cfg(not(feature = "nets"))]
    fn lpips_bytes_per_pixel(&self) -> u64 {
        0
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
        Ok(Ok(value)) => Score::of(value),
        Ok(Err(error)) => Score::NotAvailable(error.to_string()),
        Err(reason) => Score::NotAvailable(reason.clone()),
    }
}

/// The picture clamped to the display range; copied only if a value is outside.
fn clamped(image: &Image) -> Cow<'_, Image> {
    if image.data().iter().any(|v| *v < 0.0 || *v > 1.0) {
        Cow::Owned(image.map(|v| v.clamp(0.0, 1.0)))
    } else {
        Cow::Borrowed(image)
    }
}

/// The picture, black outside the mask.
fn whole<'a>(image: &'a Image, mask: Option<&Mask>) -> Result<Cow<'a, Image>, MetricError> {
    match mask {
        None => Ok(Cow::Borrowed(image)),
        Some(mask) => blacked_out(image, mask).map(Cow::Owned),
    }
}

/// A flow to the next view with the mask of its valid pixels, or the reason why there is none.
type Correspondence = Result<(Flow, Mask), String>;

/// The data by which a view is compared; none of it belongs to a method.
pub struct ComparedView<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Depth along the optical axis; 0 where unknown.
    pub depth: &'a Map,
    /// The raw input of this view: the photograph, or stage 1's rendering if there is none.
    pub raw: &'a Image,
    /// Mask of the pixels that count.
    pub mask: Option<&'a Mask>,
}

impl<'a> ComparedView<'a> {
    fn geometry(&self) -> GeometricView<'a> {
        GeometricView { camera: self.camera, depth: self.depth }
    }
}

/// The correspondence of pixels between one view and the next: by depth, and by optical flow of the raw
/// inputs if its network is present. All methods share it.
pub struct Pairing {
    geometry: Correspondence,
    flow: Correspondence,
}

impl Pairing {
    /// The correspondence of two views.
    pub fn new(judges: &Judges, first: &ComparedView<'_>, second: &ComparedView<'_>) -> Self {
        let geometry =
            geometric_warp(first.geometry(), second.geometry(), SAME_SURFACE).map_err(|e| e.to_string());
        let among = |found: Correspondence| {
            found.map(|(flow, mask)| {
                let mask = counting(&flow, mask, first.mask, second.mask);
                (flow, mask)
            })
        };
        Self { geometry: among(geometry), flow: among(judges.flow(first.raw, second.raw)) }
    }

    /// `wlpips`, `w_delta_e` and `w_ssim` of one method's images of the two views, with the shares of pixels
    /// that they compare: `coverage` (by depth) and `flow_coverage`. `prefix` is put before each name.
    pub fn scores(&self, judges: &Judges, first: &Image, second: &Image, prefix: &str) -> Scores {
        let (first, second) = (clamped(first), clamped(second));
        let mut scores = Scores::new();
        let mut insert = |name: &str, score: Score| scores.insert(format!("{prefix}{name}"), score);
        let share = |mask: &Mask| Score::of(counted(mask) as f64 / mask.pixels().max(1) as f64);
        match &self.geometry {
            Ok((flow, mask)) => {
                let of = |c: Result<use3d_metrics::Consistency, MetricError>| {
                    Score::measured(c.and_then(|c| c.value.ok_or(MetricError::NothingInCommon)))
                };
                insert("w_delta_e", of(warped_delta_e(&first, &second, flow, mask)));
                insert("w_ssim", of(warped_ssim(&first, &second, flow, mask)));
                insert("coverage", share(mask));
            }
            Err(reason) => {
                for name in ["w_delta_e", "w_ssim", "coverage"] {
                    insert(name, Score::NotAvailable(reason.clone()));
                }
            }
        }
        match &self.flow {
            Ok((flow, mask)) => {
                let distance = if counted(mask) == 0 {
                    Score::measured(Err(MetricError::NothingInCommon))
                } else {
                    judges.warped_lpips(&first, &second, flow, mask)
                };
                insert("wlpips", distance);
                insert("flow_coverage", share(mask));
            }
            Err(reason) => {
                insert("wlpips", Score::NotAvailable(reason.clone()));
                insert("flow_coverage", Score::NotAvailable(reason.clone()));
            }
        }
        scores
    }
}

/// Limits the correspondences to pixels that count in both views.
fn counting(flow: &Flow, mut mask: Mask, first: Option<&Mask>, second: Option<&Mask>) -> Mask {
    let (width, height) = (mask.width(), mask.height());
    if first.is_none() && second.is_none() {
        return mask;
    }
    for y in 0..height {
        for x in 0..width {
            let [dx, dy] = flow.pixel(x, y);
            let (u, v) = ((x as f32 + dx).round(), (y as f32 + dy).round());
            let there = |m: &Mask| {
                let inside = u >= 0.0 && v >= 0.0 && u < m.width() as f32 && v < m.height() as f32;
                inside && m.pixel(u as usize, v as usize)[0] != 0
            };
            let here =
                first.is_none_or(|m| (m.width(), m.height()) == (width, height) && m.pixel(x, y)[0] != 0);
            if !(here && second.is_none_or(there)) {
                mask.set_pixel(x, y, [0]);
            }
        }
    }
    mask
}

#[cfg(feature = "nets")]
impl Judges {
    fn flow(&self, a: &Image, b: &Image) -> Correspondence {
        let raft = self.raft.as_ref().map_err(Clone::clone)?;
        let forward = raft.flow(a, b).map_err(|e| e.to_string())?;
        let backward = raft.flow(b, a).map_err(|e| e.to_string())?;
        let both = use3d_metrics::forward_backward(&forward, &backward).map_err(|e| e.to_string())?;
        let mask = both.relative_mask(0.01, 0.5);
        Ok((forward, mask))
    }

    fn warped_lpips(&self, a: &Image, b: &Image, flow: &Flow, mask: &Mask) -> Score {
        let lpips = match &self.lpips {
            Ok(lpips) => lpips,
            Err(reason) => return Score::NotAvailable(reason.clone()),
        };
        let distance = use3d_metrics::warped_distance(a, b, flow, mask, |x, y| {
            lpips.distance(x, y).map_err(|e| Reason(e.to_string()))
        });
        distance.map_or_else(|e| Score::NotAvailable(e.0), Score::of)
    }
}

#[cfg(not(feature = "nets"))]
impl Judges {
    fn flow(&self, _: &Image, _: &Image) -> Correspondence {
        Err(WITHOUT.into())
    }

    fn warped_lpips(&self, _: &Image, _: &Image, _: &Flow, _: &Mask) -> Score {
        Score::NotAvailable(WITHOUT.into())
    }
}

/// The message of an error, from any crate.
#[cfg(feature = "nets")]
struct Reason(String);

#[cfg(feature = "nets")]
impl From<MetricError> for Reason {
    fn from(error: MetricError) -> Self {
        Self(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};

    fn ramp(width: usize, height: usize) -> Image {
        let mut image = Image::new(width, height);
        for y in 0..height {
            for x in 0..width {
                image.set_pixel(x, y, [0.02 * x as f32, 0.03 * y as f32, 0.4]);
            }
        }
        image
    }

    #[test]
    fn every_score_of_black_white_equal_and_masked_images_is_finite_or_says_why() {
        let judges = Judges::open(None);
        let (black, white) = (Image::new(40, 30), Image::filled(40, 30, 1.0));
        let nothing = Mask::new(40, 30);
        for image in [&black, &white, &ramp(40, 30)] {
            for mask in [None, Some(&nothing)] {
                let mut scores = judges.against(image, image, mask);
                scores.extend(judges.alone(image, mask));
                assert!(matches!(scores["psnr"], Score::Undefined(_)), "equal images: {scores:?}");
                let text = serde_json::to_string(&scores).unwrap();
                assert!(!text.contains("null"), "{text}");
                assert_eq!(serde_json::from_str::<Scores>(&text).unwrap(), scores);
                if mask.is_some() {
                    for name in ["psnr", "ssim", "lpips", "uciqe", "uiqm"] {
                        assert!(scores[name].reason().unwrap().contains("leaves no pixel"), "{name}");
                    }
                }
            }
        }
    }

    #[test]
    fn what_is_masked_changes_no_score() {
        let judges = Judges::open(None);
        let (image, reference) = (ramp(40, 30).map(|v| 0.9 * v), ramp(40, 30));
        let (mut spoilt, mut mask) = (image.clone(), Mask::filled(40, 30, 1));
        for y in 0..30 {
            for x in 0..14 {
                mask.set_pixel(x, y, [0]);
                spoilt.set_pixel(x, y, [1.0, 0.0, 1.0]);
            }
        }
        let of = |image| {
            let mut scores = judges.against(image, &reference, Some(&mask));
            scores.extend(judges.alone(image, Some(&mask)));
            scores
        };
        assert_eq!(of(&spoilt), of(&image));
        assert!(judges.against(&spoilt, &reference, None)["psnr"] != of(&image)["psnr"]);
    }

    #[test]
    fn pairs_say_what_they_share_and_nothing_in_common_is_no_perfect_score() {
        let judges = Judges::open(None);
        let intrinsics = Intrinsics { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        let at = |x: f64| {
            let mut pose = Pose::IDENTITY;
            pose.translation.x = -x;
            Camera { intrinsics, pose }
        };
        let (depth, raw) = (Map::filled(40, 30, 2.0), ramp(40, 30));
        let cameras = [at(0.0), at(0.2), at(50.0)];
        let mut left = Mask::filled(40, 30, 1);
        (0..30).for_each(|y| (0..20).for_each(|x| left.set_pixel(x, y, [0])));
        let seen = |i: usize, mask| ComparedView { camera: &cameras[i], depth: &depth, raw: &raw, mask };
        let of = |second, mask| {
            let pairing = Pairing::new(&judges, &seen(0, mask), &seen(second, None));
            pairing.scores(&judges, &raw, &raw, "path_")
        };
        let near = of(1, None);
        let share = near["path_coverage"].value().unwrap();
        assert!(share > 0.8 && share < 1.0 && near["path_w_delta_e"].value().is_some());
        assert!(of(1, Some(&left))["path_coverage"].value().unwrap() <= 0.5);
        let far = of(2, None);
        assert_eq!(far["path_coverage"], Score::of(0.0));
        assert!(matches!(&far["path_w_ssim"], Score::Undefined(why) if why.contains("nothing in common")));
    }
}
