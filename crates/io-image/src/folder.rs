//! The images of a folder by the stems of their names.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

/// A folder of images that cannot be listed.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder cannot be read.
    #[error("{}: the folder cannot be read ({source}); check that it is there and may be read", path.display())]
    Open {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// Two images have one stem, so it is not clear which one is meant.
    #[error(
        "{}: {first} and {second} have the same name apart from the extension; keep one of them",
        path.display()
    )]
    Twice {
        /// The folder.
        path: PathBuf,
        /// The first name in the order of names.
        first: String,
        /// The second name.
        second: String,
    },
}

/// The files of a folder, not of its sub-folders, whose extension is one of `extensions` (in lower case; the
/// case of the files' extensions does not matter).
///
/// # Errors
/// Fails if the folder cannot be read, or if two images have one stem.
pub fn images_by_stem(folder: &Path, extensions: &[&str]) -> Result<BTreeMap<String, PathBuf>, FolderError> {
    let open = |source| FolderError::Open { path: folder.to_path_buf(), source };
    let entries = std::fs::read_dir(folder).map_err(open)?;
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>().map_err(open)?;
    paths.sort();
    let mut found: BTreeMap<String, PathBuf> = BTreeMap::new();
    for path in paths {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let Some(stem) = path.file_stem().filter(|_| extensions.contains(&extension.as_str())) else {
            continue;
        };
        let stem = stem.to_string_lossy().into_owned();
        if let Some(first) = found.get(&stem) {
            let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let (first, second) = (name(first), name(&path));
            return Err(FolderError::Twice { path: folder.to_path_buf(), first, second });
        }
        found.insert(stem, path);
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_found_by_stem_and_two_of_one_stem_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        for name in ["b.JPG", "a.png", "notes.txt"] {
            std::fs::write(place(name), "").unwrap();
        }
        let found = images_by_stem(folder.path(), &["png", "jpg"]).unwrap();
        assert_eq!(
            found.into_iter().collect::<Vec<_>>(),
            [("a".into(), place("a.png")), ("b".into(), place("b.JPG"))]
        );
        std::fs::write(place("a.jpg"), "").unwrap();
        let error = images_by_stem(folder.path(), &["png", "jpg"]).unwrap_err().to_string();
        assert!(error.contains("a.jpg and a.png") && error.contains("keep one"), "{error}");
        let error = images_by_stem(&place("nowhere"), &["png"]).unwrap_err().to_string();
        assert!(error.contains("nowhere") && error.contains("check that it is there"), "{error}");
    }
}
