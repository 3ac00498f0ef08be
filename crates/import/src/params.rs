//! The parameters of an import. The defaults are those of the design.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use use3d_numerics::range::OutOfRange;

/// Parameters of the import.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ImportParams {
    /// The image folder, relative to the capture. Default: `images`, `images_wb`, `Images_wb` or `input`,
    /// whichever holds most of the model's images.
    pub image_dir: Option<String>,
    /// The model's folder or file, relative to the capture. Default: the largest model of COLMAP in
    /// `sparse/0`, `sparse`, `colmap/sparse/0` or `sparse/*`, or else the file of another program.
    pub model_dir: Option<String>,
    /// The mask folder, relative to the capture. Default: `masks` if it exists. Pixels of value 0 are
    /// ignored, white ones count fully.
    pub mask_dir: Option<String>,
    /// The depth-prior folder, relative to the capture. Default: `depth`, `depths` or `depthAnythingV2_u16`
    /// if it exists.
    pub depth_dir: Option<String>,
    /// `"WxH"`: scale to cover this size and crop centrally; the intrinsics follow.
    pub size: Option<ImageSize>,
    /// Divide the image size by this whole number; 1 leaves it.
    pub downscale: usize,
    /// Scale images down so that the longer side has at most this many pixels; 0 sets no bound.
    pub max_side: usize,
    /// The choice of held-out views (R8).
    pub split: SplitParams,
    /// Rotate, centre and scale the scene (R7). `false` for captures that are already in such a frame.
    pub normalise: bool,
    /// White balance applied to the images (R27).
    pub white_balance: WhiteBalance,
    /// Hide by a mask what lies over all photographs of a camera and never moves: bars, text, a gripper, the
    /// rim of a port.
    pub hide_overlay: bool,
}

impl Default for ImportParams {
    fn default() -> Self {
        Self {
            image_dir: None,
            model_dir: None,
            mask_dir: None,
            depth_dir: None,
            size: None,
            downscale: 1,
            max_side: 0,
            split: SplitParams::default(),
            normalise: true,
            white_balance: WhiteBalance::None,
            hide_overlay: true,
        }
    }
}

/// The choice of views that are held out from training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SplitParams {
    /// Every this-many-th view, beginning with the first, is a test view; 0 holds out none.
    pub every: usize,
    /// The order in which they are counted.
    pub order: SplitOrder,
    /// Use `train_list.txt` and `test_list.txt` in the capture instead, if they exist.
    pub lists: bool,
}

impl Default for SplitParams {
    fn default() -> Self {
        Self { every: 8, order: SplitOrder::Name, lists: true }
    }
}

/// The order in which views are counted for the split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SplitOrder {
    /// By file name.
    #[default]
    Name,
    /// By the image's id in the model.
    ColmapId,
    /// Not counted: the views that the owners of a data set name. Known for the scenes of SeaThru-NeRF.
    Owners,
}

/// White balance of the whole set of images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum WhiteBalance {
    /// Images as they are.
    #[default]
    None,
    /// Each channel over its 99.8 % quantile across all images.
    SetPercentile,
}

/// A size written as `"WxH"`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct ImageSize {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
}

impl TryFrom<String> for ImageSize {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let sides = text.split_once(['x', 'X', '×']).and_then(|(w, h)| {
            let side = |s: &str| s.trim().parse::<usize>().ok().filter(|n| *n > 0);
            Some((side(w)?, side(h)?))
        });
        match sides {
            Some((width, height)) if width.saturating_mul(height) as u64 <= use3d_io_image::MAX_PIXELS => {
                Ok(Self { width, height })
            }
            Some(_) => Err(format!("the size {text:?} has more than {} pixels", use3d_io_image::MAX_PIXELS)),
            None => Err(format!("{text:?} is not a size; write it as \"1400x933\"")),
        }
    }
}

impl From<ImageSize> for String {
    fn from(size: ImageSize) -> Self {
        format!("{}x{}", size.width, size.height)
    }
}

/// No scene can be learnt from photographs whose longer side is smaller.
pub(crate) const LEAST_SIDE: usize = 16;

impl ImportParams {
    /// Checks a condition that the types cannot express: at most one way of resizing.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        if self.downscale == 0 {
            return Err(OutOfRange::new("downscale", 0, "1, which leaves the size as it is, or more"));
        }
        if (1..LEAST_SIDE).contains(&self.max_side) {
            let expected = format!("0, which leaves the size as it is, or at least {LEAST_SIDE} pixels");
            return Err(OutOfRange::new("max_side", self.max_side, expected));
        }
        if let Some(size) = self.size.filter(|size| size.width.max(size.height) < LEAST_SIDE) {
            let expected = format!("at least {LEAST_SIDE} pixels on the longer side");
            return Err(OutOfRange::new("size", String::from(size), expected));
        }
        let ways = [
            ("size", self.size.map(String::from)),
            ("max_side", (self.max_side > 0).then(|| self.max_side.to_string())),
            ("downscale", (self.downscale > 1).then(|| self.downscale.to_string())),
        ];
        let mut given = ways.iter().filter_map(|(name, way)| Some((*name, way.as_ref()?)));
        if let (Some(_), Some((path, value))) = (given.next(), given.next()) {
            let expected = "only one of `size`, `downscale` and `max_side`; leave the others out";
            return Err(OutOfRange::new(path, value, expected));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_of_a_few_pixels_are_refused() {
        let of = |max_side| ImportParams { max_side, ..ImportParams::default() }.validate();
        assert!(of(0).is_ok() && of(16).is_ok());
        assert!(of(1).unwrap_err().to_string().contains("at least 16 pixels"));
        let of = |width, height| {
            let size = Some(ImageSize { width, height });
            ImportParams { size, ..ImportParams::default() }.validate().map_err(|e| e.to_string())
        };
        assert!(of(16, 9).is_ok() && of(9, 16).is_ok());
        let expected = "`size` is 10x10; expected at least 16 pixels on the longer side";
        assert_eq!(of(10, 10), Err(expected.into()));
    }

    #[test]
    fn sizes_are_written_as_people_write_them() {
        let parsed = |text: &str| ImageSize::try_from(text.to_string());
        assert_eq!(parsed("1400x933"), Ok(ImageSize { width: 1400, height: 933 }));
        for bad in ["1400", "0x3", "x", "ax3", "-1x3", "99999999999x99999999999"] {
            assert!(parsed(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn parameters_survive_json_and_unknown_ones_are_named() {
        let params = ImportParams {
            size: Some(ImageSize { width: 4, height: 3 }),
            white_balance: WhiteBalance::SetPercentile,
            split: SplitParams { order: SplitOrder::ColmapId, ..SplitParams::default() },
            ..ImportParams::default()
        };
        let json = serde_json::to_string(&params).unwrap();
        assert!(json.contains("\"4x3\"") && json.contains("set-percentile") && json.contains("colmap-id"));
        assert_eq!(serde_json::from_str::<ImportParams>(&json).unwrap(), params);
        assert_eq!(serde_json::from_str::<ImportParams>("{}").unwrap(), ImportParams::default());
        let error = serde_json::from_str::<ImportParams>("{\"sise\": \"4x3\"}").unwrap_err().to_string();
        assert!(error.contains("sise"), "{error}");
        assert!(ImportParams { downscale: 2, ..params }.validate().is_err());
        assert!(ImportParams { downscale: 0, ..ImportParams::default() }.validate().is_err());
    }
}
