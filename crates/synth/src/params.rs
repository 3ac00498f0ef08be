//! The parameters of a synthetic capture.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::range::{OutOfRange, within};

use crate::error::check;
use crate::lens::Optics;
use crate::physics::{Development, Physics};
use crate::scene::Location;
use crate::water::WaterType;

/// The scene to photograph, and the properties of the camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureParams {
    /// The seed of all random numbers.
    pub seed: u64,
    /// Number of photographs, at least 2.
    pub views: usize,
    /// Image width, pixels, 16 to 8192.
    pub width: usize,
    /// Image height, pixels, 16 to 8192.
    pub height: usize,
    /// Jerlov's water type.
    pub water: WaterType,
    /// Depth below the surface, metres, 0 to 60: sets the colour of the daylight.
    pub depth: f32,
    /// Share of the colour cast that the camera removes, 0 to 1: the cast of the daylight (display), or of
    /// the picture's mean (spectral).
    pub white_balance: f32,
    /// Sensor noise of a middle tone, standard deviation in display range, 0 to 0.2.
    pub noise: f32,
    /// Strength of the moving light pattern on the ground, 0 (off) to 1. It violates the assumption that the
    /// scene does not change.
    pub caustics: f32,
    /// Approximate number of sparse points.
    pub points: usize,
    /// Write depth priors.
    pub depth_priors: bool,
    /// Triangle density of the scene, 0.1 to 1: a lower density is built faster.
    pub detail: f32,
    /// The place of the photographs.
    #[serde(skip_serializing_if = "is_default")]
    pub place: Location,
    /// The image formation.
    #[serde(skip_serializing_if = "is_default")]
    pub physics: Physics,
    /// No water: the scene in air. Spectral physics only.
    #[serde(skip_serializing_if = "is_default")]
    pub air: bool,
    /// Light of two lamps at the camera on a white surface one metre ahead, in units of daylight at the
    /// surface, 0 (off) to 20. Spectral physics only.
    #[serde(skip_serializing_if = "is_default")]
    pub lamps: f32,
    /// Degree to which exposure and white balance are set for each view separately, 0 (one setting for all)
    /// to 1. Spectral physics only.
    #[serde(skip_serializing_if = "is_default")]
    pub auto_exposure: f32,
    /// Particles in front of the lens, 0 (none) to 1. Spectral physics only.
    #[serde(skip_serializing_if = "is_default")]
    pub snow: f32,
    /// The camera's development of its sensor's light. Spectral physics only, unless `plain`.
    #[serde(skip_serializing_if = "is_default")]
    pub camera: Development,
    /// Strength of the sky's light behind the scene, 0 (none) to 1: a bright sky and its glare. Spectral
    /// physics only; only a scene in air has a sky.
    #[serde(skip_serializing_if = "is_default")]
    pub backlight: f32,
    /// Boards of grey patches near and far. Not in a pool.
    #[serde(skip_serializing_if = "is_default")]
    pub greys: bool,
    /// The lens: distorting ones bend photographs, truth and model alike.
    #[serde(skip_serializing_if = "is_default")]
    pub lens: Optics,
    /// Number of fish in every view, at different places in each, hidden by masks; at most 50. Spectral
    /// physics only.
    #[serde(skip_serializing_if = "is_default")]
    pub fish: usize,
}

/// True if a value is its type's default: such fields are not written, so that files keep their bytes when a
/// field is added.
pub(crate) fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Default for CaptureParams {
    fn default() -> Self {
        Self {
            seed: 42,
            views: 48,
            width: 640,
            height: 360,
            water: WaterType::Iii,
            depth: 8.0,
            white_balance: 0.8,
            noise: 0.008,
            caustics: 0.0,
            points: 8000,
            depth_priors: true,
            detail: 1.0,
            place: Location::Reef,
            physics: Physics::Display,
            air: false,
            lamps: 0.0,
            auto_exposure: 0.0,
            snow: 0.0,
            fish: 0,
            camera: Development::Plain,
            backlight: 0.0,
            greys: false,
            lens: Optics::Pinhole,
        }
    }
}

impl CaptureParams {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        within("views", self.views, 2, 10_000)?;
        for (field, side) in [("width", self.width), ("height", self.height)] {
            check(field, side, (16..=8192).contains(&side), "16 to 8192 pixels")?;
        }
        check("depth", self.depth, (0.0..=60.0).contains(&self.depth), "0 to 60 metres")?;
        within("white_balance", self.white_balance, 0.0, 1.0)?;
        within("noise", self.noise, 0.0, 0.2)?;
        within("caustics", self.caustics, 0.0, 1.0)?;
        check("points", self.points, self.points <= 2_000_000, "at most 2000000")?;
        within("detail", self.detail, 0.1, 1.0)?;
        within("lamps", self.lamps, 0.0, 20.0)?;
        within("auto_exposure", self.auto_exposure, 0.0, 1.0)?;
        within("snow", self.snow, 0.0, 1.0)?;
        check("fish", self.fish, self.fish <= 50, "at most 50")?;
        within("backlight", self.backlight, 0.0, 1.0)?;
        let reef = "its default in a pool, because boards of greys stand only in the reef";
        check("greys", self.greys, !self.greys || self.place == Location::Reef, reef)?;
        if self.physics == Physics::Display {
            let only = "its default, because it works only with physics = \"spectral\"";
            check("air", self.air, !self.air, only)?;
            check("lamps", self.lamps, self.lamps == 0.0, only)?;
            check("auto_exposure", self.auto_exposure, self.auto_exposure == 0.0, only)?;
            check("snow", self.snow, self.snow == 0.0, only)?;
            check("fish", self.fish, self.fish == 0, only)?;
            check("camera", self.camera.name(), self.camera == Development::Plain, only)?;
            check("backlight", self.backlight, self.backlight == 0.0, only)?;
        }
        Ok(())
    }
}
