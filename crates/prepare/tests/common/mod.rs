//! The frame of a preparation in tests.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;

use use3d_prepare::{
    PrepareError, PrepareParams, Prepared, Programs, Sources, Watch, key_of, prepare, work_folder,
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
    let (stop, notes) = (AtomicBool::new(false), Mutex::new(Vec::new()));
    let note = |text: &str| notes.lock().unwrap().push(text.to_string());
    let watch = Watch { stop: &stop, progress: &|_| (), note: &note };
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
