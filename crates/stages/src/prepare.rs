//! Makes a capture from a film or from photographs, with the programs of others that find cameras.
//!
//! The versions of these programs are in the key. Two runs still differ in the last digits, because COLMAP's
//! threads finish in another order; with `repeatable` they give the same bytes. So the first result of a key
//! stays, and a result that is lost and made again is another capture.

use std::path::Path;

use use3d_prepare::{
    CAPTURE, PREPARED, PrepareError, PrepareParams, Programs, Sources, StepProgress, StepWatch, discard,
    key_of, prepare,
};
use use3d_workflow::{StageContext, StageError};

/// The folder of the unfinished work.
const WORK: &str = "preparing";

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use std::collections::BTreeMap;
    use std::sync::{Mutex, PoisonError};

    use use3d_workflow::{Figure, Lacking, Named, Scope, Stage};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("prepare", Scope::Scene, run)
            .about("find the cameras of a film or of photographs: frames, features, matches, model")
            .promises(&[PREPARED, "images/", "sparse/0/"])
            .check(|p: &PrepareParams| p.validate().map_err(of_parameter))
            .when_named(|_, named| named.has("footage"))
            .external("footage", "footage")
            .requires(|all, named, _| all.of().and_then(|p| missing(p, named)).into_iter().collect())
            .made_with(|p: &PrepareParams| versions(p).unwrap_or_else(|_| "no COLMAP".to_string()))
            .agrees_from_run_to_run(&[
                Figure { file: PREPARED, at: "/verdict/images", within: 0.0 },
                Figure { file: PREPARED, at: "/verdict/registered", within: 3.0 },
                Figure { file: PREPARED, at: "/verdict/error", within: 0.2 },
            ])
            .resumable(&["frames"])
            .usually_costs(10.0, 0.5)
            .cost(0, 2 << 30)
    }

    /// The versions of the programs, which are asked once in a process.
    fn versions(params: &PrepareParams) -> Result<String, String> {
        static KNOWN: Mutex<BTreeMap<String, Result<String, String>>> = Mutex::new(BTreeMap::new());
        let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
        let ask = || Programs::usual().versions(params).map_err(|error| error.to_string());
        known.entry(format!("{:?} {}", params.keypoints, params.repeatable)).or_insert_with(ask).clone()
    }

    /// The program that the footage of a scene needs and that is not installed.
    fn missing(params: &PrepareParams, named: &Named) -> Option<Lacking> {
        named.path("footage")?;
        let remedy = versions(params).err()?;
        let what = "the program that finds the cameras of films and photographs".to_string();
        Some(Lacking { what, remedy, without: String::new() })
    }

    /// The field and the problem of a choice that cannot be carried out.
    fn of_parameter(error: PrepareError) -> (String, String) {
        match error {
            PrepareError::Choice { flag, reason } => (flag.trim_start_matches("--").to_string(), reason),
            error => (String::new(), error.to_string()),
        }
    }
}

fn run(context: &StageContext, params: &PrepareParams) -> Result<(), StageError> {
    let sources = Sources::of(&[context.input("footage")?.to_path_buf()]).map_err(failed)?;
    let programs = Programs::usual();
    let progress = |StepProgress { step, done, total, unit }| context.progress_with(done, total, unit, step);
    let note = |text: &str| context.say(text);
    let watch = StepWatch { stop: context.stop(), progress: &progress, note: &note };
    let earlier = context.output(); // there is none
    let (key, mut inputs, _) = key_of(&sources, params, programs.finder, earlier, &watch).map_err(failed)?;
    // The times of files change no result.
    inputs.iter_mut().for_each(|input| input.modified = 0);
    let work = context.checkpoints().unwrap_or(context.output()).join(WORK);
    let threads = context.threads();
    let prepared = prepare(&sources, (&key, &inputs), params, &programs, (&work, threads), &watch);
    let prepared = prepared.map_err(failed)?;
    for entry in at(&work, std::fs::read_dir(work.join(CAPTURE)))? {
        let from = at(&work, entry)?.path();
        let to = context.output().join(from.file_name().unwrap_or_default());
        at(&to, std::fs::rename(&from, &to))?;
    }
    prepared.verdict.words.iter().chain(&prepared.remarks).for_each(|line| context.say(line));
    discard(&work).map_err(failed)
}

fn at<T>(path: &Path, result: std::io::Result<T>) -> Result<T, StageError> {
    result.map_err(|e| StageError::message(format!("{}: {e}", path.display())))
}

fn failed(error: PrepareError) -> StageError {
    match error {
        PrepareError::Interrupted => StageError::Cancelled,
        PrepareError::Step { .. } | PrepareError::Write { .. } | PrepareError::Copy { .. } => {
            StageError::failed(error)
        }
        error => StageError::bad_input(error),
    }
}
