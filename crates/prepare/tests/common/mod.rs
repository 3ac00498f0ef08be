//! The frame of a preparation in tests.
#![allow(dead_code, reason = "every test program uses its own part of it")]

#[cfg(unix)]
pub(crate) mod place;

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use use3d_prepare::{
    PrepareError, PrepareParams, Prepared, Programs, Sources, StepWatch, key_of, prepare, work_folder,
};

/// A preparation with its notes.
pub(crate) struct Attempt {
    pub(crate) done: Result<Prepared, PrepareError>,
    pub(crate) notes: Vec<String>,
    /// True if a capture of the same inputs and choices was at `out`.
    pub(crate) reusable: bool,
    /// The folder of the work.
    pub(crate) work: PathBuf,
}

pub(crate) fn attempt(
    inputs: &[PathBuf],
    params: &PrepareParams,
    programs: &Programs,
    out: &Path,
) -> Attempt {
    attempt_until(inputs, params, programs, out, None)
}

/// An attempt that is interrupted after the step whose note begins like this.
pub(crate) fn attempt_until(
    inputs: &[PathBuf],
    params: &PrepareParams,
    programs: &Programs,
    out: &Path,
    last: Option<&str>,
) -> Attempt {
    let (stop, notes) = (AtomicBool::new(false), Mutex::new(Vec::new()));
    let note = |text: &str| {
        notes.lock().unwrap().push(text.to_string());
        stop.fetch_or(last.is_some_and(|last| text.starts_with(last)), Ordering::Relaxed);
    };
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &note };
    let work = work_folder(out);
    let mut reusable = false;
    let done = Sources::of(inputs).and_then(|sources| {
        let (key, inputs, same) = key_of(&sources, params, programs.finder, out, &watch)?;
        reusable = same;
        prepare(&sources, (&key, &inputs), params, programs, (&work, 2), &watch)
    });
    let notes = notes.into_inner().unwrap();
    Attempt { done, notes, reusable, work }
}
