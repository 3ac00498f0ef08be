//! `use3d prepare`: makes a capture from films and photographs. `use3d run` does the same first if it is
//! given a film, or a folder of photographs without a model.

use std::path::{Path, PathBuf};

use use3d_capture::name::shown_lines;
use use3d_import::ImportParams;
use use3d_pipeline::destination::{absolute, path_text, word};
use use3d_pipeline::preparation::{DataSet, Preparation, capture_of};
use use3d_prepare::{PREPARED, PrepareParams, Programs, Recipe, RecipeScene, Sources};

use crate::App;
use crate::args::PrepareArgs;
use crate::error::{Done, WorkError};
use crate::verbs::check;

pub(crate) fn run(app: &App, args: &PrepareArgs) -> Done {
    // A folder of that name may be the captures of an earlier time.
    let recipe = args.inputs.first().and_then(|input| Recipe::named(input.to_str()?));
    let is_data = |recipe: &Recipe| matches!(&args.inputs[..], [_, data] if recipe.is_in(data));
    if let Some(recipe) = recipe.filter(|recipe| !args.inputs[0].exists() || is_data(recipe)) {
        return by_recipe(app, args, recipe);
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
    let (params, programs) = (args.params(&PrepareParams::default()), Programs::from(args.programs.clone()));
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

/// Prepares the scenes of a data set, each into a capture of its name.
fn by_recipe(app: &App, args: &PrepareArgs, recipe: Recipe) -> Done {
    let [name, folder] = args.inputs.as_slice() else {
        return Err(WorkError::Input(format!(
            "`use3d prepare {}` needs one folder, the unpacked data set: docs/guide/datasets.md",
            path_text(&args.inputs[0])
        )));
    };
    if args.json {
        let reason = "--json is for one capture: each scene of a data set has its own prepare.json";
        return Err(WorkError::input(reason));
    }
    let params = args.params(&recipe.choices());
    if recipe == Recipe::SeaThruNerf && params != recipe.choices() {
        return Err(WorkError::input(
            "this recipe copies published cameras, so there is nothing to choose; leave these flags out",
        ));
    }
    let (scenes, missing) = recipe.scenes(folder)?;
    let programs = Programs::from(args.programs.clone());
    let (host, out, force) = (&app.host, args.out.as_path(), args.replace.force);
    let data = DataSet { host, params: &params, programs: &programs, out, force };
    data.check(&scenes)?;
    let mut failed = Vec::new();
    for RecipeScene { name, work } in &scenes {
        match data.scene(name, work) {
            Ok(said) => said.iter().for_each(|line| println!("{name}: {line}")),
            Err(WorkError::Interrupted) => return Err(WorkError::Interrupted),
            Err(error) => {
                eprintln!("{name}: {}", shown_lines(&error.to_string()));
                failed.push(name.as_str());
            }
        }
    }
    if !missing.is_empty() {
        println!("not in {}, and not prepared: {}", path_text(folder), missing.join(", "));
    }
    // Without any capture there is nothing to run.
    if !app.quiet && failed.len() < scenes.len() {
        let (variable, pipeline) = recipe.pipeline();
        // A pipeline file in another folder reads the variable, too.
        let (out, name) = (word(&absolute(&args.out)), path_text(name));
        let file = format!("pipelines/{pipeline}.toml");
        let run = match Path::new(&file).is_file() {
            true => format!("use3d run {file}"),
            false => format!("use3d pipelines {pipeline} > {pipeline}.toml; use3d run {pipeline}.toml"),
        };
        eprintln!("next: export {variable}={out}; {run} (docs/guide/datasets.md, recipe {name})");
    }
    if failed.is_empty() {
        return Ok(());
    }
    let (names, all) = (failed.join(", "), failed.len() == scenes.len());
    let others = if all { "" } else { ", and the other scenes are there" };
    Err(WorkError::Failed(format!("not prepared: {names}; the reasons are above{others}")))
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
