//! The files of the paper's data sets where their owners' archives were put: the folder that `DATA` names, or
//! that a data set's own variable names, which wins.

use std::cell::RefCell;
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use use3d_prepare::{Recipe, RecipeWork, SetScene};
use use3d_workflow::graph::{External, Overrides};

use super::merge_into;
use super::places::folder_in;

/// The folder of all downloads.
const DATA: &str = "DATA";
/// The pairs of UIEB: their variable, and the folder that shows where they are.
const UIEB: [&str; 2] = ["UIEB", "raw-890"];
/// The depth of folders below [`DATA`] that are looked through.
const DEPTH: usize = 2;

/// The variables that name folders of downloads.
pub(super) fn variables() -> impl Iterator<Item = String> {
    let own = Recipe::ALL.map(Recipe::variable).into_iter();
    own.chain([DATA, UIEB[0]]).map(String::from)
}

/// The folders of downloads that were looked through while a pipeline file is read, each once.
#[derive(Default)]
pub(super) struct Downloads(RefCell<HashMap<PathBuf, Rc<Looked>>>);

/// The folders down to [`DEPTH`] and the archives in them.
struct Looked {
    folders: Vec<PathBuf>,
    archives: Vec<PathBuf>,
}

impl Downloads {
    /// A scene of a data set: true if its cameras must be found or unpacked, and its place.
    pub(super) fn find(&self, recipe: Recipe, scene: &str, folder: &Path) -> (bool, External) {
        let variable = recipe.variable();
        let Some(root) = folder_in(variable).or_else(|| folder_in(DATA)) else {
            let reason = format!(
                "neither {DATA} nor {variable} is set; set {DATA} to the folder of the downloads (docs/reference/datasets.md)"
            );
            return (false, Err(reason));
        };
        let root = folder.join(root);
        let looked = self.0.borrow_mut().entry(root.clone()).or_insert_with(|| Rc::new(look(&root))).clone();
        find_below(recipe, scene, &root, &looked)
    }
}

fn look(root: &Path) -> Looked {
    let folders = folders(root);
    let archive = |path: &PathBuf| use3d_archive::is_archive(path) && path.is_file();
    let archives = folders.iter().flat_map(|place| entries(place)).filter(archive).collect();
    Looked { folders, archives }
}

/// Like [`Downloads::find`], in a folder that was looked through.
fn find_below(recipe: Recipe, scene: &str, root: &Path, looked: &Looked) -> (bool, External) {
    for place in &looked.folders {
        let own = place.join(scene);
        // A capture that was made of the owners' files wins over them.
        if own.is_dir() && use3d_import::check_layout(&own).is_ok() {
            return (false, Ok(own));
        }
        match recipe.work(place, scene) {
            Ok(Some(RecipeWork::Published { images, .. })) => {
                return (false, Ok(images.parent().unwrap_or(place).to_path_buf()));
            }
            Ok(Some(RecipeWork::Linear(path) | RecipeWork::Film(path))) => return (true, Ok(path)),
            Ok(None) => {}
            Err(error) => return (true, Err(error.to_string())),
        }
    }
    match looked.archives.iter().find(|path| recipe.is_packed(path, scene)) {
        Some(archive) => (true, Ok(archive.clone())),
        None => (false, Err(format!("{}: {}", root.display(), recipe.absent(scene)))),
    }
}

/// Adds the choices for a scene of a data set to its own parameters, which win.
pub(super) fn choose(recipe: Recipe, scene: &str, overrides: &mut Overrides) {
    let origin = SetScene { recipe, scene: scene.to_string() };
    let choices = recipe.choices();
    let given = serde_json::json!({
        "origin": origin, "frames": choices.frames, "matching": choices.matching,
    });
    merge_into(overrides, "prepare", &given, false);
}

/// The folder of UIEB's pairs below [`DATA`], in place of a variable that is not set.
pub(super) fn pairs(variable: &str, folder: &Path) -> Option<String> {
    if variable != UIEB[0] {
        return None;
    }
    let data = folder_in(DATA)?;
    Some(pairs_below(&folder.join(data)).display().to_string())
}

