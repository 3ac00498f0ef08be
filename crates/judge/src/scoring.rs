//! Scores of images: formulas always, networks if their weights are present; a missing network gives its
//! reason.
//!
//! With a mask, only the pixels inside it count ([`use3d_metrics::Mask`]): PSNR and UCIQE use these pixels,
//! SSIM the windows that contain no others, and edge widths the edges around which all pixels are inside.
//! UIQM, URanker and MUSIQ judge whole pictures; the pixels outside the mask are black, in the pictures of
//! all methods alike. LPIPS gets the same pictures and is divided by the share of pixels inside the mask,
//! because its mean runs over all pixels.

use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

use use3d_capture::{Camera, Image, Map};
use use3d_metrics::{
    EdgeWidth, Flow, GeometricView, Mask, MetricError, StepEdges, blacked_out, counted, geometric_warp,
    only_counted, psnr, share, ssim, uciqe, uiqm, warped_delta_e, warped_ssim,
};
use use3d_nets::{Models, NetError, limit_long_side};

use crate::flow::{self, Correspondence};
use crate::scores::{Score, Scores};

/// Relative difference of depths that counts as the same surface when warping by geometry.
const SAME_SURFACE: f64 = 0.02;
/// Inputs of the quality networks are scaled down to this long side if theirs is longer, as in the paper.
const LONGEST_SIDE: usize = 1024;

/// A network that measures the distance of two pictures.
type Distance = dyn Fn(&Image, &Image) -> Result<f64, NetError>;
/// A network that judges the quality of a picture.
type Quality = dyn Fn(&Image) -> Result<f64, NetError>;
/// A network that finds the flow from one picture to the next.
type Motion = dyn Fn(&Image, &Image) -> Result<Flow, NetError>;

/// The reason why a network gives no score.
#[derive(Clone, Debug, thiserror::Error)]
pub enum ScoreError {
    /// There is no models folder to open the network from.
    #[error("not available: no models folder; name one with --models or USE3D_MODELS")]
    NoModels,
    /// The network cannot be opened, or not be applied.
    #[error(transparent)]
    Network(Arc<NetError>),
    /// The pictures cannot be compared.
    #[error(transparent)]
    Picture(#[from] MetricError),
}

impl From<NetError> for ScoreError {
    fn from(error: NetError) -> Self {
        Self::Network(Arc::new(error))
    }
}

/// The quality networks, each opened once, or the reason why it is missing.
pub struct Judges {
    lpips: Result<Box<Distance>, ScoreError>,
    uranker: Result<Box<Quality>, ScoreError>,
    musiq: Result<Box<Quality>, ScoreError>,
    raft: Result<Box<Motion>, ScoreError>,
}

impl Judges {
    /// Opens the networks that are in the models folder.
    pub fn open(models: Option<&Path>) -> Self {
        let models = models.map(Models::open).ok_or(ScoreError::NoModels);
        let models = models.as_ref().map_err(ScoreError::clone);
        let small = |image: &Image| limit_long_side(image, LONGEST_SIDE);
        Self {
            lpips: models.clone().and_then(|models| {
                let net = models.lpips()?;
                Ok(Box::new(move |a: &Image, b: &Image| net.distance(a, b)) as Box<Distance>)
            }),
            uranker: models.clone().and_then(|models| {
                let net = models.uranker()?;
                Ok(Box::new(move |image: &Image| net.score(&small(image))) as Box<Quality>)
            }),
            musiq: models.clone().and_then(|models| {
                let net = models.musiq()?;
                Ok(Box::new(move |image: &Image| net.score(&small(image))) as Box<Quality>)
            }),
            raft: models.and_then(|models| {
                let net = models.raft()?;
                Ok(Box::new(move |a: &Image, b: &Image| net.flow(a, b)) as Box<Motion>)
            }),
        }
    }

    /// Fails if a network is missing, with its reason.
    ///
    /// # Errors
    /// Returns the reason why the first missing network is missing.
    pub fn complete(&self) -> Result<(), ScoreError> {
        let missing = [
            self.lpips.as_ref().err(),
            self.uranker.as_ref().err(),
            self.musiq.as_ref().err(),
            self.raft.as_ref().err(),
        ];
        missing.into_iter().flatten().next().map_or(Ok(()), |reason| Err(reason.clone()))
    }

