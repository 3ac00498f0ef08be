//! `use3d prepare`: makes a capture from films and photographs. `use3d run` does the same first if it is
//! given a film, or a folder of photographs without a model.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use use3d_capture::name::shown_lines;
use use3d_prepare::{
    CAPTURE, Grade, Input, PREPARED, PrepareError, PrepareParams, Prepared, Programs, Recipe, RecipeScene,
    RecipeWork, Sources, StepProgress, StepWatch, balance, check, key_of, prepare, publish, work_folder,
};
use use3d_workflow::{Digest, Event, place};

use crate::App;
use crate::args::{PrepareArgs, usual_programs};
use crate::destination::{absolute, check_folder, path_text, word};
use crate::error::{CliError, Done};

impl From<PrepareError> for CliError {
    fn from(error: PrepareError) -> Self {
        match error {
            PrepareError::Interrupted => Self::Interrupted,
            PrepareError::Step { .. } | PrepareError::NoCameras { .. } => Self::failed(error),
            _ => Self::input(error),
        }
    }
}

/// A preparation.
struct Preparation<'a> {
    app: &'a App,
    sources: &'a Sources,
    params: &'a PrepareParams,
    programs: &'a Programs,
    out: &'a Path,
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
                self.app.over(step);
            }
        };
        let progress = |StepProgress { step, done, total, unit }| {
            begin(Some(step));
            self.app.progress(step, done, total, unit, "");
        };
        let note = |text: &str| {
            begin(None);
            self.app.listener.event(&Event::Note { label: "prepare", text });
        };
        let done = work(&StepWatch { stop: &self.app.stop, progress: &progress, note: &note });
        begin(None);
        done
    }

    /// Refuses a taken place, wrong choices and missing programs before the inputs are read, because reading
    /// long films takes minutes. A capture that was prepared before may be the wanted one.
    fn check(&self, force: bool) -> Done {
        if self.out.join(PREPARED).is_file() {
            return Ok(());
        }
        check_folder(self.out, force)?;
        Ok(check(self.sources, self.params, self.programs)?)
    }

    /// The key and the inputs of the work that the capture needs; `None` if it was prepared from the same
    /// inputs with the same choices.
    fn need(&self) -> Result<Option<(String, Vec<Input>)>, CliError> {
        let (key, inputs, same) =
            self.watched(|watch| key_of(self.sources, self.params, self.programs.finder, self.out, watch))?;
        let whole =
            || matches!(place::look(self.out, place::Look::Quick), Ok(place::Standing::Ours(o)) if o.whole);
        Ok(if same && whole() { None } else { Some((key, inputs)) })
    }

    /// Does the work, and moves the capture to its place.
    fn make(&self, key: &str, inputs: &[Input], force: bool) -> Result<Prepared, CliError> {
        check_folder(self.out, force)?;
        let work = work_folder(self.out);
        let prepared = self.watched(|watch| {
            let (params, programs) = (self.params, self.programs);
            prepare(self.sources, (key, inputs), params, programs, (&work, self.app.threads), watch)
        })?;
        put(&work, self.out, key, force)?;
        Ok(prepared)
    }
}

