//! The choices of a preparation.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::PrepareError;
use crate::origin::SetScene;

/// The pairs of images that are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Matching {
    /// Exhaustive for up to [`FEW`](Matching::FEW) photographs, sequential for films and for more.
    #[default]
    Auto,
    /// Each image with its neighbours in the order of names.
    Sequential,
    /// Every image with every other one.
    Exhaustive,
}

impl Matching {
    /// The largest number of photographs that are all compared with each other.
    pub const FEW: usize = 120;

    /// The pairing for this many images.
    pub(crate) fn settle(self, images: usize, films: bool) -> Self {
        match self {
            Self::Auto if !films && images <= Self::FEW => Self::Exhaustive,
            Self::Auto => Self::Sequential,
            chosen => chosen,
        }
    }
}

/// The way from matches to cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Mapper {
    /// Image after image. It is slower and needs little overlap.
    #[default]
    Incremental,
    /// All images together, in newer versions of COLMAP. It is faster for many images.
    Global,
}

/// The kind of keypoints by which images are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Keypoints {
    /// Those of SIFT. If too few images have a place then, learned ones as well, and the better model.
    #[default]
    Auto,
    /// Those of SIFT, which COLMAP finds itself.
    Sift,
    /// Those of ALIKED, matched by LightGlue: networks in a Python package.
    Learned,
}

/// The choices of a preparation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PrepareParams {
    /// The most frames that are taken out of the films.
    pub frames: usize,
    /// The share of the picture that neighbouring frames of a film have in common, 0.5 to 0.99; `None` for
    /// 0.8, and more in short films.
    pub overlap: Option<f64>,
    /// COLMAP's name of the lens model.
    pub lens: String,
    /// Known parameters of the lens, in COLMAP's order for `lens`; they are then not refined.
    pub calibration: Vec<f64>,
    /// The most features of an image; `None` for 3,000 on the processor and 8,192 on a graphics card, and for
    /// 1,024 and 2,048 learned ones.
    pub features: Option<usize>,
    /// The pairs of images that are compared.
    pub matching: Matching,
    /// The way from matches to cameras.
    pub mapper: Mapper,
    /// The kind of keypoints.
    pub keypoints: Keypoints,
    /// One thread for features, matching and mapping, and pycolmap, so that two runs give the same bytes.
    pub repeatable: bool,
    /// The scene of a data set that the input is, such as `druva/A3`, for its form: an archive, linear
    /// photographs, or a film. A pipeline's `download` sets it.
    #[schemars(with = "Option<String>")]
    pub origin: Option<SetScene>,
}

impl Default for PrepareParams {
    fn default() -> Self {
        Self {
            frames: 200,
            overlap: None,
            lens: LENS.into(),
            calibration: Vec::new(),
            features: None,
            matching: Matching::Auto,
            mapper: Mapper::Incremental,
            keypoints: Keypoints::Auto,
            repeatable: false,
            origin: None,
        }
    }
}

/// The usual lens model: one focal length and two radial terms. A lens with more freedom, such as OPENCV,
/// fits small pictures and plain scenes with cameras that are wrong.
pub(crate) const LENS: &str = "RADIAL";

/// Changes when linear photographs are balanced in another way.
pub(crate) const BALANCE_RULES: u32 = 1;

/// The fewest images that a model can be made from.
pub(crate) const FEWEST: usize = 3;

impl PrepareParams {
    /// The choices as a part of a key. Captures of earlier versions keep their keys: those did not have every
    /// choice.
    pub(crate) fn for_key(&self) -> Value {
        let mut choices = serde_json::to_value(self).unwrap_or_default();
        let usual = [("overlap", self.overlap.is_none()), ("keypoints", self.keypoints == Keypoints::Auto)];
        if let Some(fields) = choices.as_object_mut() {
            fields.remove("origin");
            usual.iter().filter(|(_, usual)| *usual).for_each(|(name, _)| drop(fields.remove(*name)));
        }
        choices
    }

    /// Refuses choices that cannot be carried out.
    ///
    /// # Errors
    /// The first of them, by its flag.
    pub fn validate(&self) -> Result<(), PrepareError> {
        let bad = |flag: &'static str, reason: String| Err(PrepareError::Choice { flag, reason });
        if self.frames < FEWEST {
            return bad("--frames", format!("{} is too few; expected {FEWEST} or more", self.frames));
        }
        if let Some(share) = self.overlap.filter(|share| !(0.5..=0.99).contains(share)) {
            return bad("--overlap", format!("{share} is out of range; expected 0.5 to 0.99"));
        }
        if let Some(n) = self.features.filter(|n| !(100..=100_000).contains(n)) {
            return bad("--features", format!("{n} is out of range; expected 100 to 100000"));
        }
        let Some(model) = use3d_io_colmap::LensModel::from_name(&self.lens) else {
            let reason = format!(
                "{} is no lens model of COLMAP; take RADIAL, OPENCV, or OPENCV_FISHEYE for a fisheye",
                self.lens
            );
            return bad("--lens", reason);
        };
        let (given, needed) = (self.calibration.len(), model.parameter_count());
        if given != 0 && given != needed {
            let reason =
                format!("{} has {needed} parameters in COLMAP's order, and {given} were given", self.lens);
            return bad("--calibration", reason);
        }
        if given != 0 && self.mapper == Mapper::Global {
            let reason = "the global mapper does not keep a known lens; leave out `--mapper global`, or the calibration";
            return bad("--calibration", reason.into());
        }
        if let Some(v) = self.calibration.iter().find(|v| !v.is_finite()) {
            return bad("--calibration", format!("{v} is not usable; expected finite numbers"));
        }
        let focal = model.lens(&self.calibration).map(|lens| lens.focal);
        if let Some(f) = focal.iter().flatten().find(|f| **f <= 0.0) {
            let reason = format!("the focal length {f} is out of range; expected pixels above 0");
            return bad("--calibration", reason);
        }
        Ok(())
    }
}
