//! The sources of a stage's choice among the files of a capture.

use std::path::{Path, PathBuf};

/// More files and folders than this are not compared one by one to find a change.
const MOST_COMPARED: usize = 4096;

/// The sources of the choice of files: all folders of the capture, whose times change when a file is added or
/// removed, and the files that name the images, such as models and lists.
pub(crate) fn choice_sources(capture: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(capture).follow_links(true).sort_by_file_name() {
        // An unreadable entry may become readable later, so such a choice is made again each time.
        let Ok(entry) = entry else { return Vec::new() };
        let extension = entry.path().extension().map(|e| e.to_string_lossy().to_lowercase());
        let endings = ["bin", "txt", "json", "xml", "ply", "csv", "xmp"];
        let names_images = extension.is_some_and(|extension| endings.contains(&&*extension));
        if entry.file_type().is_dir() || names_images {
            found.push(entry.path().strip_prefix(capture).unwrap_or(entry.path()).to_path_buf());
        }
        if found.len() > MOST_COMPARED {
            return Vec::new();
        }
    }
    found
}