/// Moves the finished capture of a work folder to its place.
fn put(work: &Path, out: &Path, key: &str, force: bool) -> Done {
    let made = work.join(CAPTURE);
    place::record(&made, Some(Digest::of(key.as_bytes())))
        .and_then(|()| place::put(&made, out, force))
        .map_err(CliError::failed)?;
    // The capture is in its place; files of the work that stay behind do no harm.
    let _ = std::fs::remove_dir_all(work);
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

pub(crate) fn run(app: &App, args: &PrepareArgs) -> Done {
    // A folder of that name may be the captures of an earlier time.
    let recipe = args.inputs.first().and_then(|input| Recipe::named(input.to_str()?));
    let is_data = |recipe: &Recipe| matches!(&args.inputs[..], [_, data] if recipe.is_in(data));
    if let Some(recipe) = recipe.filter(|recipe| !args.inputs[0].exists() || is_data(recipe)) {
        return by_recipe(app, args, recipe);
    }
    let sources = Sources::of(&args.inputs)?;
    let (params, programs) = (args.params(&PrepareParams::default()), Programs::from(args.programs.clone()));
    let job = Preparation { app, sources: &sources, params: &params, programs: &programs, out: &args.out };
    job.check(args.replace.force)?;
    match job.need()? {
        None if !app.quiet && !args.json => {
            println!("{}: prepared before from the same files and choices", path_text(&args.out));
        }
        None => {}
        Some(_) if args.out.join(PREPARED).is_file() && !args.replace.force => {
            return Err(CliError::Input(format!(
                "--out {}: this capture was prepared from other files or with other choices, or was changed since; pass \
                 --force to replace it, or choose another folder",
                path_text(&args.out)
            )));
        }
        Some((key, inputs)) => {
            let prepared = job.make(&key, &inputs, args.replace.force)?;
            if !args.json {
                lines(&prepared).iter().for_each(|line| println!("{line}"));
            }
        }
    }
    if args.json {
        let path = args.out.join(PREPARED);
        let text = std::fs::read_to_string(&path)
            .map_err(|e| CliError::Failed(format!("{}: {e}", path_text(&path))))?;
        print!("{text}");
    } else {
        remark!(app, "next: use3d run {}", word(&args.out));
    }
    Ok(())
}

/// Prepares the scenes of a data set, each into a capture of its name.
fn by_recipe(app: &App, args: &PrepareArgs, recipe: Recipe) -> Done {
    let [name, folder] = args.inputs.as_slice() else {
        return Err(CliError::Input(format!(
            "`use3d prepare {}` needs one folder, the unpacked data set: docs/guide/datasets.md",
            path_text(&args.inputs[0])
        )));
    };
    if args.json {
        let reason = "--json is for one capture: each scene of a data set has its own prepare.json";
        return Err(CliError::input(reason));
    }
    let params = args.params(&recipe.choices());
    if recipe == Recipe::SeaThruNerf && params != recipe.choices() {
        return Err(CliError::input(
            "this recipe copies published cameras, so there is nothing to choose; leave these flags out",
        ));
    }
    let (scenes, missing) = recipe.scenes(folder)?;
    let data = DataSet { app, args, params: &params, programs: &args.programs.clone().into() };
    data.check(&scenes)?;
    let mut failed = Vec::new();
    for RecipeScene { name, work } in &scenes {
        match data.scene(name, work) {
            Ok(said) => said.iter().for_each(|line| println!("{name}: {line}")),
            Err(CliError::Interrupted) => return Err(CliError::Interrupted),
            Err(error) => {
                eprintln!("{name}: {}", shown_lines(error.text()));
                failed.push(name.as_str());
            }
        }
    }
    if !missing.is_empty() {
        println!("not in {}, and not prepared: {}", path_text(folder), missing.join(", "));
    }
    if !app.quiet {
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
    let names = failed.join(", ");
    Err(CliError::Failed(format!(
        "not prepared: {names}; the reasons are above, and the other scenes are there"
    )))
}

/// The preparation of the scenes of a data set.
struct DataSet<'a> {
    app: &'a App,
    args: &'a PrepareArgs,
    params: &'a PrepareParams,
    programs: &'a Programs,
}

impl DataSet<'_> {
    /// Names a missing program once, and not for each scene that is left to do.
    fn check(&self, scenes: &[RecipeScene]) -> Done {
        let open = scenes.iter().filter(|scene| !self.args.out.join(&scene.name).join(PREPARED).is_file());
        let mut sources = open.filter_map(|scene| match &scene.work {
            RecipeWork::Film(path) | RecipeWork::Linear(path) => Sources::of(std::slice::from_ref(path)).ok(),
            RecipeWork::Published { .. } => None,
        });
        match sources.next().map(|sources| check(&sources, self.params, self.programs)) {
            Some(Err(error @ PrepareError::Program(_))) => Err(error.into()),
            _ => Ok(()),
        }
    }

    /// Prepares a scene, and returns the lines about it.
    fn scene(&self, name: &str, work: &RecipeWork) -> Result<Vec<String>, CliError> {
        let (out, force) = (self.args.out.join(name), self.args.replace.force);
        let (path, linear) = match work {
            RecipeWork::Published { images, model } => return copied(self.app, (images, model), &out, force),
            RecipeWork::Film(path) => (path, false),
            RecipeWork::Linear(path) => (path, true),
        };
        let mut sources = Sources::of(std::slice::from_ref(path))?;
        if linear && sources.has_films() {
            let what = "the folder has films; this recipe takes linear photographs";
            return Err(CliError::Input(format!("{}: {what}", path_text(path))));
        }
        if linear {
            sources.linear = true;
        }
        let DataSet { app, params, programs, .. } = *self;
        let job = Preparation { app, sources: &sources, params, programs, out: &out };
        job.check(force)?;
        let Some((key, inputs)) = job.need()? else {
            return Ok(vec!["prepared before from the same files and choices".into()]);
        };
        if !linear {
            return Ok(lines(&job.make(&key, &inputs, force)?));
        }
        check_folder(&out, force)?;
        let folder = work_folder(&out);
        let balanced = job.watched(|watch| {
            balance(&sources, &folder, watch)?;
            sources.made_in(&folder)
        });
        let sources = balanced.map_err(CliError::from)?;
        Ok(lines(&Preparation { sources: &sources, ..job }.make(&key, &inputs, force)?))
    }
}

