//! The white balance of a scene: the definition of grey by a person or a rule, and the gains that make it
//! grey.
//!
//! A picture of a look is multiplied, display value by display value, with one gain per channel:
//!
//! ```text
//! c' = g ⊙ c        g = (e^{−u_R}, 1, e^{−u_B})        u = (ln R/G, ln B/G)
//! ```
//!
//! `u` is the colour cast of what should be grey, in display values; green keeps its gain 1. A gain commutes
//! with the sum over Gaussians and with the clamp at 0, so a picture, the colours of an exported file and a
//! page agree exactly.
//!
//! Three looks have gains of their own, since each shows another colour of the same place: `clear` and
//! `enhanced-clear`, the object colours without water, and `enhanced`, where the whole picture is balanced,
//! including the water. `reconstruction` stays as it was photographed.
//!
//! The gains are stored next to the scene folder as `FOLDER.white.json`, so that the content of a scene
//! folder stays as its manifest lists it. Limit: a gain is exact only for the distance at which it was
//! measured. If some water is left, nearer and farther objects keep a cast.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_numerics::math;

use crate::{SceneError, files};

const FORMAT: &str = "3d-use white";
const VERSION: u32 = 1;
/// Largest size of such a file, bytes; far more than any needs.
const MOST_BYTES: u64 = 1 << 20;
/// Largest size of a scene's manifest, bytes; far more than any has.
const MOST_MANIFEST: u64 = 1 << 24;
/// Largest number of clicked places; far more than a person clicks.
const MOST_CLICKS: usize = 1000;
/// The range of valid gains. A gain outside it means that something coloured was taken for grey.
pub const GAINS: [f32; 2] = [0.2, 5.0];

/// The method by which a scene was balanced.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Places that a person marked as grey.
    Patch,
    /// The typical mean colour of reefs, applied at half strength.
    Reef,
    /// The mean of all clear surfaces is assumed to be grey.
    Grey,
}

impl Method {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Patch => "patch",
            Self::Reef => "reef",
            Self::Grey => "grey",
        }
    }
}

/// A place that a person marked as grey.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Click {
    /// The photograph's name.
    pub view: String,
    /// The pixel's coordinate from the left.
    pub x: f64,
    /// The pixel's coordinate from the top.
    pub y: f64,
    /// Distance of the place from this camera, units of the COLMAP model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
}

/// One gain per channel, red, green, blue, for each look that has one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub struct Gains {
    /// Gains of `clear`.
    pub clear: [f32; 3],
    /// Gains of `enhanced`.
    pub enhanced: [f32; 3],
    /// Gains of `enhanced-clear`.
    pub enhanced_clear: [f32; 3],
}

impl Gains {
    /// Gains that change nothing.
    pub const ONE: Self = Self { clear: [1.0; 3], enhanced: [1.0; 3], enhanced_clear: [1.0; 3] };

    /// The gains that remove one cast for each look: `clear`, `enhanced`, `enhanced-clear`.
    pub fn of_casts([clear, enhanced, enhanced_clear]: [[f64; 2]; 3]) -> Self {
        Self { clear: gains(clear), enhanced: gains(enhanced), enhanced_clear: gains(enhanced_clear) }
    }
}

/// The cast `u = (ln R/G, ln B/G)` of a colour; `None` if a channel is not positive.
pub fn cast([r, g, b]: [f64; 3]) -> Option<[f64; 2]> {
    let positive = [r, g, b].iter().all(|v| v.is_finite() && *v > 0.0);
    positive.then(|| [math::ln(r / g), math::ln(b / g)])
}

/// The gains that remove a cast: `(e^{−u_R}, 1, e^{−u_B})`.
pub fn gains([r, b]: [f64; 2]) -> [f32; 3] {
    [math::exp(-r) as f32, 1.0, math::exp(-b) as f32]
}

/// The white balance of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct White {
    format: String,
    version: u32,
    /// The method by which it was found.
    pub method: Method,
    /// The key of the scene that it was measured in, if the scene has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    scene: Option<String>,
    /// The places that a person marked, if any.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clicks: Vec<Click>,
    /// The factors of the colours.
    pub gains: Gains,
}

impl White {
    /// Makes it from a method, the places taken for grey, and the gains.
    pub fn new(method: Method, clicks: Vec<Click>, gains: Gains) -> Self {
        Self { format: FORMAT.into(), version: VERSION, method, scene: None, clicks, gains }
    }

    /// The same, bound to the scene in a folder.
    #[must_use]
    pub fn of_scene(self, folder: &Path) -> Self {
        Self { scene: key_of(folder), ..self }
    }

    /// True if it was measured in another scene than the one that is now in the folder.
    pub fn is_outdated(&self, folder: &Path) -> bool {
        self.scene.is_some() && self.scene != key_of(folder)
    }

    /// The path of the file with the white balance of a scene folder, next to the folder.
    pub fn place(scene: &Path) -> PathBuf {
        let scene = std::path::absolute(scene).unwrap_or_else(|_| scene.to_path_buf());
        let mut name = scene.file_name().unwrap_or_default().to_os_string();
        name.push(".white.json");
        scene.with_file_name(name)
    }

    /// Reads the white balance of a scene folder; `None` if none is stored.
    ///
    /// # Errors
    /// Fails if the file has another format.
    pub fn beside(scene: &Path) -> Result<Option<Self>, SceneError> {
        let place = Self::place(scene);
        place.is_file().then(|| Self::read(&place)).transpose()
    }

