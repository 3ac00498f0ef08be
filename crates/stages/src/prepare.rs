//! Makes a capture from a film or from photographs, with the programs of others that find cameras; or takes
//! one out of the archive in which its owners publish it.
//!
//! The versions of these programs are in the key. Two runs still differ in the last digits, because COLMAP's
//! threads finish in another order; with `repeatable` they give the same bytes. So the first result of a key
//! stays, and a result that is lost and made again is another capture.

use std::path::Path;

use use3d_prepare::{
    CAPTURE, Input, PREPARED, PrepareError, PrepareParams, Programs, Recipe, RecipeWork, Sources,
    StepProgress, StepWatch, balance, check_linear, discard, key_of, prepare, publish, unpack,
};
use use3d_workflow::{StageContext, StageError};

/// The folder of the unfinished work, and that of files from an archive.
const WORK: &str = "preparing";
const UNPACKED: &str = "unpacked";

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use std::collections::BTreeMap;
    use std::sync::{Mutex, PoisonError};

    use use3d_workflow::{Figure, Lacking, Named, Scope, Stage};

    use crate::planning::expected::of_prepare;

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("prepare", Scope::Scene, run)
            .about("find out where every photograph or frame of a film was taken")
            .promises(&[PREPARED, "sparse/0/"])
            .check(|p: &PrepareParams| p.validate().map_err(of_parameter))
            .when_named(|_, named| named.has("footage"))
            .external("footage", "footage")
            .requires(|all, named, _| all.of().and_then(|p| missing(p, named)).into_iter().collect())
            .made_with(|p: &PrepareParams| match has_cameras(p) {
                true => "no program".to_string(),
                false => versions(p).unwrap_or_else(|_| "no COLMAP".to_string()),
            })
            .agrees_from_run_to_run(&[
                Figure { file: PREPARED, at: "/verdict/images", within: 0.0 },
                Figure { file: PREPARED, at: "/verdict/registered", within: 3.0 },
                Figure { file: PREPARED, at: "/verdict/error", within: 0.2 },
            ])
            .resumable(&["frames"])
            .expects(of_prepare)
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
        named.path("footage").filter(|_| !has_cameras(params))?;
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

/// True if the input has cameras, which its owners publish.
fn has_cameras(params: &PrepareParams) -> bool {
    params.origin.as_ref().is_some_and(|origin| origin.recipe == Recipe::SeaThruNerf)
}

fn run(context: &StageContext, params: &PrepareParams) -> Result<(), StageError> {
    let progress = |StepProgress { step, done, total, unit }| context.progress_with(done, total, unit, step);
    let note = |text: &str| context.say(text);
    let watch = StepWatch { stop: context.stop(), progress: &progress, note: &note };
    let footage = context.input("footage")?.to_path_buf();
    let folder = context.checkpoints().unwrap_or(context.output());
    let (work, unpacked) = (folder.join(WORK), folder.join(UNPACKED));
    let found = match &params.origin {
        Some(origin) if footage.is_file() && use3d_archive::is_archive(&footage) => {
            unpack(&footage, origin, &unpacked, &watch).map_err(failed)?
        }
        Some(origin) if origin.recipe == Recipe::SeaThru => RecipeWork::Linear(footage),
        _ => RecipeWork::Film(footage),
    };
    let said = match &found {
        RecipeWork::Published { images, model } => {
            let mut inputs = Sources::of(std::slice::from_ref(images)).map_err(failed)?;
            inputs.add("sparse/0", model);
            let (key, inputs) = noted(&inputs, context, params, &watch)?;
            publish((images, model), (&key, &inputs), &work).map_err(failed)?;
            Vec::new()
        }
        RecipeWork::Linear(photographs) => find(photographs, true, (context, params), &work, &watch)?,
        RecipeWork::Film(footage) => find(footage, false, (context, params), &work, &watch)?,
    };
    for entry in at(&work, std::fs::read_dir(work.join(CAPTURE)))? {
        let from = at(&work, entry)?.path();
        let to = context.output().join(from.file_name().unwrap_or_default());
        at(&to, std::fs::rename(&from, &to))?;
    }
    said.iter().for_each(|line| context.say(line));
    if unpacked.is_dir() {
        at(&unpacked, std::fs::remove_dir_all(&unpacked))?;
    }
    discard(&work).map_err(failed)
}

/// Finds the cameras of a film, or of photographs, in the folder of the work, and returns the verdict. Linear
/// photographs are encoded for screens first.
fn find(
    footage: &Path,
    linear: bool,
    (context, params): (&StageContext, &PrepareParams),
    work: &Path,
    watch: &StepWatch<'_>,
) -> Result<Vec<String>, StageError> {
    let mut sources = Sources::of(&[footage.to_path_buf()]).map_err(failed)?;
    sources.linear = linear;
    let (key, inputs) = noted(&sources, context, params, watch)?;
    let mut said = Vec::new();
    if linear {
        said = check_linear(footage).map_err(failed)?;
        balance(&sources, work, watch).map_err(failed)?;
        sources = sources.made_in(work).map_err(failed)?;
    }
    let (programs, threads) = (Programs::usual(), context.threads());
    let prepared = prepare(&sources, (&key, &inputs), params, &programs, (work, threads), watch);
    let prepared = prepared.map_err(failed)?;
    said.extend(prepared.verdict.words.into_iter().chain(prepared.remarks));
    Ok(said)
}

/// The key of a preparation and its inputs, without the times of files, which change no result.
fn noted(
    sources: &Sources,
    context: &StageContext,
    params: &PrepareParams,
    watch: &StepWatch<'_>,
) -> Result<(String, Vec<Input>), StageError> {
    let earlier = context.output(); // there is none
    let found = key_of(sources, params, Programs::usual().finder, earlier, watch);
    let (key, mut inputs, _) = found.map_err(failed)?;
    inputs.iter_mut().for_each(|input| input.modified = 0);
    Ok((key, inputs))
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
