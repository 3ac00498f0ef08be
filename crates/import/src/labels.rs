//! From the labels of cameras to photographs.
//!
//! A label may lack the folder and the extension, and may differ from the file in case. A photograph fits a
//! label if their last parts are equal up to these; of several that fit, the one that shares more trailing
//! parts with the label is meant, and of equals the one with the same extension.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use unicode_normalization::UnicodeNormalization;
use use3d_capture::{FileName, shown};
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::folder::{IMAGE_EXTENSIONS, SourceFolder, has_extension, last_part, may_hold_photographs};

/// The outcome for one label.
enum Fit {
    None,
    One(String),
    Several(String, String),
}

/// A name in the form in which names are compared: small letters, and one form of Unicode for each character.
fn folded(name: &str) -> String {
    name.nfc().collect::<String>().to_lowercase()
}

/// The folders of a name, the innermost first.
fn folders(name: &str) -> Vec<String> {
    folded(name).rsplit('/').skip(1).map(String::from).collect()
}

/// The photographs of a folder by the folded stems of their file names.
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
                by_stem.entry(folded(stem(last_part(&path)))).or_default().push(path);
            }
        }
        Self { by_stem }
    }

    /// The photograph that fits a label best. With `same_folders`, only those in the label's folders fit.
    fn fit(&self, label: &str, same_folders: bool) -> Fit {
        let last = last_part(label);
        let mut stems = vec![folded(last), folded(stem(last))];
        stems.dedup();
        let alike = |path: &str| {
            let shared = folders(path).iter().zip(&folders(label)).take_while(|(a, b)| a == b).count();
            let file = last_part(path);
            // Folders first, then the same file name, then the same one but for case.
            (shared, file == last, file.eq_ignore_ascii_case(last), stem(file) == stem(last))
        };
        let mut fitting: Vec<&String> =
            stems.iter().filter_map(|stem| self.by_stem.get(stem)).flatten().collect();
        fitting.retain(|path| !same_folders || folders(path) == folders(label));
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
    let found = labels.iter().filter_map(|label| match photographs.fit(label, false) {
        Fit::One(path) => Some(((*label).clone(), folder.path.join(path))),
        Fit::None | Fit::Several(..) => None,
    });
    found.collect()
}

/// The number of a survey's images that have exactly one photograph in a folder.
pub(crate) fn count(survey: &Survey, folder: &SourceFolder) -> usize {
    let photographs = Photographs::of(folder);
    survey.images.iter().filter(|image| matches!(photographs.fit(&image.name, false), Fit::One(_))).count()
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
        let path = match photographs.fit(&image.name, false) {
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

/// The number of a survey's images that may have a photograph in a folder under another name.
pub(crate) fn likely(survey: &Survey, folder: &SourceFolder) -> usize {
    let photographs = Photographs::of(folder);
    survey.images.iter().filter(|image| !matches!(photographs.fit(&image.name, false), Fit::None)).count()
}

/// Names images that have no file of their name after the photographs that people take for them: names may
/// differ in case and in the form of Unicode. If no name fits so, they may differ in their folders too.
///
/// # Errors
/// A name that fits two photographs, and two names that fit one.
pub(crate) fn rename(survey: &mut Survey, folder: &SourceFolder) -> Result<(), ImportError> {
    let (mut taken, mut lost) = (BTreeSet::new(), Vec::new());
    for (index, image) in survey.images.iter().enumerate() {
        match folder.image(&image.name)? {
            Some(path) => _ = taken.insert(path),
            None => lost.push(index),
        }
    }
    if lost.is_empty() {
        return Ok(());
    }
    let mut photographs = Photographs::of(folder);
    photographs
        .by_stem
        .values_mut()
        .for_each(|paths| paths.retain(|p| !taken.contains(&folder.path.join(p))));
    let fits = |index: &usize| !matches!(photographs.fit(&survey.images[*index].name, true), Fit::None);
    let same_folders = !taken.is_empty() || lost.iter().any(fits);
    let fail = |reason: String| {
        let (path, looked) = (folder.path.clone(), folder.relative.clone());
        Err(ImportError::NoImages { path, reason, looked })
    };
    let mut renamed: BTreeMap<String, FileName> = BTreeMap::new();
    for index in lost {
        let name = &mut survey.images[index].name;
        let path = match photographs.fit(name, same_folders) {
            Fit::None => continue,
            Fit::One(path) => path,
            Fit::Several(a, b) => {
                return fail(format!(
                    "the model's image {name} may be {a} or {b}; name the folder that is meant with \
                     `--set image_dir=DIR` (`--set import.image_dir=DIR` in `use3d run`), or find the cameras again \
                     from the folder above both"
                ));
            }
        };
        if let Some(other) = renamed.insert(path.clone(), name.clone()) {
            return fail(format!(
                "two images of the model, {other} and {name}, may be the photograph {path}; put the photographs into \
                 the folders that the model names"
            ));
        }
        *name = FileName::new(&path).map_err(ImportError::file_name(&folder.path.join(path)))?;
    }
    // Two forms of an umlaut look alike.
    renamed.retain(|path, name| !path.nfc().eq(name.nfc()));
    if let Some((path, name)) = renamed.first_key_value() {
        let count = match renamed.len() {
            1 => "1 name of the model differs from that of its photograph".into(),
            count => format!("{count} names of the model differ from those of their photographs"),
        };
        survey.notes.push(format!("{count}: {} of the model is the file {}", shown(name), shown(path)));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(files: &[&str], label: &str) -> String {
        let mut by_stem: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for file in files {
            let key = folded(stem(last_part(file)));
            by_stem.entry(key).or_default().push((*file).into());
        }
        match (Photographs { by_stem }).fit(label, false) {
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
            (&["Ho\u{308}hle_1.png"], "H\u{f6}hle_1", "Ho\u{308}hle_1.png"),
            (&["a.jpg"], "b", "none"),
            (&["a.jpg"], "a.b", "none"),
        ] {
            assert_eq!(fit(files, label), expected, "{label}");
        }
    }
}