    /// Reads a file with a white balance.
    ///
    /// # Errors
    /// Fails if the file cannot be read or has another format; the error names the field and the expected
    /// value.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let bytes = files::read_bounded(path, MOST_BYTES)?;
        let wrong = files::at::<String>(path);
        let white: Self = serde_json::from_slice(&bytes)
            .map_err(|e| wrong(format!("{e}; expected a white balance, as `use3d white` writes it")))?;
        white.check(path)?;
        Ok(white)
    }

    /// Checks every number; `path` is that of the file, for messages.
    fn check(&self, path: &Path) -> Result<(), SceneError> {
        let wrong = |what: String| Err(files::at(path)(what));
        if self.format != FORMAT {
            let format = use3d_capture::shown(&self.format);
            return wrong(format!("format is `{format}`; expected `{FORMAT}`"));
        }
        if self.version != VERSION {
            return wrong(format!("version is {}; this program reads version {VERSION}", self.version));
        }
        let ([least, most], Gains { clear, enhanced, enhanced_clear }) = (GAINS, self.gains);
        let all = [clear, enhanced, enhanced_clear];
        if let Some(gain) = all.as_flattened().iter().find(|g| !(least..=most).contains(*g)) {
            return wrong(format!("a gain is {gain}; expected {least} to {most}"));
        }
        if self.clicks.len() > MOST_CLICKS {
            return wrong(format!("clicks has {} places; at most {MOST_CLICKS} are read", self.clicks.len()));
        }
        let odd = |click: &&Click| {
            let numbers = [Some(click.x), Some(click.y), click.distance];
            numbers.into_iter().flatten().any(|v| !v.is_finite())
        };
        match self.clicks.iter().find(odd) {
            Some(click) => wrong(format!("a click on `{}` has a number that is not finite", click.view)),
            None => Ok(()),
        }
    }

    /// Writes it to a file, completely or not at all.
    ///
    /// # Errors
    /// Fails for gains out of their range, or if the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), SceneError> {
        self.check(path)?;
        files::write_json(path, self)
    }
}

/// The key of the artifact from which a scene folder was copied.
fn key_of(folder: &Path) -> Option<String> {
    let bytes = files::read_bounded(&folder.join("manifest.json"), MOST_MANIFEST).ok()?;
    let manifest: serde_json::Value = serde_json::from_slice(&bytes).ok()?;
    Some(manifest.get("key")?.as_str()?.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gains_of_a_colour_make_it_grey_and_keep_its_green() {
        for color in [[0.2, 0.5, 0.4], [0.9, 0.3, 0.31], [0.05, 0.05, 0.05]] {
            let g = gains(cast(color).unwrap());
            let balanced: Vec<f64> = (0..3).map(|c| f64::from(g[c]) * color[c]).collect();
            assert!(balanced.iter().all(|v| (v - color[1]).abs() < 1e-6), "{color:?} becomes {balanced:?}");
        }
        assert_eq!(gains([0.0, 0.0]), [1.0; 3]);
        assert_eq!(cast([0.0, 0.5, 0.5]), None);
        assert_eq!(cast([0.1, f64::NAN, 0.5]), None);
    }

    #[test]
    fn what_is_written_is_read_and_a_damaged_file_is_refused_by_its_field() {
        let dir = tempfile::tempdir().unwrap();
        let scene = dir.path().join("enhanced-scene");
        std::fs::create_dir(&scene).unwrap();
        assert_eq!(White::beside(&scene).unwrap(), None);
        let click = Click { view: "f_0001.jpg".into(), x: 812.0, y: 430.0, distance: Some(2.5) };
        let gains = Gains::of_casts([[0.1, -0.2], [0.0, 0.3], [-0.4, 0.0]]);
        let white = White::new(Method::Patch, vec![click], gains);
        let place = White::place(&scene);
        assert_eq!(place, dir.path().join("enhanced-scene.white.json"));
        white.write(&place).unwrap();
        assert_eq!(White::beside(&scene).unwrap().as_ref(), Some(&white));
        let text = std::fs::read_to_string(&place).unwrap();
        for (from, to, said) in [
            (FORMAT, "3d-use views", "format"),
            ("\"version\": 1", "\"version\": 9", "version is 9"),
            ("\"enhanced-clear\": [\n", "\"enhanced-clear\": [9,\n", "expected a white balance"),
            ("1.0", "40.0", "a gain is 40"),
            ("patch", "guess", "guess"),
        ] {
            assert!(text.contains(from), "{from} in {text}");
            std::fs::write(&place, text.replacen(from, to, 1)).unwrap();
            let error = White::beside(&scene).unwrap_err().to_string();
            assert!(error.contains(said) && error.contains("white.json"), "{from}: {error}");
        }
        // The key in the manifest shows if the folder now contains another scene.
        let manifest = scene.join("manifest.json");
        std::fs::write(&manifest, r#"{ "key": "abc" }"#).unwrap();
        let of = white.clone().of_scene(&scene);
        assert!(!of.is_outdated(&scene) && !white.is_outdated(&scene));
        std::fs::write(&manifest, r#"{ "key": "abd" }"#).unwrap();
        assert!(of.is_outdated(&scene) && !white.is_outdated(&scene));
        let burnt = Gains { clear: [9.0, 1.0, 1.0], ..Gains::ONE };
        assert!(White::new(Method::Grey, Vec::new(), burnt).write(&place).is_err());
    }
}
