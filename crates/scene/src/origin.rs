//! The views that a scene was made from: the optional field `origin` of `scene.json`.
//!
//! With this field, a scene is neither scored on views that it was trained with nor combined with another
//! capture. Views are named by their stems, since an import may change extensions. Scenes without the field
//! are not checked.

use std::collections::BTreeSet;
use std::path::Path;

use serde::{Deserialize, Serialize};
use use3d_capture::{Capture, View};

use crate::SceneError;
use crate::description::Description;

/// The views of the capture that a scene was made from, by stem, and the water that it started from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// The views that were trained with.
    pub train: Vec<String>,
    /// The views that were held out.
    pub held_out: Vec<String>,
    /// The water that stage 1 started from, as a sentence with its standard errors; older scenes have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub water: Option<String>,
}

/// Largest relative difference of the numbers of two frames that count as the frames of one capture.
const SAME: f64 = 1e-6;

impl Origin {
    /// The origin of scenes made from a capture with its split.
    pub fn of(capture: &Capture) -> Self {
        let stems =
            |indices: &[usize]| indices.iter().map(|&i| capture.views[i].stem().to_string()).collect();
        Self { train: stems(&capture.split.train), held_out: stems(&capture.split.test), water: None }
    }

    /// Reads the origin of a scene folder; `None` if it is not recorded.
    ///
    /// # Errors
    /// Fails if the folder is not a scene.
    pub fn read(dir: &Path) -> Result<Option<Self>, SceneError> {
        Ok(Description::read(dir)?.origin)
    }

    /// Records it in a saved scene folder.
    ///
    /// # Errors
    /// Fails if the folder is not a scene, or cannot be written.
    pub fn write(self, dir: &Path) -> Result<(), SceneError> {
        let mut description = Description::read(dir)?;
        description.origin = Some(self);
        description.write(dir)
    }

    /// Checks that `capture` is the one that the scene in `dir` was made from.
    ///
    /// # Errors
    /// It is not, or the folder is not a scene.
    pub fn check_capture(&self, dir: &Path, capture: &Capture) -> Result<(), SceneError> {
        let wrong = |problem: String| Err(SceneError::Capture { scene: dir.to_path_buf(), problem });
        let there: BTreeSet<&str> = capture.views.iter().map(View::stem).collect();
        let lost = self.train.iter().chain(&self.held_out).find(|stem| !there.contains(stem.as_str()));
        if let Some(lost) = lost {
            return wrong(format!(
                "was made from another capture: its view `{lost}` is not in `{}`; give the capture that it was made from",
                capture.name
            ));
        }
        let own = Description::read(dir)?.frame.into();
        let numbers = |f: &use3d_capture::Frame| {
            let mut all = f.rotation.to_cols_array().to_vec();
            all.extend(f.translation.to_array());
            all.push(f.scale);
            all
        };
        let apart = |(a, b): (&f64, &f64)| (a - b).abs() > SAME * a.abs().max(b.abs()).max(1.0);
        if numbers(&own).iter().zip(&numbers(&capture.frame)).any(apart) {
            return wrong(format!(
                "was made in another frame than `{}` is imported in: give the capture that it was made from, with the \
                 same `normalise`",
                capture.name
            ));
        }
        Ok(())
    }

    /// Checks that no view that `capture` holds out was trained with.
    ///
    /// # Errors
    /// There is such a view.
    pub fn check_split(&self, dir: &Path, capture: &Capture) -> Result<(), SceneError> {
        let trained: Vec<&str> =
            capture.test_views().map(View::stem).filter(|s| self.train.iter().any(|t| t == s)).collect();
        let Some(first) = trained.first() else { return Ok(()) };
        let held_out = match self.held_out.len() {
            0 => "it held out none (split.every = 0), so nothing can be scored on unseen views".to_string(),
            n => format!("it held out {n} others"),
        };
        let problem = format!(
            "was trained with {} of the views that this split holds out (`{first}`, …): {held_out}; use the split of \
             the reconstruction, e.g. `--set split.every=N`",
            trained.len()
        );
        Err(SceneError::Capture { scene: dir.to_path_buf(), problem })
    }
}
