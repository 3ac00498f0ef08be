//! `use3d prepare`: makes a capture from films and photographs. `use3d run` does the same first if it is
//! given a film, or a folder of photographs without a model.

use std::path::{Path, PathBuf};

use use3d_import::ImportParams;
use use3d_pipeline::destination::{path_text, word};
use use3d_pipeline::preparation::{Preparation, capture_of};
use use3d_prepare::{PREPARED, PrepareParams, Programs, Recipe, Sources};

use crate::App;
use crate::args::PrepareArgs;
use crate::error::{Done, WorkError};
use crate::verbs::check;

pub(crate) fn run(app: &App, args: &PrepareArgs) -> Done {
    // The recipes of earlier versions.
    if let Some(recipe) = args.inputs.first().filter(|input| !input.exists())
        && let Some(recipe) = Recipe::ALL.into_iter().find(|known| recipe.to_str() == Some(known.name()))
    {
        let variable = recipe.variable();
        return Err(WorkError::Input(format!(
            "`use3d prepare {}` is now a part of the paper's pipeline: `{variable}=FOLDER use3d run paper --until import` \
             (docs/reference/datasets.md)",
            recipe.name()
        )));
    }
    if let [folder] = &args.inputs[..]
        && use3d_import::check_layout(folder).is_ok()
    {
        let (run, images) = (word(folder), path_text(folder));
        return Err(WorkError::Input(format!(
            "{images}: the camera positions are there already; to use them: `use3d run {run}`; to find them again, give the \
             folder of the photographs alone, such as `use3d prepare {run}/images`"
        )));
    }
    let sources = Sources::of(&args.inputs)?;
    let (params, programs) = (args.params(), Programs::from(args.programs.clone()));
    let job = Preparation {
        host: &app.host,
        sources: &sources,
        params: &params,
        programs: &programs,
        out: &args.out,
    };
    job.check(args.replace.force)?;
    match job.need()? {
        None if !app.quiet && !args.json => {
            println!("{}: prepared before from the same files and choices", path_text(&args.out));
        }
        None => {}
        Some(_) if args.out.join(PREPARED).is_file() && !args.replace.force => {
            return Err(WorkError::Input(format!(
                "--out {}: this capture was prepared from other files or with other choices, or was changed since; pass \
                 --force to replace it, or choose another folder",
                path_text(&args.out)
            )));
        }
        Some((key, inputs)) => {
            let mut lines = job.make(&key, &inputs, args.replace.force)?;
            if !args.json {
                lines.extend(check::before_run(&args.out, &ImportParams::default()));
                lines.iter().for_each(|line| println!("{line}"));
            }
        }
    }
    if args.json {
        let path = args.out.join(PREPARED);
        let text = std::fs::read_to_string(&path)
            .map_err(|e| WorkError::Failed(format!("{}: {e}", path_text(&path))))?;
        print!("{text}");
    } else {
        remark!(app, "next: use3d run {}", word(&args.out));
    }
    Ok(())
}

/// The capture for the target of a run, prepared if it is not yet. `None` if the target needs no preparation.
pub(crate) fn capture_for(
    app: &App,
    target: &Path,
    out: Option<&Path>,
) -> Result<Option<PathBuf>, WorkError> {
    let Some((sources, out)) = capture_of(target, out)? else { return Ok(None) };
    let (params, programs) = (PrepareParams::default(), Programs::usual());
    let job =
        Preparation { host: &app.host, sources: &sources, params: &params, programs: &programs, out: &out };
    job.check(false)?;
    match job.need()? {
        None => remark!(app, "the capture is {}, prepared before", path_text(&out)),
        Some(_) if out.exists() => {
            let (target, capture) = (word(target), word(&out));
            return Err(WorkError::Input(format!(
                "{capture}: this capture was prepared from other files or with other choices, or was changed since; `use3d prepare {target} \
                 --out {capture} --force` replaces it; to keep it, prepare {target} into another folder with --out, and \
                 run that folder"
            )));
        }
        Some((key, inputs)) => {
            remark!(
                app,
                "{} has no cameras yet: preparing the capture {} (`use3d prepare` has more choices)",
                path_text(target),
                path_text(&out)
            );
            job.make(&key, &inputs, false)?.iter().for_each(|line| remark!(app, "{line}"));
        }
    }
    Ok(Some(out))
}
