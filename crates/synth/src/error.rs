//! The errors of writing a synthetic data set.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use use3d_numerics::range::OutOfRange;

/// A data set that cannot be made or written. No output is left then.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// A parameter out of its range.
    #[error(transparent)]
    Parameter(#[from] OutOfRange),
    /// The output exists already.
    #[error("{}: already there; choose another output folder or remove this one first", path.display())]
    OutputExists {
        /// The output folder.
        path: PathBuf,
    },
    /// A folder or file that cannot be created.
    #[error("{}: cannot be written ({source}); check that the folder is there, writable and has space", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The progress callback stopped the work.
    #[error("interrupted; nothing is left of what was begun")]
    Interrupted,
    /// A name that is not valid for an image.
    #[error(transparent)]
    Name(#[from] use3d_capture::NameError),
    /// An image that cannot be written.
    #[error(transparent)]
    Image(#[from] use3d_io_image::ImageError),
    /// A COLMAP model that cannot be written.
    #[error(transparent)]
    Model(#[from] use3d_io_colmap::ModelError),
}

impl SynthError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_path_buf(), source }
    }
}

/// Refuses a parameter unless it is `good`; `expected` describes the valid values.
pub(crate) fn check(
    parameter: &str,
    value: impl std::fmt::Display,
    good: bool,
    expected: &str,
) -> Result<(), OutOfRange> {
    if good { Ok(()) } else { Err(OutOfRange::new(parameter, value, expected)) }
}

/// The result of a progress callback: nothing, or the choice to continue or stop.
pub trait Answer {
    /// Returns [`SynthError::Interrupted`] if the work must stop.
    fn go_on(self) -> Result<(), SynthError>;
}

impl Answer for () {
    fn go_on(self) -> Result<(), SynthError> {
        Ok(())
    }
}

impl Answer for ControlFlow<()> {
    fn go_on(self) -> Result<(), SynthError> {
        if self.is_break() { Err(SynthError::Interrupted) } else { Ok(()) }
    }
}

/// Locks a folder while the returned handle lives. An unlocked folder means that its writer has ended. `None`
/// if folders cannot be locked.
fn hold(folder: &Path) -> Option<std::fs::File> {
    let handle = std::fs::File::open(folder).ok()?;
    handle.try_lock().is_ok().then_some(handle)
}

/// The prefix of the name of an unfinished folder that becomes `name`.
fn partial_name(name: &std::ffi::OsStr) -> String {
    format!(".{}.partial-", name.to_string_lossy())
}

/// Removes unfinished folders of killed commands next to `out`.
fn sweep_partials(out: &Path) {
    let prefix = partial_name(out.file_name().unwrap_or_default());
    for entry in std::fs::read_dir(use3d_files::folder_of(out)).into_iter().flatten().flatten() {
        let left = entry.file_name().to_string_lossy().starts_with(&prefix);
        if left && hold(&entry.path()).is_some() {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

/// Runs `fill` on a new folder next to `out` and renames it to `out` when it is complete: so the output is
/// complete or absent. An existing empty folder is replaced; anything else at that path is an error.
pub(crate) fn whole_folder<T>(
    out: &Path,
    fill: impl FnOnce(&Path) -> Result<T, SynthError>,
) -> Result<T, SynthError> {
    let exists = || SynthError::OutputExists { path: out.to_path_buf() };
    let empty = match std::fs::read_dir(out) {
        Ok(mut entries) => entries.next().is_none(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(_) => return Err(exists()),
    };
    if out.exists() && !empty {
        return Err(exists());
    }
    let name = out.file_name().ok_or_else(exists)?;
    let folder = use3d_files::folder_of(out);
    std::fs::create_dir_all(folder).map_err(SynthError::io(folder))?;
    let partial = out.with_file_name(format!("{}{}", partial_name(name), use3d_files::unique()));
    sweep_partials(out);
    let _making = use3d_files::Making::new(&partial);
    // The folder must be new; an existing one belongs to another process.
    let result = std::fs::create_dir(&partial).map_err(SynthError::io(&partial)).and_then(|()| {
        let _held = hold(&partial);
        let value = fill(&partial)?;
        if empty {
            std::fs::remove_dir(out).map_err(SynthError::io(out))?;
        }
        std::fs::rename(&partial, out).map_err(SynthError::io(out))?;
        Ok(value)
    });
    if result.is_err() {
        let _ = std::fs::remove_dir_all(&partial); // the first error is the one to report
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_killed_command_left_goes_with_the_next_one() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| {
            let folder = dir.path().join(name);
            std::fs::create_dir_all(folder.join("images")).unwrap();
            folder
        };
        let (left, written, other) = (at(".reef.partial-7"), at(".reef.partial-8"), at(".wreck.partial-7"));
        let Some(held) = hold(&written) else { return }; // folders cannot be locked here
        whole_folder(&dir.path().join("reef"), |_| Ok(())).unwrap();
        assert!(!left.exists() && written.exists() && other.exists());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3);
        drop(held);
    }
}
