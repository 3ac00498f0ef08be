//! The scenes and variants of a submission, each with a digest of its part of the pipeline. A task compares
//! them with the pipeline as it is when the task starts, and leaves alone what was edited since.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use use3d_workflow::graph::{SceneVariant, cell_name};
use use3d_workflow::{Graph, Registry};

use super::ClusterError;

/// Short digests of everything that decides the keys of a submission's tasks, by scene and variant in the
/// form `SCENE@VARIANT`; that of the stages that all scenes share has no name. An engine counts by its name
/// in the settings, so no device is opened.
pub fn digests(graph: &Graph, registry: &Registry) -> BTreeMap<String, String> {
    let parts = graph.parts(registry).into_iter();
    parts.map(|((scene, variant), part)| (cell_name(&scene, &variant), part.short())).collect()
}

/// The scenes and variants of a submission, compared with the pipeline as it is now.
pub struct SubmittedCells {
    /// Those with the same keys as then.
    same: BTreeSet<SceneVariant>,
    /// The names of those that were changed or removed since.
    pub changed: Vec<String>,
    /// True if the stages that all scenes share have the same keys as then.
    shared: bool,
}

impl SubmittedCells {
    /// Reads the list of a submission's scenes and variants, and compares it with a pipeline.
    ///
    /// # Errors
    /// The list cannot be read.
    pub fn read(list: &Path, graph: &Graph, registry: &Registry) -> Result<Self, ClusterError> {
        let text = std::fs::read(list);
        let noted = text.and_then(|text| Ok(serde_json::from_slice::<BTreeMap<String, String>>(&text)?));
        let mut noted =
            noted.map_err(|source| ClusterError::List { file: list.display().to_string(), source })?;
        let mut shared = true;
        let mut same = BTreeSet::new();
        for ((scene, variant), part) in graph.parts(registry) {
            let is_same = noted.get(&cell_name(&scene, &variant)) == Some(&part.short());
            match scene.is_empty() {
                true => shared = is_same,
                false if is_same => {
                    noted.remove(&cell_name(&scene, &variant));
                    same.insert((scene, variant));
                }
                false => {}
            }
        }
        noted.remove("");
        Ok(Self { same, changed: noted.into_keys().collect(), shared })
    }

    /// The scenes and variants of a task that was asked for `only` these; `None` for a task that all scenes
    /// share. Other scenes of the file do not concern it.
    ///
    /// # Errors
    /// Nothing of the task is as it was submitted. `target` is the pipeline file.
    pub fn of_task(
        &self,
        target: &Path,
        only: Option<Vec<SceneVariant>>,
        for_all: bool,
    ) -> Result<Option<Vec<SceneVariant>>, ClusterError> {
        let own: Option<Vec<SceneVariant>> = match only {
            _ if for_all => None,
            Some(only) => Some(only.into_iter().filter(|cell| self.same.contains(cell)).collect()),
            None => Some(self.same.iter().cloned().collect()),
        };
        if own.as_ref().map_or(self.shared, |cells| !cells.is_empty()) {
            return Ok(own);
        }
        Err(ClusterError::Edited(target.display().to_string()))
    }

    /// True if a scene and variant was submitted.
    pub fn has(&self, scene: &str, variant: &str) -> bool {
        let cell = (scene.to_string(), variant.to_string());
        self.same.contains(&cell) || self.changed.contains(&cell_name(scene, variant))
    }
}
