//! Captures from films and photographs: prepares one beside its place, and moves it there when it is whole.
//! A capture that was prepared from the same inputs with the same choices is kept.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use use3d_prepare::{
    CAPTURE, Grade, Input, PREPARED, PrepareError, PrepareParams, Prepared, Programs, Sources, StepProgress,
    StepWatch, check, discard, key_of, prepare, work_folder,
};
use use3d_workflow::{Digest, Event, place};

use crate::WorkError;
use crate::destination::{OUT, check_folder};
use crate::host::Host;
use use3d_config::lacks_cameras;

/// A preparation of one capture.
#[derive(Clone, Copy)]
pub struct Preparation<'a> {
    /// The process that does the work.
    pub host: &'a Host,
    /// The films and photographs.
    pub sources: &'a Sources,
    /// The choices.
    pub params: &'a PrepareParams,
    /// The programs of others.
    pub programs: &'a Programs,
    /// The folder for the capture.
    pub out: &'a Path,
}

impl Preparation<'_> {
    /// Does work whose progress the listener gets. Each step has a label of its own.
    fn watched<T>(
        &self,
        work: impl FnOnce(&StepWatch<'_>) -> Result<T, PrepareError>,
    ) -> Result<T, PrepareError> {
        let current = Cell::new(None);
        let begin = |next: Option<&'static str>| {
            if let Some(step) = current.replace(next).filter(|step| next != Some(*step)) {
                self.host.over(step);
            }
        };
        let progress = |StepProgress { step, done, total, unit }| {
            begin(Some(step));
            self.host.progress(step, done, total, unit, "");
        };
        let note = |text: &str| {
            begin(None);
            self.host.listener.event(&Event::Note { label: "prepare", text });
        };
        let done = work(&StepWatch { stop: &self.host.stop, progress: &progress, note: &note });
        begin(None);
        done
    }

    /// Refuses a taken place, wrong choices and missing programs before the inputs are read, because reading
    /// long films takes minutes. A capture that was prepared before may be the wanted one.
    ///
    /// # Errors
    /// The first of these that is wrong.
    pub fn check(&self, force: bool) -> Result<(), WorkError> {
        if self.out.join(PREPARED).is_file() {
            return Ok(());
        }
        check_folder(self.out, force)?;
        Ok(check(self.sources, self.params, self.programs)?)
    }

    /// The key and the inputs of the work that the capture needs; `None` if it was prepared from the same
    /// inputs with the same choices. Work that an attempt left beside such a capture is removed.
    ///
    /// # Errors
    /// An input cannot be read, or the work was interrupted.
    pub fn need(&self) -> Result<Option<(String, Vec<Input>)>, WorkError> {
        let (key, inputs, same) =
            self.watched(|watch| key_of(self.sources, self.params, self.programs.finder, self.out, watch))?;
        let whole =
            || matches!(place::look(self.out, place::Look::Quick), Ok(place::Standing::Ours(o)) if o.whole);
        if !same || !whole() {
            return Ok(Some((key, inputs)));
        }
        // Work that stays does no harm: another process may use it, or it may be of another program.
        let _ = discard(&work_folder(self.out));
        Ok(None)
    }

    /// Does the work for `key` and `inputs`, moves the capture to its place, and returns the judgement of its
    /// cameras in lines. With `force`, the work begins anew, and an earlier capture is replaced.
    ///
    /// # Errors
    /// The place is taken, no cameras were found, a program of others failed, or the work was interrupted.
    pub fn make(&self, key: &str, inputs: &[Input], force: bool) -> Result<Vec<String>, WorkError> {
        check_folder(self.out, force)?;
        let work = work_folder(self.out);
        if force {
            discard(&work)?;
        }
        let prepared = self.watched(|watch| {
            let (params, programs) = (self.params, self.programs);
            prepare(self.sources, (key, inputs), params, programs, (&work, self.host.threads), watch)
        })?;
        put(&work, self.out, key, force)?;
        Ok(lines(&prepared))
    }
}

/// Moves the finished capture of a work folder to its place.
fn put(work: &Path, out: &Path, key: &str, force: bool) -> Result<(), WorkError> {
    let made = work.join(CAPTURE);
    place::record(&made, Some(Digest::of(key.as_bytes())))
        .and_then(|()| place::put(&made, out, force))
        .map_err(WorkError::failed)?;
    // The capture is in its place; files of the work that stay behind do no harm.
    let _ = discard(work);
    Ok(())
}

/// The judgement in lines, with a word for its grade.
fn lines(prepared: &Prepared) -> Vec<String> {
    let grade = match prepared.verdict.grade {
        Grade::Good => "good",
        Grade::Usable => "usable",
        Grade::Poor => "poor",
    };
    let mut lines = vec![format!("The cameras are {grade}. {}", prepared.verdict.words[0])];
    lines.extend(prepared.verdict.words[1..].iter().chain(&prepared.remarks).cloned());
    lines
}

/// The films or photographs of a target that has no cameras yet, and the folder for their capture: in
/// `captures/` beside the results in `out`. `None` if the target needs no preparation.
///
/// # Errors
/// The target cannot be read.
pub fn capture_of(target: &Path, out: Option<&Path>) -> Result<Option<(Sources, PathBuf)>, WorkError> {
    if !lacks_cameras(target) {
        return Ok(None);
    }
    let sources = Sources::of(&[target.to_path_buf()])?;
    let name = match target.is_file() {
        true => target.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        false => use3d_import::capture_name(target),
    };
    Ok(Some((sources, out.map_or(Path::new(OUT), place::parent).join("captures").join(name))))
}
