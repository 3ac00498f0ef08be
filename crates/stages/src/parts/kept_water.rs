//! Chooses the share of the water that an enhanced scene keeps, from what is known of the scene.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::kept_water::{Depths, Trust, shares};
use use3d_capture::{KeptWater, View};
use use3d_scene::{KnownViews, Scene};
use use3d_workflow::{StageContext, StageError};

use super::files::{WATER, read_json};
use super::judgement::Judgement;

/// `"auto"`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Auto {
    /// Chosen from the scene.
    #[default]
    Auto,
}

/// The share of the water that is kept, from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub(crate) enum KeptWaterChoice {
    /// `"auto"`: chosen per channel from the scene.
    Auto(Auto),
    /// One share for all channels.
    Same(f32),
    /// Shares of red, green and blue.
    Channels([f32; 3]),
}

impl Default for KeptWaterChoice {
    fn default() -> Self {
        Self::Auto(Auto::Auto)
    }
}

impl KeptWaterChoice {
    /// The given shares; `None` for `"auto"`.
    pub(crate) fn given(&self) -> Option<KeptWater> {
        match *self {
            Self::Auto(_) => None,
            Self::Same(k) => Some(KeptWater([k; 3])),
            Self::Channels(k) => Some(KeptWater(k)),
        }
    }

    /// Refuses shares outside `[0, 1]`, as the error of the parameter `kept_water`.
    pub(crate) fn check(&self) -> Result<(), (String, String)> {
        if self.given().is_none_or(|shares| shares.is_valid()) {
            return Ok(());
        }
        let given = serde_json::to_string(self).unwrap_or_default();
        Err(("kept_water".into(), format!("is {given}; expected \"auto\", or shares from 0 to 1")))
    }
}

/// Longest side at which a view's optical depths are sampled, pixels.
const SIDE: usize = 160;

/// Chooses the shares from the optical depths of all training views and from the reliability of the water.
pub(crate) fn choose(
    context: &StageContext,
    scene: &Scene,
    views: &[&View],
) -> Result<KeptWater, StageError> {
    if scene.medium.is_none() {
        return Ok(KeptWater::ALL);
    }
    let mut known = KnownViews::new(scene);
    let mut depths = Depths::default();
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        let doing = "measuring the water in front of surfaces";
        context.progress_with(i as u64, views.len() as u64, "views", doing);
        let looked = known.view(&view.camera.no_larger_than(SIDE));
        depths.add(&looked.accumulation, &looked.arriving);
    }
    Ok(shares(&depths, trust(context.input("scene")?)))
}

/// The reliability of the water: measured before training, or only learnt. It is read from stage 1's record.
/// An estimate that stage 1 did not start from, as under lamps, says nothing of the water it learnt.
fn trust(scene: &Path) -> Trust {
    match read_json::<serde_json::Value>(&scene.join(WATER)) {
        Ok(report) if report["judgement"] == Judgement::Found.name() => Trust::Measured,
        _ => Trust::Learnt,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_an_estimate_that_training_started_from_counts_as_measured() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(trust(folder.path()), Trust::Learnt, "no estimate at all");
        for (judgement, expected) in [
            ("found", Trust::Measured),
            ("lamps", Trust::Learnt),
            ("not-known", Trust::Learnt),
            ("no-water", Trust::Learnt),
        ] {
            let found = serde_json::json!({ "verdict": "found" });
            let report = serde_json::json!({ "judgement": judgement, "channels": [found, found, found] });
            std::fs::write(folder.path().join(WATER), report.to_string()).unwrap();
            assert_eq!(trust(folder.path()), expected, "{judgement}");
        }
    }
}
