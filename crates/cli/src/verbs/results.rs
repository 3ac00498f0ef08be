//! `use3d results`: lists the runs whose results were written into a folder, and restores one of them.

use std::path::{Path, PathBuf};

use serde::Serialize;
use use3d_judge::scores::{Method, SceneScores};
use use3d_stages::SCORES;
use use3d_stages::read_json;
use use3d_workflow::cache::Lookup;
use use3d_workflow::{Cache, machine};

use crate::App;
use crate::args::ResultsArgs;
use crate::destination::{OUT, entries, path_text, word};
use crate::error::{CliError, Done};
use crate::output::json;
use crate::verbs::history::{self, DeliveredArtifact, RunRecord};
use crate::verbs::run;

/// A run in the form in which it is printed.
#[derive(Serialize)]
struct RunLine {
    /// The number that restores the run.
    run: usize,
    /// True if its results are in the folder now.
    shown: bool,
    /// Time when they were written there, UTC.
    delivered: String,
    command: String,
    settings: String,
    /// True if all of its artifacts are still in the cache.
    kept: bool,
    /// PSNR of the held-out views of the first scene, decibels.
    psnr: Option<f64>,
}

/// The results folder for a name or a path.
pub(crate) fn folder(named: &Path) -> Result<PathBuf, CliError> {
    let below = Path::new(OUT).join(named);
    let found = [named.to_path_buf(), below].into_iter().find(|path| !history::records(path).is_empty());
    found.ok_or_else(|| {
        let there: Vec<String> = all().iter().map(|path| path_text(path)).collect();
        let known = match &there[..] {
            [] => format!("there are none in ./{OUT} either; `use3d run CAPTURE_DIR` makes some"),
            there => format!("there are: {}", there.join(", ")),
        };
        CliError::Input(format!("{}: no results of `use3d run` are there; {known}", path_text(named)))
    })
}

/// Every results folder below `./use3d-out`.
fn all() -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> =
        entries(Path::new(OUT)).filter(|path| !history::records(path).is_empty()).collect();
    found.sort();
    found
}

/// The folder of a run's artifact, if it is still in the cache.
pub(crate) fn found(record: &RunRecord, made: &DeliveredArtifact) -> Option<PathBuf> {
    let cache = record.cache.is_dir().then(|| Cache::open(&record.cache, false).ok()).flatten()?;
    match cache.lookup(&made.stage, &made.key) {
        Ok(Lookup::Whole(artifact)) => Some(artifact.path.clone()),
        _ => None,
    }
}

fn line(number: usize, record: &RunRecord, shown: bool) -> RunLine {
    let psnr = || {
        let evaluated = record.artifacts.iter().find(|made| made.stage == "evaluate")?;
        let scores: SceneScores = read_json(&found(record, evaluated)?.join(SCORES)).ok()?;
        scores.mean(Method::Reconstruction, "psnr")?.value()
    };
    let mut delivered = machine::utc(record.delivered);
    delivered.truncate("2026-01-01 00:00".len());
    RunLine {
        run: number,
        shown,
        delivered,
        command: record.command.clone(),
        settings: record.settings(),
        kept: record.artifacts.iter().all(|made| found(record, made).is_some()),
        psnr: psnr(),
    }
}

/// `use3d results`.
pub(crate) fn run(app: &App, args: &ResultsArgs) -> Done {
    let folders = match &args.name {
        Some(name) => vec![folder(name)?],
        None => all(),
    };
    if let (Some(number), [results]) = (args.run, &folders[..]) {
        return bring_back(app, results, number);
    }
    if folders.is_empty() && !args.json {
        return Err(CliError::Input(format!(
            "there are no results in ./{OUT}; `use3d run CAPTURE_DIR` makes some, or name their folder"
        )));
    }
    let mut documents = Vec::new();
    for results in &folders {
        let records = history::records(results);
        let current = history::current(&records).map(|(number, _)| *number);
        let runs = records.iter().map(|(number, record)| line(*number, record, current == Some(*number)));
        documents.push((results.clone(), runs.collect::<Vec<RunLine>>()));
    }
    if args.json {
        let documents: Vec<_> = documents
            .iter()
            .map(|(results, runs)| serde_json::json!({ "results": results, "runs": runs }))
            .collect();
        return json(&documents);
    }
    for (results, runs) in &documents {
        println!("{}", path_text(results));
        for RunLine { run, shown, delivered, settings, kept, psnr, .. } in runs {
            let mark = if *shown { "shown now" } else { "" };
            let psnr = psnr.map_or_else(String::new, |psnr| format!("{psnr:.2} dB"));
            let gone = if *kept { "" } else { "   (no longer complete in the cache)" };
            println!("  {run:>3}  {delivered}  {psnr:>8}  {mark:<9}  {settings}{gone}");
        }
    }
    Ok(())
}

/// Writes the results of an earlier run into their folder again; nothing is computed.
fn bring_back(app: &App, results: &Path, number: usize) -> Done {
    let records = history::records(results);
    let Some((_, record)) = records.iter().find(|(known, _)| *known == number) else {
        let known: Vec<String> = records.iter().map(|(number, _)| number.to_string()).collect();
        return Err(CliError::Input(format!(
            "{}: there is no run {number}; there are: {}",
            path_text(results),
            known.join(", ")
        )));
    };
    run::again(app, record, results).map_err(|error| match error {
        CliError::Input(what) => CliError::Input(format!("run {number} of {}: {what}", word(results))),
        other => other,
    })
}