fn pairs_below(root: &Path) -> PathBuf {
    let folders = folders(root);
    let found = folders.iter().find(|place| unpacked_or_not(place.join(UIEB[1])).exists());
    // Without one, the message names the place at the top.
    found.map_or_else(|| root.to_path_buf(), Clone::clone)
}

/// A folder, or the archive of its name if only that is there.
pub(super) fn unpacked_or_not(folder: PathBuf) -> PathBuf {
    let Some(name) = folder.file_name().and_then(|name| name.to_str()).filter(|_| !folder.exists()) else {
        return folder;
    };
    let around = entries(folder.parent().unwrap_or(Path::new("")));
    let own = |path: &PathBuf| use3d_archive::stem(path).is_some_and(|stem| stem.eq_ignore_ascii_case(name));
    around.into_iter().find(own).unwrap_or(folder)
}

/// A folder and those below it, the upper ones first.
fn folders(root: &Path) -> Vec<PathBuf> {
    let (mut all, mut level) = (vec![root.to_path_buf()], vec![root.to_path_buf()]);
    for _ in 0..DEPTH {
        level = level.iter().flat_map(|folder| entries(folder)).filter(|path| path.is_dir()).collect();
        all.extend(level.iter().cloned());
    }
    all
}

/// The visible entries of a folder, sorted.
fn entries(folder: &Path) -> BTreeSet<PathBuf> {
    let hidden = |name: &std::ffi::OsStr| name.as_encoded_bytes().starts_with(b".");
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| !hidden(&entry.file_name())).map(|entry| entry.path()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_found_where_their_owners_files_lie() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let file = |name: &str| {
            std::fs::create_dir_all(at(name).parent().unwrap()).unwrap();
            std::fs::write(at(name), "x").unwrap();
        };
        let params =
            use3d_synth::CaptureParams { views: 3, width: 16, height: 16, points: 50, ..Default::default() };
        let panama = at("SeathruNeRF_dataset/Panama");
        for capture in [&panama, &at("DRUVA/A2")] {
            use3d_synth::write_capture(&params, capture, &mut |_, _| ()).unwrap();
        }
        std::fs::rename(panama.join("images"), panama.join("Images_wb")).unwrap();
        file("Sea-thru/d3/linearpng/a.png");
        file("Sea-thru/D5.tar.gz");
        file("DRUVA/a1.MP4");
        file("UIEB/raw-890.zip");
        file("UIEB/reference-890/1.png");
        let looked = look(dir.path());
        let find = |recipe, scene: &str| find_below(recipe, scene, dir.path(), &looked);
        assert_eq!(find(Recipe::SeaThruNerf, "Panama"), (false, Ok(panama)));
        assert_eq!(find(Recipe::Druva, "A2"), (false, Ok(at("DRUVA/A2"))));
        assert_eq!(find(Recipe::Druva, "A1"), (true, Ok(at("DRUVA/a1.MP4"))));
        assert_eq!(find(Recipe::SeaThru, "D3"), (true, Ok(at("Sea-thru/d3/linearpng"))));
        assert_eq!(find(Recipe::SeaThru, "D5"), (true, Ok(at("Sea-thru/D5.tar.gz"))));
        let missing = find(Recipe::SeaThruNerf, "Curasao").1.unwrap_err();
        assert!(missing.contains("https://sea-thru-nerf.github.io/") && missing.contains("datasets.md"));
        let pairs = pairs_below(dir.path());
        assert_eq!(unpacked_or_not(pairs.join("raw-890")), at("UIEB/raw-890.zip"));
        assert_eq!(unpacked_or_not(pairs.join("reference-890")), at("UIEB/reference-890"));
        // The films are circles: all frames are compared with each other. A scene's own choices win.
        let mut own = serde_json::from_str(r#"{"prepare": {"frames": 80}}"#).unwrap();
        choose(Recipe::Druva, "A1", &mut own);
        let expected = serde_json::json!({ "origin": "druva/A1", "frames": 80, "matching": "exhaustive" });
        assert_eq!(own["prepare"], expected);
    }
}