    /// Approximate memory, in bytes per pixel, that [`alone`](Self::alone) or (with `compared`)
    /// [`against`](Self::against) needs in addition to the images. It holds without masks, and for images
    /// within display range. The memory of networks that scale a picture down to at most 1024 pixels is the
    /// same for any size, and is not included.
    pub fn bytes_per_pixel(&self, compared: bool) -> u64 {
        /// Eight bits of every channel, and of its CIELAB (UCIQE).
        const COLOURS: u64 = 6;
        /// Measured memory that LPIPS needs for two images (docs/science/networks.md).
        const LPIPS: u64 = 92;
        match compared {
            false => COLOURS,
            true if self.lpips.is_ok() => LPIPS,
            true => 0,
        }
    }

    /// PSNR, SSIM and LPIPS of an image against a reference of the same size, over the pixels of the mask.
    /// Both are clamped to the display range.
    pub fn against(&self, image: &Image, reference: &Image, mask: Option<&Mask>) -> Scores {
        let (image, reference) = (clamped(image), clamped(reference));
        let lpips = match (whole(&image, mask), whole(&reference, mask)) {
            (Ok(image), Ok(reference)) => {
                let share = share(mask);
                match measured(&self.lpips, |net| net(&image, &reference)) {
                    Score::Value(distance) => Score::of(distance.get() / share),
                    reason => reason,
                }
            }
            (Err(e), _) | (_, Err(e)) => Score::measured(Err(e)),
        };
        let psnr = Score::measured(psnr(&image, &reference, mask));
        let ssim = Score::measured(ssim(&image, &reference, mask));
        Scores::from([("psnr".into(), psnr), ("ssim".into(), ssim), ("lpips".into(), lpips)])
    }

