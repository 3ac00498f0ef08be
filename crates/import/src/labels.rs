//! From the labels of cameras to photographs.
//!
//! A label may lack the folder and the extension, and may differ from the file in case. A photograph fits a
//! label if their last parts are equal up to these; of several that fit, the one that shares more trailing
//! parts with the label is meant, and of equals the one with the same extension.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use use3d_capture::FileName;
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::folder::{IMAGE_EXTENSIONS, SourceFolder, has_extension, last_part, may_hold_photographs};

/// The outcome for one label.
enum Fit {
    None,
    One(String),
    Several(String, String),
}

/// The photographs of a folder by the lower-case stem of their file names.
struct Photographs {
    by_stem: BTreeMap<String, Vec<String>>,
}

/// A file name without the extension of an image.
fn stem(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, _)) if !stem.is_empty() && has_extension(name, &IMAGE_EXTENSIONS) => stem,
        _ => name,
    }
}

impl Photographs {
    fn of(folder: &SourceFolder) -> Self {
        let mut by_stem: BTreeMap<String, Vec<String>> = BTreeMap::new();
        let mut allowed: BTreeMap<String, bool> = BTreeMap::new();
        for path in folder.images() {
            let usable = path.split_once('/').is_none_or(|(first, _)| {
                let known = allowed.entry(first.into());
                *known.or_insert_with(|| may_hold_photographs(&folder.path, first))
            });
            if usable {
                by_stem.entry(stem(last_part(&path)).to_lowercase()).or_default().push(path);
            }
        }
        Self { by_stem }
    }

    fn fit(&self, label: &str) -> Fit {
        let last = last_part(label);
        let mut stems = vec![last.to_lowercase(), stem(last).to_lowercase()];
        stems.dedup();
        let alike = |path: &str| {
            let folders = |text: &str| -> Vec<String> {
                text.to_lowercase().rsplit('/').skip(1).map(String::from).collect()
            };
            let shared = folders(path).iter().zip(&folders(label)).take_while(|(a, b)| a == b).count();
            let file = last_part(path);
            // Folders first, then the same file name, then the same one but for case.
            (shared, file == last, file.eq_ignore_ascii_case(last), stem(file) == stem(last))
        };
        let mut fitting: Vec<&String> =
            stems.iter().filter_map(|stem| self.by_stem.get(stem)).flatten().collect();
        fitting.sort_by_key(|path| std::cmp::Reverse(alike(path)));
        match fitting.as_slice() {
            [] => Fit::None,
            [first, second, ..] if alike(first) == alike(second) => {
                Fit::Several((*first).clone(), (*second).clone())
            }
            [first, ..] => Fit::One((*first).clone()),
        }
    }
}

/// The photographs of a folder that belong to some labels, each the only one that fits its label.
pub(crate) fn photographs(labels: &[&FileName], folder: &SourceFolder) -> BTreeMap<FileName, PathBuf> {
    let photographs = Photographs::of(folder);
    let found = labels.iter().filter_map(|label| match photographs.fit(label) {
        Fit::One(path) => Some(((*label).clone(), folder.path.join(path))),
        Fit::None | Fit::Several(..) => None,
    });
    found.collect()
}

/// The number of a survey's images that have exactly one photograph in a folder.
pub(crate) fn count(survey: &Survey, folder: &SourceFolder) -> usize {
    let photographs = Photographs::of(folder);
    survey.images.iter().filter(|image| matches!(photographs.fit(&image.name), Fit::One(_))).count()
}

/// Names a survey's images after their photographs in a folder; an image without one keeps its label.
///
/// # Errors
/// A label that fits two photographs, and two labels that fit one.
pub(crate) fn resolve(survey: &mut Survey, folder: &SourceFolder) -> Result<(), ImportError> {
    let photographs = Photographs::of(folder);
    let fail = |reason: String| {
        let (path, looked) = (folder.path.clone(), folder.relative.clone());
        Err(ImportError::NoImages { path, reason, looked })
    };
    let mut taken = BTreeSet::new();
    for image in &mut survey.images {
        let path = match photographs.fit(&image.name) {
            Fit::None => continue,
            Fit::One(path) => path,
            Fit::Several(a, b) => {
                return fail(format!(
                    "the camera {} may be {a} or {b}; put the cameras into groups that are called as the folders, \
                     or name one folder with `--set image_dir=DIR` (`--set import.image_dir=DIR` in `use3d run`)",
                    image.name
                ));
            }
        };
        if !taken.insert(path.clone()) {
            return fail(format!("two cameras have the photograph {path}; rename one in the project"));
        }
        image.name = FileName::new(&path).map_err(ImportError::file_name(&folder.path.join(path)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(files: &[&str], label: &str) -> String {
        let mut by_stem: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for file in files {
            let key = stem(last_part(file)).to_lowercase();
            by_stem.entry(key).or_default().push((*file).into());
        }
        match (Photographs { by_stem }).fit(label) {
            Fit::None => "none".into(),
            Fit::One(path) => path,
            Fit::Several(a, b) => format!("{a} or {b}"),
        }
    }

    #[test]
    fn labels_find_their_photographs() {
        for (files, label, expected) in [
            (&["a.jpg", "b.jpg"][..], "a", "a.jpg"),
            (&["A.JPG"], "a.jpg", "A.JPG"),
            (&["IMG_1.Jpg"], "IMG_1", "IMG_1.Jpg"),
            (&["IMG_1.png"], "IMG_1.Jpg", "IMG_1.png"),
            (&["a.tif", "a.jpg"], "a.jpg", "a.jpg"),
            (&["DJI.0001.jpg", "DJI.0002.jpg"], "DJI.0002", "DJI.0002.jpg"),
            (&["left/1.png", "right/1.png"], "dive/right/1", "right/1.png"),
            (&["left/1.png", "right/1.png"], "1", "left/1.png or right/1.png"),
            (&["x/1.png"], "home/me/1.JPG", "x/1.png"),
            (&["a.jpg"], "b", "none"),
            (&["a.jpg"], "a.b", "none"),
        ] {
            assert_eq!(fit(files, label), expected, "{label}");
        }
    }
}
