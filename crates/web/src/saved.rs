//! Named views that the page saves: positions with their looks, the up direction, and the length of a unit.
//! If they are put back into a page, every visitor has them.

use serde::{Deserialize, Serialize};

use use3d_numerics::range::{check, positive, within};

use crate::shot::{Shot, ShotError};

const FORMAT: &str = "3d-use views";
/// Largest number of views: more than a person picks from a list.
const MOST: usize = 1000;

/// The data that a page saves in addition to its scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedViews {
    format: String,
    version: u32,
    /// The up direction, in the COLMAP frame; none if the ground was not levelled.
    #[serde(default)]
    pub up: Option<[f64; 3]>,
    /// Metres per unit of the COLMAP model, if a length was given.
    #[serde(default)]
    pub metres_per_unit: Option<f64>,
    /// The views, in their order.
    pub views: Vec<SavedView>,
}

/// A named view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedView {
    /// Its name.
    pub name: String,
    /// The pose and the look.
    #[serde(flatten)]
    pub shot: Shot,
    /// The look on the left of the divider, if two are compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compare: Option<String>,
    /// The position of the divider, as a share of the width.
    #[serde(default = "half")]
    pub at: f64,
}

fn half() -> f64 {
    0.5
}

impl SavedView {
    fn check(&self) -> Result<(), ShotError> {
        if self.name.trim().is_empty() {
            return Err(ShotError::NoName);
        }
        within("at", self.at, 0.0, 1.0)?;
        self.shot.check()
    }
}

impl SavedViews {
    /// Reads the text of a file of views.
    ///
    /// # Errors
    /// Fails at the first fault in the file, and names the view that has it.
    pub fn read(text: &str) -> Result<Self, ShotError> {
        let saved: Self =
            serde_json::from_str(text).map_err(|e| ShotError::Form("it is not a file of views", e))?;
        if saved.format != FORMAT {
            return Err(ShotError::Format(FORMAT));
        }
        if saved.version != 1 {
            return Err(ShotError::Version(saved.version));
        }
        if let Some(up) = saved.up {
            let length = up.iter().map(|v| v * v).sum::<f64>();
            check(length.is_finite() && length > 0.0, "up", format!("{up:?}"), "a direction")?;
        }
        saved.metres_per_unit.map_or(Ok(()), |metres| positive("metres_per_unit", metres))?;
        if saved.views.len() > MOST {
            return Err(ShotError::TooMany(saved.views.len(), MOST));
        }
        for (i, view) in saved.views.iter().enumerate() {
            let place = || format!("view {} (`{}`)", i + 1, view.name);
            view.check().map_err(|fault| ShotError::At(place(), Box::new(fault)))?;
        }
        Ok(saved)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn text() -> String {
        let view = json!({
            "name": "the arch", "center": [1.0, 2.0, 3.0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "vertical_fov_degrees": 50.0,
            "focus": 2.0, "mode": "clear", "strength": 0.5, "water": 1.0, "compare": "reconstruction", "at": 0.25,
        });
        json!({ "format": FORMAT, "version": 1, "frame": "colmap", "up": [0.0, -1.0, 0.0], "metres_per_unit": 1.5, "views": [view] })
            .to_string()
    }

    #[test]
    fn what_was_written_is_read() {
        let saved = SavedViews::read(&text()).unwrap();
        assert_eq!((saved.up, saved.metres_per_unit), (Some([0.0, -1.0, 0.0]), Some(1.5)));
        let view = &saved.views[0];
        assert_eq!((view.name.as_str(), view.shot.mode.as_str(), view.at), ("the arch", "clear", 0.25));
        assert_eq!(SavedViews::read(&serde_json::to_string(&saved).unwrap()).unwrap(), saved);
    }

    #[test]
    fn what_is_wrong_is_said_with_the_view_that_it_is_in() {
        let good = text();
        for (from, to, said) in [
            (FORMAT, "3d-use camera path", "format"),
            ("\"version\":1", "\"version\":2", "version 2"),
            ("[0.0,-1.0,0.0]", "[0.0,0.0,0.0]", "up is"),
            ("1.5", "-1.5", "metres_per_unit"),
            ("the arch", " ", "view 1"),
            ("0.25", "1.25", "`the arch`"),
            ("[1,0,0]", "[2,0,0]", "view 1"),
            ("50.0", "0.0", "vertical_fov_degrees"),
            ("\"focus\":2.0", "\"focus\":0.0", "focus"),
            ("\"views\"", "\"keys\"", "not a file of views"),
        ] {
            assert!(good.contains(from), "{from} in {good}");
            let error = SavedViews::read(&good.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(said), "{from}: {error}");
        }
    }
}
