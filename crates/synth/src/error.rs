//! What can go wrong while a synthetic data set is written.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use use3d_numerics::range::OutOfRange;

/// A data set that cannot be made or written. Nothing is left behind under its name.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// A parameter out of its range.
    #[error(transparent)]
    Parameter(#[from] OutOfRange),
    /// The output is there already.
    #[error("{}: already there; choose another output folder or remove this one first", path.display())]
    OutputExists {
        /// The output folder.
        path: PathBuf,
    },
    /// A folder or file that cannot be made.
    #[error("{}: cannot be written ({source}); check that the folder is there, writable and has space", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Whoever watches the progress asked to stop.
    #[error("interrupted; nothing is left of what was begun")]
    Interrupted,
    /// A name that no image can have.
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

/// Refuses a parameter that is not `good`, with what is expected in words.
pub(crate) fn check(
    parameter: &str,
    value: impl std::fmt::Display,
    good: bool,
    expected: &str,
) -> Result<(), OutOfRange> {
    if good { Ok(()) } else { Err(OutOfRange::new(parameter, value, expected)) }
}

/// What whoever watches the progress answers: nothing, or whether to go on.
pub trait Answer {
    /// [`SynthError::Interrupted`] when the work is to stop.
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

/// Locks a folder for as long as the answer lives: whoever finds it unlocked knows that its writer is gone.
/// None where folders cannot be locked.
fn hold(folder: &Path) -> Option<std::fs::File> {
    let handle = std::fs::File::open(folder).ok()?;
    handle.try_lock().is_ok().then_some(handle)
}

/// What begins the name of a folder that becomes one called `name`.
fn partial_name(name: &std::ffi::OsStr) -> String {
    format!(".{}.partial-", name.to_string_lossy())
}

/// Removes what commands that were killed left beside `out`.
fn sweep_partials(out: &Path) {
    let prefix = partial_name(out.file_name().unwrap_or_default());
    for entry in std::fs::read_dir(use3d_files::folder_of(out)).into_iter().flatten().flatten() {
        let left = entry.file_name().to_string_lossy().starts_with(&prefix);
        if left && hold(&entry.path()).is_some() {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

/// Runs `fill` on a new folder beside `out` and renames it to `out` when it is complete: the output is there
/// whole or not at all. An existing empty folder is replaced; anything else in the way is an error.
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
    // Not where something is: that would be somebody else's.
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