/// Copies a published scene into a capture, unless this was done before.
fn copied(
    app: &App,
    (images, model): (&Path, &Path),
    out: &Path,
    force: bool,
) -> Result<Vec<String>, CliError> {
    let mut sources = Sources::of(&[images.to_path_buf()])?;
    sources.add("sparse/0", model);
    if let Some(scene) = images.parent() {
        sources.add_beside(scene);
    }
    // Reading all photographs takes long.
    if !out.join(PREPARED).is_file() {
        check_folder(out, force)?;
    }
    let (params, programs) = (PrepareParams::default(), Programs::default());
    let job = Preparation { app, sources: &sources, params: &params, programs: &programs, out };
    let Some((key, inputs)) = job.need()? else {
        return Ok(vec!["copied before from the same photographs".into()]);
    };
    check_folder(out, force)?;
    let work = work_folder(out);
    publish((images, model), (&key, &inputs), &work)?;
    let imported = use3d_import::import(&work.join(CAPTURE), &use3d_import::ImportParams::default());
    let views = imported.map_err(CliError::input)?.report.views;
    put(&work, out, &key, force)?;
    Ok(vec![format!("{views} photographs and their cameras copied")])
}

/// The capture for the target of a run, prepared if it is not yet. `None` if the target needs no preparation.
/// The capture lies beside the results: in `captures/` in the folder that holds them.
pub(crate) fn capture_for(app: &App, target: &Path, out: Option<&Path>) -> Result<Option<PathBuf>, CliError> {
    let film = target.is_file() && use3d_prepare::is_film(target);
    let pictures =
        || target.is_dir() && use3d_import::holds_no_model(target) && use3d_prepare::holds_inputs(target);
    if !film && !pictures() {
        return Ok(None);
    }
    let sources = Sources::of(&[target.to_path_buf()])?;
    let name = if film {
        target.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    } else {
        use3d_import::capture_name(target)
    };
    let beside = out.map_or(Path::new("use3d-out"), place::parent);
    let capture = beside.join("captures").join(name);
    let (params, programs) = (PrepareParams::default(), usual_programs());
    let job = Preparation { app, sources: &sources, params: &params, programs: &programs, out: &capture };
    job.check(false)?;
    match job.need()? {
        None => remark!(app, "the capture is {}, prepared before", path_text(&capture)),
        Some(_) if capture.exists() => {
            let (target, capture) = (word(target), word(&capture));
            return Err(CliError::Input(format!(
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
                path_text(&capture)
            );
            let prepared = job.make(&key, &inputs, false)?;
            lines(&prepared).iter().for_each(|line| remark!(app, "{line}"));
        }
    }
    Ok(Some(capture))
}
