//! Finds the scene in a folder: the folder itself may be a scene, or the results of a run that made one.

use std::path::{Path, PathBuf};

use use3d_scene::Scene;

use crate::WorkError;
use crate::destination::{OUT, entries, path_text};
use crate::history;

/// The folders of a scene's results that are scenes, the best one first.
const SCENES: [&str; 2] = ["enhanced-scene", "scene"];

/// The scene of a folder of one scene's results.
fn own_scene(folder: &Path) -> Option<PathBuf> {
    SCENES.iter().map(|name| folder.join(name)).find(|path| Scene::is_scene(path))
}

/// Every scene below a results folder.
fn scenes_below(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = entries(folder).filter_map(|path| own_scene(&path)).collect();
    found.sort();
    found
}

/// The scene that `given` names: a scene folder itself, the folder `use3d-out/NAME/SCENE` that a run wrote,
/// or `use3d-out/NAME` if there is one scene in it. Any other path is returned unchanged; its reader reports
/// the error.
///
/// # Errors
/// A results folder with several scenes, or a capture whose results lie elsewhere.
pub fn scene_in(given: &Path) -> Result<PathBuf, WorkError> {
    if Scene::is_scene(given) {
        return Ok(given.to_path_buf());
    }
    let below = own_scene(given).map_or_else(|| scenes_below(given), |scene| vec![scene]);
    match &below[..] {
        [] => {
            // A capture's results often have its name.
            let results = Path::new(OUT).join(given.file_name().unwrap_or_default());
            if !given.is_dir() || (own_scene(&results).is_none() && scenes_below(&results).is_empty()) {
                return Ok(given.to_path_buf());
            }
            Err(WorkError::Input(format!(
                "{}: this folder holds no scene; the results of its run are in {}",
                path_text(given),
                path_text(&results)
            )))
        }
        [scene] => Ok(scene.clone()),
        several => {
            let folders = several.iter().filter_map(|scene| scene.parent()).map(path_text);
            let folders: Vec<String> = folders.collect();
            Err(WorkError::Input(format!(
                "{}: this folder holds the results of {} scenes; give one of them: {}",
                path_text(given),
                folders.len(),
                folders.join(", ")
            )))
        }
    }
}

/// The capture from which the results in a folder were made, if `given` is a results folder and its capture
/// still exists.
pub fn capture_in(given: &Path) -> Option<PathBuf> {
    if Scene::is_scene(given) {
        return None;
    }
    let record = history::of_results(given).or_else(|| history::of_results(given.parent()?))?;
    Some(record.target).filter(|target| target.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_results_folder_means_its_scene_and_the_enhanced_one_first() {
        let dir = tempfile::tempdir().unwrap();
        let scene = |path: &str| {
            let folder = dir.path().join(path);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("scene.json"), "{}").unwrap();
            folder
        };
        let found = |path: &Path| scene_in(path).unwrap();
        let plain = scene("out/reef/scene");
        assert_eq!(found(&plain), plain);
        assert_eq!(found(&dir.path().join("out")), plain);
        let enhanced = scene("out/reef/enhanced-scene");
        assert_eq!(found(&dir.path().join("out")), enhanced);
        assert_eq!(found(&dir.path().join("out/reef")), enhanced);
        // A path that is neither a results folder nor a scene.
        assert_eq!(found(&dir.path().join("nowhere")), dir.path().join("nowhere"));
        scene("out/wreck/scene");
        let refused = scene_in(&dir.path().join("out")).unwrap_err();
        assert!(refused.to_string().contains("reef") && refused.to_string().contains("wreck"), "{refused}");
    }
}