    /// UCIQE, UIQM, URanker and MUSIQ of an image, over the pixels of the mask.
    pub fn alone(&self, image: &Image, mask: Option<&Mask>) -> Scores {
        let image = clamped(image);
        let uciqe = match mask {
            None => uciqe(&image),
            Some(mask) => only_counted(&image, mask).and_then(|colours| uciqe(&colours)),
        };
        let uciqe = Score::measured(uciqe.map(|u| u.score));
        let whole = whole(&image, mask);
        let of = |measure: &dyn Fn(&Image) -> Score| match &whole {
            Ok(image) => measure(image),
            Err(e) => Score::measured(Err(e.clone())),
        };
        let uiqm = of(&|image| Score::measured(uiqm(image).map(|u| u.score)));
        let uranker = of(&|image| measured(&self.uranker, |net| net(image)));
        let musiq = of(&|image| measured(&self.musiq, |net| net(image)));
        let scores = [("uciqe", uciqe), ("uiqm", uiqm), ("uranker", uranker), ("musiq", musiq)];
        scores.map(|(name, score)| (name.to_string(), score)).into()
    }
}

/// `edge_width` and `lost_edges` of an image, by the step edges of the photograph of its view.
pub fn edge_scores(edges: &Result<StepEdges, MetricError>, image: &Image) -> Scores {
    let found = edges.as_ref().map_err(MetricError::clone).and_then(|edges| edges.in_render(&clamped(image)));
    let of =
        |value: fn(&EdgeWidth) -> f64| Score::measured(found.as_ref().map(value).map_err(MetricError::clone));
    [("edge_width", of(|found| found.ratio)), ("lost_edges", of(|found| found.lost))]
        .map(|(name, score)| (name.to_string(), score))
        .into()
}

/// The score that a network gives, or the reason why there is none.
fn measured<N: ?Sized, E: Into<ScoreError>>(
    net: &Result<Box<N>, ScoreError>,
    score: impl FnOnce(&N) -> Result<f64, E>,
) -> Score {
    match net.as_deref().map_err(ScoreError::clone).and_then(|net| score(net).map_err(E::into)) {
        Ok(value) => Score::of(value),
        Err(reason) => Score::NotAvailable(reason.to_string()),
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

/// The data by which a view is compared; none of it belongs to a method.
pub struct ComparedView<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Depth along the optical axis; 0 where unknown.
    pub depth: &'a Map,
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
    /// The correspondence of two views by depth and by their [`Judges::flow`].
    pub fn new(flow: Correspondence, first: &ComparedView<'_>, second: &ComparedView<'_>) -> Self {
        let geometry = geometric_warp(first.geometry(), second.geometry(), SAME_SURFACE);
        let geometry = geometry.map_err(ScoreError::from).map(|(flow, mask)| {
            let mask = counting(&flow, mask, first.mask, second.mask);
            (flow, mask)
        });
        Self { geometry, flow }
    }

    /// `wlpips`, `w_delta_e` and `w_ssim` of one method's images of the two views, with the shares of pixels
    /// that they compare: `coverage` (by depth) and `flow_coverage`. `prefix` is put before each name.
    /// `known` are the scores along the flow, if they are known already.
    pub fn scores(
        &self,
        judges: &Judges,
        [first, second]: [&Image; 2],
        prefix: &str,
        known: Option<Scores>,
    ) -> Scores {
        let (first, second) = (clamped(first), clamped(second));
        let mut scores = known.unwrap_or_else(|| judges.along(&self.flow, [&first, &second], prefix));
        let mut insert = |name: &str, score: Score| scores.insert(format!("{prefix}{name}"), score);
        match &self.geometry {
            Ok((flow, mask)) => {
                let of = |c: Result<use3d_metrics::Consistency, MetricError>| {
                    Score::measured(c.and_then(|c| c.value.ok_or(MetricError::NothingInCommon)))
                };
                insert("w_delta_e", of(warped_delta_e(&first, &second, flow, mask)));
                insert("w_ssim", of(warped_ssim(&first, &second, flow, mask)));
                insert("coverage", Score::of(share(Some(mask))));
            }
            Err(reason) => {
                for name in ["w_delta_e", "w_ssim", "coverage"] {
                    insert(name, Score::NotAvailable(reason.to_string()));
                }
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

impl Judges {
    /// The flow from one view to the next in both directions, as it is stored. It counts where the two agree,
    /// and inside the masks of the views.
    pub fn flow(&self, raw: [&Image; 2], masks: [Option<&Mask>; 2]) -> Correspondence {
        let raft = self.raft.as_ref().map_err(Clone::clone)?;
        let [a, b] = raw;
        let (forward, backward) = (raft(a, b)?, raft(b, a)?);
        let mask = use3d_metrics::forward_backward(&forward, &backward)?.relative_mask(0.01, 0.5);
        let mask = counting(&forward, mask, masks[0], masks[1]);
        Ok(flow::stored(&forward, &mask))
    }

    /// `wlpips` and `flow_coverage` of one method's images of two views, along their flow.
    pub fn along(&self, flow: &Correspondence, [first, second]: [&Image; 2], prefix: &str) -> Scores {
        let [distance, covered] = match flow {
            Ok((flow, mask)) => {
                let distance = match counted(mask) {
                    0 => Score::measured(Err(MetricError::NothingInCommon)),
                    _ => self.warped_lpips(&clamped(first), &clamped(second), flow, mask),
                };
                [distance, Score::of(share(Some(mask)))]
            }
            Err(reason) => [(); 2].map(|()| Score::NotAvailable(reason.to_string())),
        };
        [("wlpips", distance), ("flow_coverage", covered)].map(|(n, s)| (format!("{prefix}{n}"), s)).into()
    }

    fn warped_lpips(&self, a: &Image, b: &Image, flow: &Flow, mask: &Mask) -> Score {
        measured(&self.lpips, |lpips| {
            let between = |x: &_, y: &_| lpips(x, y).map_err(ScoreError::from);
            use3d_metrics::warped_distance(a, b, flow, mask, between)
        })
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
        let seen = |i: usize, mask| ComparedView { camera: &cameras[i], depth: &depth, mask };
        let of = |second, mask| {
            let pairing =
                Pairing::new(judges.flow([&raw; 2], [mask, None]), &seen(0, mask), &seen(second, None));
            pairing.scores(&judges, [&raw; 2], "path_", None)
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
