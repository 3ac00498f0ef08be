//! Copies photographs into the image folder, as they are stored.

use std::path::Path;

use use3d_io_image::straighten;

use crate::error::PrepareError;
use crate::process::{self, StepWatch};
use crate::sources::{BESIDE, SourcePhotograph};
use crate::tools::{self, Program};

/// Copies the photographs into `folder`. WebP becomes PNG; a JPEG's orientation is set to "not turned".
pub(crate) fn copy(
    photographs: &[SourcePhotograph],
    folder: &Path,
    ffmpeg: Option<&Program>,
    log: &Path,
    watch: &StepWatch<'_>,
) -> Result<(), PrepareError> {
    for (done, photograph) in photographs.iter().enumerate() {
        watch.check()?;
        let to = photograph.name.below(folder);
        if let Some(parent) = to.parent() {
            std::fs::create_dir_all(parent).map_err(PrepareError::write(parent))?;
        }
        let from = &photograph.path;
        match ffmpeg {
            Some(ffmpeg) if photograph.converted => {
                let source = std::path::absolute(from).map_err(PrepareError::read(from))?;
                let mut command = tools::command(&ffmpeg.path);
                // The name is no pattern for numbers, also with a percent sign.
                command
                    .args(["-v", "error", "-y", "-f", "image2", "-pattern_type", "none", "-i"])
                    .arg(source);
                command.args(["-frames:v", "1", "-update", "1"]).arg(&to);
                let outcome = process::run(&mut command, log, watch.stop, |_| {})?;
                if !outcome.status.success() {
                    let reason = process::reason(&outcome);
                    return Err(PrepareError::input(from, format!("ffmpeg cannot convert it: {reason}")));
                }
            }
            _ if photograph.orientation != 1 => {
                let mut bytes = std::fs::read(from).map_err(PrepareError::read(from))?;
                straighten(&mut bytes);
                std::fs::write(&to, bytes).map_err(PrepareError::write(&to))?;
            }
            _ => copy_file(from, &to)?,
        }
        watch.tell("photographs", (done as u64 + 1, photographs.len() as u64), "photographs");
    }
    Ok(())
}

/// Copies a file.
pub(crate) fn copy_file(from: &Path, to: &Path) -> Result<(), PrepareError> {
    let copied = std::fs::copy(from, to).map(|_| ());
    copied.map_err(|source| PrepareError::Copy { from: from.to_path_buf(), to: to.to_path_buf(), source })
}

/// Copies a file or a folder of plain files.
pub(crate) fn copy_all(from: &Path, to: &Path) -> Result<(), PrepareError> {
    if from.is_file() {
        return copy_file(from, to);
    }
    for entry in walkdir::WalkDir::new(from).follow_links(true) {
        let entry = entry.map_err(|e| PrepareError::walk(from, &e))?;
        let target = to.join(entry.path().strip_prefix(from).unwrap_or(entry.path()));
        if entry.file_type().is_dir() {
            std::fs::create_dir_all(&target).map_err(PrepareError::write(&target))?;
        } else {
            copy_file(entry.path(), &target)?;
        }
    }
    Ok(())
}

/// Copies the masks, depth maps and lists of a folder into a capture.
pub(crate) fn copy_beside(origin: &Path, capture: &Path) -> Result<(), PrepareError> {
    let there = BESIDE.iter().filter(|name| origin.join(name).exists());
    there.into_iter().try_for_each(|name| copy_all(&origin.join(name), &capture.join(name)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_copy_that_fails_names_both_files() {
        let dir = tempfile::tempdir().unwrap();
        let (from, to) = (dir.path().join("a.jpg"), dir.path().join("nowhere/a.jpg"));
        std::fs::write(&from, "picture").unwrap();
        let said = copy_all(&from, &to).unwrap_err().to_string();
        for part in [from.display().to_string(), format!("to {}", to.display()), "has space".into()] {
            assert!(said.contains(&part), "{said} lacks {part}");
        }
    }
}
